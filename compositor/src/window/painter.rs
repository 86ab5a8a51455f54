//! The state that all windows of a wall share: the GPU, the frame on it, and a test pattern in its place.

use std::time::Instant;

use crate::{
    control::alignment,
    farm::Frame,
    gpu::{Gpu, GpuError, Offscreen, Present, RgbImage, Target},
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
    /// A test pattern in place of frames, and the wall to draw it with.
    pattern: Option<(Present, Wall)>,
}

impl Painter {
    pub(super) fn new(gpu: Gpu) -> Self {
        tracing::info!("drawing with {}", gpu.name());
        Self { present: Present::new(&gpu), gpu, frame: None, is_dark: false, pattern: None }
    }

    /// Uploads a frame. Returns the time in milliseconds.
    pub(super) fn upload(&mut self, frame: &Frame) -> Result<f64, GpuError> {
        let start = Instant::now();
        self.present.upload(&self.gpu, frame.spec.size, bytemuck::cast_slice(&frame.rgba))?;
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
        // No projector lies in an empty part.
        let dark: Vec<_> =
            outputs.iter().map(|&(target, part)| (target, PixelRect { width: 0, height: 0, ..part })).collect();
        let (present, wall, outputs) = match &mut self.pattern {
            Some((present, wall)) => (present, &*wall, outputs),
            None if self.is_dark => (&mut self.present, wall, dark.as_slice()),
            None => (&mut self.present, wall, outputs),
        };
        present.draw(&self.gpu, encoder, wall, outputs);
    }

    /// The newest frame on the whole wall, without the overlay, independent of windows.
    pub(super) fn image(&mut self, wall: &Wall) -> Result<RgbImage, GpuError> {
        let offscreen = Offscreen::new(&self.gpu, wall.output_size())?;
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.present.draw(&self.gpu, &mut encoder, wall, &[(offscreen.target(), wall.whole_output())]);
        self.gpu.queue.submit([encoder.finish()]);
        offscreen.read(&self.gpu)
    }

    /// Shows a test pattern, or frames again.
    pub(super) fn show_pattern(&mut self, pattern: Option<alignment::PatternImage>) -> Result<(), GpuError> {
        let Some(alignment::PatternImage { size, rgba, wall }) = pattern else {
            self.pattern = None;
            return Ok(());
        };
        let mut present = self.pattern.take().map_or_else(|| Present::new(&self.gpu), |(present, _)| present);
        present.upload(&self.gpu, size, &rgba)?;
        self.pattern = Some((present, wall));
        Ok(())
    }
}
