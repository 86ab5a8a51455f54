//! The camera, moved by mouse and keys. Pure: no window, no clock.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use shared::camera::{Camera, CameraPath, CanvasPart, Shape, Transition, UpAxis};

use super::{drive::Drive, input::Direction};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Drag {
    /// Orbits around the chosen point, or the middle of the model.
    Orbit,
    /// Moves the model with the cursor, parallel to the view plane.
    Pan,
    /// Moves nearer (up) or farther (down).
    Dolly,
}

/// A motion by a hand, wherever it is: at the mouse, or on a remote.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Nudge {
    /// A drag by fractions of the canvas's width and height, up and to the right.
    Drag(Drag, DVec2),
    /// Moves to `factor` times the distance from what is at a point of the canvas.
    Dolly { factor: f64, at: DVec2 },
    /// Turns the picture to the left, in radians.
    Roll(f64),
}

/// The camera, moved by mouse and keys.
///
/// Points on the canvas are fractions of its width and height, (0, 0) lower left.
#[derive(Clone, Debug)]
pub(crate) struct Navigator {
    camera: Camera,
    /// The last view that made room for panels; the camera differs once it was steered.
    placed: Placed,
    /// How far panels have moved the middle of the present view aside, as fractions of the canvas.
    shift: DVec2,
    shape: Shape,
    up: UpAxis,
    aspect: f64,
    cursor: DVec2,
    drag: Option<Drag>,
    held: Vec<Direction>,
    /// How devices are held out.
    drive: Drive,
    /// The point to orbit around; `None`: the middle of the model.
    focus: Option<DVec3>,
    /// The surface point under the cursor, in world space, once it is known.
    under_cursor: Option<DVec3>,
    /// The surface point that the eye saw or went to last, in world space.
    surface: Option<DVec3>,
    motion: Option<Motion>,
    /// Steps of flying speed above the usual one.
    speed: i32,
}

/// A view in a free part of the canvas.
#[derive(Clone, Copy, Debug)]
struct Placed {
    /// As panels leave room for it.
    camera: Camera,
    shift: DVec2,
    /// As it was kept; `None`: the whole model.
    kept: Option<Camera>,
}

/// A motion without mouse or keys.
#[derive(Clone, Debug)]
enum Motion {
    /// `shifts` are those of its start and end.
    Transition {
        transition: Box<Transition>,
        seconds: f64,
        shifts: [DVec2; 2],
    },
    Play {
        path: Arc<CameraPath>,
        seconds: f64,
        repeats: bool,
    },
}

/// A drag over the height of the canvas turns the model by half a turn.
const ORBIT_RADIANS_PER_HEIGHT: f64 = std::f64::consts::PI;
/// A drag over the height of the canvas changes the distance by this factor.
const DOLLY_FACTOR_PER_HEIGHT: f64 = 8.0;
/// One notch of the wheel changes the distance by this factor.
const DOLLY_FACTOR_PER_NOTCH: f64 = 1.15;
/// Seconds to fly across the model.
const SECONDS_TO_CROSS: f64 = 2.5;
/// Flying near a surface covers this part of the distance to it in a second.
const NEAR_PART_PER_SECOND: f64 = 1.2;
/// Each step multiplies the flying speed by this.
const SPEED_FACTOR: f64 = 1.5;
/// The most steps up or down: 1.5¹⁰ is about 58 times the usual speed.
const MOST_SPEED_STEPS: i32 = 10;
/// Duration of the transition to another view.
const TRANSITION_SECONDS: f64 = 0.6;
/// Going to a point leaves this part of the distance to it.
const GO_TO_PART: f64 = 0.4;
/// Going before a point leaves this part of the model's size.
const BEFORE_PART: f64 = 0.4;
/// Nearer to a surface than this part of the model's size, the wheel goes through it.
const PASS_THROUGH_PART: f64 = 1e-3;
/// The longest time step: one slow frame must not move the eye through the model.
const LONGEST_STEP_SECONDS: f64 = 0.1;
/// The least depth that pan and dolly assume, as a part of the model's size.
const LEAST_DEPTH_PART: f64 = 0.05;

impl Navigator {
    /// Shows a whole model on a canvas with this aspect (width over height).
    pub(crate) fn new(shape: Shape, up: UpAxis, aspect: f64) -> Self {
        let camera = Camera::view_all(&shape, up, aspect, CanvasPart::WHOLE);
        Self {
            camera,
            placed: Placed { camera, shift: DVec2::ZERO, kept: None },
            shift: DVec2::ZERO,
            shape,
            up,
            aspect,
            cursor: DVec2::splat(0.5),
            drag: None,
            held: Vec::new(),
            drive: Drive::default(),
            focus: None,
            under_cursor: None,
            surface: None,
            motion: None,
            speed: 0,
        }
    }

    pub(crate) fn camera(&self) -> Camera {
        self.camera
    }

    pub(crate) fn up(&self) -> UpAxis {
        self.up
    }

    /// The end of a transition to another view; otherwise the present camera.
    fn destination(&self) -> (Camera, DVec2) {
        match &self.motion {
            Some(Motion::Transition { transition, shifts, .. }) => (transition.end(), shifts[1]),
            Some(Motion::Play { .. }) | None => (self.camera, self.shift),
        }
    }

    /// The present view as it is without panels: its middle in the middle of the canvas.
    pub(crate) fn camera_without_panels(&self) -> Camera {
        self.moved_aside(self.camera, -self.shift)
    }

    /// The view at the end of a transition, or the present one, as it is without panels.
    pub(crate) fn destination_without_panels(&self) -> Camera {
        let (camera, shift) = self.destination();
        self.moved_aside(camera, -shift)
    }

    /// Shows another model at once, as a whole in the part of the canvas in which it is largest; drags and held keys
    /// continue.
    pub(crate) fn set_model(&mut self, shape: Shape, up: UpAxis, parts: &[CanvasPart]) {
        self.shape = shape;
        self.up = up;
        self.focus = None;
        self.surface = None;
        self.motion = None;
        self.placed = self.place(None, parts);
        self.show(self.placed.camera, self.placed.shift);
    }

    /// Shows the whole model in the part of the canvas in which it is largest.
    pub(crate) fn view_all(&mut self, parts: &[CanvasPart]) {
        self.focus = None;
        self.placed = self.place(None, parts);
        self.go_to(self.placed.camera, self.placed.shift);
    }

    /// Keeps a whole model, or a kept view, in the parts of the canvas that are free now, unless the camera was steered since.
    pub(crate) fn make_room(&mut self, parts: &[CanvasPart]) {
        if self.destination().0 == self.placed.camera
            && self.held.is_empty()
            && !self.is_dragging()
            && !self.is_driven()
        {
            self.placed = self.place(self.placed.kept, parts);
            let Placed { camera, shift, .. } = self.placed;
            if self.is_moving() { self.go_to(camera, shift) } else { self.show(camera, shift) }
        }
    }

    /// Uses the next axis as up, and shows the whole model: turned in place, the eye would be above or below it.
    pub(crate) fn next_up_axis(&mut self, parts: &[CanvasPart]) {
        self.up = self.up.next();
        self.view_all(parts);
    }

    /// Starts a transition to a kept view beside panels, and has its axis point up from then on.
    pub(crate) fn go_to_view(&mut self, camera: Camera, up: Option<UpAxis>, parts: &[CanvasPart]) {
        self.up = up.unwrap_or(self.up);
        self.placed = self.place(Some(camera), parts);
        self.go_to(self.placed.camera, self.placed.shift);
    }

    /// Starts a transition to another view, whose middle panels have moved by `shift`.
    fn go_to(&mut self, camera: Camera, shift: DVec2) {
        let (start, end) = ((self.camera, self.depth_of(&self.camera)), (camera, self.depth_of(&camera)));
        let transition = Box::new(Transition::new(start, end, self.up));
        let shifts = [self.shift, shift];
        self.motion = (camera != self.camera).then_some(Motion::Transition { transition, seconds: 0.0, shifts });
        if self.motion.is_none() {
            self.shift = shift;
        }
    }

    /// Moves nearer to a point in world space until it is in the middle, and orbits around it from then on.
    pub(crate) fn go_to_point(&mut self, point: DVec3) {
        if !point.is_finite() {
            return;
        }
        let distance = (point - self.camera.eye()).length();
        let nearer = self.camera.dolly(point, GO_TO_PART);
        // Move sideways until the point is in the middle: the picture does not turn.
        let (forward, plane_distance) = view_plane(&nearer);
        let depth = (point - nearer.eye()).dot(forward);
        let middle = nearer.eye() + (nearer.target() - nearer.eye()) * (depth / plane_distance);
        let aside = point - middle;
        let right = nearer.u().normalize();
        let up = nearer.v().normalize();
        // Solve for both edges, which need not be perpendicular.
        let (a, b, c) = (right.dot(up), aside.dot(right), aside.dot(up));
        let by_up = (c - a * b) / (1.0 - a * a);
        (self.focus, self.surface) = (Some(point), Some(point));
        if distance > 0.0 && depth > 0.0 && by_up.is_finite() {
            self.go_to(nearer.fly(b - a * by_up, by_up, 0.0), DVec2::ZERO);
        }
    }

    /// Goes to a kept view of a point as [`Navigator::go_to_view`] does, and orbits around the point from then on.
    pub(crate) fn go_to_view_of(&mut self, point: DVec3, camera: Camera, up: Option<UpAxis>, parts: &[CanvasPart]) {
        (self.focus, self.surface) = (Some(point), Some(point));
        self.go_to_view(camera, up, parts);
    }

    /// Goes before a point, on the side to which its surface faces, or as near as [`Navigator::go_to_point`] goes, and orbits
    /// around it from then on.
    pub(crate) fn go_before(&mut self, point: DVec3, direction: Option<DVec3>) {
        let (_, plane_distance) = view_plane(&self.camera);
        let fov_y = 2.0 * (self.camera.v().length() * 0.5 / plane_distance).atan();
        let before = |direction: DVec3| {
            let eye = point + direction * (self.size() * BEFORE_PART);
            Camera::look_at(eye, point, self.up.direction(), fov_y, self.aspect).ok()
        };
        match direction.and_then(before) {
            Some(camera) => {
                (self.focus, self.surface) = (Some(point), Some(point));
                self.go_to(camera, DVec2::ZERO);
            }
            None => self.go_to_point(point),
        }
    }

    /// Sets the surface point under the cursor, in world space; `None` if there is none.
    pub(crate) fn set_under_cursor(&mut self, point: Option<DVec3>) {
        self.under_cursor = point.filter(|point| point.is_finite());
        self.surface = self.under_cursor.or(self.surface);
    }

    /// Sets the surface point in the middle of the view, in world space, which slows flying; `None` if there is none.
    pub(crate) fn set_ahead(&mut self, point: Option<DVec3>) {
        self.surface = point.filter(|point| point.is_finite());
    }

    pub(crate) fn is_flying(&self) -> bool {
        !self.held.is_empty() || self.drive.fly != DVec3::ZERO
    }

    pub(crate) fn needs_surface(&self) -> bool {
        self.under_cursor.is_none()
    }

    /// Plays a path from its beginning, once or repeatedly.
    pub(crate) fn play(&mut self, path: Arc<CameraPath>, repeats: bool) {
        self.up = path.up();
        self.focus = None;
        self.set_camera(path.at(0.0));
        self.motion = Some(Motion::Play { path, seconds: 0.0, repeats });
    }

    pub(crate) fn is_playing(&self) -> bool {
        matches!(self.motion, Some(Motion::Play { .. }))
    }

    /// Ends a transition or a path where the camera is.
    pub(crate) fn stop(&mut self) {
        self.motion = None;
    }

    /// A mouse button went down.
    pub(crate) fn press(&mut self, drag: Drag) {
        self.motion = None;
        self.drag = Some(drag);
    }

    /// The mouse button went up.
    pub(crate) fn release(&mut self) {
        self.drag = None;
    }

    pub(crate) fn is_dragging(&self) -> bool {
        self.drag.is_some()
    }

    /// Moves the cursor to a point on the canvas, or beyond its edge. Returns whether the camera moved.
    pub(crate) fn move_to(&mut self, point: DVec2) -> bool {
        if !point.is_finite() {
            return false;
        }
        let by = point - self.cursor;
        self.cursor = point;
        if by != DVec2::ZERO {
            self.under_cursor = None;
        }
        self.drag.is_some_and(|drag| self.nudged(Nudge::Drag(drag, by)))
    }

    /// Moves the camera as a hand elsewhere says, in place of a motion of its own. Returns whether it moved.
    pub(crate) fn nudge(&mut self, nudge: Nudge) -> bool {
        self.motion = None;
        self.under_cursor = None;
        self.nudged(nudge)
    }

    fn nudged(&mut self, nudge: Nudge) -> bool {
        let before = self.camera;
        self.camera = match nudge {
            Nudge::Drag(Drag::Orbit, by) => {
                // The model follows the cursor, so the eye moves the other way.
                let yaw = -by.x * self.aspect * ORBIT_RADIANS_PER_HEIGHT;
                let pitch = -by.y * ORBIT_RADIANS_PER_HEIGHT;
                self.camera.orbit(self.pivot(), self.up, yaw, pitch)
            }
            Nudge::Drag(Drag::Pan, by) => self.camera.pan(self.depth(), by.x, by.y),
            Nudge::Drag(Drag::Dolly, by) => {
                self.camera.dolly(self.point_under(DVec2::splat(0.5)), DOLLY_FACTOR_PER_HEIGHT.powf(-by.y))
            }
            Nudge::Dolly { factor, at } => self.camera.dolly(self.point_under(at), factor),
            Nudge::Roll(radians) => self.camera.roll(radians),
        };
        self.camera != before
    }

    /// Turns the wheel; positive notches move toward the point under the cursor. Returns whether the camera moved.
    pub(crate) fn wheel(&mut self, notches: f64) -> bool {
        let before = self.camera;
        self.motion = None;
        let notches = if notches.is_finite() { notches.clamp(-20.0, 20.0) } else { 0.0 };
        let eye = self.camera.eye();
        let surface = self.under_cursor.filter(|point| (*point - eye).length() > self.size() * PASS_THROUGH_PART);
        let point = surface.unwrap_or_else(|| self.point_under(self.cursor));
        self.camera = self.camera.dolly(point, DOLLY_FACTOR_PER_NOTCH.powf(-notches));
        self.camera != before
    }

    /// A key for flying went down.
    pub(crate) fn hold(&mut self, direction: Direction) {
        self.motion = None;
        if !self.held.contains(&direction) {
            self.held.push(direction);
        }
    }

    /// A key for flying went up.
    pub(crate) fn release_key(&mut self, direction: Direction) {
        self.held.retain(|&held| held != direction);
    }

    /// Releases all keys and buttons, as when the window loses the focus.
    pub(crate) fn release_all(&mut self) {
        self.held.clear();
        self.drag = None;
    }

    /// Moves as devices are held out from now on, in place of a motion of its own.
    pub(crate) fn set_drive(&mut self, drive: Drive) {
        if !drive.is_rest() {
            self.motion = None;
            self.under_cursor = None;
        }
        self.drive = drive;
    }

    pub(crate) fn is_driven(&self) -> bool {
        !self.drive.is_rest()
    }

    /// Whether time moves the camera.
    pub(crate) fn is_moving(&self) -> bool {
        !self.held.is_empty() || self.is_driven() || self.motion.is_some()
    }

    /// Changes the flying speed by some steps. Returns the new speed as a multiple of the usual one.
    pub(crate) fn change_speed(&mut self, steps: i32) -> f64 {
        self.speed = self.speed.saturating_add(steps).clamp(-MOST_SPEED_STEPS, MOST_SPEED_STEPS);
        SPEED_FACTOR.powi(self.speed)
    }

    /// Advances a transition, a path, or keys and devices by some seconds; `speed` multiplies the flying speed. Returns whether the
    /// camera moved.
    pub(crate) fn advance(&mut self, seconds: f64, speed: f64) -> bool {
        let before = self.camera;
        let seconds = if seconds > 0.0 { seconds } else { 0.0 };
        match &mut self.motion {
            Some(Motion::Transition { transition, seconds: passed, shifts }) => {
                *passed += seconds;
                let fraction = *passed / TRANSITION_SECONDS;
                let (camera, shift) = (transition.at(fraction), shifts[0].lerp(shifts[1], fraction.min(1.0)));
                if fraction >= 1.0 {
                    self.motion = None;
                }
                self.show(camera, shift);
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
            None => {
                let seconds = seconds.min(LONGEST_STEP_SECONDS);
                self.fly(seconds, speed);
                for nudge in self.drive.nudges(seconds, self.aspect) {
                    self.nudged(nudge);
                }
            }
        }
        self.camera != before
    }

    fn fly(&mut self, seconds: f64, speed: f64) {
        // From afar, reaching the model takes the same time.
        let (size, distance) = (self.size(), (self.camera.eye() - self.pivot()).length());
        let usual = size.max(distance - size) / SECONDS_TO_CROSS;
        let to_surface = self.surface.map_or(f64::INFINITY, |point| (point - self.camera.eye()).length());
        // A surface is passed in the end, so the speed falls no further just before it.
        let per_second = usual.min((to_surface * NEAR_PART_PER_SECOND).max(size * PASS_THROUGH_PART));
        let step = per_second * seconds * speed * SPEED_FACTOR.powi(self.speed);
        let held = |direction| if self.held.contains(&direction) { step } else { 0.0 };
        let driven = self.drive.fly * step;
        let camera = self.camera.fly(
            held(Direction::Right) - held(Direction::Left) + driven.x,
            held(Direction::Up) - held(Direction::Down) + driven.y,
            held(Direction::Forward) - held(Direction::Backward) + driven.z,
        );
        self.show(camera, self.shift);
    }

    /// Shows exactly this view at once, panels or not.
    pub(crate) fn set_camera(&mut self, camera: Camera) {
        self.show(camera, DVec2::ZERO);
    }

    fn show(&mut self, camera: Camera, shift: DVec2) {
        self.shift = shift;
        if camera != self.camera {
            self.camera = camera;
            self.under_cursor = None;
        }
    }

    /// A kept view, or the whole model, in the free part of the canvas in which the model is largest.
    fn place(&self, kept: Option<Camera>, parts: &[CanvasPart]) -> Placed {
        let whole = |part| Camera::view_all(&self.shape, self.up, self.aspect, part);
        let views = parts.iter().map(|&part| (part, whole(part)));
        let distance = |camera: &Camera| camera.eye().distance_squared(camera.target());
        let nearest = views.min_by(|(_, a), (_, b)| distance(a).total_cmp(&distance(b)));
        let (part, whole) = nearest.unwrap_or_else(|| (CanvasPart::WHOLE, whole(CanvasPart::WHOLE)));
        let shift = (part.min + part.max) * 0.5 - 0.5;
        let camera = kept.map_or(whole, |camera| self.moved_aside(camera, shift));
        Placed { camera, shift, kept }
    }

    /// The same view turned until its middle is aside by a part of the canvas. The eye stays: it might move into a surface.
    fn moved_aside(&self, camera: Camera, shift: DVec2) -> Camera {
        if shift == DVec2::ZERO {
            return camera;
        }
        let (_, distance) = view_plane(&camera);
        let angles = shift * DVec2::new(camera.u().length(), camera.v().length()) / distance;
        camera.orbit(camera.eye(), self.up, angles.x.atan(), angles.y.atan())
    }

    /// The point to orbit around: the chosen one, the middle of the model, or the origin if the model is empty.
    fn pivot(&self) -> DVec3 {
        let (min, max) = self.shape.bounds;
        let middle = if min.cmple(max).all() { (min + max) * 0.5 } else { DVec3::ZERO };
        self.focus.unwrap_or(middle)
    }

    /// The length of the box's diagonal in world units.
    fn size(&self) -> f64 {
        let (min, max) = self.shape.bounds;
        let size = if min.cmple(max).all() { (max - min).length() } else { 0.0 };
        if size > 0.0 && size.is_finite() { size } else { 1.0 }
    }

    fn depth(&self) -> f64 {
        self.depth_of(&self.camera)
    }

    /// The pivot's distance from the eye, perpendicular to the view plane, but at least a small part of the model.
    fn depth_of(&self, camera: &Camera) -> f64 {
        let (forward, _) = view_plane(camera);
        // The eye may go nearer to a chosen point than to the middle of the model.
        let nearest = if self.focus.is_some() { PASS_THROUGH_PART } else { LEAST_DEPTH_PART };
        (self.pivot() - camera.eye()).dot(forward).max(self.size() * nearest)
    }

    /// The point in world space at the pivot's depth behind a point of the canvas.
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
