//! The camera under mouse and keys. Pure: no window, no clock.

use glam::{DVec2, DVec3};
use shared::camera::{Camera, UpAxis};

use crate::input::Direction;

/// What a drag with the mouse does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drag {
    /// Turns around the middle of the model.
    Orbit,
    /// Moves the model with the cursor.
    Pan,
    /// Moves nearer (up) or farther (down).
    Dolly,
}

/// The camera under mouse and keys.
///
/// Points on the canvas are fractions of its width and height, (0, 0) lower left.
#[derive(Clone, Debug)]
pub struct Navigator {
    camera: Camera,
    bounds: (DVec3, DVec3),
    up: UpAxis,
    aspect: f64,
    cursor: DVec2,
    drag: Option<Drag>,
    held: Vec<Direction>,
}

/// A drag over the canvas's whole height turns the model by half a turn.
const ORBIT_RADIANS_PER_HEIGHT: f64 = std::f64::consts::PI;
/// A drag over the canvas's whole height changes the distance by this factor.
const DOLLY_FACTOR_PER_HEIGHT: f64 = 8.0;
/// One notch of the wheel changes the distance by this factor.
const DOLLY_FACTOR_PER_NOTCH: f64 = 1.15;
/// Flying crosses the model in this many seconds.
const SECONDS_TO_CROSS: f64 = 2.5;
/// After a pause, no step is longer than this: one slow frame must not throw the eye through the model.
const LONGEST_STEP_SECONDS: f64 = 0.1;
/// Nearer than this part of the model's size, pan and dolly go on as if the middle of the model were this far.
const NEAREST: f64 = 0.05;

impl Navigator {
    /// Sees all of a box, given by its corners in world space, on a canvas of `aspect`, its width over its height.
    pub fn new(bounds: (DVec3, DVec3), up: UpAxis, aspect: f64) -> Self {
        let camera = Camera::view_all(bounds.0, bounds.1, up, aspect);
        Self { camera, bounds, up, aspect, cursor: DVec2::splat(0.5), drag: None, held: Vec::new() }
    }

    /// The same, seen through another camera.
    #[must_use]
    pub fn with_camera(self, camera: Camera) -> Self {
        Self { camera, ..self }
    }

    /// The camera as it is now.
    pub fn camera(&self) -> Camera {
        self.camera
    }

    /// The axis that points up.
    pub fn up(&self) -> UpAxis {
        self.up
    }

    /// Looks at another model, all of it; drags and keys that are held stay so.
    pub fn set_bounds(&mut self, bounds: (DVec3, DVec3)) {
        self.bounds = bounds;
        self.view_all();
    }

    /// Sees all of the model.
    pub fn view_all(&mut self) {
        self.camera = Camera::view_all(self.bounds.0, self.bounds.1, self.up, self.aspect);
    }

    /// Takes the next axis as up.
    ///
    /// Sees all of the model afresh: turned in place, the eye would end up above or below it.
    pub fn next_up_axis(&mut self) {
        self.up = self.up.next();
        self.view_all();
    }

    /// A mouse button went down.
    pub fn press(&mut self, drag: Drag) {
        self.drag = Some(drag);
    }

    /// The mouse button is up again.
    pub fn release(&mut self) {
        self.drag = None;
    }

    /// Whether a mouse button is down.
    pub fn is_dragging(&self) -> bool {
        self.drag.is_some()
    }

    /// The cursor moved to a point on the canvas, or beyond its edge; says whether the camera moved with it.
    pub fn move_to(&mut self, point: DVec2) -> bool {
        let by = point - self.cursor;
        self.cursor = point;
        let before = self.camera;
        match self.drag {
            None => {}
            Some(Drag::Orbit) => {
                // The model follows the hand, so the eye goes the other way.
                let yaw = -by.x * self.aspect * ORBIT_RADIANS_PER_HEIGHT;
                let pitch = -by.y * ORBIT_RADIANS_PER_HEIGHT;
                self.camera = self.camera.orbit(self.pivot(), self.up, yaw, pitch);
            }
            Some(Drag::Pan) => self.camera = self.camera.pan(self.depth(), by.x, by.y),
            Some(Drag::Dolly) => {
                self.camera =
                    self.camera.dolly(self.point_under(DVec2::splat(0.5)), DOLLY_FACTOR_PER_HEIGHT.powf(-by.y));
            }
        }
        self.camera != before
    }

    /// The wheel turned, positive away from the person: nearer to what is under the cursor.
    pub fn wheel(&mut self, notches: f64) -> bool {
        let before = self.camera;
        let notches = notches.clamp(-20.0, 20.0);
        self.camera = self.camera.dolly(self.point_under(self.cursor), DOLLY_FACTOR_PER_NOTCH.powf(-notches));
        self.camera != before
    }

    /// A key to fly with went down.
    pub fn hold(&mut self, direction: Direction) {
        if !self.held.contains(&direction) {
            self.held.push(direction);
        }
    }

    /// A key to fly with is up again.
    pub fn let_go(&mut self, direction: Direction) {
        self.held.retain(|&held| held != direction);
    }

    /// Everything is let go, as when the window loses the keyboard.
    pub fn let_go_of_all(&mut self) {
        self.held.clear();
        self.drag = None;
    }

    /// Whether time moves the camera.
    pub fn is_flying(&self) -> bool {
        !self.held.is_empty()
    }

    /// Flies on for some seconds, `speed` times as fast as usual; says whether the camera moved.
    pub fn fly(&mut self, seconds: f64, speed: f64) -> bool {
        let before = self.camera;
        let step = self.size() / SECONDS_TO_CROSS * seconds.clamp(0.0, LONGEST_STEP_SECONDS) * speed;
        let held = |direction| if self.held.contains(&direction) { step } else { 0.0 };
        self.camera = self.camera.fly(
            held(Direction::Right) - held(Direction::Left),
            held(Direction::Up) - held(Direction::Down),
            held(Direction::Forward) - held(Direction::Backward),
        );
        self.camera != before
    }

    /// The middle of the model, or of space if the model has none.
    fn pivot(&self) -> DVec3 {
        let (min, max) = self.bounds;
        if min.cmple(max).all() { (min + max) * 0.5 } else { DVec3::ZERO }
    }

    /// The length of the box's diagonal in world units.
    fn size(&self) -> f64 {
        let (min, max) = self.bounds;
        let size = if min.cmple(max).all() { (max - min).length() } else { 0.0 };
        if size > 0.0 && size.is_finite() { size } else { 1.0 }
    }

    /// How far the pivot lies in front of the eye, perpendicular to the view plane, and never too near to move by.
    fn depth(&self) -> f64 {
        let (normal, _) = self.view_plane();
        (self.pivot() - self.camera.eye()).dot(normal).max(self.size() * NEAREST)
    }

    /// The point at the pivot's depth that is seen at a point of the canvas.
    fn point_under(&self, point: DVec2) -> DVec3 {
        let (_, distance) = self.view_plane();
        let eye = self.camera.eye();
        let on_plane = self.camera.ll() + self.camera.u() * point.x + self.camera.v() * point.y;
        eye + (on_plane - eye) * (self.depth() / distance)
    }

    /// The unit vector from the eye to the view plane, perpendicular to it, and their distance.
    fn view_plane(&self) -> (DVec3, f64) {
        let normal = self.camera.u().cross(self.camera.v()).normalize();
        let distance = (self.camera.ll() - self.camera.eye()).dot(normal);
        (normal * distance.signum(), distance.abs())
    }
}
#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const ASPECT: f64 = 16.0 / 9.0;

    fn navigator() -> Navigator {
        Navigator::new((DVec3::ZERO, DVec3::new(1.0, 2.0, 1.0)), UpAxis::Y, ASPECT)
    }

    /// Where a point appears on the canvas.
    fn seen_at(camera: &Camera, point: DVec3) -> DVec2 {
        let normal = camera.u().cross(camera.v());
        let ray = point - camera.eye();
        let on_plane = camera.eye() + ray * ((camera.ll() - camera.eye()).dot(normal) / ray.dot(normal)) - camera.ll();
        DVec2::new(
            on_plane.dot(camera.u()) / camera.u().length_squared(),
            on_plane.dot(camera.v()) / camera.v().length_squared(),
        )
    }

    #[test]
    fn the_mouse_moves_nothing_unless_a_button_is_down() {
        let mut navigator = navigator();
        assert!(!navigator.move_to(DVec2::new(0.1, 0.9)));
        navigator.press(Drag::Orbit);
        assert!(navigator.move_to(DVec2::new(0.2, 0.9)));
        navigator.release();
        assert!(!navigator.move_to(DVec2::new(0.5, 0.5)));
    }

    #[test]
    fn an_orbited_model_follows_the_hand() {
        let mut navigator = navigator();
        // The point of the model that faces the eye.
        let front = navigator.pivot() + (navigator.camera().eye() - navigator.pivot()).normalize() * 0.1;
        let before = seen_at(&navigator.camera(), front);
        navigator.press(Drag::Orbit);
        navigator.move_to(DVec2::new(0.55, 0.55));
        let after = seen_at(&navigator.camera(), front);
        assert!(after.x > before.x && after.y > before.y, "{before} {after}");
        let middle = seen_at(&navigator.camera(), navigator.pivot());
        assert!((middle - DVec2::splat(0.5)).length() < 1e-9, "the pivot moved to {middle}");
    }

    #[test]
    fn a_panned_model_stays_under_the_cursor() {
        let mut navigator = navigator();
        navigator.press(Drag::Pan);
        navigator.move_to(DVec2::new(0.7, 0.4));
        let middle = seen_at(&navigator.camera(), navigator.pivot());
        assert!((middle - DVec2::new(0.7, 0.4)).length() < 1e-9, "{middle}");
    }

    #[test]
    fn the_wheel_keeps_what_is_under_the_cursor_there() {
        let mut navigator = navigator();
        navigator.move_to(DVec2::new(0.3, 0.6));
        let point = navigator.point_under(DVec2::new(0.3, 0.6));
        let depth = navigator.depth();
        assert!(navigator.wheel(3.0));
        assert!(navigator.depth() < depth);
        assert!((seen_at(&navigator.camera(), point) - DVec2::new(0.3, 0.6)).length() < 1e-9);
        assert!(navigator.wheel(-3.0));
        assert!((navigator.depth() - depth).abs() < 1e-9);
    }

    #[test]
    fn the_wheel_goes_through_the_model_rather_than_stop_at_its_middle() {
        let mut navigator = navigator();
        (0..200).for_each(|_| _ = navigator.wheel(1.0));
        let (forward, _) = navigator.view_plane();
        assert!((navigator.camera().eye() - navigator.pivot()).dot(forward) > navigator.size() * 0.5);
    }

    #[test]
    fn flying_takes_time_and_opposite_keys_cancel() {
        let mut navigator = navigator();
        let eye = navigator.camera().eye();
        assert!(!navigator.fly(0.05, 1.0));
        navigator.hold(Direction::Forward);
        navigator.hold(Direction::Forward);
        assert!(navigator.is_flying() && navigator.fly(0.05, 1.0));
        let step = (navigator.camera().eye() - eye).length();
        assert!((step - navigator.size() * 0.02).abs() < 1e-9, "{step}");
        navigator.hold(Direction::Backward);
        assert!(!navigator.fly(0.05, 1.0));
        navigator.let_go(Direction::Backward);
        navigator.fly(3600.0, 1.0);
        assert!((navigator.camera().eye() - eye).length() < navigator.size() * 0.1, "a pause threw the eye away");
        navigator.let_go_of_all();
        assert!(!navigator.is_flying());
    }

    #[test]
    fn view_all_and_up_axis_start_afresh() {
        let mut navigator = navigator();
        let camera = navigator.camera();
        navigator.press(Drag::Orbit);
        navigator.move_to(DVec2::new(0.9, 0.1));
        navigator.view_all();
        assert_eq!(navigator.camera(), camera);
        for _ in UpAxis::ALL {
            navigator.next_up_axis();
            let up = navigator.up().direction();
            assert!(navigator.camera().v().dot(up) > 0.0);
        }
        assert_eq!(navigator.camera(), camera);
    }

    proptest! {
        #[test]
        fn nothing_that_a_person_does_breaks_the_camera(
            corner in -1e6..1e6f64, size in prop_oneof![Just(0.0), 1e-6..1e6f64, Just(f64::NEG_INFINITY)],
            steps in proptest::collection::vec((0..7u8, -2.0..2.0f64, -2.0..2.0f64), 1..60),
        ) {
            let bounds = (DVec3::splat(corner), DVec3::splat(corner + size));
            let mut navigator = Navigator::new(bounds, UpAxis::Z, ASPECT);
            for (kind, a, b) in steps {
                match kind {
                    0 => navigator.press(Drag::Orbit),
                    1 => navigator.press(Drag::Pan),
                    2 => navigator.press(Drag::Dolly),
                    3 => _ = navigator.wheel(a * 20.0),
                    4 => { navigator.hold(Direction::Forward); navigator.fly(a, 4.0); }
                    5 => navigator.next_up_axis(),
                    _ => navigator.release(),
                }
                navigator.move_to(DVec2::new(a, b));
                let camera = navigator.camera();
                prop_assert!(Camera::new(camera.eye(), camera.ll(), camera.u(), camera.v()).is_ok());
            }
        }
    }
}
