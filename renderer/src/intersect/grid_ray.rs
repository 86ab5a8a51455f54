//! A ray in the cells of a grid, in `f64`.

use glam::DVec3;

use crate::{
    grid::{cells::CellSpace, tree::overlap},
    intersect::{exact::ExactSum, ray::Ray},
};

/// `f64::floor` is a function call where SSE4.1 may be missing; this is not.
#[inline(always)]
pub(super) fn floor(x: f64) -> i32 {
    let truncated = x as i32;
    truncated.saturating_sub(i32::from(f64::from(truncated) > x))
}

/// A ray in finest cells, whose origin is moved along the ray if it is far from the grid.
#[derive(Clone, Copy)]
pub(super) struct GridRay {
    pub(super) origin: [f64; 3],
    pub(super) direction: [f64; 3],
    /// The ray's t at the moved origin.
    pub(super) t_base: f64,
    /// Rounding error of t.
    pub(super) t_slack: f64,
}

impl GridRay {
    /// `None` for rays that are not finite, and for some that pass far from the grid.
    #[inline(always)]
    pub(super) fn new(space: &CellSpace, ray: &Ray, dims: [i32; 3]) -> Option<Self> {
        let origin = space.point_to_cells(ray.origin.as_dvec3());
        let direction = space.direction_to_cells(ray.direction.as_dvec3());
        if !origin.is_finite() || !direction.is_finite() || direction == DVec3::ZERO {
            return None;
        }
        let grid_ray = Self { origin: origin.to_array(), direction: direction.to_array(), t_base: 0.0, t_slack: 0.0 };
        if origin.abs().max_element() <= FARTHEST_ORIGIN { Some(grid_ray) } else { grid_ray.rebased(space, ray, dims) }
    }

    /// The interval of t, from `t_base` on, in which a ray may pass the grid's bounds, enlarged as its cells are; `None` if
    /// there is none.
    ///
    /// `inverse` is one over the direction.
    #[inline(always)]
    pub(super) fn clip(&self, ray: &Ray, inverse: &[f64; 3], dims: [i32; 3]) -> Option<[f64; 2]> {
        let mut t_enter = f64::from(ray.t_min) - self.t_base - self.t_slack;
        let mut t_end = f64::from(ray.t_max) - self.t_base + self.t_slack;
        for axis in 0..3 {
            let low = -overlap::DILATION - self.origin[axis];
            let high = f64::from(dims[axis]) + overlap::DILATION - self.origin[axis];
            if self.direction[axis] == 0.0 {
                if low > 0.0 || high < 0.0 {
                    return None;
                }
            } else {
                let (a, b) = (low * inverse[axis], high * inverse[axis]);
                let (near, far) = if a < b { (a, b) } else { (b, a) };
                t_enter = if near > t_enter { near } else { t_enter };
                t_end = if far < t_end { far } else { t_end };
            }
        }
        (t_enter <= t_end).then_some([t_enter, t_end])
    }

    /// Moves the origin along the ray to a point close to the grid.
    ///
    /// Each step leads towards the point nearest to the grid's centre. Its length has the 24 bits of an `f32`, so the
    /// new point can be computed exactly; the next step covers the rest.
    #[cold]
    fn rebased(mut self, space: &CellSpace, ray: &Ray, dims: [i32; 3]) -> Option<Self> {
        let direction = DVec3::from_array(self.direction);
        let centre = DVec3::from_array(dims.map(|n| f64::from(n) * 0.5));
        let mut point = DVec3::from_array(self.origin);
        let mut delta_ts = Vec::new();
        for _ in 0..MOST_REBASES {
            let delta_t = ((centre - point).dot(direction) / direction.length_squared()) as f32;
            if delta_t == 0.0 || !delta_t.is_finite() {
                return None;
            }
            delta_ts.push(delta_t);

            // Sum up origin + Σ delta_t · direction − the grid's corner exactly.
            let from_low = [0, 1, 2].map(|axis| {
                let mut sum = ExactSum::default();
                delta_ts.iter().for_each(|&delta_t| sum.add_product(delta_t, ray.direction[axis], 1.0));
                sum.add_product(ray.origin[axis], 1.0, 1.0);
                sum.add_product(-space.origin[axis], 1.0, 1.0);
                sum.value()
            });
            point = space.direction_to_cells(DVec3::from_array(from_low));
            if point.abs().max_element() <= FARTHEST_ORIGIN {
                self.origin = point.to_array();
                self.t_base = delta_ts.iter().map(|&delta_t| f64::from(delta_t)).sum();
                self.t_slack = self.t_base.abs() * 1e-9;
                return Some(self);
            }
        }
        None
    }
}

/// Farthest origin that is not moved, in finest cells: 2⁻⁵³ of this is well below the margin around cells.
pub(super) const FARTHEST_ORIGIN: f64 = (1u64 << 34) as f64;

/// Each step reduces the distance by 23 bits, and the range of `f32` has 277.
const MOST_REBASES: usize = 16;
