//! Steering: each motion makes a camera from a camera. A step to a degenerate camera is not taken.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantArray};

use super::Camera;
use crate::names::unknown_name;

/// The least angle between the view and the up axis, in radians; beyond it, left and right would swap.
const POLE_MARGIN: f64 = 0.02;

/// The axis of the model that points up; a key steps through the variants in this order.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, Display, EnumString, VariantArray,
)]
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
    /// −y.
    #[serde(rename = "-y")]
    #[strum(serialize = "-y")]
    MinusY,
    /// −z.
    #[serde(rename = "-z")]
    #[strum(serialize = "-z")]
    MinusZ,
    /// −x.
    #[serde(rename = "-x")]
    #[strum(serialize = "-x")]
    MinusX,
}

impl UpAxis {
    /// The axes without their opposites.
    pub const POSITIVE: [Self; 3] = [Self::Y, Self::Z, Self::X];

    /// The unit vector along it.
    pub fn direction(self) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::Y => DVec3::Y,
            Self::Z => DVec3::Z,
            Self::MinusX => DVec3::NEG_X,
            Self::MinusY => DVec3::NEG_Y,
            Self::MinusZ => DVec3::NEG_Z,
        }
    }

    /// The horizontal direction from which a model is seen first: +z for y up, as in most scans; −y for z up, as in most CAD
    /// models.
    pub fn front(self) -> DVec3 {
        match self {
            Self::X | Self::Y | Self::MinusX | Self::MinusY => DVec3::Z,
            Self::Z | Self::MinusZ => DVec3::NEG_Y,
        }
    }

    /// The next variant; the first follows the last.
    #[must_use]
    pub fn next(self) -> Self {
        Self::VARIANTS[(self as usize + 1) % Self::VARIANTS.len()]
    }
}

impl Camera {
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

    /// Turns around the line of sight, in radians: positive angles turn the picture to the left.
    #[must_use]
    pub fn roll(&self, radians: f64) -> Self {
        let turn = DQuat::from_axis_angle(self.backward(), -radians);
        self.rotated(self.eye, turn)
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
        Camera::look_at(DVec3::new(1.5, 1.0, 4.0), DVec3::ZERO, DVec3::Y, 0.7, 16.0 / 9.0).unwrap()
    }

    #[test]
    fn orbiting_right_shows_the_right_side() {
        let camera = front().orbit(DVec3::ZERO, UpAxis::Y, 0.3, 0.0);
        assert!(camera.eye().dot(front().u()) > front().eye().dot(front().u()));
    }

    #[test]
    fn rolling_turns_the_picture_to_the_left_about_its_middle() {
        let (before, after) = (front(), front().roll(0.2));
        let middle = before.target();
        let right = middle + before.u().normalize() * 0.1;
        let [aside, centre] = [right, middle].map(|point| project(&after, point));
        assert!((centre.0 - 0.5).abs() < 1e-12 && (centre.1 - 0.5).abs() < 1e-12, "{centre:?}");
        let angle = (aside.1 - centre.1).atan2((aside.0 - centre.0) * 16.0 / 9.0);
        assert!((angle - 0.2).abs() < 1e-9, "{angle}");
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
