//! The way of a single ray through the bricks of a tree: a DDA after Amanatides and Woo, "A Fast Voxel Traversal Algorithm
//! for Ray Tracing" (1987).
//!
//! Crossings are computed in `f64` from the ray itself and never accumulated, so rounding stays far below the margin by
//! which cells are enlarged.

use crate::{
    grid::{
        cells::CellSpace,
        tree::{BRICK_SIZE, Tree},
    },
    intersect::{
        grid_ray::{GridRay, floor},
        ray::Ray,
    },
};

/// A ray on its way through the bricks of a tree, by a DDA.
///
/// Its parameter s counts finest cells along the major axis, from the moved origin on.
pub(super) struct BrickWalk {
    origin: [f64; 3],
    /// The largest component is 1 or −1.
    direction: [f64; 3],
    inverse_direction: [f64; 3],
    /// t where s is 0, and units of t in one of s.
    t_base: f64,
    s_per_t: f64,
    /// Rounding error of s.
    s_slack: f64,
    /// Bricks per axis.
    dims: [i32; 3],
    brick: [i32; 3],
    /// Where the ray enters the present brick.
    s_enter: f64,
    /// The ray's interval.
    s_start: f64,
    s_end: f64,
}

impl BrickWalk {
    /// Enters the tree; `None` for rays that miss it.
    #[inline]
    pub(super) fn new(space: &CellSpace, tree: &Tree, ray: &Ray) -> Option<Self> {
        let extent = tree.extent.map(|n| n as i32);
        let grid_ray = GridRay::new(space, ray, extent)?;
        let [t_enter, t_end] = grid_ray.clip(ray, extent)?;
        let GridRay { origin, direction, t_base, t_slack } = grid_ray;
        let s_per_t = direction.iter().fold(0.0f64, |largest, d| largest.max(d.abs()));
        let (direction, s_enter) = (direction.map(|d| d / s_per_t), t_enter * s_per_t);
        let dims = tree.dims.map(|n| n as i32);
        let at = |axis: usize| floor((origin[axis] + s_enter * direction[axis]) * (1.0 / f64::from(BRICK_SIZE)));
        Some(Self {
            origin,
            direction,
            inverse_direction: direction.map(|d| 1.0 / d),
            t_base,
            s_per_t,
            s_slack: t_slack * s_per_t,
            dims,
            brick: [0, 1, 2].map(|axis| at(axis).clamp(0, dims[axis] - 1)),
            s_enter,
            s_start: (f64::from(ray.t_min) - t_base - t_slack) * s_per_t,
            s_end: t_end * s_per_t,
        })
    }

    #[inline(always)]
    pub(super) fn direction(&self) -> [f32; 3] {
        self.direction.map(|d| d as f32)
    }

    /// The tree's entry for the present brick.
    #[inline(always)]
    pub(super) fn brick(&self, tree: &Tree) -> u32 {
        let [x, y, z] = self.brick.map(|x| x as usize);
        tree.bricks[(z * self.dims[1] as usize + y) * self.dims[0] as usize + x]
    }

    /// The point at which the ray enters the present brick, relative to its corner, and the ray's interval from there, up
    /// to `t_end`.
    #[inline(always)]
    pub(super) fn in_brick(&self, t_end: f64) -> ([f32; 3], [f32; 2]) {
        let point = [0, 1, 2].map(|axis| {
            let corner = f64::from(self.brick[axis]) * f64::from(BRICK_SIZE);
            (self.origin[axis] + self.s_enter * self.direction[axis] - corner) as f32
        });
        let s_start = (self.s_start - self.s_enter) as f32;
        let s_end = (self.s_end - self.s_enter) as f32;
        (point, [s_start.next_down(), s_end.next_up().min(self.s_in_brick(t_end))])
    }

    /// s in the present brick at `t`, rounded up.
    #[inline(always)]
    pub(super) fn s_in_brick(&self, t: f64) -> f32 {
        (((t - self.t_base) * self.s_per_t + self.s_slack - self.s_enter) as f32).next_up()
    }

    /// Goes to the next brick; returns false where the ray ends, at `t_end` at the latest.
    #[inline(always)]
    pub(super) fn step(&mut self, t_end: f64) -> bool {
        let (mut s_crossing, mut step_axis) = (f64::INFINITY, 3);
        for axis in 0..3 {
            let plane = f64::from((self.brick[axis] + i32::from(self.direction[axis] > 0.0)) * BRICK_SIZE as i32);
            let s = (plane - self.origin[axis]) * self.inverse_direction[axis];
            if self.direction[axis] != 0.0 && s < s_crossing {
                (s_crossing, step_axis) = (s, axis);
            }
        }
        let s_end = self.s_end.min((t_end - self.t_base) * self.s_per_t + self.s_slack);
        if step_axis == 3 || s_crossing > s_end {
            return false;
        }
        self.brick[step_axis] += if self.direction[step_axis] > 0.0 { 1 } else { -1 };
        self.s_enter = self.s_enter.max(s_crossing);
        (0..self.dims[step_axis]).contains(&self.brick[step_axis])
    }
}
