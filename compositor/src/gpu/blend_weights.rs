//! Blend weights and black of projectors that stand askew or overlap: drawn once, as they do not change from frame to
//! frame; paired with `shaders/blend_weights.wgsl`.

use std::sync::Arc;

use glam::DVec2;

use super::{
    context::Gpu,
    places::PlaceViews,
    quad::{Layer, TargetProjector, begin_pass, buffer, columns, pipeline_layout, quad_pipeline, shader},
};
use crate::wall::{FallOff, PixelRect, Wall, blend::Neighbour, mesh::Mesh};

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
    records: Records,
    /// Others are other places.
    places: PlaceViews,
    group: wgpu::BindGroup,
}

/// All projectors on a target, and all their neighbours.
#[derive(PartialEq)]
struct Records {
    projectors: Vec<ProjectorRecord>,
    neighbours: Vec<NeighbourRecord>,
    /// The meshes of neighbours, each once.
    meshes: Vec<Arc<Mesh>>,
    /// The fall-offs of neighbours.
    fall_offs: Vec<FallOff>,
}

/// One projector on one target. Matches `Projector` in `shaders/blend_weights.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorRecord {
    image_from_px: [[f32; 4]; 3],
    clip: [f32; 4],
    origin_px: [f32; 2],
    first_neighbour: u32,
    n_neighbours: u32,
    pixels: [i32; 4],
    has_mesh: u32,
    padding: [u32; 3],
}

const _: () = assert!(size_of::<ProjectorRecord>() == 112);

/// A projector's neighbour. Matches `Neighbour` in `shaders/blend_weights.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct NeighbourRecord {
    upright_from_image: [[f32; 4]; 3],
    neighbour_rect_from_rect: [f32; 4],
    reach: [f32; 4],
    image_edges: [f32; 4],
    raster_fades: [f32; 4],
    upright_size: [f32; 2],
    black_level: f32,
    blends: f32,
    first_point: u32,
    mesh_size: [u32; 2],
    fall_off: u32,
}

const _: () = assert!(size_of::<NeighbourRecord>() == 144);

/// The 11 bits of a half float hold a weight to 1/4096 of itself: less than a sixth of a step of 8 bits.
const FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rg16Float;

impl BlendStage {
    pub(super) fn new(gpu: &Gpu) -> Self {
        let device = &gpu.device;
        let source =
            concat!(include_str!("../../../shaders/keys.wgsl"), include_str!("../../../shaders/blend_weights.wgsl"));
        let shader = shader(gpu, "blend weights", source);
        let entry = |binding, visibility, ty| wgpu::BindGroupLayoutEntry { binding, visibility, ty, count: None };
        let records = wgpu::BindingType::Buffer {
            ty: wgpu::BufferBindingType::Storage { read_only: true },
            has_dynamic_offset: false,
            min_binding_size: None,
        };
        let texture = |sample_type| wgpu::BindingType::Texture {
            sample_type,
            view_dimension: wgpu::TextureViewDimension::D2,
            multisampled: false,
        };
        let floats = texture(wgpu::TextureSampleType::Float { filterable: false });
        let integers = texture(wgpu::TextureSampleType::Uint);
        let records_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("projectors and neighbours"),
            entries: &[
                entry(0, wgpu::ShaderStages::VERTEX_FRAGMENT, records),
                entry(1, wgpu::ShaderStages::FRAGMENT, records),
                entry(2, wgpu::ShaderStages::FRAGMENT, records),
                entry(3, wgpu::ShaderStages::FRAGMENT, floats),
                entry(4, wgpu::ShaderStages::FRAGMENT, records),
            ],
        });
        let weights_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("blend weights"),
            entries: &[
                entry(0, wgpu::ShaderStages::FRAGMENT, floats),
                entry(1, wgpu::ShaderStages::FRAGMENT, integers),
            ],
        });
        let layout = pipeline_layout(gpu, "blend weights", &[Some(&records_layout)]);
        let pipeline = quad_pipeline(gpu, "blend weights", &layout, &shader, &[], "fragment", &[Some(FORMAT.into())]);
        Self { pipeline, records_layout, weights_layout, cached: Vec::new() }
    }

    /// The blend weights and `places` of a part of the wall on a target, drawn by `encoder` unless they are cached.
    #[expect(clippy::too_many_arguments, reason = "all that weights depend on")]
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        places: &PlaceViews,
        target_size: [u32; 2],
        wall: &Wall,
        part: PixelRect,
        on_target: &[TargetProjector],
    ) -> wgpu::BindGroup {
        let records = Records::new(wall, on_target, target_size);
        // Equal records give equal weights.
        let cached = self.cached.iter().position(|cached| cached.part == part);
        if let Some(cached) = cached.map(|index| &self.cached[index])
            && (cached.target_size, &cached.places, &cached.records) == (target_size, places, &records)
        {
            return cached.group.clone();
        }
        let group = self.draw(gpu, encoder, places, target_size, &records);
        if let Some(index) = cached {
            self.cached.swap_remove(index);
        }
        self.cached.push(BlendWeights { part, target_size, records, places: places.clone(), group: group.clone() });
        group
    }

    fn draw(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        places: &PlaceViews,
        target_size: [u32; 2],
        records: &Records,
    ) -> wgpu::BindGroup {
        let device = &gpu.device;
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let (_, view) = gpu.texture("blend weights", target_size, FORMAT, usage);
        let storage = wgpu::BufferUsages::STORAGE;
        let buffers = [
            buffer(gpu, storage, &records.projectors),
            buffer(gpu, storage, &records.neighbours),
            buffer(gpu, storage, &records.image_points()),
            buffer(gpu, storage, &records.excesses()),
        ];
        let entry = |binding, resource| wgpu::BindGroupEntry { binding, resource };
        let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("projectors and neighbours"),
            layout: &self.records_layout,
            entries: &[
                entry(0, buffers[0].as_entire_binding()),
                entry(1, buffers[1].as_entire_binding()),
                entry(2, buffers[2].as_entire_binding()),
                entry(3, wgpu::BindingResource::TextureView(&places.exact)),
                entry(4, buffers[3].as_entire_binding()),
            ],
        });
        let mut pass = begin_pass(encoder, "blend weights", &[&view], Layer::Alone, None);
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.draw(0..4, 0..records.projectors.len() as u32);
        drop(pass);
        device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("blend weights"),
            layout: &self.weights_layout,
            entries: &[
                entry(0, wgpu::BindingResource::TextureView(&view)),
                entry(1, wgpu::BindingResource::TextureView(&places.within)),
            ],
        })
    }
}

impl Records {
    fn new(wall: &Wall, on_target: &[TargetProjector], target_size: [u32; 2]) -> Self {
        let mut records =
            Self { projectors: Vec::new(), neighbours: Vec::new(), meshes: Vec::new(), fall_offs: Vec::new() };
        for on_target in on_target {
            let first_neighbour = records.neighbours.len() as u32;
            records.projectors.push(ProjectorRecord::new(wall, on_target, target_size, first_neighbour));
            for neighbour in wall.neighbours(on_target.quad.projector_idx) {
                let first_point = neighbour.mesh.as_ref().map_or(0, |mesh| records.first_point(mesh));
                let fall_off = neighbour.fall_off.as_ref().map_or(0, |fall_off| records.number(fall_off));
                records.neighbours.push(NeighbourRecord::new(neighbour, first_point, fall_off));
            }
        }
        records
    }

    /// The place of a mesh's first point among those of all meshes.
    fn first_point(&mut self, mesh: &Arc<Mesh>) -> u32 {
        let position = self.meshes.iter().position(|it| Arc::ptr_eq(it, mesh)).unwrap_or_else(|| {
            self.meshes.push(Arc::clone(mesh));
            self.meshes.len() - 1
        });
        self.meshes[..position].iter().map(|mesh| mesh.inverse_points().1.len() as u32).sum()
    }

    /// The number of a fall-off among all, from 1.
    fn number(&mut self, fall_off: &FallOff) -> u32 {
        let position = self.fall_offs.iter().position(|it| it == fall_off).unwrap_or_else(|| {
            self.fall_offs.push(fall_off.clone());
            self.fall_offs.len() - 1
        });
        position as u32 + 1
    }

    /// The excess of all fall-offs; one if there are none, as no buffer is empty.
    fn excesses(&self) -> Vec<f32> {
        let excesses: Vec<f32> = self.fall_offs.iter().flat_map(FallOff::padded).map(|it| *it as f32).collect();
        if excesses.is_empty() { vec![1.0] } else { excesses }
    }

    /// Points of images of all meshes; one if there are none, as no buffer is empty.
    fn image_points(&self) -> Vec<[f32; 2]> {
        let points = self.meshes.iter().flat_map(|mesh| mesh.inverse_points().1);
        let points: Vec<_> = points.map(|at| at.as_vec2().to_array()).collect();
        if points.is_empty() { vec![[0.0; 2]] } else { points }
    }
}

impl ProjectorRecord {
    fn new(wall: &Wall, on_target: &TargetProjector, target_size: [u32; 2], first_neighbour: u32) -> Self {
        Self {
            image_from_px: columns(on_target.image_from_px),
            clip: on_target.quad.clip(target_size),
            origin_px: on_target.origin_px.as_vec2().to_array(),
            first_neighbour,
            n_neighbours: wall.neighbours(on_target.quad.projector_idx).len() as u32,
            pixels: on_target.quad.pixels(),
            has_mesh: u32::from(wall.projectors()[on_target.quad.projector_idx].mesh.is_some()),
            padding: [0; 3],
        }
    }
}

impl NeighbourRecord {
    fn new(neighbour: &Neighbour, first_point: u32, fall_off: u32) -> Self {
        let [origin, scale] = [neighbour.rect_origin, neighbour.rect_scale].map(DVec2::as_vec2);
        let [least, greatest] = neighbour.reach.map(DVec2::as_vec2);
        Self {
            upright_from_image: columns(neighbour.upright_from_image),
            neighbour_rect_from_rect: [origin.x, origin.y, scale.x, scale.y],
            reach: [least.x, least.y, greatest.x, greatest.y],
            image_edges: neighbour.image_edges.as_vec4().to_array(),
            raster_fades: neighbour.raster_fades.as_vec4().to_array(),
            upright_size: neighbour.upright_size.as_vec2().to_array(),
            black_level: neighbour.black_level as f32,
            blends: f32::from(u8::from(neighbour.blends)),
            first_point,
            mesh_size: neighbour.mesh.as_ref().map_or([0; 2], |mesh| mesh.inverse_points().0.map(|n| n as u32)),
            fall_off,
        }
    }
}
