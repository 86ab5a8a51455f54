//! The part of the present stage for projectors that stand askew, overlap, or have a light of their own; paired with
//! `shaders/optics.wgsl`.

use glam::{DMat3, DVec2};

use super::context::Gpu;
use super::present::{Target, clip_of, quad_pipeline};
use crate::wall::blend::Neighbour;
use crate::wall::{Gamma, Wall};

/// The pipelines of this part, for any wall.
pub(super) struct OpticsStage {
    shader: wgpu::ShaderModule,
    layout: wgpu::PipelineLayout,
    records_layout: wgpu::BindGroupLayout,
    /// One for each format of the targets so far.
    pipelines: Vec<(wgpu::TextureFormat, wgpu::RenderPipeline)>,
}

/// All that one pass draws of it.
pub(super) struct OpticsDraw {
    pipeline: wgpu::RenderPipeline,
    records: wgpu::BindGroup,
    n_projectors: u32,
}

/// One projector on one target. Matches `Projector` in `shaders/optics.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorRecord {
    place_from_px: [[f32; 4]; 3],
    clip: [f32; 4],
    frame_from_place: [f32; 4],
    drive_per_light: [f32; 3],
    gamma: f32,
    origin_px: [f32; 2],
    wall_black: f32,
    first_neighbour: u32,
    n_neighbours: u32,
    _padding: [u32; 3],
}

const _: () = assert!(size_of::<ProjectorRecord>() == 128);

/// A projector's neighbour. Matches `Neighbour` in `shaders/optics.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
struct NeighbourRecord {
    raster_from_place: [[f32; 4]; 3],
    place_from_place: [f32; 4],
    reach: [f32; 4],
    place_edges: [f32; 4],
    raster_edges: [f32; 4],
    raster_size: [f32; 2],
    black_level: f32,
    blends: f32,
}

const _: () = assert!(size_of::<NeighbourRecord>() == 128);

impl OpticsStage {
    /// `frame_layout` is the group of the frame's texture and sampler.
    pub(super) fn new(gpu: &Gpu, frame_layout: &wgpu::BindGroupLayout) -> Self {
        let device = &gpu.device;
        let shader = device.create_shader_module(wgpu::include_wgsl!("../../../shaders/optics.wgsl"));
        let records = |binding, visibility| wgpu::BindGroupLayoutEntry {
            binding,
            visibility,
            ty: wgpu::BindingType::Buffer {
                ty: wgpu::BufferBindingType::Storage { read_only: true },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let records_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("projectors and neighbours"),
            entries: &[records(0, wgpu::ShaderStages::VERTEX_FRAGMENT), records(1, wgpu::ShaderStages::FRAGMENT)],
        });
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("optics"),
            bind_group_layouts: &[Some(frame_layout), Some(&records_layout)],
            immediate_size: 0,
        });
        Self { shader, layout, records_layout, pipelines: Vec::new() }
    }

    /// What to draw of the projectors `quads` of a wall: their indices, and left, top, right and bottom on the target.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        target: &Target<'_>,
        wall: &Wall,
        quads: &[(usize, [f64; 4])],
    ) -> Option<OpticsDraw> {
        if quads.is_empty() {
            return None;
        }
        let mut neighbours = Vec::new();
        let mut projectors = Vec::with_capacity(quads.len());
        for &(projector_idx, quad) in quads {
            projectors.push(ProjectorRecord::new(wall, projector_idx, quad, target.size, neighbours.len() as u32)?);
            neighbours.extend(wall.neighbours(projector_idx).iter().map(NeighbourRecord::new));
        }
        // Made anew for each draw, as the other projectors' are: some kilobytes.
        let records = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("projectors and neighbours"),
            layout: &self.records_layout,
            entries: &[
                wgpu::BindGroupEntry {
                    binding: 0,
                    resource: storage(gpu, bytemuck::cast_slice(&projectors)).as_entire_binding(),
                },
                wgpu::BindGroupEntry {
                    binding: 1,
                    resource: storage(gpu, bytemuck::cast_slice(&neighbours)).as_entire_binding(),
                },
            ],
        });
        let pipeline = self.pipeline(gpu, target.format);
        Some(OpticsDraw { pipeline, records, n_projectors: projectors.len() as u32 })
    }

    fn pipeline(&mut self, gpu: &Gpu, format: wgpu::TextureFormat) -> wgpu::RenderPipeline {
        if let Some((_, pipeline)) = self.pipelines.iter().find(|(made_for, _)| *made_for == format) {
            return pipeline.clone();
        }
        let pipeline = quad_pipeline(gpu, "optics", &self.layout, &self.shader, &[], format);
        self.pipelines.push((format, pipeline.clone()));
        pipeline
    }
}

impl OpticsDraw {
    /// Draws into a pass in which group 0 is the frame.
    pub(super) fn draw(&self, pass: &mut wgpu::RenderPass<'_>) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(1, &self.records, &[]);
        pass.draw(0..4, 0..self.n_projectors);
    }
}

impl ProjectorRecord {
    fn new(wall: &Wall, projector_idx: usize, quad: [f64; 4], target_size: [u32; 2], first: u32) -> Option<Self> {
        let projector = &wall.projectors()[projector_idx];
        let [left, top, right, bottom] = quad;
        // Offsets from the middle are small, and f32 holds them well.
        let origin_px = DVec2::new((left + right) / 2.0, (top + bottom) / 2.0).floor();
        let raster_from_px = DMat3::from_scale(DVec2::new(1.0 / (right - left), 1.0 / (bottom - top)))
            * DMat3::from_translation(origin_px - DVec2::new(left, top));
        let place_from_px = projector.raster_from_place()?.inverse() * raster_from_px;
        let canvas = projector.canvas;
        Some(Self {
            place_from_px: columns(place_from_px),
            clip: clip_of(quad, target_size),
            // The frame covers the canvas, so a place on the canvas is the same place in the frame.
            frame_from_place: [canvas.left, canvas.bottom + canvas.height, canvas.width, -canvas.height]
                .map(|it| it as f32),
            drive_per_light: projector.gain.map(|gain| (gain / (1.0 - projector.black_level)) as f32),
            gamma: match projector.gamma {
                Gamma::Srgb => 0.0,
                Gamma::Power(exponent) => exponent as f32,
            },
            origin_px: origin_px.as_vec2().to_array(),
            wall_black: wall.black() as f32,
            first_neighbour: first,
            n_neighbours: wall.neighbours(projector_idx).len() as u32,
            _padding: [0; 3],
        })
    }
}

impl NeighbourRecord {
    fn new(neighbour: &Neighbour) -> Self {
        let [origin, scale] = [neighbour.place_origin, neighbour.place_scale].map(DVec2::as_vec2);
        let [least, greatest] = neighbour.reach.map(DVec2::as_vec2);
        Self {
            raster_from_place: columns(neighbour.raster_from_place),
            place_from_place: [origin.x, origin.y, scale.x, scale.y],
            reach: [least.x, least.y, greatest.x, greatest.y],
            place_edges: neighbour.place_edges.as_vec4().to_array(),
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
