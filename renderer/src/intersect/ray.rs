//! A ray and its hit.

use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// A ray in model space: the points `origin + t·direction` with t in `t_min..=t_max`.
///
/// The direction is not normalised. Kernels load the eight numbers as a row, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Ray {
    /// Point at t = 0.
    pub origin: Vec3,
    /// Vector from t = 0 to t = 1.
    pub direction: Vec3,
    /// Start of the ray's interval, in units of `direction`.
    pub t_min: f32,
    /// End of the ray's interval, in units of `direction`.
    pub t_max: f32,
}

impl Ray {
    /// A ray from its origin to the largest finite t.
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        Self { origin, direction, t_min: 0.0, t_max: f32::MAX }
    }
}

/// The axis of a direction's largest absolute component; the first of equal ones.
#[inline(always)]
pub(super) fn major_axis(direction: [f32; 3]) -> usize {
    let [x, y, z] = direction.map(f32::abs);
    if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    }
}

/// The hit of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Triangle index in the [`crate::grid::traced::TracedMesh`] within the renderer, file index outside of it; or
    /// [`Hit::CAP`].
    pub triangle: u32,
    /// Position along the ray, in units of its direction.
    pub t: f32,
}

impl Hit {
    /// No hit.
    pub const MISS: Self = Self { triangle: u32::MAX, t: f32::INFINITY };

    /// The index of the cap of a cut, in place of a triangle's; no mesh has as many triangles.
    pub const CAP: u32 = u32::MAX - 1;

    /// Whether the ray enters the cut through a solid.
    pub fn is_cap(self) -> bool {
        self.triangle == Self::CAP
    }

    /// Whether the ray hits nothing.
    pub fn is_miss(self) -> bool {
        self.triangle == u32::MAX
    }
}
