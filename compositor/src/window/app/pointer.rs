//! Where the mouse is, and whether it clicks or drags. Pure: time is an argument.

use std::time::{Duration, Instant};

use glam::DVec2;
use winit::dpi::PhysicalPosition;

/// A press that moves less than this, in pixels, is a click.
const CLICK_PIXELS: f64 = 4.0;
/// The longest time between the clicks of a double click, and their largest distance as a fraction of the canvas.
const DOUBLE_CLICK: (Duration, f64) = (Duration::from_millis(400), 0.01);
/// The cursor of a full-screen wall disappears after this time at rest.
const CURSOR_REST: Duration = Duration::from_secs(2);

#[derive(Debug)]
pub(super) struct Pointer {
    /// The output whose window has the cursor.
    pub(super) output_idx: usize,
    /// The cursor in pixels of that window.
    pub(super) position: PhysicalPosition<f64>,
    /// A button went down on the overlay and is still down.
    pub(super) overlay_is_pressed: bool,
    moved_at: Instant,
    /// Where the left button went down on the model, until the cursor has moved away.
    pressed_at: Option<PhysicalPosition<f64>>,
    /// Time and place of the last single click.
    clicked: Option<(Instant, DVec2)>,
}

impl Pointer {
    pub(super) fn new(now: Instant) -> Self {
        let position = PhysicalPosition::default();
        Self { output_idx: 0, position, overlay_is_pressed: false, moved_at: now, pressed_at: None, clicked: None }
    }

    /// Moves the cursor within a window, or into another.
    pub(super) fn move_to(&mut self, output_idx: usize, position: PhysicalPosition<f64>, now: Instant) {
        (self.output_idx, self.position) = (output_idx, position);
        self.pressed_at.take_if(|from| (from.x - position.x).hypot(from.y - position.y) > CLICK_PIXELS);
        self.show(now);
    }

    pub(super) fn show(&mut self, now: Instant) {
        self.moved_at = now;
    }

    pub(super) fn hides_at(&self) -> Instant {
        self.moved_at + CURSOR_REST
    }

    /// A button went down on the model; only the left one can click.
    pub(super) fn press(&mut self, is_left: bool) {
        self.pressed_at = is_left.then_some(self.position);
    }

    /// A button went up; returns whether that makes a click.
    pub(super) fn release(&mut self) -> bool {
        self.pressed_at.take().is_some()
    }

    /// Whether a click at a point of the canvas is the second of a double click.
    pub(super) fn is_double_click(&mut self, at: DVec2, now: Instant) -> bool {
        let is_second = self.clicked.is_some_and(|(clicked_at, point)| {
            now.duration_since(clicked_at) <= DOUBLE_CLICK.0 && (at - point).length() <= DOUBLE_CLICK.1
        });
        self.clicked = (!is_second).then_some((now, at));
        is_second
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drag_is_no_click() {
        let now = Instant::now();
        let mut pointer = Pointer::new(now);
        pointer.press(true);
        pointer.move_to(0, PhysicalPosition::new(2.0, 2.0), now);
        assert!(pointer.release() && !pointer.release());
        pointer.press(true);
        pointer.move_to(0, PhysicalPosition::new(9.0, 2.0), now);
        pointer.move_to(0, PhysicalPosition::new(2.0, 2.0), now);
        assert!(!pointer.release());
        pointer.press(false);
        assert!(!pointer.release());
    }

    #[test]
    fn two_near_clicks_soon_after_each_other_are_a_double_click() {
        let start = Instant::now();
        let mut pointer = Pointer::new(start);
        let mut click = |x, ms| pointer.is_double_click(DVec2::new(x, 0.5), start + Duration::from_millis(ms));
        assert!(!click(0.5, 0) && click(0.505, 300));
        assert!(!click(0.5, 400), "a third click begins anew");
        assert!(!click(0.8, 500) && !click(0.8, 1000));
    }
}
