//! Quantised bounds of the triangles in each leaf: most triangles are rejected without reading their vertices.
//!
//! Two triangles share a box: in scans those that follow each other are mostly the halves of a quadrangle, whose bounds are
//! hardly larger than those of one. Six bytes a box: bounds within the leaf's cube, in steps of a 250th of the cube. A box
//! holds the parts of its triangles inside the cube, so a ray that hits one there passes the box. Vertices lie
//! far apart in memory; in a scan seen from afar nearly all boxes lie between the rays.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::{DVec3, UVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    grid::{
        cells::CellSpace,
        traced::TracedMesh,
        tree::{BRICK_SIZE, Tree, TreeNode, hierarchy::Bounds, items::Items, overlap::child_position},
    },
    scene_file::{fault::Fault, section::Section, sections::SectionVisitor},
    simd::Simd,
};

/// Steps along a cube. The rest of a byte's 256 values reaches beyond the cube on both sides.
pub(crate) const N_STEPS: f64 = 250.0;

/// Value of the cube's lower side.
pub(crate) const FIRST_STEP: f64 = 3.0;

/// Rounding error of box tests in single precision, relative to the distances from the ray's origin.
const MARGIN: f32 = 1.0 / (1u32 << 19) as f32;

/// Bytes after the last box, so that a vector can be loaded from there.
const PADDING: usize = 16;

/// Items that share a box.
pub(crate) const ITEMS_PER_BOX: usize = 2;

/// Boxes of a group: of neighbours in space, side by side.
pub(crate) const GROUP: usize = 16;

/// Items of a group.
pub(crate) const ITEMS_PER_GROUP: usize = ITEMS_PER_BOX * GROUP;

/// The boxes of all leaves, in their order, and of groups of them.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct QuantizedBoxes {
    /// A leaf's groups follow each other. A group of n boxes from number r on has 6·n bytes from index 6·r on: n least
    /// x, n greatest x, then y and z. The leaf's first is [`box_number`].
    #[serde(skip)]
    bytes: Section<u8>,
    /// Bounds of each group, in the same form: a leaf with n groups has 6·n bytes from index 6·[`group_number`] on.
    #[serde(skip)]
    group_bytes: Section<u8>,
}

/// The number of the box in which an item of a leaf is the first. No leaf has more boxes than lie before the next's.
#[inline(always)]
fn box_number(leaf: u32, item: usize) -> usize {
    item / ITEMS_PER_BOX + leaf as usize
}

/// The number of the group in which an item of a leaf is the first. No leaf has more groups than lie before the next's.
#[inline(always)]
fn group_number(leaf: u32, item: usize) -> usize {
    item / ITEMS_PER_GROUP + leaf as usize
}

/// Boxes of a leaf or of its groups: six rows for every 16, the last of fewer.
#[derive(Clone, Copy)]
pub(crate) struct BoxBytes<'a> {
    /// With [`PADDING`].
    bytes: &'a [u8],
    n: usize,
}

impl<'a> BoxBytes<'a> {
    /// The boxes from number `first` on, which begins a group.
    #[inline(always)]
    pub(crate) fn group(&self, first: usize) -> GroupBytes<'a> {
        let n = (self.n - first).min(GROUP);
        GroupBytes { bytes: &self.bytes[6 * first..6 * first + 6 * n + PADDING], n }
    }

    /// One side of the boxes from number `first` on: twice the axis, and one more for the greatest side.
    #[inline(always)]
    pub(crate) fn side<S: Simd>(&self, side: usize, first: usize) -> S {
        let group = first / GROUP * GROUP;
        let n_in_group = (self.n - group).min(GROUP);
        S::load_bytes(&self.bytes[6 * group + side * n_in_group + (first - group)..])
    }
}

/// Boxes of one group.
#[derive(Clone, Copy)]
pub(crate) struct GroupBytes<'a> {
    bytes: &'a [u8],
    n: usize,
}

impl GroupBytes<'_> {
    /// A bit for each box.
    #[inline(always)]
    pub(crate) fn mask(&self) -> u32 {
        u32::MAX >> (32 - self.n)
    }

    /// Sides of the boxes from number `first` on, a multiple of [`Simd::LANES`] below [`GROUP`]. A side is below six and
    /// numbered as in [`BoxBytes::side`]. Lanes beyond the last box are undefined.
    #[inline(always)]
    pub(crate) fn sides<S: Simd>(&self, sides: [usize; 6], first: usize) -> [S; 6] {
        let mut rows = [S::splat(0.0); 6];
        for row in 0..6 {
            let at = sides[row] * self.n + first;
            debug_assert!(sides[row] < 6 && at + S::LANES <= self.bytes.len(), "side {} from {first} on", sides[row]);
            // SAFETY: row 5 begins n bytes before the padding of 16, so at most 16 bytes from there are in the slice.
            rows[row] = unsafe { S::load_bytes_at(self.bytes.as_ptr().add(at)) };
        }
        rows
    }
}

/// The cube of a leaf: twice its lowest corner, in finest cells, with its side added to x.
///
/// The side is a power of two, and corners are multiples of it, so it is the lowest bit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(transparent)]
pub(crate) struct LeafCube([u32; 3]);

impl LeafCube {
    fn new(corner: [u32; 3], size: u32) -> Self {
        let [x, y, z] = corner.map(|along| 2 * along);
        Self([x | size, y, z])
    }

    /// Lowest corner, in finest cells. The fourth number fills a vector.
    #[inline(always)]
    pub(crate) fn corner(self) -> [u32; 4] {
        let Self([x, y, z]) = self;
        [(x ^ self.size()) >> 1, y >> 1, z >> 1, 0]
    }

    /// Side, in finest cells.
    #[inline(always)]
    pub(crate) fn size(self) -> u32 {
        self.0[0] & self.0[0].wrapping_neg()
    }
}

impl QuantizedBoxes {
    /// Measures the triangles of a finished tree, in parallel.
    pub(crate) fn new(
        space: &CellSpace,
        leaf_cubes: &[LeafCube],
        leaf_starts: &[u32],
        items: &Items,
        mesh: &TracedMesh,
    ) -> Self {
        const LEAVES_PER_JOB: usize = 1024;
        // Divide the leaves, and the bytes of their boxes, into jobs.
        let first_box = |leaf: usize| box_number(leaf as u32, leaf_starts[leaf] as usize);
        let mut bytes = vec![0; 6 * first_box(leaf_cubes.len()) + PADDING];
        let mut jobs = Vec::new();
        let mut rest = &mut *bytes;
        for first in (0..leaf_cubes.len()).step_by(LEAVES_PER_JOB) {
            let end = (first + LEAVES_PER_JOB).min(leaf_cubes.len());
            let (chunk, others) = rest.split_at_mut(6 * (first_box(end) - first_box(first)));
            jobs.push((first..end, chunk));
            rest = others;
        }

        // Measure each leaf's triangles.
        jobs.into_par_iter().for_each(|(leaves, mut bytes)| {
            for leaf in leaves {
                let (chunk, others) = bytes.split_at_mut(6 * (first_box(leaf + 1) - first_box(leaf)));
                bytes = others;
                measure(space, leaf_cubes[leaf], mesh, items, leaf_starts[leaf]..leaf_starts[leaf + 1], chunk);
            }
        });
        let group_bytes = group_bounds(&bytes, leaf_starts);
        Self { bytes: bytes.into(), group_bytes: group_bytes.into() }
    }

    pub(crate) fn n_bytes(&self) -> usize {
        self.bytes.len() + self.group_bytes.len()
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("boxes", &mut self.bytes)?;
        visitor.visit("group boxes", &mut self.group_bytes)
    }

    /// Whether these are the boxes of so many leaves and items.
    pub(super) fn are_as_many_as(&self, n_leaves: usize, n_items: usize) -> bool {
        self.bytes.len() == 6 * box_number(n_leaves as u32, n_items) + PADDING
            && self.group_bytes.len() == 6 * group_number(n_leaves as u32, n_items) + PADDING
    }

    /// Bounds of a leaf's triangles within its cube, in finest cells.
    pub(crate) fn leaf_bounds(&self, leaf: u32, cube: LeafCube, items: Range<usize>) -> Bounds {
        let (first, n) = (6 * group_number(leaf, items.start), items.len().div_ceil(ITEMS_PER_GROUP));
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for group in 0..n {
            let (row_group, n_in_row) = (group / GROUP * GROUP, (n - group / GROUP * GROUP).min(GROUP));
            let side =
                |side: usize| f64::from(self.group_bytes[first + 6 * row_group + side * n_in_row + group - row_group]);
            low = low.min(DVec3::new(side(0), side(2), side(4)));
            high = high.max(DVec3::new(side(1), side(3), side(5)));
        }
        let [x, y, z, _] = cube.corner();
        let corner = UVec3::new(x, y, z).as_dvec3();
        let position = |sides: DVec3| corner + (sides - FIRST_STEP) * (f64::from(cube.size()) / N_STEPS);
        Bounds::new(position(low), position(high))
    }

    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, leaf: u32, items: Range<usize>) {
        let mut at = 6 * box_number(leaf, items.start);
        let end = at + 6 * items.len().div_ceil(ITEMS_PER_BOX);
        while at < end {
            S::prefetch(&self.bytes, at);
            at += 64;
        }
    }

    /// The boxes of a group of a leaf, which has these items.
    #[inline(always)]
    pub(crate) fn group(&self, leaf: u32, items: Range<usize>) -> GroupBytes<'_> {
        let BoxBytes { bytes, n } = self.of_leaf(leaf, items);
        GroupBytes { bytes, n }
    }

    /// The boxes of a leaf with these items.
    #[inline(always)]
    pub(crate) fn of_leaf(&self, leaf: u32, items: Range<usize>) -> BoxBytes<'_> {
        let (first, n) = (box_number(leaf, items.start), items.len().div_ceil(ITEMS_PER_BOX));
        BoxBytes { bytes: &self.bytes[6 * first..6 * (first + n) + PADDING], n }
    }

    /// The bounds of the groups of a leaf with these items.
    #[inline(always)]
    pub(crate) fn of_groups(&self, leaf: u32, items: Range<usize>) -> BoxBytes<'_> {
        let (first, n) = (group_number(leaf, items.start), items.len().div_ceil(ITEMS_PER_GROUP));
        BoxBytes { bytes: &self.group_bytes[6 * first..6 * (first + n) + PADDING], n }
    }
}

/// The boxes of one leaf, relative to the origin of rays that all advance the same way along an axis k.
pub(crate) struct LeafBoxes<'a> {
    bytes: BoxBytes<'a>,
    /// The near and far side along k, the least and greatest u, the least and greatest v.
    sides: [usize; 6],
    /// Positions of value 0, relative to the origin and with margins, in finest cells; depths along k.
    bases: [f32; 6],
    /// Finest cells of a step, along k (negative if rays go backward) and across.
    steps: [f32; 2],
}

/// Boxes, one per lane, in finest cells relative to the rays' origin: depths along k and bounds across it.
#[derive(Clone, Copy)]
pub(crate) struct BoxLanes<S> {
    near: S,
    far: S,
    u: [S; 2],
    v: [S; 2],
}

impl<'a> LeafBoxes<'a> {
    /// The boxes in `bytes` of a leaf: a cube of side `size` and lowest corner `corner_from_origin`, in finest cells.
    #[inline(always)]
    pub(crate) fn new(
        bytes: BoxBytes<'a>,
        axes: [usize; 3],
        is_backward: bool,
        corner_from_origin: [f64; 3],
        size: i32,
    ) -> Self {
        // Find the position of value 0, and the margin for its distance.
        let size = f64::from(size);
        let mut base = [0.0; 3];
        for local_axis in 0..3 {
            base[local_axis] = (corner_from_origin[local_axis] - FIRST_STEP / N_STEPS * size) as f32;
        }
        let farthest = base[0].abs() + base[1].abs().max(base[2].abs()) + 2.0 * size as f32;
        let margin = farthest * MARGIN;

        // Backward rays swap near and far, and count depths down.
        let [k, u, v] = axes;
        let (near, depth, direction_sign) =
            if is_backward { (2 * k + 1, -base[0], -1.0) } else { (2 * k, base[0], 1.0) };
        let step = (size * (1.0 / N_STEPS)) as f32;

        let sides = [near, near ^ 1, 2 * u, 2 * u + 1, 2 * v, 2 * v + 1];
        let [u, v] = [base[1], base[2]];
        let bases = [depth - margin, depth + margin, u - margin, u + margin, v - margin, v + margin];
        Self { bytes, sides, bases, steps: [step * direction_sign, step] }
    }

    /// The boxes from index `first` on, one per lane; lanes beyond the last box are undefined.
    #[inline(always)]
    pub(crate) fn bounds<S: Simd>(&self, first: usize) -> BoxLanes<S> {
        let [along, across] = [S::splat(self.steps[0]), S::splat(self.steps[1])];
        let mut sides = [along; 6];
        for side in 0..6 {
            let step = if side < 2 { along } else { across };
            sides[side] = self.bytes.side::<S>(self.sides[side], first).mul_add(step, S::splat(self.bases[side]));
        }
        let [near, far, u_low, u_high, v_low, v_high] = sides;
        BoxLanes { near, far, u: [u_low, u_high], v: [v_low, v_high] }
    }
}

impl<S: Simd> BoxLanes<S> {
    /// Sign bit set in lanes of boxes that begin behind the depth 1 / `inverse_limit`, or that no ray passes whose
    /// slopes against k lie within `slopes`: least and greatest u, least and greatest v.
    #[inline(always)]
    pub(crate) fn miss_signs(&self, slopes: [f32; 4], inverse_limit: f32) -> S {
        let mut missed = self.near.neg_mul_add(S::splat(inverse_limit), S::splat(1.0));
        for (axis, [low, high]) in [self.u, self.v].into_iter().enumerate() {
            let (least, greatest) = (slopes[2 * axis], slopes[2 * axis + 1]);
            // Extreme positions lie at the far side for slopes that lead outward, else at the near side.
            let depth_of_least = if least < 0.0 { self.far } else { self.near };
            let depth_of_greatest = if greatest < 0.0 { self.near } else { self.far };
            let above = S::splat(least).neg_mul_add(depth_of_least, high);
            let below = S::splat(greatest).mul_sub(depth_of_greatest, low);
            missed = missed.or(above).or(below);
        }
        missed
    }
}

/// The cubes of all leaves.
pub(crate) fn leaf_cubes(dims: [u32; 3], bricks: &[u32], nodes: &[TreeNode], n_leaves: usize) -> Vec<LeafCube> {
    let mut leaf_cubes = vec![LeafCube::default(); n_leaves];
    let mut stack = Vec::new();
    for (index, &brick) in bricks.iter().enumerate() {
        let index = index as u32;
        let position = [index % dims[0], index / dims[0] % dims[1], index / dims[0] / dims[1]];
        let cube = LeafCube::new(position.map(|along| along * BRICK_SIZE), BRICK_SIZE);
        if brick == Tree::EMPTY {
            continue;
        }
        if brick & Tree::LEAF != 0 {
            leaf_cubes[(brick & !Tree::LEAF) as usize] = cube;
        } else {
            stack.push((brick, cube));
        }
        // Visit the brick's nodes; children follow in the order of their bits.
        while let Some((number, cube)) = stack.pop() {
            let node = &nodes[number as usize];
            let (mut leaf, mut divided) = (node.first_leaf, node.first_node);
            for child in (0..64).filter(|child| node.occupied >> child & 1 == 1) {
                let size = cube.size() / 4;
                let (corner, position) = (cube.corner(), child_position(child));
                let child_cube = LeafCube::new([0, 1, 2].map(|axis| corner[axis] + position[axis] * size), size);
                if node.divided >> child & 1 == 1 {
                    stack.push((divided, child_cube));
                    divided += 1;
                } else {
                    leaf_cubes[leaf as usize] = child_cube;
                    leaf += 1;
                }
            }
        }
    }
    leaf_cubes
}

/// Writes the quantised boxes of a leaf's items, rounded outward.
fn measure(space: &CellSpace, cube: LeafCube, mesh: &TracedMesh, items: &Items, of_leaf: Range<u32>, bytes: &mut [u8]) {
    const ROUNDING: f64 = 1e-3;
    let steps_per_cell = N_STEPS / f64::from(cube.size());
    let [x, y, z, _] = cube.corner();
    let corner = UVec3::new(x, y, z).as_dvec3();
    let n = of_leaf.len().div_ceil(ITEMS_PER_BOX);
    for (index, first) in of_leaf.clone().step_by(ITEMS_PER_BOX).enumerate() {
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for item in (first..of_leaf.end).take(ITEMS_PER_BOX) {
            for point in mesh.corners(items.triangle(item)) {
                let point = space.point_to_cells(Vec3::from_array(point).as_dvec3());
                (low, high) = (low.min(point), high.max(point));
            }
        }
        let low = ((low - corner) * steps_per_cell + (FIRST_STEP - ROUNDING)).floor();
        let high = ((high - corner) * steps_per_cell + (FIRST_STEP + ROUNDING)).ceil();
        // Conversions saturate: sides outside the cube get the ends of a byte's range.
        let sides = [0, 1, 2].map(|axis| [low[axis] as u8, high[axis] as u8]);
        write_box(bytes, n, index, sides);
    }
}

/// Writes box `index` of `n`.
fn write_box(bytes: &mut [u8], n: usize, index: usize, sides: [[u8; 2]; 3]) {
    let group = index / GROUP * GROUP;
    let n_in_group = (n - group).min(GROUP);
    for (side, value) in sides.into_iter().flatten().enumerate() {
        bytes[6 * group + side * n_in_group + index - group] = value;
    }
}

/// The bounds of all groups.
fn group_bounds(bytes: &[u8], leaf_starts: &[u32]) -> Vec<u8> {
    let n_leaves = leaf_starts.len() as u32 - 1;
    let mut group_bytes = vec![0; 6 * group_number(n_leaves, leaf_starts[n_leaves as usize] as usize) + PADDING];
    for leaf in 0..n_leaves {
        let (start, end) = (leaf_starts[leaf as usize] as usize, leaf_starts[leaf as usize + 1] as usize);
        let n_boxes = (end - start).div_ceil(ITEMS_PER_BOX);
        let n_groups = n_boxes.div_ceil(GROUP);
        let of_leaf = &mut group_bytes[6 * group_number(leaf, start)..];
        for group in 0..n_groups {
            let first = box_number(leaf, start) + group * GROUP;
            let n_in_group = (n_boxes - group * GROUP).min(GROUP);
            let row = |side: usize| bytes[6 * first + side * n_in_group..][..n_in_group].iter().copied();
            let sides =
                [0, 1, 2].map(|axis| [row(2 * axis).min().unwrap_or(u8::MAX), row(2 * axis + 1).max().unwrap_or(0)]);
            write_box(of_leaf, n_groups, group, sides);
        }
    }
    group_bytes
}
