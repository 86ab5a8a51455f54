//! Traces single rays through the paper's uniform grid.
//!
//! A DDA after Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing" (1987), with steps as large as
//! the largest empty cube around the ray's cell. Crossings are computed in `f64` from the ray itself and never
//! accumulated, so rounding stays far below the margin by which cells are enlarged.

use crate::{
    grid::{
        Grid,
        cells::{CellSpace, CellStructure},
    },
    intersect::{
        filter,
        grid_ray::{GridRay, floor},
        ray::Ray,
        rays::{Nearest, RayCost},
        triangle,
    },
};

/// A cell with triangles that a ray passes.
pub(super) struct CellVisit<'a> {
    pub(super) triangles: &'a [u32],
    /// Lower bound of the ray's t where it leaves the cell.
    next_crossing_t: f64,
}

/// The nearest hit of a ray, or with `ANY` one of those in the first cell with a hit.
pub(super) fn trace<const ANY: bool>(grid: &Grid, cells: &impl CellStructure, ray: &Ray) -> Nearest {
    let mut nearest = Nearest::default();
    let mut n_tests = 0;
    let n_cells = walk(cells, &grid.space, ray, |visit| {
        for triangles in visit.triangles.chunks(filter::BATCH) {
            // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
            let mut left = unsafe { filter::may_hit(grid.instructions, &grid.mesh, ray, triangles) };
            while left != 0 {
                let triangle = triangles[left.trailing_zeros() as usize];
                left &= left - 1;
                n_tests += 1;
                if let Some(t) = triangle::intersect(ray, &grid.mesh.corners(triangle)) {
                    nearest.offer(&grid.mesh, ray, triangle, t);
                }
            }
        }
        // No later cell has a nearer hit.
        nearest.t <= visit.next_crossing_t || (ANY && nearest.is_hit())
    });
    Nearest { cost: RayCost { n_cells, n_tests }, ..nearest }
}

/// Calls `visit` with each cell that has triangles along a ray, nearest first, until `visit` returns true. Returns the
/// number of cells and empty cubes that the ray passed.
#[inline(always)]
pub(super) fn walk<C: CellStructure>(
    cells: &C,
    space: &CellSpace,
    ray: &Ray,
    mut visit: impl FnMut(CellVisit<'_>) -> bool,
) -> u32 {
    let dims = cells.dims();
    let Some(grid_ray) = GridRay::new(space, ray, dims) else { return 0 };
    let inverse = grid_ray.direction.map(|d| 1.0 / d);
    let Some([t_enter, t_end]) = grid_ray.clip(ray, &inverse, dims) else { return 0 };
    let GridRay { origin, direction, t_base, t_slack } = grid_ray;

    // Set up the DDA: the cell in which the ray enters the grid.
    let step = |axis: usize| if direction[axis] > 0.0 { 1 } else { -1 };
    let at = |t: f64, axis: usize| floor(origin[axis] + t * direction[axis]);
    let mut cell = [0, 1, 2].map(|axis| at(t_enter, axis).clamp(0, dims[axis] - 1));
    let mut n_cells = 0;
    loop {
        // Locate the cell: its list, and the cube around it with the same content.
        n_cells += 1;
        let (triangles, shift) = cells.locate(cell);
        let low = cell.map(|x| x >> shift << shift);
        let size = 1 << shift;

        // Find the axis along which the ray leaves the cube first.
        let (mut next_crossing_t, mut step_axis) = (f64::INFINITY, 3);
        for axis in 0..3 {
            let plane = if step(axis) > 0 { low[axis] + size } else { low[axis] };
            let crossing_t = (f64::from(plane) - origin[axis]) * inverse[axis];
            if direction[axis] != 0.0 && crossing_t < next_crossing_t {
                (next_crossing_t, step_axis) = (crossing_t, axis);
            }
        }

        // Visit the cell, and end where the visitor or the interval does.
        if let Some(triangles) = triangles {
            let next_crossing_t = next_crossing_t + t_base - t_slack;
            if visit(CellVisit { triangles, next_crossing_t }) {
                return n_cells;
            }
        }
        if step_axis == 3 || next_crossing_t > t_end {
            return n_cells;
        }

        // Step into the next cell. The exit axis advances and none goes back, so the walk ends despite rounding.
        for axis in 0..3 {
            if axis == step_axis {
                cell[axis] = if step(axis) > 0 { low[axis] + size } else { low[axis] - 1 };
            } else if shift > 0 && direction[axis] != 0.0 {
                // Recompute the position along the other axes of a large cube, clamped to the cube and to the grid.
                let last = (low[axis] + size).min(dims[axis]) - 1;
                let inside = at(next_crossing_t, axis).clamp(low[axis], last);
                cell[axis] = if step(axis) > 0 { inside.max(cell[axis]) } else { inside.min(cell[axis]) };
            }
        }
        if !(0..dims[step_axis]).contains(&cell[step_axis]) {
            return n_cells;
        }
    }
}
