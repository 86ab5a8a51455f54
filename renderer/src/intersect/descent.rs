//! The way of a single ray through a tree: bricks by a DDA, the nodes of a brick by comparing the ray with all 64 children
//! at once, the triangles of a leaf by comparing it with 16 boxes at once.
//!
//! Positions in a brick are single-precision, relative to the brick's corner. All comparisons have [`MARGIN`] to spare;
//! [`super::triangle`] decides in `f64`.

use crate::{
    grid::{
        cells::CellSpace,
        tree::{
            BRICK_SIZE, LEVELS, Tree,
            boxes::{self, BoxBytes},
        },
    },
    intersect::{bricks::BrickWalk, ray::Ray},
    simd::Simd,
};

/// Rounding errors of positions in a brick, in finest cells: a few units in the last place of 1024, and some to spare.
const MARGIN: f32 = 1.0 / 1024.0;

/// The smallest component of a direction, relative to the largest: over a brick, smaller ones move a ray by less than
/// [`MARGIN`]. Their inverses stay finite.
const SMALLEST_SLOPE: f32 = 1e-12;

/// Receives the leaves along a ray, nearest first.
pub(super) trait LeafVisitor {
    /// Visits a leaf whose triangles matter within `s_range`, in units of `slabs`.
    fn visit<S: Simd>(&mut self, tree: &Tree, leaf: u32, slabs: &LeafSlabs, s_range: [f32; 2]);

    /// The t beyond which nothing matters any more.
    fn t_end(&self) -> f64;
}

/// A ray in one brick. Its parameter s counts finest cells along the major axis.
#[derive(Clone, Copy)]
struct LocalRay {
    /// Point at s = 0, relative to the brick's lowest corner, in finest cells.
    origin: [f32; 3],
    /// s over a finest cell along each axis.
    inverse: [f32; 3],
    /// s over [`MARGIN`] along each axis.
    margin: [f32; 3],
    /// Bits of a child's index that run against the ray.
    flip: u32,
}

/// A node whose children are visited.
#[derive(Clone, Copy)]
struct Visit {
    node: u32,
    /// Children that are left, in the order of the ray.
    left: u64,
    /// The end of the ray when `left` was found.
    s_end: f32,
    /// Lowest corner in the brick, in finest cells.
    corner: [u32; 3],
}

/// Calls a visitor with the leaves along a ray. Returns the number of bricks and of occupied cells on the way.
#[inline(always)]
pub(super) fn descend<S: Simd>(space: &CellSpace, tree: &Tree, ray: &Ray, visitor: &mut impl LeafVisitor) -> u32 {
    let Some(mut walk) = BrickWalk::new(space, tree, ray) else { return 0 };
    let direction = walk.direction();
    let mut local = LocalRay { origin: [0.0; 3], inverse: [0.0; 3], margin: [0.0; 3], flip: 0 };
    for axis in 0..3 {
        let d = if direction[axis].abs() < SMALLEST_SLOPE { SMALLEST_SLOPE } else { direction[axis] };
        local.inverse[axis] = 1.0 / d;
        local.margin[axis] = MARGIN * local.inverse[axis].abs();
        local.flip |= if d < 0.0 { 3 << (2 * axis) } else { 0 };
    }
    let mut n_cells = 0;
    loop {
        n_cells += 1;
        let brick = walk.brick(tree);
        if brick != Tree::EMPTY {
            let s_range;
            (local.origin, s_range) = walk.in_brick(visitor.t_end());
            if brick & Tree::LEAF != 0 {
                visitor.visit::<S>(tree, brick & !Tree::LEAF, &local.leaf_slabs([0; 3], BRICK_SIZE), s_range);
            } else {
                n_cells += descend_brick::<S>(tree, &walk, &local, brick, s_range, visitor);
            }
        }
        if !walk.step(visitor.t_end()) {
            return n_cells;
        }
    }
}

/// [`descend`] for a brick with the node `root`.
#[inline(always)]
fn descend_brick<S: Simd>(
    tree: &Tree,
    walk: &BrickWalk,
    local: &LocalRay,
    root: u32,
    mut s_range: [f32; 2],
    visitor: &mut impl LeafVisitor,
) -> u32 {
    let mut stack = [Visit { node: 0, left: 0, s_end: 0.0, corner: [0; 3] }; LEVELS as usize];
    let mut depth = 0;
    let mut shift = 2 * LEVELS - 2;
    let mut t_end = visitor.t_end();
    let mut n_cells = 0;
    let mut visit = local.enter::<S>(tree, root, [0; 3], shift, s_range);
    loop {
        // Go up from nodes without children left.
        while visit.left == 0 {
            if depth == 0 {
                return n_cells;
            }
            depth -= 1;
            shift += 2;
            visit = stack[depth];
        }
        // A hit has shortened the ray since: fewer children are left.
        if s_range[1] < visit.s_end {
            let now = local.enter::<S>(tree, visit.node, visit.corner, shift, s_range);
            visit = Visit { left: visit.left & now.left, ..now };
            continue;
        }

        // Take the next child along the ray; its index counts the bits before its own.
        n_cells += 1;
        let child = visit.left.trailing_zeros() ^ local.flip;
        visit.left &= visit.left - 1;
        let node = &tree.nodes[visit.node as usize];
        let before = (1_u64 << child) - 1;
        let mut corner = visit.corner;
        for axis in 0..3 {
            corner[axis] += (child >> (2 * axis) & 3) << shift;
        }
        if node.divided >> child & 1 == 1 {
            let below = node.first_node + (node.divided & before).count_ones();
            stack[depth] = visit;
            depth += 1;
            shift -= 2;
            visit = local.enter::<S>(tree, below, corner, shift, s_range);
        } else {
            let leaf = node.first_leaf + (node.occupied & !node.divided & before).count_ones();
            visitor.visit::<S>(tree, leaf, &local.leaf_slabs(corner, 1 << shift), s_range);
            if visitor.t_end() < t_end {
                t_end = visitor.t_end();
                s_range[1] = s_range[1].min(walk.s_in_brick(t_end));
            }
        }
    }
}

impl LocalRay {
    /// The children of a node that the ray passes.
    #[inline(always)]
    fn enter<S: Simd>(&self, tree: &Tree, node: u32, corner: [u32; 3], shift: u32, s_range: [f32; 2]) -> Visit {
        let passed = self.passed_children::<S>(corner, shift, s_range) & tree.nodes[node as usize].occupied;
        Visit { node, left: reflect(passed, self.flip), s_end: s_range[1], corner }
    }

    /// A bit for each child of a node that the ray passes within `s_range`.
    #[inline(always)]
    fn passed_children<S: Simd>(&self, corner: [u32; 3], shift: u32, s_range: [f32; 2]) -> u64 {
        const COLUMNS: [[f32; 16]; 2] = [
            [0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0, 0.0, 1.0, 2.0, 3.0],
            [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0],
        ];
        // Find s at the near and far side of the first child along each axis, and the step to the next.
        let (mut near, mut far, mut step) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        for axis in 0..3 {
            step[axis] = (1 << shift) as f32 * self.inverse[axis];
            let low = (corner[axis] as f32 - self.origin[axis]) * self.inverse[axis];
            near[axis] = low + step[axis].min(0.0) - self.margin[axis];
            far[axis] = low + step[axis].max(0.0) + self.margin[axis];
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
    fn leaf_slabs(&self, corner: [u32; 3], size: u32) -> LeafSlabs {
        let step = size as f32 * (1.0 / boxes::N_STEPS as f32);
        let mut slabs = LeafSlabs { near: [0.0; 3], far: [0.0; 3], step: [0.0; 3], flip: self.flip };
        for axis in 0..3 {
            let low = corner[axis] as f32 - boxes::FIRST_STEP as f32 * step - self.origin[axis];
            let s = low * self.inverse[axis];
            slabs.near[axis] = s - self.margin[axis];
            slabs.far[axis] = s + self.margin[axis];
            slabs.step[axis] = step * self.inverse[axis];
        }
        slabs
    }
}

/// The sides of boxes along a ray: s is linear in the quantised value.
pub(super) struct LeafSlabs {
    near: [f32; 3],
    far: [f32; 3],
    step: [f32; 3],
    flip: u32,
}

impl LeafSlabs {
    /// A bit for each box from number `first` on that the ray passes within `s_range`.
    #[inline(always)]
    pub(super) fn passed<S: Simd>(&self, boxes: BoxBytes<'_>, first: usize, s_range: [f32; 2]) -> u32 {
        let (mut s_near, mut s_far) = (S::splat(s_range[0]), S::splat(s_range[1]));
        for axis in 0..3 {
            let is_backward = (self.flip >> (2 * axis) & 1) as usize;
            let step = S::splat(self.step[axis]);
            let near = boxes.side::<S>(2 * axis + is_backward, first);
            let far = boxes.side::<S>(2 * axis + 1 - is_backward, first);
            s_near = s_near.max(near.mul_add(step, S::splat(self.near[axis])));
            s_far = s_far.min(far.mul_add(step, S::splat(self.far[axis])));
        }
        s_near.le(s_far) & (u32::MAX >> (32 - (boxes.n() - first).min(S::LANES)))
    }
}

/// Moves the bit of each child to the child's index with the bits of `flip` inverted.
#[inline(always)]
fn reflect(mut children: u64, flip: u32) -> u64 {
    let swap = |children: u64, mask: u64, distance: u32| children >> distance & mask | (children & mask) << distance;
    if flip & 3 != 0 {
        children = swap(children, 0x5555_5555_5555_5555, 1);
        children = swap(children, 0x3333_3333_3333_3333, 2);
    }
    if flip & 12 != 0 {
        children = swap(children, 0x0f0f_0f0f_0f0f_0f0f, 4);
        children = swap(children, 0x00ff_00ff_00ff_00ff, 8);
    }
    if flip & 48 != 0 {
        children = swap(children, 0x0000_ffff_0000_ffff, 16).rotate_left(32);
    }
    children
}
