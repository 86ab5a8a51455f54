//! Shared by the stages that draw the wall: targets, and a quad for each projector.

use glam::{DMat3, DVec2};

use super::{context::Gpu, frame::FrameLayouts};
use crate::wall::{PixelRect, Wall};

/// An image to draw on.
#[derive(Clone, Copy)]
pub struct Target<'a> {
    /// The image.
    pub view: &'a wgpu::TextureView,
    /// The view's format. Shaders encode values for views without sRGB.
    pub format: wgpu::TextureFormat,
    /// Columns and rows.
    pub size: [u32; 2],
}

/// A projector's pixels on a target.
#[derive(Clone, Copy)]
pub(crate) struct Quad {
    pub(crate) projector_idx: usize,
    /// Left, top, right and bottom in pixels of the target; not whole when the wall is scaled.
    pub(crate) edges: [f64; 4],
}

/// A quad whose projector stands askew, overlaps others, or has a light of its own.
pub(super) struct TargetProjector {
    pub(super) quad: Quad,
    /// A pixel in the quad's middle: f32 holds the small offsets from it well.
    pub(super) origin_px: DVec2,
    /// From pixels right and down of `origin_px` to the projector's image.
    pub(super) image_from_px: DMat3,
}

impl Quad {
    /// The quads on a target of the projectors in a part of the wall.
    pub(crate) fn of_part(wall: &Wall, part: PixelRect, target_size: [u32; 2]) -> impl Iterator<Item = Self> {
        let fitted = PixelRect::fitted([part.width, part.height], target_size);
        let x_scale = f64::from(fitted.width) / f64::from(part.width.max(1));
        let y_scale = f64::from(fitted.height) / f64::from(part.height.max(1));
        let shown = wall.projectors().iter().enumerate().filter(move |(_, projector)| part.overlaps(&projector.output));
        shown.map(move |(projector_idx, projector)| {
            let PixelRect { x, y, width, height } = projector.output;
            // Scale edges instead of extents: neighbours get the same numbers, and no seam opens.
            let x_of = |edge: u32| f64::from(fitted.x) + (f64::from(edge) - f64::from(part.x)) * x_scale;
            let y_of = |edge: u32| f64::from(fitted.y) + (f64::from(edge) - f64::from(part.y)) * y_scale;
            Self { projector_idx, edges: [x_of(x), y_of(y), x_of(x + width), y_of(y + height)] }
        })
    }

    /// The columns and rows of the first and the last pixel whose centres it covers.
    pub(super) fn pixels(&self) -> [i32; 4] {
        let [left, top, right, bottom] = self.edges.map(|edge| (edge - 0.5).ceil() as i32);
        [left, top, right - 1, bottom - 1]
    }

    /// Left, bottom, right and top in clip coordinates.
    pub(super) fn clip(&self, target_size: [u32; 2]) -> [f32; 4] {
        let [left, top, right, bottom] = self.edges;
        let [target_width, target_height] = target_size.map(f64::from);
        let clip_x = |x: f64| (2.0 * x / target_width - 1.0) as f32;
        let clip_y = |y: f64| (1.0 - 2.0 * y / target_height) as f32;
        [clip_x(left), clip_y(bottom), clip_x(right), clip_y(top)]
    }
}

impl TargetProjector {
    pub(super) fn new(wall: &Wall, quad: Quad) -> Option<Self> {
        let [left, top, right, bottom] = quad.edges;
        let origin_px = DVec2::new((left + right) / 2.0, (top + bottom) / 2.0).floor();
        let raster_from_px = DMat3::from_scale(DVec2::new(1.0 / (right - left), 1.0 / (bottom - top)))
            * DMat3::from_translation(origin_px - DVec2::new(left, top));
        let image_from_raster = wall.projectors()[quad.projector_idx].raster_from_image()?.inverse();
        Some(Self { quad, origin_px, image_from_px: image_from_raster * raster_from_px })
    }
}

/// The variant of a pipeline: for targets of a format, a frame that is cut or not, alone or over another.
type Variant = (wgpu::TextureFormat, bool, Layer);

/// How a frame lies on the target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Layer {
    /// Alone.
    Alone,
    /// Over another, mixed by the pass's blend constant.
    Over,
}

/// Pipelines that draw quads, one for each format of the targets so far, because a window and a screenshot may differ, and
/// for frames that are cut or not.
pub(super) struct QuadPipelines {
    label: &'static str,
    /// For frames that are whole, and for frames in pieces.
    variants: [(wgpu::ShaderModule, wgpu::PipelineLayout); 2],
    instances: wgpu::VertexBufferLayout<'static>,
    used: Vec<(Variant, wgpu::RenderPipeline)>,
}

impl QuadPipelines {
    /// None yet. `T` is an instance with these attributes; group 0 is the frame, `group` the shader's other one.
    pub(super) fn new<T>(
        gpu: &Gpu,
        label: &'static str,
        source: &str,
        layouts: &FrameLayouts,
        group: Option<&wgpu::BindGroupLayout>,
        attributes: &'static [wgpu::VertexAttribute],
    ) -> Self {
        let instances = wgpu::VertexBufferLayout {
            array_stride: size_of::<T>() as u64,
            step_mode: wgpu::VertexStepMode::Instance,
            attributes,
        };
        let [whole, in_pieces] = FrameLayouts::sources(source);
        let [whole_layout, pieces_layout] = layouts.both();
        let variants = [(whole, whole_layout), (in_pieces, pieces_layout)].map(|(source, frame)| {
            let source = wgpu::ShaderSource::Wgsl(source.into());
            let descriptor = wgpu::ShaderModuleDescriptor { label: Some(label), source };
            let groups: Vec<_> = [Some(frame), group].into_iter().filter(Option::is_some).collect();
            (gpu.device.create_shader_module(descriptor), pipeline_layout(gpu, label, &groups))
        });
        Self { label, variants, instances, used: Vec::new() }
    }

    /// The pipeline for targets of a format, which encode sRGB themselves or leave it to the shader, and a frame that is cut
    /// or not, alone or over another.
    pub(super) fn get(
        &mut self,
        gpu: &Gpu,
        format: wgpu::TextureFormat,
        is_cut: bool,
        layer: Layer,
    ) -> wgpu::RenderPipeline {
        let variant = (format, is_cut, layer);
        if let Some((_, pipeline)) = self.used.iter().find(|(made_for, _)| *made_for == variant) {
            return pipeline.clone();
        }
        let fragment = if format.is_srgb() { "fragment_linear" } else { "fragment_encoded" };
        let buffers = [Some(self.instances.clone())];
        let (shader, layout) = &self.variants[usize::from(is_cut)];
        let blend = (layer == Layer::Over).then_some(MIX);
        let target = wgpu::ColorTargetState { blend, ..format.into() };
        let pipeline = quad_pipeline(gpu, self.label, layout, shader, &buffers, fragment, &[Some(target)]);
        self.used.push((variant, pipeline.clone()));
        pipeline
    }
}

/// Mixes by the blend constant: in linear light where the target encodes sRGB.
const MIX: wgpu::BlendState = {
    let mix = wgpu::BlendComponent {
        src_factor: wgpu::BlendFactor::Constant,
        dst_factor: wgpu::BlendFactor::OneMinusConstant,
        operation: wgpu::BlendOperation::Add,
    };
    wgpu::BlendState { color: mix, alpha: mix }
};

pub(super) fn pipeline_layout(
    gpu: &Gpu,
    label: &str,
    groups: &[Option<&wgpu::BindGroupLayout>],
) -> wgpu::PipelineLayout {
    gpu.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(label),
        bind_group_layouts: groups,
        immediate_size: 0,
    })
}

/// A shader of this source.
pub(super) fn shader(gpu: &Gpu, label: &str, source: &'static str) -> wgpu::ShaderModule {
    let source = wgpu::ShaderSource::Wgsl(source.into());
    gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: Some(label), source })
}

/// Draws one quad for each projector on targets of a format.
pub(super) fn quad_pipeline(
    gpu: &Gpu,
    label: &str,
    layout: &wgpu::PipelineLayout,
    shader: &wgpu::ShaderModule,
    buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
    fragment: &'static str,
    targets: &[Option<wgpu::ColorTargetState>],
) -> wgpu::RenderPipeline {
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some(label),
        layout: Some(layout),
        vertex: wgpu::VertexState {
            module: shader,
            entry_point: Some("vertex"),
            compilation_options: Default::default(),
            buffers,
        },
        primitive: wgpu::PrimitiveState { topology: wgpu::PrimitiveTopology::TriangleStrip, ..Default::default() },
        depth_stencil: None,
        multisample: Default::default(),
        fragment: Some(wgpu::FragmentState {
            module: shader,
            entry_point: Some(fragment),
            compilation_options: Default::default(),
            targets,
        }),
        multiview_mask: None,
        cache: None,
    })
}

/// A matrix as WGSL lays it out: columns of three, each padded to four.
pub(super) fn columns(matrix: DMat3) -> [[f32; 4]; 3] {
    matrix.to_cols_array_2d().map(|[x, y, z]| [x as f32, y as f32, z as f32, 0.0])
}

/// A buffer that holds `records`.
pub(super) fn buffer<T: bytemuck::NoUninit>(gpu: &Gpu, usage: wgpu::BufferUsages, records: &[T]) -> wgpu::Buffer {
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("projectors"),
        size: size_of_val(records) as u64,
        usage: usage | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(records));
    buffer
}

/// A pass that draws on `views`: over what is there, or on black.
pub(super) fn begin_pass<'a>(
    encoder: &'a mut wgpu::CommandEncoder,
    label: &str,
    views: &[&wgpu::TextureView],
    layer: Layer,
    timestamp_writes: Option<wgpu::RenderPassTimestampWrites<'_>>,
) -> wgpu::RenderPass<'a> {
    let load = match layer {
        Layer::Alone => wgpu::LoadOp::Clear(wgpu::Color::BLACK),
        Layer::Over => wgpu::LoadOp::Load,
    };
    let attachment = |view| wgpu::RenderPassColorAttachment {
        view,
        depth_slice: None,
        resolve_target: None,
        ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
    };
    let attachments: Vec<_> = views.iter().map(|view| Some(attachment(view))).collect();
    encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some(label),
        color_attachments: &attachments,
        timestamp_writes,
        ..Default::default()
    })
}
