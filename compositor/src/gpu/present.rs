//! The stage that shows the frame on the wall; paired with `shaders/present.wgsl`.

use shared::division::FrameSize;

use super::context::{Gpu, GpuError};
use super::frame_texture::FrameTexture;
use super::optics::OpticsStage;
use super::timer::DrawTimer;
use crate::wall::{CanvasRect, PixelRect, Projector, Wall};

/// Draws the newest frame on any target: a window, an offscreen wall, one output of several.
///
/// Every projector is a quad that samples its part of the frame, bilinearly and in linear light, or sample by sample where
/// it has a pixel for each. Those that are warped,
/// overlap others, or have a light of their own are drawn by [`super::optics`] in the same pass.
pub struct Present {
    shader: wgpu::ShaderModule,
    layout: wgpu::PipelineLayout,
    /// One for each format of the targets so far: a window and a screenshot may differ.
    pipelines: Vec<(wgpu::TextureFormat, wgpu::RenderPipeline)>,
    optics: OpticsStage,
    frame_layout: wgpu::BindGroupLayout,
    samplers: PerFilter<wgpu::Sampler>,
    frame: Option<(FrameTexture, PerFilter<wgpu::BindGroup>)>,
    timer: Option<DrawTimer>,
}

/// Ways to read the frame, one of which each draw binds.
struct PerFilter<T> {
    bilinear: T,
    /// The same picture where pixels and samples coincide, as they do when a resting wall has become as fine as it gets;
    /// on a software adapter in two thirds of the time.
    nearest: T,
}

/// A picture to draw on.
pub struct Target<'a> {
    /// The picture.
    pub view: &'a wgpu::TextureView,
    /// The view's format. Those without sRGB get values encoded by the shader.
    pub format: wgpu::TextureFormat,
    /// Its columns and rows.
    pub size: [u32; 2],
}

/// One projector on one target. Matches `Projector` in `shaders/present.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]
struct ProjectorInstance {
    clip: [f32; 4],
    origin_px: [f32; 2],
    origin_frame: [f32; 2],
    frame_per_px: [f32; 2],
}

const _: () = assert!(size_of::<ProjectorInstance>() == 40);

const INSTANCE_ATTRIBUTES: [wgpu::VertexAttribute; 4] =
    wgpu::vertex_attr_array![0 => Float32x4, 1 => Float32x2, 2 => Float32x2, 3 => Float32x2];

impl Present {
    /// The stage, without a frame yet.
    pub fn new(gpu: &Gpu) -> Self {
        let device = &gpu.device;
        let shader = device.create_shader_module(wgpu::include_wgsl!("../../../shaders/present.wgsl"));
        let frame_layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("frame"),
            entries: &[
                fragment_binding(
                    0,
                    wgpu::BindingType::Texture {
                        sample_type: wgpu::TextureSampleType::Float { filterable: true },
                        view_dimension: wgpu::TextureViewDimension::D2,
                        multisampled: false,
                    },
                ),
                fragment_binding(1, wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering)),
            ],
        });
        let sampler = |filter| {
            device.create_sampler(&wgpu::SamplerDescriptor {
                label: Some("frame"),
                mag_filter: filter,
                min_filter: filter,
                ..Default::default()
            })
        };
        let samplers =
            PerFilter { bilinear: sampler(wgpu::FilterMode::Linear), nearest: sampler(wgpu::FilterMode::Nearest) };
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("present"),
            bind_group_layouts: &[Some(&frame_layout)],
            immediate_size: 0,
        });
        let optics = OpticsStage::new(gpu, &frame_layout);
        let timer = DrawTimer::new(gpu);
        Self { shader, layout, pipelines: Vec::new(), optics, frame_layout, samplers, frame: None, timer }
    }

    /// Takes a whole frame, as [`FrameTexture::upload`] does; its resolution may differ from the last one's.
    pub fn upload(&mut self, gpu: &Gpu, size: FrameSize, rgba: &[u8]) -> Result<(), GpuError> {
        match &self.frame {
            Some((texture, _)) if texture.size() == size => texture.upload(gpu, rgba),
            _ => {
                let texture = FrameTexture::new(gpu, size)?;
                texture.upload(gpu, rgba)?;
                let read_by = |sampler| {
                    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                        label: Some("frame"),
                        layout: &self.frame_layout,
                        entries: &[
                            wgpu::BindGroupEntry {
                                binding: 0,
                                resource: wgpu::BindingResource::TextureView(texture.view()),
                            },
                            wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::Sampler(sampler) },
                        ],
                    })
                };
                let bilinear = read_by(&self.samplers.bilinear);
                let nearest = read_by(&self.samplers.nearest);
                self.frame = Some((texture, PerFilter { bilinear, nearest }));
                Ok(())
            }
        }
    }

    /// Draws a part of the wall over all of `target`, and black around it and before any frame.
    ///
    /// `part` is a rectangle of the output that spans all projectors, and holds each of them whole or none of it; it is
    /// scaled to fit the target whole, centred.
    pub fn draw(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target: &Target<'_>,
        wall: &Wall,
        part: PixelRect,
    ) {
        self.draw_all(gpu, encoder, wall, &[(target, part)]);
    }

    /// Draws the same frame on several targets, a part of the wall on each, as [`Present::draw`] does.
    pub fn draw_all(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        wall: &Wall,
        outputs: &[(&Target<'_>, PixelRect)],
    ) {
        for (index, (target, part)) in outputs.iter().enumerate() {
            let is_end = [index == 0, index + 1 == outputs.len()];
            self.draw_pass(gpu, encoder, target, wall, *part, is_end);
        }
        if let Some(timer) = &mut self.timer
            && !outputs.is_empty()
        {
            timer.read_after(encoder);
        }
    }

    /// `is_end`: whether it is the first pass that counts as one draw, and whether it is the last.
    fn draw_pass(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        target: &Target<'_>,
        wall: &Wall,
        part: PixelRect,
        is_end: [bool; 2],
    ) {
        let pipeline = self.pipeline(gpu, target.format);
        let (plain, corrected): (Vec<_>, Vec<_>) =
            quads(wall, part, target.size).partition(|(projector_idx, _)| wall.is_plain(*projector_idx));
        let frame_from_px: Vec<_> =
            plain.iter().map(|(index, quad)| FrameFromPx::new(&wall.projectors()[*index], *quad)).collect();
        let instances: Vec<_> = (frame_from_px.iter().zip(&plain))
            .map(|(frame_from_px, (_, quad))| ProjectorInstance::new(frame_from_px, *quad, target.size))
            .collect();
        // Made anew for each draw: half a kilobyte, and several targets in one submission cannot disturb each other.
        let instance_buffer = (!instances.is_empty()).then(|| vertex_buffer(gpu, &instances));
        let corrected = self.optics.prepare(gpu, encoder, target, wall, part, &corrected);

        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("present"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: target.view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            timestamp_writes: self.timer.as_ref().and_then(|timer| timer.pass_timestamps(is_end)),
            ..Default::default()
        });
        if let Some((texture, frame)) = &self.frame {
            if let Some(instance_buffer) = &instance_buffer {
                let is_sample_per_px = frame_from_px.iter().all(|it| it.is_sample_per_px(texture.size(), target.size));
                pass.set_bind_group(0, if is_sample_per_px { &frame.nearest } else { &frame.bilinear }, &[]);
                pass.set_pipeline(&pipeline);
                pass.set_vertex_buffer(0, instance_buffer.slice(..));
                pass.draw(0..4, 0..instances.len() as u32);
            }
            if let Some(corrected) = &corrected {
                pass.set_bind_group(0, &frame.bilinear, &[]);
                corrected.draw(&mut pass);
            }
        }
    }

    /// How long the GPU took for the newest draw that it has finished, in milliseconds; `None` where GPUs do not tell.
    pub fn draw_ms(&mut self, gpu: &Gpu) -> Option<f64> {
        self.timer.as_mut()?.newest_ms(gpu)
    }

    /// The pipeline for targets of a format, made when the format first comes up.
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
        let pipeline = quad_pipeline(gpu, "present", &self.layout, &self.shader, &[Some(instances)], fragment, format);
        self.pipelines.push((format, pipeline.clone()));
        pipeline
    }
}

/// The fragment stage for targets of a format, which encode sRGB themselves or have the shader do it.
pub(super) fn fragment_for(format: wgpu::TextureFormat) -> &'static str {
    if format.is_srgb() { "fragment_linear" } else { "fragment_encoded" }
}

/// Draws one quad for each projector on targets of a format.
pub(super) fn quad_pipeline(
    gpu: &Gpu,
    label: &str,
    layout: &wgpu::PipelineLayout,
    shader: &wgpu::ShaderModule,
    buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
    fragment: &'static str,
    format: wgpu::TextureFormat,
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
            targets: &[Some(format.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}

pub(super) fn vertex_buffer<T: bytemuck::NoUninit>(gpu: &Gpu, instances: &[T]) -> wgpu::Buffer {
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("projectors"),
        size: size_of_val(instances) as u64,
        usage: wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(instances));
    buffer
}

/// The quads on a target of the projectors in a part of the wall: left, top, right and bottom in pixels, not whole when
/// the wall is scaled.
fn quads(wall: &Wall, part: PixelRect, target_size: [u32; 2]) -> impl Iterator<Item = (usize, [f64; 4])> {
    let fitted = PixelRect::fitted([part.width, part.height], target_size);
    let x_scale = f64::from(fitted.width) / f64::from(part.width.max(1));
    let y_scale = f64::from(fitted.height) / f64::from(part.height.max(1));
    let shown =
        wall.projectors().iter().enumerate().filter(move |(_, projector)| part.contains_rect(&projector.output));
    shown.map(move |(index, projector)| {
        let PixelRect { x, y, width, height } = projector.output;
        // Edges, not extents, are scaled: neighbours share the same numbers, and no seam opens.
        let x_of = |edge: u32| f64::from(fitted.x) + f64::from(edge - part.x) * x_scale;
        let y_of = |edge: u32| f64::from(fitted.y) + f64::from(edge - part.y) * y_scale;
        (index, [x_of(x), y_of(y), x_of(x + width), y_of(y + height)])
    })
}

/// A quad's left, bottom, right and top in clip coordinates.
pub(super) fn clip_of([left, top, right, bottom]: [f64; 4], target_size: [u32; 2]) -> [f32; 4] {
    let [target_width, target_height] = target_size.map(f64::from);
    let clip_x = |x: f64| (2.0 * x / target_width - 1.0) as f32;
    let clip_y = |y: f64| (1.0 - 2.0 * y / target_height) as f32;
    [clip_x(left), clip_y(bottom), clip_x(right), clip_y(top)]
}

/// Where a projector's pixels on a target lie in the frame, whose lower-left corner is (0, 0) and whose upper-right corner
/// is (1, 1).
struct FrameFromPx {
    /// A point at the upper-left corner of its quad, in whole pixels, which f32 holds exactly: the corner of a scaled wall
    /// would be rounded.
    origin_px: [f64; 2],
    /// The same point in the frame.
    origin_frame: [f64; 2],
    /// How far one pixel to the right and one pixel down go in the frame.
    frame_per_px: [f64; 2],
}

impl FrameFromPx {
    fn new(projector: &Projector, quad: [f64; 4]) -> Self {
        let [left, top, right, bottom] = quad;
        // The frame covers the canvas, so a place on the canvas is the same place in the frame.
        let CanvasRect { left: canvas_left, bottom: canvas_bottom, width, height } = projector.canvas;
        let frame_per_px = [width / (right - left), -height / (bottom - top)];
        let origin_px = [left.floor(), top.floor()];
        let frame_x = canvas_left + (origin_px[0] - left) * frame_per_px[0];
        let frame_y = canvas_bottom + height + (origin_px[1] - top) * frame_per_px[1];
        Self { origin_px, origin_frame: [frame_x, frame_y], frame_per_px }
    }

    /// Whether the centre of each pixel is that of a sample, to a hundredth of it over all of a target.
    fn is_sample_per_px(&self, frame: FrameSize, target_size: [u32; 2]) -> bool {
        [frame.xres(), frame.yres()].into_iter().enumerate().all(|(axis, n_samples)| {
            let samples_per_px = self.frame_per_px[axis].abs() * f64::from(n_samples);
            let origin = self.origin_frame[axis] * f64::from(n_samples);
            (samples_per_px - 1.0).abs() * f64::from(target_size[axis]) < 0.01 && (origin - origin.round()).abs() < 0.01
        })
    }
}

impl ProjectorInstance {
    fn new(frame_from_px: &FrameFromPx, quad: [f64; 4], target_size: [u32; 2]) -> Self {
        let f32s = |it: [f64; 2]| it.map(|it| it as f32);
        Self {
            clip: clip_of(quad, target_size),
            origin_px: f32s(frame_from_px.origin_px),
            origin_frame: f32s(frame_from_px.origin_frame),
            frame_per_px: f32s(frame_from_px.frame_per_px),
        }
    }
}

fn fragment_binding(binding: u32, ty: wgpu::BindingType) -> wgpu::BindGroupLayoutEntry {
    wgpu::BindGroupLayoutEntry { binding, visibility: wgpu::ShaderStages::FRAGMENT, ty, count: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_read_one_by_one_where_pixels_and_samples_coincide() {
        let wall =
            Wall::from_toml("small.toml", "canvas_m = [4.0, 1.0]\n[grid]\ncolumns = 3\nrows = 2\npixels = [111, 70]\n")
                .unwrap();
        let is_sample_per_px = |frame: [u32; 2], target_size| {
            quads(&wall, wall.whole_output(), target_size).all(|(index, quad)| {
                let frame = FrameSize::new(frame[0], frame[1]).unwrap();
                FrameFromPx::new(&wall.projectors()[index], quad).is_sample_per_px(frame, target_size)
            })
        };
        assert_eq!(wall.output_size(), [333, 140]);
        assert!(is_sample_per_px([333, 140], [333, 140]));
        assert!(is_sample_per_px([333, 140], [433, 140]), "centred on a wider target");
        let others =
            [([334, 140], [333, 140]), ([333, 70], [333, 140]), ([333, 140], [666, 280]), ([666, 280], [333, 140])];
        for (frame, target_size) in others {
            assert!(!is_sample_per_px(frame, target_size), "{frame:?} on {target_size:?}");
        }
    }
}
