//! Shadow rays by the convention of the peers that Raywall is measured against.

use glam::Vec3;
use shared::camera::CameraRays;

use super::frame::Kernel;
use crate::{
    grid::PacketScratch,
    ray::{Hit, Ray},
    secondary,
    tracer::{Scene, lane_places},
};

/// What a point light in world space needs to find its shadows.
pub(super) struct ShadowCaster<'a> {
    pub(super) scene: &'a Scene,
    pub(super) rays: &'a CameraRays,
    pub(super) light: Vec3,
    pub(super) kernel: Kernel,
}

/// Peers begin at the hit and count what lies beyond 1e-4 of the way to the light; here rays come from the light, so that
/// those of a tile have a common origin.
const T_MAX: f32 = 1.0 - 1e-4;

impl ShadowCaster<'_> {
    /// Casts a ray for each hit of a tile that faces the light. Returns how many rays that were, and how many hits the
    /// light does not reach, because they face away from it or something is in between.
    pub(super) fn cast(&self, tile: &[(u32, u32)], hits: &[Hit], scratch: &mut PacketScratch) -> (usize, usize) {
        let mut directions = [None; 64];
        let mut n_dark = 0;
        // Lanes beyond the samples repeat the last.
        for (direction, &place) in directions.iter_mut().zip(&lane_places(tile)).take(tile.len()) {
            let hit = hits[place];
            if hit.is_miss() {
                continue;
            }
            *direction = self.ray_to(self.rays.direction(tile[place].0, tile[place].1), hit);
            n_dark += usize::from(direction.is_none());
        }
        let grid = self.scene.grid();
        let n_hidden = match self.kernel {
            Kernel::Packet => {
                secondary::hidden(grid, None, self.light, &directions, T_MAX, scratch).count_ones() as usize
            }
            Kernel::Single => directions
                .iter()
                .flatten()
                .filter(|&&direction| grid.occluded(&Ray { t_max: T_MAX, ..Ray::new(self.light, direction) }))
                .count(),
        };
        (directions.iter().flatten().count(), n_dark + n_hidden)
    }

    /// The direction from the light to a hit; `None` if the surface faces away.
    fn ray_to(&self, direction: Vec3, hit: Hit) -> Option<Vec3> {
        let from_light = self.rays.eye + direction * hit.t - self.light;
        let [a, b, c] = self.scene.mesh().corners(hit.triangle).map(Vec3::from_array);
        let normal = (b - a).cross(c - a);
        let faces_eye = normal.dot(direction) < 0.0;
        let cosine = -normal.dot(from_light);
        (if faces_eye { cosine > 0.0 } else { cosine < 0.0 }).then_some(from_light)
    }
}
