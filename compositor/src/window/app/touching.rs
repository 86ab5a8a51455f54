//! Touch screens and touchpads: fingers steer the camera, or belong to the overlay's panels.

use std::time::Instant;

use glam::DVec2;
use winit::{
    dpi::PhysicalPosition,
    event::{Touch, TouchPhase, WindowEvent},
};

use super::{App, probing::Purpose};
use crate::control::{
    navigator::{Drag, Nudge},
    touch::{FingerId, Tap, Touches},
};

/// The largest change of distance by one event of a touchpad, and one over the smallest.
const LARGEST_FACTOR: f64 = 20.0;

/// The fingers on the wall's windows.
pub(super) struct TouchControl {
    touches: Touches,
    /// Those that came down on a panel: the overlay gets all that they do.
    of_overlay: Vec<FingerId>,
    /// The one that drags a projector's corner.
    aligning: Option<FingerId>,
}

impl TouchControl {
    /// For a canvas with this aspect (width over height).
    pub(super) fn new(aspect: f64) -> Self {
        Self { touches: Touches::new(aspect), of_overlay: Vec::new(), aligning: None }
    }

    /// All fingers are gone, as when the window loses the focus.
    pub(super) fn lift_all(&mut self) {
        self.touches.lift_all();
        self.of_overlay.clear();
        self.aligning = None;
    }
}

impl App<'_> {
    pub(super) fn touch(&mut self, index: usize, event: &WindowEvent, touch: &Touch) {
        let Touch { phase, location, id, .. } = *touch;
        let (finger, now) = ((index, id), Instant::now());
        self.kiosk.touch(now);
        let is_down = phase == TouchPhase::Started;
        if is_down && self.is_over_overlay(index, location) {
            self.fingers.of_overlay.push(finger);
        }
        if self.fingers.of_overlay.contains(&finger) {
            if matches!(phase, TouchPhase::Ended | TouchPhase::Cancelled) {
                self.fingers.of_overlay.retain(|of_overlay| *of_overlay != finger);
            }
            return self.forward_to_overlay(index, event);
        }
        if is_down && self.outputs.field_has_focus() {
            self.outputs.take_focus();
            self.redraw();
        }
        let on_output = self.outputs.on_wall(index, location);
        if self.touch_corner(finger, phase, on_output) {
            return self.redraw();
        }
        let at = self.wall.wall.canvas_at(on_output);
        let touches = &mut self.fingers.touches;
        match phase {
            TouchPhase::Started => {
                if self.touch_show() {
                    return self.redraw();
                }
                self.fingers.touches.down(finger, at, now);
            }
            TouchPhase::Moved => {
                let nudges = touches.move_to(finger, at);
                self.nudge_all(nudges);
            }
            TouchPhase::Ended => {
                if let Some(tap) = touches.up(finger, now) {
                    self.pointer.move_to(index, location, now);
                    self.tap(tap);
                }
            }
            TouchPhase::Cancelled => touches.lift(finger),
        }
    }

    /// Drags a corner of a projector while the pattern for that is shown. Returns whether the finger does that.
    fn touch_corner(&mut self, finger: FingerId, phase: TouchPhase, on_output: DVec2) -> bool {
        if phase == TouchPhase::Started
            && self.fingers.aligning.is_none()
            && !self.kiosk.is_locked
            && self.wall.takes_corners()
        {
            self.fingers.aligning = Some(finger);
            self.wall.press(on_output);
            return true;
        }
        let is_aligning = self.fingers.aligning == Some(finger);
        match phase {
            _ if !is_aligning => {}
            TouchPhase::Started | TouchPhase::Moved => _ = self.wall.drag_to(on_output),
            TouchPhase::Ended | TouchPhase::Cancelled => {
                self.wall.release();
                self.fingers.aligning = None;
            }
        }
        is_aligning
    }

    /// A tap clicks; two of them go to the point, on a locked wall too.
    fn tap(&mut self, Tap { at, is_double }: Tap) {
        if is_double && self.kiosk.is_locked {
            self.probe_at(Purpose::GoTo, at);
        } else {
            self.click(at, |_| is_double);
        }
    }

    /// A touchpad, or the system in place of a touch screen, has seen a gesture at the cursor.
    pub(super) fn gesture(&mut self, index: usize, event: &WindowEvent) {
        if self.cursor_is_over_overlay() {
            return self.forward_to_overlay(index, event);
        }
        self.kiosk.touch(Instant::now());
        if self.touch_show() {
            return self.redraw();
        }
        let at = self.point_on_canvas().clamp(DVec2::ZERO, DVec2::ONE);
        let nudge = match *event {
            WindowEvent::PinchGesture { delta, .. } if delta.is_finite() => {
                let factor = 1.0 / (1.0 + delta).max(1.0 / LARGEST_FACTOR);
                Nudge::Dolly { factor: factor.max(1.0 / LARGEST_FACTOR), at }
            }
            WindowEvent::PanGesture { delta, .. } => {
                let from = self.pointer.position;
                let to = PhysicalPosition::new(from.x + f64::from(delta.x), from.y + f64::from(delta.y));
                let on_canvas = |at| self.wall.wall.canvas_at(self.outputs.on_wall(index, at));
                Nudge::Drag(Drag::Pan, on_canvas(to) - on_canvas(from))
            }
            // winit counts to the left too, in degrees.
            WindowEvent::RotationGesture { delta, .. } => Nudge::Roll(f64::from(delta).to_radians()),
            WindowEvent::DoubleTapGesture { .. } => {
                self.probe_at(Purpose::GoTo, at);
                return;
            }
            _ => return,
        };
        self.nudge_all([nudge]);
    }

    /// Moves the camera, and makes one picture of all of it.
    fn nudge_all(&mut self, nudges: impl IntoIterator<Item = Nudge>) {
        let has_moved = nudges.into_iter().fold(false, |has_moved, nudge| self.nudge(nudge) | has_moved);
        if has_moved {
            self.want_picture();
        }
    }
}
