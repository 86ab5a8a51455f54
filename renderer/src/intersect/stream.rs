//! Many rays at once on their ways down a hierarchy, each on its own.
//!
//! A ray alone waits: for memory, for the result of one step to know the next, and for branches that nobody can predict.
//! Here each of [`N_SLOTS`] rays takes one step at a time, and rays that need the same step take it one after the other, so
//! that a processor overlaps their steps. Their triangles are decided together, with all lanes full.

use std::{cell::Cell, mem, ops::Range, slice};

use bytemuck::Zeroable;

use crate::{
    grid::{
        Grid,
        tree::{
            Tree,
            boxes::{GROUP, GroupBatch, GroupBoxes},
            hierarchy::{CHILDREN, Entry, HierarchyNode, LEAF, NONE},
        },
    },
    intersect::{
        descent::{Descent, GroupSlabs, Slabs},
        entry_points::RayBatch,
        ray::Ray,
        rays::Nearest,
        triangle,
    },
    simd::{Kernel, Real, Simd, consecutive},
};

/// Rays on their way at a time: enough to fill lanes, and few enough to stay in the nearest cache.
const N_SLOTS: usize = 64;
const _: () = assert!(N_SLOTS <= u64::BITS as usize, "a bit for each slot");

/// Groups of boxes, and pairs of a ray and a triangle, that are collected before they are tested.
const N_COLLECTED: usize = 128;

/// Room for the vectors of one more group, and to read a whole vector from any item. Indices are taken modulo twice the
/// number that is collected, which spares checks.
const ROOM: usize = 2 * N_COLLECTED + 32;

/// A ray on its way.
struct Slot {
    /// Index of the ray.
    ray_idx: u32,
    descent: Descent,
    nearest: Nearest,
    /// Of the present leaf.
    items: [u32; 2],
}

impl Slot {
    fn new() -> Self {
        let (descent, nearest) = Default::default();
        Self { ray_idx: 0, descent, nearest, items: [0; 2] }
    }
}

/// Some of the slots.
struct SlotList {
    /// With room for a vector after the last.
    slots: [u32; N_SLOTS + 16],
    n: usize,
}

impl SlotList {
    const EMPTY: Self = Self { slots: [0; N_SLOTS + 16], n: 0 };

    /// Appends the slots from `first` on with a bit in `mask`.
    #[inline(always)]
    fn push_lanes<S: Simd>(&mut self, first: usize, mask: u32) {
        const ALL: [u32; N_SLOTS] = {
            let mut all = [0; N_SLOTS];
            let mut slot = 0;
            while slot < N_SLOTS {
                all[slot] = slot as u32;
                slot += 1;
            }
            all
        };
        self.n += S::load_bits(&ALL[first..]).compress_bits_to(mask, &mut self.slots[self.n.min(N_SLOTS)..]);
    }

    #[inline(always)]
    fn as_slice(&self) -> &[u32] {
        &self.slots[..self.n.min(N_SLOTS)]
    }
}

/// Pairs of a slot and another index.
struct Pairs {
    slots: [u32; ROOM],
    indices: [u32; ROOM],
    n: usize,
}

impl Pairs {
    const EMPTY: Self = Self { slots: [0; ROOM], indices: [0; ROOM], n: 0 };

    /// Appends the pairs of a slot with those items of a group that its ray passes, which are numbered from `first_index` on.
    /// Returns how many there are.
    #[inline(always)]
    fn push_items<S: Simd>(
        &mut self,
        slot: u32,
        descent: &Descent,
        slabs: &GroupSlabs<f32>,
        boxes: GroupBoxes<'_>,
        first_index: u32,
    ) -> usize {
        let mut n = 0;
        for first in (0..GROUP).step_by(S::LANES) {
            let passed = descent.passed_boxes::<S>(slabs, boxes, first);
            n += self.push_passed::<S>(slot, passed, first_index + first as u32);
        }
        n
    }

    /// Appends the pairs of a slot with the numbers from `first_index` on that have a bit in `passed`. Returns how many there
    /// are.
    #[inline(always)]
    fn push_passed<S: Simd>(&mut self, slot: u32, passed: u32, first_index: u32) -> usize {
        let at = self.n % (2 * N_COLLECTED);
        self.slots[at..][..S::LANES].fill(slot);
        let n = S::load_bits(&consecutive(first_index)).compress_bits_to(passed, &mut self.indices[at..]);
        self.n = at + n;
        n
    }

    /// Appends the pairs of a slot with those children of a node that its ray passes. Returns how many there are.
    #[inline(always)]
    fn push_children<S: Simd>(&mut self, slot: u32, descent: &Descent, node: &HierarchyNode) -> usize {
        let n_before = self.n % (2 * N_COLLECTED);
        let mut n = n_before;
        for first in (0..CHILDREN).step_by(S::LANES) {
            let passed = descent.passed_children::<S>(node, first);
            let at = n % (2 * N_COLLECTED);
            self.slots[at..][..S::LANES].fill(slot);
            n += S::load_bits(&node.children[first..]).compress_bits_to(passed, &mut self.indices[at..]);
        }
        self.n = n;
        n - n_before
    }

    /// Whether another vector has no room.
    #[inline(always)]
    fn is_full(&self) -> bool {
        self.n > N_COLLECTED
    }
}

/// Groups of boxes that rays may pass, counted in the slot's leaf.
struct Groups {
    pairs: Pairs,
    /// The maps of each: see [`GroupSlabs`].
    slabs: [[f32; ROOM]; 9],
}

impl Groups {
    const EMPTY: Self = Self { pairs: Pairs::EMPTY, slabs: [[0.0; ROOM]; 9] };

    /// Appends those of a batch that the ray of a slot passes, which are numbered from `first_index` on.
    #[inline(always)]
    fn push_passed<S: Simd>(
        &mut self,
        slot: u32,
        descent: &Descent,
        of_leaf: &Slabs,
        batch: GroupBatch<'_>,
        first_index: u32,
    ) {
        for first in (0..GROUP).step_by(S::LANES) {
            let (passed, slabs) = descent.passed_groups::<S>(of_leaf, batch, first);
            let at = self.pairs.n % (2 * N_COLLECTED);
            for number in 0..9 {
                slabs.0[number].compress_to(passed, &mut self.slabs[number][at..]);
            }
            self.pairs.push_passed::<S>(slot, passed, first_index + first as u32);
        }
    }

    /// The maps of the one at an index.
    #[inline(always)]
    fn slabs(&self, index: usize) -> GroupSlabs<f32> {
        let mut slabs = GroupSlabs([0.0; 9]);
        for number in 0..9 {
            slabs.0[number] = self.slabs[number][index % ROOM];
        }
        slabs
    }
}

/// The state of a stream. Making it takes longer than tracing a ray, so each thread keeps one.
struct State {
    slots: [Slot; N_SLOTS],
    /// The ray of each slot: side by side, they share cache lines with no stack.
    rays: [Ray; N_SLOTS],
    /// The node or leaf that each slot's ray enters next; [`NONE`] at its end.
    entries: [Entry; N_SLOTS],
    /// The rays that begin next.
    batch: RayBatch,
    groups: Groups,
    /// Triangles that rays may hit, or items of leaves.
    triangles: Pairs,
}

impl State {
    // Not inlined: the caller would reserve room for a state on its stack, and touch each page of that, which took half of the
    // time of a ray alone.
    #[cold]
    #[inline(never)]
    fn new() -> Box<Self> {
        Box::new(Self {
            slots: std::array::from_fn(|_| Slot::new()),
            rays: [Ray::zeroed(); N_SLOTS],
            entries: [NONE; N_SLOTS],
            batch: RayBatch::EMPTY,
            groups: Groups::EMPTY,
            triangles: Pairs::EMPTY,
        })
    }
}

thread_local! {
    static STATE: Cell<Option<Box<State>>> = const { Cell::new(None) };
}

/// Traces runs of rays, and calls `answer` with the index of each and its nearest hit, with `ANY` one of its hits.
pub(super) struct RayStream<'a, F, const ANY: bool> {
    grid: &'a Grid,
    tree: &'a Tree,
    rays: &'a [Ray],
    answer: F,
    /// The next ray to begin, and the end of its run; equal if none is left.
    next_ray: usize,
    end: usize,
    /// The runs that follow.
    runs: slice::Iter<'a, Range<usize>>,
    /// Whether to hint at what rays enter next.
    hints: bool,
    /// A bit for each slot whose ray has met a triangle in its present leaf.
    hit_slots: u64,
    state: Box<State>,
}

impl<'a, F: FnMut(usize, Nearest), const ANY: bool> RayStream<'a, F, ANY> {
    pub(super) fn new(grid: &'a Grid, tree: &'a Tree, rays: &'a [Ray], runs: &'a [Range<usize>], answer: F) -> Self {
        // Rays of which any hit counts take 0.95 to 1.1 of the time with hints.
        let hints = !ANY && tree.exceeds_caches();
        let mut state = STATE.take().unwrap_or_else(State::new);
        state.batch.clear();
        Self { grid, tree, rays, answer, next_ray: 0, end: 0, runs: runs.iter(), hints, hit_slots: 0, state }
    }
}

impl<F: FnMut(usize, Nearest), const ANY: bool> Kernel for RayStream<'_, F, ANY> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self) {
        let mut n_begun = 0;
        while n_begun < N_SLOTS && self.has_next::<S>() {
            self.begin_ray::<S>(n_begun as u32);
            n_begun += 1;
        }
        // Made once: to write them anew for each round took 3 to 6 % of the time.
        let (mut at_ends, mut at_nodes, mut at_leaves) = (SlotList::EMPTY, SlotList::EMPTY, SlotList::EMPTY);
        loop {
            // Sort the slots by the step that each needs. No branch does: nobody can tell what comes next.
            (at_ends.n, at_nodes.n, at_leaves.n) = (0, 0, 0);
            for first in (0..n_begun).step_by(S::LANES) {
                let begun = u32::MAX >> (32 - S::LANES.min(n_begun - first));
                let entries = &self.state.entries[first..];
                let (leaf, end) = (S::load_bits(entries).sign_mask(), S::eq_mask(entries, NONE));
                at_ends.push_lanes::<S>(first, end & begun);
                at_leaves.push_lanes::<S>(first, leaf & !end & begun);
                at_nodes.push_lanes::<S>(first, !leaf & begun);
            }

            // Let other rays begin where some end.
            if at_ends.n == n_begun && !self.has_next::<S>() {
                break;
            }
            for &slot in at_ends.as_slice() {
                if !self.has_next::<S>() {
                    break;
                }
                self.end_ray(slot);
                self.begin_ray::<S>(slot);
            }

            for &slot in at_nodes.as_slice() {
                let slot_idx = slot as usize % N_SLOTS;
                let node = &self.tree.hierarchy.nodes[self.state.entries[slot_idx] as usize];
                let descent = &mut self.state.slots[slot_idx].descent;
                descent.enter_node::<S, ANY>(node);
                let next = descent.next();
                self.set_entry::<S>(slot_idx, next);
            }
            self.visit_leaves::<S>(at_leaves.as_slice());
        }
        for slot in 0..n_begun {
            self.end_ray(slot as u32);
        }
        STATE.set(Some(self.state));
    }
}

impl<F: FnMut(usize, Nearest), const ANY: bool> RayStream<'_, F, ANY> {
    /// Whether a ray is left to begin with; prepares others if none is.
    #[inline(always)]
    fn has_next<S: Simd>(&mut self) -> bool {
        while self.state.batch.is_empty() {
            if self.next_ray == self.end {
                let Some(run) = self.runs.next() else { return false };
                (self.next_ray, self.end) = (run.start, run.end);
            }
            let (rays, answer) = (&self.rays[self.next_ray..self.end], &mut self.answer);
            let miss = |ray_idx| answer(ray_idx, Nearest::default());
            self.next_ray += self.state.batch.prepare::<S, ANY>(&self.grid.space, self.tree, self.next_ray, rays, miss);
        }
        true
    }

    /// Lets the next ray begin in a slot; there is one.
    #[inline(always)]
    fn begin_ray<S: Simd>(&mut self, slot: u32) {
        let slot_idx = slot as usize % N_SLOTS;
        let begun = &mut self.state.slots[slot_idx];
        let (ray_idx, first) =
            self.state.batch.begin::<S, ANY>(&self.grid.space, self.tree, self.rays, &mut begun.descent);
        self.state.rays[slot_idx] = self.rays[ray_idx];
        (begun.ray_idx, begun.nearest) = (ray_idx as u32, Nearest::default());
        self.state.entries[slot_idx] = first;
    }

    /// Answers the ray of a slot.
    #[inline(always)]
    fn end_ray(&mut self, slot: u32) {
        let Slot { ray_idx, descent, nearest, .. } = &mut self.state.slots[slot as usize % N_SLOTS];
        nearest.cost.n_cells = descent.n_cells;
        (self.answer)(*ray_idx as usize, *nearest);
    }

    /// Tests the triangles in the leaves that these slots' rays enter, and takes the rays on.
    #[inline(always)]
    fn visit_leaves<S: Simd>(&mut self, slots: &[u32]) {
        if self.tree.hierarchy.triangle_nodes.is_empty() {
            self.collect_groups::<S>(slots);
            self.decide_items::<S>();
        } else {
            self.collect_triangles::<S>(slots);
            self.decide_triangles::<S>();
        }
        if !ANY {
            let mut left = mem::take(&mut self.hit_slots);
            while left != 0 {
                let Slot { descent, nearest, .. } = &mut self.state.slots[left.trailing_zeros() as usize % N_SLOTS];
                left &= left - 1;
                descent.shorten::<S>(nearest.t);
            }
        }
        for &slot in slots {
            let slot_idx = slot as usize % N_SLOTS;
            let Slot { descent, nearest, .. } = &mut self.state.slots[slot_idx];
            let next = if ANY && nearest.is_hit() { NONE } else { descent.next() };
            self.set_entry::<S>(slot_idx, next);
        }
    }

    /// Sets the node or leaf that a slot's ray enters next. Other slots' steps come before it, while memory delivers it.
    #[inline(always)]
    fn set_entry<S: Simd>(&mut self, slot_idx: usize, next: Entry) {
        self.state.entries[slot_idx] = next;
        if self.hints {
            self.tree.prefetch::<S>(next);
        }
    }

    /// Collects the triangles of triangle nodes whose boxes the rays pass.
    #[inline(always)]
    fn collect_triangles<S: Simd>(&mut self, slots: &[u32]) {
        for &slot in slots {
            let slot_idx = slot as usize % N_SLOTS;
            let node = &self.tree.hierarchy.triangle_nodes[(self.state.entries[slot_idx] & !LEAF) as usize];
            let Slot { descent, nearest, .. } = &mut self.state.slots[slot_idx];
            nearest.cost.n_tests += self.state.triangles.push_children::<S>(slot, descent, node) as u32;
            if self.state.triangles.is_full() {
                self.decide_triangles::<S>();
            }
        }
    }

    /// Collects the triangles of a tree's leaves whose boxes the rays pass.
    #[inline(always)]
    fn collect_groups<S: Simd>(&mut self, slots: &[u32]) {
        for &slot in slots {
            let leaf = self.state.entries[slot as usize % N_SLOTS] & !LEAF;
            self.tree.boxes.prefetch_bounds::<S>(leaf, self.tree.items_of(leaf));
        }
        // A leaf's groups are collected sixteen at a time, and tested when many are.
        let (mut next, mut first) = (0, 0);
        while next < slots.len() {
            while next < slots.len() && !self.state.groups.pairs.is_full() {
                let slot_idx = slots[next] as usize % N_SLOTS;
                let leaf = self.state.entries[slot_idx] & !LEAF;
                let Slot { descent, items, .. } = &mut self.state.slots[slot_idx];
                let of_leaf = self.tree.items_of(leaf);
                let n_groups = of_leaf.len().div_ceil(GROUP);
                let of_leaf_cube = descent.leaf_slabs(self.tree.leaf_cubes[leaf as usize]);
                *items = [of_leaf.start as u32, of_leaf.end as u32];
                self.tree.items.prefetch::<S>(of_leaf.start);
                let batch = self.tree.boxes.of_groups(leaf, of_leaf).batch(first);
                self.state.groups.push_passed::<S>(slots[next], descent, &of_leaf_cube, batch, first as u32);
                let is_last = first + GROUP >= n_groups;
                first = if is_last { 0 } else { first + GROUP };
                next += usize::from(is_last);
                if !is_last {
                    break;
                }
            }
            self.test_groups::<S>();
        }
    }

    /// Tests the boxes of all groups.
    #[inline(always)]
    fn test_groups<S: Simd>(&mut self) {
        let Groups { pairs, .. } = &self.state.groups;
        for (&slot, &group) in pairs.slots.iter().zip(&pairs.indices).take(pairs.n) {
            let first = self.state.slots[slot as usize % N_SLOTS].items[0] as usize + group as usize * GROUP;
            self.tree.boxes.prefetch_group::<S>(first);
        }
        for index in 0..mem::take(&mut self.state.groups.pairs.n) {
            let slot_idx = self.state.groups.pairs.slots[index];
            let slot = &mut self.state.slots[slot_idx as usize];
            let [start, end] = slot.items.map(|item| item as usize);
            let first = start + self.state.groups.pairs.indices[index] as usize * GROUP;
            let boxes = self.tree.boxes.group(first, (end - first).min(GROUP));
            let slabs = self.state.groups.slabs(index);
            let n = self.state.triangles.push_items::<S>(slot_idx, &slot.descent, &slabs, boxes, first as u32);
            slot.nearest.cost.n_tests += n as u32;
            if self.state.triangles.is_full() {
                self.decide_items::<S>();
            }
        }
    }

    /// Decides all pairs of a ray and an item. All triangles are found first, so that their cache misses overlap.
    #[inline(always)]
    fn decide_items<S: Simd>(&mut self) {
        let Pairs { indices, n, .. } = &mut self.state.triangles;
        for index in &mut indices[..*n] {
            *index = self.tree.items.triangle(*index);
            self.grid.mesh().prefetch::<S>(*index);
        }
        for &triangle in &indices[..*n] {
            self.grid.mesh().prefetch_vertices::<S>(triangle);
        }
        self.decide_triangles::<S>();
    }

    /// Decides all pairs of a ray and a triangle.
    #[inline(always)]
    fn decide_triangles<S: Simd>(&mut self) {
        let n = mem::take(&mut self.state.triangles.n);
        // Lanes behind the last pair repeat the first: what they hold may be of another mesh.
        let indices = &mut self.state.triangles.indices;
        let first_index = indices[0];
        indices[n..n + 16].fill(first_index);
        for first in (0..n).step_by(S::LANES) {
            self.decide_vector::<S>(first, n - first);
        }
    }

    /// Decides up to [`Simd::LANES`] of `n` pairs from `first` on. Lanes behind the last hold others.
    #[inline(always)]
    fn decide_vector<S: Simd>(&mut self, first: usize, n: usize) {
        let mesh = self.grid.mesh();
        // Gather the corners of triangles and the rays, a pair a lane.
        let triangles: &[u32; 16] =
            self.state.triangles.indices[first..first + 16].try_into().expect("sixteen triangles");
        let slots: &[u32; 16] = self.state.triangles.slots[first..first + 16].try_into().expect("sixteen slots");
        let corners = mesh.gather_corners::<S>(triangles);
        let [x, y, z, along_x, along_y, along_z, _, _] =
            S::gather_columns(bytemuck::cast_slice(&self.state.rays), slots);

        // Decide, and offer the hits to their rays.
        for first_lane in (0..S::LANES.min(n)).step_by(S::Double::LANES) {
            let decision = triangle::decide_lanes(&[x, y, z], &[along_x, along_y, along_z], &corners, first_lane);
            let mut ts = [0.0; 8];
            decision.t.store(&mut ts);
            let n_lanes = (n - first_lane).min(S::Double::LANES);
            let mut left = !decision.certain_miss & ((1 << n_lanes) - 1);
            while left != 0 {
                let lane = left.trailing_zeros() as usize;
                left &= left - 1;
                let triangle = triangles[first_lane + lane];
                let slot_idx = slots[first_lane + lane] as usize % N_SLOTS;
                let slot = &mut self.state.slots[slot_idx];
                let ray = &self.state.rays[slot_idx];
                let certain_t = (decision.uncertain >> lane & 1 == 0).then_some(ts[lane]);
                if let Some(t) = triangle::finish(ray, certain_t, || mesh.corners_by_call(triangle)) {
                    slot.nearest.offer(mesh, ray, triangle, t);
                    self.hit_slots |= u64::from(!ANY) << slot_idx;
                }
            }
        }
    }
}
