//! Frames whose resolution follows a motion, and then refinement at rest.

use std::time::{Duration, Instant};

use glam::DVec3;
use renderer::cli::progress::Progress;
use shared::protocol::FrameSpec;

use super::{Headless, Wakeups, milliseconds, warn_if_blank};
use crate::{
    cli::report::Report,
    control::refinement::{Refinement, ShowTimes},
    farm::Farm,
};

impl Headless {
    /// Shows `n_frames` as if the camera moved between them, and then refines the last one fully. The report has only the
    /// former.
    pub(crate) fn show_refined(
        &mut self,
        farm: &Farm,
        wakeups: &Wakeups,
        n_frames: u32,
        (spec, fine_bounds): (FrameSpec, Option<(DVec3, DVec3)>),
        refinement: &mut Refinement,
    ) -> anyhow::Result<Report> {
        let mut report = Report::default();
        let is_moving = |report: &Report| report.n_frames() < n_frames as usize;
        let bar = Progress::new("refining the picture");
        let mut ended_at = Instant::now();
        request_frame(farm, refinement.change(ended_at, spec, fine_bounds).spec, true);
        loop {
            if !is_moving(&report) {
                if refinement.is_done() {
                    break;
                }
                // Nobody moves this camera: it is at rest immediately.
                if let Some(step) = refinement.refines_at().and_then(|rested_at| refinement.refine(rested_at)) {
                    tracing::info!("refining to {}, samples a pixel: {}", step.spec.size, step.spec.samples.count);
                    request_frame(farm, step.spec, false);
                }
            }
            let Some(frame) = self.next_frame(farm, wakeups)? else { break };
            refinement.on_frame(&frame.spec, Duration::from_secs_f64(frame.stats.interval_ms / 1e3));
            if report.n_frames() == 0 {
                warn_if_blank(&frame);
            }
            let display = self.show(&frame)?;
            let [took_ms, upload_ms] = [display.upload_ms + display.draw_ms, display.upload_ms];
            let [took, upload] = [took_ms, upload_ms].map(|ms| Duration::from_secs_f64(ms / 1e3));
            refinement.on_shown(&frame.spec, &ShowTimes { took, upload, refresh: Duration::ZERO });
            if !is_moving(&report) {
                bar.set(frame.spec.samples.count as f32 / refinement.n_samples() as f32);
                continue;
            }
            report.add(&frame, display, milliseconds(ended_at.elapsed()));
            ended_at = Instant::now();
            if is_moving(&report) {
                refinement.start_again();
                request_frame(farm, refinement.change(ended_at, spec, fine_bounds).spec, true);
            } else {
                farm.update_goal(|goal| goal.repeat = false);
            }
        }
        Ok(report)
    }
}

fn request_frame(farm: &Farm, spec: FrameSpec, repeat: bool) {
    farm.update_goal(|goal| (goal.spec, goal.repeat, goal.moved_at) = (Some(spec), repeat, Instant::now()));
}
