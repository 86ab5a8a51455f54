//! Rays that lie close together and lead the same way, as to a sun: one walk down a hierarchy for all.
//!
//! A [`shaft`] around the rays is compared with the 16 boxes of a node at once, or in a leaf with those of 16 groups, then with
//! those of a group; each box that it passes is compared with all rays, one a lane, and so are [`triangles`].
//!
//! Axes are the major axis k, along which all rays advance, and u and v across it, mirrored so that rays go up along each.
//! Depths count along k.

mod shaft;
mod triangles;

use crate::{
    grid::{
        Grid,
        tree::{
            Tree,
            boxes::{GROUP, PlacedGroups},
            hierarchy::{self, CHILDREN, Hierarchy, LEAF, NONE, SLOT_BITS},
        },
    },
    intersect::ray::{Ray, major_axis},
    simd::{Simd, consecutive},
};
use shaft::{BoxRows, Shaft};
use triangles::Pairs;

/// Most rays of a bundle.
pub(super) const MOST_RAYS: usize = 16;

/// Fewest rays that go together.
const FEWEST_RAYS: usize = 8;

/// Most difference between slopes of rays that go together.
const WIDEST: f32 = 1.0 / 16.0;

/// Typical triangles that cover the section of the widest shaft. With fewer, rays lose close to scans, and with more, where scans
/// are seen whole; tests/README.md has figures.
const TRIANGLES_IN_SECTION: f32 = 64.0;

/// A bundle that was compared with more boxes than these has taken longer than its rays would have alone, as where triangles near
/// it are far smaller than typical ones.
const MOST_BOXES: u32 = 512;

/// After such a bundle, the rays of so many more go alone: they lie close to it. tests/README.md has figures.
const N_SPARED: u32 = 15;

/// The greatest slope: along the major axis of one ray of a bundle, others may be a little steeper than 1.
const STEEPEST: f32 = 1.125;

/// The greatest inverse of a slope: over a grid, smaller slopes move a ray by less than the margin.
const GREATEST_INVERSE: f32 = 1e12;

/// Farthest distances within a bundle, in extents of the grid: single precision bounds them well.
const FARTHEST: f64 = 64.0;

/// Rounding error of a shaft, relative to the farthest distance within it: fifteen roundings, and seventeen to spare.
const SHAFT_MARGIN: f64 = 32.0 / (1u32 << 24) as f64;

/// Rounding error of boxes within a leaf's cube, in finest cells: six roundings of at most a brick's 1,024 cells, and ten to
/// spare.
const CUBE_MARGIN: f64 = 1.0 / 1024.0;

/// The rays of a bundle, one a lane.
#[derive(Default)]
#[repr(C, align(64))]
struct RayLanes {
    /// In world units, by axis.
    origins: [[f32; MOST_RAYS]; 3],
    /// u and v over a unit of depth.
    slopes: [[f32; MOST_RAYS]; 2],
    /// The interval in depths from the ray's origin, in world units.
    intervals: [[f32; MOST_RAYS]; 2],
    /// The interval in the shaft's depths.
    ends: [[f32; MOST_RAYS]; 2],
    /// Depth in the shaft over a unit of u and v, and depth where u and v are 0.
    inverses: [[f32; MOST_RAYS]; 2],
    bases: [[f32; MOST_RAYS]; 2],
}

/// Rays that follow each other, of which any hit counts, in bundles where they go together.
pub(super) struct Bundles<'a> {
    grid: &'a Grid,
    tree: &'a Tree,
    /// Largest section of a shaft, in squares of finest cells: where triangles are finer, rays meet different ones, and are
    /// faster alone.
    widest_section: f32,
    /// A triangle that hid rays of the last bundle, if none of them was left. It is tested first, because it may well hide those
    /// of the next (Haines and Greenberg, "The Light Buffer: A Shadow-Testing Accelerator", 1986).
    occluder: Option<u32>,
    /// Whether all rays of the last bundle were hidden; true before the first.
    beside_hidden: bool,
    /// The bundles to come whose rays go alone.
    n_spared: u32,
}

impl<'a> Bundles<'a> {
    pub(super) fn new(grid: &'a Grid, tree: &'a Tree) -> Self {
        let Hierarchy { triangle_nodes, typical_area, .. } = &tree.hierarchy;
        let [n_items, n_leaves] = [tree.n_items(), tree.leaf_cubes.len()].map(|n| n.max(1) as f32);
        let items_per_box = if triangle_nodes.is_empty() { n_items / n_leaves } else { 1.0 };
        let widest_section = TRIANGLES_IN_SECTION * typical_area / items_per_box;
        Self { grid, tree, widest_section, occluder: None, beside_hidden: true, n_spared: 0 }
    }

    /// A bit for each of up to [`MOST_RAYS`] rays that hits something; `None` if they do not go together.
    #[inline(always)]
    pub(super) fn occluded<S: Simd>(&mut self, rays: &[Ray]) -> Option<u32> {
        if self.n_spared > 0 {
            self.n_spared -= 1;
            return None;
        }
        let axis = major_axis(rays.first()?.direction.to_array());
        let axes = [axis, (axis + 1) % 3, (axis + 2) % 3];
        if rays.len() < FEWEST_RAYS || !self.may_go_together(rays, axes) {
            return None;
        }
        let left = u32::MAX >> (32 - rays.len());
        let (lanes, shaft, pairs) = (RayLanes::default(), Shaft::default(), Pairs::NONE);
        let Self { grid, tree, widest_section, occluder, beside_hidden, .. } = *self;
        let mut bundle = Bundle {
            grid,
            tree,
            rays,
            axes,
            lanes,
            shaft,
            pairs,
            left,
            occluded: 0,
            occluder: None,
            beside_hidden,
            n_boxes: 0,
        };
        if !bundle.bound::<S>() || bundle.shaft.section(tree.extent) > widest_section {
            return None;
        }
        if let Some(triangle) = occluder {
            bundle.test_triangle::<S>(triangle, bundle.left);
        }
        if tree.hierarchy.triangle_nodes.is_empty() {
            bundle.trace::<S, true>();
        } else {
            bundle.trace::<S, false>();
        }
        self.n_spared = if bundle.n_boxes > MOST_BOXES { N_SPARED } else { 0 };
        self.beside_hidden = bundle.left == 0;
        self.occluder = bundle.occluder.filter(|_| bundle.left == 0);
        Some(bundle.occluded)
    }

    /// Whether rays may lie in a shaft that is not too wide. Most have nothing to do with each other, which the last one tells:
    /// it is seldom farther from the first than three times the root of the section.
    #[inline(always)]
    fn may_go_together(&self, rays: &[Ray], [k, u, v]: [usize; 3]) -> bool {
        let (first, last) = (&rays[0], &rays[rays.len() - 1]);
        let from_first = last.origin - first.origin;
        let (along_first, along_last) = (first.direction[k], last.direction[k]);
        let mut distance = 0.0;
        for across in [u, v] {
            // Compare slopes without divisions, which most rays would do for nothing.
            let difference = first.direction[across] * along_last - last.direction[across] * along_first;
            let are_parallel = difference.abs() <= WIDEST * (along_first * along_last);
            if !are_parallel {
                return false;
            }
            distance += (from_first[across] - from_first[k] * (first.direction[across] / along_first)).powi(2);
        }
        distance * (self.grid.space.cells_per_unit as f32).powi(2) <= 9.0 * self.widest_section
    }
}

/// Rays that go together, of which any hit counts.
struct Bundle<'a> {
    grid: &'a Grid,
    tree: &'a Tree,
    rays: &'a [Ray],
    axes: [usize; 3],
    lanes: RayLanes,
    shaft: Shaft,
    pairs: Pairs,
    /// A bit for each ray that may still hit something.
    left: u32,
    /// A bit for each ray that hits something.
    occluded: u32,
    /// The last triangle that some of them hit.
    occluder: Option<u32>,
    /// As in [`Bundles`].
    beside_hidden: bool,
    /// Boxes that all rays were compared with, but for those of a leaf's groups.
    n_boxes: u32,
}

impl Bundle<'_> {
    /// Prepares all rays and the shaft. Returns false if the rays do not go together.
    #[inline(always)]
    fn bound<S: Simd>(&mut self) -> bool {
        // Put the rays into lanes; those behind the last repeat it.
        let RayLanes { origins, slopes, intervals, .. } = &mut self.lanes;
        let [k, u, v] = self.axes;
        let sign = 1f32.copysign(self.rays[0].direction[k]);
        let (mut along, rows): (_, &[[f32; 8]]) = ([0.0; MOST_RAYS], bytemuck::cast_slice(self.rays));
        for lane in (0..MOST_RAYS).step_by(S::LANES) {
            let columns = S::gather_columns(rows, &consecutive(lane as u32));
            for axis in 0..3 {
                columns[self.axes[axis]].store(&mut origins[axis][lane..]);
            }
            columns[3 + k].mul(S::splat(sign)).store(&mut along[lane..]);
            columns[3 + u].store(&mut slopes[0][lane..]);
            columns[3 + v].store(&mut slopes[1][lane..]);
            columns[6].store(&mut intervals[0][lane..]);
            columns[7].store(&mut intervals[1][lane..]);
        }

        // Compute slopes. Rays with an empty interval miss; those that are not finite go alone.
        let (lowest, highest) = (S::splat(f32::INFINITY), S::splat(f32::NEG_INFINITY));
        let mut slope_bounds = [[lowest, highest]; 2];
        let all = ((1u64 << S::LANES) - 1) as u32;
        let mut sound = all;
        for lane in (0..MOST_RAYS).step_by(S::LANES) {
            let along = S::load(&along[lane..]);
            sound &= S::splat(f32::MIN_POSITIVE).le(along) & along.le(S::splat(f32::MAX));
            for across in 0..2 {
                let slope = S::load(&slopes[across][lane..]).div(along);
                sound &= slope.abs().le(S::splat(STEEPEST));
                slope_bounds[across] = [slope.min(slope_bounds[across][0]), slope.max(slope_bounds[across][1])];
                slope.store(&mut slopes[across][lane..]);
            }
            let (t_min, t_max) = (S::load(&intervals[0][lane..]), S::load(&intervals[1][lane..]));
            self.left &= !((!t_min.le(t_max) & all) << lane);
            t_min.mul(along).store(&mut intervals[0][lane..]);
            t_max.mul(along).store(&mut intervals[1][lane..]);
        }

        // Mirror the axes along which the rays go down; all must go the same way.
        let mut signs = [sign, 1.0, 1.0];
        for (across, [low, high]) in reduce(slope_bounds).into_iter().enumerate() {
            if high <= 0.0 {
                signs[1 + across] = -1.0;
            }
            if sound != all || high - low > WIDEST || (low < 0.0 && high > 0.0) {
                return false;
            }
            self.shaft.slopes[across] = if high <= 0.0 { [-high, -low] } else { [low, high] };
        }

        // Find where the first ray begins, and the last ends.
        let first = [origins[0][0], origins[1][0], origins[2][0]];
        let (mut start, mut end) = (lowest, highest);
        let mut origin_bounds = [[lowest, highest]; 3];
        for lane in (0..MOST_RAYS).step_by(S::LANES) {
            for axis in 0..3 {
                let origin = S::load(&origins[axis][lane..]);
                sound &= origin.abs().le(S::splat(f32::MAX));
                origin_bounds[axis] = [origin.min(origin_bounds[axis][0]), origin.max(origin_bounds[axis][1])];
            }
            let from_first = S::load(&origins[0][lane..]).sub(S::splat(first[0])).mul(S::splat(sign));
            start = from_first.add(S::load(&intervals[0][lane..])).min(start);
            end = from_first.add(S::load(&intervals[1][lane..])).max(end);
        }
        let (start, end) = (start.reduce_min(), end.reduce_max());
        if sound != all || !self.set_margins(first, signs, reduce(origin_bounds), start, end) {
            return false;
        }

        // Move the rays to the shaft's depth 0, and convert them to finest cells.
        let RayLanes { origins, slopes, intervals, ends, inverses, bases } = &mut self.lanes;
        let cells_per_unit = S::splat(self.grid.space.cells_per_unit as f32);
        let mut starts = [[lowest, highest]; 2];
        for lane in (0..MOST_RAYS).step_by(S::LANES) {
            let to_start =
                S::load(&origins[0][lane..]).sub(S::splat(first[0])).mul(S::splat(-sign)).add(S::splat(start));
            for end in 0..2 {
                let from_start = S::load(&intervals[end][lane..]).sub(to_start);
                from_start.mul(cells_per_unit).store(&mut ends[end][lane..]);
            }
            for across in 0..2 {
                let slope = S::load(&slopes[across][lane..]).abs();
                let from_first = S::load(&origins[1 + across][lane..]).sub(S::splat(first[1 + across]));
                let at_start = slope.mul_add(to_start, from_first.mul(S::splat(signs[1 + across]))).mul(cells_per_unit);
                starts[across] = [at_start.min(starts[across][0]), at_start.max(starts[across][1])];
                let inverse = S::splat(1.0).div(slope).min(S::splat(GREATEST_INVERSE));
                inverse.store(&mut inverses[across][lane..]);
                S::splat(0.0).sub(at_start.mul(inverse)).store(&mut bases[across][lane..]);
                slope.store(&mut slopes[across][lane..]);
            }
            for axis in 0..3 {
                let origin = S::load(&origins[axis][lane..]).mul(S::splat(signs[axis]));
                origin.store(&mut origins[axis][lane..]);
            }
        }
        self.shaft.starts = reduce(starts);
        true
    }

    /// Sets the shaft's sides and margins, for rays within bounds in world units. Returns false where they are too large.
    #[inline(always)]
    fn set_margins(&mut self, first: [f32; 3], signs: [f32; 3], origins: [[f32; 2]; 3], start: f32, end: f32) -> bool {
        let space = &self.grid.space;
        let extent = f64::from(self.tree.extent.into_iter().max().unwrap_or(1));
        let in_cells = |length: f32| f64::from(length) * space.cells_per_unit;
        let mut farthest = extent + in_cells(start).abs();
        let mut first_in_cells = [0.0; 3];
        for local_axis in 0..3 {
            let (axis, [low, high]) = (self.axes[local_axis], origins[local_axis]);
            let from_low = f64::from(first[local_axis]) - f64::from(space.origin[axis]);
            first_in_cells[local_axis] = from_low * space.cells_per_unit * f64::from(signs[local_axis]);
            farthest += first_in_cells[local_axis].abs() + in_cells(high - low);
        }
        let margin = farthest * SHAFT_MARGIN + CUBE_MARGIN;
        let shaft = &mut self.shaft;
        first_in_cells[0] += in_cells(start);
        for local_axis in 0..3 {
            let axis = self.axes[local_axis];
            let is_up = signs[local_axis] > 0.0;
            let near = 2 * axis + usize::from(!is_up);
            (shaft.sides[2 * local_axis], shaft.sides[2 * local_axis + 1]) = (near, near ^ 1);
            shaft.bases[2 * local_axis] = (-first_in_cells[local_axis] - margin) as f32;
            shaft.bases[2 * local_axis + 1] = (-first_in_cells[local_axis] + margin) as f32;
            shaft.nearest |= if is_up { 0 } else { SLOT_BITS[axis] as usize };
        }
        shaft.signs = signs;
        shaft.end = (in_cells(end) - in_cells(start)) as f32;
        farthest <= FARTHEST * extent
    }

    /// Finds the rays that hit something, from the farthest boxes to the nearest, because what lies near a surface seldom hides
    /// it; beside hidden bundles the largest box is first.
    #[inline(always)]
    fn trace<S: Simd, const OVER_LEAVES: bool>(&mut self) {
        const N_STACK: usize = ((CHILDREN - 1) * hierarchy::LEVELS + 2).next_power_of_two();
        let Hierarchy { root, nodes, triangle_nodes, .. } = &self.tree.hierarchy;
        // Each entry has a bit for each ray that passes its box; others may have occluded these rays when it is taken.
        let (mut stack, mut n_stack) = ([(NONE, 0); N_STACK], 2);
        stack[1] = (*root, self.left);
        let (mut rows, mut groups) = (BoxRows::default(), PlacedGroups::NONE);
        loop {
            n_stack -= 1;
            let (entry, rays) = stack[n_stack % N_STACK];
            if entry == NONE || self.left == 0 {
                break;
            }
            if rays & self.left == 0 {
                continue;
            }
            let index = (entry & !LEAF) as usize;
            if entry & LEAF != 0 {
                if OVER_LEAVES {
                    self.visit_leaf::<S>(index as u32, &mut groups, &mut rows);
                } else {
                    let node = &triangle_nodes[index];
                    let passed = self.shaft.passed_children::<S>(node, &mut rows);
                    self.visit_boxes::<S, false>(&rows, passed, self.shaft.nearest, &node.children);
                }
                // Beside hidden bundles a few triangles may hide all rays, which ends the walk.
                if self.beside_hidden {
                    self.test_waiting::<S>();
                }
                continue;
            }
            let node = &nodes[index];
            let passed = self.shaft.passed_children::<S>(node, &mut rows);
            // Beside others that are hidden, the largest box is entered first: it may hold a triangle that hides the next bundles
            // too. Elsewhere finding it took up to 8 % of the time.
            let largest = if self.beside_hidden { self.shaft.largest::<S>(&rows, passed) } else { 0 };
            self.n_boxes += passed.count_ones();
            let n_before = n_stack;
            for mut passed in [passed & !largest, largest] {
                while passed != 0 {
                    let slot = (passed.trailing_zeros() as usize ^ self.shaft.nearest) % CHILDREN;
                    passed &= passed - 1;
                    // Without a branch: nobody can tell which boxes of the shaft rays pass.
                    let rays = self.passing::<S>(&rows.0, slot);
                    stack[n_stack % N_STACK] = (node.children[slot], rays);
                    n_stack += usize::from(rays != 0);
                }
            }
            for &(child, _) in &stack[n_before % N_STACK..n_stack % N_STACK] {
                if !OVER_LEAVES || child & LEAF == 0 {
                    self.tree.hierarchy.prefetch::<S>(child);
                }
            }
        }
        self.test_waiting::<S>();
    }

    /// Tests the triangles in a leaf of the tree: those in groups whose bounds, and in boxes, that rays pass.
    #[inline(always)]
    fn visit_leaf<S: Simd>(&mut self, leaf: u32, placed: &mut PlacedGroups, rows: &mut BoxRows) {
        let Tree { boxes, leaf_cubes, .. } = self.tree;
        let items = self.tree.items_of(leaf);
        let (n_groups, groups) = (items.len().div_ceil(GROUP), boxes.of_groups(leaf, items.clone()));
        let leaf_cube = self.shaft.leaf_cube(leaf_cubes[leaf as usize]);
        for first_group in (0..n_groups).step_by(GROUP) {
            let mut passed = self.shaft.passed_groups::<S>(&leaf_cube, groups.batch(first_group), placed);
            while passed != 0 {
                let group = passed.trailing_zeros() as usize % GROUP;
                passed &= passed - 1;
                if self.passing::<S>(&placed.sides, group) == 0 {
                    continue;
                }
                let first = items.start + (first_group + group) * GROUP;
                let of_group = boxes.group(first, (items.end - first).min(GROUP));
                let passed = self.shaft.passed_boxes::<S>(placed, group, of_group, rows);
                self.visit_boxes::<S, true>(rows, passed, 0, &consecutive(first as u32));
            }
        }
    }

    /// Tests the triangles whose boxes rays pass. `passed` has a bit for each box that the shaft passes, at its slot's number with
    /// the bits of `flip` inverted; `triangles` has the triangle of each slot, or its item.
    #[inline(always)]
    fn visit_boxes<S: Simd, const ARE_ITEMS: bool>(
        &mut self,
        rows: &BoxRows,
        mut passed: u32,
        flip: usize,
        triangles: &[u32; CHILDREN],
    ) {
        self.n_boxes += passed.count_ones();
        let (mut met, mut n_met) = ([(0, 0); CHILDREN], 0);
        while passed != 0 {
            let slot = (passed.trailing_zeros() as usize ^ flip) % CHILDREN;
            passed &= passed - 1;
            let rays = self.passing::<S>(&rows.0, slot);
            met[n_met % CHILDREN] = (triangles[slot], rays);
            n_met += usize::from(rays != 0);
        }
        for &(triangle, rays) in &met[..n_met] {
            let triangle = if ARE_ITEMS { self.tree.items.triangle(triangle) } else { triangle };
            self.grid.mesh().prefetch_vertices::<S>(triangle);
            self.test_soon::<S>(triangle, rays & self.left);
        }
    }

    /// A bit for each ray left that passes the box in a slot.
    #[inline(always)]
    fn passing<S: Simd>(&self, rows: &[[f32; CHILDREN]; 6], slot: usize) -> u32 {
        let RayLanes { ends, inverses, bases, .. } = &self.lanes;
        let mut passing = 0;
        for lane in (0..MOST_RAYS).step_by(S::LANES) {
            let mut near = S::splat(rows[0][slot]).max(S::load(&ends[0][lane..]));
            let mut far = S::splat(rows[1][slot]).min(S::load(&ends[1][lane..]));
            for across in 0..2 {
                let (inverse, base) = (S::load(&inverses[across][lane..]), S::load(&bases[across][lane..]));
                near = near.max(S::splat(rows[2 + 2 * across][slot]).mul_add(inverse, base));
                far = far.min(S::splat(rows[3 + 2 * across][slot]).mul_add(inverse, base));
            }
            passing |= near.le(far) << lane;
        }
        passing & self.left
    }
}

/// The least and greatest numbers of all lanes.
#[inline(always)]
fn reduce<S: Simd, const N: usize>(bounds: [[S; 2]; N]) -> [[f32; 2]; N] {
    let mut reduced = [[0.0; 2]; N];
    for axis in 0..N {
        reduced[axis] = [bounds[axis][0].reduce_min(), bounds[axis][1].reduce_max()];
    }
    reduced
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::{
        grid::{GridOptions, Structure},
        model::mesh::Mesh,
        simd::Portable,
    };

    #[test]
    fn parallel_rays_go_together_where_triangles_are_large() {
        let vertices = vec![[0.0, 0.0, 5.0], [10.0, 0.0, 5.0], [0.0, 10.0, 5.0], [10.0, 10.0, 6.0]];
        let mesh = Mesh { vertices, triangles: vec![[0, 1, 2], [1, 3, 2]], ..Mesh::default() };
        let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
        let Structure::Tree(tree) = &grid.structure else { panic!("no tree") };
        let rays = |spacing: f32| {
            let ray = |lane: u8| {
                let [x, y] = [f32::from(lane % 4), f32::from(lane / 4)].map(|step| 9.5 + step * spacing);
                Ray::new(Vec3::new(x, y, 0.0), Vec3::new(0.1, 0.0, 1.0))
            };
            [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15].map(ray)
        };
        let mut bundles = Bundles::new(&grid, tree);
        let mut occluded = |rays: &[Ray]| (bundles.occluded::<Portable>(rays), bundles.occluder);
        // They leave the square at its side.
        assert_eq!(occluded(&rays(0.01)), (Some(0), None));
        let left = rays(-0.2);
        let expected = left.iter().map(|ray| u32::from(grid.occluded(ray))).rev().fold(0, |mask, hit| mask << 1 | hit);
        assert_eq!(occluded(&left), (Some(expected), None));
        assert!(expected != 0 && expected != 0xffff);
        for (spacing, why) in [(120.0, "far apart"), (45.0, "a wide shaft")] {
            assert_eq!(occluded(&rays(spacing)).0, None, "{why}");
        }
        for lane in [7, 15] {
            let mut apart = rays(0.01);
            apart[lane].direction.x = 0.5;
            assert_eq!(occluded(&apart).0, None, "ray {lane} is not parallel");
        }

        // A triangle that hid all rays of a bundle is tested first for the next, and need not hide it.
        let mut within = rays(0.01);
        within.iter_mut().for_each(|ray| ray.origin.x -= 3.0);
        let (all, occluder) = occluded(&within);
        assert!(all == Some(0xffff) && occluder.is_some());
        assert_eq!(occluded(&left), (Some(expected), None));
        assert_eq!(occluded(&within), (all, occluder));
    }
}
