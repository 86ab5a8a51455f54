//! Where secondary rays start: hits, lifted off their surfaces.

use glam::{DVec3, Vec3};
use shared::appearance::ClipPlane;

use crate::{grid::traced::TracedMesh, intersect::ray::Hit};

/// Lifts hits off the surfaces of a scene that a plane may cut open.
pub(super) struct Lift<'a> {
    mesh: &'a TracedMesh,
    clip: Option<ClipPlane>,
    /// How far points are lifted off their surfaces, in world units.
    pub(super) ray_offset: f64,
}

/// The start of secondary rays.
pub(super) struct LiftedPoint {
    /// The hit point, lifted off the surface; model space.
    pub(super) point: DVec3,
    /// Unit length, on the side of the ray's origin.
    pub(super) normal: DVec3,
}

impl<'a> Lift<'a> {
    /// For rays between surfaces, and to another point.
    pub(super) fn new(mesh: &'a TracedMesh, clip: Option<ClipPlane>, other: Vec3) -> Self {
        let [min, max] = mesh.bounds().corners();
        // No coordinate exceeds this, and no difference its double. Rounding a point or a direction to single precision
        // moves it by at most √3·2⁻²⁴ of that.
        let max_coordinate = min.abs().max(max.abs()).max(other.as_dvec3().abs()).max_element();
        Self { mesh, clip, ray_offset: max_coordinate * (8.0 * f64::from(f32::EPSILON)) }
    }

    /// The start of rays from the hit of a ray; `None` for a miss, and for slivers too thin to have a normal.
    pub(super) fn point(&self, origin: DVec3, direction: Vec3, hit: Hit) -> Option<LiftedPoint> {
        if hit.is_miss() {
            return None;
        }
        let (a, normal) = match self.clip {
            Some(ClipPlane { normal, offset }) if hit.is_cap() => (normal * offset, normal),
            _ => (Vec3::from_array(self.mesh.corners(hit.triangle)[0]).as_dvec3(), self.mesh.normal(hit.triangle)),
        };
        let direction = direction.as_dvec3();
        let length = normal.length();
        let normal = if normal.dot(direction) > 0.0 { -normal } else { normal } * (1.0 / length);
        // Recompute t from the triangle's plane: single precision is too coarse for an eye far away.
        let t = normal.dot(a - origin) / normal.dot(direction);
        let point = origin + direction * t + normal * self.ray_offset;
        (length > 0.0 && point.is_finite() && normal.is_finite()).then_some(LiftedPoint { point, normal })
    }
}
