//! Traces single rays through the grid.
//!
//! A DDA after Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing" (1987), with steps as large as
//! the largest empty cube around the ray's cell. Crossings are computed in `f64` from the ray itself and never
//! accumulated, so rounding stays far below the margin by which cells are enlarged.

use glam::DVec3;

use crate::{
    grid::{
        Grid, Structure,
        cells::{CellSpace, CellStructure, TriangleList},
        tree::overlap,
    },
    intersect::{
        exact::ExactSum,
        filter::RayFilter,
        ray::{Hit, Ray},
        triangle,
    },
};

/// A cell with triangles that a ray passes.
struct CellVisit<'a> {
    list: TriangleList<'a>,
    /// The cell's lowest corner relative to the ray's origin, or to another point of the ray, in finest cells.
    corner_from_origin: [f64; 3],
    /// Side of the cell, in finest cells.
    size: i32,
    /// Lower bound of the ray's t where it leaves the cell.
    next_crossing_t: f64,
}

/// The cost of a ray in its two parts, which the paper's figure 3 shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RayCost {
    /// Cells that the ray passes; an empty cube that it skips whole counts once.
    pub n_cells: u32,
    /// Triangles that it is tested against.
    pub n_tests: u32,
}

/// The nearest hit so far, with its t still in `f64`.
#[derive(Clone, Copy)]
struct Nearest {
    triangle: u32,
    t: f64,
}

impl Grid {
    /// The nearest hit of a ray; of several at the same t that of the first triangle in the file.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        let nearest = self.nearest(ray).0;
        if nearest.triangle == u32::MAX { Hit::MISS } else { Hit { triangle: nearest.triangle, t: nearest.t as f32 } }
    }

    /// The cost of [`Grid::intersect`] for this ray.
    pub fn cost(&self, ray: &Ray) -> RayCost {
        self.nearest(ray).1
    }

    fn nearest(&self, ray: &Ray) -> (Nearest, RayCost) {
        let mut nearest = Nearest { triangle: u32::MAX, t: f64::INFINITY };
        let filter = RayFilter::new(self.instructions, &self.mesh, ray);
        let mut n_tests = 0;
        let n_cells = self.walk(ray, |visit| {
            filter.for_each(&visit.list, visit.corner_from_origin, visit.size, |triangle| {
                n_tests += 1;
                let Some(t) = triangle::intersect(ray, &self.mesh.corners(triangle)) else { return };
                let file_index = |index| self.mesh.file_index(index);
                if t < nearest.t || (t == nearest.t && file_index(triangle) < file_index(nearest.triangle)) {
                    nearest = Nearest { triangle, t };
                }
            });
            // No later cell has a nearer hit.
            nearest.t <= visit.next_crossing_t
        });
        (nearest, RayCost { n_cells, n_tests })
    }

    /// Whether a ray hits any triangle.
    pub fn occluded(&self, ray: &Ray) -> bool {
        let mut occluded = false;
        let filter = RayFilter::new(self.instructions, &self.mesh, ray);
        self.walk(ray, |visit| {
            filter.for_each(&visit.list, visit.corner_from_origin, visit.size, |triangle| {
                occluded = occluded || triangle::intersect(ray, &self.mesh.corners(triangle)).is_some();
            });
            occluded
        });
        occluded
    }

    /// Calls `visit` with each triangle in the cells along a ray, some several times, for tests by other routines.
    pub fn for_each_candidate(&self, ray: &Ray, mut visit: impl FnMut(u32)) {
        self.walk(ray, |cell| {
            cell.list.triangles.iter().copied().for_each(&mut visit);
            false
        });
    }

    /// Calls `visit` with each cell that has triangles along the ray, nearest first, until `visit` returns true.
    /// Returns the number of cells and empty cubes that the ray passed.
    #[inline(always)]
    fn walk(&self, ray: &Ray, visit: impl FnMut(CellVisit<'_>) -> bool) -> u32 {
        match &self.structure {
            Structure::Tree(tree) => walk(tree, &self.space, ray, visit),
            Structure::Plain(grid) => walk(grid, &self.space, ray, visit),
            Structure::RowDisplacement(grid) => walk(grid, &self.space, ray, visit),
        }
    }
}

/// [`Grid::walk`] for one kind of cells.
#[inline(always)]
fn walk<C: CellStructure>(
    cells: &C,
    space: &CellSpace,
    ray: &Ray,
    mut visit: impl FnMut(CellVisit<'_>) -> bool,
) -> u32 {
    let dims = cells.dims();
    let Some(GridRay { origin, direction, t_base, t_slack }) = GridRay::new(space, ray, dims) else { return 0 };
    let inverse_direction = direction.map(|d| 1.0 / d);

    // Clip the ray's interval to the grid's bounds, enlarged as its cells are.
    let (mut t_enter, mut t_end) = (f64::from(ray.t_min) - t_base - t_slack, f64::from(ray.t_max) - t_base + t_slack);
    for axis in 0..3 {
        let (low, high) = (-overlap::DILATION - origin[axis], f64::from(dims[axis]) + overlap::DILATION - origin[axis]);
        if direction[axis] == 0.0 {
            if low > 0.0 || high < 0.0 {
                return 0;
            }
        } else {
            let (a, b) = (low * inverse_direction[axis], high * inverse_direction[axis]);
            t_enter = t_enter.max(a.min(b));
            t_end = t_end.min(a.max(b));
        }
    }
    if t_enter > t_end {
        return 0;
    }

    // Set up the DDA: the cell in which the ray enters the grid.
    let step = |axis: usize| if direction[axis] > 0.0 { 1 } else { -1 };
    let at = |t: f64, axis: usize| floor(origin[axis] + t * direction[axis]);
    let mut cell = [0, 1, 2].map(|axis| at(t_enter, axis).clamp(0, dims[axis] - 1));
    let mut n_cells = 0;
    loop {
        // Locate the cell: its list, and the cube around it with the same content.
        n_cells += 1;
        let (list, shift) = cells.locate(cell);
        let low = cell.map(|x| x >> shift << shift);
        let size = 1 << shift;

        // Find the axis along which the ray leaves the cube first.
        let (mut next_crossing_t, mut step_axis) = (f64::INFINITY, 3);
        for axis in 0..3 {
            let plane = if step(axis) > 0 { low[axis] + size } else { low[axis] };
            let crossing_t = (f64::from(plane) - origin[axis]) * inverse_direction[axis];
            if direction[axis] != 0.0 && crossing_t < next_crossing_t {
                (next_crossing_t, step_axis) = (crossing_t, axis);
            }
        }

        // Visit the cell, and end where the visitor or the interval does.
        if let Some(list) = list {
            let corner_from_origin = [0, 1, 2].map(|axis| f64::from(low[axis]) - origin[axis]);
            if visit(CellVisit { list, corner_from_origin, size, next_crossing_t: next_crossing_t + t_base - t_slack })
            {
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

/// `f64::floor` is a function call where SSE4.1 may be missing; this is not.
#[inline(always)]
fn floor(x: f64) -> i32 {
    let truncated = x as i32;
    truncated.saturating_sub(i32::from(f64::from(truncated) > x))
}

/// A ray in finest cells, whose origin is moved along the ray if it is far from the grid.
struct GridRay {
    origin: [f64; 3],
    direction: [f64; 3],
    /// The ray's t at the moved origin.
    t_base: f64,
    /// Rounding error of t.
    t_slack: f64,
}

impl GridRay {
    /// `None` for rays that are not finite, and for some that pass far from the grid.
    #[inline]
    fn new(space: &CellSpace, ray: &Ray, dims: [i32; 3]) -> Option<Self> {
        let origin = space.point_to_cells(ray.origin.as_dvec3());
        let direction = space.direction_to_cells(ray.direction.as_dvec3());
        if !origin.is_finite() || !direction.is_finite() || direction == DVec3::ZERO {
            return None;
        }
        let grid_ray = Self { origin: origin.to_array(), direction: direction.to_array(), t_base: 0.0, t_slack: 0.0 };
        if origin.abs().max_element() <= FARTHEST_ORIGIN { Some(grid_ray) } else { grid_ray.rebased(space, ray, dims) }
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
const FARTHEST_ORIGIN: f64 = (1u64 << 34) as f64;

/// Each step reduces the distance by 23 bits, and the range of `f32` has 277.
const MOST_REBASES: usize = 16;
