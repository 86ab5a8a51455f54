//! Interpolation of cameras, for smooth transitions and camera paths.

use glam::DVec3;

use super::{Camera, UpAxis};

/// Number of components of a [`Pose`].
pub(super) const POSE_LEN: usize = 13;

/// A camera as independent numbers that can be interpolated.
///
/// The numbers are a target point, the logarithm of its distance, three angles about the up axis, and the shape of the
/// view plane. Numbers between those of two cameras are a camera again: an interpolated distance is never zero, and a
/// horizon that is level at both ends stays level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pose(pub(super) [f64; POSE_LEN]);

/// Indices of the angles, which are in radians.
const ANGLES: [usize; 3] = [4, 5, 6];
/// Index of the view plane's height; a negative height mirrors the picture.
const HEIGHT: usize = 12;

impl Pose {
    /// The pose of a camera. `focus_distance` is the distance from the eye to the target, perpendicular to the view plane;
    /// it must be above zero.
    pub(super) fn new(camera: &Camera, focus_distance: f64, up: UpAxis) -> Self {
        let [east, north, zenith] = axes(up);
        let backward = camera.backward();
        let right = camera.u.normalize();
        let (x, y, z) = (backward.dot(east), backward.dot(north), backward.dot(zenith));
        let (yaw, pitch) = (y.atan2(x), z.atan2(x.hypot(y)));
        let (level_right, level_top) = level(yaw, pitch, up);
        let roll = right.dot(level_top).atan2(right.dot(level_right));
        let top = backward.cross(right);
        let distance = camera.plane_distance();
        let corner = (camera.ll - camera.eye) / distance;
        let focus = camera.eye - backward * focus_distance;
        Self([
            focus.x,
            focus.y,
            focus.z,
            focus_distance.ln(),
            yaw,
            pitch,
            roll,
            distance.ln(),
            corner.dot(right),
            corner.dot(top),
            camera.u.length() / distance,
            camera.v.dot(right) / distance,
            camera.v.dot(top) / distance,
        ])
    }

    /// The same camera with angles within half a turn of those of `before`.
    pub(super) fn unwrapped_after(mut self, before: &Self) -> Self {
        for angle in ANGLES {
            let turns = ((self.0[angle] - before.0[angle]) / std::f64::consts::TAU).round();
            self.0[angle] -= turns * std::f64::consts::TAU;
        }
        self
    }

    /// Whether the two can be interpolated: a picture and its mirror image cannot.
    pub(super) fn can_interpolate_to(&self, other: &Self) -> bool {
        self.0.iter().chain(&other.0).all(|number| number.is_finite()) && self.0[HEIGHT] * other.0[HEIGHT] > 0.0
    }

    /// The camera of this pose; `None` if it is degenerate.
    pub(super) fn camera(&self, up: UpAxis) -> Option<Camera> {
        let [x, y, z, focus_distance, yaw, pitch, roll, distance, left, bottom, width, lean, height] = self.0;
        let [east, north, zenith] = axes(up);
        let backward = (east * yaw.cos() + north * yaw.sin()) * pitch.cos() + zenith * pitch.sin();
        let (level_right, level_top) = level(yaw, pitch, up);
        let right = level_right * roll.cos() + level_top * roll.sin();
        let top = backward.cross(right);
        let eye = DVec3::new(x, y, z) + backward * focus_distance.exp();
        let distance = distance.exp();
        let ll = eye + (right * left + top * bottom - backward) * distance;
        Camera::new(eye, ll, right * (width * distance), (right * lean + top * height) * distance).ok()
    }
}

/// Two level directions and the up axis, right-handed.
fn axes(up: UpAxis) -> [DVec3; 3] {
    match up {
        UpAxis::X => [DVec3::Y, DVec3::Z, DVec3::X],
        UpAxis::Y => [DVec3::Z, DVec3::X, DVec3::Y],
        UpAxis::Z => [DVec3::X, DVec3::Y, DVec3::Z],
        UpAxis::MinusX => [DVec3::Z, DVec3::Y, DVec3::NEG_X],
        UpAxis::MinusY => [DVec3::X, DVec3::Z, DVec3::NEG_Y],
        UpAxis::MinusZ => [DVec3::Y, DVec3::X, DVec3::NEG_Z],
    }
}

/// Right and top of a camera whose horizon is level.
fn level(yaw: f64, pitch: f64, up: UpAxis) -> (DVec3, DVec3) {
    let [east, north, zenith] = axes(up);
    let outward = east * yaw.cos() + north * yaw.sin();
    let right = north * yaw.cos() - east * yaw.sin();
    (right, zenith * pitch.cos() - outward * pitch.sin())
}

/// A smooth motion from one camera to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    ends: [Camera; 2],
    poses: [Pose; 2],
    up: UpAxis,
}

impl Transition {
    /// From one camera to another, each with the distance of its target, perpendicular to its view plane, in world units.
    /// The view plane's distance replaces one that is not positive and finite.
    pub fn new(from: (Camera, f64), to: (Camera, f64), up: UpAxis) -> Self {
        let pose = |(camera, distance): (Camera, f64)| {
            let is_usable = distance > 0.0 && distance.is_finite();
            Pose::new(&camera, if is_usable { distance } else { camera.plane_distance() }, up)
        };
        let start = pose(from);
        Self { ends: [from.0, to.0], poses: [start, pose(to).unwrapped_after(&start)], up }
    }

    /// The last camera.
    pub fn end(&self) -> Camera {
        self.ends[1]
    }

    /// The camera after a fraction of the time, 0 to 1: slow at both ends, and exactly the first and last camera there.
    pub fn at(&self, fraction: f64) -> Camera {
        let [start, end] = &self.poses;
        if fraction <= 0.0 {
            return self.ends[0];
        }
        // Without an interpolation, the camera jumps to the end.
        if fraction >= 1.0 || fraction.is_nan() || !start.can_interpolate_to(end) {
            return self.ends[1];
        }
        let eased = fraction * fraction * (3.0 - 2.0 * fraction);
        let interpolated = std::array::from_fn(|index| start.0[index] + (end.0[index] - start.0[index]) * eased);
        Pose(interpolated).camera(self.up).unwrap_or(self.ends[1])
    }
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;
    use strum::VariantArray;

    use super::*;

    pub(in crate::camera) fn any_camera() -> impl Strategy<Value = Camera> {
        let number = || prop_oneof![-3.0..3.0f64, -1e6..1e6f64, Just(0.0), Just(1.0)];
        let vector = move || [number(), number(), number()].prop_map(DVec3::from);
        (vector(), vector(), vector(), vector())
            .prop_filter_map("no camera", |(eye, ll, u, v)| Camera::new(eye, ll, u, v).ok())
    }

    /// Whether two cameras are equal within a millionth of their size.
    fn are_close(a: &Camera, b: &Camera) -> bool {
        let size = [a.eye, a.ll, a.u, a.v].iter().map(|vector| vector.length()).fold(0.0, f64::max);
        [a.eye - b.eye, a.ll - b.ll, a.u - b.u, a.v - b.v].iter().all(|by| by.length() <= 1e-6 * size)
    }

    fn front() -> Camera {
        Camera::look_at(DVec3::new(1.5, 1.0, 4.0), DVec3::ZERO, DVec3::Y, 0.7, 16.0 / 9.0).unwrap()
    }

    #[test]
    fn a_level_horizon_stays_level() {
        let top = front().orbit(DVec3::ZERO, UpAxis::Y, 2.8, 1.0);
        let transition = Transition::new((front(), front().plane_distance()), (top, top.plane_distance()), UpAxis::Y);
        for step in 0..=100 {
            let camera = transition.at(f64::from(step) / 100.0);
            assert!(camera.u.normalize().dot(DVec3::Y).abs() < 1e-9, "{camera:?}");
            // Both ends look at the middle from the same distance, so all cameras between do too.
            assert!((camera.target()).length() < 1e-9);
            assert!((camera.eye.length() / front().eye.length() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn the_shorter_way_around_is_taken() {
        let right = front().orbit(DVec3::ZERO, UpAxis::Y, 3.0, 0.0);
        let left = front().orbit(DVec3::ZERO, UpAxis::Y, -3.0, 0.0);
        let half = Transition::new((right, 3.0), (left, 3.0), UpAxis::Y).at(0.5);
        assert!(half.backward().dot(front().backward()) < -0.8, "the motion passes the back");
    }

    #[test]
    fn a_mirror_image_is_jumped_to() {
        let mirrored = Camera::new(front().eye, front().ll + front().v, front().u, -front().v).unwrap();
        let transition = Transition::new((front(), 1.0), (mirrored, 1.0), UpAxis::Y);
        assert_eq!((transition.at(0.0), transition.at(0.1)), (front(), mirrored));
    }

    proptest! {
        #[test]
        fn a_pose_gives_its_camera_back(camera in any_camera(), up in 0..UpAxis::VARIANTS.len(), part in 0.1..10.0f64) {
            let up = UpAxis::VARIANTS[up];
            let pose = Pose::new(&camera, camera.plane_distance() * part, up);
            // If the eye is nearly in the view plane, there may be no camera, but never a wrong one.
            if let Some(again) = pose.camera(up) {
                prop_assert!(are_close(&camera, &again), "{camera:?} {again:?}");
            }
        }

        #[test]
        fn every_camera_on_the_way_is_one(
            from in any_camera(), to in any_camera(), up in 0..UpAxis::VARIANTS.len(),
            distances in (prop_oneof![Just(0.0), Just(f64::NAN), 1e-9..1e9f64], 1e-9..1e9f64),
            fraction in prop_oneof![0.0..1.0f64, Just(f64::NAN), -2.0..3.0f64],
        ) {
            let transition = Transition::new((from, distances.0), (to, distances.1), UpAxis::VARIANTS[up]);
            let camera = transition.at(fraction);
            prop_assert!(Camera::new(camera.eye, camera.ll, camera.u, camera.v).is_ok());
            prop_assert_eq!((transition.at(0.0), transition.at(1.0)), (from, to));
        }
    }
}
