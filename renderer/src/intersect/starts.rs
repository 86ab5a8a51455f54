//! Rays where they enter a grid, several at once.
//!
//! A ray that meets little is not traced much longer than it takes to prepare it.

use crate::{
    grid::{cells::CellSpace, tree::overlap},
    intersect::{
        grid_ray::{FARTHEST_ORIGIN, GridRay},
        ray::Ray,
        triangle::Vector,
    },
    simd::Real,
};

/// Rounding errors of positions and distances in a grid, relative to its extent: ten roundings of `f32`.
const RELATIVE_MARGIN: f64 = 10.0 / (1 << 24) as f64;

/// Rounding errors that do not depend on the extent, in finest cells.
const MARGIN: f64 = 1.0 / 1024.0;

/// The largest inverse component of a direction whose largest component is 1: over a grid, smaller components move a ray by
/// less than [`MARGIN`].
const STEEPEST: f64 = 1e12;

/// In place of an infinite inverse: finite products with any position, and beyond all inverses of components that are not 0.
const INFINITE: f64 = 1e290;

/// Up to eight rays, a lane each.
///
/// A ray's parameter s counts finest cells along its major axis, from the point where it enters the grid.
#[derive(Clone, Copy, Default)]
pub(super) struct RayStarts {
    /// A bit for each ray that may meet the grid.
    pub(super) meeting: u32,
    /// A bit for each ray that [`RayStarts::of_far_ray`] must prepare.
    pub(super) far: u32,
    /// s where the position along each axis is 0, with a margin to either side, and s over a unit of the position.
    pub(super) s_near: [[f64; 8]; 3],
    pub(super) s_far: [[f64; 8]; 3],
    pub(super) s_step: [[f64; 8]; 3],
    /// The ray's interval.
    pub(super) s_start: [f64; 8],
    pub(super) s_end: [f64; 8],
    /// t where s is 0, units of s in one of t, and the rounding error of s.
    pub(super) t_base: [f64; 8],
    pub(super) s_per_t: [f64; 8],
    pub(super) s_slack: [f64; 8],
}

impl RayStarts {
    /// The first of some rays, [`Real::LANES`] of them, in a grid that extends over so many finest cells.
    #[inline(always)]
    pub(super) fn new<R: Real>(space: &CellSpace, extent: [u32; 3], rays: &[Ray]) -> Self {
        let mut numbers = [[0.0; 8]; 8];
        for (lane, ray) in rays.iter().take(R::LANES).enumerate() {
            let of_ray = [ray.origin.to_array(), ray.direction.to_array(), [ray.t_min, ray.t_max, 0.0]];
            for (number, of_ray) in of_ray.into_iter().flatten().take(8).enumerate() {
                numbers[number][lane] = of_ray;
            }
        }

        // Convert to finest cells.
        let cells_per_unit = R::splat(space.cells_per_unit);
        let (mut origin, mut direction) = ([cells_per_unit; 3], [cells_per_unit; 3]);
        for axis in 0..3 {
            let low = R::splat(f64::from(space.origin[axis]));
            origin[axis] = R::load(&numbers[axis]).sub(low).mul(cells_per_unit);
            direction[axis] = R::load(&numbers[3 + axis]).mul(cells_per_unit);
        }

        // Rays that are far away, or not finite, are rare.
        let all = (1 << R::LANES.min(rays.len())) - 1;
        let mut near = all;
        for axis in 0..3 {
            near &=
                origin[axis].abs().le(R::splat(FARTHEST_ORIGIN)) & direction[axis].abs().lt(R::splat(f64::INFINITY));
        }
        let (zero, t_range) = (R::splat(0.0), [R::load(&numbers[6]), R::load(&numbers[7])]);
        let starts = Self::of_lanes(extent, origin, direction, t_range, [zero, zero]);
        Self { meeting: starts.meeting & near, far: all & !near, ..starts }
    }

    /// A ray that comes from far away, or is not finite, in the first lane.
    #[cold]
    pub(super) fn of_far_ray(space: &CellSpace, extent: [u32; 3], ray: &Ray) -> Self {
        let Some(grid_ray) = GridRay::new(space, ray, extent.map(|n| n as i32)) else { return Self::default() };
        let GridRay { origin, direction, t_base, t_slack } = grid_ray;
        let t_range = [f64::from(ray.t_min), f64::from(ray.t_max)];
        Self::of_lanes(extent, origin, direction, t_range, [t_base, t_slack])
    }

    /// Rays in finest cells, each with t at its origin and the rounding error of t.
    #[inline(always)]
    fn of_lanes<R: Real>(
        extent: [u32; 3],
        origin: Vector<R>,
        direction: Vector<R>,
        [t_min, t_max]: [R; 2],
        [t_base, t_slack]: [R; 2],
    ) -> Self {
        // Clip the rays to the grid's bounds, enlarged as its cells are. Along an axis of no motion, both sides are infinitely
        // far away: behind and ahead of rays between them, else both on one side.
        let mut t_enter = t_min.sub(t_base).sub(t_slack);
        let mut t_end = t_max.sub(t_base).add(t_slack);
        let mut s_per_t = R::splat(0.0);
        let mut inverse = [s_per_t; 3];
        for axis in 0..3 {
            let bounded = R::splat(1.0).div(direction[axis]).min(R::splat(INFINITE));
            inverse[axis] = bounded.max(R::splat(-INFINITE));
            let to_low = R::splat(-overlap::DILATION).sub(origin[axis]).mul(inverse[axis]);
            let to_high = R::splat(f64::from(extent[axis]) + overlap::DILATION).sub(origin[axis]).mul(inverse[axis]);
            // A NaN in the interval stays there.
            t_enter = to_low.min(to_high).max(t_enter);
            t_end = to_low.max(to_high).min(t_end);
            s_per_t = s_per_t.max(direction[axis].abs());
        }
        let meeting = t_enter.le(t_end) & R::splat(0.0).lt(s_per_t);

        // Let s count from the point where rays enter the grid.
        let mut starts = Self { meeting, ..Self::default() };
        let (t_base, s_slack) = (t_base.add(t_enter), t_slack.mul(s_per_t));
        t_min.sub(t_base).mul(s_per_t).sub(s_slack).store(&mut starts.s_start);
        t_end.sub(t_enter).mul(s_per_t).store(&mut starts.s_end);
        t_base.store(&mut starts.t_base);
        s_per_t.store(&mut starts.s_per_t);
        s_slack.store(&mut starts.s_slack);

        // Prepare the slabs of positions in the grid.
        for axis in 0..3 {
            let step = inverse[axis].mul(s_per_t).min(R::splat(STEEPEST)).max(R::splat(-STEEPEST));
            let s_zero = origin[axis].add(t_enter.mul(direction[axis])).mul(step);
            let margin = step.abs().mul(R::splat(f64::from(extent[axis]) * RELATIVE_MARGIN + MARGIN));
            R::splat(0.0).sub(s_zero).sub(margin).store(&mut starts.s_near[axis]);
            margin.sub(s_zero).store(&mut starts.s_far[axis]);
            step.store(&mut starts.s_step[axis]);
        }
        starts
    }
}
