//! The part of the present stage that does not change from frame to frame: what each pixel gives of the picture's light
//! where projectors stand askew or overlap; paired with `shaders/shares.wgsl`.

use glam::{DMat3, DVec2};

use super::context::Gpu;
use super::optics::TargetProjector;
use super::present::{clip_of, quad_pipeline};
use crate::wall::blend::Neighbour;
use crate::wall::{PixelRect, Wall};

/// Shares of the light, kept for as long as a part of the wall is drawn in the same way.
pub(super) struct BlendStage {
    pipeline: wgpu::RenderPipeline,
    records_layout: wgpu::BindGroupLayout,
    weights_layout: wgpu::BindGroupLayout,
    /// The newest of each part of the wall.
    cached: Vec<BlendWeights>,
}

/// Those of one part of the wall on a target.
struct BlendWeights {
    part: PixelRect,
    target_size: [u32; 2],
    projectors: Vec<ProjectorRecord>,
    neighbours: Vec<NeighbourRecord>,
    group: wgpu::BindGroup,
}

/// One projector on one target. Matches `Projector` in `shaders/shares.wgsl`.
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

/// A projector's neighbour. Matches `Neighbour` in `shaders/shares.wgsl`.
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

/// Eleven bits hold a share to a fortieth of a percent of itself: less than a sixth of a step of 8 bits.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rg16Float;

impl BlendStage {
    pub(super) fn new(gpu: &Gpu) -> Self {
        let device = &gpu.device;
        let shader = device.create_shader_module(wgpu::include_wgsl!("../../../shaders/shares.wgsl"));
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
            label: Some("shares"),
            entries: &[entry(0, wgpu::ShaderStages::FRAGMENT, texture)],
        });
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("shares"),
            bind_group_layouts: &[Some(&records_layout)],
            immediate_size: 0,
        });
        let pipeline = quad_pipeline(gpu, "shares", &layout, &shader, &[], "fragment", FORMAT);
        Self { pipeline, records_layout, weights_layout, cached: Vec::new() }
    }

    /// The layout of the group that [`BlendStage::prepare`] gives.
    pub(super) fn layout(&self) -> &wgpu::BindGroupLayout {
        &self.weights_layout
    }

    /// The shares of a part of a wall on a target, for the shader; drawn by `encoder` unless they are at hand.
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
            neighbours.extend(wall.neighbours(on_target.projector_idx).iter().map(NeighbourRecord::new));
        }
        // What the records say is all that shares depend on.
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
        [width, height]: [u32; 2],
        projectors: &[ProjectorRecord],
        neighbours: &[NeighbourRecord],
    ) -> wgpu::BindGroup {
        let device = &gpu.device;
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("shares"),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let view = texture.create_view(&wgpu::TextureViewDescriptor::default());
        let records = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("projectors and neighbours"),
            layout: &self.records_layout,
            entries: &[
                wgpu::BindGroupEntry {
                    binding: 0,
                    resource: storage(gpu, bytemuck::cast_slice(projectors)).as_entire_binding(),
                },
                wgpu::BindGroupEntry {
                    binding: 1,
                    resource: storage(gpu, bytemuck::cast_slice(neighbours)).as_entire_binding(),
                },
            ],
        });
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("shares"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            ..Default::default()
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &records, &[]);
        pass.draw(0..4, 0..projectors.len() as u32);
        drop(pass);
        device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("shares"),
            layout: &self.weights_layout,
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) }],
        })
    }
}

impl ProjectorRecord {
    fn new(wall: &Wall, on_target: &TargetProjector, target_size: [u32; 2], first_neighbour: u32) -> Self {
        Self {
            rect_from_px: columns(on_target.rect_from_px),
            clip: clip_of(on_target.quad, target_size),
            origin_px: on_target.origin_px.as_vec2().to_array(),
            first_neighbour,
            n_neighbours: wall.neighbours(on_target.projector_idx).len() as u32,
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

fn storage(gpu: &Gpu, bytes: &[u8]) -> wgpu::Buffer {
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("projectors or neighbours"),
        size: bytes.len() as u64,
        usage: wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    gpu.queue.write_buffer(&buffer, 0, bytes);
    buffer
}
