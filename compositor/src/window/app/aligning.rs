//! Test patterns and corners in the window: passes keys and mouse to [`crate::control::alignment`], and patterns to the
//! painter.

use glam::DVec2;
use winit::keyboard::NamedKey;

use super::effect::Effect;
use crate::{
    control::alignment::Alignment,
    wall::Wall,
    window::{options::WindowOptions, painter::Painter},
};

/// The distance that an arrow key moves a corner, in pixels: alone, and with Shift.
const NUDGE_PX: [f64; 2] = [1.0, 0.1];

/// The wall, whose corners can be moved while a test pattern is on it.
pub(super) struct WallControl {
    wall: Wall,
    alignment: Alignment,
    /// The pattern on screen is out of date.
    is_stale: bool,
}

impl WallControl {
    pub(super) fn new(options: &WindowOptions) -> Self {
        let alignment = Alignment::new(options.wall_file.clone());
        Self { wall: options.wall.clone(), alignment, is_stale: false }
    }

    pub(super) fn wall(&self) -> &Wall {
        &self.wall
    }

    pub(super) fn next_pattern(&mut self) -> Effect {
        self.alignment.next_pattern();
        self.is_stale = true;
        match self.alignment.pattern() {
            Some(pattern) => Effect::note(format!("{}: {}", pattern.name(), pattern.help())),
            None => Effect::note("No test pattern"),
        }
    }

    pub(super) fn save_corners(&self) -> Effect {
        self.alignment.save(&self.wall).map_or_else(|problem| Effect::problem(problem.to_string()), Effect::note)
    }

    /// Moves the selected corner, selects the next, or ends the pattern; `false` for keys that do none of that now.
    pub(super) fn press_key(&mut self, key: NamedKey, has_shift: bool) -> bool {
        let arrow = match key {
            NamedKey::ArrowUp => DVec2::NEG_Y,
            NamedKey::ArrowDown => DVec2::Y,
            NamedKey::ArrowLeft => DVec2::NEG_X,
            NamedKey::ArrowRight => DVec2::X,
            _ => DVec2::ZERO,
        };
        match key {
            NamedKey::Escape if self.alignment.pattern().is_some() => self.alignment.show(None),
            NamedKey::Tab if self.takes_corners() => self.alignment.next_corner(&self.wall),
            _ if self.takes_corners() && arrow != DVec2::ZERO => {
                let moved = self.alignment.moved(&self.wall, arrow * NUDGE_PX[usize::from(has_shift)]);
                self.set_wall(moved);
            }
            _ => return false,
        }
        self.is_stale = true;
        true
    }

    /// Whether the left mouse button moves corners now.
    pub(super) fn takes_corners(&self) -> bool {
        self.alignment.takes_corners()
    }

    /// Grabs the corner near a point of the output, or releases it.
    pub(super) fn grab(&mut self, is_pressed: bool, at: DVec2) {
        if is_pressed {
            self.alignment.press(&self.wall, at);
        } else {
            self.alignment.release();
        }
        self.is_stale = true;
    }

    /// Moves the grabbed corner with the cursor; returns whether one is grabbed.
    pub(super) fn drag_to(&mut self, at: DVec2) -> bool {
        let is_dragging = self.alignment.is_dragging();
        if is_dragging {
            let moved = self.alignment.drag_to(&self.wall, at);
            self.set_wall(moved);
            self.is_stale = true;
        }
        is_dragging
    }

    fn set_wall(&mut self, wall: Option<Wall>) {
        if let Some(wall) = wall {
            self.wall = wall;
        }
    }

    /// Updates the pattern on screen. Once for each redraw: a hand may move faster than patterns are drawn.
    pub(super) fn refresh(&mut self, painter: Option<&mut Painter>) -> Effect {
        if !std::mem::take(&mut self.is_stale) {
            return Effect::default();
        }
        let shown = self.alignment.shown(&self.wall).transpose();
        let Some(painter) = painter else { return Effect::default() };
        let Err(problem) = shown.and_then(|shown| Ok(painter.show_pattern(shown)?)) else { return Effect::default() };
        self.alignment.show(None);
        // Taking a pattern away cannot fail.
        let _ = painter.show_pattern(None);
        Effect::problem(problem.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrows_move_the_selected_corner_of_the_align_pattern_only() {
        let wall = Wall::of_one_output([640, 360]);
        let mut control = WallControl { wall, alignment: Alignment::default(), is_stale: false };
        assert!(!control.press_key(NamedKey::Tab, false) && !control.press_key(NamedKey::Escape, false));
        control.next_pattern();
        assert!(control.press_key(NamedKey::Tab, false) && control.press_key(NamedKey::ArrowRight, false));
        assert!(control.press_key(NamedKey::ArrowDown, true) && !control.press_key(NamedKey::Space, false));
        assert_eq!(control.wall().projectors()[0].warp_px[0], [1.0, 0.1]);
        assert!(control.press_key(NamedKey::Escape, false) && !control.press_key(NamedKey::ArrowDown, false));
    }
}
