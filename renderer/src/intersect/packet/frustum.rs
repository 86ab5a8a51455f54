//! The region that a packet's rays pass, slab by slab.

use crate::grid::tree::overlap::DILATION;

/// Finest cells across the major axis: first and last.
#[derive(Clone, Copy)]
pub(crate) struct CellBounds {
    pub(crate) u: [i32; 2],
    pub(crate) v: [i32; 2],
}

/// The region that a packet's rays pass, in finest cells along k, u and v.
pub(crate) struct Frustum {
    pub(crate) origin: [f64; 3],
    pub(crate) is_forward: bool,
    /// Least and largest du/dk, least and largest dv/dk.
    pub(crate) slopes: [f32; 4],
    /// The grid's size along u and v.
    pub(crate) size: [f64; 2],
    /// Finest cells in a world unit.
    pub(crate) cells_per_unit: f64,
    /// What rounding can do to a place, when the origin is far away.
    pub(crate) margin: f64,
}

impl Frustum {
    /// The depths at which a slab begins and ends, counted from the origin along the way.
    #[inline(always)]
    pub(crate) fn depths(&self, low: i32, size: i32) -> (f64, f64) {
        let (low, high) = (f64::from(low), f64::from(low + size));
        if self.is_forward {
            (low - self.origin[0] - self.margin, high - self.origin[0] + self.margin)
        } else {
            (self.origin[0] - high - self.margin, self.origin[0] - low + self.margin)
        }
    }

    /// The cells of the grid that lie within the frustum from one depth to another, if any do.
    #[inline(always)]
    pub(crate) fn cells(&self, near: f64, far: f64) -> Option<CellBounds> {
        let near = near.max(0.0);
        Some(CellBounds { u: self.cell_range(0, near, far)?, v: self.cell_range(1, near, far)? })
    }

    #[inline(always)]
    fn cell_range(&self, axis: usize, near: f64, far: f64) -> Option<[i32; 2]> {
        let (low, high) = (f64::from(self.slopes[2 * axis]), f64::from(self.slopes[2 * axis + 1]));
        let from = self.origin[axis + 1] - self.margin + low * if low < 0.0 { far } else { near };
        let to = self.origin[axis + 1] + self.margin + high * if high < 0.0 { near } else { far };
        if to < 0.0 || from > self.size[axis] {
            return None;
        }
        let last = self.size[axis] as i32 - 1;
        Some([(from.max(0.0) as i32).min(last), (to as i32).min(last)])
    }

    /// The area of its section at a depth.
    #[inline(always)]
    pub(crate) fn area(&self, depth: f64) -> f64 {
        let [u_low, u_high, v_low, v_high] = self.slopes;
        f64::from(u_high - u_low) * f64::from(v_high - v_low) * (depth * depth)
    }

    /// A slab in which cells of this size may slip between the rays.
    #[inline(always)]
    pub(crate) fn narrow(&self, near: f64, far: f64, size: u32) -> Option<NarrowSlab<'_>> {
        let width = f64::from(self.slopes[1] - self.slopes[0]) * near;
        (near > f64::from(size) * 1e-3 && width > LEAST_CELLS_ACROSS * f64::from(size)).then(|| NarrowSlab {
            frustum: self,
            inverse_depth: (self.cells_per_unit / near * (1.0 + 1e-6)) as f32,
            inverse_near: 1.0 / near,
            inverse_far: 1.0 / far,
        })
    }

    /// A depth before which the frustum does not meet the grid.
    #[inline(always)]
    pub(crate) fn entry_depth(&self) -> f64 {
        let mut depth = 0.0f64;
        for axis in 0..2 {
            let (low, high) = (f64::from(self.slopes[2 * axis]), f64::from(self.slopes[2 * axis + 1]));
            let origin = self.origin[axis + 1];
            let (distance, slope) = if origin + self.margin < 0.0 {
                (-origin - self.margin, high)
            } else if origin - self.margin > self.size[axis] {
                (origin - self.margin - self.size[axis], -low)
            } else {
                continue;
            };
            depth = depth.max(if slope > 0.0 { distance / slope } else { f64::INFINITY });
        }
        (depth * (1.0 - 1e-9) - self.margin).max(0.0)
    }
}

/// How many cells must fit across a packet before it pays to look for cells between its rays.
const LEAST_CELLS_ACROSS: f64 = 1.0;

/// A slab that lies wholly before the origin.
#[derive(Clone, Copy)]
pub(crate) struct NarrowSlab<'a> {
    frustum: &'a Frustum,
    /// Inverse depth of the nearer side, per world unit.
    pub(crate) inverse_depth: f32,
    /// Inverse depths of its sides.
    inverse_near: f64,
    inverse_far: f64,
}

impl NarrowSlab<'_> {
    /// The slopes between which a cell of the slab is seen, from its lowest place along u (0) or v (1).
    #[inline(always)]
    pub(crate) fn slopes(&self, axis: usize, low: i32, size: f64) -> [f32; 2] {
        let margin = DILATION + self.frustum.margin;
        let low = f64::from(low) - self.frustum.origin[axis + 1];
        let (low, high) = (low - margin, low + size + margin);
        [
            (low * if low < 0.0 { self.inverse_near } else { self.inverse_far }) as f32,
            (high * if high < 0.0 { self.inverse_far } else { self.inverse_near }) as f32,
        ]
    }
}
