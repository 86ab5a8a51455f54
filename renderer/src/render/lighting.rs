//! From the hits of a block of samples to their light, in any shading and lighting mode.

use glam::Vec3;
use shared::{
    appearance::ClipPlane,
    protocol::{FrameSpec, ShadingMode},
};

use crate::{
    grid::Grid,
    intersect::{
        MOST_PACKETS, PacketScratch, RayCost, clip,
        ray::{Hit, Ray},
    },
    render::{
        blocks::SampleBlock,
        sampling::sample_point,
        secondary::SecondaryRays,
        shade::{self, Shader},
    },
    texture::{footprint::SampleRays, materials::PointMaterial},
};

/// Lights the hits of one frame.
pub struct Lighting<'a> {
    shading: ShadingMode,
    shader: Shader<'a>,
    secondary: SecondaryRays<'a>,
    eye: Vec3,
    /// Change of a ray's direction across the width and the height of its part of a pixel, in model space.
    sample_sides: [Vec3; 2],
}

impl<'a> Lighting<'a> {
    /// Prepares for one frame of a scene that a plane may cut open.
    pub fn new(grid: &'a Grid, spec: &FrameSpec, clip: Option<ClipPlane>) -> Self {
        let secondary = SecondaryRays::new(grid, spec, clip);
        let rays = spec.camera.rays(spec.size);
        // All samples of a pixel share it.
        let side = 1.0 / (spec.samples.count as f32).sqrt();
        let sample_sides = [rays.du * side, rays.dv * side];
        let shader = Shader::new(grid.mesh(), spec, clip);
        Self { shading: spec.view, shader, secondary, eye: rays.eye, sample_sides }
    }

    /// Finds the materials at up to 64 hits; `None` for misses and caps. All are `None`, and left so, in meshes without
    /// materials.
    fn find_materials(&self, directions: &[Vec3], hits: &[Hit], materials: &mut [Option<PointMaterial>; 64]) {
        let grid = self.secondary.grid;
        if self.shading == ShadingMode::Shaded && grid.mesh().has_materials() {
            let rays = SampleRays { eye: self.eye, directions, sides: self.sample_sides };
            grid.mesh().find_materials(grid.instructions, rays, hits, materials);
        }
    }

    /// The linear light of neighbouring blocks: of sample number `sample` of their pixels (i, j), whose rays follow
    /// `directions` to `hits`. Entries beyond a block's samples are undefined.
    pub fn light_group(
        &self,
        blocks: &[SampleBlock<'_>],
        sample: u32,
        directions: &[[Vec3; 64]],
        hits: &[[Hit; 64]],
        scratch: &mut PacketScratch,
    ) -> [[Vec3; 64]; MOST_PACKETS] {
        let mut lights = [[Vec3::ZERO; 64]; MOST_PACKETS];
        if self.shading == ShadingMode::Cost {
            let SecondaryRays { grid, clip, eye, .. } = &self.secondary;
            for (index, block) in blocks.iter().enumerate() {
                for (light, &direction) in lights[index].iter_mut().zip(&directions[index]).take(block.n_samples()) {
                    let ray = clip::clip_ray(clip.as_ref(), Ray::new(eye.as_vec3(), direction));
                    *light = shade::cost_color(ray.map_or(RayCost::default(), |ray| grid.cost(&ray)));
                }
            }
            return lights;
        }
        let visibility = self.secondary.visibility(blocks, sample, directions, hits, scratch);
        // Written again for each block: copies of either took up to 5 % of a frame's time.
        let (mut surfaces, mut materials) = ([None; 64], [None; 64]);
        for (index, block) in blocks.iter().enumerate() {
            let n_samples = block.n_samples();
            let (directions, hits) = (&directions[index][..n_samples], &hits[index][..n_samples]);
            if !hits.iter().all(|hit| hit.is_miss()) {
                self.shader.find_surfaces(self.secondary.grid.instructions, directions, hits, &mut surfaces);
                self.find_materials(directions, hits, &mut materials);
            }
            for (sample_idx, (i, j)) in block.samples().enumerate() {
                let (_, y) = sample_point(i, j, sample);
                lights[index][sample_idx] = self.shader.light(
                    directions[sample_idx],
                    hits[sample_idx],
                    surfaces[sample_idx].as_ref(),
                    materials[sample_idx].as_ref(),
                    y,
                    &visibility[index][sample_idx],
                );
            }
        }
        lights
    }
}
