//! Traces rays of any origins: through a tree with [`super::stream`], or with [`super::bundle`] where they go together;
//! through the paper's uniform grid with [`super::walk`].

use std::{ops::Range, slice};

use crate::{
    grid::{
        Grid, Structure,
        traced::TracedMesh,
        tree::{
            Tree,
            hierarchy::{LEAF, NONE},
        },
    },
    intersect::{
        bundle::{self, Bundles},
        descent::Descent,
        ray::{Hit, Ray},
        starts::RayStarts,
        stream::RayStream,
        walk,
    },
    simd::{Kernel, Simd},
};

/// The cost of a ray in its two parts, which the paper's figure 3 shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RayCost {
    /// Steps of the ray: in a tree nodes of the hierarchy and leaves, in a uniform grid all cells that it passes; an empty
    /// cube that it skips whole counts once.
    pub n_cells: u32,
    /// Triangles that it is tested against; one in pieces counts once for each that the ray passes.
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

    /// Some hit or none, where it does not matter which.
    #[inline(always)]
    fn any(is_hit: bool) -> Self {
        Self { triangle: if is_hit { 0 } else { u32::MAX }, ..Self::default() }
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
    /// If there are fewer `hits` than `rays`, or 2³² rays or more.
    pub fn intersect_rays(&self, rays: &[Ray], hits: &mut [Hit]) {
        self.trace::<false>(rays, |index, nearest| hits[index] = nearest.hit());
    }

    /// Whether rays hit any triangle.
    ///
    /// # Panics
    ///
    /// If there are fewer entries in `occluded` than `rays`, or 2³² rays or more.
    pub fn occluded_rays(&self, rays: &[Ray], occluded: &mut [bool]) {
        self.trace::<true>(rays, |index, nearest| occluded[index] = nearest.is_hit());
    }

    /// [`Grid::intersect_rays`] for one ray.
    pub fn intersect(&self, ray: &Ray) -> Hit {
        let mut hits = [Hit::MISS];
        self.intersect_rays(slice::from_ref(ray), &mut hits);
        hits[0]
    }

    /// [`Grid::occluded_rays`] for one ray.
    pub fn occluded(&self, ray: &Ray) -> bool {
        let mut occluded = [false];
        self.occluded_rays(slice::from_ref(ray), &mut occluded);
        occluded[0]
    }

    /// The cost of [`Grid::intersect`] for this ray.
    pub fn cost(&self, ray: &Ray) -> RayCost {
        let mut cost = RayCost::default();
        self.trace::<false>(slice::from_ref(ray), |_, nearest| cost = nearest.cost);
        cost
    }

    /// Calls `visit` with each triangle in the cells along a ray, some several times, for tests by other routines.
    pub fn for_each_candidate(&self, ray: &Ray, mut visit: impl FnMut(u32)) {
        struct EachLeaf<'a, F>(&'a Grid, &'a Tree, &'a Ray, F);
        impl<F: FnMut(u32)> Kernel for EachLeaf<'_, F> {
            type Output = ();
            #[inline(always)]
            fn run<S: Simd>(self) {
                let Self(grid, tree, ray, mut visit) = self;
                let Tree { hierarchy, extent, .. } = tree;
                let starts = RayStarts::of_far_ray(&grid.space, *extent, ray);
                let mut descent = Descent::default();
                descent.begin::<true>(&starts, 0);
                let mut entry = if starts.meeting == 1 { hierarchy.root } else { NONE };
                while entry != NONE {
                    let index = (entry & !LEAF) as usize;
                    if entry & LEAF == 0 {
                        descent.enter_node::<S, true>(&hierarchy.nodes[index]);
                    } else if let Some(node) = hierarchy.triangle_nodes.get(index) {
                        let triangles = node.children.into_iter().filter(|&triangle| triangle != NONE);
                        triangles.for_each(&mut visit);
                    } else {
                        tree.items_of(index as u32).for_each(|item| visit(tree.items.triangle(item as u32)));
                    }
                    entry = descent.next();
                }
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

    /// Calls `answer` with the index of each ray and its nearest hit, with `ANY` one of its hits, in any order.
    fn trace<const ANY: bool>(&self, rays: &[Ray], mut answer: impl FnMut(usize, Nearest)) {
        assert!(u32::try_from(rays.len()).is_ok(), "{} rays in one call", rays.len());
        let each = rays.iter().enumerate();
        match &self.structure {
            // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
            Structure::Tree(tree) => unsafe {
                if ANY && rays.len() > 1 {
                    self.instructions.call(BundlesAndStream { grid: self, tree, rays, answer });
                } else {
                    let all = 0..rays.len();
                    self.instructions.call(RayStream::<_, ANY>::new(self, tree, rays, slice::from_ref(&all), answer));
                }
            },
            Structure::Plain(grid) => each.for_each(|(index, ray)| answer(index, walk::trace::<ANY>(self, grid, ray))),
            Structure::RowDisplacement(grid) => {
                each.for_each(|(index, ray)| answer(index, walk::trace::<ANY>(self, grid, ray)));
            }
        }
    }
}

/// Hints that 16 rays will be read soon, which lie a little behind the one at `first`; they need not be there. Rays of ambient
/// occlusion take 0.96 of the time where the caller's lie in memory.
#[inline(always)]
pub(super) fn prefetch_ahead<S: Simd>(rays: &[Ray], first: usize) {
    const AHEAD: usize = 32;
    const RAYS_PER_LINE: usize = 2;
    for ray in (0..16).step_by(RAYS_PER_LINE) {
        S::prefetch(rays, first + AHEAD + ray);
    }
}

/// Rays of which any hit counts: bundles of those that go together, and a stream of all others.
struct BundlesAndStream<'a, F> {
    grid: &'a Grid,
    tree: &'a Tree,
    rays: &'a [Ray],
    answer: F,
}

impl<F: FnMut(usize, Nearest)> Kernel for BundlesAndStream<'_, F> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { grid, tree, rays, mut answer } = self;
        let mut bundles = Bundles::new(grid, tree);
        let mut runs_alone: Vec<Range<usize>> = Vec::new();
        for first in (0..rays.len()).step_by(bundle::MOST_RAYS) {
            prefetch_ahead::<S>(rays, first);
            let end = rays.len().min(first + bundle::MOST_RAYS);
            if let Some(occluded) = bundles.occluded::<S>(&rays[first..end]) {
                (first..end).for_each(|index| answer(index, Nearest::any(occluded >> (index - first) & 1 == 1)));
            } else {
                match runs_alone.last_mut() {
                    Some(run) if run.end == first => run.end = end,
                    _ => runs_alone.push(first..end),
                }
            }
        }
        RayStream::<_, true>::new(grid, tree, rays, &runs_alone, answer).run::<S>();
    }
}
