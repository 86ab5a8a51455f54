//! The wall without a window: renders frames, draws them on an offscreen wall, and reports.

mod film;
mod refined;

use std::time::{Duration, Instant};

use shared::division::FrameSize;

use super::report::Report;
use crate::{
    farm::{Farm, Frame, stats::DisplayStats},
    gpu::{Gpu, GpuError, OffscreenWall, Present, RgbImage},
    wall::Wall,
};

pub use film::Film;

/// News for a wall without a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wakeup {
    /// The farm has news.
    Farm,
    /// The operator stops it.
    Stop,
}

/// Where wake-up calls arrive.
pub type Wakeups = std::sync::mpsc::Receiver<Wakeup>;

/// After this time without news, a log line says what the wall waits for.
const REPORT_WAIT_AFTER: Duration = Duration::from_secs(5);

/// An offscreen wall.
pub struct Headless {
    gpu: Gpu,
    present: Present,
    offscreen: OffscreenWall,
    wall: Wall,
}

impl Headless {
    /// Finds a GPU and creates the offscreen image.
    pub fn new(wall: Wall) -> anyhow::Result<Self> {
        let gpu = Gpu::headless()?;
        tracing::info!("drawing on {}", gpu.name());
        let offscreen = OffscreenWall::new(&gpu, &wall)?;
        let present = Present::new(&gpu);
        Ok(Self { gpu, present, offscreen, wall })
    }

    /// Shows `n_frames` of the farm's frames, each once.
    pub fn show_frames(&mut self, farm: &Farm, wakeups: &Wakeups, n_frames: u32) -> anyhow::Result<Report> {
        let mut report = Report::default();
        let mut ended_at = Instant::now();
        while report.n_frames() < n_frames as usize {
            let Some(frame) = next_frame(farm, wakeups)? else { break };
            let display = self.show(&frame)?;
            report.add(&frame, display, milliseconds(ended_at.elapsed()));
            ended_at = Instant::now();
            tracing::debug!("frame shown: {}", frame.stats.frame);
        }
        Ok(report)
    }

    /// Shows one frame.
    pub fn show(&mut self, frame: &Frame) -> anyhow::Result<DisplayStats> {
        let (upload, draw) = self.upload_and_draw(frame.spec.size, &frame.rgba)?;
        Ok(DisplayStats {
            upload_ms: milliseconds(upload),
            draw_ms: milliseconds(draw),
            present_ms: 0.0,
            latency_ms: milliseconds(frame.moved_at.elapsed()),
        })
    }

    /// The wall as it is now.
    pub fn image(&self) -> Result<RgbImage, GpuError> {
        self.offscreen.read(&self.gpu)
    }

    /// The GPU that draws.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Uploads samples to the GPU and draws the wall; returns the times of both.
    pub fn upload_and_draw(&mut self, size: FrameSize, rgba: &[u32]) -> anyhow::Result<(Duration, Duration)> {
        Ok((self.upload(size, rgba)?, self.draw()?))
    }

    /// Uploads samples to the GPU; returns the time.
    pub fn upload(&mut self, size: FrameSize, rgba: &[u32]) -> anyhow::Result<Duration> {
        let started_at = Instant::now();
        self.present.upload(&self.gpu, size, bytemuck::cast_slice(rgba))?;
        // Without a submission the samples would reach the GPU only with the draw.
        self.gpu.queue.submit([]);
        self.gpu.wait()?;
        Ok(started_at.elapsed())
    }

    /// Draws the wall with the last samples; returns the time.
    pub fn draw(&mut self) -> anyhow::Result<Duration> {
        let started_at = Instant::now();
        let mut encoder = self.gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        self.present.draw(&self.gpu, &mut encoder, &self.wall, &self.offscreen.outputs());
        self.gpu.queue.submit([encoder.finish()]);
        // Without a screen, a frame is shown when the GPU has drawn it.
        self.gpu.wait()?;
        self.gpu.check()?;
        Ok(started_at.elapsed())
    }
}

/// The farm's next frame; `None` once the operator stops the wall.
fn next_frame(farm: &Farm, wakeups: &Wakeups) -> anyhow::Result<Option<Frame>> {
    loop {
        // Check for a stop before each frame: with a farm faster than the display, the wall never waits.
        if wakeups.try_recv() == Ok(Wakeup::Stop) {
            return Ok(None);
        }
        if let Some(frame) = farm.take_frame() {
            return Ok(Some(frame));
        }
        if wait(farm, wakeups)? == Wakeup::Stop {
            return Ok(None);
        }
    }
}

/// Waits for news, and after a while logs what is missing.
pub fn wait(farm: &Farm, wakeups: &Wakeups) -> anyhow::Result<Wakeup> {
    use std::sync::mpsc::RecvTimeoutError::{Disconnected, Timeout};
    match wakeups.recv_timeout(REPORT_WAIT_AFTER) {
        Ok(wakeup) => Ok(wakeup),
        Err(Disconnected) => anyhow::bail!("the farm has ended"),
        Err(Timeout) => {
            let status = farm.status();
            let n_ready = status.nodes.iter().filter(|node| node.is_ready()).count();
            let n_needed = farm.goal().min_renderers.max(1);
            tracing::info!(
                "{n_ready} of {n_needed} render servers are ready, {} connected; start one with: renderer connect {}{}",
                status.nodes.len(),
                farm.address(),
                status.message.map(|message| format!("; last: {message}")).unwrap_or_default()
            );
            Ok(Wakeup::Farm)
        }
    }
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
