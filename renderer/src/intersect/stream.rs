//! Many rays at once on their ways down a hierarchy, each on its own.
//!
//! A ray alone waits: for memory, for the result of one step to know the next, and for branches that nobody can predict.
//! Here each of [`N_SLOTS`] rays takes one step at a time, and rays that need the same step take it one after the other, so
//! that a processor overlaps their steps. Their triangles are decided together, with all lanes full.

use std::cell::Cell;

use crate::{
    grid::{
        Grid,
        tree::{
            Tree,
            boxes::{GROUP, GroupBytes},
        },
    },
    intersect::{
        descent::{Descent, Slabs, Step},
        ray::Ray,
        rays::Nearest,
        triangle,
    },
    simd::{Kernel, Real, Simd},
};

/// Rays on their way at a time: enough to fill lanes, and few enough to stay in the nearest cache.
const N_SLOTS: usize = 32;

/// Groups of boxes, and pairs of a ray and a triangle, that are collected before they are tested.
const N_COLLECTED: usize = 128;

/// Room for the vectors of one more group, and to read a whole vector from any item. Indices are taken modulo twice the
/// number that is collected, which spares checks.
const ROOM: usize = 2 * N_COLLECTED + 32;

/// The first references of a leaf's groups.
const FIRST_OF_GROUPS: [u32; 16] = [0, 16, 32, 48, 64, 80, 96, 112, 128, 144, 160, 176, 192, 208, 224, 240];

/// A ray on its way.
struct Slot {
    /// Index of the ray.
    ray_idx: usize,
    ray: Ray,
    descent: Descent,
    nearest: Nearest,
    /// Of the present leaf: its boxes along the ray, and its references.
    slabs: Slabs,
    references: [u32; 2],
}

impl Slot {
    fn new(ray: Ray) -> Self {
        let (descent, nearest, slabs) = Default::default();
        Self { ray_idx: 0, ray, descent, nearest, slabs, references: [0; 2] }
    }
}

/// Slots that need a step.
struct Queue {
    slots: [u8; N_SLOTS],
    n: usize,
}

impl Queue {
    const EMPTY: Self = Self { slots: [0; N_SLOTS], n: 0 };

    #[inline(always)]
    fn push(&mut self, slot: u8) {
        self.slots[self.n % N_SLOTS] = slot;
        self.n += 1;
    }

    #[inline(always)]
    fn pop(&mut self) -> Option<u8> {
        self.n = self.n.checked_sub(1)?;
        Some(self.slots[self.n % N_SLOTS])
    }

    /// Empties the queue.
    #[inline(always)]
    fn take(&mut self) -> ([u8; N_SLOTS], usize) {
        (self.slots, std::mem::take(&mut self.n))
    }
}

/// The slots that need each [`Step`].
struct Queues([Queue; 3]);

impl Queues {
    /// The queue is an index, not a branch.
    #[inline(always)]
    fn push(&mut self, step: Step, slot: u8) {
        self.0[step as usize].push(slot);
    }

    #[inline(always)]
    fn of(&mut self, step: Step) -> &mut Queue {
        &mut self.0[step as usize]
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

    /// Appends the pairs of a slot with the indices of those boxes that its ray passes. Returns how many there are.
    #[inline(always)]
    fn push_passed<S: Simd>(
        &mut self,
        slot: u8,
        descent: &Descent,
        slabs: &Slabs,
        boxes: GroupBytes<'_>,
        indices: &[u32],
    ) -> usize {
        let n_before = self.n % (2 * N_COLLECTED);
        let mut n = n_before;
        for first in (0..GROUP).step_by(S::LANES) {
            let passed = descent.passed_boxes::<S>(slabs, boxes, first);
            let slots = &mut self.slots[n % (2 * N_COLLECTED)..][..S::LANES];
            slots.fill(u32::from(slot));
            let of_lanes = &indices[first.min(indices.len())..(first + S::LANES).min(indices.len())];
            n += S::compress(of_lanes, passed, &mut self.indices[n % (2 * N_COLLECTED)..]);
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

/// The state of a stream. Making it takes longer than tracing a ray, so each thread keeps one.
struct State {
    slots: Vec<Slot>,
    /// Of the slots' rays, three numbers each.
    origins: [f32; 3 * N_SLOTS + 3],
    directions: [f32; 3 * N_SLOTS + 3],
    /// Groups of boxes that rays may pass, by their first reference in the slot's leaf.
    groups: Pairs,
    /// Triangles that rays may hit.
    triangles: Pairs,
}

impl State {
    const NEW: Self = {
        let coordinates = [0.0; 3 * N_SLOTS + 3];
        let (origins, directions) = (coordinates, coordinates);
        Self { slots: Vec::new(), origins, directions, groups: Pairs::EMPTY, triangles: Pairs::EMPTY }
    };
}

thread_local! {
    static STATE: Cell<Option<Box<State>>> = const { Cell::new(None) };
}

/// Traces rays, and calls `answer` with the index of each and its nearest hit, with `ANY` one of its hits.
pub(super) struct RayStream<'a, F, const ANY: bool> {
    grid: &'a Grid,
    tree: &'a Tree,
    rays: &'a [Ray],
    answer: F,
    /// The next ray to begin, and the slots that rays have begun in so far.
    next_ray: usize,
    n_begun: usize,
    state: Box<State>,
}

impl<'a, F: FnMut(usize, Nearest), const ANY: bool> RayStream<'a, F, ANY> {
    pub(super) fn new(grid: &'a Grid, tree: &'a Tree, rays: &'a [Ray], answer: F) -> Self {
        let state = STATE.take().unwrap_or_else(|| Box::new(State::NEW));
        Self { grid, tree, rays, answer, next_ray: 0, n_begun: 0, state }
    }
}

impl<F: FnMut(usize, Nearest), const ANY: bool> Kernel for RayStream<'_, F, ANY> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self) {
        let mut queues = Queues([Queue::EMPTY; 3]);
        let hierarchy = &self.tree.hierarchy;
        loop {
            self.begin_rays(&mut queues);
            let (waiting, n) = queues.of(Step::Node).take();
            for &slot in &waiting[..n] {
                let descent = &mut self.state.slots[slot as usize].descent;
                descent.enter_node::<S>(hierarchy);
                queues.push(descent.next(), slot);
            }
            let (waiting, n) = queues.of(Step::Leaf).take();
            self.visit_leaves::<S>(&waiting[..n]);
            for &slot in &waiting[..n] {
                let Slot { descent, nearest, .. } = &mut self.state.slots[slot as usize];
                if !(ANY && nearest.is_hit()) {
                    descent.shorten(nearest.t);
                    queues.push(descent.next(), slot);
                } else {
                    queues.push(Step::End, slot);
                }
            }
            if queues.0[0].n + queues.0[1].n == 0 && self.next_ray == self.rays.len() {
                break;
            }
        }
        while let Some(slot) = queues.of(Step::End).pop() {
            self.end_ray(slot);
        }
        STATE.set(Some(self.state));
    }
}

impl<F: FnMut(usize, Nearest), const ANY: bool> RayStream<'_, F, ANY> {
    /// Answers the rays that have ended and lets others begin in their slots.
    #[inline(always)]
    fn begin_rays(&mut self, queues: &mut Queues) {
        while self.next_ray < self.rays.len() {
            let (ray_idx, ray) = (self.next_ray, self.rays[self.next_ray]);
            let slot = if let Some(slot) = queues.of(Step::End).pop() {
                self.end_ray(slot);
                slot
            } else if self.n_begun < N_SLOTS {
                if self.n_begun == self.state.slots.len() {
                    self.state.slots.push(Slot::new(ray));
                }
                self.n_begun += 1;
                (self.n_begun - 1) as u8
            } else {
                return;
            };
            self.next_ray += 1;
            let begun = &mut self.state.slots[slot as usize];
            (begun.ray_idx, begun.ray, begun.nearest) = (ray_idx, ray, Nearest::default());
            let at = 3 * slot as usize;
            self.state.origins[at..at + 3].copy_from_slice(&ray.origin.to_array());
            self.state.directions[at..at + 3].copy_from_slice(&ray.direction.to_array());
            queues.push(begun.descent.begin(&self.grid.space, self.tree, &ray), slot);
        }
    }

    #[inline(always)]
    fn end_ray(&mut self, slot: u8) {
        let Slot { ray_idx, descent, nearest, .. } = &mut self.state.slots[slot as usize];
        nearest.cost.n_cells = descent.n_cells;
        (self.answer)(*ray_idx, *nearest);
    }

    /// Tests the triangles in the present leaves of these slots.
    #[inline(always)]
    fn visit_leaves<S: Simd>(&mut self, slots: &[u8]) {
        // A leaf's groups are collected sixteen at a time, and tested when many are.
        let (mut next, mut first) = (0, 0);
        while next < slots.len() {
            while next < slots.len() && !self.state.groups.is_full() {
                let slot_idx = slots[next];
                let Slot { descent, slabs, references, .. } = &mut self.state.slots[slot_idx as usize];
                let leaf = descent.leaf();
                let of_leaf = self.tree.references_of(leaf);
                let n_groups = of_leaf.len().div_ceil(GROUP);
                *slabs = descent.leaf_slabs(self.tree);
                *references = [(of_leaf.start + first * GROUP) as u32, of_leaf.end as u32];
                let groups = self.tree.boxes.of_groups(leaf, of_leaf).group(first);
                let indices = &FIRST_OF_GROUPS[..(n_groups - first).min(GROUP)];
                self.state.groups.push_passed::<S>(slot_idx, descent, slabs, groups, indices);
                let is_last = first + GROUP >= n_groups;
                first = if is_last { 0 } else { first + GROUP };
                next += usize::from(is_last);
                if !is_last {
                    break;
                }
            }
            self.test_groups::<S>();
        }
        self.decide_triangles::<S>();
    }

    /// Tests the boxes of all groups.
    #[inline(always)]
    fn test_groups<S: Simd>(&mut self) {
        for index in 0..std::mem::take(&mut self.state.groups.n) {
            let slot_idx = self.state.groups.slots[index] as u8;
            let slot = &mut self.state.slots[slot_idx as usize];
            let first = (slot.references[0] + self.state.groups.indices[index]) as usize;
            let triangles = &self.tree.references[first..(first + GROUP).min(slot.references[1] as usize)];
            let boxes = self.tree.boxes.group(first, triangles.len());
            let n = self.state.triangles.push_passed::<S>(slot_idx, &slot.descent, &slot.slabs, boxes, triangles);
            slot.nearest.cost.n_tests += n as u32;
            if self.state.triangles.is_full() {
                self.decide_triangles::<S>();
            }
        }
    }

    /// Decides all pairs of a ray and a triangle.
    #[inline(always)]
    fn decide_triangles<S: Simd>(&mut self) {
        let n = std::mem::take(&mut self.state.triangles.n);
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
        let mut corners = [[[0.0; 16]; 3]; 3];
        for (corner, point) in mesh.gather_corners::<S>(triangles).into_iter().enumerate() {
            for axis in 0..3 {
                point[axis].store(&mut corners[corner][axis]);
            }
        }
        let (mut origin, mut direction) = ([[0.0; 16]; 3], [[0.0; 16]; 3]);
        // SAFETY: all slots have three numbers, and three more follow the last.
        let (origins, directions) =
            unsafe { (S::gather_xyz(&self.state.origins, slots), S::gather_xyz(&self.state.directions, slots)) };
        for axis in 0..3 {
            origins[axis].store(&mut origin[axis]);
            directions[axis].store(&mut direction[axis]);
        }

        // Decide, and offer the hits to their rays.
        for first_lane in (0..S::LANES.min(n)).step_by(S::Double::LANES) {
            let decision = triangle::decide_lanes::<S::Double>(&origin, &direction, &corners, first_lane);
            let mut ts = [0.0; 8];
            decision.t.store(&mut ts);
            let n_lanes = (n - first_lane).min(S::Double::LANES);
            let mut left = !decision.certain_miss & ((1 << n_lanes) - 1);
            while left != 0 {
                let lane = left.trailing_zeros() as usize;
                left &= left - 1;
                let triangle = triangles[first_lane + lane];
                let slot = &mut self.state.slots[slots[first_lane + lane] as usize];
                let certain_t = (decision.uncertain >> lane & 1 == 0).then_some(ts[lane]);
                if let Some(t) = triangle::finish(&slot.ray, certain_t, || mesh.corners(triangle)) {
                    slot.nearest.offer(mesh, &slot.ray, triangle, t);
                }
            }
        }
    }
}
