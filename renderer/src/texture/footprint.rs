//! The part of a texture that one sample of the picture shows, and the lookups that cover it.
//!
//! Ray differentials after Igehy, "Tracing Ray Differentials" (1999), for rays of a camera, where they are exact; several
//! lookups along the longer axis after McCormack et al., "Feline: Fast Elliptical Lines for Anisotropic Texture Mapping"
//! (1999).

use glam::{Vec2, Vec3};

use crate::{
    intersect::{ray::Ray, triangle},
    texture::level::round,
};

/// A parallelogram on a texture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint {
    /// Its centre, in texture coordinates.
    pub(crate) centre: Vec2,
    /// Its sides.
    pub(crate) sides: [Vec2; 2],
}

/// Footprints that are computed at once: loops over arrays, which the compiler turns into vector instructions.
pub(crate) const N: usize = 16;

/// Two coordinates on a texture for each of [`N`] samples.
pub(crate) type Points = [[f32; N]; 2];

/// [`N`] footprints.
#[derive(Clone, Copy)]
pub(crate) struct FootprintLanes {
    pub(super) centres: Points,
    pub(super) sides: [Points; 2],
}

/// Up to 64 footprints, of the hits on triangles in their order.
pub(crate) struct Footprints {
    /// Those beyond it are undefined.
    pub(super) n: usize,
    pub(super) lanes: [FootprintLanes; 64 / N],
}

/// Squares along a footprint's longer axis that cover it.
#[derive(Clone, Copy)]
pub(super) struct Squares {
    pub(super) first: Vec2,
    pub(super) step: Vec2,
    /// At least 1.
    pub(super) n: u32,
    /// 1 / n.
    pub(super) part: f32,
    /// Of the texels that are to be looked up, in texels of the image.
    pub(super) width: f32,
}

/// The distance of squares in units of their side: a lookup blends the texels around its point, so it reaches that far.
const REACH: f32 = 1.7;

/// The width of texels for a square, in units of its side. With these numbers a tenth to a fifth of the lookups are saved that
/// up to five squares need with 1.5 and 1.0, and a checkerboard to the horizon has the same PSNR.
const BLUR: f32 = 1.25;

/// Limit of [`Squares::n`]: longer footprints are blurred across. [`Footprint::squares`] lists 1 / n up to it.
pub(super) const MOST_SQUARES: u32 = 4;

/// Rays by number, and the change of their directions across the width and the height of what each stands for.
pub(crate) trait WideRays: Copy {
    fn origin(&self, index: usize) -> Vec3;
    fn direction(&self, index: usize) -> Vec3;
    fn sides(&self, index: usize) -> [Vec3; 2];
}

/// Rays of a camera, and the change of their directions across the width and the height of a sample.
#[derive(Clone, Copy)]
pub(crate) struct SampleRays<'a> {
    pub(crate) eye: Vec3,
    pub(crate) directions: &'a [Vec3],
    pub(crate) sides: [Vec3; 2],
}

impl WideRays for SampleRays<'_> {
    #[inline(always)]
    fn origin(&self, _: usize) -> Vec3 {
        self.eye
    }

    #[inline(always)]
    fn direction(&self, index: usize) -> Vec3 {
        self.directions[index]
    }

    #[inline(always)]
    fn sides(&self, _: usize) -> [Vec3; 2] {
        self.sides
    }
}

/// Where a ray hits a triangle, in texture coordinates; `coordinates` are those of its corners.
#[inline]
pub(crate) fn texture_point(ray: &Ray, corners: &[[f32; 3]; 3], [a, b, c]: [Vec2; 3]) -> Vec2 {
    let weights = triangle::corner_weights(ray.origin, ray.direction, corners);
    a * weights[0] as f32 + b * weights[1] as f32 + c * weights[2] as f32
}

/// A hit of a ray, and the change of the ray's direction across the width and the height of its sample.
pub(crate) struct WideHit {
    pub(crate) direction: Vec3,
    pub(crate) sides: [Vec3; 2],
    /// Those of the triangle.
    pub(crate) corners: [Vec3; 3],
    /// Of unit length, on the side where the corners run counter-clockwise.
    pub(crate) normal: Vec3,
    /// The hit's distance, in lengths of `direction`, over twice the triangle's area.
    pub(crate) distance_by_area: f32,
}

impl WideHit {
    /// The footprint on a triangle with these texture coordinates of its corners; `weights` are the corners' parts of the hit
    /// point.
    ///
    /// The point moves by t·(side − direction · (normal·side) / (normal·direction)), and the part of a corner grows at right
    /// angles to the opposite edge, over twice the triangle's area.
    #[inline(always)]
    pub(crate) fn footprint(&self, coordinates: [Vec2; 3], weights: Vec3) -> Footprint {
        let ([a, b, c], [at_a, at_b, at_c]) = (self.corners, coordinates);
        // Edges first, so that no product of triangles of any size overflows.
        let (ab, ac) = ((b - a) * self.distance_by_area, (c - a) * self.distance_by_area);
        let (growth_of_b, growth_of_c) = (ac.cross(self.normal), self.normal.cross(ab));
        let (along_b, along_c) = (growth_of_b.dot(self.direction), growth_of_c.dot(self.direction));
        let inverse = 1.0 / self.normal.dot(self.direction);
        let (to_b, to_c) = (at_b - at_a, at_c - at_a);
        let change = |side: Vec3| {
            let farther = self.normal.dot(side) * inverse;
            to_b * (growth_of_b.dot(side) - along_b * farther) + to_c * (growth_of_c.dot(side) - along_c * farther)
        };
        Footprint {
            centre: at_a + to_b * weights.y + to_c * weights.z,
            sides: [change(self.sides[0]), change(self.sides[1])],
        }
    }
}

impl Footprints {
    pub(crate) const NONE: Self = Self { n: 0, lanes: [FootprintLanes::NONE; 64 / N] };

    pub(crate) fn clear(&mut self) {
        self.n = 0;
    }

    /// Adds footprints behind the others, whose number must be a multiple of [`N`]; of the last ones there may be fewer.
    #[inline(always)]
    pub(crate) fn push(&mut self, lanes: &FootprintLanes, n: usize) {
        self.lanes[self.n / N % (64 / N)] = *lanes;
        self.n += n;
    }

    pub(super) fn is_empty(&self) -> bool {
        self.n == 0
    }

    /// Some of the footprints.
    pub(super) fn pick(&self, indices: &[usize]) -> Self {
        let mut picked = Self::NONE;
        for (to, &from) in indices.iter().enumerate() {
            picked.lanes[to / N].set(to % N, &self.lanes[from / N].get(from % N));
        }
        picked.n = indices.len();
        picked
    }
}

impl FootprintLanes {
    pub(crate) const NONE: Self = Self { centres: [[0.0; N]; 2], sides: [[[0.0; N]; 2]; 2] };

    #[inline(always)]
    pub(crate) fn set(&mut self, lane: usize, footprint: &Footprint) {
        for axis in 0..2 {
            self.centres[axis][lane] = footprint.centre[axis];
            self.sides[0][axis][lane] = footprint.sides[0][axis];
            self.sides[1][axis][lane] = footprint.sides[1][axis];
        }
    }

    #[inline(always)]
    pub(super) fn get(&self, lane: usize) -> Footprint {
        let point = |[u, v]: &Points| Vec2::new(u[lane], v[lane]);
        Footprint { centre: point(&self.centres), sides: [point(&self.sides[0]), point(&self.sides[1])] }
    }
}

#[cfg(test)]
impl FromIterator<Footprint> for Footprints {
    fn from_iter<T: IntoIterator<Item = Footprint>>(all: T) -> Self {
        let mut footprints = Self::NONE;
        for footprint in all {
            footprints.lanes[footprints.n / N].set(footprints.n % N, &footprint);
            footprints.n += 1;
        }
        footprints
    }
}

impl Footprint {
    /// The footprint on a texture whose coordinates are this matrix times (u, v, 1).
    #[inline(always)]
    pub(super) fn transformed(&self, rows: &[[f32; 3]; 2]) -> Self {
        let [[a, b, _], [c, d, _]] = *rows;
        let [right, up] = self.sides;
        let [right, up] = [
            Vec2::new(a * right.x + b * right.y, c * right.x + d * right.y),
            Vec2::new(a * up.x + b * up.y, c * up.x + d * up.y),
        ];
        Self { centre: transformed(self.centre, rows), sides: [right, up] }
    }

    /// Whether it is so small that a single square covers it, of texels of an image of `size` texels: its shorter axis is at
    /// most 1.12 texels long then, and its longer 1.59.
    #[inline(always)]
    pub(super) fn is_small(&self, size: Vec2) -> bool {
        (self.sides[0] * size).length_squared() + (self.sides[1] * size).length_squared() <= 2.5
    }

    /// The squares for an image of `size` texels. Nothing branches, so that a loop becomes vector instructions.
    #[inline(always)]
    pub(super) fn squares(&self, size: Vec2) -> Squares {
        // The axes are those of the ellipse that the sides span: the singular values and vectors of a matrix.
        let (a, b) = (self.sides[0] * size, self.sides[1] * size);
        let (sum, area) = (a.length_squared() + b.length_squared(), a.perp_dot(b).abs());
        let difference = ((sum - 2.0 * area).max(0.0) * (sum + 2.0 * area)).sqrt();
        let major_squared = (sum + difference) * 0.5;
        let major = major_squared.sqrt();
        // Texels are never narrower than one.
        let minor = (area / major).max(1.0);
        // `clamp` would leave NaN, of which no number of squares can be made.
        let (n, integer) = round((major / (minor * REACH)).min(MOST_SQUARES as f32).max(1.0));
        let is_one = integer == 1;
        // Chosen, not divided: that took a 15th of the time of all lookups.
        let part = if n < 1.5 {
            1.0
        } else if n < 2.5 {
            0.5
        } else if n < 3.5 {
            1.0 / 3.0
        } else {
            0.25
        };

        // A single square needs no axis, and a circle has none.
        let (xx, yy, xy) = (a.x * a.x + b.x * b.x, a.y * a.y + b.y * b.y, a.x * a.y + b.x * b.y);
        let along = if xx > yy { Vec2::new(major_squared - yy, xy) } else { Vec2::new(xy, major_squared - xx) };
        let scale = if is_one { 0.0 } else { major / along.length() };
        let axis = along * scale * (1.0 / size);
        let step = axis * part;
        Squares {
            first: self.centre - (axis - step) * 0.5,
            step,
            n: integer as u32,
            part,
            width: (major * part * (1.0 / REACH)).max(minor) * BLUR,
        }
    }
}

/// The matrix of these rows times (u, v, 1).
#[inline]
pub(crate) fn transformed(at: Vec2, [u, v]: &[[f32; 3]; 2]) -> Vec2 {
    Vec2::new(u[0] * at.x + u[1] * at.y + u[2], v[0] * at.x + v[1] * at.y + v[2])
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// The corners' parts of the point where a ray meets a triangle's plane, by distances from its edges in `f64`.
    fn weights(origin: Vec3, direction: DVec3, corners: [[f32; 3]; 3]) -> [f64; 3] {
        let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
        let (origin, normal) = (origin.as_dvec3(), (b - a).cross(c - a));
        let at = origin + direction * (normal.dot(a - origin) / normal.dot(direction));
        [(b, c, a), (c, a, b), (a, b, c)].map(|(p, q, opposite)| {
            let across = normal.cross(q - p);
            across.dot(at - p) / across.dot(opposite - p)
        })
    }

    #[test]
    fn footprints_are_the_differences_of_neighbouring_rays() {
        let triangle = [[0.1, 0.0, -0.3], [1.0, 0.2, 0.4], [-0.2, 0.9, 0.1]];
        let coordinates = [Vec2::new(0.2, 0.1), Vec2::new(3.0, 0.5), Vec2::new(-0.4, 2.5)];
        for scale in [1e-15f32, 1e-3, 1.0, 1e3, 1e15] {
            let corners = triangle.map(|corner| corner.map(|x| x * scale));
            for (x, y) in (-4..5).flat_map(|x| (-4..5).map(move |y| (x as f32 / 5.0, y as f32 / 5.0))) {
                let eye = Vec3::new(0.5 * x, 0.3, 4.0) * scale;
                let direction = Vec3::new(x, y, -4.0) * scale;
                let [a, b, c] = corners.map(|corner| Vec3::from(corner).as_dvec3());
                let normal = (b - a).cross(c - a);
                let distance = normal.dot(a - eye.as_dvec3()) / normal.dot(direction.as_dvec3());
                let ray = WideHit {
                    direction,
                    sides: [Vec3::new(0.1, 0.0, 0.01) * scale, Vec3::new(0.0, 0.08, -0.02) * scale],
                    corners: corners.map(Vec3::from),
                    normal: normal.normalize().as_vec3(),
                    distance_by_area: (distance / normal.length()) as f32,
                };
                let of_hit = weights(eye, ray.direction.as_dvec3(), corners).map(|weight| weight as f32);
                let footprint = ray.footprint(coordinates, Vec3::from(of_hit));
                let at = |side: f64, of: usize| {
                    let direction = ray.direction.as_dvec3() + ray.sides[of].as_dvec3() * side;
                    let weights = weights(eye, direction, corners);
                    let sum = |axis: usize| {
                        (0..3).map(|corner| weights[corner] * f64::from(coordinates[corner][axis])).sum::<f64>()
                    };
                    [sum(0), sum(1)]
                };
                for axis in 0..2 {
                    let (found, expected) = (f64::from(footprint.centre[axis]), at(0.0, 0)[axis]);
                    assert!((found - expected).abs() < 1e-5, "{scale} {x} {y}: {found}, not {expected}");
                    for side in 0..2 {
                        let expected = (at(1e-4, side)[axis] - at(-1e-4, side)[axis]) / 2e-4;
                        let found = f64::from(footprint.sides[side][axis]);
                        assert!((found - expected).abs() < 1e-5, "{scale} {x} {y}: {found}, not {expected}");
                    }
                }
            }
        }
    }

    #[test]
    fn squares_cover_a_footprint() {
        let size = Vec2::new(100.0, 50.0);
        let squares = |right: [f32; 2], up: [f32; 2]| {
            let sides = [right, up].map(|side| Vec2::from_array(side) / size);
            let squares = Footprint { centre: Vec2::splat(0.5), sides }.squares(size);
            let step = (squares.step * size).length();
            // The middle of the row is the footprint's.
            let middle = squares.first + squares.step * (squares.n as f32 - 1.0) * 0.5;
            assert!((middle - 0.5).length() < 1e-6, "{right:?} {up:?}");
            (squares.n, step, squares.width)
        };
        assert_eq!(squares([0.1, 0.0], [0.0, 0.2]), (1, 0.0, BLUR), "magnified");
        assert_eq!(squares([3.0, 0.0], [0.0, 3.0]), (1, 0.0, 3.0 * BLUR), "as wide as high");
        let (n, step, width) = squares([6.0, 6.0], [1.0, -1.0]);
        assert!(n == 4 && (step * 4.0 - 72.0f32.sqrt()).abs() < 1e-4 && (width - 2.0f32.sqrt() * BLUR).abs() < 0.01);
        let (n, _, width) = squares([1000.0, 0.0], [0.0, 1.0]);
        assert!(n == 4 && (width * 4.0 * REACH - 1000.0 * BLUR).abs() < 0.1, "blurred across");
        for odd in [f32::NAN, f32::INFINITY, f32::MAX, 1e-38] {
            let squares = Footprint { centre: Vec2::splat(odd), sides: [Vec2::splat(odd); 2] }.squares(size);
            assert!((1..=MOST_SQUARES).contains(&squares.n), "{odd}");
        }
    }
}
