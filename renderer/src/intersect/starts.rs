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
    simd::{Real, Simd, consecutive},
};

/// Rounding errors of positions and distances in a grid, relative to its extent: ten roundings of `f32`.
const RELATIVE_MARGIN: f64 = 10.0 / (1 << 24) as f64;

/// Rounding errors that do not depend on the extent, in finest cells.
const MARGIN: f64 = 1.0 / 1024.0;

/// Rounding errors of positions in a grid that extends over so many finest cells.
fn position_margin(extent: u32) -> f64 {
    f64::from(extent) * RELATIVE_MARGIN + MARGIN
}

/// The largest inverse component of a direction whose largest component is 1: over a grid, smaller components move a ray by
/// less than [`MARGIN`].
const STEEPEST: f64 = 1e12;

/// In place of an infinite inverse: finite products with any position, and beyond all inverses of components that are not 0.
const INFINITE: f64 = 1e290;

/// Up to sixteen rays, a lane each.
///
/// A ray's parameter s counts finest cells along its major axis, from the point where it enters the grid.
#[derive(Clone, Copy)]
pub(super) struct RayStarts {
    /// A bit for each ray that may meet the grid.
    pub(super) meeting: u32,
    /// A bit for each ray that [`RayStarts::of_far_ray`] must prepare.
    pub(super) far: u32,
    /// s where the position along each axis is 0, with a margin to either side, and s over a unit of the position.
    pub(super) s_near: [[f32; 16]; 3],
    pub(super) s_far: [[f32; 16]; 3],
    pub(super) s_step: [[f32; 16]; 3],
    /// The ray's interval, rounded outward.
    pub(super) s_start: [f32; 16],
    pub(super) s_end: [f32; 16],
    /// t where s is 0, units of s in one of t, and the rounding error of s.
    pub(super) t_base: [f64; 16],
    pub(super) s_per_t: [f64; 16],
    pub(super) s_slack: [f64; 16],
    /// Where the ray begins or enters the grid, and where it ends or leaves it, by axis, in finest cells; only with `ENDS`.
    ends: [[[f32; 16]; 3]; 2],
}

impl RayStarts {
    pub(super) const EMPTY: Self = Self {
        meeting: 0,
        far: 0,
        s_near: [[0.0; 16]; 3],
        s_far: [[0.0; 16]; 3],
        s_step: [[0.0; 16]; 3],
        s_start: [0.0; 16],
        s_end: [0.0; 16],
        t_base: [0.0; 16],
        s_per_t: [0.0; 16],
        s_slack: [0.0; 16],
        ends: [[[0.0; 16]; 3]; 2],
    };

    /// Prepares the first of some rays, [`Simd::LANES`] of them, in a grid that extends over so many finest cells. In place:
    /// to return them took up to a twentieth of the time of short rays.
    #[inline(always)]
    pub(super) fn prepare_rays<S: Simd, const ENDS: bool>(
        &mut self,
        space: &CellSpace,
        extent: [u32; 3],
        rays: &[Ray],
    ) {
        let columns = S::gather_columns(bytemuck::cast_slice(rays), &consecutive(0));
        let mut numbers = [[0.0; 16]; 8];
        for number in 0..8 {
            columns[number].store(&mut numbers[number]);
        }
        (self.meeting, self.far) = (0, 0);
        for first in (0..S::LANES.min(rays.len())).step_by(S::Double::LANES) {
            self.prepare_near::<S::Double, ENDS>(space, extent, &numbers, first);
        }
    }

    /// Bounds along each axis of the rays that meet the grid, within it, in finest cells; inverted if none does. The ends of
    /// those rays are finite.
    #[inline(always)]
    pub(super) fn bounds<S: Simd>(all: &[Self], extent: [u32; 3]) -> [[f32; 2]; 3] {
        let (lowest, highest) = (S::splat(f32::INFINITY), S::splat(f32::NEG_INFINITY));
        let mut bounds = [[0.0; 2]; 3];
        for axis in 0..3 {
            let (mut low, mut high) = (lowest, highest);
            for starts in all {
                let [from, to] = [S::load(&starts.ends[0][axis]), S::load(&starts.ends[1][axis])];
                low = low.min(S::select(starts.meeting, from.min(to), lowest));
                high = high.max(S::select(starts.meeting, from.max(to), highest));
            }
            let margin = position_margin(extent[axis]) as f32;
            bounds[axis] = [low.reduce_min() - margin, high.reduce_max() + margin];
        }
        bounds
    }

    /// A ray that comes from far away, or is not finite, in the first lane.
    #[cold]
    pub(super) fn of_far_ray(space: &CellSpace, extent: [u32; 3], ray: &Ray) -> Self {
        let mut starts = Self::EMPTY;
        if let Some(grid_ray) = GridRay::new(space, ray, extent.map(|n| n as i32)) {
            let GridRay { origin, direction, t_base, t_slack } = grid_ray;
            let t_range = [f64::from(ray.t_min), f64::from(ray.t_max)];
            starts.prepare::<f64, false>(extent, origin, direction, t_range, [t_base, t_slack], 0);
        }
        starts
    }

    /// Prepares rays from lane `first` on that are near and finite, as most are; `numbers` are those of [`Ray`], in its order.
    #[inline(always)]
    fn prepare_near<R: Real, const ENDS: bool>(
        &mut self,
        space: &CellSpace,
        extent: [u32; 3],
        numbers: &[[f32; 16]; 8],
        first: usize,
    ) {
        // Convert to finest cells.
        let cells_per_unit = R::splat(space.cells_per_unit);
        let (mut origin, mut direction) = ([cells_per_unit; 3], [cells_per_unit; 3]);
        let mut near = (1 << R::LANES) - 1;
        for axis in 0..3 {
            let low = R::splat(f64::from(space.origin[axis]));
            origin[axis] = R::load(&numbers[axis][first..]).sub(low).mul(cells_per_unit);
            direction[axis] = R::load(&numbers[3 + axis][first..]).mul(cells_per_unit);
            near &=
                origin[axis].abs().le(R::splat(FARTHEST_ORIGIN)) & direction[axis].abs().lt(R::splat(f64::INFINITY));
        }

        let (zero, t_range) = (R::splat(0.0), [R::load(&numbers[6][first..]), R::load(&numbers[7][first..])]);
        self.prepare::<R, ENDS>(extent, origin, direction, t_range, [zero, zero], first);
        let far = (!near & ((1 << R::LANES) - 1)) << first;
        self.far |= far;
        self.meeting &= !far;
    }

    /// Prepares rays in finest cells, from lane `first` on, each with t at its origin and the rounding error of t.
    #[inline(always)]
    fn prepare<R: Real, const ENDS: bool>(
        &mut self,
        extent: [u32; 3],
        origin: Vector<R>,
        direction: Vector<R>,
        [t_min, t_max]: [R; 2],
        [t_base, t_slack]: [R; 2],
        first: usize,
    ) {
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
        self.meeting |= (t_enter.le(t_end) & R::splat(0.0).lt(s_per_t)) << first;

        // Let s count from the point where rays enter the grid.
        let (t_base, s_slack) = (t_base.add(t_enter), t_slack.mul(s_per_t));
        let (outward, least) = (R::splat(f64::from(f32::EPSILON)), R::splat(f64::from(f32::MIN_POSITIVE)));
        let s_start = t_min.sub(t_base).mul(s_per_t).sub(s_slack);
        let s_end = t_end.sub(t_enter).mul(s_per_t);
        s_start.sub(s_start.abs().mul(outward)).sub(least).store_rounded(&mut self.s_start[first..]);
        s_end.add(s_end.abs().mul(outward)).add(least).store_rounded(&mut self.s_end[first..]);
        t_base.store(&mut self.t_base[first..]);
        s_per_t.store(&mut self.s_per_t[first..]);
        s_slack.store(&mut self.s_slack[first..]);

        // Prepare the slabs of positions in the grid.
        for axis in 0..3 {
            let step = inverse[axis].mul(s_per_t).min(R::splat(STEEPEST)).max(R::splat(-STEEPEST));
            let at_entry = origin[axis].add(t_enter.mul(direction[axis]));
            if ENDS {
                at_entry.store_rounded(&mut self.ends[0][axis][first..]);
                origin[axis].add(t_end.mul(direction[axis])).store_rounded(&mut self.ends[1][axis][first..]);
            }
            let s_zero = at_entry.mul(step);
            let margin = step.abs().mul(R::splat(position_margin(extent[axis])));
            R::splat(0.0).sub(s_zero).sub(margin).store_rounded(&mut self.s_near[axis][first..]);
            margin.sub(s_zero).store_rounded(&mut self.s_far[axis][first..]);
            step.store_rounded(&mut self.s_step[axis][first..]);
        }
    }
}
