//! What is on screen, and what time alone changes of it.

use std::time::{Duration, Instant};

use winit::event_loop::ActiveEventLoop;

use super::App;
use crate::{
    control::{navigator::Navigator, refinement::ShowTimes, sidecar::SidecarFiles},
    farm::stats::DisplayStats,
    overlay::{FrameTimes, OverlayModel},
    supervisor::SupervisorLink,
};

/// The cursor of a fullscreen wall disappears when it has rested for so long.
const CURSOR_REST: Duration = Duration::from_secs(2);
/// While a key to fly is held, the camera moves so often.
const FLY_INTERVAL: Duration = Duration::from_millis(16);
/// Flying with Shift is so much faster.
const FAST: f64 = 4.0;
/// When there is nothing to draw on, a frame that waits is tried again after this.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);
/// The overlay shows what the last frame took after this, unless another frame comes first.
const SETTLE_TIME: Duration = Duration::from_millis(100);
/// A note that needs nobody stays on screen for so long.
const NOTE_LIFE: Duration = Duration::from_secs(8);

impl App<'_> {
    pub(super) fn overlay_is_visible(&self) -> bool {
        self.overlay.is_visible()
    }

    /// Has all windows drawn once everything that has happened is known.
    pub(super) fn redraw(&mut self) {
        self.is_stale = true;
    }

    /// Brings the overlay's figures up to date, and says whether that is worth drawing.
    pub(super) fn overlay_changed(&mut self) -> bool {
        let before = self.overlay.clone();
        self.update_overlay(Instant::now());
        // A ping that took another time is no reason to draw a resting wall again.
        self.overlay_is_visible() && without_pings(before) != without_pings(self.overlay.clone())
    }

    pub(super) fn update_overlay(&mut self, now: Instant) {
        let wanted = self.farm.goal();
        self.note.take_if(|(_, since)| now.duration_since(*since) >= NOTE_LIFE);
        self.overlay.status = self.farm.status();
        self.overlay.division = wanted.division;
        self.overlay.min_renderers = wanted.min_renderers;
        self.overlay.view = self.view;
        self.overlay.rays = self.rays;
        self.overlay.appearance = self.appearance;
        self.overlay.is_refining = self.refinement.is_on();
        let so_far = self.frame.as_ref().map_or(0, |frame| frame.spec.samples.count);
        self.overlay.n_samples = [so_far, self.refinement.n_samples()];
        self.overlay.frame = self.frame.as_ref().map(|frame| frame.stats.clone());
        self.place_pick();
        self.overlay.up = self.navigator.as_ref().map(Navigator::up).unwrap_or_default();
        self.overlay.is_recording = self.recording.is_some();
        self.overlay.is_playing = self.navigator.as_ref().is_some_and(Navigator::is_playing);
        self.overlay.views = self
            .sidecars
            .as_ref()
            .and_then(SidecarFiles::views)
            .map(|views| views.numbers().collect())
            .unwrap_or_default();
        self.overlay.loading = self.loader.progress();
        self.overlay.frames_per_second = self.rate.per_second(now);
        self.overlay.note = self.note.as_ref().map(|(note, _)| note.clone());
        let status = &self.overlay.status;
        let is_dismissed = (&status.message, status.n_lost) == (&self.dismissed.0, self.dismissed.1);
        let farm_message = status.message.clone().filter(|_| !is_dismissed);
        let missing =
            Some(self.outputs.missing()).filter(|missing| !missing.is_empty() && *missing != self.dismissed_missing);
        let missing = missing.map(|missing| {
            format!("Monitor missing: {}. Once connected and switched on it is taken up again", missing.join(", "))
        });
        self.overlay.messages = self.error.clone().into_iter().chain(missing).chain(farm_message).collect();
    }

    /// Says where on the canvas the point is that somebody asked for.
    fn place_pick(&mut self) {
        let pick = self.overlay.pick.zip(self.frame.as_ref());
        self.overlay.pick_on_canvas = pick.and_then(|(pick, frame)| {
            let [x, y] = frame.spec.camera.project(pick.point)?;
            Some(egui::pos2(x as f32, (1.0 - y) as f32))
        });
    }

    pub(super) fn draw(&mut self, event_loop: &ActiveEventLoop) {
        self.is_stale = false;
        self.take_frame();
        self.refresh_pattern();
        self.update_overlay(Instant::now());
        let new_frame = self.frame.as_ref().filter(|_| self.frame_is_new);
        let started_at = Instant::now();
        let drawn = match self.outputs.draw(&self.options.wall, new_frame, &self.overlay) {
            Ok(Some(drawn)) => drawn,
            Ok(None) => {
                self.retry_at = self.frame_is_new.then(|| Instant::now() + RETRY_INTERVAL);
                return;
            }
            Err(error) => return self.fail(event_loop, error),
        };
        self.retry_at = drawn.is_incomplete.then(|| Instant::now() + RETRY_INTERVAL);
        let now = Instant::now();
        self.repaint_at = now.checked_add(drawn.repaint_after);
        self.overlay_areas = drawn.overlay.areas;
        if self.frame_is_new
            && let Some(frame) = &self.frame
        {
            self.frame_is_new = false;
            self.rate.count(now);
            self.supervisor.iter_mut().for_each(SupervisorLink::report_first_frame);
            let latency_ms = now.duration_since(frame.moved_at).as_secs_f64() * 1e3;
            self.overlay.history.add(FrameTimes { render_ms: frame.stats.render_ms, latency_ms });
            let stats = DisplayStats { latency_ms, ..drawn.stats };
            let shown = ShowTimes {
                // What the GPU does after the submission shows in the next draw only if that has to wait for it.
                took: (now - started_at).max(Duration::from_secs_f64(stats.draw_ms / 1e3)),
                upload: Duration::from_secs_f64(stats.upload_ms / 1e3),
                refresh: self.outputs.refresh_interval().unwrap_or_default(),
            };
            self.refinement.on_shown(&frame.spec, &shown);
            tracing::debug!(
                "frame {} is on screen, {latency_ms:.1} ms after the camera{}",
                frame.stats.frame,
                if drawn.monitors.is_empty() {
                    String::new()
                } else {
                    format!(", on {}", drawn.monitors.join(" and "))
                }
            );
            self.overlay.display = Some(stats);
            // What showing it took is known only now.
            self.repaint_at = self.repaint_at.into_iter().chain([now + SETTLE_TIME]).min();
            if (self.on_shown)(frame, &stats).is_break() {
                event_loop.exit();
            }
        }
        for command in drawn.overlay.commands {
            self.execute(event_loop, command);
        }
    }

    /// Does what time has come for, and says when to look again.
    pub(super) fn on_time(&mut self, event_loop: &ActiveEventLoop) -> Option<Instant> {
        let now = Instant::now();
        let mut next: Vec<Instant> = self.update_kiosk(now).into_iter().collect();
        if self.outputs.next_check_at().is_some_and(|next_check_at| now >= next_check_at) {
            self.follow_monitors(event_loop);
        }
        next.extend(self.outputs.next_check_at());
        let speed = if self.modifiers.shift_key() { FAST } else { 1.0 };
        if let Some(navigator) = self.navigator.as_mut().filter(|navigator| navigator.is_moving()) {
            let elapsed = now.duration_since(self.stepped_at);
            if elapsed >= FLY_INTERVAL {
                self.stepped_at = now;
                if navigator.advance(elapsed.as_secs_f64(), speed) {
                    self.want_picture();
                }
            }
            next.push(self.stepped_at + FLY_INTERVAL);
        }
        if let Some(step) = self.refinement.refine(now) {
            tracing::debug!("refining to {}, samples a pixel: {}", step.spec.size, step.spec.samples.count);
            self.farm.update_goal(|wanted| (wanted.spec, wanted.is_refinement) = (Some(step.spec), step.is_refinement));
        }
        next.extend(self.refinement.refines_at());
        if self.outputs.is_filling() && self.outputs.cursor_is_visible() {
            let hide_at = self.cursor_moved_at + CURSOR_REST;
            if now >= hide_at {
                self.outputs.show_cursor(false);
            } else {
                next.push(hide_at);
            }
        }
        let mut moments = vec![self.retry_at];
        if self.overlay_is_visible() {
            let rests_at = self.overlay.frames_per_second.and_then(|_| self.rate.rests_at());
            let note_ends_at = self.overlay.note.as_ref().and(self.note.as_ref()).map(|(_, since)| *since + NOTE_LIFE);
            moments.extend([rests_at, note_ends_at, self.repaint_at]);
        }
        for moment in moments.into_iter().flatten() {
            if now >= moment {
                self.redraw();
            } else {
                next.push(moment);
            }
        }
        next.into_iter().min()
    }
}

fn without_pings(mut model: OverlayModel) -> OverlayModel {
    model.status.nodes.iter_mut().for_each(|node| node.round_trip_ms = None);
    model
}
