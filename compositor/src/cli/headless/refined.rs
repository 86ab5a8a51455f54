//! Frames whose resolution follows a motion, and then the picture of a camera at rest.

use std::time::{Duration, Instant};

use renderer::cli::progress::Progress;
use shared::protocol::Picture;

use super::{Headless, Wakeup, Wakeups, milliseconds, wait};
use crate::{
    cli::report::Report,
    control::refinement::{Refinement, Shown},
    farm::Farm,
};

impl Headless {
    /// Shows `n_frames` as if the camera moved from each to the next, and then the same picture as fine as it gets. The
    /// report has the former only.
    pub fn show_refined(
        &mut self,
        farm: &Farm,
        wakeups: &Wakeups,
        n_frames: u32,
        subject: Picture,
        refinement: &mut Refinement,
    ) -> anyhow::Result<Report> {
        let mut report = Report::default();
        let is_moving = |report: &Report| report.n_frames() < n_frames as usize;
        let bar = Progress::new("refining the picture");
        let mut ended_at = Instant::now();
        want(farm, refinement.change(ended_at, subject).picture, true);
        loop {
            if !is_moving(&report) {
                if refinement.is_done() {
                    break;
                }
                // Nobody's hand is on this camera: it rests at once.
                if let Some(ask) = refinement.refines_at().and_then(|rested_at| refinement.refine(rested_at)) {
                    tracing::info!("refining to {}, samples a pixel: {}", ask.picture.size, ask.picture.samples.count);
                    want(farm, ask.picture, false);
                }
            }
            if wakeups.try_recv() == Ok(Wakeup::Stop) {
                break;
            }
            let Some(frame) = farm.take_frame() else {
                if wait(farm, wakeups)? == Wakeup::Stop {
                    break;
                }
                continue;
            };
            refinement.on_frame(&frame.picture, Duration::from_secs_f64(frame.stats.interval_ms / 1e3));
            let display = self.show(&frame)?;
            let [took_ms, upload_ms] = [display.upload_ms + display.draw_ms, display.upload_ms];
            let [took, upload] = [took_ms, upload_ms].map(|ms| Duration::from_secs_f64(ms / 1e3));
            refinement.on_shown(&frame.picture, &Shown { took, upload, refresh: Duration::ZERO });
            if !is_moving(&report) {
                bar.set(frame.picture.samples.count as f32 / refinement.n_samples() as f32);
                continue;
            }
            report.add(Some(&frame), display, milliseconds(ended_at.elapsed()));
            ended_at = Instant::now();
            if is_moving(&report) {
                refinement.start_again();
                want(farm, refinement.change(ended_at, subject).picture, true);
            } else {
                farm.want(|wanted| wanted.repeat = false);
            }
        }
        Ok(report)
    }
}

fn want(farm: &Farm, picture: Picture, repeat: bool) {
    farm.want(|wanted| (wanted.picture, wanted.repeat, wanted.moved_at) = (Some(picture), repeat, Instant::now()));
}
