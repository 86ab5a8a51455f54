//! Shows frames and the overlay, and does what is due at a time.

use std::time::{Duration, Instant};

use shared::{noise::NoiseLimit, scene::SceneId};
use winit::event_loop::ActiveEventLoop;

use super::{App, show::ShowControl};
use crate::{
    control::refinement::ShowTimes,
    farm::{
        Frame,
        stats::{DisplayStats, FarmStatus},
    },
    overlay::{FrameTimes, OverlayModel},
    supervisor::SupervisorLink,
    window::{effect::Effect, frame_rate::FrameRate, outputs::RETRY_INTERVAL},
};

/// The overlay shows the times of the last frame after this, unless another frame comes first.
const SETTLE_TIME: Duration = Duration::from_millis(100);

/// The newest frame, and when to draw.
#[derive(Debug, Default)]
pub(super) struct Presentation {
    pub(super) frame: Option<Frame>,
    /// The frame has yet to be shown.
    pub(super) is_new: bool,
    /// The scene of the last frame on screen.
    pub(super) scene: Option<SceneId>,
    pub(super) is_stale: bool,
    pub(super) rate: FrameRate,
    pub(super) repaint_at: Option<Instant>,
    /// The change that the last frame on screen belongs to.
    pub(super) change: u32,
    /// When the next picture of a fade is due.
    pub(super) fades_at: Option<Instant>,
    /// When to draw again after a window could not be drawn on.
    pub(super) retry_at: Option<Instant>,
}

/// The outcome of drawing all windows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Attempt {
    /// Every window that has pixels shows the picture.
    Complete,
    /// The display of at least one is late.
    Incomplete,
    /// No window has pixels: all are closed, or minimised to nothing.
    Nowhere,
}

impl Presentation {
    /// Draws again a little later what is not on every window yet.
    fn attempted(&mut self, attempt: Attempt, now: Instant) {
        self.retry_at = (attempt == Attempt::Incomplete).then(|| now + RETRY_INTERVAL);
    }
}

/// Whether one of these moments has come, and the first of the others.
pub(super) fn due(moments: &[Option<Instant>], now: Instant) -> (bool, Option<Instant>) {
    let (past, next): (Vec<_>, Vec<_>) = moments.iter().flatten().partition(|&&moment| moment <= now);
    (!past.is_empty(), next.into_iter().copied().min())
}

impl App<'_> {
    /// Draws all windows once the pending events are handled.
    pub(super) fn redraw(&mut self) {
        self.presentation.is_stale = true;
    }

    /// Updates the overlay's model, and returns whether it must be drawn.
    pub(super) fn overlay_changed(&mut self) -> bool {
        self.remote.has_news = true;
        let before = self.overlay.clone();
        self.update_overlay(Instant::now());
        is_seen_change(before, self.overlay.clone())
    }

    fn update_overlay(&mut self, now: Instant) {
        let goal = self.farm.goal();
        let caption = self.show.as_ref().and_then(|show| show.caption(self.free_canvas(), &self.covered_canvas(), now));
        let overlay = &mut self.overlay;
        overlay.status = self.farm.status();
        overlay.division = goal.division;
        overlay.min_renderers = goal.min_renderers;
        overlay.view = self.picture.shading;
        overlay.rays = self.picture.rays;
        overlay.appearance = self.picture.appearance_around(self.camera.up().0);
        overlay.is_refining = self.picture.refinement.is_on();
        let frame = self.presentation.frame.as_ref();
        overlay.n_samples = [frame.map_or(0, |frame| frame.spec.samples.count), self.picture.refinement.n_samples()];
        overlay.has_noise_limit = frame.is_some_and(|frame| frame.spec.samples.noise != NoiseLimit::NONE);
        overlay.frame = frame.map(|frame| frame.stats.clone());
        if let Some((pick, frame)) = overlay.pick.as_mut().zip(frame) {
            pick.distance = (pick.point - frame.spec.camera.eye()).length();
        }
        overlay.pick_on_canvas = overlay.pick.zip(frame).and_then(|(pick, frame)| {
            let [x, y] = frame.spec.camera.project(pick.point)?;
            Some(egui::pos2(x as f32, (1.0 - y) as f32))
        });
        (overlay.up, overlay.up_is_guessed) = self.camera.up();
        overlay.is_recording = self.camera.is_recording();
        overlay.is_playing = self.camera.is_playing();
        overlay.views = self.camera.view_numbers();
        overlay.scene = self.show.as_ref().and_then(|show| {
            let player = &show.player;
            Some((player.shown()?.0 + 1, player.show().scenes.len()))
        });
        overlay.files = self.browser.files.clone();
        overlay.is_aligning = self.wall.has_pattern();
        // A scene to come is read while the present one is shown: that is no news for visitors.
        overlay.loading = self.loader.progress().filter(|_| self.model.is_none() || !self.loader.is_preparing());
        overlay.caption = caption;
        overlay.frames_per_second = self.presentation.rate.per_second(now);
        overlay.note = self.messages.note(now);
        let has_panel = overlay.panel && !overlay.is_aligning;
        let missing = self.outputs.missing();
        // A pattern is covered only by the answer to the hand that aligns; other news come back with the picture.
        let (status, missing) =
            if overlay.is_aligning { (&FarmStatus::default(), &[][..]) } else { (&overlay.status, &*missing) };
        let messages = self.messages.list(status, missing, has_panel, now);
        // Messages are for operators.
        overlay.messages = if self.kiosk.is_locked { Vec::new() } else { messages };
        self.update_marks();
    }

    pub(super) fn draw(&mut self, event_loop: &ActiveEventLoop) {
        self.presentation.is_stale = false;
        self.take_frame();
        self.show_pattern();
        self.update_overlay(Instant::now());
        let started_at = Instant::now();
        if let (Some(painter), Some(show)) = (&mut self.outputs.painter, &self.show) {
            painter.present.set_fade(show.fade_part(started_at));
        }
        self.follow_fade(started_at);
        let fades = self.show.as_ref().is_some_and(ShowControl::fades);
        let change = self.presentation.change;
        let new_frame = self.presentation.frame.as_ref().filter(|_| self.presentation.is_new);
        let new_frame = new_frame.map(|frame| (frame, fades && frame.change != change));
        let drawn = match self.outputs.draw(&self.wall.wall, new_frame, &self.overlay) {
            Ok(Some(drawn)) => drawn,
            // The frame, or the change of the overlay, is still to be shown.
            Ok(None) => {
                let attempt = if self.outputs.is_open() { Attempt::Incomplete } else { Attempt::Nowhere };
                return self.presentation.attempted(attempt, Instant::now());
            }
            Err(error) => return self.fail(event_loop, error),
        };
        let now = Instant::now();
        let attempt = if drawn.is_incomplete { Attempt::Incomplete } else { Attempt::Complete };
        self.presentation.attempted(attempt, now);
        self.presentation.repaint_at = now.checked_add(drawn.repaint_after);
        self.overlay_areas = drawn.overlay.areas;
        self.overlay.marks.places = drawn.overlay.places;
        if self.covered != drawn.overlay.covered {
            self.covered = drawn.overlay.covered;
            // Labels and captions make room.
            self.presentation.is_stale |= !self.overlay.marks.labels.is_empty() || self.overlay.caption.is_some();
        }
        if !drawn.overlay.has_dialog && self.panels != drawn.overlay.panels {
            self.panels = drawn.overlay.panels;
            let effect = self.camera.make_room(&self.free_parts(), now);
            self.apply(effect);
        }
        if std::mem::take(&mut self.presentation.is_new) {
            self.on_new_change(now);
            self.on_new_frame(event_loop, drawn.stats, now - started_at, &drawn.monitors);
        }
        drawn.overlay.draft.into_iter().for_each(|texts| self.type_draft(texts));
        for command in drawn.overlay.commands {
            self.execute(event_loop, command);
        }
    }

    /// A frame has reached the screen: it may be the first of a change.
    fn on_new_change(&mut self, now: Instant) {
        let change = self.presentation.frame.as_ref().map_or(0, |frame| frame.change);
        if std::mem::replace(&mut self.presentation.change, change) != change {
            self.on_change_shown(change, now);
            self.follow_fade(now);
        }
    }

    /// Ends a fade that is over, or has its next picture drawn in time.
    fn follow_fade(&mut self, now: Instant) {
        if let Some(show) = &mut self.show {
            show.end_fade(now);
            self.presentation.fades_at = show.fades_at(now);
        }
    }

    /// Updates the pattern on screen. Once for each redraw: a hand may move faster than patterns are drawn.
    fn show_pattern(&mut self) {
        let Some(shown) = self.wall.take_shown() else { return };
        let Some(painter) = &mut self.outputs.painter else { return };
        let Err(problem) = shown.and_then(|shown| Ok(painter.show_pattern(&shown)?)) else { return };
        self.wall.show(None);
        // Taking a pattern away cannot fail.
        let _ = painter.show_pattern(&[]);
        self.apply(Effect::problem(problem.to_string()));
    }

    /// Accounts for a frame that has just reached the screen.
    fn on_new_frame(&mut self, event_loop: &ActiveEventLoop, stats: DisplayStats, took: Duration, monitors: &[String]) {
        let Some(frame) = &self.presentation.frame else { return };
        let now = Instant::now();
        self.presentation.rate.count(now);
        self.supervisor.iter_mut().for_each(SupervisorLink::report_first_frame);
        let latency_ms = now.duration_since(frame.moved_at).as_secs_f64() * 1e3;
        self.overlay.history.add(FrameTimes { render_ms: frame.stats.render_ms, latency_ms });
        let stats = DisplayStats { latency_ms, ..stats };
        let times = ShowTimes {
            // The wall sees the GPU's work after the submission only if the next draw has to wait for it.
            took: took.max(Duration::from_secs_f64(stats.draw_ms / 1e3)),
            upload: Duration::from_secs_f64(stats.upload_ms / 1e3),
            refresh: self.outputs.refresh_interval().unwrap_or_default(),
        };
        self.picture.refinement.on_shown(&frame.spec, &times);
        let on_monitors = if monitors.is_empty() { String::new() } else { format!(", on {}", monitors.join(" and ")) };
        tracing::debug!("frame {} is on screen, {latency_ms:.1} ms after the camera{on_monitors}", frame.stats.frame);
        self.overlay.display = Some(stats);
        self.remote.on_shown(frame.moved_at);
        let is_first = self.presentation.scene.replace(frame.spec.scene) != Some(frame.spec.scene);
        let is_blank = is_first && frame.is_blank();
        // The times of this frame are known only now.
        self.presentation.repaint_at = self.presentation.repaint_at.into_iter().chain([now + SETTLE_TIME]).min();
        if (self.on_shown)(frame, &stats).is_break() {
            event_loop.exit();
        }
        if is_blank {
            self.apply(Effect::note("The picture shows nothing of the model: F views all of it"));
        }
    }

    /// Does what is due, and returns when to call this again.
    pub(super) fn on_time(&mut self, event_loop: &ActiveEventLoop) -> Option<Instant> {
        let now = Instant::now();
        let mut next: Vec<Option<Instant>> = Vec::new();
        if !self.camera.is_moving() {
            if self.kiosk.returns(now) {
                self.marks.chosen = None;
                let effect = match &mut self.show {
                    Some(show) => {
                        show.player.play(now);
                        Effect::default()
                    }
                    None => self.camera.start_again(&self.free_parts(), now),
                };
                self.apply(effect);
            } else {
                next.push(self.kiosk.returns_at());
            }
        }
        if self.outputs.next_check_at().is_some_and(|next_check_at| now >= next_check_at) {
            self.follow_monitors(event_loop);
        }
        next.push(self.outputs.next_check_at());
        let (has_moved, next_step_at) = self.camera.advance(self.modifiers.shift_key(), now);
        if has_moved {
            self.want_picture();
            self.probe_ahead();
            // A device that is held out as far as it goes says nothing new.
            if self.camera.is_driven() {
                self.kiosk.touch(now);
            }
        }
        next.push(next_step_at);
        if let Some(step) = self.picture.refinement.refine(now) {
            tracing::debug!("refining to {}, {} samples a pixel", step.spec.size, step.spec.samples.count);
            self.farm.update_goal(|goal| (goal.spec, goal.is_refinement) = (Some(step.spec), step.is_refinement));
        }
        next.push(self.picture.refinement.refines_at());
        if self.outputs.is_filling && self.outputs.cursor_is_visible {
            let hides_at = self.pointer.hides_at();
            if now >= hides_at {
                self.outputs.show_cursor(false);
            } else {
                next.push(Some(hides_at));
            }
        }
        next.push(self.advance_show(now));
        let mut redraws = vec![self.presentation.retry_at, self.presentation.fades_at];
        if self.overlay.is_visible() {
            let rests_at = self.overlay.frames_per_second.and_then(|_| self.presentation.rate.rests_at());
            let note_ends_at = self.overlay.note.as_ref().and_then(|_| self.messages.note_ends_at());
            let has_messages = !self.overlay.messages.is_empty();
            let news_end_at = self.messages.news_end_at().filter(|_| has_messages);
            redraws.extend([rests_at, note_ends_at, news_end_at, self.presentation.repaint_at]);
        }
        let (is_due, next_redraw_at) = due(&redraws, now);
        if is_due {
            self.redraw();
        }
        next.push(next_redraw_at);
        next.push(self.tell_remotes(now));
        next.into_iter().flatten().min()
    }
}

/// Whether a change of the overlay is to be drawn. A new round-trip time alone does not redraw a resting wall.
fn is_seen_change(before: OverlayModel, now: OverlayModel) -> bool {
    let is_seen = before.is_visible() || now.is_visible();
    is_seen && without_pings(before) != without_pings(now)
}

fn without_pings(mut model: OverlayModel) -> OverlayModel {
    model.status.nodes.iter_mut().for_each(|node| node.round_trip_ms = None);
    model
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        farm::stats::{FarmStatus, NodeId, NodeStatus},
        overlay::{FileEntry, FileList},
    };

    #[test]
    fn a_window_whose_display_is_late_is_drawn_again_and_a_minimised_wall_is_not() {
        let start = Instant::now();
        let mut presentation = Presentation::default();
        let retries_after =
            |presentation: &Presentation, passed: Duration| due(&[presentation.retry_at], start + passed);
        presentation.attempted(Attempt::Incomplete, start);
        let too_early = RETRY_INTERVAL - Duration::from_millis(1);
        assert_eq!(retries_after(&presentation, too_early), (false, Some(start + RETRY_INTERVAL)));
        assert_eq!(retries_after(&presentation, RETRY_INTERVAL), (true, None));
        for ended in [Attempt::Complete, Attempt::Nowhere] {
            presentation.attempted(Attempt::Incomplete, start);
            presentation.attempted(ended, start);
            assert_eq!(retries_after(&presentation, RETRY_INTERVAL), (false, None), "{ended:?}");
        }
    }

    #[test]
    fn the_end_of_a_listing_is_drawn_and_a_round_trip_time_is_not() {
        let looking = FileList { is_loading: true, ..FileList::default() };
        let entries = vec![FileEntry { name: "a.ply".to_owned(), bytes: Some(1) }];
        let listed = FileList { entries, ..FileList::default() };
        let with = |files: &FileList| OverlayModel { files: Some(files.clone()), ..OverlayModel::default() };
        assert!(is_seen_change(with(&looking), with(&listed)));
        assert!(is_seen_change(with(&looking), with(&FileList::default())), "an empty folder is no longer looked into");
        assert!(is_seen_change(with(&listed), OverlayModel::default()), "a list that is closed leaves the screen");
        let node = |round_trip_ms| NodeStatus {
            id: NodeId(1),
            name: "left".to_owned(),
            address: ([127, 0, 0, 1], 1).into(),
            threads: 1,
            scene: None,
            is_silent: false,
            n_failures: 0,
            round_trip_ms,
        };
        let pinged = |ms, panel| OverlayModel {
            panel,
            status: FarmStatus { nodes: vec![node(ms)], ..FarmStatus::default() },
            ..OverlayModel::default()
        };
        assert!(!is_seen_change(pinged(None, true), pinged(Some(0.5), true)));
        assert!(!is_seen_change(OverlayModel::default(), pinged(None, false)), "a hidden overlay is not drawn");
    }
}
