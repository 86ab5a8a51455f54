//! The reference for all methods, in `f64` and by an algorithm of its own.
//!
//! After Badouel, "An Efficient Ray-Polygon Intersection" (1990): the intersection of ray and plane, then a test in two
//! dimensions whether that point lies inside. It bounds its own rounding; rays that it cannot decide are not compared.

use glam::{DVec3, Vec3};
use renderer::intersect::ray::Ray;

/// The reference's result for a ray and a triangle, or for a ray and all of its candidates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Verdict {
    Miss,
    Hit(f64),
    /// The ray passes too close to an edge, or is too nearly parallel, for `f64`.
    Unknown,
}

/// Bound on the relative error of a few operations.
const ROUNDING: f64 = 32.0 * f64::EPSILON;

pub(crate) fn verdict(ray: &Ray, corners: &[[f32; 3]; 3]) -> Verdict {
    let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
    let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
    let normal = (b - a).cross(c - a);
    let facing = normal.dot(direction);
    let to_plane = a - origin;
    if normal == DVec3::ZERO {
        return Verdict::Miss;
    }
    if facing.abs() <= ROUNDING * normal.length() * direction.length() {
        return Verdict::Unknown;
    }
    let t = normal.dot(to_plane) / facing;
    if t < 0.0 {
        return Verdict::Miss;
    }
    let point = direction * t - to_plane;
    // The error grows as the ray becomes parallel to the plane.
    let slant = normal.length() * direction.length() / facing.abs();
    let error = ROUNDING * (to_plane.length() + direction.length() * t) * slant;
    // Project along the normal's largest axis.
    let axis = normal.abs().max_position();
    let (x, y) = ((axis + 1) % 3, (axis + 2) % 3);
    let corners = [DVec3::ZERO, b - a, c - a];
    let (mut inside, mut unknown, mut sign) = (true, false, 0.0);
    for edge in 0..3 {
        let (from, to) = (corners[edge], corners[(edge + 1) % 3]);
        let along = to - from;
        let side = along[x] * (point[y] - from[y]) - along[y] * (point[x] - from[x]);
        if side.abs() <= (along[x].abs() + along[y].abs()) * error {
            unknown = true;
        } else if sign == 0.0 {
            sign = side.signum();
        } else {
            inside &= sign == side.signum();
        }
    }
    match (inside, unknown) {
        (false, _) => Verdict::Miss,
        (true, true) => Verdict::Unknown,
        (true, false) => Verdict::Hit(t),
    }
}

pub(crate) fn truth(ray: &Ray, candidates: impl Iterator<Item = [[f32; 3]; 3]>) -> Verdict {
    let mut nearest = f64::INFINITY;
    for corners in candidates {
        match verdict(ray, &corners) {
            Verdict::Miss => {}
            // It may lie behind the nearest hit, but that is rare.
            Verdict::Unknown => return Verdict::Unknown,
            Verdict::Hit(t) => nearest = nearest.min(t),
        }
    }
    if nearest < f64::INFINITY { Verdict::Hit(nearest) } else { Verdict::Miss }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CORNERS: [[f32; 3]; 3] = [[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 4.0, 5.0]];

    fn towards(x: f32, y: f32) -> Verdict {
        verdict(&Ray::new(Vec3::ZERO, Vec3::new(x, y, 5.0)), &CORNERS)
    }

    #[test]
    fn inside_outside_and_undecided() {
        assert_eq!(towards(1.0, 1.0), Verdict::Hit(1.0));
        assert_eq!(towards(3.0, 3.0), Verdict::Miss);
        assert_eq!(towards(-1.0, 1.0), Verdict::Miss);
        assert_eq!(towards(1.0, 0.0), Verdict::Unknown, "on an edge");
        assert_eq!(towards(4.0, 0.0), Verdict::Unknown, "on a corner");
        assert_eq!(towards(1.0, 1e-6), Verdict::Hit(1.0), "beside an edge");
        assert_eq!(towards(1.0, -1e-6), Verdict::Miss);
        let behind = Ray::new(Vec3::Z * 9.0, Vec3::new(0.1, 0.1, 1.0));
        assert_eq!(verdict(&behind, &CORNERS), Verdict::Miss);
        let edge_on = Ray::new(Vec3::new(-1.0, 1.0, 5.0), Vec3::X);
        assert_eq!(verdict(&edge_on, &CORNERS), Verdict::Unknown);
        assert_eq!(verdict(&edge_on, &[CORNERS[0]; 3]), Verdict::Miss);
    }

    #[test]
    fn the_nearest_counts() {
        let nearer = CORNERS.map(|[x, y, _]| [x, y, 2.5]);
        let ray = Ray::new(Vec3::ZERO, Vec3::new(1.0, 1.0, 5.0));
        assert_eq!(truth(&ray, [CORNERS, nearer].into_iter()), Verdict::Hit(0.5));
        assert_eq!(truth(&ray, [].into_iter()), Verdict::Miss);
    }
}
