//! The truth that methods are held against, in `f64` and by another way than any of them.
//!
//! After Badouel, "An Efficient Ray-Polygon Intersection" (1990): where the ray meets the plane, then whether that point
//! lies inside, in two dimensions. With bounds on its own rounding: what it cannot tell is left out of the comparison.

use glam::{DVec3, Vec3};
use renderer::intersect::ray::Ray;

/// What the reference says of a ray and a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Verdict {
    Miss,
    Hit(f64),
    /// The ray passes an edge, or lies in the plane, more closely than `f64` can tell.
    Unknown,
}

/// What the reference says of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Truth {
    Miss,
    Nearest(f64),
    Unknown,
}

/// A bound on the relative error of a handful of operations.
const ROUNDING: f64 = 32.0 * f64::EPSILON;

/// One ray, one triangle.
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
    // The more the ray grazes, the farther the point can be off.
    let slant = normal.length() * direction.length() / facing.abs();
    let error = ROUNDING * (to_plane.length() + direction.length() * t) * slant;
    // Seen along the axis in which the triangle is largest.
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

/// One ray, and all triangles that it may hit.
pub(crate) fn truth(ray: &Ray, candidates: impl Iterator<Item = [[f32; 3]; 3]>) -> Truth {
    let mut truth = Truth::Miss;
    for corners in candidates {
        match verdict(ray, &corners) {
            Verdict::Miss => {}
            // It may be behind the nearest, but few are.
            Verdict::Unknown => return Truth::Unknown,
            Verdict::Hit(t) => {
                if !matches!(truth, Truth::Nearest(nearest) if nearest <= t) {
                    truth = Truth::Nearest(t);
                }
            }
        }
    }
    truth
}

#[cfg(test)]
mod tests {
    use super::*;

    const CORNERS: [[f32; 3]; 3] = [[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [0.0, 4.0, 5.0]];

    fn towards(x: f32, y: f32) -> Verdict {
        verdict(&Ray::new(Vec3::ZERO, Vec3::new(x, y, 5.0)), &CORNERS)
    }

    #[test]
    fn inside_outside_and_what_cannot_be_told() {
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
        assert_eq!(truth(&ray, [CORNERS, nearer].into_iter()), Truth::Nearest(0.5));
        assert_eq!(truth(&ray, [].into_iter()), Truth::Miss);
    }
}
