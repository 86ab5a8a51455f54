//! Shadow rays by the convention of the ray tracers that Raywall is compared with.

use glam::Vec3;
use renderer::{
    intersect::{
        MOST_PACKETS, Packet, PacketScratch,
        ray::{Hit, Ray},
    },
    render::{blocks::SampleBlock, scene::Scene, secondary, tracer::set_camera_rays},
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
        let mut n_hits = 0;
        for (index, tile) in tiles.iter().enumerate() {
            n_hits += self.directions(tile, &hits[index], &mut directions[index]);
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
        let n_rays = rays.count();
        (n_rays, n_hits - n_rays + n_hidden)
    }

    /// Finds the directions from the light to the hits of a tile that face it, by lane; leaves the others `None`. Returns
    /// the number of hits.
    fn directions(&self, tile: &SampleBlock<'_>, hits: &[Hit; 64], directions: &mut [Option<Vec3>; 64]) -> usize {
        if hits.iter().all(|hit| hit.is_miss()) {
            return 0;
        }
        // Collect what is known of each hit. Neighbours often hit one triangle.
        let mut packet = Packet::NONE;
        set_camera_rays(&mut packet, self.rays, tile, 0);
        let (mut normals, mut t) = ([[0.0; 64]; 3], [0.0; 64]);
        let (mut triangle, mut normal) = (Hit::MISS.triangle, Vec3::ZERO);
        let mut n_hits = 0;
        for (lane, &sample_idx) in tile.sample_of_lane().iter().enumerate().take(tile.n_samples()) {
            let hit = hits[sample_idx];
            if hit.triangle != triangle {
                (triangle, normal) = (hit.triangle, self.normal(hit));
            }
            (t[lane], normals[0][lane], normals[1][lane], normals[2][lane]) = (hit.t, normal.x, normal.y, normal.z);
            n_hits += usize::from(!hit.is_miss());
        }

        // Find the way from the light, and which side of the surface it shines on: loops over arrays, which the compiler
        // turns into vector instructions.
        let (mut from_light, mut along_eye, mut along_light) = ([[0.0; 64]; 3], [0.0; 64], [0.0; 64]);
        for axis in 0..3 {
            let (eye, light) = (self.rays.eye[axis], self.light[axis]);
            for lane in 0..64 {
                let along = packet.directions[axis][lane];
                from_light[axis][lane] = eye + along * t[lane] - light;
                along_eye[lane] += normals[axis][lane] * along;
                along_light[lane] += normals[axis][lane] * from_light[axis][lane];
            }
        }
        let mut is_lit = [false; 64];
        for lane in 0..64 {
            is_lit[lane] = along_light[lane].abs() > 0.0 && (along_eye[lane] < 0.0) == (along_light[lane] < 0.0);
        }
        for lane in (0..64).filter(|&lane| is_lit[lane]) {
            directions[lane] = Some(Vec3::new(from_light[0][lane], from_light[1][lane], from_light[2][lane]));
        }
        n_hits
    }

    /// A vector across the triangle that is hit; zero for a miss.
    fn normal(&self, hit: Hit) -> Vec3 {
        if hit.is_miss() {
            return Vec3::ZERO;
        }
        let [a, b, c] = self.scene.mesh().corners(hit.triangle).map(Vec3::from_array);
        (b - a).cross(c - a)
    }
}
