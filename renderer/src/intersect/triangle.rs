//! Decides whether a ray hits a triangle, and where: the one routine on which all kernels agree.
//!
//! A ray hits a triangle when it passes all three edges on the same side, or through them. The side is the sign of a
//! determinant, and it is found exactly: in `f64` where rounding cannot change it, else in exact arithmetic. So a
//! closed mesh has no leak at any size and distance, and every kernel gives the same hits: a side that a kernel proves
//! by its own margins is the side found here.

use glam::Vec3;

use crate::{
    intersect::{exact::ExactSum, ray::Ray},
    simd::{Real, Simd},
};

/// The t at which a ray meets the plane of a triangle that it hits, or `None` if it hits none within `t_min..=t_max`.
///
/// Triangles seen exactly edge-on, and those without area, are not hit.
#[inline]
pub fn intersect(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    let to_f64 = |vector: [f32; 3]| vector.map(f64::from);
    let planes = EdgePlanes::new(to_f64(ray.origin.to_array()), corners.map(to_f64));
    let decision = planes.decide(to_f64(ray.direction.to_array()));
    if decision.certain_miss == 1 {
        return None;
    }
    finish(ray, (decision.uncertain == 0).then_some(decision.t), || *corners)
}

/// The t of a hit within the ray's interval, from a certain t, or decided exactly for the corners.
#[inline(always)]
pub(super) fn finish(ray: &Ray, certain_t: Option<f64>, corners: impl FnOnce() -> [[f32; 3]; 3]) -> Option<f64> {
    let t = match certain_t {
        Some(t) => t,
        None => intersect_exactly(ray, &corners())?,
    };
    (f64::from(ray.t_min)..=f64::from(ray.t_max)).contains(&t).then_some(t)
}

/// Decides on pairs of a ray and a triangle, one a lane, in the lanes from `first` on: the rays' origins and directions by
/// axis, and the triangles' corners by corner and axis.
#[inline(always)]
pub(super) fn decide_lanes<S: Simd>(
    origin: &[S; 3],
    direction: &[S; 3],
    corners: &[[S; 3]; 3],
    first: usize,
) -> Decision<S::Double> {
    EdgePlanes::new(widen(origin, first), widen_corners(corners, first)).decide(widen(direction, first))
}

/// Points in the lanes from `first` on.
#[inline(always)]
fn widen<S: Simd>([x, y, z]: &[S; 3], first: usize) -> Vector<S::Double> {
    [x.widen(first), y.widen(first), z.widen(first)]
}

/// The corners of triangles in the lanes from `first` on.
#[inline(always)]
pub(super) fn widen_corners<S: Simd>([a, b, c]: &[[S; 3]; 3], first: usize) -> [Vector<S::Double>; 3] {
    [widen(a, first), widen(b, first), widen(c, first)]
}

/// The decision in `f64` on pairs of a ray and a triangle, with a bit for each pair in the masks.
pub(super) struct Decision<R> {
    /// The ray certainly misses the triangle.
    pub(super) certain_miss: u32,
    /// [`intersect_exactly`] must decide. Undefined for certain misses.
    pub(super) uncertain: u32,
    /// t of the hit; undefined where uncertain.
    pub(super) t: R,
}

/// Three coordinates, each in one or several lanes.
pub(super) type Vector<R> = [R; 3];

/// A triangle prepared for rays from a common origin; with several lanes, one triangle per lane.
///
/// No closures: they would not be compiled for the caller's instruction set.
#[derive(Clone, Copy)]
pub(super) struct EdgePlanes<R> {
    /// Normals of the planes through the origin and an edge from p to q: p × (q − p), relative to the origin.
    sides: [Vector<R>; 3],
    plane: Plane<R>,
    /// Bound of a determinant's rounding error, for a direction whose absolute components add up to one.
    error_bound: R,
}

impl<R: Real> EdgePlanes<R> {
    #[inline(always)]
    pub(super) fn new(origin: Vector<R>, [a, b, c]: [Vector<R>; 3]) -> Self {
        let (a_from_origin, b_from_origin, c_from_origin) = (sub(a, origin), sub(b, origin), sub(c, origin));
        let (edge_ab, edge_bc, edge_ca) = (sub(b, a), sub(c, b), sub(a, c));

        // Eight roundings lie between the inputs and a determinant, each at most 2⁻⁵³ of the sum of absolute products.
        let from_origin = largest(a_from_origin).max(largest(b_from_origin)).max(largest(c_from_origin));
        let edges = largest(edge_ab).max(largest(edge_bc)).max(largest(edge_ca));
        Self {
            sides: [cross(a_from_origin, edge_ab), cross(b_from_origin, edge_bc), cross(c_from_origin, edge_ca)],
            plane: Plane::new(origin, [a, b, c]),
            error_bound: from_origin.mul(edges).mul(R::splat(32.0 * f64::EPSILON)),
        }
    }

    /// Decides by the sides of the edges: the determinant |direction, p, q| for the edge from p to q, relative to the
    /// origin, is direction·(p × (q − p)), and its sign is the side on which the ray passes.
    #[inline(always)]
    pub(super) fn decide(&self, direction: Vector<R>) -> Decision<R> {
        // Scale the error bound to the direction.
        let sum = direction[0].abs().add(direction[1].abs()).add(direction[2].abs());
        let error_bound = sum.mul(self.error_bound);
        let minus_bound = R::splat(0.0).sub(error_bound);

        // Find the sides that are certain.
        let [ab, bc, ca] =
            [dot(direction, self.sides[0]), dot(direction, self.sides[1]), dot(direction, self.sides[2])];
        let left = [error_bound.lt(ab), error_bound.lt(bc), error_bound.lt(ca)];
        let right = [ab.lt(minus_bound), bc.lt(minus_bound), ca.lt(minus_bound)];

        // Decided: all sides are certain, and the ray is not parallel to the plane.
        let determinant = dot(direction, self.plane.normal);
        let decided =
            (left[0] | right[0]) & (left[1] | right[1]) & (left[2] | right[2]) & R::splat(0.0).lt(determinant.abs());
        Decision {
            certain_miss: (left[0] | left[1] | left[2]) & (right[0] | right[1] | right[2]),
            uncertain: !decided & ((1 << R::LANES) - 1),
            t: self.plane.offset.div(determinant),
        }
    }
}

/// A triangle's plane, relative to the rays' origin: all points x with normal·x = offset.
#[derive(Clone, Copy)]
pub(super) struct Plane<R> {
    /// (b − a) × (c − a).
    normal: Vector<R>,
    offset: R,
}

impl<R: Real> Plane<R> {
    #[inline(always)]
    pub(super) fn new(origin: Vector<R>, [a, b, c]: [Vector<R>; 3]) -> Self {
        let normal = cross(sub(b, a), sub(c, a));
        Self { normal, offset: dot(normal, sub(a, origin)) }
    }

    /// The t at which a ray meets the plane, with the bits of [`EdgePlanes::decide`].
    #[inline(always)]
    pub(super) fn t(&self, direction: Vector<R>) -> R {
        self.offset.div(dot(direction, self.normal))
    }
}

impl Plane<f64> {
    #[inline(always)]
    pub(super) fn splat<R: Real>(&self) -> Plane<R> {
        let [x, y, z] = self.normal;
        Plane { normal: [R::splat(x), R::splat(y), R::splat(z)], offset: R::splat(self.offset) }
    }
}

#[inline(always)]
fn sub<R: Real>(a: Vector<R>, b: Vector<R>) -> Vector<R> {
    [a[0].sub(b[0]), a[1].sub(b[1]), a[2].sub(b[2])]
}

#[inline(always)]
fn dot<R: Real>(a: Vector<R>, b: Vector<R>) -> R {
    a[0].mul(b[0]).add(a[1].mul(b[1])).add(a[2].mul(b[2]))
}

#[inline(always)]
fn cross<R: Real>(a: Vector<R>, b: Vector<R>) -> Vector<R> {
    [a[1].mul(b[2]).sub(b[1].mul(a[2])), a[2].mul(b[0]).sub(b[2].mul(a[0])), a[0].mul(b[1]).sub(b[0].mul(a[1]))]
}

#[inline(always)]
fn largest<R: Real>(vector: Vector<R>) -> R {
    vector[0].abs().max(vector[1].abs()).max(vector[2].abs())
}

/// The t of a hit, decided in exact arithmetic, or `None` for a miss. The ray's interval is ignored.
#[cold]
pub(super) fn intersect_exactly(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    if !hits_exactly(ray, corners) {
        return None;
    }
    let to_f64 = |vector: [f32; 3]| vector.map(f64::from);
    let (origin, direction) = (to_f64(ray.origin.to_array()), to_f64(ray.direction.to_array()));
    let plane = Plane::new(origin, corners.map(to_f64));
    let determinant = dot(direction, plane.normal);
    Some(if determinant == 0.0 {
        // A sliver too thin for `f64` lies along the ray: take the t of any of its corners.
        dot(sub(to_f64(corners[0]), origin), direction) / dot(direction, direction)
    } else {
        plane.offset / determinant
    })
}

/// The parts of a triangle's corners in the point where a ray from `origin` hits it: each from 0 to 1, with the sum 1.
///
/// They are the areas of the triangles that the point makes with the opposite edges, by Cramer's rule. Where none has a
/// size, as in slivers seen along the ray, the parts are equal. Nothing branches, so that a loop becomes vector instructions.
#[inline(always)]
pub fn corner_weights(origin: Vec3, direction: Vec3, [a, b, c]: &[[f32; 3]; 3]) -> [f64; 3] {
    let (origin, direction) = (origin.as_dvec3(), direction.as_dvec3());
    let (a, b, c) = (Vec3::from(*a).as_dvec3(), Vec3::from(*b).as_dvec3(), Vec3::from(*c).as_dvec3());
    let (ab, ac) = (b - a, c - a);
    let area = ab.cross(ac).dot(direction);
    let moment = (a - origin).cross(direction);
    let sign = 1.0f64.copysign(area);
    let (area_b, area_c) = (ac.dot(moment) * sign, -ab.dot(moment) * sign);
    // Rounding may have moved the ray beyond an edge.
    let (area_a, area_b, area_c) = ((area.abs() - area_b - area_c).max(0.0), area_b.max(0.0), area_c.max(0.0));
    let inverse = 1.0 / (area_a + area_b + area_c);
    let has_size = inverse.is_finite();
    let part = |area: f64| if has_size { area * inverse } else { 1.0 / 3.0 };
    [part(area_a), part(area_b), part(area_c)]
}

/// Whether the sides of the three edges agree, in exact arithmetic.
fn hits_exactly(ray: &Ray, &[a, b, c]: &[[f32; 3]; 3]) -> bool {
    let sides = [(a, b), (b, c), (c, a)].map(|(p, q)| side_exactly(ray, p, q));
    let any = |sign: f64| sides.contains(&sign);
    any(1.0) != any(-1.0)
}

/// The sign of direction·(p×q + q×o + o×p), which is |direction, p − o, q − o| free of rounded differences.
fn side_exactly(ray: &Ray, p: [f32; 3], q: [f32; 3]) -> f64 {
    let origin = ray.origin.to_array();
    let mut sum = ExactSum::default();
    for (from, to) in [(p, q), (q, origin), (origin, p)] {
        for (axis, along) in ray.direction.to_array().into_iter().enumerate() {
            let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
            sum.add_product(from[next], to[last], along);
            sum.add_product(-from[last], to[next], along);
        }
    }
    sum.signum()
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    const TRIANGLE: [[f32; 3]; 3] = [[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 4.0, 5.0]];

    fn ray_to(target: [f32; 3]) -> Ray {
        Ray::new(Vec3::ZERO, Vec3::from_array(target))
    }

    fn check(ray: &Ray, corners: [[f32; 3]; 3], expected: Option<f64>) {
        let [a, b, c] = corners;
        for corners in [[a, b, c], [b, c, a], [c, a, b], [a, c, b], [c, b, a], [b, a, c]] {
            assert_eq!(intersect(ray, &corners), expected, "{ray:?} {corners:?}");
        }
    }

    #[test]
    fn t_is_in_units_of_the_direction() {
        check(&ray_to([1.0, 1.0, 5.0]), TRIANGLE, Some(1.0));
        check(&ray_to([2.0, 2.0, 10.0]), TRIANGLE, Some(0.5));
        check(&ray_to([-1.0, -1.0, -5.0]), TRIANGLE, None);
        check(&ray_to([3.0, 3.0, 5.0]), TRIANGLE, None);
    }

    #[test]
    fn edges_and_corners_belong_to_the_triangle() {
        for target in [[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 4.0, 5.0], [2.0, 2.0, 5.0], [0.0, 1.0, 5.0]] {
            check(&ray_to(target), TRIANGLE, Some(1.0));
        }
    }

    #[test]
    fn the_range_of_t_is_closed() {
        for (t_min, t_max, hit) in [(0.0, 1.0, true), (1.0, 2.0, true), (1.0001, 2.0, false), (0.0, 0.9999, false)] {
            let ray = Ray { t_min, t_max, ..ray_to([1.0, 1.0, 5.0]) };
            check(&ray, TRIANGLE, hit.then_some(1.0));
        }
    }

    #[test]
    fn triangles_without_area_are_not_hit() {
        let p = [1.0, 1.0, 5.0];
        check(&ray_to(p), [p; 3], None);
        check(&ray_to(p), [[0.0, 0.0, 5.0], [2.0, 2.0, 5.0], p], None);
        // Seen edge-on.
        check(&ray_to([1.0, 0.0, 5.0]), [[0.0, 0.0, 4.0], [0.0, 0.0, 6.0], [4.0, 0.0, 5.0]], None);
        check(&Ray::new(Vec3::ZERO, Vec3::ZERO), TRIANGLE, None);
    }

    #[test]
    fn a_fan_around_a_vertex_far_from_the_origin_has_no_leak() {
        // The position of Embree's watertightness test.
        let centre = Vec3::new(148_376.0, 1234.0, -223_423.0);
        let rim: Vec<Vec3> = (0..7)
            .map(|k| {
                let angle = k as f32 * 0.9;
                centre + Vec3::new(angle.cos() * 2.0, angle.sin() * 2.0, 0.3 * angle)
            })
            .collect();
        let origin = Vec3::new(1.0e5, -3.0, 7.0);
        for spoke in &rim {
            for step in 0..200 {
                let target = centre + (*spoke - centre) * (step as f32 / 400.0);
                let ray = Ray::new(origin, target - origin);
                let hit = (0..7).any(|k| {
                    let corners = [centre, rim[k], rim[(k + 1) % 7]].map(|v| v.to_array());
                    intersect(&ray, &corners).is_some()
                });
                assert!(hit, "leak beside {target}");
            }
        }
    }

    #[test]
    fn weights_of_corners_are_areas() {
        // Deterministic points, triangles and directions of many sizes.
        let mut bits = 1u32;
        let mut random = || {
            bits = bits.wrapping_mul(0x915f_77f5).wrapping_add(0x9e37_79b9);
            (bits >> 8) as f32 / 8_388_608.0 - 1.0
        };
        for scale in [1e-15, 1e-3, 1.0, 1e6, 1e15] {
            for _ in 0..200 {
                let mut point = || Vec3::new(random(), random(), random()) * scale;
                let (origin, corners) = (point() + Vec3::Z * (9.0 * scale), [point(), point(), point()]);
                let parts = point().abs() / scale;
                let target = corners[0] * parts.x + corners[1] * parts.y + corners[2] * parts.z;
                let target = target / parts.element_sum();
                let direction = target - origin;
                let [a, b, c] = corners.map(Vec3::as_dvec3);
                // The point of the plane, and the areas of the triangles that it makes with the edges.
                let (origin_f64, along) = (origin.as_dvec3(), direction.as_dvec3());
                let normal = (b - a).cross(c - a);
                if normal.length() < 1e-2 * f64::from(scale).powi(2)
                    || normal.normalize().dot(along.normalize()).abs() < 0.1
                {
                    continue;
                }
                let point = origin_f64 + along * (normal.dot(a - origin_f64) / normal.dot(along));
                let area = |p: glam::DVec3, q: glam::DVec3| (p - point).cross(q - point).length();
                let areas = [area(b, c), area(c, a), area(a, b)];
                let weights = corner_weights(origin, direction, &corners.map(|corner| corner.to_array()));
                for (weight, area) in weights.into_iter().zip(areas) {
                    let expected = area / areas.iter().sum::<f64>();
                    assert!((weight - expected).abs() < 1e-5, "{scale}: {weights:?} {areas:?}");
                }
            }
        }
    }

    #[test]
    fn weights_of_any_triangle_are_fractions_that_add_up_to_one() {
        let (p, q, r) = ([0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [2.0, 1e-30, 5.0]);
        for corners in
            [[p; 3], [p, q, r], [p, q, q], [[f32::NAN; 3]; 3], [[1e18, 0.0, 0.0], p, [0.0, 1e18, 1.0]], TRIANGLE]
        {
            for target in [[1.0, 0.0, 5.0], [-9.0, 3.0, 5.0], [1e-38; 3], [0.0; 3], [1e18, 1.0, 1.0], [f32::NAN; 3]] {
                let weights = corner_weights(Vec3::ZERO, Vec3::from_array(target), &corners);
                assert!(
                    weights.iter().all(|weight| (0.0..=1.0).contains(weight)),
                    "{corners:?} {target:?}: {weights:?}"
                );
                assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-15, "{corners:?} {target:?}: {weights:?}");
            }
        }
    }
}
