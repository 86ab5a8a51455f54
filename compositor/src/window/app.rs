//! What happens in the windows: events in, wishes to the farm and pictures out.

mod aligning;
mod opening;
mod probing;
mod showing;
mod steering;
mod touring;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use renderer::model::scene::SceneSource;
use shared::{
    appearance::Appearance,
    protocol::{FrameSpec, LightingMode, ShadingMode},
};
use winit::{
    application::ApplicationHandler,
    dpi::PhysicalPosition,
    event::WindowEvent,
    event_loop::{ActiveEventLoop, ControlFlow},
    keyboard::ModifiersState,
    window::WindowId,
};

use super::{
    Call, OnShown, Waker, WindowOptions,
    frame_rate::FrameRate,
    jobs::Jobs,
    join_hint,
    model_loader::{ModelLoader, name_of},
    outputs::Outputs,
    session::{legacy, screensaver::ScreensaverHold},
};
use crate::{
    control::alignment::Alignment,
    control::{
        kiosk::Kiosk,
        model::Model,
        navigator::Navigator,
        refinement::{Refinement, RefinementOptions},
        sidecar::SidecarFiles,
    },
    farm::{Farm, Frame},
    overlay::{ModelSummary, OverlayModel, WallDrawing},
    supervisor::SupervisorLink,
    wall::OnLoss,
};

/// The windows' state.
pub(super) struct App<'a> {
    options: WindowOptions,
    alignment: Alignment,
    /// The pattern on screen is not what it should be now.
    pattern_is_stale: bool,
    farm: &'a Farm,
    on_shown: OnShown,
    outcome: anyhow::Result<()>,
    outputs: Outputs,
    supervisor: Option<SupervisorLink>,
    /// What is on screen is not what should be there now.
    is_stale: bool,

    loader: ModelLoader,
    model: Option<Model>,
    sidecars: Option<SidecarFiles>,
    navigator: Option<Navigator>,
    recording: Option<touring::Recording>,
    probing: probing::Probing,
    browser: opening::Browser,
    /// Visitors can only steer.
    is_locked: bool,
    view: ShadingMode,
    rays: LightingMode,
    appearance: Appearance,
    refinement: Refinement,
    jobs: Jobs,

    overlay: OverlayModel,
    overlay_areas: Vec<egui::Rect>,
    /// A mouse button went down on the overlay and is still down.
    overlay_is_pressed: bool,
    error: Option<String>,
    /// The farm's message that was dismissed, and how many render servers were lost by then.
    dismissed: (Option<String>, u32),
    /// The monitors that were away when the message about them was dismissed.
    dismissed_missing: Vec<String>,
    note: Option<(String, Instant)>,

    /// The newest frame, and whether it has yet to be shown.
    frame: Option<Frame>,
    frame_is_new: bool,
    rate: FrameRate,

    /// Where the cursor is, and in the window of which output.
    cursor: PhysicalPosition<f64>,
    cursor_output: usize,
    cursor_moved_at: Instant,
    /// Where the mouse button went down on the model, until it is dragged.
    pressed_at: Option<PhysicalPosition<f64>>,
    kiosk: Option<Kiosk>,
    modifiers: ModifiersState,
    /// When time last moved the camera.
    stepped_at: Instant,
    screensaver: Option<ScreensaverHold>,
    repaint_at: Option<Instant>,
    /// When to draw again what could not be drawn.
    retry_at: Option<Instant>,
}

impl<'a> App<'a> {
    pub(super) fn new(
        options: WindowOptions,
        farm: &'a Farm,
        on_shown: OnShown,
        waker: Waker,
        supervisor: Option<SupervisorLink>,
    ) -> Self {
        let now = Instant::now();
        let overlay = OverlayModel {
            panel: options.overlay,
            wall: WallDrawing::new(&options.wall),
            join: join_hint(farm.address(), None),
            min_renderers: farm.goal().min_renderers,
            ..Default::default()
        };
        let mut loader = ModelLoader::new(waker.clone());
        loader.load(options.source.clone());
        Self {
            jobs: Jobs::new(waker),
            farm,
            on_shown,
            outcome: Ok(()),
            outputs: Outputs::new(&options.wall, options.fullscreen),
            supervisor,
            is_stale: true,
            loader,
            model: None,
            sidecars: None,
            navigator: None,
            recording: None,
            probing: probing::Probing::default(),
            browser: opening::Browser::new(&options.source),
            is_locked: options.kiosk.is_some(),
            view: options.view,
            rays: options.rays,
            appearance: options.appearance,
            refinement: Refinement::new(options.refinement),
            overlay,
            overlay_areas: Vec::new(),
            overlay_is_pressed: false,
            error: None,
            dismissed: (None, 0),
            dismissed_missing: Vec::new(),
            note: None,
            frame: None,
            frame_is_new: false,
            rate: FrameRate::default(),
            cursor: PhysicalPosition::default(),
            cursor_output: 0,
            cursor_moved_at: now,
            pressed_at: None,
            kiosk: options.kiosk.map(|patience| Kiosk::new(patience, now)),
            modifiers: ModifiersState::empty(),
            alignment: Alignment::new(options.wall_file.clone()),
            pattern_is_stale: false,
            stepped_at: now,
            screensaver: None,
            repaint_at: None,
            retry_at: None,
            options,
        }
    }

    pub(super) fn into_outcome(self) -> anyhow::Result<()> {
        if self.supervisor.is_some() && self.outcome.is_err() {
            // What is on them is the guard's.
            std::mem::forget(self.outputs);
        }
        self.outcome
    }

    fn fail(&mut self, event_loop: &ActiveEventLoop, error: impl Into<anyhow::Error>) {
        self.outcome = Err(error.into());
        event_loop.exit();
    }

    /// Opens and closes windows as monitors come and go.
    pub(super) fn follow_monitors(&mut self, event_loop: &ActiveEventLoop) {
        match self.outputs.follow_monitors(event_loop) {
            Ok(true) => {
                if let Some(supervisor) = &mut self.supervisor {
                    supervisor.report_windows(self.outputs.windows().filter_map(legacy::x_window_id));
                }
                if let Some(largest) = self.outputs.largest_frame_side() {
                    self.refinement.limit_sides(largest);
                }
                self.hold_screensaver();
                self.redraw();
            }
            Ok(false) => {}
            Err(error) => self.fail(event_loop, error),
        }
    }

    fn take_news(&mut self, event_loop: &ActiveEventLoop) {
        while let Some(outcome) = self.loader.poll() {
            match outcome {
                Ok((model, sidecars)) => self.show_model(model, sidecars),
                Err(problem) if self.model.is_none() => return self.fail(event_loop, anyhow::anyhow!(problem)),
                Err(problem) => {
                    tracing::error!("{problem}");
                    self.show_problem(problem);
                }
            }
        }
        while let Some(outcome) = self.jobs.poll() {
            match outcome {
                Ok(None) => {}
                Ok(Some(note)) => self.show_note(note),
                Err(problem) => {
                    tracing::error!("{problem}");
                    self.show_problem(problem);
                }
            }
        }
        self.take_probed();
        self.take_listing();
        self.take_frame();
        self.update_darkness();
        if self.overlay_changed() || self.frame_is_new {
            self.redraw();
        }
    }

    fn show_model(&mut self, model: Model, sidecars: SidecarFiles) {
        let name = name_of(&model.source);
        tracing::info!("showing {name}: {} triangles", model.n_triangles);
        let up = self.options.up.or_else(|| sidecars.views().and_then(|views| views.up)).unwrap_or_default();
        let problem = sidecars.problem().map(str::to_owned);
        self.recording = None;
        self.sidecars = Some(sidecars);
        match &mut self.navigator {
            Some(navigator) => navigator.set_bounds(model.bounds, up),
            None => {
                let navigator = Navigator::new(model.bounds, up, self.options.wall.aspect());
                self.navigator = Some(match self.options.camera {
                    Some(camera) => navigator.with_camera(camera),
                    None => navigator,
                });
                if let (Some(path), Some(sidecars)) = (self.options.path.take(), &mut self.sidecars) {
                    let path = Arc::new(path);
                    sidecars.keep_path(Arc::clone(&path));
                    self.play(path, true);
                }
            }
        }
        self.overlay.pick = None;
        self.overlay.model = Some(ModelSummary {
            name: name.clone(),
            n_triangles: model.n_triangles,
            n_rejected: model.n_rejected,
            extent: model.bounds.1 - model.bounds.0,
        });
        self.outputs.set_title(format!("{name} – Raywall"));
        self.overlay.join = join_hint(self.farm.address(), model.path().as_deref());
        if let Some(problem) = &problem {
            tracing::warn!("{problem}");
        }
        self.error = problem;
        self.model = Some(model);
        self.want_picture();
    }

    fn take_frame(&mut self) {
        // One that is still to be shown keeps the next waiting: each is shown once.
        if !self.frame_is_new
            && let Some(frame) = self.farm.take_frame()
        {
            self.refinement.on_frame(&frame.spec, Duration::from_secs_f64(frame.stats.interval_ms / 1e3));
            if self.refinement.is_done() {
                tracing::debug!("the picture is as fine as it gets: {}", frame.spec.size);
            }
            self.frame = Some(frame);
            self.frame_is_new = true;
        }
    }

    /// Goes dark when no render server is left, if the wall is to, and shows its frame again when one has joined.
    fn update_darkness(&mut self) {
        if self.options.wall.on_loss() == OnLoss::LastFrame {
            return;
        }
        let is_dark = self.farm.status().nodes.is_empty();
        if let Some(painter) = self.outputs.painter()
            && std::mem::replace(&mut painter.is_dark, is_dark) != is_dark
        {
            tracing::info!("the wall {}", if is_dark { "is black: no render server is left" } else { "shows frames" });
            self.redraw();
        }
    }

    fn want_picture(&mut self) {
        self.record_camera();
        let (Some(model), Some(navigator)) = (&self.model, &self.navigator) else { return };
        let RefinementOptions { fixed_size, fixed_samples, .. } = self.options.refinement;
        let spec = FrameSpec {
            scene: model.scene,
            camera: navigator.camera(),
            size: fixed_size,
            view: self.view,
            rays: self.rays,
            samples: fixed_samples,
            appearance: self.appearance,
        };
        let now = Instant::now();
        let step = self.refinement.change(now, spec);
        self.farm.update_goal(|wanted| {
            wanted.spec = Some(step.spec);
            wanted.is_refinement = step.is_refinement;
            wanted.scene_path = model.path();
            wanted.moved_at = now;
        });
    }
}

impl ApplicationHandler<Call> for App<'_> {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.supervisor.is_some() {
            legacy::retain_windows(event_loop, true);
        }
        self.follow_monitors(event_loop);
    }

    fn user_event(&mut self, event_loop: &ActiveEventLoop, call: Call) {
        match call {
            Call::Appearance => self.take_news(event_loop),
            Call::Close => event_loop.exit(),
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, window: WindowId, event: WindowEvent) {
        // A window that was closed with its monitor may still be told of things.
        let Some(index) = self.outputs.index_of(window) else { return };
        match &event {
            WindowEvent::CloseRequested | WindowEvent::Destroyed => event_loop.exit(),
            WindowEvent::RedrawRequested => self.draw(event_loop),
            WindowEvent::Resized(size) => {
                self.outputs.resize(index, (*size).into());
                self.redraw();
            }
            WindowEvent::Occluded(false) | WindowEvent::ScaleFactorChanged { .. } => self.redraw(),
            WindowEvent::Focused(false) => {
                if let Some(navigator) = &mut self.navigator {
                    navigator.release_all();
                }
            }
            WindowEvent::ModifiersChanged(modifiers) => {
                self.modifiers = modifiers.state();
                self.forward_to_overlay(index, &event);
            }
            WindowEvent::KeyboardInput { event: key, is_synthetic: false, .. } => self.key(event_loop, key),
            WindowEvent::CursorMoved { position, .. } => self.cursor_moved(index, &event, *position),
            WindowEvent::CursorLeft { .. } => self.forward_to_overlay(index, &event),
            WindowEvent::MouseInput { state, button, .. } => self.mouse_button(index, &event, *state, *button),
            WindowEvent::MouseWheel { delta, .. } => self.wheel(index, &event, *delta),
            WindowEvent::DroppedFile(path) if !self.is_locked => {
                self.loader.load(SceneSource::Ply(path.clone()));
                self.redraw();
            }
            _ => {}
        }
    }

    fn exiting(&mut self, event_loop: &ActiveEventLoop) {
        if self.outcome.is_ok()
            && let Some(path) = self.options.screenshot_at_end.take()
        {
            self.outcome = self.write_last_picture(&path);
        }
        if self.supervisor.is_some() && self.outcome.is_ok() {
            legacy::retain_windows(event_loop, false);
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        let mut next = self.on_time(event_loop);
        if self.is_stale {
            self.draw(event_loop);
            next = self.on_time(event_loop);
        }
        event_loop.set_control_flow(match next {
            _ if self.is_stale => ControlFlow::Poll,
            Some(moment) => ControlFlow::WaitUntil(moment),
            None => ControlFlow::Wait,
        });
    }
}
