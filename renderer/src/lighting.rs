//! From the hits of a block of samples to their light, whatever the view and the ray tree.

use glam::Vec3;
use shared::{look::ClipPlane, protocol::View};

use crate::{
    clip,
    grid::{Grid, PacketScratch, RayCost},
    ray::{Hit, Ray},
    secondary::SecondaryRays,
    shade::{self, Shader},
    tracer::{FrameRequest, sample_point},
};

/// All that lights one frame.
pub struct Lighting<'a> {
    grid: &'a Grid,
    view: View,
    eye: Vec3,
    clip: Option<ClipPlane>,
    shader: Shader<'a>,
    secondary: SecondaryRays<'a>,
}

impl<'a> Lighting<'a> {
    /// Makes ready for one frame of a scene that a plane may cut open.
    pub fn new(grid: &'a Grid, request: &FrameRequest, clip: Option<ClipPlane>) -> Self {
        Self {
            grid,
            view: request.view,
            eye: request.camera.rays(request.size).eye,
            clip,
            shader: Shader::new(grid.mesh(), request),
            secondary: SecondaryRays::new(grid, request, clip),
        }
    }

    /// The linear light of a block of at most 64 samples: sample number `sample` of its pixels (i, j), which follow
    /// `directions` to `hits`. Entries beyond the block are undefined.
    pub fn of_block(
        &self,
        block: &[(u32, u32)],
        sample: u32,
        directions: &[Vec3; 64],
        hits: &[Hit; 64],
        scratch: &mut PacketScratch,
    ) -> [Vec3; 64] {
        let mut lights = [Vec3::ZERO; 64];
        if self.view == View::Cost {
            for (light, &direction) in lights.iter_mut().zip(directions).take(block.len()) {
                let ray = clip::kept(self.clip.as_ref(), Ray::new(self.eye, direction));
                *light = shade::cost(ray.map_or(RayCost::default(), |ray| self.grid.cost(&ray)));
            }
            return lights;
        }
        let reach = self.secondary.reach(block, sample, directions, hits, scratch);
        for (lane, &(i, j)) in block.iter().enumerate() {
            let (_, y) = sample_point(i, j, sample);
            lights[lane] = self.shader.light(directions[lane], hits[lane], y, &reach[lane]);
        }
        lights
    }
}
