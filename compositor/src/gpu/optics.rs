//! Draws projectors that stand askew, overlap, or have a light of their own; paired with `shaders/optics.wgsl`.

use super::{
    blend_weights::BlendStage,
    context::Gpu,
    frame::FrameLayouts,
    places::PlaceStage,
    quad::{Layer, Quad, QuadPipelines, Target, TargetProjector, buffer},
};
use crate::wall::{Gamma, PixelRect, Wall};

/// The pipelines of this stage, for any wall.
pub(super) struct OpticsStage {
    places: PlaceStage,
    blend_weights: BlendStage,
    pipelines: QuadPipelines,
}

/// Everything that one pass draws of it.
pub(super) struct OpticsDraw {
    pipeline: wgpu::RenderPipeline,
    blend_weights: wgpu::BindGroup,
    instances: wgpu::Buffer,
    n_projectors: u32,
}

/// One projector on one target. Matches `Projector` in `shaders/optics.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorInstance {
    image_from_px: [[f32; 3]; 3],
    clip: [f32; 4],
    frame_from_rect: [f32; 4],
    drive_per_light: [f32; 3],
    gamma: f32,
    origin_px: [f32; 2],
    wall_black: f32,
    has_mesh: u32,
}

const _: () = assert!(size_of::<ProjectorInstance>() == 100);

const INSTANCE_ATTRIBUTES: [wgpu::VertexAttribute; 10] = wgpu::vertex_attr_array![
    0 => Float32x3, 1 => Float32x3, 2 => Float32x3, 3 => Float32x4, 4 => Float32x4, 5 => Float32x3, 6 => Float32,
    7 => Float32x2, 8 => Float32, 9 => Uint32
];

impl OpticsStage {
    pub(super) fn new(gpu: &Gpu, layouts: &FrameLayouts) -> Self {
        let source = include_str!("../../../shaders/optics.wgsl");
        let blend_weights = BlendStage::new(gpu);
        let weights_layout = Some(&blend_weights.weights_layout);
        let pipelines = QuadPipelines::new::<ProjectorInstance>(
            gpu,
            "optics",
            source,
            layouts,
            weights_layout,
            &INSTANCE_ATTRIBUTES,
        );
        Self { places: PlaceStage::new(gpu), blend_weights, pipelines }
    }

    /// Prepares a pass that draws `quads`, the corrected projectors of a part of the wall, from a frame that [is
    /// cut](super::frame::FrameTexture::is_cut) or not, alone or over another; `None` if there are no projectors.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        wall: &Wall,
        &(target, part): &(Target<'_>, PixelRect),
        quads: &[Quad],
        (is_cut, layer): (bool, Layer),
    ) -> Option<OpticsDraw> {
        let on_target: Vec<_> = quads.iter().filter_map(|&quad| TargetProjector::new(wall, quad)).collect();
        if on_target.is_empty() {
            return None;
        }
        let instances: Vec<_> =
            on_target.iter().map(|on_target| ProjectorInstance::new(wall, on_target, target.size)).collect();
        let places = self.places.prepare(gpu, encoder, target.size, wall, part, &on_target);
        Some(OpticsDraw {
            pipeline: self.pipelines.get(gpu, target.format, is_cut, layer),
            blend_weights: self.blend_weights.prepare(gpu, encoder, &places, target.size, wall, part, &on_target),
            instances: buffer(gpu, wgpu::BufferUsages::VERTEX, &instances),
            n_projectors: instances.len() as u32,
        })
    }
}

impl OpticsDraw {
    /// Draws into a pass in which group 0 is the frame.
    pub(super) fn draw(&self, pass: &mut wgpu::RenderPass<'_>) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(1, &self.blend_weights, &[]);
        pass.set_vertex_buffer(0, self.instances.slice(..));
        pass.draw(0..4, 0..self.n_projectors);
    }
}

impl ProjectorInstance {
    fn new(wall: &Wall, on_target: &TargetProjector, target_size: [u32; 2]) -> Self {
        let projector = &wall.projectors()[on_target.quad.projector_idx];
        let canvas = projector.canvas;
        Self {
            image_from_px: on_target.image_from_px.to_cols_array_2d().map(|column| column.map(|it| it as f32)),
            clip: on_target.quad.clip(target_size),
            // The frame covers the canvas: a point of the canvas is the same point of the frame.
            frame_from_rect: [canvas.left, canvas.bottom + canvas.height, canvas.width, -canvas.height]
                .map(|it| it as f32),
            drive_per_light: projector.gain.map(|gain| (gain / (1.0 - projector.black_level)) as f32),
            gamma: match projector.gamma {
                Gamma::Srgb => 0.0,
                Gamma::Power(exponent) => exponent as f32,
            },
            origin_px: on_target.origin_px.as_vec2().to_array(),
            wall_black: wall.black() as f32,
            has_mesh: u32::from(projector.mesh.is_some()),
        }
    }
}
