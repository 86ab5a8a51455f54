//! A ray and what it hits.

use glam::Vec3;

/// A ray in world space: the points `origin + t·direction` with t in `t_min..=t_max`.
///
/// The direction is not normalised, and every t is in units of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where t = 0.
    pub origin: Vec3,
    /// The step of t = 1.
    pub direction: Vec3,
    /// The first t that counts.
    pub t_min: f32,
    /// The last t that counts.
    pub t_max: f32,
}

impl Ray {
    /// A ray from its origin to as far as a depth can be told.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        Self { origin, direction, t_min: 0.0, t_max: f32::MAX }
    }
}

/// The nearest triangle along a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Which one: within the renderer its place in the [`crate::grid::traced::TracedMesh`], outside its number in the file.
    pub triangle: u32,
    /// Where, in units of the ray's direction.
    pub t: f32,
}

impl Hit {
    /// No triangle at all.
    pub const MISS: Self = Self { triangle: u32::MAX, t: f32::INFINITY };

    /// Whether there is no triangle.
    pub fn is_miss(self) -> bool {
        self.triangle == u32::MAX
    }
}
