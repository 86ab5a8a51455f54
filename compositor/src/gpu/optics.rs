//! The part of the present stage for projectors that stand askew, overlap, or have a light of their own; paired with
//! `shaders/optics.wgsl`.

use glam::{DMat3, DVec2};

use super::blend_weights::BlendStage;
use super::context::Gpu;
use super::present::{Target, clip_of, fragment_for, quad_pipeline, vertex_buffer};
use crate::wall::{Gamma, PixelRect, Wall};

/// The pipelines of this part, for any wall.
pub(super) struct OpticsStage {
    shader: wgpu::ShaderModule,
    layout: wgpu::PipelineLayout,
    blend_weights: BlendStage,
    /// One for each format of the targets so far.
    pipelines: Vec<(wgpu::TextureFormat, wgpu::RenderPipeline)>,
}

/// All that one pass draws of it.
pub(super) struct OpticsDraw {
    pipeline: wgpu::RenderPipeline,
    blend_weights: wgpu::BindGroup,
    instances: wgpu::Buffer,
    n_projectors: u32,
}

/// A projector, and where it is on a target.
pub(super) struct TargetProjector {
    pub(super) projector_idx: usize,
    /// Left, top, right and bottom of its pixels on the target.
    pub(super) quad: [f64; 4],
    /// A pixel in their middle: offsets from there are small, and f32 holds them well.
    pub(super) origin_px: DVec2,
    /// From pixels right and down of it to the projector's place.
    pub(super) rect_from_px: DMat3,
}

/// One projector on one target. Matches `Projector` in `shaders/optics.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorInstance {
    rect_from_px: [[f32; 3]; 3],
    clip: [f32; 4],
    frame_from_rect: [f32; 4],
    drive_per_light: [f32; 3],
    gamma: f32,
    origin_px: [f32; 2],
    wall_black: f32,
}

const _: () = assert!(size_of::<ProjectorInstance>() == 96);

const INSTANCE_ATTRIBUTES: [wgpu::VertexAttribute; 9] = wgpu::vertex_attr_array![
    0 => Float32x3, 1 => Float32x3, 2 => Float32x3, 3 => Float32x4, 4 => Float32x4, 5 => Float32x3, 6 => Float32,
    7 => Float32x2, 8 => Float32
];

impl OpticsStage {
    /// `frame_layout` is the group of the frame's texture and sampler.
    pub(super) fn new(gpu: &Gpu, frame_layout: &wgpu::BindGroupLayout) -> Self {
        let device = &gpu.device;
        let shader = device.create_shader_module(wgpu::include_wgsl!("../../../shaders/optics.wgsl"));
        let blend_weights = BlendStage::new(gpu);
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("optics"),
            bind_group_layouts: &[Some(frame_layout), Some(blend_weights.layout())],
            immediate_size: 0,
        });
        Self { shader, layout, blend_weights, pipelines: Vec::new() }
    }

    /// What to draw of the projectors `quads` of a part of a wall: their indices, and left, top, right and bottom on the
    /// target.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target: &Target<'_>,
        wall: &Wall,
        part: PixelRect,
        quads: &[(usize, [f64; 4])],
    ) -> Option<OpticsDraw> {
        let on_target: Vec<TargetProjector> =
            quads.iter().filter_map(|&(index, quad)| TargetProjector::new(wall, index, quad)).collect();
        if on_target.is_empty() {
            return None;
        }
        let instances: Vec<_> =
            on_target.iter().map(|on_target| ProjectorInstance::new(wall, on_target, target.size)).collect();
        Some(OpticsDraw {
            pipeline: self.pipeline(gpu, target.format),
            blend_weights: self.blend_weights.prepare(gpu, encoder, target.size, wall, part, &on_target),
            instances: vertex_buffer(gpu, &instances),
            n_projectors: instances.len() as u32,
        })
    }

    fn pipeline(&mut self, gpu: &Gpu, format: wgpu::TextureFormat) -> wgpu::RenderPipeline {
        if let Some((_, pipeline)) = self.pipelines.iter().find(|(made_for, _)| *made_for == format) {
            return pipeline.clone();
        }
        let instances = wgpu::VertexBufferLayout {
            array_stride: size_of::<ProjectorInstance>() as u64,
            step_mode: wgpu::VertexStepMode::Instance,
            attributes: &INSTANCE_ATTRIBUTES,
        };
        let fragment = fragment_for(format);
        let pipeline = quad_pipeline(gpu, "optics", &self.layout, &self.shader, &[Some(instances)], fragment, format);
        self.pipelines.push((format, pipeline.clone()));
        pipeline
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

impl TargetProjector {
    fn new(wall: &Wall, projector_idx: usize, quad: [f64; 4]) -> Option<Self> {
        let [left, top, right, bottom] = quad;
        let origin_px = DVec2::new((left + right) / 2.0, (top + bottom) / 2.0).floor();
        let raster_from_px = DMat3::from_scale(DVec2::new(1.0 / (right - left), 1.0 / (bottom - top)))
            * DMat3::from_translation(origin_px - DVec2::new(left, top));
        let rect_from_raster = wall.projectors()[projector_idx].raster_from_rect()?.inverse();
        Some(Self { projector_idx, quad, origin_px, rect_from_px: rect_from_raster * raster_from_px })
    }
}

impl ProjectorInstance {
    fn new(wall: &Wall, on_target: &TargetProjector, target_size: [u32; 2]) -> Self {
        let projector = &wall.projectors()[on_target.projector_idx];
        let canvas = projector.canvas;
        Self {
            rect_from_px: on_target.rect_from_px.to_cols_array_2d().map(|column| column.map(|it| it as f32)),
            clip: clip_of(on_target.quad, target_size),
            // The frame covers the canvas, so a place on the canvas is the same place in the frame.
            frame_from_rect: [canvas.left, canvas.bottom + canvas.height, canvas.width, -canvas.height]
                .map(|it| it as f32),
            drive_per_light: projector.gain.map(|gain| (gain / (1.0 - projector.black_level)) as f32),
            gamma: match projector.gamma {
                Gamma::Srgb => 0.0,
                Gamma::Power(exponent) => exponent as f32,
            },
            origin_px: on_target.origin_px.as_vec2().to_array(),
            wall_black: wall.black() as f32,
        }
    }
}
