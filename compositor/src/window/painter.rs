//! The state that all windows of a wall share: the GPU, the frame on it, and a test pattern in its place.

use std::time::Instant;

use crate::{
    control::alignment::PatternImage,
    farm::Frame,
    gpu::{FrameTexture, Gpu, GpuError, OffscreenWall, Present, RgbImage, Target},
    wall::{PixelRect, Wall},
};

pub(super) fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

pub(super) struct Painter {
    pub(super) gpu: Gpu,
    pub(super) present: Present,
    /// The number of the frame on the GPU.
    pub(super) frame: Option<u64>,
    /// Whether the wall is black instead of showing the frame.
    pub(super) is_dark: bool,
    /// A test pattern in place of frames.
    pattern: Vec<ShownPattern>,
}

/// A test pattern on one output, the wall to draw it with, and the part of that wall.
struct ShownPattern {
    output: PixelRect,
    texture: FrameTexture,
    wall: (Wall, PixelRect),
}

impl Painter {
    pub(super) fn new(gpu: Gpu) -> Self {
        tracing::info!("drawing with {}", gpu.name());
        Self { present: Present::new(&gpu), gpu, frame: None, is_dark: false, pattern: Vec::new() }
    }

    /// Uploads a frame, which the wall may fade into. Returns the time in milliseconds.
    pub(super) fn upload(&mut self, frame: &Frame, fades: bool) -> Result<f64, GpuError> {
        let start = Instant::now();
        let (size, rgba) = (frame.spec.size, bytemuck::cast_slice(&frame.rgba));
        if fades {
            self.present.fade_into(&self.gpu, size, rgba)?;
        } else {
            self.present.upload(&self.gpu, size, rgba)?;
        }
        self.frame = Some(frame.stats.frame);
        Ok(ms_since(start))
    }

    /// Draws the frame, the pattern or black: a part of the wall on each target.
    pub(super) fn draw(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        wall: &Wall,
        outputs: &[(Target<'_>, PixelRect)],
    ) {
        if self.pattern.is_empty() && !self.is_dark {
            return self.present.draw(&self.gpu, encoder, wall, outputs);
        }
        for &(target, part) in outputs {
            match self.pattern.iter().find(|shown| shown.output == part) {
                Some(ShownPattern { texture, wall: (wall, part), .. }) => {
                    self.present.draw_frame(&self.gpu, encoder, Some(texture), wall, &[(target, *part)]);
                }
                None => self.present.draw_frame(&self.gpu, encoder, None, wall, &[(target, part)]),
            }
        }
    }

    /// The newest frame on the whole wall, without the overlay, independent of windows.
    pub(super) fn image(&mut self, wall: &Wall) -> Result<RgbImage, GpuError> {
        let offscreen = OffscreenWall::new(&self.gpu, wall)?;
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.present.draw(&self.gpu, &mut encoder, wall, &offscreen.outputs());
        self.gpu.queue.submit([encoder.finish()]);
        offscreen.read(&self.gpu)
    }

    /// Shows a test pattern, or frames again.
    pub(super) fn show_pattern(&mut self, pattern: &[PatternImage]) -> Result<(), GpuError> {
        let mut old = std::mem::take(&mut self.pattern);
        for PatternImage { output, size, rgba, wall } in pattern {
            let old = old.iter().position(|old| old.output == *output).map(|index| old.swap_remove(index).texture);
            let texture = self.present.texture(&self.gpu, *size, rgba, old)?;
            self.pattern.push(ShownPattern { output: *output, texture, wall: wall.clone() });
        }
        Ok(())
    }
}
