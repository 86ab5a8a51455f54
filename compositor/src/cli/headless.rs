//! The wall without a window: renders frames, draws them on an offscreen wall, and reports.

mod film;
mod refined;
mod run;
mod show;

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use renderer::cli::picture_args::SHOWS_NOTHING;
use shared::{division::FrameSize, printable::counted};

use super::report::Report;
use crate::{
    farm::{
        Farm, Frame,
        stats::{DisplayStats, FarmStatus, NodeStatus},
    },
    gpu::{Gpu, GpuError, OffscreenWall, Present, RgbImage},
    wall::Wall,
    window::join_hint,
};

pub use film::{Film, Output, Pictures, Video};
pub(crate) use run::run_headless;

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
    /// The wall's key file, which render servers need to join.
    key_file: Option<PathBuf>,
}

impl Headless {
    /// Finds a GPU and creates the offscreen image.
    pub fn new(wall: Wall) -> anyhow::Result<Self> {
        let gpu = Gpu::headless()?;
        tracing::info!("drawing on {}", gpu.name());
        let offscreen = OffscreenWall::new(&gpu, &wall)?;
        let present = Present::new(&gpu);
        Ok(Self { gpu, present, offscreen, wall, key_file: None })
    }

    /// The same wall with a key file, named where render servers are missing.
    #[must_use]
    pub fn with_key_file(self, key_file: Option<PathBuf>) -> Self {
        Self { key_file, ..self }
    }

    /// Shows `n_frames` of the farm's frames, each once.
    pub fn show_frames(&mut self, farm: &Farm, wakeups: &Wakeups, n_frames: u32) -> anyhow::Result<Report> {
        let mut report = Report::default();
        let mut ended_at = Instant::now();
        while report.n_frames() < n_frames as usize {
            let Some(frame) = self.next_frame(farm, wakeups)? else { break };
            if report.n_frames() == 0 {
                warn_if_blank(&frame);
            }
            let display = self.show(&frame)?;
            report.add(&frame, display, milliseconds(ended_at.elapsed()));
            ended_at = Instant::now();
            tracing::debug!("frame shown: {}", frame.stats.frame);
        }
        Ok(report)
    }

    /// The farm's next frame; `None` once the operator stops the wall.
    fn next_frame(&self, farm: &Farm, wakeups: &Wakeups) -> anyhow::Result<Option<Frame>> {
        loop {
            // Check for a stop before each frame: with a farm faster than the display, the wall never waits.
            if wakeups.try_recv() == Ok(Wakeup::Stop) {
                return Ok(None);
            }
            if let Some(frame) = farm.take_frame() {
                return Ok(Some(frame));
            }
            if wait(farm, wakeups, self.key_file.as_deref())? == Wakeup::Stop {
                return Ok(None);
            }
        }
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

/// Warns of a first frame that shows nothing.
fn warn_if_blank(frame: &Frame) {
    if frame.is_blank() {
        tracing::warn!("{SHOWS_NOTHING}");
    }
}

/// Waits for news, and after a while logs what is missing; render servers need the key file to join, if there is one.
pub fn wait(farm: &Farm, wakeups: &Wakeups, key_file: Option<&Path>) -> anyhow::Result<Wakeup> {
    use std::sync::mpsc::RecvTimeoutError::{Disconnected, Timeout};
    match wakeups.recv_timeout(REPORT_WAIT_AFTER) {
        Ok(wakeup) => Ok(wakeup),
        Err(Disconnected) => anyhow::bail!("the farm has ended"),
        Err(Timeout) => {
            let goal = farm.goal();
            let files = [goal.scene_path.as_deref(), goal.sky_path.as_deref()];
            let join = join_hint(farm.address(), key_file, files);
            tracing::info!("{}", waiting_for(&farm.status(), goal.min_renderers.max(1) as usize, &join.command));
            Ok(Wakeup::Farm)
        }
    }
}

/// The line about a frame that is not there yet: what is missing, and the cure if there is one.
fn waiting_for(status: &FarmStatus, n_needed: usize, join_command: &str) -> String {
    let (n_joined, n_ready) = (status.nodes.len(), status.nodes.iter().filter(|node| node.is_ready()).count());
    let last = status.notices.message().map(|message| format!("; last: {message}")).unwrap_or_default();
    if n_joined < n_needed {
        let needed = counted(n_needed, "render server");
        format!("{n_joined} of {needed} joined; start one with: {join_command}{last}")
    } else if n_ready < n_needed {
        let fetching = status.nodes.iter().filter_map(NodeStatus::transfer);
        let fetching: String =
            fetching.map(|node| format!("; {} fetches the model: {}", node.name, node.transfer)).collect();
        format!("{n_ready} of {} ready{fetching}{last}", counted(n_joined, "render server"))
    } else {
        format!("a frame is being rendered by {}", counted(n_ready, "render server"))
    }
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    use shared::protocol::{SceneState, Transfer};

    use super::*;
    use crate::farm::stats::NodeId;

    #[test]
    fn render_servers_are_asked_for_only_where_some_are_missing() {
        let address = "127.0.0.1:7117".parse().unwrap();
        let command = "renderer connect wall:7117 --model a.ply";
        let node = |scene| NodeStatus {
            id: NodeId(1),
            name: "left".to_owned(),
            address,
            threads: 1,
            scene: Some(scene),
            is_silent: false,
            n_failures: 0,
            round_trip_ms: None,
        };
        let line = |nodes| waiting_for(&FarmStatus { nodes, ..FarmStatus::default() }, 1, command);
        assert_eq!(line(vec![]), format!("0 of 1 render server joined; start one with: {command}"));
        assert_eq!(line(vec![node(SceneState::Loading { progress: 0.5 })]), "0 of 1 render server ready");
        let transfer = Transfer { n_done: 30_000_000, n_bytes: 120_000_000, bytes_per_second: 10_000_000 };
        let fetching = line(vec![node(SceneState::Fetching(transfer))]);
        let told = "0 of 1 render server ready; left fetches the model: 25 % of 120 MB, 10 MB/s, 9 s left";
        assert_eq!(fetching, told);
        let ready = SceneState::Ready { triangles: 1, bytes: 1, grid: None };
        assert_eq!(line(vec![node(ready)]), "a frame is being rendered by 1 render server");
    }
}
