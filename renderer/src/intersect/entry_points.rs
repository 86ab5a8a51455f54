//! Where rays that begin one after the other enter a hierarchy: at the few nodes and leaves that their bounds meet, in place of
//! the root, after Reshetov, Soupikov and Hurley, "Multi-Level Ray Tracing Algorithm" (2005).
//!
//! Short rays from neighbouring samples, as those of ambient occlusion, spare a third of their steps, but must be compared with
//! all entry points, which pays for a vector of rays at a time. Those that pass none are answered at once. tests/README.md has
//! figures.

use std::ops::Range;

use crate::{
    grid::{
        cells::CellSpace,
        tree::{
            Tree,
            hierarchy::{CHILDREN, Entry, Hierarchy, HierarchyNode, LEAF, NONE},
        },
    },
    intersect::{descent::Descent, ray::Ray, rays::prefetch_ahead, starts::RayStarts},
    simd::{Simd, consecutive},
};

/// Vectors of rays in a batch: as many as spread the cost of its entry points, and few enough to lie close together.
const N_VECTORS: usize = 8;

/// Fewest rays that are worth their own entry points.
const FEWEST_RAYS: usize = 32;

/// After so many nodes whose children have no room, no other is tried: where rays are long, none has.
const MOST_FAILURES: usize = 4;

/// Entry points, and room for the children of one.
const ROOM: usize = 2 * CHILDREN;

/// Rays that begin one after the other.
pub(super) struct RayBatch {
    /// Index of the first among all rays.
    first: usize,
    /// The places in the batch of rays that may hit something, with room for a vector after the last.
    places: [u32; N_VECTORS * 16 + 16],
    /// Those of `places` whose rays have not begun.
    left: Range<usize>,
    starts: [RayStarts; N_VECTORS],
    entry_points: EntryPoints,
    /// Only where any hit counts, because the nearest is found by the order of boxes along each ray, and over triangles: over
    /// leaves, short rays take as long with them, and long ones up to a tenth longer.
    has_entry_points: bool,
    /// For each ray, a bit for each entry point that it passes.
    passed: [[u32; 16]; N_VECTORS],
}

impl RayBatch {
    pub(super) const EMPTY: Self = Self {
        first: 0,
        places: [0; N_VECTORS * 16 + 16],
        left: 0..0,
        starts: [RayStarts::EMPTY; N_VECTORS],
        entry_points: EntryPoints::EMPTY,
        has_entry_points: false,
        passed: [[0; 16]; N_VECTORS],
    };

    /// Forgets its rays.
    pub(super) fn clear(&mut self) {
        self.left = 0..0;
    }

    /// Whether it has a ray to begin with.
    #[inline(always)]
    pub(super) fn is_empty(&self) -> bool {
        self.left.is_empty()
    }

    /// Prepares the first of some rays, whose indices count from `first`. Calls `miss` with the indices of those that certainly
    /// hit nothing, which need no slot. Returns how many rays it has prepared.
    #[inline(always)]
    pub(super) fn prepare<S: Simd, const ANY: bool>(
        &mut self,
        space: &CellSpace,
        tree: &Tree,
        first: usize,
        rays: &[Ray],
        mut miss: impl FnMut(usize),
    ) -> usize {
        let n = rays.len().min(N_VECTORS * S::LANES);
        self.first = first;
        let n_vectors = n.div_ceil(S::LANES);
        for vector in 0..n_vectors {
            // Bundles have read rays of which any hit counts.
            if !ANY {
                prefetch_ahead::<S>(rays, vector * S::LANES);
            }
            self.starts[vector].prepare_rays::<S, ANY>(space, tree.extent, &rays[vector * S::LANES..]);
        }
        let Hierarchy { root, triangle_nodes, .. } = &tree.hierarchy;
        self.has_entry_points = ANY && n >= FEWEST_RAYS && root & LEAF == 0 && !triangle_nodes.is_empty();
        if self.has_entry_points {
            let bounds = RayStarts::bounds::<S>(&self.starts[..n_vectors], tree.extent);
            self.entry_points.find::<S>(&tree.hierarchy, bounds);
        }

        let mut n_left = 0;
        for vector in 0..n_vectors {
            let RayStarts { mut meeting, far, .. } = self.starts[vector];
            if self.has_entry_points {
                self.entry_points.find_passed::<S>(&self.starts[vector], &mut self.passed[vector]);
                meeting &= !S::eq_mask(&self.passed[vector], 0);
            }
            let place = vector * S::LANES;
            let of_rays = u32::MAX >> (32 - S::LANES.min(n - place));
            let left = (meeting | far) & of_rays;
            n_left += S::load_bits(&consecutive(place as u32)).compress_bits_to(left, &mut self.places[n_left..]);
            let mut missing = of_rays & !left;
            while missing != 0 {
                miss(first + place + missing.trailing_zeros() as usize);
                missing &= missing - 1;
            }
        }
        self.left = 0..n_left;
        n
    }

    /// Begins with the next ray, of which there is one. Returns its index and what it enters first.
    #[inline(always)]
    pub(super) fn begin<S: Simd, const ANY: bool>(
        &mut self,
        space: &CellSpace,
        tree: &Tree,
        rays: &[Ray],
        descent: &mut Descent,
    ) -> (usize, Entry) {
        let place = self.places[self.left.start % (N_VECTORS * 16)] as usize;
        self.left.start += 1;
        let ray_idx = self.first + place;
        let (vector, lane) = (place / S::LANES % N_VECTORS, place % S::LANES);
        let starts = &self.starts[vector];
        if starts.far >> lane & 1 == 1 {
            let start = RayStarts::of_far_ray(space, tree.extent, &rays[ray_idx]);
            descent.begin::<ANY>(&start, 0);
            return (ray_idx, if start.meeting == 1 { tree.hierarchy.root } else { NONE });
        }
        descent.begin::<ANY>(starts, lane);
        let entry = if ANY && self.has_entry_points {
            descent.enter::<S>(&self.entry_points.entries, self.passed[vector][lane]);
            descent.next()
        } else {
            tree.hierarchy.root
        };
        (ray_idx, entry)
    }
}

/// Up to [`CHILDREN`] nodes and leaves that cover what bounds meet.
struct EntryPoints {
    /// Their boxes, as in [`HierarchyNode`].
    sides: [[f32; CHILDREN]; 6],
    entries: [Entry; CHILDREN],
    n: usize,
}

impl EntryPoints {
    const EMPTY: Self = Self { sides: [[0.0; CHILDREN]; 6], entries: [NONE; CHILDREN], n: 0 };

    /// Finds those for rays within bounds, in finest cells.
    #[inline(always)]
    fn find<S: Simd>(&mut self, hierarchy: &Hierarchy, bounds: [[f32; 2]; 3]) {
        // Replace nodes by their children within the bounds while there is room.
        let mut boxes = Boxes { sides: [[0.0; ROOM]; 6], entries: [NONE; ROOM], n: 0 };
        boxes.push_within::<S>(&hierarchy.nodes[hierarchy.root as usize], &bounds);
        let (mut index, mut n_failures) = (0, 0);
        while index < boxes.n && n_failures < MOST_FAILURES {
            let (entry, n) = (boxes.entries[index % ROOM], boxes.n);
            if entry & LEAF != 0 {
                index += 1;
                continue;
            }
            boxes.push_within::<S>(&hierarchy.nodes[entry as usize], &bounds);
            if boxes.n <= CHILDREN + 1 {
                boxes.remove(index);
            } else {
                boxes.n = n;
                index += 1;
                n_failures += 1;
            }
        }

        // Order them by the distance from the centre of the bounds. The last is entered first: what lies near a surface seldom
        // hides it.
        let order = boxes.order(bounds);
        self.n = boxes.n.min(CHILDREN);
        for (place, &index) in order[..self.n].iter().enumerate() {
            for side in 0..6 {
                self.sides[side][place] = boxes.sides[side][index];
            }
            self.entries[place] = boxes.entries[index];
        }
    }

    /// Finds which of them rays pass, a bit for each.
    #[inline(always)]
    fn find_passed<S: Simd>(&self, starts: &RayStarts, passed: &mut [u32; 16]) {
        let mut of_lanes = S::splat(0.0);
        let [mut step, mut near, mut far] = [[of_lanes; 3]; 3];
        for axis in 0..3 {
            step[axis] = S::load(&starts.s_step[axis]);
            near[axis] = S::load(&starts.s_near[axis]);
            far[axis] = S::load(&starts.s_far[axis]);
        }
        let (s_start, s_end) = (S::load(&starts.s_start), S::load(&starts.s_end));
        for index in 0..self.n.min(CHILDREN) {
            let (mut s_near, mut s_far) = (s_start, s_end);
            for axis in 0..3 {
                let (low, high) = (S::splat(self.sides[2 * axis][index]), S::splat(self.sides[2 * axis + 1][index]));
                let (of_low, of_high) = (low.mul_add(step[axis], near[axis]), high.mul_add(step[axis], near[axis]));
                s_near = s_near.max(of_low.min(of_high));
                let (of_low, of_high) = (low.mul_add(step[axis], far[axis]), high.mul_add(step[axis], far[axis]));
                s_far = s_far.min(of_low.max(of_high));
            }
            let with_bit = of_lanes.or(S::splat(f32::from_bits(1 << index)));
            of_lanes = S::select(s_near.le(s_far), with_bit, of_lanes);
        }
        of_lanes.store_bits(passed);
    }
}

/// Nodes and leaves with their boxes, and room for the children of another node.
struct Boxes {
    sides: [[f32; ROOM]; 6],
    entries: [Entry; ROOM],
    n: usize,
}

impl Boxes {
    /// Appends the children of a node that bounds meet.
    #[inline(always)]
    fn push_within<S: Simd>(&mut self, node: &HierarchyNode, bounds: &[[f32; 2]; 3]) {
        for first in (0..CHILDREN).step_by(S::LANES) {
            let (mut within, mut rows) = (u32::MAX, [S::splat(0.0); 6]);
            for axis in 0..3 {
                let [least, greatest] = bounds[axis];
                let (low, high) =
                    (S::load(&node.sides[2 * axis][first..]), S::load(&node.sides[2 * axis + 1][first..]));
                within &= low.le(S::splat(greatest)) & S::splat(least).le(high);
                (rows[2 * axis], rows[2 * axis + 1]) = (low, high);
            }
            for side in 0..6 {
                rows[side].compress_to(within, &mut self.sides[side][self.n..]);
            }
            self.n += S::load_bits(&node.children[first..]).compress_bits_to(within, &mut self.entries[self.n..]);
        }
    }

    /// Removes the box at an index, and puts the last one there.
    #[inline(always)]
    fn remove(&mut self, index: usize) {
        self.n -= 1;
        for side in 0..6 {
            self.sides[side][index] = self.sides[side][self.n];
        }
        self.entries[index] = self.entries[self.n];
    }

    /// The indices of up to [`CHILDREN`] boxes, from the nearest to the centre of bounds to the farthest.
    #[inline(always)]
    fn order(&self, bounds: [[f32; 2]; 3]) -> [usize; CHILDREN] {
        let mut distances = [0.0; CHILDREN];
        for axis in 0..3 {
            let [least, greatest] = bounds[axis];
            for index in 0..CHILDREN {
                let from_centre = self.sides[2 * axis][index] + self.sides[2 * axis + 1][index] - (least + greatest);
                distances[index] += from_centre * from_centre;
            }
        }
        let mut order = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
        order[..self.n].sort_unstable_by(|&a, &b| distances[a].total_cmp(&distances[b]));
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        grid::{Grid, GridOptions, Structure},
        model::statue,
        simd::Portable,
    };

    /// The triangles below an entry of a hierarchy over triangles.
    fn triangles_below(hierarchy: &Hierarchy, entry: Entry, triangles: &mut Vec<u32>) {
        let index = (entry & !LEAF) as usize;
        if entry & LEAF == 0 {
            let children = hierarchy.nodes[index].children.into_iter().filter(|&child| child != NONE);
            children.for_each(|child| triangles_below(hierarchy, child, triangles));
        } else {
            triangles.extend(hierarchy.triangle_nodes[index].children.iter().filter(|&&triangle| triangle != NONE));
        }
    }

    #[test]
    fn all_triangles_within_bounds_lie_below_few_entry_points() {
        let grid = Grid::build(statue::generate(20_000, &|_| ()), &GridOptions::default(), &|_| ());
        let (mesh, Structure::Tree(Tree { hierarchy, .. })) = (grid.mesh(), &grid.structure) else { panic!("no tree") };
        let to_cells = |corner: [f32; 3]| grid.space.point_to_cells(glam::DVec3::from(corner.map(f64::from))).as_vec3();
        for around in (0..mesh.n_triangles() as u32).step_by(501) {
            for (reach, most) in [(0.0, 16 * CHILDREN), (500.0, mesh.n_triangles() / 4), (1e9, mesh.n_triangles())] {
                let corner = to_cells(mesh.corners(around)[0]);
                let (least, greatest) = (corner - reach, corner + reach);
                let mut entry_points = EntryPoints::EMPTY;
                entry_points.find::<Portable>(hierarchy, [0, 1, 2].map(|axis| [least[axis], greatest[axis]]));
                let mut found = Vec::new();
                for &entry in &entry_points.entries[..entry_points.n] {
                    triangles_below(hierarchy, entry, &mut found);
                }
                // Bounds may meet a triangle's box, and none of its pieces.
                let is_met = |triangle: &u32| {
                    let [a, b, c] = mesh.corners(*triangle).map(to_cells);
                    let points = [a, b, c, (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0, (a + b + c) / 3.0];
                    points.iter().any(|point| point.cmple(greatest).all() && least.cmple(*point).all())
                };
                let met: Vec<_> = (0..mesh.n_triangles() as u32).filter(is_met).collect();
                found.sort_unstable();
                found.dedup();
                assert!(met.iter().all(|triangle| found.binary_search(triangle).is_ok()), "{around} {reach}");
                assert!(found.len() <= most, "{} for {} within {reach}", found.len(), met.len());
            }
        }
    }
}
