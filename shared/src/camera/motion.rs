//! Steering: each motion makes a camera from a camera. A step to a degenerate camera is not taken.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantArray};

use super::Camera;
use crate::names::unknown_name;

/// Vertical field of view of [`Camera::view_all`], in radians: 40°, the angle of a wall at a comfortable distance.
const FOV_Y: f64 = 0.7;

/// The least angle between the view and the up axis, in radians; beyond it, left and right would swap.
const POLE_MARGIN: f64 = 0.02;

/// The axis of the model that points up; a key steps through the variants in this order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, EnumString, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum UpAxis {
    /// y, as in most scans.
    #[default]
    Y,
    /// z, as in most CAD models.
    Z,
    /// x.
    X,
}

impl UpAxis {
    /// The unit vector along it.
    pub fn direction(self) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::Y => DVec3::Y,
            Self::Z => DVec3::Z,
        }
    }

    /// The next variant; the first follows the last.
    #[must_use]
    pub fn next(self) -> Self {
        Self::VARIANTS[(self as usize + 1) % Self::VARIANTS.len()]
    }
}

impl Camera {
    /// A camera that sees a whole box, from the front, a little from the right and above.
    ///
    /// `min` and `max` are the box's corners in world space; `aspect` is the canvas's width over its height.
    /// A box that is empty or has no extent is viewed as a small cube.
    pub fn view_all(min: DVec3, max: DVec3, up: UpAxis, aspect: f64) -> Self {
        let (centre, half) = if min.cmple(max).all() && min.is_finite() && max.is_finite() {
            ((min + max) * 0.5, (max - min) * 0.5)
        } else {
            (DVec3::ZERO, DVec3::ONE)
        };
        // From nearer, rounding would move the eye by much of its distance.
        let least = centre.abs().max_element() * f64::EPSILON * 4096.0;
        let half = half.max(DVec3::splat((half.max_element() * 1e-3).max(least).max(1e-36)));
        let up_direction = up.direction();
        // For y up the front is +z, as in most scans; for z up it is −y, as in most CAD models.
        let front = match up {
            UpAxis::X | UpAxis::Y => DVec3::Z,
            UpAxis::Z => -DVec3::Y,
        };
        let side = up_direction.cross(front);
        let towards_eye = (front + side * 0.35 + up_direction * 0.25).normalize();
        let right = up_direction.cross(towards_eye).normalize();
        let top = towards_eye.cross(right);
        // The least distance from which every corner is in view, and then 4 % more.
        let tan_y = (FOV_Y * 0.5).tan();
        let distance = (0..8)
            .map(|corner| {
                let sign = |bit: u32| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
                let offset = half * DVec3::new(sign(0), sign(1), sign(2));
                let across = (offset.dot(right).abs() / aspect).max(offset.dot(top).abs());
                across / tan_y + offset.dot(towards_eye)
            })
            .fold(0.0, f64::max);
        Self::look_at(centre + towards_eye * (distance * 1.04), centre, up_direction, FOV_Y, aspect)
            .unwrap_or_else(|_| Self::fallback_camera(aspect))
    }

    /// A camera at the origin, for boxes so far away that no `f32` ray reaches them.
    fn fallback_camera(aspect: f64) -> Self {
        let half_height = (FOV_Y * 0.5).tan();
        let u = DVec3::X * (2.0 * half_height * aspect);
        let v = DVec3::Y * (2.0 * half_height);
        Self { eye: DVec3::Z, ll: (u + v) * -0.5, u, v }
    }

    /// Turns around `pivot`: `yaw` about the up axis, `pitch` about the camera's right, both in radians.
    ///
    /// Positive angles carry the eye to the right and upwards. The view never passes the poles.
    #[must_use]
    pub fn orbit(&self, pivot: DVec3, up: UpAxis, yaw: f64, pitch: f64) -> Self {
        let up = up.direction();
        let right = self.u.normalize();
        let backward = self.backward();
        let elevation = backward.dot(up).clamp(-1.0, 1.0).asin();
        let highest = std::f64::consts::FRAC_PI_2 - POLE_MARGIN;
        // A camera that is already beyond the margin (from a file, or after a change of axis) may stay there.
        let (lowest, highest) = ((-highest).min(elevation), highest.max(elevation));
        let pitch = (elevation + pitch).clamp(lowest, highest) - elevation;
        let turn = DQuat::from_axis_angle(up, yaw) * DQuat::from_axis_angle(right, -pitch);
        self.rotated(pivot, turn)
    }

    /// Moves sideways so that a point at `distance` from the eye moves by `right` and `up`, as fractions of the view
    /// plane's width and height.
    #[must_use]
    pub fn pan(&self, distance: f64, right: f64, up: f64) -> Self {
        let scale = distance / self.plane_distance();
        self.translated(-(self.u * right + self.v * up) * scale)
    }

    /// Moves the eye towards `point`, to `factor` times its distance: below 1 is nearer.
    #[must_use]
    pub fn dolly(&self, point: DVec3, factor: f64) -> Self {
        self.translated((self.eye - point) * (factor - 1.0))
    }

    /// Moves by distances in world units along the camera's own right, up and forward.
    #[must_use]
    pub fn fly(&self, right: f64, up: f64, forward: f64) -> Self {
        self.translated(self.u.normalize() * right + self.v.normalize() * up - self.backward() * forward)
    }

    /// The unit vector from the view plane to the eye, perpendicular to the plane.
    pub(super) fn backward(&self) -> DVec3 {
        let normal = self.u.cross(self.v).normalize();
        if normal.dot(self.eye - self.ll) < 0.0 { -normal } else { normal }
    }

    /// Distance from the eye to the view plane.
    pub(super) fn plane_distance(&self) -> f64 {
        (self.eye - self.ll).dot(self.backward())
    }

    fn translated(&self, by: DVec3) -> Self {
        Self::new(self.eye + by, self.ll + by, self.u, self.v).unwrap_or(*self)
    }

    fn rotated(&self, pivot: DVec3, turn: DQuat) -> Self {
        let about = |point: DVec3| pivot + turn * (point - pivot);
        Self::new(about(self.eye), about(self.ll), turn * self.u, turn * self.v).unwrap_or(*self)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn project(camera: &Camera, point: DVec3) -> (f64, f64) {
        camera.project(point).unwrap().into()
    }

    fn front() -> Camera {
        Camera::view_all(DVec3::splat(-1.0), DVec3::splat(1.0), UpAxis::Y, 16.0 / 9.0)
    }

    #[test]
    fn view_all_sees_every_corner_and_fills_the_canvas() {
        let boxes = [
            (DVec3::ZERO, DVec3::ONE),
            (DVec3::ZERO, DVec3::splat(1e-30)),
            (DVec3::splat(1e6), DVec3::splat(1e6 + 1.0)),
            (DVec3::new(5e5, 0.0, -3.0), DVec3::new(5e5 + 1.0, 20.0, 1.0)),
        ];
        for ((min, max), up) in boxes.into_iter().flat_map(|b| UpAxis::VARIANTS.iter().map(move |&up| (b, up))) {
            let camera = Camera::view_all(min, max, up, 16.0 / 9.0);
            let mut largest: f64 = 0.0;
            for corner in 0..8 {
                let pick = |bit: usize| if corner >> bit & 1 == 0 { min[bit] } else { max[bit] };
                let (x, y) = project(&camera, DVec3::new(pick(0), pick(1), pick(2)));
                assert!((0.0..=1.0).contains(&x) && (0.0..=1.0).contains(&y), "{x} {y}");
                largest = largest.max((x - 0.5).abs()).max((y - 0.5).abs());
            }
            // A long box seen end on is nearer at one end, so it cannot fill the canvas about its centre.
            assert!(largest > 0.25, "the box fills only {largest} of the half canvas");
        }
    }

    #[test]
    fn view_all_survives_boxes_without_extent() {
        for (min, max) in [
            (DVec3::INFINITY, DVec3::NEG_INFINITY),
            (DVec3::ONE, DVec3::ONE),
            (DVec3::splat(1e17), DVec3::splat(1e17)),
            (DVec3::splat(-1e18), DVec3::splat(1e18)),
            (DVec3::ZERO, DVec3::X),
        ] {
            let camera = Camera::view_all(min, max, UpAxis::Z, 1.0);
            assert!(camera.u().length() > 0.0);
        }
    }

    #[test]
    fn orbiting_right_shows_the_right_side() {
        let camera = front().orbit(DVec3::ZERO, UpAxis::Y, 0.3, 0.0);
        assert!(camera.eye().dot(front().u()) > front().eye().dot(front().u()));
    }

    #[test]
    fn a_full_turn_comes_back() {
        let mut camera = front();
        for _ in 0..360 {
            camera = camera.orbit(DVec3::ZERO, UpAxis::Y, 1f64.to_radians(), 0.0);
        }
        assert!((camera.eye() - front().eye()).length() < 1e-9);
    }

    #[test]
    fn orbiting_up_stops_before_the_pole() {
        let mut camera = front();
        for _ in 0..100 {
            camera = camera.orbit(DVec3::ZERO, UpAxis::Y, 0.0, 0.1);
        }
        let elevation = camera.eye().normalize().dot(DVec3::Y).asin();
        assert!((elevation - (std::f64::consts::FRAC_PI_2 - POLE_MARGIN)).abs() < 1e-6, "{elevation}");
    }

    #[test]
    fn a_panned_point_follows_the_cursor() {
        let camera = front();
        let before = project(&camera, DVec3::ZERO);
        let after = project(&camera.pan(camera.plane_distance(), 0.1, 0.2), DVec3::ZERO);
        assert!((after.0 - before.0 - 0.1).abs() < 1e-12 && (after.1 - before.1 - 0.2).abs() < 1e-12);
    }

    #[test]
    fn a_dolly_keeps_its_point_in_place_on_the_canvas() {
        let point = DVec3::new(0.5, 0.25, 0.0);
        let (before, after) = (project(&front(), point), project(&front().dolly(point, 0.5), point));
        assert!((after.0 - before.0).abs() < 1e-12 && (after.1 - before.1).abs() < 1e-12);
    }

    proptest! {
        #[test]
        fn no_motion_makes_a_degenerate_camera(
            steps in proptest::collection::vec((0..5u8, -1e3..1e3f64, -1e3..1e3f64), 1..40),
        ) {
            let mut camera = front();
            for (kind, a, b) in steps {
                camera = match kind {
                    0 => camera.orbit(DVec3::ZERO, UpAxis::Z, a, b),
                    1 => camera.pan(a, b, a),
                    2 => camera.dolly(DVec3::ZERO, a.abs()),
                    3 => camera.fly(a, b, 1e17 * a),
                    _ => camera.orbit(camera.eye(), UpAxis::X, a, b),
                };
                prop_assert!(Camera::new(camera.eye(), camera.ll(), camera.u(), camera.v()).is_ok());
            }
        }
    }
}
