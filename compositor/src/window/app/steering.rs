//! Keys, mouse and commands.

use std::{path::Path, time::Instant};

use glam::DVec2;
use renderer::model::scene::SceneSource;
use shared::{
    camera::CanvasPart,
    division::Division,
    protocol::ShadingMode,
    structure::{Storage, Structure},
};
use strum::VariantArray;
use winit::{
    dpi::PhysicalPosition,
    event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, WindowEvent},
    event_loop::ActiveEventLoop,
    keyboard,
};

use super::{App, picture::next, probing::Purpose};
use crate::{
    control::{
        free_parts::free_parts,
        input::{self, Command, Key, KeyAction, Tint},
        marks::MarkCommand,
        navigator::{Drag, Navigator},
        show::{Player, SceneEdit},
    },
    farm::Probe,
    overlay::{DENSITIES, RAYS, STORAGES},
    window::{effect::Effect, screenshots},
};

/// Pixels that a touchpad scrolls for one notch of a wheel.
const PIXELS_PER_NOTCH: f64 = 50.0;

impl App<'_> {
    pub(super) fn key(&mut self, event_loop: &ActiveEventLoop, index: usize, event: &WindowEvent, key: &KeyEvent) {
        let is_pressed = key.state == ElementState::Pressed;
        let now = Instant::now();
        self.kiosk.touch(now);
        // The field that has the focus gets every press; releases are for all, who may have seen the press.
        let is_typed = self.overlay.is_visible() && self.outputs.field_has_focus();
        if is_typed || !is_pressed {
            self.forward_to_overlay(index, event);
        }
        if is_typed && is_pressed {
            return;
        }
        // A release is of the key that was pressed, perhaps before Ctrl.
        let has_ctrl = is_pressed && self.modifiers.control_key();
        let has_shift = self.modifiers.shift_key();
        let cap = Key::from_winit(&key.logical_key, has_ctrl, has_shift);
        if is_pressed && self.browser.files.is_some() {
            return self.key_to_browser(event_loop, cap, key, has_ctrl);
        }
        // Alignment takes only presses: a key that was pressed before the pattern came must still be released.
        let took_corners = self.wall.takes_corners();
        if let keyboard::Key::Named(named) = key.logical_key
            && is_pressed
            && !self.kiosk.is_locked
            && self.wall.press_key(named, has_shift)
        {
            let unsaved = self.wall.unsaved_note().filter(|_| took_corners);
            self.apply(unsaved.map_or_else(Effect::default, Effect::note));
            return self.redraw();
        }
        if is_pressed && cap == Some(Key::Named(keyboard::NamedKey::Escape)) && self.cancel_marks() {
            return self.redraw();
        }
        match cap.and_then(input::action) {
            Some(KeyAction::Fly(_)) if is_pressed && !key.repeat && self.touch_show() => self.redraw(),
            Some(KeyAction::Fly(direction)) if !(is_pressed && key.repeat) => {
                self.camera.fly(direction, is_pressed, now);
            }
            Some(KeyAction::Trigger(command)) if is_pressed && (!key.repeat || command.repeats()) => {
                self.execute(event_loop, command);
            }
            _ => {}
        }
    }

    /// While files are on screen, all keys that are pressed belong to them.
    fn key_to_browser(&mut self, event_loop: &ActiveEventLoop, cap: Option<Key>, key: &KeyEvent, has_ctrl: bool) {
        match (cap.and_then(|cap| self.browser.command(cap)), &key.text) {
            (Some(command), _) if !key.repeat || command.repeats() => self.execute(event_loop, command),
            (None, Some(text)) if !has_ctrl => {
                self.browser.type_text(text);
                self.redraw();
            }
            _ => {}
        }
    }

    pub(super) fn execute(&mut self, event_loop: &ActiveEventLoop, command: Command) {
        self.kiosk.touch(Instant::now());
        if self.kiosk.allows(command) && !(command.is_steering() && self.touch_show()) {
            self.perform(event_loop, command);
        }
    }

    /// Carries out a command of somebody who may give it.
    pub(super) fn perform(&mut self, event_loop: &ActiveEventLoop, command: Command) {
        let now = Instant::now();
        if command.is_steering() {
            self.marks.chosen = None;
        }
        let effect = match command {
            Command::ViewAll => {
                let parts = self.free_parts();
                self.camera.steer(now, |navigator| navigator.view_all(&parts))
            }
            Command::NextUpAxis => {
                let parts = self.free_parts();
                self.camera.steer(now, |navigator| navigator.next_up_axis(&parts))
            }
            Command::GoToView(number) => {
                let look = self.camera.view(number).and_then(|view| view.look);
                look.into_iter().for_each(|look| self.picture.set_look(look));
                self.camera.go_to_view(number, &self.free_parts(), now)
            }
            Command::KeepView(number) => self.camera.keep_view(number, self.picture.look()),
            Command::ToggleRecording => self.camera.toggle_recording(now),
            Command::TogglePlaying => self.camera.toggle_playing(self.kiosk.repeats_paths(), now),
            Command::ChangeSpeed(steps) => self.camera.change_speed(steps),
            Command::Inspect => self.probe(Purpose::Inspect),
            Command::GoToCursor => self.probe(Purpose::GoTo),
            Command::GoToMiddle => {
                self.probe_at(Purpose::GoTo, DVec2::splat(0.5));
                Effect::default()
            }
            Command::NextTint => self.set_tint(next(Tint::VARIANTS, self.overlay.tint)),
            Command::SetTint(tint) => self.set_tint(tint),
            Command::NextStorage => {
                let storage = self.overlay.structure.map(|structure| structure.storage);
                self.set_storage(next(&STORAGES, storage))
            }
            Command::SetStorage(storage) => self.set_storage(storage),
            Command::NextDensity => {
                let density = self.overlay.structure.unwrap_or_default().density;
                self.set_density(next(&DENSITIES, density as u32))
            }
            Command::SetDensity(density) => self.set_density(density),
            Command::ToggleFiles => self.browser.toggle(),
            Command::Choose(index) => {
                self.browser.choose(index);
                Effect::default()
            }
            Command::OpenEntry(index) => {
                let (file, effect) = self.browser.open(index);
                file.into_iter().for_each(|file| self.loader.load(SceneSource::File(file)));
                effect
            }
            Command::OpenParent => self.browser.open_parent(),
            Command::Untype => {
                self.browser.untype();
                Effect::default()
            }
            Command::NextDivision => self.set_division(next(Division::VARIANTS, self.farm.goal().division)),
            Command::SetDivision(division) => self.set_division(division),
            Command::NextShading => self.picture.change(|it| it.shading = next(ShadingMode::VARIANTS, it.shading)),
            Command::SetShading(shading) => self.picture.change(|it| it.shading = shading),
            Command::NextLighting => self.picture.choose_rays(next(&RAYS, self.picture.rays)),
            Command::SetLighting(rays) => self.picture.choose_rays(rays),
            Command::NextLight => self.picture.next_light(),
            Command::SetLight(light) => self.picture.change(|it| it.appearance.light = light),
            Command::SetSun(decidegrees) => self.picture.change(|it| {
                it.appearance.path = it.appearance.path.with_sun(decidegrees);
            }),
            Command::SetExposure(deci_ev) => self.picture.change(|it| {
                it.appearance.path = it.appearance.path.with_exposure(deci_ev);
            }),
            Command::ChangeExposure(deci_ev) => self.picture.change_exposure(deci_ev),
            Command::SetGround(has_ground) => self.picture.change(|it| {
                it.appearance.path = it.appearance.path.with_ground(has_ground);
            }),
            Command::ToggleGround => self.picture.toggle_ground(),
            Command::NextBackground => self.picture.next_background(),
            Command::SetBackground(background) => self.picture.change(|it| it.appearance.background = background),
            Command::NextClip => self.picture.next_clip(),
            Command::SetClip(clip) => self.picture.change(|it| it.appearance.clip = clip),
            Command::MoveClip(permille) => self.picture.change(|it| {
                it.appearance.clip = it.appearance.clip.map(|clip| clip.deepened_by(permille));
            }),
            Command::ToggleRefinement => self.picture.toggle_refinement(),
            Command::ToggleOverlay => {
                self.overlay.panel = !self.overlay.panel;
                Effect::default()
            }
            Command::ToggleHelp => {
                self.overlay.help = !self.overlay.help;
                Effect::default()
            }
            Command::ToggleFullscreen => self.fill(event_loop, !self.outputs.is_filling, now),
            Command::LeaveFullscreen => self.fill(event_loop, false, now),
            Command::Screenshot => self.take_screenshot(),
            Command::NextPattern => {
                let took_corners = self.wall.takes_corners();
                let pattern = self.wall.next_pattern();
                // A pattern has the wall for itself, until somebody asks for help.
                self.overlay.help = false;
                let help = pattern.map_or_else(|| "No test pattern".to_owned(), |pattern| self.wall.help(pattern));
                let unsaved = self.wall.unsaved_note().filter(|_| took_corners);
                Effect::note(unsaved.map_or(help.clone(), |unsaved| format!("{unsaved}. {help}")))
            }
            Command::SaveCorners => {
                self.wall.save().map_or_else(|problem| Effect::problem(problem.to_string()), Effect::note)
            }
            Command::Undo => Effect::note(self.wall.undo()),
            Command::Redo => Effect::note(self.wall.redo()),
            Command::ToggleLock => self.toggle_lock(),
            Command::ToggleRemote => self.toggle_remote(),
            Command::TogglePlayingShow => {
                self.order_show(|player| if player.is_playing() { player.pause(now) } else { player.play(now) })
            }
            Command::NextScene => self.order_show(Player::go_on),
            Command::PreviousScene => self.order_show(Player::go_back),
            Command::KeepScene => self.keep_scene(String::new(), None),
            Command::MoveScene { is_later } => self.move_scene(is_later),
            Command::DeleteScene => self.edit_scene(None, SceneEdit::Delete),
            Command::Mark(command) => self.mark(command),
            Command::DismissMessage => {
                self.messages.dismiss(&self.farm.status(), self.outputs.missing());
                Effect::default()
            }
            Command::Quit => {
                event_loop.exit();
                Effect::default()
            }
        };
        self.apply(effect);
        self.redraw();
    }

    /// Locks the wall and hides everything that is not for visitors, or unlocks it.
    fn toggle_lock(&mut self) -> Effect {
        if !self.kiosk.toggle_lock(&mut self.overlay.panel) {
            return Effect::note("Unlocked");
        }
        self.overlay.help = false;
        (self.overlay.tint, self.overlay.pick) = (Tint::None, None);
        self.browser.files = None;
        self.lay_marks_down();
        Effect::note("Locked: visitors can only steer; Ctrl+L unlocks")
    }

    fn set_tint(&mut self, tint: Tint) -> Effect {
        self.overlay.tint = tint;
        Effect::default()
    }

    fn set_division(&mut self, division: Division) -> Effect {
        tracing::info!("dividing frames {division}");
        self.farm.update_goal(|goal| {
            goal.division = division;
            goal.moved_at = Instant::now();
        });
        // Coarse frames first, to show the new division at once.
        self.picture.refinement.start_again();
        Effect::picture()
    }

    fn set_storage(&mut self, storage: Option<Storage>) -> Effect {
        let density = self.overlay.structure.unwrap_or_default().density;
        self.set_structure(storage.map(|storage| Structure { storage, density }))
    }

    fn set_density(&mut self, density: u32) -> Effect {
        let storage = self.overlay.structure.unwrap_or_default().storage;
        self.set_structure(Some(Structure { storage, density: density.into() }))
    }

    fn set_structure(&mut self, structure: Option<Structure>) -> Effect {
        self.overlay.structure = structure;
        self.farm.set_structure(structure);
        Effect::note(match structure {
            Some(Structure { storage, density }) => format!("Grids become {storage}, {density} cells a triangle"),
            None => "Grids become as the render servers were started".to_owned(),
        })
    }

    fn fill(&mut self, event_loop: &ActiveEventLoop, is_filling: bool, now: Instant) -> Effect {
        self.outputs.fill(event_loop, is_filling);
        self.pointer.show(now);
        self.outputs.show_cursor(true);
        Effect::default()
    }

    fn take_screenshot(&mut self) -> Effect {
        let (Some(painter), Some(_)) = (&mut self.outputs.painter, &self.presentation.frame) else {
            return Effect::problem("no screenshot: nothing has been rendered yet");
        };
        match painter.image(&self.wall.wall) {
            Ok(image) => Effect::job(move || screenshots::write(".".as_ref(), &image)),
            Err(error) => Effect::problem(format!("no screenshot: {error}")),
        }
    }

    pub(super) fn write_last_picture(&mut self, path: &Path) -> anyhow::Result<()> {
        let (Some(painter), Some(_)) = (&mut self.outputs.painter, &self.presentation.frame) else {
            anyhow::bail!("no screenshot {}: the window was closed before anything was rendered", path.display());
        };
        painter.image(&self.wall.wall)?.write_png(path)?;
        tracing::info!("wrote {}", path.display());
        Ok(())
    }

    /// Asks a render server for the triangle under the cursor; [`App::take_probed`] takes the answer.
    pub(super) fn probe(&mut self, purpose: Purpose) -> Effect {
        self.probe_at(purpose, self.point_on_canvas());
        Effect::default()
    }

    /// Asks a render server what is ahead, while keys fly the camera.
    pub(super) fn probe_ahead(&mut self) {
        if self.camera.navigator.as_ref().is_some_and(Navigator::is_flying) {
            self.probe_at(Purpose::Ahead, DVec2::splat(0.5));
        }
    }

    /// Returns whether the question was asked; `point` is a fraction of the canvas, (0, 0) lower left.
    pub(super) fn probe_at(&mut self, purpose: Purpose, point: DVec2) -> bool {
        let (Some(model), Some(navigator)) = (&self.model, &self.camera.navigator) else { return false };
        let (camera, at) = (navigator.camera(), [point.x as f32, point.y as f32]);
        let number = self.probing.start(purpose, camera, Instant::now());
        if let Some(number) = number {
            let (view, clip) = (Some((model.scene, camera)), self.picture.appearance.clip);
            self.farm.probe(Probe { number, view, at, clip });
        }
        number.is_some()
    }

    /// Takes the answer to the last probe, once it has come.
    pub(super) fn take_probed(&mut self) {
        let probed = self.farm.status().probed;
        let Some((purpose, pick)) = probed.and_then(|probed| self.probing.finish(probed)) else { return };
        if purpose == Purpose::Ahead {
            let navigator = self.camera.navigator.as_mut();
            // Nothing to draw: the next step of the flight shows it.
            return navigator.into_iter().for_each(|navigator| navigator.set_ahead(pick.map(|pick| pick.point)));
        }
        let effect = match (purpose, pick) {
            (Purpose::Inspect, pick) => {
                self.overlay.pick = pick;
                pick.map_or_else(Effect::default, |pick| Effect::note(pick.to_string()))
            }
            (Purpose::GoTo | Purpose::Annotate | Purpose::Measure, None) => Effect::note("The model is not there"),
            (Purpose::Annotate, Some(pick)) => self.annotate(pick),
            (Purpose::Measure, Some(pick)) => self.measure(pick),
            (Purpose::GoTo, Some(pick)) => {
                self.overlay.pick = Some(pick);
                self.camera.steer(Instant::now(), |navigator| navigator.go_to_point(pick.point))
            }
            (Purpose::Approach | Purpose::Ahead, pick) => {
                let navigator = self.camera.navigator.as_mut();
                navigator.into_iter().for_each(|navigator| navigator.set_under_cursor(pick.map(|pick| pick.point)));
                Effect::default()
            }
        };
        self.apply(effect);
        self.redraw();
    }

    pub(super) fn cursor_moved(&mut self, index: usize, event: &WindowEvent, position: PhysicalPosition<f64>) {
        let was_over_overlay = self.cursor_is_over_overlay();
        let now = Instant::now();
        self.kiosk.touch(now);
        self.pointer.move_to(index, position, now);
        self.outputs.show_cursor(true);
        let (on_output, on_canvas) = (self.point_on_output(), self.point_on_canvas());
        if self.wall.drag_to(on_output) {
            self.redraw();
        }
        if self.camera.navigator.as_mut().is_some_and(|navigator| navigator.move_to(on_canvas)) {
            self.want_picture();
        }
        let is_over_overlay = was_over_overlay || self.cursor_is_over_overlay();
        if self.pointer.overlay_is_pressed || (is_over_overlay && !self.camera.is_dragging()) {
            self.forward_to_overlay(index, event);
        }
    }

    pub(super) fn mouse_button(&mut self, index: usize, event: &WindowEvent, state: ElementState, button: MouseButton) {
        let is_pressed = state == ElementState::Pressed;
        // The overlay also gets the release of a button that was pressed on it.
        if self.pointer.overlay_is_pressed || (self.cursor_is_over_overlay() && !self.camera.is_dragging()) {
            self.pointer.overlay_is_pressed = is_pressed;
            return self.forward_to_overlay(index, event);
        }
        if is_pressed && self.outputs.field_has_focus() {
            self.outputs.take_focus();
            self.redraw();
        }
        let now = Instant::now();
        self.kiosk.touch(now);
        if !self.kiosk.is_locked && self.wall.takes_corners() && button == MouseButton::Left {
            let at = self.point_on_output();
            if is_pressed {
                self.wall.press(at);
            } else {
                self.wall.release();
            }
            return self.redraw();
        }
        if is_pressed && self.touch_show() {
            return self.redraw();
        }
        let is_click = !is_pressed && self.pointer.release();
        self.pointer.press(is_pressed && button == MouseButton::Left);
        let Some(navigator) = &mut self.camera.navigator else { return };
        match (is_pressed, button, self.modifiers.shift_key()) {
            (false, ..) => navigator.release(),
            (_, MouseButton::Left, false) => navigator.press(Drag::Orbit),
            (_, MouseButton::Left, true) | (_, MouseButton::Middle, _) => navigator.press(Drag::Pan),
            (_, MouseButton::Right, _) => navigator.press(Drag::Dolly),
            _ => {}
        }
        if is_click {
            let at = self.point_on_canvas();
            self.click(at, |app| app.pointer.is_double_click(at, now));
        }
    }

    /// A click on a label, or on the model; it may be the second of a double click.
    pub(super) fn click(&mut self, at: DVec2, is_double: impl FnOnce(&mut Self) -> bool) {
        if let Some(annotation) = self.label_at(at) {
            return self.perform_mark(MarkCommand::GoTo(annotation));
        }
        if self.marks.chosen.take().is_some() {
            self.redraw();
        }
        if self.kiosk.is_locked {
            return;
        }
        let purpose = match (is_double(self), self.has_ruler()) {
            (true, true) => return,
            (true, false) => Purpose::GoTo,
            (false, true) => Purpose::Measure,
            (false, false) => Purpose::Inspect,
        };
        self.probe_at(purpose, at);
    }

    pub(super) fn wheel(&mut self, index: usize, event: &WindowEvent, delta: MouseScrollDelta) {
        if self.cursor_is_over_overlay() {
            return self.forward_to_overlay(index, event);
        }
        let notches = match delta {
            MouseScrollDelta::LineDelta(_, lines) => f64::from(lines),
            MouseScrollDelta::PixelDelta(pixels) => pixels.y / PIXELS_PER_NOTCH,
        };
        self.kiosk.touch(Instant::now());
        if self.touch_show() {
            return self.redraw();
        }
        // The first notch moves toward the middle of the model; the answer comes before the next notch.
        if self.camera.navigator.as_ref().is_some_and(Navigator::needs_surface) {
            self.probe(Purpose::Approach);
        }
        if self.camera.navigator.as_mut().is_some_and(|navigator| navigator.wheel(notches)) {
            self.want_picture();
        }
    }

    /// The cursor in pixels of the spanning output.
    fn point_on_output(&self) -> DVec2 {
        self.outputs.on_wall(self.pointer.output_idx, self.pointer.position)
    }

    /// The cursor as a fraction of the canvas, (0, 0) lower left.
    pub(super) fn point_on_canvas(&self) -> DVec2 {
        self.wall.wall.canvas_at(self.point_on_output())
    }

    /// The parts of the canvas that panels leave free.
    pub(super) fn free_parts(&self) -> Vec<CanvasPart> {
        let on_canvas = |point| self.wall.wall.canvas_at(self.outputs.overlay_on_wall(point));
        let panel = |area: &egui::Rect| {
            let corners = [area.left_top(), area.right_top(), area.left_bottom(), area.right_bottom()].map(on_canvas);
            let (min, max) = (corners.into_iter().reduce(DVec2::min), corners.into_iter().reduce(DVec2::max));
            CanvasPart { min: min.unwrap_or_default(), max: max.unwrap_or_default() }
        };
        free_parts(&self.panels.iter().map(panel).collect::<Vec<_>>())
    }

    /// The largest part of the canvas that panels leave free, its upper-left corner (0, 0).
    pub(super) fn free_canvas(&self) -> egui::Rect {
        let size = |part: &CanvasPart| (part.max - part.min).element_product();
        let largest = self.free_parts().into_iter().max_by(|a, b| size(a).total_cmp(&size(b)));
        let CanvasPart { min, max } = largest.unwrap_or(CanvasPart::WHOLE);
        let point = |x: f64, y: f64| egui::pos2(x as f32, (1.0 - y) as f32);
        egui::Rect::from_min_max(point(min.x, max.y), point(max.x, min.y))
    }

    pub(super) fn cursor_is_over_overlay(&self) -> bool {
        self.is_over_overlay(self.pointer.output_idx, self.pointer.position)
    }

    /// Whether a point of a window lies on a panel.
    pub(super) fn is_over_overlay(&self, index: usize, at: PhysicalPosition<f64>) -> bool {
        let point = self.outputs.on_overlay(index, at);
        point.is_some_and(|point| self.overlay_areas.iter().any(|area| area.contains(point)))
    }

    pub(super) fn forward_to_overlay(&mut self, index: usize, event: &WindowEvent) {
        if self.overlay.is_visible() {
            self.outputs.forward_to_overlay(index, event);
            self.redraw();
        }
    }
}
