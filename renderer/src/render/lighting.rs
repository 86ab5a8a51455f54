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
};

/// Lights the hits of one frame.
pub struct Lighting<'a> {
    shading: ShadingMode,
    shader: Shader<'a>,
    secondary: SecondaryRays<'a>,
}

impl<'a> Lighting<'a> {
    /// Prepares for one frame of a scene that a plane may cut open.
    pub fn new(grid: &'a Grid, spec: &FrameSpec, clip: Option<ClipPlane>) -> Self {
        let secondary = SecondaryRays::new(grid, spec, clip);
        Self { shading: spec.view, shader: Shader::new(grid.mesh(), spec, clip), secondary }
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
        for (index, block) in blocks.iter().enumerate() {
            let n_samples = block.n_samples();
            let materials = self.shader.materials(&directions[index][..n_samples], &hits[index][..n_samples]);
            for (sample_idx, (i, j)) in block.samples().enumerate() {
                let (_, y) = sample_point(i, j, sample);
                lights[index][sample_idx] = self.shader.light(
                    directions[index][sample_idx],
                    hits[index][sample_idx],
                    materials[sample_idx].as_ref(),
                    y,
                    &visibility[index][sample_idx],
                );
            }
        }
        lights
    }
}
