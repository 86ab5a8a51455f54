//! The way of one ray down the hierarchy of boxes over a tree's leaves: a ray is compared with all boxes of a node at once, then
//! with those of a leaf.
//!
//! Positions are single-precision, in finest cells of the grid. All comparisons have a margin for rounding;
//! [`super::triangle`] decides in `f64`.

use crate::{
    grid::{
        cells::CellSpace,
        tree::{
            Tree,
            boxes::{self, GroupBytes},
            hierarchy::{self, CHILDREN, Entry, Hierarchy, LEAF, SLOT_BITS},
        },
    },
    intersect::{grid_ray::GridRay, ray::Ray},
    simd::Simd,
};

/// Rounding errors of positions and distances in a grid, relative to its extent: eight roundings of `f32`.
const RELATIVE_MARGIN: f64 = 8.0 / (1 << 24) as f64;

/// Rounding errors that do not depend on the extent, in finest cells.
const MARGIN: f64 = 1.0 / 1024.0;

/// The largest inverse component of a direction whose largest component is 1: over a grid, smaller components move a ray by
/// less than [`MARGIN`].
const STEEPEST: f64 = 1e12;

/// Entries of a stack: all but one child of each node on the way, and room for a vector of one more.
const STACK: usize = N_STACK + CHILDREN;

/// Most entries below those of the last node. A power of two.
const N_STACK: usize = ((CHILDREN - 1) * hierarchy::LEVELS + 1).next_power_of_two();

/// The next step of a descent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// [`Descent::enter_node`].
    Node,
    /// The triangles of [`Descent::leaf`], then [`Descent::next`].
    Leaf,
    /// None: the ray ends.
    End,
}

/// A ray on its way down a hierarchy, step by step, to its leaves, roughly from the nearest to the farthest.
///
/// Its parameter s counts finest cells along the major axis, from the point where it enters the grid.
pub(super) struct Descent {
    slabs: Slabs,
    /// The ray's interval.
    s_range: [f32; 2],
    /// The bits of a slot's number for axes along which the ray goes up.
    ahead: u32,
    /// Nodes and leaves on the way so far.
    pub(super) n_cells: u32,
    /// The present node or leaf.
    entry: Entry,
    n_stack: u32,
    /// Where the ray enters each entry of the stack, and the entry: the next is the last.
    stack_s: [f32; STACK],
    stack: [Entry; STACK],
    /// t where s is 0, units of s in one of t, and the rounding error of s.
    t_base: f64,
    s_per_t: f64,
    s_slack: f64,
}

impl Default for Descent {
    fn default() -> Self {
        Self {
            slabs: Slabs::default(),
            s_range: [0.0; 2],
            ahead: 0,
            n_cells: 0,
            entry: hierarchy::NONE,
            n_stack: 0,
            stack_s: [0.0; STACK],
            stack: [hierarchy::NONE; STACK],
            t_base: 0.0,
            s_per_t: 0.0,
            s_slack: 0.0,
        }
    }
}

impl Descent {
    /// Begins with a ray, in place of any other.
    #[inline(always)]
    pub(super) fn begin(&mut self, space: &CellSpace, tree: &Tree, ray: &Ray) -> Step {
        self.n_cells = 0;
        let extent = tree.extent.map(|n| n as i32);
        let Some(grid_ray) = GridRay::new(space, ray, extent) else { return Step::End };
        let inverse = grid_ray.direction.map(|d| 1.0 / d);
        let Some([t_enter, t_end]) = grid_ray.clip(ray, &inverse, extent) else { return Step::End };

        // Let s count from the point where the ray enters the grid.
        let GridRay { origin, direction, t_base, t_slack } = grid_ray;
        let [dx, dy, dz] = direction;
        self.s_per_t = dx.abs().max(dy.abs()).max(dz.abs());
        self.t_base = t_base + t_enter;
        self.s_slack = t_slack * self.s_per_t;
        let s_start = ((f64::from(ray.t_min) - self.t_base) * self.s_per_t - self.s_slack) as f32;
        self.s_range = [down(s_start), up(((t_end - t_enter) * self.s_per_t) as f32)];

        // Prepare the slabs of positions in the grid.
        self.ahead = 0;
        for axis in 0..3 {
            let inverse = inverse[axis] * self.s_per_t;
            let inverse = if inverse.abs() <= STEEPEST { inverse } else { STEEPEST };
            self.ahead |= if inverse < 0.0 { 0 } else { SLOT_BITS[axis] };
            let s_zero = -(origin[axis] + t_enter * direction[axis]) * inverse;
            let s_margin = (f64::from(extent[axis]) * RELATIVE_MARGIN + MARGIN) * inverse.abs();
            self.slabs.step[axis] = inverse as f32;
            self.slabs.near[axis] = (s_zero - s_margin) as f32;
            self.slabs.far[axis] = (s_zero + s_margin) as f32;
        }

        // The stack's last entry ends the ray, however far it goes.
        self.stack[0] = hierarchy::NONE;
        self.stack_s[0] = f32::NEG_INFINITY;
        self.n_stack = 1;
        self.enter(tree.hierarchy.root)
    }

    #[inline(always)]
    fn enter(&mut self, entry: Entry) -> Step {
        self.entry = entry;
        self.n_cells += 1;
        // Computed without a branch: nobody can tell what comes next.
        match (entry & LEAF != 0, entry == hierarchy::NONE) {
            (false, _) => Step::Node,
            (true, false) => Step::Leaf,
            (true, true) => Step::End,
        }
    }

    /// Puts those children of the present node on the stack that the ray passes.
    #[inline(always)]
    pub(super) fn enter_node<S: Simd>(&mut self, hierarchy: &Hierarchy) {
        let node = &hierarchy.nodes[self.entry as usize];
        // The child that is farthest along the ray comes first: it is in slot `flip`.
        let flip = self.ahead;
        let within = S::LANES as u32 - 1;
        let sides = self.sides();
        let mut n_stack = self.n_stack as usize % N_STACK;
        let mut first = 0;
        while first < CHILDREN {
            let slots = first ^ (flip & !within) as usize;
            let mut rows = [S::splat(0.0); 6];
            for row in 0..6 {
                rows[row] = S::load(&node.sides[sides[row]][slots..]);
            }
            let (s_near, s_far) = self.slabs.range::<S>(rows, self.s_range);
            let (s_near, s_far) = (s_near.reflect(flip & within), s_far.reflect(flip & within));
            let passed = s_near.le(s_far);
            let children = S::load_bits(&node.children[slots..]).reflect(flip & within);
            s_near.compress_to(passed, &mut self.stack_s[n_stack..]);
            n_stack += children.compress_bits_to(passed, &mut self.stack[n_stack..]);
            first += S::LANES;
        }
        self.n_stack = n_stack as u32;
    }

    /// Takes the next entry from the stack; nothing beyond `t_end` matters any more.
    #[inline(always)]
    pub(super) fn next(&mut self) -> Step {
        let mut last = self.n_stack as usize - 1;
        while self.stack_s[last % STACK] > self.s_range[1] {
            last -= 1;
        }
        self.n_stack = last as u32;
        self.enter(self.stack[last % STACK])
    }

    /// Shortens the ray to `t_end`.
    #[inline(always)]
    pub(super) fn shorten(&mut self, t_end: f64) {
        let s_end = up(((t_end - self.t_base) * self.s_per_t + self.s_slack) as f32);
        self.s_range[1] = if s_end < self.s_range[1] { s_end } else { self.s_range[1] };
    }

    /// The leaf at [`Step::Leaf`].
    #[inline(always)]
    pub(super) fn leaf(&self) -> u32 {
        self.entry & !LEAF
    }

    /// The map from the sides of the present leaf's boxes to s.
    #[inline(always)]
    pub(super) fn leaf_slabs(&self, tree: &Tree) -> Slabs {
        let cube = tree.leaf_cubes[self.leaf() as usize];
        let (corner, size) = (cube.corner(), cube.size() as f32);
        let step = size * (1.0 / boxes::N_STEPS as f32);
        let mut slabs = Slabs::default();
        for axis in 0..4 {
            let s_low = (corner[axis] as f32 - boxes::FIRST_STEP as f32 * step) * self.slabs.step[axis];
            slabs.near[axis] = s_low + self.slabs.near[axis];
            slabs.far[axis] = s_low + self.slabs.far[axis];
            slabs.step[axis] = step * self.slabs.step[axis];
        }
        slabs
    }

    /// A bit for each box of a group in the present leaf that the ray passes.
    #[inline(always)]
    pub(super) fn passed_boxes<S: Simd>(&self, slabs: &Slabs, boxes: GroupBytes<'_>, first: usize) -> u32 {
        let (s_near, s_far) = slabs.range::<S>(boxes.sides(self.sides(), first), self.s_range);
        s_near.le(s_far) & boxes.mask() >> first
    }

    /// The near and far side along each axis: twice the axis, and one more for the greatest side.
    #[inline(always)]
    fn sides(&self) -> [usize; 6] {
        let ahead = self.ahead as usize;
        let [x, y, z] = [ahead >> 1 & 1, ahead >> 2 & 1, ahead >> 3 & 1];
        [1 - x, x, 3 - y, 2 + y, 5 - z, 4 + z]
    }
}

/// A map from positions, or sides of boxes, to s. It is linear. Arrays have a fourth lane to fill vectors.
#[derive(Clone, Copy, Default)]
pub(super) struct Slabs {
    /// s where the position is 0, with a margin to either side.
    near: [f32; 4],
    far: [f32; 4],
    /// s over a unit of the position.
    step: [f32; 4],
}

impl Slabs {
    /// Where rays enter and leave boxes, one a lane, within `s_range`.
    #[inline(always)]
    fn range<S: Simd>(&self, rows: [S; 6], s_range: [f32; 2]) -> (S, S) {
        let (mut s_near, mut s_far) = (S::splat(s_range[0]), S::splat(s_range[1]));
        for axis in 0..3 {
            let step = S::splat(self.step[axis]);
            s_near = s_near.max(rows[2 * axis].mul_add(step, S::splat(self.near[axis])));
            s_far = s_far.min(rows[2 * axis + 1].mul_add(step, S::splat(self.far[axis])));
        }
        (s_near, s_far)
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
