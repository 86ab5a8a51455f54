//! What happens in the window: events in, wishes to the farm and pictures out.

use std::{
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};

use glam::DVec2;
use renderer::scene::SceneSource;
use shared::{
    division::Division,
    protocol::{Picture, SampleRange, View},
};
use winit::{
    application::ApplicationHandler,
    dpi::{PhysicalPosition, PhysicalSize},
    event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, WindowEvent},
    event_loop::{ActiveEventLoop, ControlFlow},
    keyboard::ModifiersState,
    window::{Fullscreen, Window, WindowId},
};

use super::{
    OnShown, Waker, WindowOptions,
    frame_rate::FrameRate,
    join_hint,
    model_loader::{ModelLoader, name_of},
    screen::Screen,
    screenshots::Screenshots,
};
use crate::{
    farm::{Farm, Frame},
    input::{self, Action, Command, Drag, Key, Navigator},
    model::Model,
    overlay::{ModelSummary, OverlayModel},
    screensaver::ScreensaverHold,
    stats::{DisplayStats, FarmStatus},
    wall::PixelRect,
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
/// Pixels that a touchpad scrolls for what a wheel does with one notch.
const PIXELS_PER_NOTCH: f64 = 50.0;

/// The window's state.
pub(super) struct App<'a> {
    options: WindowOptions,
    farm: &'a Farm,
    on_shown: OnShown,
    outcome: anyhow::Result<()>,
    screen: Option<Screen>,

    loader: ModelLoader,
    model: Option<Model>,
    navigator: Option<Navigator>,
    view: View,
    screenshots: Screenshots,

    overlay: OverlayModel,
    overlay_areas: Vec<egui::Rect>,
    error: Option<String>,
    dismissed: Option<String>,
    note: Option<(String, Instant)>,

    /// The newest frame, and whether it has yet to be shown.
    frame: Option<Frame>,
    frame_is_new: bool,
    rate: FrameRate,

    cursor: PhysicalPosition<f64>,
    cursor_moved_at: Instant,
    cursor_is_visible: bool,
    modifiers: ModifiersState,
    flown_at: Instant,
    screensaver: Option<ScreensaverHold>,
    repaint_at: Option<Instant>,
}

impl<'a> App<'a> {
    pub(super) fn new(options: WindowOptions, farm: &'a Farm, on_shown: OnShown, waker: Waker) -> Self {
        let now = Instant::now();
        let overlay = OverlayModel {
            panel: options.overlay,
            join: join_hint(farm.address(), None),
            min_renderers: farm.wanted().min_renderers,
            ..Default::default()
        };
        let mut loader = ModelLoader::new(waker.clone());
        loader.load(options.source.clone());
        Self {
            screenshots: Screenshots::new(options.screenshot_folder.clone(), waker),
            farm,
            on_shown,
            outcome: Ok(()),
            screen: None,
            loader,
            model: None,
            navigator: None,
            view: options.view,
            overlay,
            overlay_areas: Vec::new(),
            error: None,
            dismissed: None,
            note: None,
            frame: None,
            frame_is_new: false,
            rate: FrameRate::default(),
            cursor: PhysicalPosition::default(),
            cursor_moved_at: now,
            cursor_is_visible: true,
            modifiers: ModifiersState::empty(),
            flown_at: now,
            screensaver: None,
            repaint_at: None,
            options,
        }
    }

    pub(super) fn into_outcome(self) -> anyhow::Result<()> {
        self.outcome
    }

    fn fail(&mut self, event_loop: &ActiveEventLoop, error: impl Into<anyhow::Error>) {
        self.outcome = Err(error.into());
        event_loop.exit();
    }

    fn open(&mut self, event_loop: &ActiveEventLoop) -> anyhow::Result<Screen> {
        let [width, height] = self.options.wall.output_size();
        let monitor = event_loop.primary_monitor().or_else(|| event_loop.available_monitors().next());
        // A window that leaves room for the desktop around it.
        let room = monitor.map_or([1280, 720], |monitor| [monitor.size().width / 5 * 4, monitor.size().height / 5 * 4]);
        let fitted = PixelRect::fitted([width, height], [room[0].min(width), room[1].min(height)]);
        let attributes = Window::default_attributes()
            .with_title("Raywall")
            .with_inner_size(PhysicalSize::new(fitted.width, fitted.height))
            .with_min_inner_size(PhysicalSize::new(320, 180));
        let screen = Screen::new(event_loop.create_window(attributes)?)?;
        if self.options.fullscreen {
            self.set_fullscreen(&screen.window, true);
        }
        screen.window.request_redraw();
        Ok(screen)
    }

    // What other threads have for the window.

    fn look_around(&mut self, event_loop: &ActiveEventLoop) {
        while let Some(outcome) = self.loader.poll() {
            match outcome {
                Ok(model) => self.show_model(model),
                Err(problem) if self.model.is_none() => return self.fail(event_loop, anyhow::anyhow!(problem)),
                Err(problem) => {
                    tracing::error!("{problem}");
                    self.error = Some(problem);
                }
            }
        }
        while let Some(outcome) = self.screenshots.poll() {
            match outcome {
                Ok(note) => {
                    tracing::info!("{note}");
                    self.note = Some((note, Instant::now()));
                }
                Err(problem) => {
                    tracing::error!("{problem}");
                    self.error = Some(problem);
                }
            }
        }
        self.take_frame();
        let before = self.overlay.clone();
        self.update_overlay(Instant::now());
        // A ping that took another time is no reason to draw a resting wall again.
        if self.frame_is_new || (self.overlay_is_visible() && without_pings(&before) != without_pings(&self.overlay)) {
            self.redraw();
        }
    }

    fn show_model(&mut self, model: Model) {
        let name = name_of(&model.source);
        tracing::info!("showing {name}: {} triangles", model.n_triangles);
        match &mut self.navigator {
            Some(navigator) => navigator.set_bounds(model.bounds),
            None => {
                let navigator = Navigator::new(model.bounds, self.options.up, self.options.wall.aspect());
                self.navigator = Some(match self.options.camera {
                    Some(camera) => navigator.with_camera(camera),
                    None => navigator,
                });
            }
        }
        self.overlay.model =
            Some(ModelSummary { name: name.clone(), n_triangles: model.n_triangles, n_rejected: model.n_rejected });
        if let Some(screen) = &self.screen {
            screen.window.set_title(&format!("{name} – Raywall"));
        }
        self.overlay.join = join_hint(self.farm.address(), model.path().as_deref());
        self.error = None;
        self.model = Some(model);
        self.want_picture();
    }

    fn take_frame(&mut self) {
        // One that is still to be shown keeps the next waiting: each is shown once.
        if !self.frame_is_new
            && let Some(frame) = self.farm.take_frame()
        {
            self.frame = Some(frame);
            self.frame_is_new = true;
        }
    }

    fn want_picture(&self) {
        let (Some(model), Some(navigator)) = (&self.model, &self.navigator) else { return };
        let picture = Picture {
            scene: model.scene,
            camera: navigator.camera(),
            size: self.options.size,
            view: self.view,
            samples: SampleRange::CENTRE,
        };
        self.farm.want(|wanted| {
            wanted.picture = Some(picture);
            wanted.scene_path = model.path();
            wanted.moved_at = Instant::now();
        });
    }

    // What a person does.

    fn key(&mut self, event_loop: &ActiveEventLoop, event: &KeyEvent) {
        let pressed = event.state == ElementState::Pressed;
        // A key that was pressed before Ctrl is let go as the key that it was.
        let Some(key) = Key::from_winit(&event.logical_key, pressed && self.modifiers.control_key()) else { return };
        match input::action(key) {
            Some(Action::Fly(direction)) => {
                let Some(navigator) = &mut self.navigator else { return };
                if !pressed {
                    navigator.let_go(direction);
                } else if !event.repeat {
                    if !navigator.is_flying() {
                        self.flown_at = Instant::now();
                    }
                    navigator.hold(direction);
                }
            }
            Some(Action::Ask(command)) if pressed && !event.repeat => self.obey(event_loop, command),
            _ => {}
        }
    }

    fn obey(&mut self, event_loop: &ActiveEventLoop, command: Command) {
        match command {
            Command::ViewAll => self.steer(Navigator::view_all),
            Command::NextUpAxis => self.steer(Navigator::next_up_axis),
            Command::NextDivision => self.set_division(next(&Division::ALL, self.farm.wanted().division)),
            Command::SetDivision(division) => self.set_division(division),
            Command::NextView => self.set_view(next(&View::ALL, self.view)),
            Command::SetView(view) => self.set_view(view),
            Command::ToggleOverlay => self.overlay.panel = !self.overlay.panel,
            Command::ToggleHelp => self.overlay.help = !self.overlay.help,
            Command::ToggleFullscreen | Command::LeaveFullscreen => {
                if let Some(window) = self.screen.as_ref().map(|screen| Arc::clone(&screen.window)) {
                    let fill = command == Command::ToggleFullscreen && window.fullscreen().is_none();
                    self.set_fullscreen(&window, fill);
                }
            }
            Command::Screenshot => self.take_screenshot(),
            Command::DismissMessage => {
                self.error = None;
                self.note = None;
                self.dismissed = self.farm.status().message;
            }
            Command::Quit => event_loop.exit(),
        }
        self.redraw();
    }

    fn steer(&mut self, motion: fn(&mut Navigator)) {
        if let Some(navigator) = &mut self.navigator {
            motion(navigator);
            self.want_picture();
        }
    }

    fn set_division(&mut self, division: Division) {
        tracing::info!("dividing frames {}", division.name());
        self.farm.want(|wanted| {
            wanted.division = division;
            wanted.moved_at = Instant::now();
        });
    }

    fn set_view(&mut self, view: View) {
        self.view = view;
        self.want_picture();
    }

    fn set_fullscreen(&mut self, window: &Window, fill: bool) {
        window.set_fullscreen(fill.then_some(Fullscreen::Borderless(None)));
        self.screensaver = fill.then(ScreensaverHold::new).flatten();
        self.cursor_moved_at = Instant::now();
        self.show_cursor(window, true);
    }

    fn show_cursor(&mut self, window: &Window, visible: bool) {
        if visible != self.cursor_is_visible {
            window.set_cursor_visible(visible);
            self.cursor_is_visible = visible;
        }
    }

    fn take_screenshot(&mut self) {
        let (Some(screen), Some(_)) = (&mut self.screen, &self.frame) else {
            self.error = Some("no screenshot: nothing has been rendered yet".to_owned());
            return;
        };
        match screen.picture(&self.options.wall) {
            Ok(picture) => self.screenshots.write(picture),
            Err(error) => self.error = Some(format!("no screenshot: {error}")),
        }
    }

    fn write_last_picture(&mut self, path: &Path) -> anyhow::Result<()> {
        let (Some(screen), Some(_)) = (&mut self.screen, &self.frame) else {
            anyhow::bail!("no screenshot {}: the window was closed before anything was rendered", path.display());
        };
        screen.picture(&self.options.wall)?.write_png(path)?;
        tracing::info!("wrote {}", path.display());
        Ok(())
    }

    fn cursor_moved(&mut self, event: &WindowEvent, position: PhysicalPosition<f64>) {
        let was_over_overlay = self.cursor_is_over_overlay();
        self.cursor = position;
        self.cursor_moved_at = Instant::now();
        if let Some(window) = self.screen.as_ref().map(|screen| Arc::clone(&screen.window)) {
            self.show_cursor(&window, true);
        }
        let point = self.point_on_canvas();
        let is_dragging = self.navigator.as_ref().is_some_and(Navigator::is_dragging);
        if self.navigator.as_mut().is_some_and(|navigator| navigator.move_to(point)) {
            self.want_picture();
        }
        if !is_dragging && (was_over_overlay || self.cursor_is_over_overlay()) {
            self.tell_overlay(event);
        }
    }

    fn mouse_button(&mut self, event: &WindowEvent, state: ElementState, button: MouseButton) {
        let drag = match (button, self.modifiers.shift_key()) {
            (MouseButton::Left, false) => Drag::Orbit,
            (MouseButton::Left, true) | (MouseButton::Middle, _) => Drag::Pan,
            (MouseButton::Right, _) => Drag::Dolly,
            _ => return,
        };
        let over_overlay = self.cursor_is_over_overlay();
        let is_dragging = self.navigator.as_ref().is_some_and(Navigator::is_dragging);
        if over_overlay && !is_dragging {
            return self.tell_overlay(event);
        }
        let Some(navigator) = &mut self.navigator else { return };
        match state {
            ElementState::Pressed => navigator.press(drag),
            ElementState::Released => navigator.release(),
        }
    }

    fn wheel(&mut self, event: &WindowEvent, delta: MouseScrollDelta) {
        if self.cursor_is_over_overlay() {
            return self.tell_overlay(event);
        }
        let notches = match delta {
            MouseScrollDelta::LineDelta(_, lines) => f64::from(lines),
            MouseScrollDelta::PixelDelta(pixels) => pixels.y / PIXELS_PER_NOTCH,
        };
        if self.navigator.as_mut().is_some_and(|navigator| navigator.wheel(notches)) {
            self.want_picture();
        }
    }

    /// The cursor as a fraction of the canvas, (0, 0) lower left.
    fn point_on_canvas(&self) -> DVec2 {
        let size = self.screen.as_ref().map_or([1, 1], Screen::size);
        let wall = PixelRect::fitted(self.options.wall.output_size(), size);
        let x = (self.cursor.x - f64::from(wall.x)) / f64::from(wall.width.max(1));
        let y = (self.cursor.y - f64::from(wall.y)) / f64::from(wall.height.max(1));
        DVec2::new(x, 1.0 - y)
    }

    fn cursor_is_over_overlay(&self) -> bool {
        let Some(screen) = &self.screen else { return false };
        let scale = f64::from(screen.pixels_per_point());
        let point = egui::pos2((self.cursor.x / scale) as f32, (self.cursor.y / scale) as f32);
        self.overlay_areas.iter().any(|area| area.contains(point))
    }

    fn tell_overlay(&mut self, event: &WindowEvent) {
        if self.overlay_is_visible()
            && let Some(screen) = &mut self.screen
        {
            screen.overlay_event(event);
            screen.window.request_redraw();
        }
    }

    // What is on screen.

    fn overlay_is_visible(&self) -> bool {
        self.overlay.panel || self.overlay.help
    }

    fn redraw(&self) {
        if let Some(screen) = &self.screen {
            screen.window.request_redraw();
        }
    }

    fn update_overlay(&mut self, now: Instant) {
        let wanted = self.farm.wanted();
        self.note.take_if(|(_, since)| now.duration_since(*since) >= NOTE_LIFE);
        self.overlay.status = self.farm.status();
        self.overlay.division = wanted.division;
        self.overlay.min_renderers = wanted.min_renderers;
        self.overlay.view = self.view;
        self.overlay.frame = self.frame.as_ref().map(|frame| frame.stats.clone());
        self.overlay.up = self.navigator.as_ref().map_or(self.options.up, Navigator::up);
        self.overlay.loading = self.loader.progress();
        self.overlay.frames_per_second = self.rate.per_second(now);
        self.overlay.note = self.note.as_ref().map(|(note, _)| note.clone());
        let farm_message =
            self.overlay.status.message.clone().filter(|message| Some(message) != self.dismissed.as_ref());
        self.overlay.messages = self.error.clone().into_iter().chain(farm_message).collect();
    }

    fn draw(&mut self, event_loop: &ActiveEventLoop) {
        self.take_frame();
        self.update_overlay(Instant::now());
        let Some(screen) = &mut self.screen else { return };
        let new_frame = self.frame.as_ref().filter(|_| self.frame_is_new);
        let drawn = match screen.draw(&self.options.wall, new_frame, &self.overlay) {
            Ok(Some(drawn)) => drawn,
            Ok(None) => {
                self.repaint_at = self.frame_is_new.then(|| Instant::now() + RETRY_INTERVAL);
                return;
            }
            Err(error) => return self.fail(event_loop, error),
        };
        let now = Instant::now();
        self.repaint_at = now.checked_add(drawn.repaint_after);
        self.overlay_areas = drawn.overlay.areas;
        if self.frame_is_new
            && let Some(frame) = &self.frame
        {
            self.frame_is_new = false;
            self.rate.count(now);
            let latency_ms = now.duration_since(frame.moved_at).as_secs_f64() * 1e3;
            let stats = DisplayStats { latency_ms, ..drawn.stats };
            tracing::debug!("frame {} is on screen, {latency_ms:.1} ms after the camera", frame.stats.frame);
            self.overlay.display = Some(stats);
            // What showing it took is known only now.
            self.repaint_at = self.repaint_at.into_iter().chain([now + SETTLE_TIME]).min();
            if (self.on_shown)(frame, &stats).is_break() {
                event_loop.exit();
            }
        }
        for command in drawn.overlay.commands {
            self.obey(event_loop, command);
        }
    }

    /// Does what time has come for, and says when to look again.
    fn pass_time(&mut self) -> Option<Instant> {
        let now = Instant::now();
        let mut next = Vec::new();
        let speed = if self.modifiers.shift_key() { FAST } else { 1.0 };
        if let Some(navigator) = self.navigator.as_mut().filter(|navigator| navigator.is_flying()) {
            let elapsed = now.duration_since(self.flown_at);
            if elapsed >= FLY_INTERVAL {
                self.flown_at = now;
                if navigator.fly(elapsed.as_secs_f64(), speed) {
                    self.want_picture();
                }
            }
            next.push(self.flown_at + FLY_INTERVAL);
        }
        if let Some(window) = self.screen.as_ref().map(|screen| Arc::clone(&screen.window))
            && window.fullscreen().is_some()
            && self.cursor_is_visible
        {
            let hide_at = self.cursor_moved_at + CURSOR_REST;
            if now >= hide_at {
                self.show_cursor(&window, false);
            } else {
                next.push(hide_at);
            }
        }
        if self.overlay_is_visible() {
            let rests_at = self.overlay.frames_per_second.and_then(|_| self.rate.rests_at());
            let note_ends_at = self.overlay.note.as_ref().and(self.note.as_ref()).map(|(_, since)| *since + NOTE_LIFE);
            for moment in [rests_at, note_ends_at, self.repaint_at].into_iter().flatten() {
                if now >= moment {
                    self.redraw();
                } else {
                    next.push(moment);
                }
            }
        }
        next.into_iter().min()
    }
}

impl ApplicationHandler for App<'_> {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.screen.is_none() {
            match self.open(event_loop) {
                Ok(screen) => self.screen = Some(screen),
                Err(error) => self.fail(event_loop, error),
            }
        }
    }

    fn user_event(&mut self, event_loop: &ActiveEventLoop, (): ()) {
        self.look_around(event_loop);
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match &event {
            WindowEvent::CloseRequested | WindowEvent::Destroyed => event_loop.exit(),
            WindowEvent::RedrawRequested => self.draw(event_loop),
            WindowEvent::Resized(size) => {
                if let Some(screen) = &mut self.screen {
                    screen.resize([size.width, size.height]);
                }
                self.redraw();
            }
            WindowEvent::Occluded(false) | WindowEvent::ScaleFactorChanged { .. } => self.redraw(),
            WindowEvent::Focused(false) => {
                if let Some(navigator) = &mut self.navigator {
                    navigator.let_go_of_all();
                }
            }
            WindowEvent::ModifiersChanged(modifiers) => {
                self.modifiers = modifiers.state();
                self.tell_overlay(&event);
            }
            WindowEvent::KeyboardInput { event: key, is_synthetic: false, .. } => self.key(event_loop, key),
            WindowEvent::CursorMoved { position, .. } => self.cursor_moved(&event, *position),
            WindowEvent::MouseInput { state, button, .. } => self.mouse_button(&event, *state, *button),
            WindowEvent::MouseWheel { delta, .. } => self.wheel(&event, *delta),
            WindowEvent::DroppedFile(path) => {
                self.loader.load(SceneSource::Ply(path.clone()));
                self.redraw();
            }
            _ => {}
        }
    }

    fn exiting(&mut self, _: &ActiveEventLoop) {
        if self.outcome.is_ok()
            && let Some(path) = self.options.screenshot_at_end.take()
        {
            self.outcome = self.write_last_picture(&path);
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        event_loop.set_control_flow(self.pass_time().map_or(ControlFlow::Wait, ControlFlow::WaitUntil));
    }
}

/// The one after `current`, and after the last the first.
fn next<T: Copy + PartialEq>(all: &[T], current: T) -> T {
    let index = all.iter().position(|&one| one == current).map_or(0, |index| index + 1);
    all[index % all.len()]
}

fn without_pings(model: &OverlayModel) -> OverlayModel {
    let mut model = model.clone();
    let FarmStatus { nodes, .. } = &mut model.status;
    nodes.iter_mut().for_each(|node| node.round_trip_ms = None);
    model
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_steps_through_all_choices() {
        assert_eq!(next(&[1, 2, 3], 1), 2);
        assert_eq!(next(&[1, 2, 3], 3), 1);
    }
}
