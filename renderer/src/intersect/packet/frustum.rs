//! The frustum around the rays of packets, slab by slab.

use crate::grid::tree::overlap::DILATION;

/// First and last finest cell along u and v.
#[derive(Clone, Copy)]
pub(super) struct CellBounds {
    pub(super) u: [i32; 2],
    pub(super) v: [i32; 2],
}

/// Bounds of all rays of the packets, in finest cells along k, u and v.
pub(super) struct Frustum {
    pub(super) origin: [f64; 3],
    pub(super) is_forward: bool,
    /// Least and largest du/dk, least and largest dv/dk.
    pub(super) slopes: [f32; 4],
    pub(super) size: [f64; 2],
    /// Finest cells in a world unit.
    pub(super) cells_per_unit: f64,
    /// Rounding error of a position, which grows with the origin's distance.
    pub(super) margin: f64,
}

impl Frustum {
    /// The depths of a slab's near and far side, measured from the origin along the major axis.
    #[inline(always)]
    pub(super) fn depths(&self, low: i32, size: i32) -> (f64, f64) {
        let (low, high) = (f64::from(low), f64::from(low + size));
        if self.is_forward {
            (low - self.origin[0] - self.margin, high - self.origin[0] + self.margin)
        } else {
            (self.origin[0] - high - self.margin, self.origin[0] - low + self.margin)
        }
    }

    /// The cells of the grid within the frustum between two depths, if there are any.
    #[inline(always)]
    pub(super) fn cells(&self, near: f64, far: f64) -> Option<CellBounds> {
        let near = near.max(0.0);
        Some(CellBounds { u: self.cell_range(0, near, far)?, v: self.cell_range(1, near, far)? })
    }

    /// The first and last cell along u (0) or v (1).
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

    /// Area of the frustum's section at a depth.
    #[inline(always)]
    pub(super) fn area(&self, depth: f64) -> f64 {
        let [u_low, u_high, v_low, v_high] = self.slopes;
        f64::from(u_high - u_low) * f64::from(v_high - v_low) * (depth * depth)
    }

    /// A slab in which cells of this size may lie between the rays, if the frustum is wide enough there.
    #[inline(always)]
    pub(super) fn narrow(&self, near: f64, far: f64, size: u32) -> Option<NarrowSlab<'_>> {
        let width = f64::from(self.slopes[1] - self.slopes[0]) * near;
        (near > f64::from(size) * 1e-3 && width > LEAST_CELLS_ACROSS * f64::from(size)).then(|| NarrowSlab {
            frustum: self,
            inverse_depth: (self.cells_per_unit / near * (1.0 + 1e-6)) as f32,
            inverse_near: 1.0 / near,
            inverse_far: 1.0 / far,
        })
    }

    /// A lower bound of the depth at which the frustum enters the grid; infinite if it never does.
    #[inline(always)]
    pub(super) fn entry_depth(&self) -> f64 {
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

/// Cells that must fit across the packets before culling cells between their rays pays.
const LEAST_CELLS_ACROSS: f64 = 1.0;

/// A slab that lies in front of the origin.
#[derive(Clone, Copy)]
pub(super) struct NarrowSlab<'a> {
    frustum: &'a Frustum,
    /// Inverse depth of the near side, per world unit.
    pub(super) inverse_depth: f32,
    /// Inverse depths of its sides, per finest cell.
    inverse_near: f64,
    inverse_far: f64,
}

impl NarrowSlab<'_> {
    /// Bounds of the slopes of rays that pass a cell, whose lowest coordinate along u (0) or v (1) is `low`.
    #[inline(always)]
    pub(super) fn slopes(&self, axis: usize, low: i32, size: f64) -> [f32; 2] {
        let margin = DILATION + self.frustum.margin;
        let low = f64::from(low) - self.frustum.origin[axis + 1];
        let (low, high) = (low - margin, low + size + margin);
        [
            (low * if low < 0.0 { self.inverse_near } else { self.inverse_far }) as f32,
            (high * if high < 0.0 { self.inverse_far } else { self.inverse_near }) as f32,
        ]
    }
}
