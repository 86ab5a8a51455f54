//! What a person does: keys, mouse and commands.

use std::{path::Path, time::Instant};

use glam::DVec2;
use shared::{
    appearance::{Appearance, Background, Clip, ClipSide, Light},
    division::Division,
    protocol::{LightingMode, ShadingMode},
    structure::{Storage, Structure},
};
use winit::{
    dpi::PhysicalPosition,
    event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, WindowEvent},
    event_loop::ActiveEventLoop,
};

use super::{App, probing::Purpose};
use crate::{
    control::{
        input::{self, Command, Key, KeyAction},
        navigator::{Drag, Navigator},
    },
    overlay::{DENSITIES, STORAGES, Tint},
    window::{screenshots, session::screensaver::ScreensaverHold},
};

/// A mouse that moves less than this while its button is down has clicked.
const CLICK_PIXELS: f64 = 4.0;
/// Pixels that a touchpad scrolls for what a wheel does with one notch.
const PIXELS_PER_NOTCH: f64 = 50.0;

impl App<'_> {
    pub(super) fn key(&mut self, event_loop: &ActiveEventLoop, event: &KeyEvent) {
        let pressed = event.state == ElementState::Pressed;
        // A key that was pressed before Ctrl is let go as the key that it was.
        self.touch();
        if self.align_key(event) {
            return;
        }
        let Some(key) = Key::from_winit(&event.logical_key, pressed && self.modifiers.control_key()) else { return };
        if pressed && let Some(command) = self.files_key(key) {
            return self.execute(event_loop, command);
        }
        match input::action(key) {
            Some(KeyAction::Fly(direction)) => {
                let Some(navigator) = &mut self.navigator else { return };
                if !pressed {
                    navigator.release_key(direction);
                } else if !event.repeat {
                    if !navigator.is_moving() {
                        self.stepped_at = Instant::now();
                    }
                    navigator.hold(direction);
                }
            }
            Some(KeyAction::Trigger(command)) if pressed && (!event.repeat || command.repeats()) => {
                self.execute(event_loop, command);
            }
            _ => {}
        }
    }

    pub(super) fn execute(&mut self, event_loop: &ActiveEventLoop, command: Command) {
        self.touch();
        if self.is_locked && !command.is_for_visitors() {
            return;
        }
        match command {
            Command::ViewAll => self.steer(Navigator::view_all),
            Command::GoToView(number) => self.go_to_view(number),
            Command::KeepView(number) => self.keep_view(number),
            Command::ToggleRecording => self.toggle_recording(),
            Command::TogglePlaying => self.toggle_playing(),
            Command::ChangeSpeed(steps) => self.change_speed(steps),
            Command::Inspect => self.probe(Purpose::Inspect),
            Command::NextTint => self.overlay.tint = next(&Tint::ALL, self.overlay.tint),
            Command::SetTint(tint) => self.overlay.tint = tint,
            Command::NextStorage => {
                let storage = self.overlay.structure.map(|structure| structure.storage);
                self.set_storage(next(&STORAGES, storage));
            }
            Command::SetStorage(storage) => self.set_storage(storage),
            Command::NextDensity => {
                let density = self.overlay.structure.unwrap_or_default().density;
                self.set_density(next(&DENSITIES, density as u32));
            }
            Command::SetDensity(density) => self.set_density(density),
            Command::ToggleFiles => self.toggle_files(),
            Command::Choose(index) => self.choose(index),
            Command::OpenEntry(index) => self.open_entry(index),
            Command::OpenParent => self.open_parent(),
            Command::GoToCursor => self.probe(Purpose::GoTo),
            Command::NextUpAxis => self.steer(Navigator::next_up_axis),
            Command::NextDivision => self.set_division(next(&Division::ALL, self.farm.goal().division)),
            Command::SetDivision(division) => self.set_division(division),
            Command::NextView => self.set_view(next(&ShadingMode::ALL, self.view)),
            Command::SetView(view) => self.set_view(view),
            Command::NextRays => self.set_rays(next(&LightingMode::ALL, self.rays)),
            Command::SetRays(rays) => self.set_rays(rays),
            Command::NextLight => {
                let (name, light) = next_of(&Light::PRESETS, self.appearance.light);
                self.show_note(format!("Light: {name}"));
                self.set_appearance(Appearance { light, ..self.appearance });
            }
            Command::SetLight(light) => self.set_appearance(Appearance { light, ..self.appearance }),
            Command::NextBackground => {
                let (name, background) = next_of(&Background::PRESETS, self.appearance.background);
                self.show_note(format!("Background: {name}"));
                self.set_appearance(Appearance { background, ..self.appearance });
            }
            Command::SetBackground(background) => self.set_appearance(Appearance { background, ..self.appearance }),
            Command::NextClip => self.next_clip(),
            Command::SetClip(clip) => self.set_appearance(Appearance { clip, ..self.appearance }),
            Command::MoveClip(permille) => {
                let clip = self.appearance.clip.map(|clip| clip.deepened_by(permille));
                self.set_appearance(Appearance { clip, ..self.appearance });
            }
            Command::ToggleRefinement => self.set_refining(!self.refinement.is_on()),
            Command::ToggleOverlay => self.overlay.panel = !self.overlay.panel,
            Command::ToggleHelp => self.overlay.help = !self.overlay.help,
            Command::ToggleFullscreen => self.fill(event_loop, !self.outputs.is_filling()),
            Command::LeaveFullscreen => self.fill(event_loop, false),
            Command::Screenshot => self.take_screenshot(),
            Command::NextPattern => self.next_pattern(),
            Command::SaveCorners => self.save_corners(),
            Command::ToggleLock => self.toggle_lock(),
            Command::DismissMessage => {
                self.error = None;
                self.note = None;
                let status = self.farm.status();
                self.dismissed = (status.message, status.n_lost);
                self.dismissed_missing = self.outputs.missing();
            }
            Command::Quit => event_loop.exit(),
        }
        self.redraw();
    }

    /// Locks the wall for visitors and hides what is not for them, or unlocks it.
    fn toggle_lock(&mut self) {
        self.is_locked = !self.is_locked;
        if self.is_locked {
            (self.overlay.panel, self.overlay.help) = (false, false);
            (self.overlay.files, self.overlay.tint) = (None, Tint::None);
            self.overlay.pick = None;
            self.show_note("Locked: visitors can steer; Ctrl+L unlocks");
        } else {
            self.show_note("Unlocked");
        }
    }

    fn set_division(&mut self, division: Division) {
        tracing::info!("dividing frames {}", division.name());
        self.farm.update_goal(|wanted| {
            wanted.division = division;
            wanted.moved_at = Instant::now();
        });
        // To be seen at once: in coarse frames first.
        self.refinement.start_again();
        self.want_picture();
    }

    fn set_refining(&mut self, is_on: bool) {
        self.refinement.set_on(is_on);
        self.want_picture();
        self.show_note(if is_on { "The resolution follows the motion" } else { "All frames have the same resolution" });
    }

    fn set_storage(&mut self, storage: Option<Storage>) {
        let density = self.overlay.structure.unwrap_or_default().density;
        self.set_structure(storage.map(|storage| Structure { storage, density }));
    }

    fn set_density(&mut self, density: u32) {
        let storage = self.overlay.structure.unwrap_or_default().storage;
        self.set_structure(Some(Structure { storage, density: density.into() }));
    }

    fn set_structure(&mut self, structure: Option<Structure>) {
        self.overlay.structure = structure;
        self.farm.set_structure(structure);
        self.show_note(match structure {
            Some(Structure { storage, density }) => format!("Grids become {storage}, {density} cells a triangle"),
            None => "Grids become as the render servers were started".to_owned(),
        });
    }

    fn set_view(&mut self, view: ShadingMode) {
        self.view = view;
        self.want_picture();
    }

    fn set_rays(&mut self, rays: LightingMode) {
        self.rays = rays;
        self.want_picture();
    }

    fn set_appearance(&mut self, appearance: Appearance) {
        self.appearance = appearance;
        self.want_picture();
    }

    fn next_clip(&mut self) {
        let from = match self.appearance.clip {
            None => Some(ClipSide::ALL[0]),
            Some(clip) => {
                let index = ClipSide::ALL.iter().position(|&from| from == clip.side());
                index.and_then(|index| ClipSide::ALL.get(index + 1)).copied()
            }
        };
        self.show_note(from.map_or("Whole again".to_owned(), |from| format!("Cut open from {}", from.name())));
        self.set_appearance(Appearance {
            clip: from.map(|from| Clip::with_side(from, self.appearance.clip)),
            ..self.appearance
        });
    }

    fn fill(&mut self, event_loop: &ActiveEventLoop, is_filling: bool) {
        self.outputs.fill(event_loop, is_filling);
        self.hold_screensaver();
        self.cursor_moved_at = Instant::now();
        self.outputs.show_cursor(true);
    }

    /// Holds the screensaver off while windows fill their monitors.
    pub(super) fn hold_screensaver(&mut self) {
        if self.outputs.is_filling() != self.screensaver.is_some() {
            self.screensaver = self.outputs.is_filling().then(ScreensaverHold::new).flatten();
        }
    }

    fn take_screenshot(&mut self) {
        let (Some(painter), Some(_)) = (self.outputs.painter(), &self.frame) else {
            self.show_problem("no screenshot: nothing has been rendered yet".to_owned());
            return;
        };
        match painter.image(&self.options.wall) {
            Ok(image) => {
                let folder = self.options.screenshot_folder.clone();
                self.jobs.add(move || screenshots::write(&folder, &image));
            }
            Err(error) => self.show_problem(format!("no screenshot: {error}")),
        }
    }

    pub(super) fn write_last_picture(&mut self, path: &Path) -> anyhow::Result<()> {
        let (Some(painter), Some(_)) = (self.outputs.painter(), &self.frame) else {
            anyhow::bail!("no screenshot {}: the window was closed before anything was rendered", path.display());
        };
        painter.image(&self.options.wall)?.write_png(path)?;
        tracing::info!("wrote {}", path.display());
        Ok(())
    }

    pub(super) fn cursor_moved(&mut self, index: usize, event: &WindowEvent, position: PhysicalPosition<f64>) {
        let was_over_overlay = self.cursor_is_over_overlay();
        (self.cursor, self.cursor_output) = (position, index);
        self.cursor_moved_at = Instant::now();
        self.touch();
        self.pressed_at.take_if(|from| (from.x - position.x).hypot(from.y - position.y) > CLICK_PIXELS);
        self.outputs.show_cursor(true);
        self.align_cursor();
        let point = self.point_on_canvas();
        if self.navigator.as_mut().is_some_and(|navigator| navigator.move_to(point)) {
            self.want_picture();
        }
        let is_over_overlay = was_over_overlay || self.cursor_is_over_overlay();
        if self.overlay_is_pressed || (is_over_overlay && !self.is_dragging()) {
            self.forward_to_overlay(index, event);
        }
    }

    pub(super) fn mouse_button(&mut self, index: usize, event: &WindowEvent, state: ElementState, button: MouseButton) {
        // Who has seen a button go down sees it come up.
        let is_for_overlay = self.overlay_is_pressed || (self.cursor_is_over_overlay() && !self.is_dragging());
        if is_for_overlay {
            self.overlay_is_pressed = state == ElementState::Pressed;
            return self.forward_to_overlay(index, event);
        }
        self.touch();
        if self.align_button(state, button) {
            return;
        }
        let is_click = state == ElementState::Released && self.pressed_at.take().is_some();
        self.pressed_at = (state == ElementState::Pressed && button == MouseButton::Left).then_some(self.cursor);
        let Some(navigator) = &mut self.navigator else { return };
        match (state, button, self.modifiers.shift_key()) {
            (ElementState::Released, ..) => {
                navigator.release();
                if is_click && !self.is_locked {
                    self.click();
                }
            }
            (_, MouseButton::Left, false) => navigator.press(Drag::Orbit),
            (_, MouseButton::Left, true) | (_, MouseButton::Middle, _) => navigator.press(Drag::Pan),
            (_, MouseButton::Right, _) => navigator.press(Drag::Dolly),
            _ => {}
        }
    }

    fn is_dragging(&self) -> bool {
        self.navigator.as_ref().is_some_and(Navigator::is_dragging)
    }

    pub(super) fn wheel(&mut self, index: usize, event: &WindowEvent, delta: MouseScrollDelta) {
        if self.cursor_is_over_overlay() {
            return self.forward_to_overlay(index, event);
        }
        let notches = match delta {
            MouseScrollDelta::LineDelta(_, lines) => f64::from(lines),
            MouseScrollDelta::PixelDelta(pixels) => pixels.y / PIXELS_PER_NOTCH,
        };
        self.touch();
        // The first notch goes by the model's middle; the answer is here before the next.
        if self.navigator.as_ref().is_some_and(Navigator::needs_surface) {
            self.probe(Purpose::Approach);
        }
        if self.navigator.as_mut().is_some_and(|navigator| navigator.wheel(notches)) {
            self.want_picture();
        }
    }

    /// The cursor as a fraction of the canvas, (0, 0) lower left.
    pub(super) fn point_on_canvas(&self) -> DVec2 {
        self.options.wall.canvas_at(self.cursor_on_output())
    }

    fn cursor_is_over_overlay(&self) -> bool {
        let point = self.outputs.on_overlay(self.cursor_output, self.cursor);
        point.is_some_and(|point| self.overlay_areas.iter().any(|area| area.contains(point)))
    }

    pub(super) fn forward_to_overlay(&mut self, index: usize, event: &WindowEvent) {
        if self.overlay_is_visible() {
            self.outputs.forward_to_overlay(index, event);
            self.redraw();
        }
    }
}

/// The one after `current`, and after the last the first.
fn next<T: Copy + PartialEq>(all: &[T], current: T) -> T {
    let index = all.iter().position(|&one| one == current).map_or(0, |index| index + 1);
    all[index % all.len()]
}

/// The named one after `current`, and after the last or one without a name the first.
fn next_of<T: Copy + PartialEq>(all: &[(&'static str, T)], current: T) -> (&'static str, T) {
    let index = all.iter().position(|&(_, one)| one == current).map_or(0, |index| index + 1);
    all[index % all.len()]
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
