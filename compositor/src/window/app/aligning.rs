//! Test patterns and corners in the window: keys and mouse go to [`crate::control::alignment`], and what it shows to the
//! screen.

use glam::DVec2;
use winit::{
    event::{ElementState, KeyEvent, MouseButton},
    keyboard::{Key, NamedKey},
};

use super::App;
use crate::wall::Wall;

/// What an arrow key moves a corner by, in pixels, and with Shift.
const NUDGE_PX: [f64; 2] = [1.0, 0.1];

impl App<'_> {
    pub(super) fn next_pattern(&mut self) {
        self.alignment.next_pattern();
        match self.alignment.pattern() {
            Some(pattern) => self.show_note(format!("{}: {}", pattern.name(), pattern.help())),
            None => self.show_note("No test pattern"),
        }
        self.pattern_changed();
    }

    pub(super) fn save_corners(&mut self) {
        match self.alignment.save(&self.options.wall) {
            Ok(note) => {
                tracing::info!("{note}");
                self.show_note(note);
            }
            Err(problem) => {
                tracing::error!("{problem}");
                self.error = Some(problem.to_string());
            }
        }
    }

    /// Does what a key asks for while corners are moved, and says whether it was one of those keys.
    pub(super) fn align_key(&mut self, event: &KeyEvent) -> bool {
        let Key::Named(key) = event.logical_key else { return false };
        let is_ours = match key {
            NamedKey::Escape => self.alignment.pattern().is_some(),
            NamedKey::Tab | NamedKey::ArrowUp | NamedKey::ArrowDown | NamedKey::ArrowLeft | NamedKey::ArrowRight => {
                self.alignment.takes_corners()
            }
            _ => false,
        };
        if self.is_locked || !is_ours || event.state != ElementState::Pressed {
            // A key that was pressed before the pattern came is let go as the key that it was.
            return false;
        }
        let step = |x: f64, y: f64| DVec2::new(x, y) * NUDGE_PX[usize::from(self.modifiers.shift_key())];
        let moved = |by_px| self.alignment.moved(&self.options.wall, by_px);
        match key {
            NamedKey::Escape => self.alignment.show(None),
            NamedKey::Tab => self.alignment.next_corner(&self.options.wall),
            NamedKey::ArrowUp => self.set_wall(moved(step(0.0, -1.0))),
            NamedKey::ArrowDown => self.set_wall(moved(step(0.0, 1.0))),
            NamedKey::ArrowLeft => self.set_wall(moved(step(-1.0, 0.0))),
            _ => self.set_wall(moved(step(1.0, 0.0))),
        }
        self.pattern_changed();
        true
    }

    /// Grabs a corner or lets it go, and says whether mouse buttons are for that now.
    pub(super) fn align_button(&mut self, state: ElementState, button: MouseButton) -> bool {
        if self.is_locked || !self.alignment.takes_corners() || button != MouseButton::Left {
            return false;
        }
        match state {
            ElementState::Pressed => {
                let at = self.cursor_on_output();
                self.alignment.press(&self.options.wall, at);
            }
            ElementState::Released => self.alignment.release(),
        }
        self.pattern_changed();
        true
    }

    /// The grabbed corner follows the cursor.
    pub(super) fn align_cursor(&mut self) {
        if self.alignment.is_dragging() {
            let at = self.cursor_on_output();
            self.set_wall(self.alignment.drag_to(&self.options.wall, at));
            self.pattern_changed();
        }
    }

    fn set_wall(&mut self, wall: Option<Wall>) {
        if let Some(wall) = wall {
            self.options.wall = wall;
        }
    }

    /// The cursor in pixels of the output that spans all projectors.
    pub(super) fn cursor_on_output(&self) -> DVec2 {
        self.outputs.on_wall(self.cursor_output, self.cursor)
    }

    /// What has changed is drawn with the next picture: a hand may move faster than patterns are drawn.
    fn pattern_changed(&mut self) {
        self.pattern_is_stale = true;
        self.redraw();
    }

    /// Brings the pattern on screen up to date.
    pub(super) fn refresh_pattern(&mut self) {
        if !std::mem::take(&mut self.pattern_is_stale) {
            return;
        }
        let shown = self.alignment.shown(&self.options.wall).transpose();
        let Some(painter) = self.outputs.painter() else { return };
        let outcome = shown.and_then(|shown| Ok(painter.show_pattern(shown)?));
        if let Err(problem) = outcome {
            self.error = Some(problem.to_string());
            self.alignment.show(None);
            // Frames again: taking a pattern away cannot fail.
            let _ = painter.show_pattern(None);
        }
    }
}
