//! The window's events: dispatches them to the parts of the window, asks the farm for frames and shows them.

mod camera;
mod driving;
mod marks;
mod messages;
mod opening;
mod picture;
mod pointer;
mod probing;
mod remote;
mod show;
mod showing;
mod steering;
mod touching;

use std::time::{Duration, Instant};

use renderer::{cli::large_file::warn_of_large_file, model::scene::SceneSource};
use shared::printable::counted;
use winit::{
    application::ApplicationHandler,
    event::WindowEvent,
    event_loop::{ActiveEventLoop, ControlFlow},
    keyboard::ModifiersState,
    window::WindowId,
};

use self::{
    camera::CameraControl, driving::DeviceControl, marks::MarkControl, messages::Messages, opening::Browser,
    picture::PictureControl, pointer::Pointer, probing::Probing, remote::RemoteControl, show::ShowControl,
    showing::Presentation, touching::TouchControl,
};
use super::{
    OnShown, Steering,
    effect::Effect,
    jobs::Jobs,
    join::join_hint,
    model_loader::{Loaded, ModelLoader, name_of},
    outputs::Outputs,
    session::legacy,
    waker::{Call, Waker},
};
use crate::{
    cli::args::{Inputs, WallArgs},
    control::{alignment::Alignment, kiosk::Kiosk, model::Model, sidecar::SidecarFiles},
    farm::Farm,
    overlay::{ModelSummary, OverlayModel, WallDrawing},
    supervisor::SupervisorLink,
    wall::OnLoss,
};

/// Connects the parts of the window: each owns its state and knows nothing of the others.
pub(super) struct App<'a> {
    farm: &'a Farm,
    supervisor: Option<SupervisorLink>,
    on_shown: OnShown,
    outcome: anyhow::Result<()>,
    args: &'a WallArgs,

    loader: ModelLoader,
    model: Option<Model>,
    browser: Browser,
    camera: CameraControl,
    picture: PictureControl,
    probing: Probing,
    marks: MarkControl,
    wall: Alignment,
    kiosk: Kiosk,
    /// The show that the wall plays, if it plays one.
    show: Option<ShowControl>,
    remote: RemoteControl,
    devices: DeviceControl,
    pointer: Pointer,
    fingers: TouchControl,
    modifiers: ModifiersState,
    messages: Messages,
    jobs: Jobs,

    presentation: Presentation,
    overlay: OverlayModel,
    /// The parts of the leading window that the overlay covers.
    overlay_areas: Vec<egui::Rect>,
    /// The panels beside which the model makes room, in points.
    panels: Vec<egui::Rect>,
    /// All that labels on the picture leave free, in points.
    covered: Vec<egui::Rect>,
    outputs: Outputs,
}

impl<'a> App<'a> {
    pub(super) fn new(
        args: &'a WallArgs,
        inputs: Inputs,
        farm: &'a Farm,
        on_shown: OnShown,
        waker: Waker,
        supervisor: Option<SupervisorLink>,
        steering: Steering,
    ) -> Self {
        let now = Instant::now();
        let plays = inputs.show.as_ref().is_some_and(|(_, show)| !show.scenes.is_empty());
        // Visitors have no key that would show it.
        let for_visitors = args.kiosk.is_some() && args.remote.remote_tokens.is_some();
        let overlay = OverlayModel {
            remote_link: steering.remote.as_ref().filter(|_| for_visitors).map(|remote| remote.link().to_owned()),
            // Captions need the room.
            panel: args.kiosk.is_none() && !plays,
            wall: WallDrawing::new(&inputs.wall),
            join: join_hint(farm.address(), args.key.as_deref(), [None; 2]),
            ..Default::default()
        };
        let store = args.scene.store();
        let mut loader = ModelLoader::new(waker.clone(), args.show.model.treatment(), store.clone());
        let source = args.show.model.source();
        let picture = PictureControl::new(args, &inputs.wall, inputs.sky);
        let show = inputs.show.map(|show| ShowControl::new(show, source.clone(), picture.look(), now));
        // The first scene of a show takes the place of the model.
        if !plays {
            if !store.has(&source, args.show.model.treatment()) {
                warn_of_large_file(&source, 1 + args.n_local());
            }
            loader.load(source.clone());
        }
        let kiosk = args.kiosk.map(|seconds| Duration::from_secs(seconds.into()));
        Self {
            farm,
            supervisor,
            on_shown,
            outcome: Ok(()),
            args,
            loader,
            model: None,
            browser: Browser::new(&source),
            camera: CameraControl::new(args.up, &inputs.wall, (inputs.camera, inputs.path), now),
            picture,
            probing: Probing::default(),
            marks: MarkControl::default(),
            kiosk: Kiosk::new(kiosk, now),
            show,
            remote: RemoteControl::new(steering.remote),
            devices: DeviceControl::new(steering.devices),
            pointer: Pointer::new(now),
            fingers: TouchControl::new(inputs.wall.aspect()),
            modifiers: ModifiersState::empty(),
            messages: Messages::default(),
            jobs: Jobs::new(waker),
            presentation: Presentation { is_stale: true, ..Presentation::default() },
            overlay,
            overlay_areas: Vec::new(),
            panels: Vec::new(),
            covered: Vec::new(),
            outputs: Outputs::new(&inputs.wall, args.fullscreen || args.kiosk.is_some()),
            wall: Alignment::new(args.show.wall.clone(), inputs.wall),
        }
    }

    pub(super) fn into_outcome(self) -> anyhow::Result<()> {
        if self.supervisor.is_some() && self.outcome.is_err() {
            // The windows stay open: the supervisor covers the desktop with a copy of them.
            std::mem::forget(self.outputs);
        }
        self.outcome
    }

    fn fail(&mut self, event_loop: &ActiveEventLoop, error: impl Into<anyhow::Error>) {
        self.outcome = Err(error.into());
        event_loop.exit();
    }

    /// Opens and closes windows as monitors come and go.
    fn follow_monitors(&mut self, event_loop: &ActiveEventLoop) {
        match self.outputs.follow_monitors(event_loop) {
            Ok(true) => {
                if let Some(supervisor) = &mut self.supervisor {
                    supervisor.report_windows(self.outputs.windows().filter_map(legacy::x_window_id));
                }
                self.redraw();
            }
            Ok(false) => {}
            Err(error) => self.fail(event_loop, error),
        }
    }

    /// Carries out the requests of a part of the window.
    fn apply(&mut self, effect: Effect) {
        let Effect { wants_picture, note, problem, job, files, models, show } = effect;
        if let Some(note) = note {
            tracing::info!("{note}");
            self.messages.show_note(note, Instant::now());
        }
        if let Some(problem) = problem {
            tracing::error!("{problem}");
            self.messages.show_problem(problem, Instant::now());
        }
        if let Some(job) = job {
            self.jobs.add(job);
        }
        if let Some(files) = files {
            self.browser.show(files);
        }
        if let Some(models) = models {
            self.remote.models = models;
        }
        if let (Some(show), Some(control)) = (show, &mut self.show) {
            control.take_edit(*show);
        }
        if wants_picture {
            self.want_picture();
        }
    }

    /// Asks the farm for a picture of the model from here.
    fn want_picture(&mut self) {
        let now = Instant::now();
        let recorded = self.camera.record(now);
        self.apply(recorded);
        let (Some(model), Some(navigator)) = (&self.model, &self.camera.navigator) else { return };
        let spec = self.picture.spec(model.scene, navigator.camera(), navigator.up());
        let step = self.picture.refinement.change(now, spec, model.fine_bounds());
        self.farm.update_goal(|goal| {
            goal.spec = Some(step.spec);
            goal.is_refinement = step.is_refinement;
            goal.scene_path = model.path();
            goal.change = self.show.as_ref().map_or(0, |show| show.change);
            goal.moved_at = now;
        });
    }

    /// Takes everything that the farm has finished, and redraws if anything on screen has changed.
    fn take_results(&mut self) {
        self.take_probed();
        self.take_frame();
        self.update_darkness();
        if self.overlay_changed() || self.presentation.is_new {
            self.redraw();
        }
    }

    fn take_model(&mut self, event_loop: &ActiveEventLoop, loaded: Loaded) {
        self.loader.load_next();
        match loaded {
            Ok(loaded) => self.show_model(loaded.0, loaded.1),
            // Scenes of a show may still come.
            Err(problem) if self.model.is_none() && self.show.as_ref().is_none_or(ShowControl::is_empty) => {
                self.fail(event_loop, anyhow::anyhow!(problem));
            }
            Err(problem) => {
                self.show.iter_mut().for_each(ShowControl::forget_stand_in);
                self.apply(Effect::problem(problem));
            }
        }
    }

    fn show_model(&mut self, model: Model, sidecars: SidecarFiles) {
        self.messages.problem = None;
        if let Some(problem) = sidecars.problem() {
            self.apply(Effect::problem(problem));
        }
        self.leave_show();
        self.announce(&model);
        if self.model.is_some() {
            self.picture.begin_model();
        }
        let effect = self.camera.set_model(&model, sidecars, &self.free_parts(), Instant::now());
        if let (up, true) = self.camera.up() {
            let name = name_of(&model.source);
            tracing::info!("{up} is guessed to point up in {name}: U on the wall, or --up, chooses another axis");
        }
        self.model = Some(model);
        self.apply(effect);
    }

    /// Tells which model is on the wall from now on.
    fn announce(&mut self, model: &Model) {
        let name = name_of(&model.source);
        tracing::info!("showing {name}: {}", counted(model.n_triangles, "triangle"));
        // Points of the model before are none of this one.
        self.overlay.pick = None;
        self.probing.forget();
        self.forget_marks();
        self.overlay.model = Some(ModelSummary {
            name: name.clone(),
            n_triangles: model.n_triangles,
            is_solid: model.is_solid,
            extent: model.shape.bounds.1 - model.shape.bounds.0,
            found: model.found.clone(),
            left_out: model.left_out.clone(),
        });
        let files = [model.path(), self.args.appearance.sky.clone()];
        self.overlay.join =
            join_hint(self.farm.address(), self.args.key.as_deref(), files.each_ref().map(Option::as_deref));
        self.outputs.set_title(format!("{name} – Raywall"));
    }

    fn take_frame(&mut self) {
        // The next frame waits until this one is shown: each is shown once.
        if !self.presentation.is_new
            && let Some(frame) = self.farm.take_frame()
        {
            let refinement = &mut self.picture.refinement;
            refinement.on_frame(&frame.spec, Duration::from_secs_f64(frame.stats.interval_ms / 1e3));
            if refinement.is_done() {
                tracing::debug!("the picture is fully refined: {}", frame.spec.size);
            }
            self.presentation.frame = Some(frame);
            self.presentation.is_new = true;
        }
    }

    /// A wall that is black on loss goes dark with its last render server, and lights up when one has joined.
    fn update_darkness(&mut self) {
        if self.wall.wall.on_loss() == OnLoss::LastFrame {
            return;
        }
        let is_dark = self.farm.status().nodes.is_empty();
        if let Some(painter) = &mut self.outputs.painter
            && std::mem::replace(&mut painter.is_dark, is_dark) != is_dark
        {
            tracing::info!("the wall {}", if is_dark { "is black: no render server is left" } else { "shows frames" });
            self.redraw();
        }
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
            Call::Check => {}
            Call::Apply(effect) => self.apply(effect),
            Call::Show(loaded) => self.take_model(event_loop, loaded),
            Call::Prepared(index, prepared) => self.take_prepared(index, prepared),
            Call::Close => event_loop.exit(),
        }
        self.take_orders(event_loop);
        self.take_device_orders(event_loop);
        self.take_results();
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, window: WindowId, event: WindowEvent) {
        // Events of a window may come after it was closed with its monitor.
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
                if let Some(navigator) = &mut self.camera.navigator {
                    navigator.release_all();
                }
                self.fingers.lift_all();
            }
            WindowEvent::ModifiersChanged(modifiers) => {
                self.modifiers = modifiers.state();
                self.forward_to_overlay(index, &event);
            }
            WindowEvent::KeyboardInput { event: key, is_synthetic: false, .. } => {
                self.key(event_loop, index, &event, key);
            }
            WindowEvent::CursorMoved { position, .. } => self.cursor_moved(index, &event, *position),
            WindowEvent::CursorLeft { .. } | WindowEvent::Ime(_) => self.forward_to_overlay(index, &event),
            WindowEvent::MouseInput { state, button, .. } => self.mouse_button(index, &event, *state, *button),
            WindowEvent::MouseWheel { delta, .. } => self.wheel(index, &event, *delta),
            WindowEvent::Touch(touch) => self.touch(index, &event, touch),
            WindowEvent::PinchGesture { .. }
            | WindowEvent::PanGesture { .. }
            | WindowEvent::RotationGesture { .. }
            | WindowEvent::DoubleTapGesture { .. } => self.gesture(index, &event),
            WindowEvent::DroppedFile(path) if !self.kiosk.is_locked => {
                self.loader.load(SceneSource::File(path.clone()));
                self.redraw();
            }
            _ => {}
        }
    }

    fn exiting(&mut self, event_loop: &ActiveEventLoop) {
        match self.wall.save_aside() {
            Ok(kept) => kept.iter().for_each(|line| tracing::warn!("{line}")),
            Err(error) if self.outcome.is_ok() => self.outcome = Err(error),
            Err(error) => tracing::error!("{error}"),
        }
        if self.outcome.is_ok()
            && let Some(path) = &self.args.screenshot
        {
            self.outcome = self.write_last_picture(path);
        }
        if self.supervisor.is_some() && self.outcome.is_ok() {
            legacy::retain_windows(event_loop, false);
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        let mut next = self.on_time(event_loop);
        if self.presentation.is_stale {
            self.draw(event_loop);
            next = self.on_time(event_loop);
        }
        event_loop.set_control_flow(match next {
            _ if self.presentation.is_stale => ControlFlow::Poll,
            Some(moment) => ControlFlow::WaitUntil(moment),
            None => ControlFlow::Wait,
        });
    }
}
