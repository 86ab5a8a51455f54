//! Quantised bounds of the triangles in each leaf: most triangles are rejected without reading their vertices.
//!
//! Every sixteen triangles of a leaf have common bounds, in steps of a 250th of the leaf's cube, and each triangle has three
//! bytes more: its own, in steps of a 15th of the common ones. A box holds the part of its triangle inside the cube, so a ray
//! that hits the triangle there passes the box. Vertices lie far apart in memory; in a scan seen from afar nearly all boxes lie
//! between the rays.

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

/// Steps along the bounds of a group.
pub(crate) const N_GROUP_STEPS: u8 = 15;

/// Rounding error of box tests in single precision, relative to the distances from the ray's origin.
const MARGIN: f32 = 1.0 / (1u32 << 19) as f32;

/// Bytes after the last box, so that a vector can be loaded from there.
const PADDING: usize = 16;

/// Triangles of a group: neighbours in space, whose boxes lie side by side.
pub(crate) const GROUP: usize = 16;

/// The boxes of all leaves, in their order, and of groups of them.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct QuantizedBoxes {
    /// A leaf's groups follow each other. A group of n items from number r on has 3·n bytes from index 3·r on, a row of n for
    /// each axis. The lower half of a byte counts steps up from the group's least side, the upper half steps down from its
    /// greatest. Empty in a compact tree: a triangle's box is its group's.
    #[serde(skip)]
    bytes: Section<u8>,
    /// Bounds of each group. A leaf with n groups has 6·n bytes from index 6·[`first_group`] on; every 16 groups, the last of
    /// fewer, have a row for each side: least x, greatest x, then y and z.
    #[serde(skip)]
    group_bytes: Section<u8>,
}

/// Boxes of triangles that are as large as their group.
static AS_LARGE_AS_GROUPS: [u8; 3 * GROUP + PADDING] = [0; 3 * GROUP + PADDING];

/// Index of a leaf's first group, if its items begin at `start`. No leaf has more groups than lie before the next's.
#[inline(always)]
fn first_group(leaf: u32, start: usize) -> usize {
    start / GROUP + leaf as usize
}

/// Bounds of a leaf's groups.
#[derive(Clone, Copy)]
pub(crate) struct GroupBounds<'a> {
    /// With [`PADDING`].
    bytes: &'a [u8],
    n: usize,
}

impl<'a> GroupBounds<'a> {
    /// Those from number `first` on, a multiple of [`GROUP`], at most [`GROUP`] of them.
    #[inline(always)]
    pub(crate) fn batch(&self, first: usize) -> GroupBatch<'a> {
        let n = (self.n - first).min(GROUP);
        GroupBatch { bytes: &self.bytes[6 * first..6 * first + 6 * n + PADDING], n }
    }

    /// All sides of one group: twice the axis, and one more for the greatest side.
    #[inline(always)]
    pub(crate) fn sides(&self, group: usize) -> [u8; 6] {
        let GroupBatch { bytes, n } = self.batch(group / GROUP * GROUP);
        let mut sides = [0; 6];
        for side in 0..6 {
            sides[side] = bytes[side * n + group % GROUP];
        }
        sides
    }
}

/// Bounds of up to [`GROUP`] groups.
#[derive(Clone, Copy)]
pub(crate) struct GroupBatch<'a> {
    bytes: &'a [u8],
    n: usize,
}

impl GroupBatch<'_> {
    /// A bit for each group.
    #[inline(always)]
    pub(crate) fn mask(&self) -> u32 {
        u32::MAX >> (32 - self.n)
    }

    /// Sides of the groups from number `first` on, a multiple of [`Simd::LANES`] below [`GROUP`]. A side is below six and
    /// numbered as in [`GroupBounds::sides`]. Lanes beyond the last group are undefined.
    ///
    /// # Safety
    ///
    /// `sides` and `first` are as said.
    #[inline(always)]
    pub(crate) unsafe fn rows<S: Simd>(&self, sides: [usize; 6], first: usize) -> [S; 6] {
        let mut rows = [S::splat(0.0); 6];
        for row in 0..6 {
            let at = sides[row] * self.n + first;
            debug_assert!(sides[row] < 6 && at + S::LANES <= self.bytes.len(), "side {} from {first} on", sides[row]);
            // SAFETY: the caller's; row 5 begins n bytes before the padding of 16, so the slice has 16 bytes from any row's
            // start.
            rows[row] = unsafe { S::load_bytes_at(self.bytes.as_ptr().add(at)) };
        }
        rows
    }
}

/// Boxes of one group.
#[derive(Clone, Copy)]
pub(crate) struct GroupBoxes<'a> {
    /// With [`PADDING`].
    bytes: &'a [u8],
    n: usize,
}

impl GroupBoxes<'_> {
    /// A bit for each box.
    #[inline(always)]
    pub(crate) fn mask(&self) -> u32 {
        u32::MAX >> (32 - self.n)
    }

    /// For the boxes from number `first` on, a multiple of [`Simd::LANES`] below [`GROUP`], steps from the group's least side
    /// up and from its greatest side down, along an axis; in the other order if `is_backward`. Lanes beyond the last box are
    /// undefined.
    ///
    /// # Safety
    ///
    /// The axis is below 3, and `first` as said.
    #[inline(always)]
    pub(crate) unsafe fn steps<S: Simd>(&self, axis: usize, is_backward: bool, first: usize) -> [S; 2] {
        let at = axis * self.n + first;
        debug_assert!(axis < 3 && at + S::LANES <= self.bytes.len(), "axis {axis} from {first} on");
        // SAFETY: the caller's; row 2 begins n bytes before the padding of 16, so the slice has 16 bytes from any row's start.
        unsafe { S::load_halves_at(self.bytes.as_ptr().add(at), 4 * u32::from(is_backward)) }
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
    /// Measures the triangles of a finished tree, in parallel, or only their groups if it is compact.
    pub(crate) fn new(
        space: &CellSpace,
        leaf_cubes: &[LeafCube],
        leaf_starts: &[u32],
        items: &Items,
        mesh: &TracedMesh,
        is_compact: bool,
    ) -> Self {
        const LEAVES_PER_JOB: usize = 1024;
        // Divide the leaves, and the bytes of their boxes, into jobs.
        let n_items = leaf_starts.last().map_or(0, |&end| end as usize);
        let mut bytes = vec![0; 3 * n_items + PADDING];
        let mut group_bytes = vec![0; 6 * first_group(leaf_cubes.len() as u32, n_items) + PADDING];
        let first_group_of = |leaf: usize| first_group(leaf as u32, leaf_starts[leaf] as usize);
        let mut jobs = Vec::new();
        let (mut rest, mut rest_of_groups) = (&mut *bytes, &mut *group_bytes);
        for first in (0..leaf_cubes.len()).step_by(LEAVES_PER_JOB) {
            let end = (first + LEAVES_PER_JOB).min(leaf_cubes.len());
            let (chunk, others) = rest.split_at_mut(3 * (leaf_starts[end] - leaf_starts[first]) as usize);
            let (groups, other_groups) = rest_of_groups.split_at_mut(6 * (first_group_of(end) - first_group_of(first)));
            jobs.push((first..end, chunk, groups));
            (rest, rest_of_groups) = (others, other_groups);
        }

        // Measure each leaf's triangles.
        jobs.into_par_iter().for_each(|(leaves, mut bytes, mut group_bytes)| {
            for leaf in leaves {
                let of_leaf = leaf_starts[leaf]..leaf_starts[leaf + 1];
                let (chunk, others) = bytes.split_at_mut(3 * of_leaf.len());
                let (groups, other_groups) =
                    group_bytes.split_at_mut(6 * (first_group_of(leaf + 1) - first_group_of(leaf)));
                (bytes, group_bytes) = (others, other_groups);
                measure(space, leaf_cubes[leaf], mesh, of_leaf.map(|item| items.triangle(item)), chunk, groups);
            }
        });
        if is_compact {
            bytes = Vec::new();
        }
        Self { bytes: bytes.into(), group_bytes: group_bytes.into() }
    }

    /// Whether only groups have boxes.
    #[inline(always)]
    pub(crate) fn are_of_groups(&self) -> bool {
        self.bytes.is_empty()
    }

    pub(crate) fn n_bytes(&self) -> usize {
        self.bytes.len() + self.group_bytes.len()
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("boxes", &mut self.bytes)?;
        visitor.visit("group boxes", &mut self.group_bytes)
    }

    /// Whether these are the boxes of so many leaves and items, or in a compact tree of groups of them.
    pub(super) fn are_as_many_as(&self, n_leaves: usize, n_items: usize, is_compact: bool) -> bool {
        let n_bytes = if is_compact { 0 } else { 3 * n_items + PADDING };
        self.bytes.len() == n_bytes && self.group_bytes.len() == 6 * first_group(n_leaves as u32, n_items) + PADDING
    }

    /// Bounds of a leaf's triangles within its cube, in finest cells.
    pub(crate) fn leaf_bounds(&self, leaf: u32, cube: LeafCube, items: Range<usize>) -> Bounds {
        let groups = self.of_groups(leaf, items);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for group in 0..groups.n {
            let [x, greatest_x, y, greatest_y, z, greatest_z] = groups.sides(group).map(f64::from);
            low = low.min(DVec3::new(x, y, z));
            high = high.max(DVec3::new(greatest_x, greatest_y, greatest_z));
        }
        let [x, y, z, _] = cube.corner();
        let corner = UVec3::new(x, y, z).as_dvec3();
        let position = |sides: DVec3| corner + (sides - FIRST_STEP) * (f64::from(cube.size()) / N_STEPS);
        Bounds::new(position(low), position(high))
    }

    /// Hints that the bounds of a leaf's first groups will be read soon.
    #[inline(always)]
    pub(crate) fn prefetch_bounds<S: Simd>(&self, leaf: u32, items: Range<usize>) {
        let first = 6 * first_group(leaf, items.start);
        S::prefetch(&self.group_bytes, first);
        S::prefetch(&self.group_bytes, first + 63);
    }

    /// Hints that the boxes of these items will be read soon.
    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, items: Range<usize>) {
        if self.are_of_groups() {
            return;
        }
        let mut at = 3 * items.start;
        while at < 3 * items.end {
            S::prefetch(&self.bytes, at);
            at += 64;
        }
    }

    /// Hints that the boxes of a group from this item on will be read soon.
    #[inline(always)]
    pub(crate) fn prefetch_group<S: Simd>(&self, first: usize) {
        if self.are_of_groups() {
            return;
        }
        S::prefetch(&self.bytes, 3 * first);
        S::prefetch(&self.bytes, 3 * (first + GROUP) - 1);
    }

    /// The boxes of a group of `n` items from `first` on.
    #[inline(always)]
    pub(crate) fn group(&self, first: usize, n: usize) -> GroupBoxes<'_> {
        if self.are_of_groups() {
            return GroupBoxes { bytes: &AS_LARGE_AS_GROUPS[..3 * n + PADDING], n };
        }
        GroupBoxes { bytes: &self.bytes[3 * first..3 * (first + n) + PADDING], n }
    }

    /// The bounds of the groups of a leaf with these items.
    #[inline(always)]
    pub(crate) fn of_groups(&self, leaf: u32, items: Range<usize>) -> GroupBounds<'_> {
        let (first, n) = (first_group(leaf, items.start), items.len().div_ceil(GROUP));
        GroupBounds { bytes: &self.group_bytes[6 * first..6 * (first + n) + PADDING], n }
    }
}

/// The groups of one leaf, relative to the origin of rays that all advance the same way along an axis k.
pub(crate) struct LeafGroups<'a> {
    bounds: GroupBounds<'a>,
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

/// Up to sixteen groups in memory: the near and far side of each along k, then u and v, and lengths of steps along them.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct PlacedGroups {
    pub(crate) sides: [[f32; GROUP]; 6],
    pub(crate) steps: [[f32; GROUP]; 3],
}

impl PlacedGroups {
    pub(crate) const NONE: Self = Self { sides: [[0.0; GROUP]; 6], steps: [[0.0; GROUP]; 3] };

    /// The sides of a group's boxes from number `first` on, a multiple of [`Simd::LANES`] below [`GROUP`]; lanes beyond the last
    /// box are undefined. `sides` are numbered as in [`GroupBounds::sides`], two for each axis.
    #[inline(always)]
    pub(crate) fn boxes<S: Simd>(
        &self,
        sides: [usize; 6],
        group: usize,
        boxes: GroupBoxes<'_>,
        first: usize,
    ) -> [S; 6] {
        let mut of_boxes = [S::splat(0.0); 6];
        for axis in 0..3 {
            let [near, far] = [2 * axis, 2 * axis + 1];
            let is_backward = sides[near] % 2 == 1;
            // SAFETY: sides are those of three axes; the caller's `first`.
            let [from_near, from_far] = unsafe { boxes.steps::<S>(sides[near] / 2, is_backward, first) };
            let step = S::splat(self.steps[axis][group]);
            of_boxes[near] = from_near.mul_add(step, S::splat(self.sides[near][group]));
            of_boxes[far] = from_far.neg_mul_add(step, S::splat(self.sides[far][group]));
        }
        of_boxes
    }
}

impl<'a> LeafGroups<'a> {
    /// Those of a leaf: a cube of side `size` and lowest corner `corner_from_origin`, in finest cells.
    #[inline(always)]
    pub(crate) fn new(
        bounds: GroupBounds<'a>,
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
        Self { bounds, sides, bases, steps: [step * direction_sign, step] }
    }

    pub(crate) fn n(&self) -> usize {
        self.bounds.n
    }

    /// The bounds of the groups from number `first` on, a multiple of [`Simd::LANES`], one per lane; lanes beyond the last group
    /// are undefined. `placed` gets them for [`LeafGroups::boxes`].
    #[inline(always)]
    pub(crate) fn bounds<S: Simd>(&self, first: usize, placed: &mut PlacedGroups) -> BoxLanes<S> {
        let batch = self.bounds.batch(first / GROUP * GROUP);
        // SAFETY: sides are those of three axes, and `first` is a multiple of the lanes.
        let rows = unsafe { batch.rows::<S>(self.sides, first % GROUP) };
        for axis in 0..3 {
            let group_step = S::splat(self.steps[1] * (1.0 / f32::from(N_GROUP_STEPS)));
            let length = rows[2 * axis + 1].sub(rows[2 * axis]).abs();
            length.mul(group_step).store(&mut placed.steps[axis]);
        }
        let [along, across] = [S::splat(self.steps[0]), S::splat(self.steps[1])];
        let mut sides = [along; 6];
        for side in 0..6 {
            let step = if side < 2 { along } else { across };
            sides[side] = rows[side].mul_add(step, S::splat(self.bases[side]));
            sides[side].store(&mut placed.sides[side]);
        }
        let [near, far, u_low, u_high, v_low, v_high] = sides;
        BoxLanes { near, far, u: [u_low, u_high], v: [v_low, v_high] }
    }

    /// The boxes of group `lane` of those placed, from number `first` on, a multiple of [`Simd::LANES`] below [`GROUP`]; lanes
    /// beyond the last box are undefined.
    #[inline(always)]
    pub(crate) fn boxes<S: Simd>(
        &self,
        placed: &PlacedGroups,
        lane: usize,
        boxes: GroupBoxes<'_>,
        first: usize,
    ) -> BoxLanes<S> {
        let [near, far, u_low, u_high, v_low, v_high] = placed.boxes(self.sides, lane, boxes, first);
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

/// Writes the quantised boxes of a leaf's triangles and of its groups, rounded outward.
fn measure(
    space: &CellSpace,
    cube: LeafCube,
    mesh: &TracedMesh,
    triangles: impl ExactSizeIterator<Item = u32>,
    bytes: &mut [u8],
    group_bytes: &mut [u8],
) {
    const ROUNDING: f64 = 1e-3;
    let steps_per_cell = N_STEPS / f64::from(cube.size());
    let [x, y, z, _] = cube.corner();
    let corner = UVec3::new(x, y, z).as_dvec3();
    let n = triangles.len();
    // Of each triangle of a group, in steps of the leaf.
    let mut sides = [[DVec3::ZERO; 2]; GROUP];
    for (index, triangle) in triangles.enumerate() {
        let points = mesh.corners(triangle).map(|corner| space.point_to_cells(Vec3::from_array(corner).as_dvec3()));
        let [low, high] = [points[0].min(points[1]).min(points[2]), points[0].max(points[1]).max(points[2])];
        // Sides outside the cube get the ends of a byte's range.
        let within = |position: DVec3| position.clamp(DVec3::ZERO, DVec3::splat(f64::from(u8::MAX)));
        sides[index % GROUP] = [
            within((low - corner) * steps_per_cell + (FIRST_STEP - ROUNDING)),
            within((high - corner) * steps_per_cell + (FIRST_STEP + ROUNDING)),
        ];
        if index % GROUP == GROUP - 1 || index == n - 1 {
            let first = index / GROUP * GROUP;
            write_group(
                &sides[..=index % GROUP],
                &mut bytes[3 * first..=3 * index + 2],
                group_bytes,
                index / GROUP,
                n.div_ceil(GROUP),
            );
        }
    }
}

/// Writes the boxes of group `group` of `n_groups`, and its bounds.
fn write_group(boxes: &[[DVec3; 2]], bytes: &mut [u8], group_bytes: &mut [u8], group: usize, n_groups: usize) {
    let batch = group / GROUP * GROUP;
    let n_in_batch = (n_groups - batch).min(GROUP);
    for axis in 0..3 {
        let least = boxes.iter().map(|[low, _]| low[axis]).fold(f64::INFINITY, f64::min).floor();
        let greatest = boxes.iter().map(|[_, high]| high[axis]).fold(f64::NEG_INFINITY, f64::max).ceil();
        for (side, value) in [least, greatest].into_iter().enumerate() {
            group_bytes[6 * batch + (2 * axis + side) * n_in_batch + group - batch] = value as u8;
        }
        // Conversions round down, so a box grows; they saturate, where a group is flat.
        let steps_per_step = f64::from(N_GROUP_STEPS) / (greatest - least);
        for (index, [low, high]) in boxes.iter().enumerate() {
            let up = (((low[axis] - least) * steps_per_step) as u8).min(N_GROUP_STEPS);
            let down = (((greatest - high[axis]) * steps_per_step) as u8).min(N_GROUP_STEPS);
            bytes[axis * boxes.len() + index] = up | down << 4;
        }
    }
}
