//! Where each pixel of projectors with a mesh shows the picture: drawn once, as it does not change from frame to frame;
//! paired with `shaders/places.wgsl`.

use std::sync::Arc;

use super::{
    context::Gpu,
    quad::{Layer, TargetProjector, begin_pass, buffer, columns, pipeline_layout, quad_pipeline, shader},
};
use crate::wall::{PixelRect, Wall, mesh::Mesh};

/// Draws places, and caches them until a part of the wall is drawn differently.
pub(super) struct PlaceStage {
    pipeline: wgpu::RenderPipeline,
    records_layout: wgpu::BindGroupLayout,
    /// For parts of a wall without meshes: nobody reads them.
    nowhere: PlaceViews,
    /// The newest for each part of the wall.
    cached: Vec<Places>,
}

/// The places of one part of the wall on a target, and everything that they depend on.
struct Places {
    part: PixelRect,
    target_size: [u32; 2],
    projectors: Vec<ProjectorRecord>,
    meshes: Vec<Arc<Mesh>>,
    views: PlaceViews,
}

/// The places of one part of the wall on a target, each pixel's in units of its projector's rectangle.
#[derive(Clone, PartialEq)]
pub(super) struct PlaceViews {
    /// As they are, also beyond the rectangle: for blend weights.
    pub(super) exact: wgpu::TextureView,
    /// The nearest in the rectangle, in half the bytes: for each frame.
    pub(super) within: wgpu::TextureView,
}

/// One projector on one target. Matches `Projector` in `shaders/places.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorRecord {
    image_from_px: [[f32; 4]; 3],
    clip: [f32; 4],
    origin_px: [f32; 2],
    first_point: u32,
    n_columns: u32,
    n_cells: [f32; 2],
    padding: [u32; 2],
}

const _: () = assert!(size_of::<ProjectorRecord>() == 96);

/// An exact place is held to a sixteen-millionth of the projector's rectangle.
const EXACT: wgpu::TextureFormat = wgpu::TextureFormat::Rg32Float;

/// Two numbers of sixteen bits hold a place to a thirtieth of a pixel in a rectangle of 4096 pixels. Meshes cost lavapipe 4
/// to 10 % of a frame so, and 7 to 15 % with exact places. A format of two such numbers is optional in WebGPU.
const WITHIN: wgpu::TextureFormat = wgpu::TextureFormat::R32Uint;

impl PlaceStage {
    pub(super) fn new(gpu: &Gpu) -> Self {
        let source = concat!(include_str!("../../../shaders/keys.wgsl"), include_str!("../../../shaders/places.wgsl"));
        let shader = shader(gpu, "places", source);
        let entry = |binding, visibility| wgpu::BindGroupLayoutEntry {
            binding,
            visibility,
            ty: wgpu::BindingType::Buffer {
                ty: wgpu::BufferBindingType::Storage { read_only: true },
                has_dynamic_offset: false,
                min_binding_size: None,
            },
            count: None,
        };
        let records_layout = gpu.device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("projectors and control points"),
            entries: &[entry(0, wgpu::ShaderStages::VERTEX_FRAGMENT), entry(1, wgpu::ShaderStages::FRAGMENT)],
        });
        let layout = pipeline_layout(gpu, "places", &[Some(&records_layout)]);
        let pipeline =
            quad_pipeline(gpu, "places", &layout, &shader, &[], "fragment", &[EXACT, WITHIN].map(|it| Some(it.into())));
        let nowhere = PlaceViews::new(gpu, [1, 1]);
        Self { pipeline, records_layout, nowhere, cached: Vec::new() }
    }

    /// The places of a part of the wall on a target, drawn by `encoder` unless they are cached; a single one if no
    /// projector there has a mesh.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target_size: [u32; 2],
        wall: &Wall,
        part: PixelRect,
        on_target: &[TargetProjector],
    ) -> PlaceViews {
        let mut meshes = Vec::new();
        let mut projectors = Vec::new();
        let mut first_point = 0;
        for on_target in on_target {
            if let Some(mesh) = &wall.projectors()[on_target.quad.projector_idx].mesh {
                projectors.push(ProjectorRecord::new(on_target, target_size, mesh, first_point));
                first_point += mesh.padded().len() as u32;
                meshes.push(Arc::clone(mesh));
            }
        }
        let cached = self.cached.iter().position(|cached| cached.part == part);
        if projectors.is_empty() {
            cached.map(|index| self.cached.swap_remove(index));
            return self.nowhere.clone();
        }
        // Equal records and meshes give equal places.
        if let Some(cached) = cached.map(|index| &self.cached[index])
            && (cached.target_size, &cached.projectors, &cached.meshes) == (target_size, &projectors, &meshes)
        {
            return cached.views.clone();
        }
        let views = self.draw(gpu, encoder, target_size, &projectors, &meshes);
        if let Some(index) = cached {
            self.cached.swap_remove(index);
        }
        self.cached.push(Places { part, target_size, projectors, meshes, views: views.clone() });
        views
    }

    fn draw(
        &self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target_size: [u32; 2],
        projectors: &[ProjectorRecord],
        meshes: &[Arc<Mesh>],
    ) -> PlaceViews {
        let points: Vec<[f32; 2]> = meshes
            .iter()
            .flat_map(|mesh| mesh.padded().iter().map(|at| mesh.bounds().rect_from_canvas(*at).as_vec2().to_array()))
            .collect();
        let views = PlaceViews::new(gpu, target_size);
        let storage = wgpu::BufferUsages::STORAGE;
        let [projector_buffer, point_buffer] = [buffer(gpu, storage, projectors), buffer(gpu, storage, &points)];
        let records = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("projectors and control points"),
            layout: &self.records_layout,
            entries: &[
                wgpu::BindGroupEntry { binding: 0, resource: projector_buffer.as_entire_binding() },
                wgpu::BindGroupEntry { binding: 1, resource: point_buffer.as_entire_binding() },
            ],
        });
        let mut pass = begin_pass(encoder, "places", &[&views.exact, &views.within], Layer::Alone, None);
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &records, &[]);
        pass.draw(0..4, 0..projectors.len() as u32);
        drop(pass);
        views
    }
}

impl PlaceViews {
    fn new(gpu: &Gpu, size: [u32; 2]) -> Self {
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let view = |label, format| gpu.texture(label, size, format, usage).1;
        Self { exact: view("exact places", EXACT), within: view("places within rectangles", WITHIN) }
    }
}

impl ProjectorRecord {
    fn new(on_target: &TargetProjector, target_size: [u32; 2], mesh: &Mesh, first_point: u32) -> Self {
        let [columns_of_mesh, rows] = mesh.size();
        Self {
            image_from_px: columns(on_target.image_from_px),
            clip: on_target.quad.clip(target_size),
            origin_px: on_target.origin_px.as_vec2().to_array(),
            first_point,
            n_columns: columns_of_mesh as u32 + 2,
            n_cells: [columns_of_mesh - 1, rows - 1].map(|n| n as f32),
            padding: [0; 2],
        }
    }
}
