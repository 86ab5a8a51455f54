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
/// Its parameter s counts finest cells along the major axis, from the moved origin on. Arrays have a fourth lane, so that
/// they fill vectors.
#[derive(Default)]
pub(super) struct BrickWalk {
    origin: [f64; 4],
    /// The largest component is 1 or −1, but for rounding.
    direction: [f64; 4],
    /// NaN along axes that the ray does not cross.
    pub(super) inverse_direction: [f64; 4],
    /// 1 along axes on which the ray goes up.
    ahead: [i32; 4],
    /// t where s is 0, and units of t in one of s.
    t_base: f64,
    s_per_t: f64,
    /// Rounding error of s.
    s_slack: f64,
    /// Bricks per axis.
    dims: [i32; 4],
    brick: [i32; 4],
    /// Where the ray enters the present brick.
    s_enter: f64,
    /// The ray's interval.
    s_start: f64,
    s_end: f64,
}

/// A brick's side in finest cells.
const SIDE: f64 = BRICK_SIZE as f64;

impl BrickWalk {
    /// Enters the tree with a ray, in place of any other; returns false for rays that miss it.
    #[inline(always)]
    pub(super) fn begin(&mut self, space: &CellSpace, tree: &Tree, ray: &Ray) -> bool {
        let extent = tree.extent.map(|n| n as i32);
        let Some(grid_ray) = GridRay::new(space, ray, extent) else { return false };
        let inverse = grid_ray.direction.map(|d| 1.0 / d);
        let Some([t_enter, t_end]) = grid_ray.clip(ray, &inverse, extent) else { return false };
        let GridRay { origin: [ox, oy, oz], direction: [dx, dy, dz], t_base, t_slack } = grid_ray;
        let s_per_t = dx.abs().max(dy.abs()).max(dz.abs());
        let (t_per_s, s_enter) = (1.0 / s_per_t, t_enter * s_per_t);
        self.origin = [ox, oy, oz, 0.0];
        self.direction = [dx * t_per_s, dy * t_per_s, dz * t_per_s, 0.0];
        self.dims = [tree.dims[0] as i32, tree.dims[1] as i32, tree.dims[2] as i32, 1];
        (self.t_base, self.s_per_t, self.s_slack) = (t_base, s_per_t, t_slack * s_per_t);
        self.s_enter = s_enter;
        self.s_start = (f64::from(ray.t_min) - t_base - t_slack) * s_per_t;
        self.s_end = t_end * s_per_t;
        (self.inverse_direction[3], self.brick[3]) = (f64::NAN, 0);
        for axis in 0..3 {
            let direction = self.direction[axis];
            self.inverse_direction[axis] = if direction == 0.0 { f64::NAN } else { inverse[axis] * s_per_t };
            self.ahead[axis] = i32::from(direction > 0.0);
            let entry = floor((self.origin[axis] + s_enter * direction) * (1.0 / SIDE));
            self.brick[axis] = entry.max(0).min(self.dims[axis] - 1);
        }
        true
    }

    /// The tree's entry for the present brick.
    #[inline(always)]
    pub(super) fn brick(&self, tree: &Tree) -> u32 {
        let [x, y, z, _] = self.brick;
        tree.bricks[((z * self.dims[1] + y) as usize) * self.dims[0] as usize + x as usize]
    }

    /// The point at which the ray enters the present brick, relative to its corner, and the ray's interval from there, up
    /// to `t_end`.
    #[inline(always)]
    pub(super) fn in_brick(&self, t_end: f64) -> ([f32; 4], [f32; 2]) {
        let mut point = [0.0; 4];
        for axis in 0..4 {
            let corner = f64::from(self.brick[axis]) * SIDE;
            point[axis] = (self.origin[axis] + self.s_enter * self.direction[axis] - corner) as f32;
        }
        let s_start = (self.s_start - self.s_enter) as f32;
        let s_end = (self.s_end - self.s_enter) as f32;
        (point, [down(s_start), lesser(up(s_end), self.s_in_brick(t_end))])
    }

    /// s in the present brick at `t`, rounded up.
    #[inline(always)]
    pub(super) fn s_in_brick(&self, t: f64) -> f32 {
        up(((t - self.t_base) * self.s_per_t + self.s_slack - self.s_enter) as f32)
    }

    /// Goes to the next brick; returns false where the ray ends, at `t_end` at the latest.
    #[inline(always)]
    pub(super) fn step(&mut self, t_end: f64) -> bool {
        let mut s_planes = [0.0; 4];
        for axis in 0..4 {
            let plane = f64::from(self.brick[axis] + self.ahead[axis]) * SIDE;
            s_planes[axis] = (plane - self.origin[axis]) * self.inverse_direction[axis];
        }
        let (mut s_crossing, mut step_axis) = (f64::INFINITY, 3);
        for axis in 0..3 {
            let is_nearer = s_planes[axis] < s_crossing;
            s_crossing = if is_nearer { s_planes[axis] } else { s_crossing };
            step_axis = if is_nearer { axis } else { step_axis };
        }
        // Stepping along the fourth lane leads out.
        let delta = 2 * self.ahead[step_axis] - 1;
        self.brick[step_axis] += delta;
        self.s_enter = if s_crossing > self.s_enter { s_crossing } else { self.s_enter };
        let s_end = (t_end - self.t_base) * self.s_per_t + self.s_slack;
        let s_end = if s_end < self.s_end { s_end } else { self.s_end };
        let is_inside = (self.brick[step_axis] as u32) < self.dims[step_axis] as u32;
        is_inside & (s_crossing <= s_end)
    }
}

/// The next greater number, or one a little greater.
#[inline(always)]
fn up(x: f32) -> f32 {
    x + x.abs() * f32::EPSILON + f32::MIN_POSITIVE
}

/// The next smaller number, or one a little smaller.
#[inline(always)]
fn down(x: f32) -> f32 {
    x - x.abs() * f32::EPSILON - f32::MIN_POSITIVE
}

/// The lesser of two numbers; the second of NaNs.
#[inline(always)]
pub(super) fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}
