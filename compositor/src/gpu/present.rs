//! The stage that shows the frame on the wall; paired with `shaders/present.wgsl`.

use shared::division::FrameSize;

use super::{
    context::{Gpu, GpuError},
    optics::OpticsStage,
    quad::{Quad, QuadPipelines, Target, begin_pass, buffer},
    timer::DrawTimer,
};
use crate::wall::{CanvasRect, PixelRect, Wall};

/// Draws the newest frame on any target: a window, an offscreen wall, one output of several.
///
/// Every projector is a quad that samples its part of the frame in linear light: bilinearly, or sample by sample where it
/// has a pixel for each. [`super::optics`] draws, in the same pass, those that are warped, overlap others, or have a light
/// of their own.
pub struct Present {
    pipelines: QuadPipelines,
    optics: OpticsStage,
    frame_layout: wgpu::BindGroupLayout,
    /// Bilinear and nearest.
    samplers: [wgpu::Sampler; 2],
    frame: Option<FrameTexture>,
    timer: Option<DrawTimer>,
}

/// A frame's samples on the GPU: row 0 is the bottom row, and shaders read linear light. Each draw binds one filter.
struct FrameTexture {
    size: FrameSize,
    texture: wgpu::Texture,
    bilinear: wgpu::BindGroup,
    /// The same image where pixels and samples coincide, as on a resting wall after refinement; on a software adapter in
    /// two thirds of the time.
    nearest: wgpu::BindGroup,
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
        let shader = wgpu::include_wgsl!("../../../shaders/present.wgsl");
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
        let samplers = [sampler(wgpu::FilterMode::Linear), sampler(wgpu::FilterMode::Nearest)];
        let groups = [Some(&frame_layout)];
        let pipelines = QuadPipelines::new::<ProjectorInstance>(gpu, "present", shader, &groups, &INSTANCE_ATTRIBUTES);
        let (optics, timer) = (OpticsStage::new(gpu, &frame_layout), DrawTimer::new(gpu));
        Self { pipelines, optics, frame_layout, samplers, frame: None, timer }
    }

    /// Takes a complete frame, whose resolution may differ from the last one's: sRGB-encoded R, G, B and one byte unused,
    /// row by row from the bottom left. The bytes are copied at once and reach the GPU with the next submission.
    pub fn upload(&mut self, gpu: &Gpu, size: FrameSize, rgba: &[u8]) -> Result<(), GpuError> {
        if rgba.len() as u64 != 4 * u64::from(size.n_samples()) {
            return Err(GpuError::NotAFrame { n_bytes: rgba.len(), size });
        }
        let frame = match self.frame.take().filter(|frame| frame.size == size) {
            Some(frame) => frame,
            None => self.frame_texture(gpu, size)?,
        };
        let layout =
            wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * size.xres()), rows_per_image: None };
        gpu.queue.write_texture(frame.texture.as_image_copy(), rgba, layout, frame.texture.size());
        self.frame = Some(frame);
        Ok(())
    }

    fn frame_texture(&self, gpu: &Gpu, size: FrameSize) -> Result<FrameTexture, GpuError> {
        let extent = [size.xres(), size.yres()];
        gpu.check_size("a frame", extent)?;
        // Loads from sRGB give linear light, in which the wall is filtered and blended.
        let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        let (texture, view) = gpu.texture("frame", extent, wgpu::TextureFormat::Rgba8UnormSrgb, usage);
        let [bilinear, nearest] = self.samplers.each_ref().map(|sampler| {
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("frame"),
                layout: &self.frame_layout,
                entries: &[
                    wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&view) },
                    wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::Sampler(sampler) },
                ],
            })
        });
        Ok(FrameTexture { size, texture, bilinear, nearest })
    }

    /// Draws parts of the wall, each over all of a target; black around it, and black before the first frame.
    ///
    /// A part is a rectangle of the spanning output that contains each projector wholly or not at all; it is scaled to fit
    /// into its target, centred.
    pub fn draw(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        wall: &Wall,
        outputs: &[(Target<'_>, PixelRect)],
    ) {
        for (index, &(target, part)) in outputs.iter().enumerate() {
            let pipeline = self.pipelines.get(gpu, target.format);
            let (plain, corrected): (Vec<_>, Vec<_>) =
                Quad::of_part(wall, part, target.size).partition(|quad| wall.is_plain(quad.projector_idx));
            let frame_from_px: Vec<_> = plain.iter().map(|quad| FrameFromPx::new(wall, quad)).collect();
            let instances: Vec<_> = (frame_from_px.iter().zip(&plain))
                .map(|(frame_from_px, quad)| ProjectorInstance::new(frame_from_px, quad, target.size))
                .collect();
            // A new buffer for each draw costs half a kilobyte, and several targets in one submission share nothing.
            let instance_buffer = (!instances.is_empty()).then(|| buffer(gpu, wgpu::BufferUsages::VERTEX, &instances));
            let corrected = self.optics.prepare(gpu, encoder, &target, wall, part, &corrected);

            let is_end = [index == 0, index + 1 == outputs.len()];
            let timestamps = self.timer.as_ref().and_then(|timer| timer.pass_timestamps(is_end));
            let mut pass = begin_pass(encoder, "present", target.view, timestamps);
            if let Some(frame) = &self.frame {
                if let Some(instance_buffer) = &instance_buffer {
                    let is_sample_per_px = frame_from_px.iter().all(|it| it.is_sample_per_px(frame.size, target.size));
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
        if let Some(timer) = &mut self.timer
            && !outputs.is_empty()
        {
            timer.read_after(encoder);
        }
    }

    /// GPU time of the newest finished draw in milliseconds; `None` on GPUs without timestamps.
    pub fn draw_ms(&mut self, gpu: &Gpu) -> Option<f64> {
        self.timer.as_mut()?.newest_ms(gpu)
    }
}

/// Where a projector's pixels on a target lie in the frame, whose lower-left corner is (0, 0) and whose upper-right corner
/// is (1, 1).
struct FrameFromPx {
    /// A point near the quad's upper-left corner, in whole pixels: f32 holds it exactly, but not the corner of a scaled
    /// wall.
    origin_px: [f64; 2],
    /// The same point in the frame.
    origin_frame: [f64; 2],
    /// The step in the frame for one pixel to the right, and for one pixel down.
    frame_per_px: [f64; 2],
}

impl FrameFromPx {
    fn new(wall: &Wall, quad: &Quad) -> Self {
        let [left, top, right, bottom] = quad.edges;
        // The frame covers the canvas: a point of the canvas is the same point of the frame.
        let CanvasRect { left: canvas_left, bottom: canvas_bottom, width, height } =
            wall.projectors()[quad.projector_idx].canvas;
        let frame_per_px = [width / (right - left), -height / (bottom - top)];
        let origin_px = [left.floor(), top.floor()];
        let frame_x = canvas_left + (origin_px[0] - left) * frame_per_px[0];
        let frame_y = canvas_bottom + height + (origin_px[1] - top) * frame_per_px[1];
        Self { origin_px, origin_frame: [frame_x, frame_y], frame_per_px }
    }

    /// Whether each pixel's centre is a sample's centre, to a hundredth of a pixel over all of a target.
    fn is_sample_per_px(&self, frame: FrameSize, target_size: [u32; 2]) -> bool {
        [frame.xres(), frame.yres()].into_iter().enumerate().all(|(axis, n_samples)| {
            let samples_per_px = self.frame_per_px[axis].abs() * f64::from(n_samples);
            let origin = self.origin_frame[axis] * f64::from(n_samples);
            (samples_per_px - 1.0).abs() * f64::from(target_size[axis]) < 0.01 && (origin - origin.round()).abs() < 0.01
        })
    }
}

impl ProjectorInstance {
    fn new(frame_from_px: &FrameFromPx, quad: &Quad, target_size: [u32; 2]) -> Self {
        let f32s = |it: [f64; 2]| it.map(|it| it as f32);
        Self {
            clip: quad.clip(target_size),
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
            let frame = FrameSize::new(frame[0], frame[1]).unwrap();
            let mut quads = Quad::of_part(&wall, wall.whole_output(), target_size);
            quads.all(|quad| FrameFromPx::new(&wall, &quad).is_sample_per_px(frame, target_size))
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
