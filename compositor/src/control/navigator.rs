//! The camera under mouse and keys. Pure: no window, no clock.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use shared::camera::{Camera, CameraPath, Transition, UpAxis};

use super::input::Direction;

/// What a drag with the mouse does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drag {
    /// Turns around the point that is looked at: the middle of the model unless another is chosen.
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
    /// The point to orbit around, if not the middle of the model.
    focus: Option<DVec3>,
    /// The surface that lies under the cursor, once somebody has said where.
    under_cursor: Option<DVec3>,
    motion: Option<Motion>,
    /// Steps by which flying is faster than usual.
    speed: i32,
}

/// What moves the camera by itself.
#[derive(Clone, Debug)]
enum Motion {
    /// On the way to another view.
    Transition { transition: Box<Transition>, seconds: f64 },
    /// Along a path.
    Play { path: Arc<CameraPath>, seconds: f64, repeats: bool },
}

/// A drag over the canvas's whole height turns the model by half a turn.
const ORBIT_RADIANS_PER_HEIGHT: f64 = std::f64::consts::PI;
/// A drag over the canvas's whole height changes the distance by this factor.
const DOLLY_FACTOR_PER_HEIGHT: f64 = 8.0;
/// One notch of the wheel changes the distance by this factor.
const DOLLY_FACTOR_PER_NOTCH: f64 = 1.15;
/// Flying crosses the model in this many seconds.
const SECONDS_TO_CROSS: f64 = 2.5;
/// A step of speed makes flying so much faster.
const SPEED_FACTOR: f64 = 1.5;
/// No more steps than this either way: a fiftieth of the usual speed, or fifty times as fast.
const MOST_SPEED_STEPS: i32 = 10;
/// The way to another view takes so long.
const TRANSITION_SECONDS: f64 = 0.6;
/// Going to a point of the model leaves this part of the distance to it.
const GO_TO_PART: f64 = 0.4;
/// Nearer to a surface than this part of the model's size, the wheel goes through it.
const PASS_THROUGH_PART: f64 = 1e-3;
/// After a pause, no step is longer than this: one slow frame must not throw the eye through the model.
const LONGEST_STEP_SECONDS: f64 = 0.1;
/// Nearer than this part of the model's size, pan and dolly go on as if the middle of the model were this far.
const LEAST_DEPTH_PART: f64 = 0.05;

impl Navigator {
    /// Sees all of a box, given by its corners in world space, on a canvas of `aspect`, its width over its height.
    pub fn new(bounds: (DVec3, DVec3), up: UpAxis, aspect: f64) -> Self {
        let camera = Camera::view_all(bounds.0, bounds.1, up, aspect);
        Self {
            camera,
            bounds,
            up,
            aspect,
            cursor: DVec2::splat(0.5),
            drag: None,
            held: Vec::new(),
            focus: None,
            under_cursor: None,
            motion: None,
            speed: 0,
        }
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

    /// Where the camera will rest: where it is, unless it is on its way to another view.
    pub fn destination(&self) -> Camera {
        match &self.motion {
            Some(Motion::Transition { transition, .. }) => transition.end(),
            Some(Motion::Play { .. }) | None => self.camera,
        }
    }

    /// Looks at another model at once, all of it; drags and keys that are held stay so.
    pub fn set_bounds(&mut self, bounds: (DVec3, DVec3), up: UpAxis) {
        self.bounds = bounds;
        self.up = up;
        self.focus = None;
        self.motion = None;
        self.set_camera(self.view_all_camera());
    }

    /// Goes to where all of the model is seen.
    pub fn view_all(&mut self) {
        self.focus = None;
        self.go_to(self.view_all_camera());
    }

    /// Takes the next axis as up.
    ///
    /// Sees all of the model afresh: turned in place, the eye would end up above or below it.
    pub fn next_up_axis(&mut self) {
        self.up = self.up.next();
        self.view_all();
    }

    /// Goes to another view.
    pub fn go_to(&mut self, camera: Camera) {
        let (start, end) = ((self.camera, self.depth_of(&self.camera)), (camera, self.depth_of(&camera)));
        let transition = Box::new(Transition::new(start, end, self.up));
        self.motion = (camera != self.camera).then_some(Motion::Transition { transition, seconds: 0.0 });
    }

    /// Goes nearer to a point of the model, in world space, until it is in the middle, to orbit around it from then on.
    pub fn go_to_point(&mut self, point: DVec3) {
        if !point.is_finite() {
            return;
        }
        let distance = (point - self.camera.eye()).length();
        let nearer = self.camera.dolly(point, GO_TO_PART);
        // In the middle: moved sideways, so that the picture does not turn.
        let (forward, plane_distance) = view_plane(&nearer);
        let depth = (point - nearer.eye()).dot(forward);
        let middle = nearer.eye() + (nearer.target() - nearer.eye()) * (depth / plane_distance);
        let aside = point - middle;
        let right = nearer.u().normalize();
        let up = nearer.v().normalize();
        // Solved for both edges, which need not be perpendicular.
        let (a, b, c) = (right.dot(up), aside.dot(right), aside.dot(up));
        let by_up = (c - a * b) / (1.0 - a * a);
        self.focus = Some(point);
        if distance > 0.0 && depth > 0.0 && by_up.is_finite() {
            self.go_to(nearer.fly(b - a * by_up, by_up, 0.0));
        }
    }

    /// Says where the surface under the cursor is, in world space; `None`: nowhere.
    pub fn set_under_cursor(&mut self, point: Option<DVec3>) {
        self.under_cursor = point.filter(|point| point.is_finite());
    }

    /// Whether it would help to know the surface under the cursor.
    pub fn needs_surface(&self) -> bool {
        self.under_cursor.is_none()
    }

    /// Follows a path from its beginning; for ever, if it `repeats`.
    pub fn play(&mut self, path: Arc<CameraPath>, repeats: bool) {
        self.up = path.up();
        self.focus = None;
        self.set_camera(path.at(0.0));
        self.motion = Some(Motion::Play { path, seconds: 0.0, repeats });
    }

    /// Whether the camera follows a path.
    pub fn is_playing(&self) -> bool {
        matches!(self.motion, Some(Motion::Play { .. }))
    }

    /// Stays where the camera is.
    pub fn stop(&mut self) {
        self.motion = None;
    }

    /// A mouse button went down.
    pub fn press(&mut self, drag: Drag) {
        self.motion = None;
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
        if !point.is_finite() {
            return false;
        }
        let by = point - self.cursor;
        self.cursor = point;
        if by != DVec2::ZERO {
            self.under_cursor = None;
        }
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
        self.motion = None;
        let notches = if notches.is_finite() { notches.clamp(-20.0, 20.0) } else { 0.0 };
        let eye = self.camera.eye();
        let surface = self.under_cursor.filter(|point| (*point - eye).length() > self.size() * PASS_THROUGH_PART);
        let point = surface.unwrap_or_else(|| self.point_under(self.cursor));
        self.camera = self.camera.dolly(point, DOLLY_FACTOR_PER_NOTCH.powf(-notches));
        self.camera != before
    }

    /// A key to fly with went down.
    pub fn hold(&mut self, direction: Direction) {
        self.motion = None;
        if !self.held.contains(&direction) {
            self.held.push(direction);
        }
    }

    /// A key to fly with is up again.
    pub fn release_key(&mut self, direction: Direction) {
        self.held.retain(|&held| held != direction);
    }

    /// Everything is let go, as when the window loses the keyboard.
    pub fn release_all(&mut self) {
        self.held.clear();
        self.drag = None;
    }

    /// Whether time moves the camera.
    pub fn is_moving(&self) -> bool {
        !self.held.is_empty() || self.motion.is_some()
    }

    /// Flies faster from now on, by so many steps, or slower; says how many times as fast as usual that is.
    pub fn change_speed(&mut self, steps: i32) -> f64 {
        self.speed = self.speed.saturating_add(steps).clamp(-MOST_SPEED_STEPS, MOST_SPEED_STEPS);
        SPEED_FACTOR.powi(self.speed)
    }

    /// Lets some seconds pass: flies on, `speed` times as fast as chosen, goes on to another view, or follows a path.
    /// Says whether the camera moved.
    pub fn advance(&mut self, seconds: f64, speed: f64) -> bool {
        let before = self.camera;
        let seconds = if seconds > 0.0 { seconds } else { 0.0 };
        match &mut self.motion {
            Some(Motion::Transition { transition, seconds: passed }) => {
                *passed += seconds;
                let fraction = *passed / TRANSITION_SECONDS;
                let camera = transition.at(fraction);
                if fraction >= 1.0 {
                    self.motion = None;
                }
                self.set_camera(camera);
            }
            Some(Motion::Play { path, seconds: passed, repeats }) => {
                *passed += seconds;
                let duration = path.duration_seconds();
                let is_over = *passed >= duration;
                if is_over && *repeats && duration > 0.0 {
                    *passed %= duration;
                }
                let camera = path.at(*passed);
                if is_over && !*repeats {
                    self.motion = None;
                }
                self.set_camera(camera);
            }
            None => self.fly(seconds, speed),
        }
        self.camera != before
    }

    fn fly(&mut self, seconds: f64, speed: f64) {
        // From far away the model is reached in the same time.
        let (size, distance) = (self.size(), (self.camera.eye() - self.pivot()).length());
        let per_second = size.max(distance - size) / SECONDS_TO_CROSS;
        let step = per_second * seconds.min(LONGEST_STEP_SECONDS) * speed * SPEED_FACTOR.powi(self.speed);
        let held = |direction| if self.held.contains(&direction) { step } else { 0.0 };
        let camera = self.camera.fly(
            held(Direction::Right) - held(Direction::Left),
            held(Direction::Up) - held(Direction::Down),
            held(Direction::Forward) - held(Direction::Backward),
        );
        self.set_camera(camera);
    }

    fn set_camera(&mut self, camera: Camera) {
        if camera != self.camera {
            self.camera = camera;
            self.under_cursor = None;
        }
    }

    fn view_all_camera(&self) -> Camera {
        Camera::view_all(self.bounds.0, self.bounds.1, self.up, self.aspect)
    }

    /// The point to orbit around: one that was chosen, the middle of the model, or of space if the model has none.
    fn pivot(&self) -> DVec3 {
        let (min, max) = self.bounds;
        let middle = if min.cmple(max).all() { (min + max) * 0.5 } else { DVec3::ZERO };
        self.focus.unwrap_or(middle)
    }

    /// The length of the box's diagonal in world units.
    fn size(&self) -> f64 {
        let (min, max) = self.bounds;
        let size = if min.cmple(max).all() { (max - min).length() } else { 0.0 };
        if size > 0.0 && size.is_finite() { size } else { 1.0 }
    }

    fn depth(&self) -> f64 {
        self.depth_of(&self.camera)
    }

    /// How far the pivot lies in front of an eye, perpendicular to the view plane, and never too near to move by.
    fn depth_of(&self, camera: &Camera) -> f64 {
        let (forward, _) = view_plane(camera);
        // A point that somebody chose was worth going near to.
        let nearest = if self.focus.is_some() { PASS_THROUGH_PART } else { LEAST_DEPTH_PART };
        (self.pivot() - camera.eye()).dot(forward).max(self.size() * nearest)
    }

    /// The point at the pivot's depth that is seen at a point of the canvas.
    fn point_under(&self, point: DVec2) -> DVec3 {
        let (_, distance) = view_plane(&self.camera);
        let eye = self.camera.eye();
        let on_plane = self.camera.ll() + self.camera.u() * point.x + self.camera.v() * point.y;
        eye + (on_plane - eye) * (self.depth() / distance)
    }
}

/// The unit vector from the eye to the view plane, perpendicular to it, and their distance.
fn view_plane(camera: &Camera) -> (DVec3, f64) {
    let normal = camera.u().cross(camera.v()).normalize();
    let distance = (camera.ll() - camera.eye()).dot(normal);
    (normal * distance.signum(), distance.abs())
}

#[cfg(test)]
mod tests;
