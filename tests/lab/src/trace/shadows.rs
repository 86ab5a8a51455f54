//! Shadow rays by the convention of the ray tracers that Raywall is compared with.

use glam::Vec3;
use renderer::{
    intersect::{
        MOST_PACKETS, PacketScratch,
        ray::{Hit, Ray},
    },
    render::{blocks::SampleBlock, scene::Scene, secondary},
};
use shared::camera::CameraRays;

use super::frame::Kernel;

/// Casts the shadows of a point light at `light`, in model space.
pub(super) struct ShadowCaster<'a> {
    pub(super) scene: &'a Scene,
    pub(super) rays: &'a CameraRays,
    pub(super) light: Vec3,
    pub(super) kernel: Kernel,
}

/// Others trace from the hit and ignore the first 1e-4 of the way to the light. Here rays start at the light, so that those
/// of a tile have a common origin.
const T_MAX: f32 = 1.0 - 1e-4;

impl ShadowCaster<'_> {
    /// Casts a ray for each hit of neighbouring tiles that faces the light. Returns the number of rays, and of hits that
    /// face away from the light or are occluded from it.
    pub(super) fn cast(
        &self,
        tiles: &[SampleBlock<'_>],
        hits: &[[Hit; 64]],
        scratch: &mut PacketScratch,
    ) -> (usize, usize) {
        let mut directions = [[None; 64]; MOST_PACKETS];
        let mut n_dark = 0;
        for (index, tile) in tiles.iter().enumerate() {
            // Lanes beyond the samples repeat the last sample.
            for (direction, &sample_idx) in
                directions[index].iter_mut().zip(&tile.sample_of_lane()).take(tile.n_samples())
            {
                let hit = hits[index][sample_idx];
                if hit.is_miss() {
                    continue;
                }
                let (i, j) = tile.sample(sample_idx);
                *direction = self.ray_to(self.rays.direction(i, j), hit);
                n_dark += usize::from(direction.is_none());
            }
        }
        let directions = &directions[..tiles.len()];
        let rays = directions.as_flattened().iter().flatten();
        let grid = &self.scene.grid;
        let n_hidden = match self.kernel {
            Kernel::Packet => {
                let occluded_lanes = secondary::occluded_lanes(grid, None, self.light, directions, T_MAX, scratch);
                occluded_lanes.iter().map(|occluded_lanes| occluded_lanes.count_ones() as usize).sum()
            }
            Kernel::Single => rays
                .clone()
                .filter(|&&direction| grid.occluded(&Ray { t_max: T_MAX, ..Ray::new(self.light, direction) }))
                .count(),
        };
        (rays.count(), n_dark + n_hidden)
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
