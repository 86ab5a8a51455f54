//! Tests triangles against the rays of a bundle, in single precision.
//!
//! After Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (2013): corners are sheared so that the ray becomes an
//! axis. [`triangle`] decides where rounding could change the answer, so the answers are those of rays that go alone.
//!
//! A large triangle is tested against all rays at once. A small one lies on the way of two or three of them: these pairs wait
//! until they fill a vector, and are tested a pair a lane.

use super::{Bundle, MOST_RAYS, RayLanes};
use crate::{
    intersect::{margins::UNDERFLOW_MARGIN, triangle},
    simd::{Simd, consecutive},
};

/// Rounding error of an edge's side, relative to L·(L + D) for the corners' largest sheared coordinate L and largest depth D: 20
/// roundings, for slopes up to [`super::STEEPEST`], and 12 to spare. Such products are finite: usable positions are below 10¹⁷, and
/// bundles span at most [`super::FARTHEST`] extents.
const SIDE_MARGIN: f32 = 32.0 / (1u32 << 24) as f32;

/// Rounding error of a depth, relative to distances along the normal: 20 roundings, and 12 to spare.
const DEPTH_MARGIN: f32 = 32.0 / (1u32 << 24) as f32;

/// Least cosine, as it were, between ray and normal for which [`DEPTH_MARGIN`] holds.
const LEAST_COSINE: f32 = 1.0 / 4096.0;

/// Fewest rays that are tested against a triangle at once. With 4 to 10 in its place, rays to a sun take as long.
const FEWEST_AT_ONCE: u32 = 6;

/// Room for pairs that wait, for those of another triangle, and to write a whole vector behind any of them.
const ROOM: usize = 3 * MOST_RAYS;

/// Pairs of a ray and a triangle that wait for their test: fewer than [`MOST_RAYS`].
pub(super) struct Pairs {
    /// By index in the bundle.
    rays: [u32; ROOM],
    triangles: [u32; ROOM],
    n: usize,
}

impl Pairs {
    pub(super) const NONE: Self = Self { rays: [0; ROOM], triangles: [0; ROOM], n: 0 };
}

/// A ray and a triangle in each lane, by the bundle's axes.
struct PairLanes<S> {
    /// The triangle's corners, from the ray's origin.
    corners: [[S; 3]; 3],
    /// A vector of any length across the triangle, and the size to which its rounding error is relative.
    normal: [S; 3],
    normal_scale: S,
    /// Of the ray, as in [`RayLanes`].
    slopes: [S; 2],
    interval: [S; 2],
}

/// Single precision's answer, with a bit for each lane. Lanes with neither bit miss.
#[derive(Clone, Copy)]
struct Verdict {
    hit: u32,
    undecided: u32,
}

impl<S: Simd> PairLanes<S> {
    #[inline(always)]
    fn test(&self) -> Verdict {
        // Shear the corners so that the ray becomes the axis k.
        let Self { corners, normal, normal_scale, slopes, interval } = self;
        let zero = S::splat(0.0);
        let mut sheared = [[zero; 2]; 3];
        for corner in 0..3 {
            let [depth, u, v] = corners[corner];
            sheared[corner] = [slopes[0].neg_mul_add(depth, u), slopes[1].neg_mul_add(depth, v)];
        }

        // Find the side on which the ray passes each edge.
        let [a, b, c] = sheared;
        let sides = [
            c[0].mul_sub(b[1], c[1].mul(b[0])),
            a[0].mul_sub(c[1], a[1].mul(c[0])),
            b[0].mul_sub(a[1], b[1].mul(a[0])),
        ];
        let largest = a[0].abs().max(a[1].abs()).max(b[0].abs().max(b[1].abs())).max(c[0].abs().max(c[1].abs()));
        let deepest = corners[0][0].abs().max(corners[1][0].abs()).max(corners[2][0].abs());
        let error = largest.add(deepest).mul(S::splat(SIDE_MARGIN));
        let margin = largest.add(error).mul_add(error, S::splat(UNDERFLOW_MARGIN));
        let low = sides[0].min(sides[1]).min(sides[2]);
        let high = sides[0].max(sides[1]).max(sides[2]);
        let inside = low.max(zero.sub(high));
        let all = ((1u64 << S::LANES) - 1) as u32;
        let possible = all & !inside.lt(zero.sub(margin));

        // Bound the depth at which the ray meets the triangle's plane. In tiny scenes, products along it may leave the range of
        // normal numbers.
        let underflow = S::splat(UNDERFLOW_MARGIN);
        let normal_scale = normal_scale.add(underflow);
        let [along_k, along_u, along_v] = *normal;
        let [depth, u, v] = corners[0];
        let offset = along_k.mul_add(depth, along_u.mul_add(u, along_v.mul(v)));
        let cosine = along_u.mul_add(slopes[0], along_v.mul_add(slopes[1], along_k));
        let inverse = S::splat(1.0).div(cosine);
        let distance = depth.abs().max(u.abs()).max(v.abs());
        let depth = offset.mul(inverse);
        let error = distance.add(depth.abs()).mul_add(normal_scale.mul(S::splat(DEPTH_MARGIN)), underflow);
        let error = error.mul(inverse.abs());
        let (least, greatest) = (depth.sub(error), depth.add(error));

        // Find certain hits, and what rounding could change.
        let [start, end] = *interval;
        let bounded = possible & normal_scale.mul(S::splat(LEAST_COSINE)).lt(cosine.abs());
        let outside = bounded & (greatest.lt(start) | end.lt(least));
        let hit = bounded & margin.lt(inside) & start.lt(least) & greatest.lt(end);
        Verdict { hit, undecided: possible & !outside & !hit }
    }
}

impl Bundle<'_> {
    /// Tests a triangle against some rays, at once or when their pairs and others fill a vector.
    #[inline(always)]
    pub(super) fn test_soon<S: Simd>(&mut self, triangle: u32, rays: u32) {
        if rays.count_ones() >= FEWEST_AT_ONCE {
            self.test_triangle::<S>(triangle, rays);
            return;
        }
        if rays == 0 {
            return;
        }
        let Pairs { rays: rays_of_pairs, triangles, n } = &mut self.pairs;
        let mut end = *n % MOST_RAYS;
        triangles[end..][..MOST_RAYS].fill(triangle);
        for first in (0..MOST_RAYS).step_by(S::LANES) {
            let lanes = S::load_bits(&consecutive(first as u32));
            end += lanes.compress_bits_to(rays >> first, &mut rays_of_pairs[end % (2 * MOST_RAYS)..]);
        }
        *n = end;
        if end >= MOST_RAYS {
            for first in (0..MOST_RAYS).step_by(S::LANES) {
                self.test_vector::<S>(first, S::LANES);
            }
            let Pairs { rays, triangles, n } = &mut self.pairs;
            rays.copy_within(MOST_RAYS..2 * MOST_RAYS, 0);
            triangles.copy_within(MOST_RAYS..2 * MOST_RAYS, 0);
            *n -= MOST_RAYS;
        }
    }

    /// Tests all pairs that wait, unless all rays are hidden.
    #[inline(always)]
    pub(super) fn test_waiting<S: Simd>(&mut self) {
        let n = if self.left == 0 { 0 } else { self.pairs.n };
        for first in (0..n).step_by(S::LANES) {
            self.test_vector::<S>(first, n - first);
        }
        self.pairs.n = 0;
    }

    /// Tests a triangle against some rays.
    #[inline(always)]
    pub(super) fn test_triangle<S: Simd>(&mut self, triangle: u32, rays: u32) {
        let corners = self.grid.mesh().corners_by_call(triangle);
        let mut points = [[0.0; 3]; 3];
        for corner in 0..3 {
            for axis in 0..3 {
                points[corner][axis] = corners[corner][self.axes[axis]] * self.shaft.signs[axis];
            }
        }
        let normal = normal(&points);
        let normal_scale = S::splat(normal[0].abs() + normal[1].abs() + normal[2].abs());
        let normal = [S::splat(normal[0]), S::splat(normal[1]), S::splat(normal[2])];
        for first in (0..MOST_RAYS).step_by(S::LANES) {
            let RayLanes { origins, slopes, intervals, .. } = &self.lanes;
            let mut from_origin = [[S::splat(0.0); 3]; 3];
            for axis in 0..3 {
                let origin = S::load(&origins[axis][first..]);
                for corner in 0..3 {
                    from_origin[corner][axis] = S::splat(points[corner][axis]).sub(origin);
                }
            }
            let lanes = PairLanes {
                corners: from_origin,
                normal,
                normal_scale,
                slopes: [S::load(&slopes[0][first..]), S::load(&slopes[1][first..])],
                interval: [S::load(&intervals[0][first..]), S::load(&intervals[1][first..])],
            };
            let hit = self.hits(lanes.test(), rays >> first, &[triangle; 16], &consecutive(first as u32));
            if hit != 0 {
                self.occluder = Some(triangle);
            }
            self.occluded |= hit << first;
        }
        self.left &= !self.occluded;
    }

    /// Tests up to [`Simd::LANES`] of `n` pairs that wait, from `first` on. Lanes behind the last do not count.
    #[inline(always)]
    fn test_vector<S: Simd>(&mut self, first: usize, n: usize) {
        let mut pairs = [[0; 16]; 2];
        pairs[0].copy_from_slice(&self.pairs.rays[first % (2 * MOST_RAYS)..][..16]);
        pairs[1].copy_from_slice(&self.pairs.triangles[first % (2 * MOST_RAYS)..][..16]);
        let [rays, triangles] = &pairs;
        let corners = self.grid.mesh().gather_corners::<S>(triangles);
        let RayLanes { origins, slopes, intervals, .. } = &self.lanes;
        let mut from_origin = [[S::splat(0.0); 3]; 3];
        let mut edges = [[S::splat(0.0); 3]; 2];
        for axis in 0..3 {
            let (sign, origin) = (S::splat(self.shaft.signs[axis]), S::pick(&origins[axis], rays));
            let mut along = [S::splat(0.0); 3];
            for corner in 0..3 {
                along[corner] = corners[corner][self.axes[axis] % 3].mul(sign);
                from_origin[corner][axis] = along[corner].sub(origin);
            }
            (edges[0][axis], edges[1][axis]) = (along[1].sub(along[0]), along[2].sub(along[0]));
        }
        let (normal, normal_scale) = normal_of_edges(edges);
        let lanes = PairLanes {
            corners: from_origin,
            normal,
            normal_scale,
            slopes: [S::pick(&slopes[0], rays), S::pick(&slopes[1], rays)],
            interval: [S::pick(&intervals[0], rays), S::pick(&intervals[1], rays)],
        };
        let mut hit = self.hits(lanes.test(), u32::MAX >> (32 - S::LANES.min(n)), triangles, rays);
        while hit != 0 {
            let lane = hit.trailing_zeros() as usize % 16;
            hit &= hit - 1;
            self.occluded |= 1 << rays[lane];
            self.occluder = Some(triangles[lane]);
        }
        self.left &= !self.occluded;
    }

    /// A bit for each of the `pairs` whose ray hits its triangle; those that are undecided are decided here.
    #[inline(always)]
    fn hits(&self, verdict: Verdict, pairs: u32, triangles: &[u32; 16], rays: &[u32; 16]) -> u32 {
        let mesh = self.grid.mesh();
        let Verdict { hit, undecided } = verdict;
        let (mut hit, mut undecided) = if mesh.has_masks() { (0, hit | undecided) } else { (hit, undecided) };
        (hit, undecided) = (hit & pairs, undecided & pairs);
        while undecided != 0 {
            let lane = undecided.trailing_zeros() as usize % 16;
            undecided &= undecided - 1;
            let (triangle, ray) = (triangles[lane], &self.rays[rays[lane] as usize]);
            let is_hit = triangle::intersect(ray, &mesh.corners_by_call(triangle)).is_some()
                && !(mesh.has_masks() && mesh.is_passed(triangle, ray));
            hit |= u32::from(is_hit) << lane;
        }
        hit
    }
}

/// A vector across each triangle with these edges from a corner, and the size to which its rounding error is relative. Edges are
/// differences of corners as they are, so their rounding error is relative to themselves.
#[inline(always)]
fn normal_of_edges<S: Simd>([[x, y, z], [p, q, r]]: [[S; 3]; 2]) -> ([S; 3], S) {
    let normal = [y.mul_sub(r, z.mul(q)), z.mul_sub(p, x.mul(r)), x.mul_sub(q, y.mul(p))];
    let size = normal[0].abs().add(normal[1].abs()).add(normal[2].abs());
    let of_edges = x.abs().max(y.abs()).max(z.abs()).mul(p.abs().max(q.abs()).max(r.abs()));
    (normal, size.add(of_edges))
}

/// A vector of any length across a triangle, rounded once.
#[inline(always)]
fn normal(points: &[[f32; 3]; 3]) -> [f32; 3] {
    let [a, b, c] = points.map(|point| point.map(f64::from));
    let ([x, y, z], [p, q, r]) = ([b[0] - a[0], b[1] - a[1], b[2] - a[2]], [c[0] - a[0], c[1] - a[1], c[2] - a[2]]);
    [(y * r - z * q) as f32, (z * p - x * r) as f32, (x * q - y * p) as f32]
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::{
        intersect::ray::Ray,
        simd::{InstructionSet, Kernel},
    };

    /// The pair in all lanes, with a normal in `f64`, or of the edges.
    fn lanes<S: Simd>(ray: &Ray, corners: &[[f32; 3]; 3], of_edges: bool) -> PairLanes<S> {
        const AXES: [usize; 3] = [2, 0, 1];
        let splat = S::splat;
        let points = corners.map(|corner| AXES.map(|axis| corner[axis]));
        let along = |to: usize| AXES.map(|axis| splat(corners[to][axis] - corners[0][axis]));
        let (normal, normal_scale) = if of_edges {
            normal_of_edges([along(1), along(2)])
        } else {
            let normal = normal(&points);
            (normal.map(splat), splat(normal.iter().map(|component| component.abs()).sum()))
        };
        PairLanes {
            corners: corners.map(|corner| AXES.map(|axis| splat(corner[axis] - ray.origin[axis]))),
            normal,
            normal_scale,
            slopes: [ray.direction.x, ray.direction.y].map(|across| splat(across / ray.direction.z)),
            interval: [ray.t_min, ray.t_max].map(|t| splat(t * ray.direction.z)),
        }
    }

    #[test]
    fn single_precision_agrees_with_the_exact_test_or_does_not_decide() {
        for instructions in InstructionSet::available() {
            // SAFETY: they are available.
            let [n_hits, n_misses, n] = unsafe { instructions.call(Agreement) };
            assert!(n_hits > n / 60 && n_misses > n / 50, "{n_hits} hits and {n_misses} misses are certain, of {n}");
        }
    }

    /// Compares with the exact test. Returns how many hits and misses are certain, and how many tests there were.
    struct Agreement;

    impl Kernel for Agreement {
        type Output = [u32; 3];
        #[inline(always)]
        fn run<S: Simd>(self) -> [u32; 3] {
            agreement::<S>()
        }
    }

    fn agreement<S: Simd>() -> [u32; 3] {
        // Deterministic rays that aim at points of triangles, or at their edges and corners, from near and far.
        let mut bits = 1u32;
        let mut random = || {
            bits = bits.wrapping_mul(0x915f_77f5).wrapping_add(0x9e37_79b9);
            (bits >> 8) as f32 / 8_388_608.0 - 1.0
        };
        let (mut n_hits, mut n_misses, mut n) = (0, 0, 0);
        for size in [1e-18f32, 1e-15, 1e-12, 1e-6, 1e-4, 1e-2, 1.0] {
            for distance in [1e-18f32, 1e-15, 1e-12, 1e-4, 1e-2, 1.0, 10.0] {
                for case in 0..500 {
                    let mut point = || Vec3::new(random(), random(), random());
                    let (origin, slopes, centre) = (point(), point(), point() * size);
                    let flatness = if case % 5 == 0 { 1e-3 } else { 1.0 };
                    let mut corner = || centre + point() * Vec3::new(size, size * flatness, size);
                    let corners = [corner(), corner(), corner()];
                    let weights = match case % 4 {
                        0 => Vec3::X,
                        1 => Vec3::new(0.5, 0.5, 0.0),
                        _ => point().abs() * 0.6,
                    };
                    let [a, b, c] = corners;
                    let target = a * weights.x + b * weights.y + c * (1.0 - weights.x - weights.y);
                    let direction = Vec3::new(slopes.x, slopes.y, 1.0) * (0.1 + slopes.z.abs());
                    let origin = target - direction * distance + origin * (size * f32::EPSILON);
                    // Intervals begin or end at the triangle, or beside it.
                    let ends =
                        [0.0, 1.0 - 1e-4, 1.0 - 1e-6, 1.0 + 1e-6, 1.0 + 1e-4, f32::MAX].map(|part| part * distance);
                    let (t_min, t_max) = (ends[case / 2 % 4], ends[5 - case / 8 % 4]);
                    let ray = Ray { origin, direction, t_min, t_max };
                    let corners = corners.map(|corner| corner.to_array());
                    let expected = triangle::intersect(&ray, &corners).is_some();
                    for of_edges in [false, true] {
                        let Verdict { hit, undecided } = lanes::<S>(&ray, &corners, of_edges).test();
                        let decided = undecided & 1 == 0;
                        assert!(!decided || (hit & 1 == 1) == expected, "{ray:?} {corners:?}");
                        n_hits += u32::from(decided && expected);
                        n_misses += u32::from(decided && !expected);
                        n += 1;
                    }
                }
            }
        }
        [n_hits, n_misses, n]
    }
}
