//! The paper's camera, its rays, the motions that steer it, and the paths that it follows.

mod motion;
mod path;
mod pose;
mod shape;
mod views;

pub use motion::UpAxis;
pub use path::{CameraPath, CameraPathError, CameraRecorder};
pub use pose::Transition;
pub use shape::{CanvasPart, Shape};
pub(crate) use views::ViewTable;
pub use views::{Look, View, Views};

use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};

use crate::{division::FrameSize, toml_text::plain_problem};

/// The paper's camera: an eye and a view plane, in world space: the coordinates of the model's file.
///
/// Points of the view plane are `ll + s·u + t·v` with s and t in 0..1: `ll` is its lower-left corner, `u` runs along its
/// bottom edge to the right, `v` along its left edge upwards.
/// `f64` in memory, in files and on the wire: single precision moves thousands of pixels on CAD models.
///
/// Invariant: every component is finite and the plane has an area that the eye does not lie in; [`Camera::new`] checks it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "CameraVectors")]
pub struct Camera {
    eye: DVec3,
    ll: DVec3,
    u: DVec3,
    v: DVec3,
}

/// Unchecked vectors of a camera, from a file or a message.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraVectors {
    eye: DVec3,
    ll: DVec3,
    u: DVec3,
    v: DVec3,
}

/// The vectors are not a valid camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum CameraError {
    // Larger numbers are too large for `f32` rays.
    #[error("a component of eye, ll, u or v is not a finite number below 1e18")]
    NotFinite,
    #[error("the view plane has no area: u and v must be nonzero and not parallel")]
    NoArea,
    #[error("the eye lies in the view plane: move ll away from eye")]
    EyeInPlane,
}

/// A file of a camera, a path, views or marks is malformed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {problem}; {format}")]
pub struct CameraFileError {
    line: usize,
    problem: String,
    /// The expected format.
    format: &'static str,
}

impl CameraFileError {
    /// A problem at a byte offset of a text; `format` describes a correct file.
    pub(crate) fn at(text: &str, offset: usize, problem: &str, format: &'static str) -> Self {
        let line = 1 + text.get(..offset).unwrap_or("").matches('\n').count();
        Self { line, problem: plain_problem(text, offset, problem), format }
    }
}

/// Beyond this, the squares of `f32` rays overflow.
pub(crate) const LARGEST_COMPONENT: f64 = 1e18;

impl TryFrom<CameraVectors> for Camera {
    type Error = CameraError;

    fn try_from(CameraVectors { eye, ll, u, v }: CameraVectors) -> Result<Self, CameraError> {
        Self::new(eye, ll, u, v)
    }
}

impl Camera {
    /// A camera from vectors in world space.
    pub fn new(eye: DVec3, ll: DVec3, u: DVec3, v: DVec3) -> Result<Self, CameraError> {
        let usable = |p: DVec3| p.abs().max_element() < LARGEST_COMPONENT && p.is_finite();
        if ![eye, ll, u, v].into_iter().all(usable) {
            return Err(CameraError::NotFinite);
        }
        // Relative to the edges' lengths, so that the model's unit does not matter.
        let area = u.normalize_or_zero().cross(v.normalize_or_zero());
        if area.length() < 1e-9 {
            return Err(CameraError::NoArea);
        }
        let distance = (ll - eye).dot(area.normalize()).abs();
        if distance < 1e-9 * u.length().max(v.length()) {
            return Err(CameraError::EyeInPlane);
        }
        Ok(Self { eye, ll, u, v })
    }

    /// A camera at `eye` that looks at `target`; its view plane passes through `target`.
    ///
    /// `up` need not be perpendicular to the view; if it is parallel, an arbitrary up is used.
    /// `fov_y` is the vertical field of view in radians. `aspect` is the view plane's width over its height: that of the
    /// canvas, not of the frame, because samples need not be square.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3, fov_y: f64, aspect: f64) -> Result<Self, CameraError> {
        let forward = target - eye;
        let distance = forward.length();
        let forward = forward / distance;
        let across = forward.cross(up);
        let right = if across.length() > 1e-6 * up.length() { across } else { forward.any_orthogonal_vector() };
        let right = right.normalize();
        let half_height = distance * (fov_y * 0.5).tan();
        let u = right * (2.0 * half_height * aspect);
        let v = right.cross(forward) * (2.0 * half_height);
        Self::new(eye, target - (u + v) * 0.5, u, v)
    }

    /// Reads the text of a camera file; see [`Camera::to_toml`].
    pub fn from_toml(text: &str) -> Result<Self, CameraFileError> {
        toml::from_str(text).map_err(|error: toml::de::Error| {
            let format = "a camera file has four lines: eye, ll, u and v, each = [x, y, z]";
            CameraFileError::at(text, error.span().map_or(0, |span| span.start), error.message(), format)
        })
    }

    /// Writes a camera file: `eye`, `ll`, `u` and `v`, each `= [x, y, z]`, exact to the last bit.
    pub fn to_toml(&self) -> String {
        let line = |name: &str, p: DVec3| format!("{name} = [{:?}, {:?}, {:?}]\n", p.x, p.y, p.z);
        line("eye", self.eye) + &line("ll", self.ll) + &line("u", self.u) + &line("v", self.v)
    }

    /// The eye, in world space.
    pub fn eye(&self) -> DVec3 {
        self.eye
    }

    /// The lower-left corner of the view plane, in world space.
    pub fn ll(&self) -> DVec3 {
        self.ll
    }

    /// The bottom edge of the view plane, to the right.
    pub fn u(&self) -> DVec3 {
        self.u
    }

    /// The left edge of the view plane, upwards.
    pub fn v(&self) -> DVec3 {
        self.v
    }

    /// The middle of the view plane, in world space.
    pub fn target(&self) -> DVec3 {
        self.ll + (self.u + self.v) * 0.5
    }

    /// The same camera in a space whose zero is at `origin`.
    #[must_use]
    pub fn relative_to(&self, origin: DVec3) -> Self {
        Self { eye: self.eye - origin, ll: self.ll - origin, ..*self }
    }

    /// A point's projection, as parts of the edges u and v; `None` if it lies beside or behind the eye.
    pub fn project(&self, point: DVec3) -> Option<[f64; 2]> {
        // Solve eye + t·(point − eye) = ll + s·u + p·v for t, s and p.
        let normal = self.u.cross(self.v);
        let (ray, to_plane) = (point - self.eye, self.ll - self.eye);
        let t = to_plane.dot(normal) / ray.dot(normal);
        if !(t.is_finite() && t > 0.0) {
            return None;
        }
        let on_plane = ray * t - to_plane;
        let area = normal.length_squared();
        let (s, p) = (on_plane.cross(self.v).dot(normal) / area, self.u.cross(on_plane).dot(normal) / area);
        Some([s, p])
    }

    /// The rays of this camera for a frame of the given size.
    pub fn rays(&self, size: FrameSize) -> CameraRays {
        CameraRays {
            eye: self.eye.as_vec3(),
            a: (self.ll - self.eye).as_vec3(),
            du: (self.u / f64::from(size.xres())).as_vec3(),
            dv: (self.v / f64::from(size.yres())).as_vec3(),
        }
    }
}

/// The origin and direction terms of a frame's rays, in single precision.
///
/// The arithmetic matches that of the peers in comparisons, bit for bit: differences are taken in `f64` and rounded once,
/// then [`CameraRays::direction`] adds in `f32` without fused multiply-add.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraRays {
    /// The origin of every ray, in the camera's space.
    pub eye: Vec3,
    /// From the eye to the lower-left corner of the view plane.
    pub a: Vec3,
    /// One sample's step to the right.
    pub du: Vec3,
    /// One sample's step up.
    pub dv: Vec3,
}

impl CameraRays {
    /// The direction through the centre of sample (i, j), row j = 0 at the bottom; not normalised: t = 1 lies on the
    /// view plane.
    #[inline]
    pub fn direction(&self, i: u32, j: u32) -> Vec3 {
        self.direction_through(i as f32 + 0.5, j as f32 + 0.5)
    }

    /// The direction through the point (x, y) of the view plane, in samples from its lower-left corner.
    #[inline]
    pub fn direction_through(&self, x: f32, y: f32) -> Vec3 {
        (self.a + self.du * x) + self.dv * y
    }

    /// Column and row terms of the directions along an axis: the term for x plus the term for y is that component of
    /// [`CameraRays::direction_through`] (x, y), bit for bit.
    #[inline]
    pub fn direction_terms<const N: usize>(&self, axis: usize, x: &[f32; N], y: &[f32; N]) -> [[f32; N]; 2] {
        let (a, du, dv) = (self.a[axis], self.du[axis], self.dv[axis]);
        [x.map(|x| a + du * x), y.map(|y| dv * y)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_file_keeps_every_bit() {
        let camera = Camera::new(
            DVec3::new(0.1, 1.0 / 3.0, -1e-17),
            DVec3::new(-0.867_890_688_775_879_5, 5e10, 0.3),
            DVec3::new(0.7, 1e-300, 0.0),
            DVec3::new(0.0, 0.7, 1.0),
        )
        .unwrap();
        assert_eq!(Camera::from_toml(&camera.to_toml()).unwrap(), camera);
    }

    #[test]
    fn a_camera_file_that_is_wrong_says_where() {
        let error = Camera::from_toml("eye = [0, 0, 0]\nll = [0, 0]\n").unwrap_err().to_string();
        assert!(error.contains("line 2"), "{error}");
        let error = Camera::from_toml("eye = [0,0,1]\nll = [0,0,0]\nu = [1,0,0]\nv = [2,0,0]").unwrap_err().to_string();
        assert!(error.contains("no area"), "{error}");
    }

    #[test]
    fn vectors_that_make_no_rays_are_refused() {
        let (eye, ll, u, v) = (DVec3::Z, DVec3::ZERO, DVec3::X, DVec3::Y);
        assert_eq!(Camera::new(eye * f64::NAN, ll, u, v), Err(CameraError::NotFinite));
        assert_eq!(Camera::new(eye * 1e19, ll, u, v), Err(CameraError::NotFinite));
        assert_eq!(Camera::new(eye, ll, u, DVec3::ZERO), Err(CameraError::NoArea));
        assert_eq!(Camera::new(DVec3::X, ll, u, v), Err(CameraError::EyeInPlane));
    }

    #[test]
    fn a_point_is_seen_where_its_ray_goes() {
        let (u, v) = (DVec3::new(2.0, 0.5, 0.0), DVec3::new(0.3, 1.0, -0.2));
        let camera = Camera::new(DVec3::new(0.1, 0.2, 3.0), DVec3::new(-1.0, -0.7, 0.3), u, v).unwrap();
        for (s, p, t) in [(0.0, 0.0, 1.0), (0.3, 0.9, 0.1), (-1.0, 2.0, 7.0)] {
            let point = camera.eye() + (camera.ll() + u * s + v * p - camera.eye()) * t;
            let seen = camera.project(point).unwrap();
            assert!((seen[0] - s).abs() < 1e-12 && (seen[1] - p).abs() < 1e-12, "{seen:?}");
            assert_eq!(camera.project(camera.eye() * 2.0 - point), None, "behind the eye");
        }
        let exact = Camera::new(DVec3::Z, DVec3::ZERO, DVec3::X, DVec3::Y).unwrap();
        assert_eq!(exact.project(exact.eye() + DVec3::X), None, "beside the eye");
        assert_eq!(camera.project(camera.eye()), None);
    }

    #[test]
    fn rays_are_made_by_the_stated_arithmetic() {
        let camera =
            Camera::new(DVec3::new(0.1, 0.2, 3.0), DVec3::new(-1.0, -0.7, 0.3), DVec3::X * 1.9, DVec3::Y * 1.1)
                .unwrap();
        let rays = camera.rays(FrameSize::PAPER);
        for axis in 0..3 {
            let a = (camera.ll()[axis] - camera.eye()[axis]) as f32;
            let du = (camera.u()[axis] / 1024.0) as f32;
            let dv = (camera.v()[axis] / 512.0) as f32;
            let expected = (a + du * 700.5) + dv * 33.5;
            assert_eq!(rays.direction(700, 33)[axis].to_bits(), expected.to_bits());
        }
    }
}
