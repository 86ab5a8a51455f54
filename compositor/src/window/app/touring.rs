//! Going to views and along camera paths, and keeping them.

use std::{sync::Arc, time::Instant};

use shared::camera::{CameraPath, CameraRecorder, UpAxis};

use super::App;
use crate::control::{
    navigator::Navigator,
    sidecar::{self, SidecarFiles},
};

/// A path that is being recorded.
pub(super) struct Recording {
    since: Instant,
    recorder: CameraRecorder,
}

impl App<'_> {
    /// Changes the camera, or sets it in motion.
    pub(super) fn steer(&mut self, motion: impl FnOnce(&mut Navigator)) {
        let Some(navigator) = &mut self.navigator else { return };
        if !navigator.is_moving() {
            self.stepped_at = Instant::now();
        }
        motion(navigator);
        self.want_picture();
    }

    pub(super) fn show_note(&mut self, note: impl Into<String>) {
        let note = note.into();
        tracing::info!("{note}");
        self.note = Some((note, Instant::now()));
    }

    /// Tells of a problem: on the panel until it is dismissed, and without the panel for a while.
    pub(super) fn show_problem(&mut self, problem: String) {
        if !self.overlay.panel && !self.is_locked {
            self.note = Some((problem.clone(), Instant::now()));
        }
        self.error = Some(problem);
    }

    pub(super) fn go_to_view(&mut self, number: u8) {
        match self.sidecars.as_ref().and_then(SidecarFiles::views).and_then(|views| views.get(number)) {
            Some(camera) => self.steer(|navigator| navigator.go_to(camera)),
            None => self.show_note(format!("There is no view {number}: Ctrl+{number} keeps this one")),
        }
    }

    pub(super) fn keep_view(&mut self, number: u8) {
        let (Some(sidecars), Some(navigator)) = (&mut self.sidecars, &self.navigator) else { return };
        match sidecars.keep_view(number, navigator.destination(), navigator.up()) {
            Ok((file, text)) => {
                self.jobs.add(move || sidecar::write_views(&file, &text).map(|()| None));
                self.show_note(format!("View {number} is kept: key {number} goes there"));
            }
            Err(problem) => self.show_problem(problem),
        }
    }

    pub(super) fn toggle_recording(&mut self) {
        if self.recording.is_some() {
            return self.end_recording();
        }
        let Some(navigator) = &self.navigator else { return };
        self.recording = Some(Recording { since: Instant::now(), recorder: CameraRecorder::new(navigator.camera()) });
        self.show_note("Recording the camera: C ends it");
    }

    fn end_recording(&mut self) {
        let Some(Recording { recorder, .. }) = self.recording.take() else { return };
        let up = self.navigator.as_ref().map_or_else(UpAxis::default, Navigator::up);
        let (Some(path), Some(sidecars)) = (recorder.finish(up), &mut self.sidecars) else {
            return self.show_note("The camera did not move: nothing is recorded");
        };
        let path = Arc::new(path);
        let file = sidecars.keep_path(Arc::clone(&path));
        let note = format!("Camera path of {:.1} s: Space plays it", path.duration_seconds());
        self.jobs.add(move || sidecar::write_path(&file, &path).map(|()| None));
        self.show_note(note);
    }

    /// Notes where the camera is, if its path is recorded.
    pub(super) fn record_camera(&mut self) {
        let (Some(recording), Some(navigator)) = (&mut self.recording, &self.navigator) else { return };
        if !recording.recorder.record(recording.since.elapsed().as_secs_f64(), navigator.camera()) {
            self.end_recording();
        }
    }

    pub(super) fn toggle_playing(&mut self) {
        if self.navigator.as_ref().is_some_and(Navigator::is_playing) {
            return self.steer(Navigator::stop);
        }
        match self.sidecars.as_ref().and_then(SidecarFiles::path) {
            Some(path) => self.play(path, self.kiosk.is_some()),
            None => self.show_note("There is no camera path: C begins to record one"),
        }
    }

    pub(super) fn play(&mut self, path: Arc<CameraPath>, repeats: bool) {
        self.steer(|navigator| navigator.play(path, repeats));
    }

    pub(super) fn change_speed(&mut self, steps: i32) {
        let Some(navigator) = &mut self.navigator else { return };
        let factor = navigator.change_speed(steps);
        self.show_note(format!("Flying {factor:.2} times as fast as usual"));
    }

    /// Somebody is there.
    pub(super) fn touch(&mut self) {
        self.kiosk.iter_mut().for_each(|kiosk| kiosk.touch(Instant::now()));
    }

    /// In a kiosk, goes back to the beginning when everybody has gone; says when that will be.
    pub(super) fn update_kiosk(&mut self, now: Instant) -> Option<Instant> {
        let is_moving = self.navigator.as_ref().is_none_or(Navigator::is_moving);
        let kiosk = self.kiosk.as_mut().filter(|_| self.is_locked && !is_moving)?;
        if !kiosk.returns(now) {
            return kiosk.returns_at();
        }
        match self.sidecars.as_ref().and_then(SidecarFiles::path) {
            Some(path) => self.play(path, true),
            None => self.steer(Navigator::view_all),
        }
        None
    }
}
