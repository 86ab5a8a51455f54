//! The stage that shows the frame on the wall; paired with `shaders/present.wgsl`.

use shared::division::FrameSize;

use super::{
    context::{Gpu, GpuError},
    frame::{FrameLayouts, FrameTexture},
    optics::OpticsStage,
    quad::{Layer, Quad, QuadPipelines, Target, begin_pass, buffer},
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
    layouts: FrameLayouts,
    frame: Option<FrameTexture>,
    /// The frame that the wall fades from, and the new one's part of the light, 0 to 1.
    fade: Option<(FrameTexture, f64)>,
    timer: Option<DrawTimer>,
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
        let layouts = FrameLayouts::new(gpu);
        let source = include_str!("../../../shaders/present.wgsl");
        let pipelines =
            QuadPipelines::new::<ProjectorInstance>(gpu, "present", source, &layouts, None, &INSTANCE_ATTRIBUTES);
        let (optics, timer) = (OpticsStage::new(gpu, &layouts), DrawTimer::new(gpu));
        Self { pipelines, optics, layouts, frame: None, fade: None, timer }
    }

    /// Takes a complete frame, whose resolution may differ from the last one's: sRGB-encoded R, G, B and one byte unused,
    /// row by row from the bottom left. The bytes are copied at once and reach the GPU with the next submission.
    pub fn upload(&mut self, gpu: &Gpu, size: FrameSize, rgba: &[u8]) -> Result<(), GpuError> {
        let old = self.frame.take();
        self.frame = Some(self.texture(gpu, size, rgba, old)?);
        Ok(())
    }

    /// The same, but the wall keeps showing the old frame, and fades into the new one as [`Present::set_fade`] says.
    pub fn fade_into(&mut self, gpu: &Gpu, size: FrameSize, rgba: &[u8]) -> Result<(), GpuError> {
        let spare = self.fade.take().map(|(old, _)| old);
        let new = self.texture(gpu, size, rgba, spare)?;
        self.fade = self.frame.replace(new).map(|old| (old, 0.0));
        Ok(())
    }

    /// Sets the new frame's part of the light, 0 to 1: at 1, the fade is over.
    pub fn set_fade(&mut self, part: f64) {
        self.fade.take_if(|_| part >= 1.0);
        self.fade.iter_mut().for_each(|(_, of_new)| *of_new = part);
    }

    /// A texture with a frame's samples, for [`Present::draw_frame`]; the old one, if it has the size.
    pub(crate) fn texture(
        &self,
        gpu: &Gpu,
        size: FrameSize,
        rgba: &[u8],
        old: Option<FrameTexture>,
    ) -> Result<FrameTexture, GpuError> {
        if rgba.len() as u64 != 4 * u64::from(size.n_samples()) {
            return Err(GpuError::NotAFrame { n_bytes: rgba.len(), size });
        }
        let texture = match old.filter(|old| old.size == size) {
            Some(old) => old,
            None => FrameTexture::new(gpu, &self.layouts, size)?,
        };
        texture.write(gpu, rgba);
        Ok(texture)
    }

    /// Draws parts of the wall, each over all of a target; black around it, and black before the first frame.
    ///
    /// A part is a rectangle of the spanning output; it is scaled to fit into its target, centred. A part that cuts a
    /// projector must fit its target exactly.
    pub fn draw(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        wall: &Wall,
        outputs: &[(Target<'_>, PixelRect)],
    ) {
        let (frame, fade) = (self.frame.take(), self.fade.take());
        match (&frame, &fade) {
            (Some(new), Some((old, part))) => {
                self.draw_layers(gpu, encoder, &[(Some(old), 1.0), (Some(new), *part)], wall, outputs);
            }
            (frame, _) => self.draw_layers(gpu, encoder, &[(frame.as_ref(), 1.0)], wall, outputs),
        }
        (self.frame, self.fade) = (frame, fade);
    }

    /// The same with another frame, or black without one.
    pub(crate) fn draw_frame(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        frame: Option<&FrameTexture>,
        wall: &Wall,
        outputs: &[(Target<'_>, PixelRect)],
    ) {
        self.draw_layers(gpu, encoder, &[(frame, 1.0)], wall, outputs);
    }

    /// The same with frames over each other, the lowest first, each with its part of the light.
    fn draw_layers(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        frames: &[(Option<&FrameTexture>, f64)],
        wall: &Wall,
        outputs: &[(Target<'_>, PixelRect)],
    ) {
        let passes: Vec<_> =
            outputs.iter().flat_map(|output| (0..frames.len()).map(move |index| (output, index))).collect();
        for (index, &(output, frame_idx)) in passes.iter().enumerate() {
            let is_end = [index == 0, index + 1 == passes.len()];
            let layer = if frame_idx == 0 { Layer::Alone } else { Layer::Over };
            self.draw_layer(gpu, encoder, frames[frame_idx], layer, wall, output, is_end);
        }
        if let Some(timer) = &mut self.timer
            && !outputs.is_empty()
        {
            timer.read_after(encoder);
        }
    }

    #[expect(clippy::too_many_arguments, reason = "a pass needs all of them")]
    fn draw_layer(
        &mut self,
        gpu: &Gpu,
        encoder: &mut wgpu::CommandEncoder,
        (frame, light): (Option<&FrameTexture>, f64),
        layer: Layer,
        wall: &Wall,
        output: &(Target<'_>, PixelRect),
        is_end: [bool; 2],
    ) {
        let is_cut = frame.is_some_and(FrameTexture::is_cut);
        let &(target, part) = output;
        let pipeline = self.pipelines.get(gpu, target.format, is_cut, layer);
        let (plain, corrected): (Vec<_>, Vec<_>) =
            Quad::of_part(wall, part, target.size).partition(|quad| wall.is_plain(quad.projector_idx));
        let frame_from_px: Vec<_> = plain.iter().map(|quad| FrameFromPx::new(wall, quad)).collect();
        let instances: Vec<_> = (frame_from_px.iter().zip(&plain))
            .map(|(frame_from_px, quad)| ProjectorInstance::new(frame_from_px, quad, target.size))
            .collect();
        // A new buffer for each draw costs half a kilobyte, and several targets in one submission share nothing.
        let instance_buffer = (!instances.is_empty()).then(|| buffer(gpu, wgpu::BufferUsages::VERTEX, &instances));
        let corrected = self.optics.prepare(gpu, encoder, wall, output, &corrected, (is_cut, layer));
        let timestamps = self.timer.as_ref().and_then(|timer| timer.pass_timestamps(is_end));
        let mut pass = begin_pass(encoder, "present", &[target.view], layer, timestamps);
        let Some(frame) = frame else { return };
        pass.set_blend_constant(wgpu::Color { r: light, g: light, b: light, a: light });
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
