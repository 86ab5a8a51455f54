//! Many rays at once on their ways through a tree, each on its own.
//!
//! A ray alone waits: for memory, for the result of one step to know the next, and for branches that nobody can predict.
//! Here each of [`N_SLOTS`] rays takes one step at a time, and rays that need the same step take it one after the other, so
//! that a processor overlaps their steps. Their triangles are decided together, with all lanes full.

use crate::{
    grid::{
        Grid,
        tree::{
            Tree,
            boxes::{GROUP, GroupBytes},
        },
    },
    intersect::{
        descent::{Descent, LeafSlabs, Step},
        ray::Ray,
        rays::Nearest,
        triangle,
    },
    simd::{Kernel, Real, Simd},
};

/// Rays on their way at a time: enough to fill lanes, and few enough to stay in the nearest cache.
const N_SLOTS: usize = 64;

/// Groups of boxes, and pairs of a ray and a triangle, that are collected before they are tested.
const N_COLLECTED: usize = 128;

/// Room for the vectors of one more group, and to read a whole vector from any item.
const ROOM: usize = N_COLLECTED + 32;

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
    slabs: LeafSlabs,
    references: [u32; 2],
}

impl Slot {
    fn new(ray: Ray) -> Self {
        let (descent, nearest, slabs) = Default::default();
        Self { ray_idx: 0, ray, descent, nearest, slabs, references: [0; 2] }
    }

    /// The t beyond which nothing matters any more.
    #[inline(always)]
    fn t_end<const ANY: bool>(&self) -> f64 {
        if ANY && self.nearest.is_hit() { f64::NEG_INFINITY } else { self.nearest.t }
    }
}

/// The slots that need each step.
struct Queues {
    slots: [[u8; N_SLOTS]; 5],
    n: [usize; 5],
}

impl Queues {
    /// The step is an index, not a branch.
    #[inline(always)]
    fn push(&mut self, step: Step, slot: u8) {
        let n = &mut self.n[step as usize];
        self.slots[step as usize][*n % N_SLOTS] = slot;
        *n += 1;
    }

    /// Empties the queue of a step.
    #[inline(always)]
    fn take(&mut self, step: Step) -> ([u8; N_SLOTS], usize) {
        (self.slots[step as usize], std::mem::take(&mut self.n[step as usize]))
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
        slabs: &LeafSlabs,
        boxes: GroupBytes<'_>,
        s_range: [f32; 2],
        indices: &[u32],
    ) -> usize {
        let n_before = self.n;
        let mut first = 0;
        loop {
            let passed = slabs.passed::<S>(boxes, first, s_range);
            let end = (first + S::LANES).min(indices.len());
            self.slots[self.n..self.n + S::LANES].fill(u32::from(slot));
            self.n += S::compress(&indices[first..end], passed, &mut self.indices[self.n..]);
            first += S::LANES;
            if first >= indices.len() {
                return self.n - n_before;
            }
        }
    }

    /// Whether another vector has no room.
    #[inline(always)]
    fn is_full(&self) -> bool {
        self.n > N_COLLECTED
    }
}

/// Traces rays, and calls `answer` with the index of each and its nearest hit, with `ANY` one of its hits.
pub(super) struct RayStream<'a, F, const ANY: bool> {
    grid: &'a Grid,
    tree: &'a Tree,
    rays: &'a [Ray],
    answer: F,
    slots: Vec<Slot>,
    /// Groups of boxes that rays may pass, by their first reference in the slot's leaf.
    groups: Pairs,
    /// Triangles that rays may hit.
    triangles: Pairs,
}

impl<'a, F: FnMut(usize, Nearest), const ANY: bool> RayStream<'a, F, ANY> {
    pub(super) fn new(grid: &'a Grid, tree: &'a Tree, rays: &'a [Ray], answer: F) -> Self {
        let slots = Vec::with_capacity(rays.len().min(N_SLOTS));
        Self { grid, tree, rays, answer, slots, groups: Pairs::EMPTY, triangles: Pairs::EMPTY }
    }
}

impl<F: FnMut(usize, Nearest), const ANY: bool> Kernel for RayStream<'_, F, ANY> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(mut self) {
        let mut queues = Queues { slots: [[0; N_SLOTS]; 5], n: [0; 5] };
        let mut next_ray = 0;
        loop {
            self.begin_rays(&mut queues, &mut next_ray);
            let tree = self.tree;
            let (waiting, n) = queues.take(Step::Brick);
            for &slot in &waiting[..n] {
                let Slot { descent, nearest, .. } = &mut self.slots[slot as usize];
                queues.push(descent.enter_brick(tree, nearest.t), slot);
            }
            let (waiting, n) = queues.take(Step::Node);
            for &slot in &waiting[..n] {
                let Slot { descent, nearest, .. } = &mut self.slots[slot as usize];
                descent.enter_node::<S>(tree);
                queues.push(descent.next_child(tree, nearest.t), slot);
            }
            let (waiting, n) = queues.take(Step::Child);
            for &slot in &waiting[..n] {
                let Slot { descent, nearest, .. } = &mut self.slots[slot as usize];
                queues.push(descent.next_child(tree, nearest.t), slot);
            }
            let (waiting, n) = queues.take(Step::Leaf);
            self.visit_leaves::<S>(&waiting[..n]);
            for &slot in &waiting[..n] {
                let t_end = self.slots[slot as usize].t_end::<ANY>();
                let step = self.slots[slot as usize].descent.leave_leaf(t_end);
                queues.push(if ANY && t_end == f64::NEG_INFINITY { Step::End } else { step }, slot);
            }
            if queues.n[..4] == [0; 4] && next_ray == self.rays.len() {
                break;
            }
        }
        let (ended, n) = queues.take(Step::End);
        for &slot in &ended[..n] {
            self.end_ray(slot);
        }
    }
}

impl<F: FnMut(usize, Nearest), const ANY: bool> RayStream<'_, F, ANY> {
    /// Answers the rays that have ended and lets others begin in their slots.
    #[inline(always)]
    fn begin_rays(&mut self, queues: &mut Queues, next_ray: &mut usize) {
        while *next_ray < self.rays.len() {
            let ended = queues.n[Step::End as usize];
            if ended == 0 && self.slots.len() == N_SLOTS {
                return;
            }
            let (ray_idx, ray) = (*next_ray, self.rays[*next_ray]);
            *next_ray += 1;
            let slot = if ended > 0 {
                queues.n[Step::End as usize] -= 1;
                let slot = queues.slots[Step::End as usize][ended - 1];
                self.end_ray(slot);
                slot
            } else {
                self.slots.push(Slot::new(ray));
                (self.slots.len() - 1) as u8
            };
            let begun = &mut self.slots[slot as usize];
            (begun.ray_idx, begun.ray, begun.nearest) = (ray_idx, ray, Nearest::default());
            let step = begun.descent.begin(&self.grid.space, self.tree, &ray);
            queues.push(step, slot);
        }
    }

    #[inline(always)]
    fn end_ray(&mut self, slot: u8) {
        let Slot { ray_idx, descent, nearest, .. } = &mut self.slots[slot as usize];
        nearest.cost.n_cells = descent.n_cells;
        (self.answer)(*ray_idx, *nearest);
    }

    /// Tests the triangles in the present leaves of these slots.
    #[inline(always)]
    fn visit_leaves<S: Simd>(&mut self, slots: &[u8]) {
        // A leaf's groups are collected sixteen at a time, and tested when many are.
        let (mut next, mut first) = (0, 0);
        while next < slots.len() {
            while next < slots.len() && !self.groups.is_full() {
                let slot_idx = slots[next];
                let Slot { descent, slabs, references, .. } = &mut self.slots[slot_idx as usize];
                let leaf = descent.leaf;
                let of_leaf = self.tree.references_of(leaf);
                let n_groups = of_leaf.len().div_ceil(GROUP);
                *slabs = descent.leaf_slabs();
                *references = [(of_leaf.start + first * GROUP) as u32, of_leaf.end as u32];
                let (slabs, s_range) = (*slabs, descent.s_range);
                let groups = self.tree.boxes.of_groups(leaf, of_leaf).group(first);
                let indices = &FIRST_OF_GROUPS[..(n_groups - first).min(GROUP)];
                self.groups.push_passed::<S>(slot_idx, &slabs, groups, s_range, indices);
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
        for index in 0..std::mem::take(&mut self.groups.n) {
            let slot_idx = self.groups.slots[index] as u8;
            let slot = &mut self.slots[slot_idx as usize];
            let first = (slot.references[0] + self.groups.indices[index]) as usize;
            let triangles = &self.tree.references[first..(first + GROUP).min(slot.references[1] as usize)];
            let boxes = self.tree.boxes.group(first, triangles.len());
            let n = self.triangles.push_passed::<S>(slot_idx, &slot.slabs, boxes, slot.descent.s_range, triangles);
            slot.nearest.cost.n_tests += n as u32;
            if self.triangles.is_full() {
                self.decide_triangles::<S>();
            }
        }
    }

    /// Decides all pairs of a ray and a triangle.
    #[inline(always)]
    fn decide_triangles<S: Simd>(&mut self) {
        let n = std::mem::take(&mut self.triangles.n);
        for first in (0..n).step_by(S::LANES) {
            self.decide_vector::<S>(first, n - first);
        }
    }

    /// Decides up to [`Simd::LANES`] of `n` pairs from `first` on. Lanes behind the last hold older pairs.
    #[inline(always)]
    fn decide_vector<S: Simd>(&mut self, first: usize, n: usize) {
        let mesh = self.grid.mesh();
        // Gather the corners of triangles and the rays, a pair a lane.
        let triangles: &[u32; 16] = self.triangles.indices[first..first + 16].try_into().expect("sixteen triangles");
        let slots: &[u32; 16] = self.triangles.slots[first..first + 16].try_into().expect("sixteen slots");
        let mut corners = [[[0.0; 16]; 3]; 3];
        for (corner, point) in mesh.gather_corners::<S>(triangles).into_iter().enumerate() {
            for axis in 0..3 {
                point[axis].store(&mut corners[corner][axis]);
            }
        }
        let (mut origin, mut direction) = ([[0.0; 16]; 3], [[0.0; 16]; 3]);
        for lane in 0..S::LANES {
            let ray = &self.slots[slots[lane] as usize].ray;
            for axis in 0..3 {
                origin[axis][lane] = ray.origin[axis];
                direction[axis][lane] = ray.direction[axis];
            }
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
                let slot = &mut self.slots[slots[first_lane + lane] as usize];
                let certain_t = (decision.uncertain >> lane & 1 == 0).then_some(ts[lane]);
                if let Some(t) = triangle::finish(&slot.ray, certain_t, || mesh.corners(triangle)) {
                    slot.nearest.offer(mesh, &slot.ray, triangle, t);
                }
            }
        }
    }
}
