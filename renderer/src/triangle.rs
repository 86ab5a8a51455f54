//! The one routine that decides whether a ray hits a triangle, and where.
//!
//! A ray hits a triangle when it passes all three edges on the same side, or through them.
//! Which side is the sign of a determinant, and it is told exactly: in `f64` where rounding cannot change it, else in
//! exact arithmetic. So a closed mesh has no leak, whatever the triangles' size and distance, and every kernel that
//! proposes candidates leads to the same picture.

use glam::{DVec3, Vec3};

use crate::{exact::ExactSum, ray::Ray};

/// Where a ray hits a triangle, as t in `f64`, or `None` if it does not within `t_min..=t_max`.
///
/// Triangles seen exactly edge-on, and those without area, are not hit.
/// t is that of Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection" (1997), in `f64`.
#[inline]
pub fn intersect(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    let origin = ray.origin.as_dvec3();
    let direction = ray.direction.as_dvec3();
    let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
    let from_origin = [a - origin, b - origin, c - origin];
    let edges = [b - a, c - b, a - c];

    // The determinant |direction, p, q| for the edge from p to q, seen from the origin, is direction·(p × (q − p)).
    // Eight roundings lie between the inputs and it, each of at most 2⁻⁵³ of the sum of absolute products.
    let largest = |vectors: [DVec3; 3]| vectors.into_iter().map(|v| v.abs().max_element()).fold(0.0, f64::max);
    let sum_of_products = 2.0 * direction.abs().element_sum() * largest(from_origin) * largest(edges);
    let error_bound = sum_of_products * (16.0 * f64::EPSILON);
    let sides = [0, 1, 2].map(|edge| direction.dot(from_origin[edge].cross(edges[edge])));
    if sides.iter().any(|&side| side > error_bound) && sides.iter().any(|&side| side < -error_bound) {
        return None;
    }
    if sides.iter().any(|side| side.abs() <= error_bound) && !hits_exactly(ray, corners) {
        return None;
    }

    let (edge_ab, edge_ac) = (edges[0], c - a);
    let p = direction.cross(edge_ac);
    let determinant = edge_ab.dot(p);
    let to_origin = origin - a;
    let t = if determinant == 0.0 {
        // A sliver too thin for `f64`: it lies along the ray, and any of its corners tells where.
        from_origin[0].dot(direction) / direction.length_squared()
    } else {
        edge_ac.dot(to_origin.cross(edge_ab)) / determinant
    };
    (f64::from(ray.t_min)..=f64::from(ray.t_max)).contains(&t).then_some(t)
}

/// Whether the sides of the three edges agree, in exact arithmetic.
#[cold]
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
    fn what_has_no_area_is_not_hit() {
        let p = [1.0, 1.0, 5.0];
        check(&ray_to(p), [p; 3], None);
        check(&ray_to(p), [[0.0, 0.0, 5.0], [2.0, 2.0, 5.0], p], None);
        // Seen edge-on.
        check(&ray_to([1.0, 0.0, 5.0]), [[0.0, 0.0, 4.0], [0.0, 0.0, 6.0], [4.0, 0.0, 5.0]], None);
        check(&Ray::new(Vec3::ZERO, Vec3::ZERO), TRIANGLE, None);
    }

    #[test]
    fn a_fan_around_a_vertex_far_from_the_origin_has_no_leak() {
        // Embree's test of watertightness stands at this place.
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
}
