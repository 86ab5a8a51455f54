//! From the hits of a block of samples to their light, whatever the view and the ray tree.

use glam::Vec3;
use shared::protocol::View;

use crate::{
    grid::{Grid, PacketScratch},
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
    shader: Shader<'a>,
    secondary: SecondaryRays<'a>,
}

impl<'a> Lighting<'a> {
    /// Makes ready for one frame.
    pub fn new(grid: &'a Grid, request: &FrameRequest) -> Self {
        Self {
            grid,
            view: request.view,
            eye: request.camera.rays(request.size).eye,
            shader: Shader::new(grid.mesh(), request),
            secondary: SecondaryRays::new(grid, request),
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
                *light = shade::cost(self.grid.cost(&Ray::new(self.eye, direction)));
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
