//! Cameras between cameras: what smooth transitions and camera paths are made of.

use glam::DVec3;

use super::{Camera, UpAxis};

/// How many numbers a [`Pose`] is.
pub(super) const POSE_LEN: usize = 13;

/// A camera as numbers, each of which can change without the others.
///
/// They are what a person would say: a point that is looked at, the logarithm of its distance, three angles about the
/// up axis, and the shape of the view plane. Numbers between those of two cameras are a camera again: no distance
/// between two distances is zero, and a horizon that is level at both ends stays level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pose(pub(super) [f64; POSE_LEN]);

/// The places of the angles among the numbers, in radians.
const ANGLES: [usize; 3] = [4, 5, 6];
/// The place of the view plane's height, whose sign says whether the picture is mirrored.
const HEIGHT: usize = 12;

impl Pose {
    /// Takes a camera apart. `focus_distance` is how far before the eye, perpendicular to the view plane, the point lies
    /// that a transition keeps in view; above zero.
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

    /// The same camera, its angles less than half a turn from those of `before`.
    pub(super) fn unwrapped_after(mut self, before: &Self) -> Self {
        for angle in ANGLES {
            let turns = ((self.0[angle] - before.0[angle]) / std::f64::consts::TAU).round();
            self.0[angle] -= turns * std::f64::consts::TAU;
        }
        self
    }

    /// Whether there are cameras between the two: not between a picture and its mirror image.
    pub(super) fn can_interpolate_to(&self, other: &Self) -> bool {
        self.0.iter().chain(&other.0).all(|number| number.is_finite()) && self.0[HEIGHT] * other.0[HEIGHT] > 0.0
    }

    /// Puts the camera together again, unless its numbers have left the range of cameras.
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
    }
}

/// Right and top of a camera whose horizon is level.
fn level(yaw: f64, pitch: f64, up: UpAxis) -> (DVec3, DVec3) {
    let [east, north, zenith] = axes(up);
    let outward = east * yaw.cos() + north * yaw.sin();
    let right = north * yaw.cos() - east * yaw.sin();
    (right, zenith * pitch.cos() - outward * pitch.sin())
}

/// A smooth way from one camera to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    ends: [Camera; 2],
    poses: [Pose; 2],
    up: UpAxis,
}

impl Transition {
    /// From one camera to another, each with the distance of what it looks at, perpendicular to its view plane and in
    /// world units; distances that are none are taken as those of the view planes.
    pub fn new(from: (Camera, f64), to: (Camera, f64), up: UpAxis) -> Self {
        let pose = |(camera, distance): (Camera, f64)| {
            let is_usable = distance > 0.0 && distance.is_finite();
            Pose::new(&camera, if is_usable { distance } else { camera.plane_distance() }, up)
        };
        let start = pose(from);
        Self { ends: [from.0, to.0], poses: [start, pose(to).unwrapped_after(&start)], up }
    }

    /// Where the way ends.
    pub fn end(&self) -> Camera {
        self.ends[1]
    }

    /// The camera when a part of the time has passed, 0 to 1: slow at both ends, and exactly the first and the last
    /// camera there.
    pub fn at(&self, fraction: f64) -> Camera {
        let [start, end] = &self.poses;
        if fraction <= 0.0 {
            return self.ends[0];
        }
        // A way that cannot be gone is skipped.
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

    use super::*;

    pub(in crate::camera) fn any_camera() -> impl Strategy<Value = Camera> {
        let number = || prop_oneof![-3.0..3.0f64, -1e6..1e6f64, Just(0.0), Just(1.0)];
        let vector = move || [number(), number(), number()].prop_map(DVec3::from);
        (vector(), vector(), vector(), vector())
            .prop_filter_map("no camera", |(eye, ll, u, v)| Camera::new(eye, ll, u, v).ok())
    }

    /// Whether two cameras send the same rays, as seen from how large they are.
    fn are_close(a: &Camera, b: &Camera) -> bool {
        let size = [a.eye, a.ll, a.u, a.v].iter().map(|vector| vector.length()).fold(0.0, f64::max);
        [a.eye - b.eye, a.ll - b.ll, a.u - b.u, a.v - b.v].iter().all(|by| by.length() <= 1e-6 * size)
    }

    fn front() -> Camera {
        Camera::view_all(DVec3::splat(-1.0), DVec3::splat(1.0), UpAxis::Y, 16.0 / 9.0)
    }

    #[test]
    fn a_level_horizon_stays_level() {
        let top = front().orbit(DVec3::ZERO, UpAxis::Y, 2.8, 1.0);
        let transition = Transition::new((front(), front().plane_distance()), (top, top.plane_distance()), UpAxis::Y);
        for step in 0..=100 {
            let camera = transition.at(f64::from(step) / 100.0);
            assert!(camera.u.normalize().dot(DVec3::Y).abs() < 1e-9, "{camera:?}");
            // Both look at the middle, so all between do, from the same distance.
            assert!((camera.target()).length() < 1e-9);
            assert!((camera.eye.length() / front().eye.length() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn the_shorter_way_around_is_taken() {
        let right = front().orbit(DVec3::ZERO, UpAxis::Y, 3.0, 0.0);
        let left = front().orbit(DVec3::ZERO, UpAxis::Y, -3.0, 0.0);
        let half = Transition::new((right, 3.0), (left, 3.0), UpAxis::Y).at(0.5);
        assert!(half.backward().dot(front().backward()) < -0.8, "the way goes round the back");
    }

    #[test]
    fn a_mirror_image_is_jumped_to() {
        let mirrored = Camera::new(front().eye, front().ll + front().v, front().u, -front().v).unwrap();
        let transition = Transition::new((front(), 1.0), (mirrored, 1.0), UpAxis::Y);
        assert_eq!((transition.at(0.0), transition.at(0.1)), (front(), mirrored));
    }

    proptest! {
        #[test]
        fn a_camera_taken_apart_is_the_same_put_together(camera in any_camera(), up in 0..3usize, part in 0.1..10.0f64) {
            let up = UpAxis::ALL[up];
            let pose = Pose::new(&camera, camera.plane_distance() * part, up);
            // Where the view plane is nearly in the eye, putting together may fail, but never errs.
            if let Some(again) = pose.camera(up) {
                prop_assert!(are_close(&camera, &again), "{camera:?} {again:?}");
            }
        }

        #[test]
        fn every_camera_on_the_way_is_one(
            from in any_camera(), to in any_camera(), up in 0..3usize,
            distances in (prop_oneof![Just(0.0), Just(f64::NAN), 1e-9..1e9f64], 1e-9..1e9f64),
            fraction in prop_oneof![0.0..1.0f64, Just(f64::NAN), -2.0..3.0f64],
        ) {
            let transition = Transition::new((from, distances.0), (to, distances.1), UpAxis::ALL[up]);
            let camera = transition.at(fraction);
            prop_assert!(Camera::new(camera.eye, camera.ll, camera.u, camera.v).is_ok());
            prop_assert_eq!((transition.at(0.0), transition.at(1.0)), (from, to));
        }
    }
}
