//! The way of one ray down a hierarchy of boxes: a ray is compared with all boxes of a node at once.
//!
//! Positions are single-precision, in finest cells of the grid. All comparisons have a margin for rounding;
//! [`super::triangle`] decides in `f64`.

use crate::{
    grid::tree::{
        boxes::{self, GroupBatch, GroupBoxes, LeafCube},
        hierarchy::{self, CHILDREN, Entry, HierarchyNode, SLOT_BITS},
    },
    intersect::starts::RayStarts,
    simd::Simd,
};

/// Most entries of a stack: all but one child of each node on the way, one at the end, and the other child of the last node.
/// Entry points are no more than the children of the root, in whose place they are.
/// Indices are taken modulo this power of two, which spares checks.
const N_STACK: usize = ((CHILDREN - 1) * hierarchy::LEVELS + 2).next_power_of_two();

/// Room to write a whole vector behind any entry.
const STACK: usize = N_STACK + CHILDREN;

/// A ray on its way down a hierarchy, step by step, to its leaves, roughly from the nearest to the farthest, or back if any
/// hit counts.
///
/// [`RayStarts`] says what its parameter s is.
pub(super) struct Descent {
    slabs: Slabs,
    /// The ray's interval.
    s_range: [f32; 2],
    /// The bits of a slot's number for axes along which the ray goes up.
    ahead: u32,
    /// Nodes and leaves on the way so far.
    pub(super) n_cells: u32,
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
    /// Begins with the ray of a lane, in place of any other. With `ANY`, it is not shortened.
    #[inline(always)]
    pub(super) fn begin<const ANY: bool>(&mut self, starts: &RayStarts, lane: usize) {
        self.n_cells = 0;
        self.ahead = 0;
        for axis in 0..3 {
            let step = starts.s_step[axis][lane];
            self.ahead |= if step < 0.0 { 0 } else { SLOT_BITS[axis] };
            self.slabs.step[axis] = step;
            self.slabs.near[axis] = starts.s_near[axis][lane];
            self.slabs.far[axis] = starts.s_far[axis][lane];
        }
        self.s_range = [starts.s_start[lane], starts.s_end[lane]];
        if !ANY {
            (self.t_base, self.s_per_t) = (starts.t_base[lane], starts.s_per_t[lane]);
            self.s_slack = starts.s_slack[lane];
        }

        // The stack's last entry ends the ray, however far it goes.
        self.stack[0] = hierarchy::NONE;
        self.stack_s[0] = f32::NEG_INFINITY;
        self.n_stack = 1;
    }

    /// Puts those children of a node on the stack that the ray passes. With `ANY`, rays are not shortened.
    #[inline(always)]
    pub(super) fn enter_node<S: Simd, const ANY: bool>(&mut self, node: &HierarchyNode) {
        // The child that is to be entered last comes first: it is in slot `flip`. The nearest child is entered first, but with
        // `ANY` the farthest, because what lies near a surface seldom hides it.
        let flip = if ANY { !self.ahead } else { self.ahead } % CHILDREN as u32;
        let within = S::LANES as u32 - 1;
        let mut n_stack = self.n_stack as usize % N_STACK;
        let mut first = 0;
        while first < CHILDREN {
            let slots = first ^ (flip & !within) as usize;
            let (s_near, s_far) = self.slabs.range::<S>(self.rows(node, slots), self.s_range);
            let (s_near, s_far) = (s_near.reflect(flip & within), s_far.reflect(flip & within));
            let passed = s_near.le(s_far);
            let children = S::load_bits(&node.children[slots..]).reflect(flip & within);
            if !ANY {
                s_near.compress_to(passed, &mut self.stack_s[n_stack..]);
            }
            n_stack += children.compress_bits_to(passed, &mut self.stack[n_stack..]);
            first += S::LANES;
        }
        self.n_stack = n_stack as u32;
    }

    /// Puts those of `entries` on the empty stack that have a bit in `passed`: the last is entered first. Only for rays that are
    /// not shortened, because where they enter is left out.
    #[inline(always)]
    pub(super) fn enter<S: Simd>(&mut self, entries: &[Entry; CHILDREN], passed: u32) {
        let mut n_stack = 1;
        for first in (0..CHILDREN).step_by(S::LANES) {
            let of_lanes = S::load_bits(&entries[first..]);
            n_stack += of_lanes.compress_bits_to(passed >> first, &mut self.stack[n_stack..]);
        }
        self.n_stack = n_stack as u32;
    }

    /// Takes the next entry from the stack.
    #[inline(always)]
    pub(super) fn next(&mut self) -> Entry {
        let last = self.n_stack as usize - 1;
        self.n_stack = last as u32;
        self.n_cells += 1;
        self.stack[last % N_STACK]
    }

    /// Shortens the ray to `t_end`, and takes entries beyond it off the stack. To leave that to [`Descent::next`] took up to a
    /// sixth more time: nobody can tell how many it would pass over.
    #[inline(always)]
    pub(super) fn shorten<S: Simd>(&mut self, t_end: f64) {
        let s_end = up(((t_end - self.t_base) * self.s_per_t + self.s_slack) as f32);
        self.s_range[1] = if s_end < self.s_range[1] { s_end } else { self.s_range[1] };
        // The first entry stays, however short the ray.
        let (n_stack, mut n_kept) = (self.n_stack as usize % N_STACK, 0);
        for first in (0..n_stack).step_by(S::LANES) {
            let (s_near, entries) = (S::load(&self.stack_s[first..]), S::load_bits(&self.stack[first..]));
            let of_stack = u32::MAX >> (32 - S::LANES.min(n_stack - first));
            let kept = s_near.le(S::splat(self.s_range[1])) & of_stack;
            s_near.compress_to(kept, &mut self.stack_s[n_kept..]);
            n_kept += entries.compress_bits_to(kept, &mut self.stack[n_kept..]);
        }
        self.n_stack = n_kept as u32;
    }

    /// The map from the sides of boxes in a leaf's cube to s.
    #[inline(always)]
    pub(super) fn leaf_slabs(&self, cube: LeafCube) -> Slabs {
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

    /// A bit for each group of a leaf, from number `first` on, whose bounds the ray passes, and the maps of all.
    #[inline(always)]
    pub(super) fn passed_groups<S: Simd>(
        &self,
        of_leaf: &Slabs,
        groups: GroupBatch<'_>,
        first: usize,
    ) -> (u32, GroupSlabs<S>) {
        // SAFETY: sides are those of three axes; the caller's `first`.
        let rows = unsafe { groups.rows::<S>(self.sides(), first) };
        let mut slabs = GroupSlabs([S::splat(0.0); 9]);
        let (mut s_near, mut s_far) = (S::splat(self.s_range[0]), S::splat(self.s_range[1]));
        for axis in 0..3 {
            let (near, far, step) = (rows[2 * axis], rows[2 * axis + 1], of_leaf.step[axis]);
            let near_s = near.mul_add(S::splat(step), S::splat(of_leaf.near[axis]));
            let far_s = far.mul_add(S::splat(step), S::splat(of_leaf.far[axis]));
            let group_step = far.sub(near).mul(S::splat(step * (1.0 / f32::from(boxes::N_GROUP_STEPS))));
            (slabs.0[3 * axis], slabs.0[3 * axis + 1], slabs.0[3 * axis + 2]) = (near_s, far_s, group_step);
            s_near = s_near.max(near_s);
            s_far = s_far.min(far_s);
        }
        (s_near.le(s_far) & groups.mask() >> first, slabs)
    }

    /// A bit for each box of a group, from number `first` on, that the ray passes.
    #[inline(always)]
    pub(super) fn passed_boxes<S: Simd>(&self, slabs: &GroupSlabs<f32>, boxes: GroupBoxes<'_>, first: usize) -> u32 {
        let (mut s_near, mut s_far) = (S::splat(self.s_range[0]), S::splat(self.s_range[1]));
        for axis in 0..3 {
            let is_backward = self.ahead & SLOT_BITS[axis] == 0;
            // SAFETY: three axes; the caller's `first`.
            let [from_near, from_far] = unsafe { boxes.steps::<S>(axis, is_backward, first) };
            let [near, far, step] = [slabs.0[3 * axis], slabs.0[3 * axis + 1], slabs.0[3 * axis + 2]];
            s_near = s_near.max(from_near.mul_add(S::splat(step), S::splat(near)));
            s_far = s_far.min(from_far.neg_mul_add(S::splat(step), S::splat(far)));
        }
        s_near.le(s_far) & boxes.mask() >> first
    }

    /// A bit for each child of a node, from a slot on, that the ray passes.
    #[inline(always)]
    pub(super) fn passed_children<S: Simd>(&self, node: &HierarchyNode, first: usize) -> u32 {
        let (s_near, s_far) = self.slabs.range::<S>(self.rows(node, first), self.s_range);
        s_near.le(s_far)
    }

    /// The near and far sides of a node's children from a slot on.
    #[inline(always)]
    fn rows<S: Simd>(&self, node: &HierarchyNode, slots: usize) -> [S; 6] {
        let mut rows = [S::splat(0.0); 6];
        for axis in 0..3 {
            let [low, high] = [&node.sides[2 * axis], &node.sides[2 * axis + 1]];
            let (near, far) = if self.ahead & SLOT_BITS[axis] != 0 { (low, high) } else { (high, low) };
            (rows[2 * axis], rows[2 * axis + 1]) = (S::load(&near[slots..]), S::load(&far[slots..]));
        }
        rows
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

/// Maps from steps along the bounds of a group, one a lane, to s. For each axis: s at the near side, s at the far side, and s
/// over a step, up from the near side and down from the far side.
pub(super) struct GroupSlabs<T>(pub(super) [T; 9]);

/// The next greater number, or one a little greater.
#[inline(always)]
fn up(x: f32) -> f32 {
    x + x.abs() * f32::EPSILON + f32::MIN_POSITIVE
}
