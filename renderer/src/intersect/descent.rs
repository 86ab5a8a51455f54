//! The way of one ray through a tree: bricks by a DDA, the nodes of a brick by comparing the ray with all 64 children at once,
//! the boxes of a leaf by comparing it with 16 at once.
//!
//! Positions in a brick are single-precision, relative to the brick's corner. All comparisons have [`MARGIN`] to spare;
//! [`super::triangle`] decides in `f64`.

use crate::{
    grid::{
        cells::CellSpace,
        tree::{
            BRICK_SIZE, LEVELS, Tree,
            boxes::{self, GroupBytes},
        },
    },
    intersect::{
        bricks::{BrickWalk, lesser},
        ray::Ray,
    },
    simd::Simd,
};

/// Rounding errors of positions in a brick, in finest cells: a few units in the last place of 1024, and some to spare.
const MARGIN: f32 = 1.0 / 1024.0;

/// The largest inverse component of a direction whose largest component is 1: over a brick, smaller components move a ray by
/// less than [`MARGIN`].
const STEEPEST: f32 = 1e12;

/// A ray in one brick. Its parameter s counts finest cells along the major axis. Arrays have a fourth lane, so that they
/// fill vectors.
#[derive(Clone, Copy, Default)]
struct LocalRay {
    /// Point at s = 0, relative to the brick's lowest corner, in finest cells.
    origin: [f32; 4],
    /// s over a finest cell along each axis.
    inverse: [f32; 4],
    /// s over [`MARGIN`] along each axis.
    margin: [f32; 4],
    /// Bits of a child's index that run against the ray.
    flip: u32,
}

/// A node whose children are visited.
#[derive(Clone, Copy, Default)]
struct Visit {
    node: u32,
    /// Side of a child is 2 to the power of this, in finest cells.
    shift: u32,
    /// Children that are left, in the order of the ray.
    left: u64,
    /// The end of the ray when `left` was found.
    s_end: f32,
    /// Lowest corner in the brick, in finest cells.
    corner: [u32; 4],
}

/// The next step of a descent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// [`Descent::enter_brick`].
    Brick,
    /// [`Descent::enter_node`].
    Node,
    /// [`Descent::next_child`].
    Child,
    /// The triangles of [`Descent::leaf`], then [`Descent::leave_leaf`].
    Leaf,
    /// None: the ray ends.
    End,
}

/// A ray on its way through a tree, step by step, to its leaves from the nearest to the farthest.
///
/// Steps are short and take the same way through the code for most rays, so that a processor overlaps those of several.
#[derive(Default)]
pub(super) struct Descent {
    walk: BrickWalk,
    local: LocalRay,
    /// The ray's interval in the present brick.
    pub(super) s_range: [f32; 2],
    /// Open nodes, all with children left, and room for one more.
    visits: [Visit; LEVELS as usize + 1],
    n_visits: usize,
    /// The leaf at [`Step::Leaf`], with its lowest corner and side in the brick, in finest cells.
    pub(super) leaf: u32,
    leaf_corner: [u32; 4],
    leaf_size: u32,
    /// Bricks and occupied cells on the way so far.
    pub(super) n_cells: u32,
}

impl Descent {
    /// Begins with a ray, in place of any other.
    #[inline(always)]
    pub(super) fn begin(&mut self, space: &CellSpace, tree: &Tree, ray: &Ray) -> Step {
        (self.n_cells, self.n_visits) = (0, 0);
        if !self.walk.begin(space, tree, ray) {
            return Step::End;
        }
        let Self { walk, local, .. } = self;
        local.flip = 0;
        for axis in 0..4 {
            let inverse = walk.inverse_direction[axis] as f32;
            local.inverse[axis] = if inverse.abs() <= STEEPEST { inverse } else { STEEPEST };
            local.margin[axis] = MARGIN * local.inverse[axis].abs();
        }
        for axis in 0..3 {
            local.flip |= if local.inverse[axis] < 0.0 { 3 << (2 * axis) } else { 0 };
        }
        Step::Brick
    }

    /// Enters the present brick, if it holds triangles; nothing beyond `t_end` matters.
    #[inline(always)]
    pub(super) fn enter_brick(&mut self, tree: &Tree, t_end: f64) -> Step {
        self.n_cells += 1;
        let brick = self.walk.brick(tree);
        if brick == Tree::EMPTY {
            return self.leave_brick(t_end);
        }
        (self.local.origin, self.s_range) = self.walk.in_brick(t_end);
        if brick & Tree::LEAF != 0 {
            (self.leaf, self.leaf_corner, self.leaf_size) = (brick & !Tree::LEAF, [0; 4], BRICK_SIZE);
            return Step::Leaf;
        }
        self.visits[0] = Visit { node: brick, shift: 2 * LEVELS - 2, left: u64::MAX, s_end: 0.0, corner: [0; 4] };
        self.n_visits = 1;
        Step::Node
    }

    fn leave_brick(&mut self, t_end: f64) -> Step {
        if self.walk.step(t_end) { Step::Brick } else { Step::End }
    }

    /// Keeps those children of the last node that the ray passes.
    #[inline(always)]
    pub(super) fn enter_node<S: Simd>(&mut self, tree: &Tree) -> Step {
        let visit = &mut self.visits[self.n_visits - 1];
        let passed = self.local.passed_children::<S>(visit.corner, visit.shift, self.s_range);
        let occupied = tree.nodes[visit.node as usize].occupied;
        visit.left &= reflect(passed & occupied, self.local.flip);
        visit.s_end = self.s_range[1];
        self.n_visits -= usize::from(visit.left == 0);
        Step::Child
    }

    /// Takes the next child along the ray, or goes to the next brick if none is left.
    #[inline(always)]
    pub(super) fn next_child(&mut self, tree: &Tree, t_end: f64) -> Step {
        if self.n_visits == 0 {
            return self.leave_brick(t_end);
        }
        let visit = &mut self.visits[self.n_visits - 1];
        // A hit has shortened the ray since: fewer children are left.
        if self.s_range[1] < visit.s_end {
            return Step::Node;
        }
        self.n_cells += 1;
        let child = visit.left.trailing_zeros() ^ self.local.flip;
        visit.left &= visit.left - 1;
        let node = &tree.nodes[visit.node as usize];
        let Visit { shift, mut corner, .. } = *visit;
        for axis in 0..3 {
            corner[axis] += (child >> (2 * axis) & 3) << shift;
        }
        self.n_visits -= usize::from(visit.left == 0);

        // A child's index counts the bits before its own.
        let before = (1_u64 << child) - 1;
        let below = node.first_node + (node.divided & before).count_ones();
        self.leaf = node.first_leaf + (node.occupied & !node.divided & before).count_ones();
        (self.leaf_corner, self.leaf_size) = (corner, 1 << shift);
        // Written without a branch: nobody can tell which children are divided.
        let is_divided = node.divided >> child & 1 == 1;
        self.visits[self.n_visits] =
            Visit { node: below, shift: shift.wrapping_sub(2), left: u64::MAX, s_end: 0.0, corner };
        self.n_visits += usize::from(is_divided);
        if is_divided { Step::Node } else { Step::Leaf }
    }

    /// Goes on behind a leaf; nothing beyond `t_end` matters any more.
    #[inline(always)]
    pub(super) fn leave_leaf(&mut self, t_end: f64) -> Step {
        self.s_range[1] = self.s_range[1].min(self.walk.s_in_brick(t_end));
        Step::Child
    }

    /// The map from quantised sides of the boxes in [`Descent::leaf`] to s.
    #[inline(always)]
    pub(super) fn leaf_slabs(&self) -> LeafSlabs {
        self.local.leaf_slabs(self.leaf_corner, self.leaf_size)
    }
}

impl LocalRay {
    /// A bit for each child of a node that the ray passes within `s_range`.
    #[inline(always)]
    fn passed_children<S: Simd>(&self, corner: [u32; 4], shift: u32, s_range: [f32; 2]) -> u64 {
        const COLUMNS: [[f32; 16]; 2] = [
            [0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0],
            [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0],
        ];
        // Find s at the near and far side of the first child along each axis, and the step to the next.
        let (mut near, mut far, mut step) = ([0.0; 4], [0.0; 4], [0.0; 4]);
        let size = (1 << shift) as f32;
        for axis in 0..4 {
            step[axis] = size * self.inverse[axis];
            let low = (corner[axis] as i32 as f32 - self.origin[axis]) * self.inverse[axis];
            near[axis] = low + lesser(step[axis], 0.0) - self.margin[axis];
            far[axis] = low - lesser(-step[axis], 0.0) + self.margin[axis];
        }

        // Intersect the slabs of 16 columns of children along z, then of each layer.
        let [x_step, y_step] = [S::splat(step[0]), S::splat(step[1])];
        let mut passed = 0;
        let mut first = 0;
        while first < 16 {
            let [x, y] = [S::load(&COLUMNS[0][first..]), S::load(&COLUMNS[1][first..])];
            let s_near = x.mul_add(x_step, S::splat(near[0])).max(y.mul_add(y_step, S::splat(near[1])));
            let s_far = x.mul_add(x_step, S::splat(far[0])).min(y.mul_add(y_step, S::splat(far[1])));
            let (s_near, s_far) = (s_near.max(S::splat(s_range[0])), s_far.min(S::splat(s_range[1])));
            for layer in 0..4 {
                let z = layer as f32 * step[2];
                let in_layer = s_near.max(S::splat(near[2] + z)).le(s_far.min(S::splat(far[2] + z)));
                passed |= u64::from(in_layer) << (16 * layer + first);
            }
            first += S::LANES;
        }
        passed
    }

    /// The map from quantised sides of a leaf's boxes to s.
    #[inline(always)]
    fn leaf_slabs(&self, corner: [u32; 4], size: u32) -> LeafSlabs {
        let step = size as f32 * (1.0 / boxes::N_STEPS as f32);
        let mut slabs = LeafSlabs { near: [0.0; 4], far: [0.0; 4], step: [0.0; 4], flip: self.flip };
        for axis in 0..4 {
            let low = corner[axis] as i32 as f32 - boxes::FIRST_STEP as f32 * step - self.origin[axis];
            let s = low * self.inverse[axis];
            slabs.near[axis] = s - self.margin[axis];
            slabs.far[axis] = s + self.margin[axis];
            slabs.step[axis] = step * self.inverse[axis];
        }
        slabs
    }
}

/// The sides of boxes along a ray: s is linear in the quantised value.
#[derive(Clone, Copy, Default)]
pub(super) struct LeafSlabs {
    near: [f32; 4],
    far: [f32; 4],
    step: [f32; 4],
    flip: u32,
}

impl LeafSlabs {
    /// A bit for each box of a group from number `first` on that the ray passes within `s_range`.
    #[inline(always)]
    pub(super) fn passed<S: Simd>(&self, boxes: GroupBytes<'_>, first: usize, s_range: [f32; 2]) -> u32 {
        let (mut s_near, mut s_far) = (S::splat(s_range[0]), S::splat(s_range[1]));
        for axis in 0..3 {
            let is_backward = (self.flip >> (2 * axis) & 1) as usize;
            let step = S::splat(self.step[axis]);
            let near = boxes.side::<S>(2 * axis + is_backward, first);
            let far = boxes.side::<S>(2 * axis + 1 - is_backward, first);
            s_near = s_near.max(near.mul_add(step, S::splat(self.near[axis])));
            s_far = s_far.min(far.mul_add(step, S::splat(self.far[axis])));
        }
        s_near.le(s_far) & boxes.mask() >> first
    }
}

/// Moves the bit of each child to the child's index with the bits of `flip` inverted.
#[inline(always)]
fn reflect(mut children: u64, flip: u32) -> u64 {
    // Selected without branches: nobody can tell where rays go.
    const SWAPS: [(u32, u64, u32); 6] = [
        (0, 0x5555_5555_5555_5555, 1),
        (0, 0x3333_3333_3333_3333, 2),
        (2, 0x0f0f_0f0f_0f0f_0f0f, 4),
        (2, 0x00ff_00ff_00ff_00ff, 8),
        (4, 0x0000_ffff_0000_ffff, 16),
        (4, 0x0000_0000_ffff_ffff, 32),
    ];
    for (bit, mask, distance) in SWAPS {
        let swapped = children >> distance & mask | (children & mask) << distance;
        let keep = u64::from(flip >> bit & 1).wrapping_sub(1);
        children = (children & keep) | (swapped & !keep);
    }
    children
}
