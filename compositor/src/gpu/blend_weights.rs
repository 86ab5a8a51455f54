//! Blend weights and black of projectors that stand askew or overlap: drawn once, as they do not change from frame to
//! frame; paired with `shaders/blend_weights.wgsl`.

use glam::{DMat3, DVec2};

use super::{
    context::Gpu,
    quad::{Layer, TargetProjector, begin_pass, buffer, pipeline_layout, quad_pipeline},
};
use crate::wall::{PixelRect, Wall, blend::Neighbour};

/// Draws blend weights, and caches them until a part of the wall is drawn differently.
pub(super) struct BlendStage {
    pipeline: wgpu::RenderPipeline,
    records_layout: wgpu::BindGroupLayout,
    /// The layout of the group that [`BlendStage::prepare`] returns.
    pub(super) weights_layout: wgpu::BindGroupLayout,
    /// The newest for each part of the wall.
    cached: Vec<BlendWeights>,
}

/// The weights of one part of the wall on a target, and everything that they depend on.
struct BlendWeights {
    part: PixelRect,
    target_size: [u32; 2],
    projectors: Vec<ProjectorRecord>,
    neighbours: Vec<NeighbourRecord>,
    group: wgpu::BindGroup,
}

/// One projector on one target. Matches `Projector` in `shaders/blend_weights.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorRecord {
    rect_from_px: [[f32; 4]; 3],
    clip: [f32; 4],
    origin_px: [f32; 2],
    first_neighbour: u32,
    n_neighbours: u32,
}

const _: () = assert!(size_of::<ProjectorRecord>() == 80);

/// A projector's neighbour. Matches `Neighbour` in `shaders/blend_weights.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct NeighbourRecord {
    raster_from_rect: [[f32; 4]; 3],
    neighbour_rect_from_rect: [f32; 4],
    reach: [f32; 4],
    rect_edges: [f32; 4],
    raster_edges: [f32; 4],
    raster_size: [f32; 2],
    black_level: f32,
    blends: f32,
}

const _: () = assert!(size_of::<NeighbourRecord>() == 128);

/// The 11 bits of a half float hold a weight to 1/4096 of itself: less than a sixth of a step of 8 bits.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rg16Float;

impl BlendStage {
    pub(super) fn new(gpu: &Gpu) -> Self {
        let device = &gpu.device;
        let shader = device.create_shader_module(wgpu::include_wgsl!("../../../shaders/blend_weights.wgsl"));
        let entry = |binding, visibility, ty| wgpu::BindGroupLayoutEntry { binding, visibility, ty, count: None };
        let records = wgpu::BindingType::Buffer {
            ty: wgpu::BufferBindingType::Storage { read_only: true },
            has_dynamic_offset: false,
            min_binding_size: None,
        };
        let records_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("projectors and neighbours"),
            entries: &[
                entry(0, wgpu::ShaderStages::VERTEX_FRAGMENT, records),
                entry(1, wgpu::ShaderStages::FRAGMENT, records),
            ],
        });
        let texture = wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Float { filterable: false },
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        };
        let weights_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("blend weights"),
            entries: &[entry(0, wgpu::ShaderStages::FRAGMENT, texture)],
        });
        let layout = pipeline_layout(gpu, "blend weights", &[Some(&records_layout)]);
        let pipeline = quad_pipeline(gpu, "blend weights", &layout, &shader, &[], "fragment", FORMAT.into());
        Self { pipeline, records_layout, weights_layout, cached: Vec::new() }
    }

    /// The blend weights of a part of the wall on a target, drawn by `encoder` unless they are cached.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target_size: [u32; 2],
        wall: &Wall,
        part: PixelRect,
        on_target: &[TargetProjector],
    ) -> wgpu::BindGroup {
        let mut neighbours = Vec::new();
        let mut projectors = Vec::with_capacity(on_target.len());
        for on_target in on_target {
            projectors.push(ProjectorRecord::new(wall, on_target, target_size, neighbours.len() as u32));
            neighbours.extend(wall.neighbours(on_target.quad.projector_idx).iter().map(NeighbourRecord::new));
        }
        // Equal records give equal weights.
        let cached = self.cached.iter().position(|cached| cached.part == part);
        if let Some(cached) = cached.map(|index| &self.cached[index])
            && (cached.target_size, &cached.projectors, &cached.neighbours) == (target_size, &projectors, &neighbours)
        {
            return cached.group.clone();
        }
        let group = self.draw(gpu, encoder, target_size, &projectors, &neighbours);
        if let Some(index) = cached {
            self.cached.swap_remove(index);
        }
        self.cached.push(BlendWeights { part, target_size, projectors, neighbours, group: group.clone() });
        group
    }

    fn draw(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target_size: [u32; 2],
        projectors: &[ProjectorRecord],
        neighbours: &[NeighbourRecord],
    ) -> wgpu::BindGroup {
        let device = &gpu.device;
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let (_, view) = gpu.texture("blend weights", target_size, FORMAT, usage);
        let storage = wgpu::BufferUsages::STORAGE;
        let [projector_buffer, neighbour_buffer] = [buffer(gpu, storage, projectors), buffer(gpu, storage, neighbours)];
        let records = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("projectors and neighbours"),
            layout: &self.records_layout,
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: projector_buffer.as_entire_binding() },
                wgpu::BindGroupEntry { binding: 1, resource: neighbour_buffer.as_entire_binding() },
            ],
        });
        let mut pass = begin_pass(encoder, "blend weights", &view, Layer::Alone, None);
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &records, &[]);
        pass.draw(0..4, 0..projectors.len() as u32);
        drop(pass);
        device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("blend weights"),
            layout: &self.weights_layout,
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) }],
        })
    }
}

impl ProjectorRecord {
    fn new(wall: &Wall, on_target: &TargetProjector, target_size: [u32; 2], first_neighbour: u32) -> Self {
        Self {
            rect_from_px: columns(on_target.rect_from_px),
            clip: on_target.quad.clip(target_size),
            origin_px: on_target.origin_px.as_vec2().to_array(),
            first_neighbour,
            n_neighbours: wall.neighbours(on_target.quad.projector_idx).len() as u32,
        }
    }
}

impl NeighbourRecord {
    fn new(neighbour: &Neighbour) -> Self {
        let [origin, scale] = [neighbour.rect_origin, neighbour.rect_scale].map(DVec2::as_vec2);
        let [least, greatest] = neighbour.reach.map(DVec2::as_vec2);
        Self {
            raster_from_rect: columns(neighbour.raster_from_rect),
            neighbour_rect_from_rect: [origin.x, origin.y, scale.x, scale.y],
            reach: [least.x, least.y, greatest.x, greatest.y],
            rect_edges: neighbour.rect_edges.as_vec4().to_array(),
            raster_edges: neighbour.raster_edges.as_vec4().to_array(),
            raster_size: neighbour.raster_size.as_vec2().to_array(),
            black_level: neighbour.black_level as f32,
            blends: f32::from(u8::from(neighbour.blends)),
        }
    }
}

/// A matrix as WGSL lays it out: columns of three, each padded to four.
fn columns(matrix: DMat3) -> [[f32; 4]; 3] {
    matrix.to_cols_array_2d().map(|[x, y, z]| [x as f32, y as f32, z as f32, 0.0])
}
