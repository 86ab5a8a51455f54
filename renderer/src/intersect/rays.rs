//! Traces rays that share nothing, each alone: through a tree with [`super::descent`], through the paper's uniform grid with
//! [`super::walk`].

use crate::{
    grid::{
        Grid, Structure,
        traced::TracedMesh,
        tree::{
            Tree,
            boxes::{BoxBytes, GROUP},
        },
    },
    intersect::{
        descent::{self, LeafSlabs, LeafVisitor},
        ray::{Hit, Ray},
        triangle, walk,
    },
    simd::{Kernel, Real, Simd},
};

/// The cost of a ray in its two parts, which the paper's figure 3 shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RayCost {
    /// Cells that the ray passes: in a tree bricks and occupied cells in them, in a uniform grid all cells; an empty cube
    /// that it skips whole counts once.
    pub n_cells: u32,
    /// Triangles that it is tested against.
    pub n_tests: u32,
}

/// The nearest hit so far, with its t still in `f64`.
#[derive(Clone, Copy)]
pub(super) struct Nearest {
    pub(super) triangle: u32,
    /// Infinite without a hit.
    pub(super) t: f64,
    pub(super) cost: RayCost,
}

impl Default for Nearest {
    fn default() -> Self {
        Self { triangle: u32::MAX, t: f64::INFINITY, cost: RayCost::default() }
    }
}

impl Nearest {
    #[inline(always)]
    pub(super) fn is_hit(&self) -> bool {
        self.triangle != u32::MAX
    }

    /// Takes a hit if it is nearer, and the ray does not pass it; of several at the same t that of the first triangle in the
    /// file.
    #[inline(always)]
    pub(super) fn offer(&mut self, mesh: &TracedMesh, ray: &Ray, triangle: u32, t: f64) {
        let is_nearer = t < self.t || (t == self.t && mesh.file_index(triangle) < mesh.file_index(self.triangle));
        if is_nearer && !(mesh.has_masks() && mesh.is_passed(triangle, ray)) {
            (self.triangle, self.t) = (triangle, t);
        }
    }

    fn hit(&self) -> Hit {
        if self.is_hit() { Hit { triangle: self.triangle, t: self.t as f32 } } else { Hit::MISS }
    }
}

impl Grid {
    /// The nearest hits of rays; of several at the same t that of the first triangle in the file.
    ///
    /// # Panics
    ///
    /// If there are fewer `hits` than `rays`.
    pub fn intersect_rays(&self, rays: &[Ray], hits: &mut [Hit]) {
        self.trace::<false>(rays, |index, nearest| hits[index] = nearest.hit());
    }

    /// Whether rays hit any triangle.
    ///
    /// # Panics
    ///
    /// If there are fewer entries in `occluded` than `rays`.
    pub fn occluded_rays(&self, rays: &[Ray], occluded: &mut [bool]) {
        self.trace::<true>(rays, |index, nearest| occluded[index] = nearest.is_hit());
    }

    /// [`Grid::intersect_rays`] for one ray.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        let mut hits = [Hit::MISS];
        self.intersect_rays(std::slice::from_ref(ray), &mut hits);
        hits[0]
    }

    /// [`Grid::occluded_rays`] for one ray.
    pub fn occluded(&self, ray: &Ray) -> bool {
        let mut occluded = [false];
        self.occluded_rays(std::slice::from_ref(ray), &mut occluded);
        occluded[0]
    }

    /// The cost of [`Grid::intersect`] for this ray.
    pub fn cost(&self, ray: &Ray) -> RayCost {
        let mut cost = RayCost::default();
        self.trace::<false>(std::slice::from_ref(ray), |_, nearest| cost = nearest.cost);
        cost
    }

    /// Calls `visit` with each triangle in the cells along a ray, some several times, for tests by other routines.
    pub fn for_each_candidate(&self, ray: &Ray, mut visit: impl FnMut(u32)) {
        struct EachLeaf<'a, F>(&'a Grid, &'a Tree, &'a Ray, F);
        impl<F: FnMut(u32)> Kernel for EachLeaf<'_, F> {
            type Output = ();
            #[inline(always)]
            fn run<S: Simd>(self) {
                let Self(grid, tree, ray, visit) = self;
                descent::descend::<S>(&grid.space, tree, ray, &mut Candidates(visit));
            }
        }
        let mut visit_cell = |cell: walk::CellVisit<'_>| {
            cell.triangles.iter().copied().for_each(&mut visit);
            false
        };
        match &self.structure {
            // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
            Structure::Tree(tree) => unsafe { self.instructions.call(EachLeaf(self, tree, ray, visit)) },
            Structure::Plain(grid) => _ = walk::walk(grid, &self.space, ray, visit_cell),
            Structure::RowDisplacement(grid) => _ = walk::walk(grid, &self.space, ray, &mut visit_cell),
        }
    }

    /// Calls `answer` with the index of each ray and its nearest hit, with `ANY` one of its hits.
    fn trace<const ANY: bool>(&self, rays: &[Ray], mut answer: impl FnMut(usize, Nearest)) {
        struct TraceAll<'a, F, const ANY: bool>(&'a Grid, &'a Tree, &'a [Ray], F);
        impl<F: FnMut(usize, Nearest), const ANY: bool> Kernel for TraceAll<'_, F, ANY> {
            type Output = ();
            #[inline(always)]
            fn run<S: Simd>(self) {
                let Self(grid, tree, rays, mut answer) = self;
                for (index, ray) in rays.iter().enumerate() {
                    let mut tester = TriangleTester::<ANY>::new(&grid.mesh, ray);
                    let n_cells = descent::descend::<S>(&grid.space, tree, ray, &mut tester);
                    tester.nearest.cost.n_cells = n_cells;
                    answer(index, tester.nearest);
                }
            }
        }
        let each = rays.iter().enumerate();
        match &self.structure {
            // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
            Structure::Tree(tree) => unsafe {
                self.instructions.call(TraceAll::<_, ANY>(self, tree, rays, answer));
            },
            Structure::Plain(grid) => each.for_each(|(index, ray)| answer(index, walk::trace::<ANY>(self, grid, ray))),
            Structure::RowDisplacement(grid) => {
                each.for_each(|(index, ray)| answer(index, walk::trace::<ANY>(self, grid, ray)));
            }
        }
    }
}

/// Collects the triangles of all leaves.
struct Candidates<F>(F);

impl<F: FnMut(u32)> LeafVisitor for Candidates<F> {
    #[inline(always)]
    fn visit<S: Simd>(&mut self, tree: &Tree, leaf: u32, _: &LeafSlabs, _: [f32; 2]) {
        tree.references[tree.references_of(leaf)].iter().copied().for_each(&mut self.0);
    }

    fn t_end(&self) -> f64 {
        f64::INFINITY
    }
}

/// Tests the triangles of leaves, nearest leaf first.
struct TriangleTester<'a, const ANY: bool> {
    mesh: &'a TracedMesh,
    ray: &'a Ray,
    nearest: Nearest,
    /// Triangles whose boxes the ray passes.
    waiting: [u32; 8],
    n_waiting: usize,
}

impl<const ANY: bool> LeafVisitor for TriangleTester<'_, ANY> {
    #[inline(always)]
    fn visit<S: Simd>(&mut self, tree: &Tree, leaf: u32, slabs: &LeafSlabs, s_range: [f32; 2]) {
        let references = tree.references_of(leaf);
        let triangles = &tree.references[references.clone()];
        let boxes = tree.boxes.of_leaf(references.clone());
        if triangles.len() <= GROUP {
            self.visit_group::<S>(slabs, s_range, boxes, 0, triangles);
            return self.settle::<S>();
        }

        // Test the bounds of the groups, then the triangles of those that the ray passes.
        let groups = tree.boxes.of_groups(leaf, references);
        let mut first_group = 0;
        while first_group < groups.n() {
            let mut left = slabs.passed::<S>(groups, first_group, s_range);
            while left != 0 {
                let first = (first_group + left.trailing_zeros() as usize) * GROUP;
                left &= left - 1;
                let end = (first + GROUP).min(triangles.len());
                self.visit_group::<S>(slabs, s_range, boxes, first, &triangles[first..end]);
            }
            first_group += S::LANES;
        }
        self.settle::<S>();
    }

    #[inline(always)]
    fn t_end(&self) -> f64 {
        if ANY && self.nearest.is_hit() { f64::NEG_INFINITY } else { self.nearest.t }
    }
}

impl<'a, const ANY: bool> TriangleTester<'a, ANY> {
    #[inline(always)]
    fn new(mesh: &'a TracedMesh, ray: &'a Ray) -> Self {
        Self { mesh, ray, nearest: Nearest::default(), waiting: [0; 8], n_waiting: 0 }
    }

    /// Collects those of up to [`GROUP`] triangles whose boxes the ray passes: the boxes from number `first` on.
    #[inline(always)]
    fn visit_group<S: Simd>(
        &mut self,
        slabs: &LeafSlabs,
        s_range: [f32; 2],
        boxes: BoxBytes<'_>,
        first: usize,
        triangles: &[u32],
    ) {
        let mut offset = 0;
        while offset < triangles.len() {
            let mut left = slabs.passed::<S>(boxes, first + offset, s_range);
            while left != 0 {
                self.waiting[self.n_waiting] = triangles[offset + left.trailing_zeros() as usize];
                self.n_waiting += 1;
                left &= left - 1;
                if self.n_waiting == self.waiting.len() {
                    self.settle::<S>();
                }
            }
            offset += S::LANES;
        }
    }

    /// Decides all triangles that wait.
    #[inline(always)]
    fn settle<S: Simd>(&mut self) {
        let n = std::mem::take(&mut self.n_waiting);
        let mut first = 0;
        while first < n {
            let end = (first + S::Double::LANES).min(n);
            self.test::<S::Double>(first, end);
            first = end;
        }
    }

    /// Decides the waiting triangles from `first` to `end`, one a lane.
    #[inline(always)]
    fn test<R: Real>(&mut self, first: usize, end: usize) {
        self.nearest.cost.n_tests += (end - first) as u32;
        let mut corners = [[[0.0; 8]; 3]; 3];
        for lane in first..end {
            for (corner, point) in self.mesh.corners(self.waiting[lane]).into_iter().enumerate() {
                for axis in 0..3 {
                    corners[corner][axis][lane - first] = point[axis];
                }
            }
        }
        let decision = triangle::decide_lanes::<R>(self.ray, &corners);
        let mut ts = [0.0; 8];
        decision.t.store(&mut ts);
        let mut left = !decision.certain_miss & ((1 << (end - first)) - 1);
        while left != 0 {
            let lane = left.trailing_zeros() as usize;
            left &= left - 1;
            let triangle = self.waiting[first + lane];
            let certain_t = (decision.uncertain >> lane & 1 == 0).then_some(ts[lane]);
            if let Some(t) = triangle::finish(self.ray, certain_t, || self.mesh.corners(triangle)) {
                self.nearest.offer(self.mesh, self.ray, triangle, t);
            }
        }
    }
}
