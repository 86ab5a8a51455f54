//! Single rays through the grid.
//!
//! After Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing" (1987), with steps as large as the
//! largest empty cube around the ray's point. Everything is computed in `f64` from the ray itself, never accumulated,
//! so that rounding stays far below the margin by which cells are enlarged.

use glam::DVec3;

use crate::{
    grid::{Grid, Structure, tree::overlap, uniform::resolution::CellSpace},
    intersect::{
        exact::ExactSum,
        filter::RayFilter,
        ray::{Hit, Ray},
        triangle,
    },
};

/// What rays walk through.
pub(crate) trait CellStructure {
    /// Finest cells per axis.
    fn dims(&self) -> [i32; 3];

    /// The list of triangles around a finest cell, if there is one, and the size (log₂ in finest cells) of the cube
    /// around the cell in which that holds.
    fn locate(&self, cell: [i32; 3]) -> (Option<TriangleList<'_>>, u32);
}

/// The triangles of a cell.
#[derive(Clone, Copy)]
pub(crate) struct TriangleList<'a> {
    /// By their places in the mesh.
    pub(crate) triangles: &'a [u32],
    /// Their boxes, or nothing in grids that have none.
    pub(crate) boxes: &'a [u8],
}

/// A cell with triangles that a ray passes.
struct CellVisit<'a> {
    list: TriangleList<'a>,
    /// The cell's lowest corner less the ray's origin, or less another point of the ray, in finest cells.
    corner_from_origin: [f64; 3],
    /// In finest cells.
    size: i32,
    /// The ray's t where it leaves the cell.
    next_crossing_t: f64,
}

/// The two parts of a ray's cost, which the paper's figure 3 shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RayCost {
    /// Cells that the ray passes, empty cubes that it skips whole counted once.
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
    /// The nearest triangle along a ray; of several at the same t the first in the file.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        let nearest = self.nearest(ray).0;
        if nearest.triangle == u32::MAX { Hit::MISS } else { Hit { triangle: nearest.triangle, t: nearest.t as f32 } }
    }

    /// What [`Grid::intersect`] costs a ray that is followed alone.
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
                let number = |point| self.mesh.file_index(point);
                if t < nearest.t || (t == nearest.t && number(triangle) < number(nearest.triangle)) {
                    nearest = Nearest { triangle, t };
                }
            });
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

    /// Calls `visit` with the place of each triangle in the cells along the whole ray, of the nearest cell first, and of
    /// some several times. Measurements try other ways to intersect rays with triangles on them.
    pub fn for_each_candidate(&self, ray: &Ray, mut visit: impl FnMut(u32)) {
        self.walk(ray, |cell| {
            cell.list.triangles.iter().copied().for_each(&mut visit);
            false
        });
    }

    /// Calls `visit` with each list of triangles along the ray, nearest first, until `visit` returns true. Returns how
    /// many cells and empty cubes the ray passed.
    #[inline(always)]
    fn walk(&self, ray: &Ray, visit: impl FnMut(CellVisit<'_>) -> bool) -> u32 {
        match &self.structure {
            Structure::Tree(tree) => walk(tree, &self.space, ray, visit),
            Structure::Plain(grid) => walk(grid, &self.space, ray, visit),
            Structure::RowDisplacement { grid, .. } => walk(grid, &self.space, ray, visit),
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

    let at = |t: f64, axis: usize| floor(origin[axis] + t * direction[axis]);
    let mut cell = [0, 1, 2].map(|axis| at(t_enter, axis).clamp(0, dims[axis] - 1));
    let mut n_cells = 0;
    loop {
        n_cells += 1;
        let (list, shift) = cells.locate(cell);
        // The cube around the cell that has the same content, and where the ray leaves it.
        let low = cell.map(|x| x >> shift << shift);
        let size = 1 << shift;
        let (mut next_crossing_t, mut step_axis) = (f64::INFINITY, 3);
        for axis in 0..3 {
            let plane = if direction[axis] > 0.0 { low[axis] + size } else { low[axis] };
            let t = (f64::from(plane) - origin[axis]) * inverse_direction[axis];
            if direction[axis] != 0.0 && t < next_crossing_t {
                (next_crossing_t, step_axis) = (t, axis);
            }
        }
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
        // The axis of exit always steps, and no axis steps back, so the walk ends whatever rounding does.
        for axis in 0..3 {
            let forward = direction[axis] > 0.0;
            if axis == step_axis {
                cell[axis] = if forward { low[axis] + size } else { low[axis] - 1 };
            } else if shift > 0 && direction[axis] != 0.0 {
                // Macrocells may reach beyond the grid, and so may the ray by the cells' margin.
                let last = (low[axis] + size).min(dims[axis]) - 1;
                let inside = at(next_crossing_t, axis).clamp(low[axis], last);
                cell[axis] = if forward { inside.max(cell[axis]) } else { inside.min(cell[axis]) };
            }
        }
        if !(0..dims[step_axis]).contains(&cell[step_axis]) {
            return n_cells;
        }
    }
}

/// Without the call that `f64::floor` is where SSE4.1 may be missing.
#[inline(always)]
fn floor(x: f64) -> i32 {
    let truncated = x as i32;
    truncated.saturating_sub(i32::from(f64::from(truncated) > x))
}

/// A ray in finest cells, from a point of it that is not far from the grid.
struct GridRay {
    origin: [f64; 3],
    direction: [f64; 3],
    /// The ray's t at that point.
    t_base: f64,
    /// What rounding can do to a t.
    t_slack: f64,
}

impl GridRay {
    /// `None` where a ray cannot be followed, or passes the grid by far.
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

    /// The same way from a point close to the grid.
    ///
    /// It goes to where the ray comes nearest, with a t of so few bits that the point can be told exactly; what remains
    /// to go, as t has few bits, is gone likewise.
    #[cold]
    fn rebased(mut self, space: &CellSpace, ray: &Ray, dims: [i32; 3]) -> Option<Self> {
        let direction = DVec3::from_array(self.direction);
        let centre = DVec3::from_array(dims.map(|n| f64::from(n) * 0.5));
        let mut point = DVec3::from_array(self.origin);
        let mut t_steps = Vec::new();
        for _ in 0..MOST_REBASES {
            let step = ((centre - point).dot(direction) / direction.length_squared()) as f32;
            if step == 0.0 || !step.is_finite() {
                return None;
            }
            t_steps.push(step);
            let from_low = [0, 1, 2].map(|axis| {
                let mut sum = ExactSum::default();
                t_steps.iter().for_each(|&step| sum.add_product(step, ray.direction[axis], 1.0));
                sum.add_product(ray.origin[axis], 1.0, 1.0);
                sum.add_product(-space.origin()[axis], 1.0, 1.0);
                sum.value()
            });
            point = space.direction_to_cells(DVec3::from_array(from_low));
            if point.abs().max_element() <= FARTHEST_ORIGIN {
                self.origin = point.to_array();
                self.t_base = t_steps.iter().map(|&step| f64::from(step)).sum();
                self.t_slack = self.t_base.abs() * 1e-9;
                return Some(self);
            }
        }
        None
    }
}

/// In finest cells: 2⁻⁵³ of this is well below the margin around cells.
const FARTHEST_ORIGIN: f64 = (1u64 << 34) as f64;

/// Each step comes nearer by 23 bits, and the range of `f32` has 277.
const MOST_REBASES: usize = 16;
