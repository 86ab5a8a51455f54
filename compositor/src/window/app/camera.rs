//! The camera: steered by hand, sent to kept views, recorded, and moved along paths. Pure: time is an argument.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use shared::camera::{Camera, CameraPath, CameraRecorder, CanvasPart, Look, UpAxis, View};

use crate::{
    control::{
        drive::Drive,
        input::Direction,
        model::Model,
        navigator::Navigator,
        show::Cue,
        sidecar::{self, SidecarFiles},
    },
    wall::Wall,
    window::effect::Effect,
};

/// The time between two steps of a camera that moves by itself.
const STEP_INTERVAL: Duration = Duration::from_millis(16);
/// Shift multiplies the speed of flying by this.
const FAST: f64 = 4.0;

/// The camera on the current model, and the model's views and path.
pub(super) struct CameraControl {
    /// `None` until the first model is loaded.
    pub(super) navigator: Option<Navigator>,
    pub(super) sidecars: Option<SidecarFiles>,
    recording: Option<Recording>,
    /// When time last moved the camera.
    stepped_at: Instant,
    aspect: f64,
    /// The axis of the options, until the first model is shown.
    up: Option<UpAxis>,
    /// The axis that points up by the model's shape alone.
    guessed_up: Option<UpAxis>,
    first_camera: Option<Camera>,
    first_path: Option<CameraPath>,
}

struct Recording {
    since: Instant,
    recorder: CameraRecorder,
}

impl CameraControl {
    /// A camera for this wall, whose first model is seen by the axis, and from the camera or along the path, of the options.
    pub(super) fn new(
        up: Option<UpAxis>,
        wall: &Wall,
        (first_camera, first_path): (Option<Camera>, Option<CameraPath>),
        now: Instant,
    ) -> Self {
        Self {
            navigator: None,
            sidecars: None,
            recording: None,
            stepped_at: now,
            aspect: wall.aspect(),
            up,
            guessed_up: None,
            first_camera,
            first_path,
        }
    }

    pub(super) fn is_recording(&self) -> bool {
        self.recording.is_some()
    }

    /// Whether time moves the camera; true before the first model.
    pub(super) fn is_moving(&self) -> bool {
        self.navigator.as_ref().is_none_or(Navigator::is_moving)
    }

    pub(super) fn is_playing(&self) -> bool {
        self.navigator.as_ref().is_some_and(Navigator::is_playing)
    }

    pub(super) fn has_path(&self) -> bool {
        self.sidecars.as_ref().is_some_and(|sidecars| sidecars.path().is_some())
    }

    pub(super) fn is_dragging(&self) -> bool {
        self.navigator.as_ref().is_some_and(Navigator::is_dragging)
    }

    pub(super) fn view_numbers(&self) -> Vec<u8> {
        let views = self.sidecars.as_ref().and_then(SidecarFiles::views);
        views.map(|views| views.numbers().collect()).unwrap_or_default()
    }

    /// Shows a model: the first by the axis, and from the camera or along the path, of the options; others as a whole, in
    /// the free `parts` of the canvas.
    pub(super) fn set_model(
        &mut self,
        model: &Model,
        sidecars: SidecarFiles,
        parts: &[CanvasPart],
        now: Instant,
    ) -> Effect {
        let known_up = self.up.take().or_else(|| sidecars.views().and_then(|views| views.up));
        let up = known_up.unwrap_or(model.shape.up);
        self.guessed_up = known_up.is_none().then_some(up);
        self.recording = None;
        let sidecars = self.sidecars.insert(sidecars);
        if let Some(navigator) = &mut self.navigator {
            navigator.set_model(model.shape.clone(), up, parts);
            return Effect::picture();
        }
        let navigator = self.navigator.insert(Navigator::new(model.shape.clone(), up, self.aspect));
        // A panel may be there before the model, and stay as it is.
        navigator.make_room(parts);
        self.first_camera.into_iter().for_each(|camera| navigator.set_camera(camera));
        let Some(path) = self.first_path.take().map(Arc::new) else { return Effect::picture() };
        sidecars.keep_path(Arc::clone(&path));
        self.play(path, true, now)
    }

    /// Shows the model of a scene of a show at once, from its camera; its path waits for [`CameraControl::begin_path`].
    pub(super) fn enter(&mut self, cue: &Cue, is_same_model: bool, parts: &[CanvasPart]) {
        (self.recording, self.guessed_up, self.up) = (None, None, None);
        // Views may have been kept since those of the scene were read.
        if !is_same_model || self.sidecars.is_none() {
            self.sidecars = Some(cue.sidecars.clone());
        }
        let new = || Navigator::new(cue.model.shape.clone(), cue.up, self.aspect);
        let navigator = self.navigator.get_or_insert_with(new);
        navigator.set_model(cue.model.shape.clone(), cue.up, parts);
        cue.camera.into_iter().for_each(|camera| navigator.set_camera(camera));
    }

    /// Begins the camera path of a scene.
    pub(super) fn begin_path(&mut self, path: Arc<CameraPath>, repeats: bool, now: Instant) {
        let _ = self.play(path, repeats, now);
    }

    /// The model's present view, for a scene of a show.
    pub(super) fn present_view(&self) -> Option<(Camera, UpAxis)> {
        self.navigator.as_ref().map(|navigator| (navigator.destination_without_panels(), navigator.up()))
    }

    /// Moves the camera, or sets it in motion; a note tells another up axis.
    pub(super) fn steer(&mut self, now: Instant, motion: impl FnOnce(&mut Navigator)) -> Effect {
        let Some(navigator) = &mut self.navigator else { return Effect::default() };
        if !navigator.is_moving() {
            self.stepped_at = now;
        }
        let up_before = navigator.up();
        motion(navigator);
        let up = navigator.up();
        if up == up_before { Effect::picture() } else { Effect::picture().with_note(format!("Up: {up}")) }
    }

    /// Flies in a direction from when its key goes down until it goes up.
    pub(super) fn fly(&mut self, direction: Direction, is_pressed: bool, now: Instant) {
        let Some(navigator) = &mut self.navigator else { return };
        if !is_pressed {
            return navigator.release_key(direction);
        }
        if !navigator.is_moving() {
            self.stepped_at = now;
        }
        navigator.hold(direction);
    }

    /// Moves as devices are held out from now on.
    pub(super) fn drive(&mut self, drive: Drive, now: Instant) {
        let Some(navigator) = &mut self.navigator else { return };
        if !navigator.is_moving() {
            self.stepped_at = now;
        }
        navigator.set_drive(drive);
    }

    /// Whether devices are held out.
    pub(super) fn is_driven(&self) -> bool {
        self.navigator.as_ref().is_some_and(Navigator::is_driven)
    }

    /// Lets time move the camera. Returns whether it moved, and when to call this again.
    pub(super) fn advance(&mut self, is_fast: bool, now: Instant) -> (bool, Option<Instant>) {
        let Some(navigator) = self.navigator.as_mut().filter(|navigator| navigator.is_moving()) else {
            return (false, None);
        };
        let elapsed = now.duration_since(self.stepped_at);
        let is_due = elapsed >= STEP_INTERVAL;
        if is_due {
            self.stepped_at = now;
        }
        let has_moved = is_due && navigator.advance(elapsed.as_secs_f64(), if is_fast { FAST } else { 1.0 });
        (has_moved, Some(self.stepped_at + STEP_INTERVAL))
    }

    pub(super) fn change_speed(&mut self, steps: i32) -> Effect {
        let factor = self.navigator.as_mut().map(|navigator| navigator.change_speed(steps));
        factor.map_or_else(Effect::default, |factor| Effect::note(format!("Flying speed: {factor:.2}×")))
    }

    pub(super) fn view(&self, number: u8) -> Option<View> {
        self.sidecars.as_ref().and_then(SidecarFiles::views).and_then(|views| views.get(number))
    }

    pub(super) fn go_to_view(&mut self, number: u8, parts: &[CanvasPart], now: Instant) -> Effect {
        match self.view(number) {
            Some(View { camera, up, .. }) => self.steer(now, |navigator| navigator.go_to_view(camera, up, parts)),
            None => Effect::note(format!("There is no view {number}: Ctrl+{number} keeps the current view")),
        }
    }

    pub(super) fn keep_view(&mut self, number: u8, look: Look) -> Effect {
        let (Some(sidecars), Some(navigator)) = (&mut self.sidecars, &self.navigator) else { return Effect::default() };
        let view = View { camera: navigator.destination_without_panels(), up: Some(navigator.up()), look: Some(look) };
        match sidecars.keep_view(number, view) {
            Ok((file, text)) => Effect::job(move || sidecar::write_views(&file, &text).map(|()| Effect::default()))
                .with_note(format!("View {number} is kept: key {number} goes there")),
            Err(problem) => Effect::problem(problem),
        }
    }

    pub(super) fn toggle_recording(&mut self, now: Instant) -> Effect {
        if let Some(Recording { recorder, .. }) = self.recording.take() {
            return self.end_recording(recorder);
        }
        let Some(navigator) = &self.navigator else { return Effect::default() };
        self.recording =
            Some(Recording { since: now, recorder: CameraRecorder::new(navigator.camera_without_panels()) });
        Effect::note("Recording the camera: C ends it")
    }

    /// Adds the camera to the recording, if there is one; ends it when it is full.
    pub(super) fn record(&mut self, now: Instant) -> Effect {
        let Some(navigator) = &self.navigator else { return Effect::default() };
        let is_full = |recording: &mut Recording| {
            !recording
                .recorder
                .record(now.duration_since(recording.since).as_secs_f64(), navigator.camera_without_panels())
        };
        match self.recording.take_if(is_full) {
            Some(Recording { recorder, .. }) => self.end_recording(recorder),
            None => Effect::default(),
        }
    }

    fn end_recording(&mut self, recorder: CameraRecorder) -> Effect {
        let up = self.navigator.as_ref().map_or_else(UpAxis::default, Navigator::up);
        let (Some(path), Some(sidecars)) = (recorder.finish(up), &mut self.sidecars) else {
            return Effect::note("The camera did not move: no path is recorded");
        };
        let path = Arc::new(path);
        let file = sidecars.keep_path(Arc::clone(&path));
        let note = format!("Camera path of {:.1} s: Space plays it", path.duration_seconds());
        Effect::job(move || sidecar::write_path(&file, &path).map(|()| Effect::default())).with_note(note)
    }

    pub(super) fn toggle_playing(&mut self, repeats: bool, now: Instant) -> Effect {
        if self.is_playing() {
            return self.steer(now, Navigator::stop);
        }
        match self.sidecars.as_ref().and_then(SidecarFiles::path) {
            Some(path) => self.play(path, repeats, now),
            None => Effect::note("There is no camera path: C starts to record one"),
        }
    }

    /// The axis that points up, and whether it is only guessed.
    pub(super) fn up(&self) -> (UpAxis, bool) {
        let up = self.navigator.as_ref().map(Navigator::up).unwrap_or_default();
        (up, self.guessed_up == Some(up))
    }

    /// Keeps a whole model, or a kept view, that nobody has moved since, out of the way of panels.
    pub(super) fn make_room(&mut self, parts: &[CanvasPart], now: Instant) -> Effect {
        let before = self.navigator.as_ref().map(Navigator::camera);
        let effect = self.steer(now, |navigator| navigator.make_room(parts));
        if self.navigator.as_ref().map(Navigator::camera) == before { Effect::default() } else { effect }
    }

    /// Returns to the beginning: plays the model's path repeatedly, or shows the whole model.
    pub(super) fn start_again(&mut self, parts: &[CanvasPart], now: Instant) -> Effect {
        match self.sidecars.as_ref().and_then(SidecarFiles::path) {
            Some(path) => self.play(path, true, now),
            None => self.steer(now, |navigator| navigator.view_all(parts)),
        }
    }

    fn play(&mut self, path: Arc<CameraPath>, repeats: bool, now: Instant) -> Effect {
        self.steer(now, |navigator| navigator.play(path, repeats))
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3};
    use renderer::model::scene::SceneSource;
    use shared::camera::Shape;

    use super::*;
    use crate::control::navigator::Drag;

    fn cube() -> Model {
        let statue = SceneSource::Statue { triangles: 8 };
        Model {
            source: SceneSource::File("/no/such/folder/cube.ply".into()),
            scene: renderer::model::scene::load(&statue, Default::default(), &|_| {}).unwrap().id,
            shape: Shape::of_box(DVec3::ZERO, DVec3::ONE),
            n_triangles: 12,
            is_solid: true,
            found: Vec::new(),
            left_out: Vec::new(),
        }
    }

    fn show(control: &mut CameraControl, model: &Model, parts: &[CanvasPart], now: Instant) {
        assert!(control.set_model(model, SidecarFiles::read(&model.source), parts, now).wants_picture);
    }

    /// A camera without a model.
    fn unused(now: Instant) -> CameraControl {
        CameraControl {
            navigator: None,
            sidecars: None,
            recording: None,
            stepped_at: now,
            aspect: 1.5,
            up: None,
            guessed_up: None,
            first_camera: None,
            first_path: None,
        }
    }

    fn camera_on_a_cube(now: Instant) -> CameraControl {
        let mut control = unused(now);
        show(&mut control, &cube(), &[], now);
        control
    }

    #[test]
    fn another_model_opens_as_a_whole_beside_panels_whatever_the_first_was_told() {
        let now = Instant::now();
        let camera = Camera::look_at(DVec3::splat(9.0), DVec3::ONE, DVec3::Z, 0.7, 1.5).unwrap();
        let mut control = CameraControl { up: Some(UpAxis::Z), first_camera: Some(camera), ..unused(now) };
        let left = CanvasPart { max: DVec2::new(0.5, 1.0), ..CanvasPart::WHOLE };
        show(&mut control, &cube(), &[left], now);
        assert_eq!((control.up().0, control.navigator.as_ref().unwrap().camera()), (UpAxis::Z, camera));
        let whole = |model: &Model| Camera::view_all(&model.shape, model.shape.up, 1.5, left);
        let mut alone = unused(now);
        show(&mut alone, &cube(), &[left], now);
        assert_eq!(alone.navigator.as_ref().unwrap().camera(), whole(&cube()));
        let other = Model { shape: Shape::of_box(DVec3::splat(5.0), DVec3::splat(9.0)), ..cube() };
        show(&mut control, &other, &[left], now);
        assert_eq!(control.up(), (other.shape.up, true));
        assert_eq!(control.navigator.as_ref().unwrap().camera(), whole(&other));
    }

    #[test]
    fn a_held_key_flies_step_by_step_and_shift_flies_faster() {
        let start = Instant::now();
        let eye_after_a_step = |is_fast| {
            let mut control = camera_on_a_cube(start);
            control.fly(Direction::Forward, true, start);
            assert_eq!(control.advance(is_fast, start), (false, Some(start + STEP_INTERVAL)));
            let (has_moved, next) = control.advance(is_fast, start + STEP_INTERVAL);
            assert!(has_moved && next == Some(start + 2 * STEP_INTERVAL));
            control.fly(Direction::Forward, false, start);
            assert_eq!(control.advance(is_fast, start + 3 * STEP_INTERVAL), (false, None));
            control.navigator.as_ref().unwrap().camera().eye()
        };
        let eye = camera_on_a_cube(start).navigator.unwrap().camera().eye();
        let [slow, fast] = [false, true].map(|is_fast| (eye_after_a_step(is_fast) - eye).length());
        assert!((fast / slow - FAST).abs() < 1e-6, "{slow} {fast}");
    }

    #[test]
    fn a_recorded_path_can_be_played() {
        let start = Instant::now();
        let mut control = camera_on_a_cube(start);
        assert!(control.toggle_playing(false, start).note.is_some(), "there is no path yet");
        control.toggle_recording(start);
        assert!(control.is_recording());
        control.navigator.as_mut().unwrap().press(Drag::Orbit);
        control.navigator.as_mut().unwrap().move_to(DVec2::new(0.7, 0.5));
        control.record(start + Duration::from_secs(1));
        let effect = control.toggle_recording(start + Duration::from_secs(1));
        assert!(effect.job.is_some() && effect.note.is_some() && !control.is_recording());
        assert!(control.toggle_playing(false, start).wants_picture && control.is_playing());
        assert!(control.toggle_playing(false, start).wants_picture && !control.is_playing());
    }

    #[test]
    fn views_are_kept_and_found_again() {
        let start = Instant::now();
        let mut control = camera_on_a_cube(start);
        assert!(control.go_to_view(3, &[], start).note.unwrap().contains("Ctrl+3"));
        assert!(control.keep_view(3, Look::default()).job.is_some());
        assert_eq!(control.view_numbers(), [3]);
        assert!(control.go_to_view(3, &[], start).wants_picture);
        let effect = control.steer(start, |navigator| navigator.next_up_axis(&[CanvasPart::WHOLE]));
        assert_eq!((effect.note, control.up()), (Some("Up: z".to_owned()), (UpAxis::Z, false)));
        let effect = control.go_to_view(3, &[], start);
        assert_eq!(control.up(), (UpAxis::Y, true), "a view has its own axis");
        assert_eq!(effect.note.as_deref(), Some("Up: y"), "the note on screen is still of the old axis");
        assert_eq!(control.go_to_view(3, &[], start).note, None);
        assert_eq!(control.view(3).unwrap().look, Some(Look::default()));
    }

    #[test]
    fn a_whole_model_makes_room_for_panels_until_it_is_moved() {
        let start = Instant::now();
        let mut control = camera_on_a_cube(start);
        let left = [CanvasPart { max: DVec2::new(0.5, 1.0), ..CanvasPart::WHOLE }];
        let middle = |control: &CameraControl| {
            DVec2::from(control.navigator.as_ref().unwrap().camera().project(DVec3::splat(0.5)).unwrap())
        };
        assert!(control.make_room(&left, start).wants_picture && middle(&control).x < 0.3);
        assert!(!control.make_room(&left, start).wants_picture, "there is room already");
        control.steer(start, |navigator| _ = navigator.wheel(1.0));
        assert!(!control.make_room(&[CanvasPart::WHOLE], start).wants_picture, "a hand has moved it");
        control.steer(start, |navigator| navigator.view_all(&[CanvasPart::WHOLE]));
        control.navigator.as_mut().unwrap().advance(1.0, 1.0);
        assert!((middle(&control).x - 0.5).abs() < 0.05);
    }
}
