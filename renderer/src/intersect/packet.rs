//! Packets of 64 rays with a common origin through the grid, up to four of them together.
//!
//! Packets that go together share the way and the triangles on it: what a step costs grows with the width of what they
//! meet, not with their rays, and four tiles in a square are as wide as two.
//!
//! After Wald et al., "Ray Tracing Animated Scenes using Coherent Grid Traversal" (2006): the grid is cut into slabs
//! across the packet's major axis k, and the packet's least and largest slopes bound the cells (u, v) that it can meet
//! in a slab. Slabs are as thick as a brick, then as a node's children, and so on down; a node's mask gives all occupied
//! children within the bounds at once.
//!
//! Triangles on the way are culled many at a time, see [`crate::intersect::packet::cull`], and what is left is decided by
//! [`crate::intersect::triangle`]: the hits are those of single rays, bit for bit.

pub(crate) mod cull;
#[expect(clippy::needless_range_loop, reason = "an axis, a corner or a lane indexes several arrays at once")]
pub(crate) mod decide;
pub(crate) mod frustum;
#[expect(clippy::needless_range_loop, reason = "an edge indexes several arrays at once")]
pub(crate) mod pairs;
#[expect(clippy::needless_range_loop, reason = "an axis or an edge indexes several arrays at once")]
pub(crate) mod prepared;
pub(crate) mod ray_set;

use glam::Vec3;

use crate::{
    grid::{
        Grid, Structure,
        tree::{BRICK_SIZE, LEVELS, Tree, boxes::LeafBoxes},
    },
    intersect::{
        InstructionSet,
        kernel::PacketKernel,
        ray::{Hit, Ray},
        simd::{Avx2, Avx512, Portable},
    },
};
use cull::CullScratch;
use cull::Culler;
use frustum::CellBounds;
use frustum::Frustum;
use frustum::NarrowSlab;
use ray_set::RaySet;
#[cfg(target_arch = "x86_64")]

/// Rays with a common origin, in world space.
///
/// Its vectors are aligned, as are others of the kernel: one that lies across two lines of the cache is read twice.
#[repr(C, align(64))]
pub struct Packet {
    /// Their directions, component by component. Rays 16·n to 16·n + 15 are culled together, or half as many: they
    /// should lie close to each other. Entries of no ray must repeat another's direction.
    pub directions: [[f32; 64]; 3],
    /// Where they begin.
    pub origin: Vec3,
    /// A bit for each entry that is a ray.
    pub active: u64,
    /// The first t that counts.
    pub t_min: f32,
    /// The last t that counts.
    pub t_max: f32,
    /// Whether any hit of a ray will do in place of the nearest, as for shadows.
    pub any_hit: bool,
}

impl Packet {
    /// No rays.
    pub const NONE: Self =
        Self { directions: [[0.0; 64]; 3], origin: Vec3::ZERO, active: 0, t_min: 0.0, t_max: f32::MAX, any_hit: false };

    /// One ray of a packet.
    pub fn ray(&self, lane: usize) -> Ray {
        let [x, y, z] = &self.directions;
        let direction = Vec3::new(x[lane], y[lane], z[lane]);
        Ray { origin: self.origin, direction, t_min: self.t_min, t_max: self.t_max }
    }
}

/// Packets that can go together.
pub const MOST_PACKETS: usize = 4;

/// Memory that the packets of one thread use one after the other.
#[derive(Default)]
pub struct PacketScratch {
    one: Scratch<1>,
    four: Scratch<MOST_PACKETS>,
}

/// What so many packets that go together need of it.
#[derive(Default)]
pub(crate) struct Scratch<const N: usize> {
    /// The nodes that they meet in the slab at hand, level by level from number 1, bricks, on; the last has room for what is
    /// not kept.
    entries: [Vec<NodeEntry<N>>; LEVELS as usize + 2],
    /// The leaves that they met, whose triangles wait for their test.
    leaves: Vec<PendingLeaf<N>>,
    cull: CullScratch<N>,
}

/// A node within a packet's bounds.
#[derive(Clone, Copy)]
struct NodeEntry<const N: usize> {
    node: u32,
    /// Its lowest corner across the major axis, in finest cells.
    u: i32,
    v: i32,
    /// The rays that may pass it.
    rays: RaySet<N>,
}

/// A leaf that some rays pass.
#[derive(Clone, Copy)]
pub(crate) struct PendingLeaf<const N: usize> {
    number: u32,
    /// Its lowest corner along the major axis and across, and its size, in finest cells.
    low: [i32; 3],
    size: i32,
    /// The rays that may pass it.
    rays: RaySet<N>,
}

impl Grid {
    /// The nearest triangle along each ray of a packet; entries of no ray are undefined.
    pub fn intersect_packet(&self, packet: &Packet, scratch: &mut PacketScratch) -> [Hit; 64] {
        let mut hits = [[Hit::MISS; 64]];
        if !self.trace_together([packet], RaySet { masks: [packet.active] }, &mut scratch.one, &mut hits) {
            for (lane, hit) in hits[0].iter_mut().enumerate().filter(|(lane, _)| packet.active >> lane & 1 == 1) {
                *hit = self.intersect(&packet.ray(lane));
            }
        }
        hits[0]
    }

    /// The same for packets with a common origin, [`MOST_PACKETS`] at a time: the closer they lie together, the less it
    /// takes. `hits` has an entry for each of them.
    pub fn intersect_packets(&self, packets: &[Packet], scratch: &mut PacketScratch, hits: &mut [[Hit; 64]]) {
        debug_assert!(packets.len() == hits.len() && packets.iter().all(|packet| packet.origin == packets[0].origin));
        for (packets, hits) in packets.chunks(MOST_PACKETS).zip(hits.chunks_mut(MOST_PACKETS)) {
            if let (Some(four), Some(hits)) = (packets.as_array::<MOST_PACKETS>(), hits.as_mut_array()) {
                let masks = std::array::from_fn(|index| four[index].active);
                if self.trace_together(four.each_ref(), RaySet { masks }, &mut scratch.four, hits) {
                    continue;
                }
            } else if packets.len() > 1 {
                // Those that are missing repeat the first, without rays.
                let four = std::array::from_fn(|index| packets.get(index).unwrap_or(&packets[0]));
                let masks = std::array::from_fn(|index| packets.get(index).map_or(0, |packet| packet.active));
                let mut quad_hits = [[Hit::MISS; 64]; MOST_PACKETS];
                if self.trace_together(four, RaySet { masks }, &mut scratch.four, &mut quad_hits) {
                    hits.copy_from_slice(&quad_hits[..packets.len()]);
                    continue;
                }
            }
            for (packet, hits) in packets.iter().zip(hits) {
                *hits = self.intersect_packet(packet, scratch);
            }
        }
    }

    /// Follows the active rays of packets together, if the grid is one for packets and all advance along one axis. Returns
    /// whether it did.
    fn trace_together<const N: usize>(
        &self,
        packets: [&Packet; N],
        active: RaySet<N>,
        scratch: &mut Scratch<N>,
        hits: &mut [[Hit; 64]; N],
    ) -> bool {
        let Structure::Tree(tree) = &self.structure else { return false };
        if self.space.length_to_world(1.0) < SMALLEST_CELL_SIZE {
            return false;
        }
        match self.instructions {
            InstructionSet::Portable => Portable::march(self, tree, packets, active, scratch, hits),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => Avx2::march(self, tree, packets, active, scratch, hits),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => Avx512::march(self, tree, packets, active, scratch, hits),
        }
    }

    /// The way of some packets, if their rays all advance along one axis. Returns whether they do.
    #[inline(always)]
    pub(crate) fn march<S: PacketKernel, const N: usize>(
        &self,
        tree: &Tree,
        packets: [&Packet; N],
        active: RaySet<N>,
        scratch: &mut Scratch<N>,
        hits: &mut [[Hit; 64]; N],
    ) -> bool {
        let Some(axis) = major_axis(&packets) else { return false };
        let Scratch { entries, leaves, cull } = scratch;
        let axes = [axis, (axis + 1) % 3, (axis + 2) % 3];
        let is_forward = packets[0].directions[axis][0] > 0.0;
        let origin = self.space.point_to_cells(packets[0].origin.as_dvec3());
        if !origin.is_finite() {
            return false;
        }
        let mut frustum = Frustum {
            origin: [origin[axes[0]], origin[axes[1]], origin[axes[2]]],
            is_forward,
            slopes: cull.compute_slopes::<S>(&packets, axes),
            size: [f64::from(tree.extent[axes[1]]), f64::from(tree.extent[axes[2]])],
            cells_per_unit: self.space.cells_per_unit(),
            margin: origin.abs().max_element() * (16.0 * f64::EPSILON),
        };
        let bricks_along_k = tree.dims[axis] as i32;
        // Packets that pass the grid by need not be made ready: 2 % of the time of a board seen whole.
        let (near, far) = frustum.depths(0, tree.extent[axis] as i32);
        if far < 0.0 || frustum.cells(near, far).is_none() {
            hits.fill([Hit::MISS; 64]);
            return true;
        }
        let mut culler = Culler::new::<S>(self, packets, active, axes, if is_forward { 1.0 } else { -1.0 }, cull);
        frustum.slopes = culler.ray_bounds.slopes;
        let entry_depth = frustum.entry_depth();
        let entry_k = entry_depth - frustum.margin;
        let k = frustum.origin[0] + if is_forward { entry_k } else { -entry_k };
        let mut brick_k = (k / f64::from(BRICK_SIZE)).floor() as i32;
        if (is_forward && brick_k >= bricks_along_k) || (!is_forward && brick_k < 0) || !entry_depth.is_finite() {
            hits.fill([Hit::MISS; 64]);
            return true;
        }
        brick_k = brick_k.clamp(0, bricks_along_k - 1);

        let mut coverage = 0.0;
        let mut pending_near_depth = 0.0f64;
        leaves.clear();
        while (0..bricks_along_k).contains(&brick_k) {
            let low = brick_k * BRICK_SIZE as i32;
            brick_k += if is_forward { 1 } else { -1 };
            let (near, far) = frustum.depths(low, BRICK_SIZE as i32);
            let Some(bounds) = frustum.cells(near, far) else {
                if near > entry_depth {
                    break;
                }
                continue;
            };
            let narrow = frustum.narrow(near, far, BRICK_SIZE);
            tree.enter_bricks::<S, N>(&culler, leaves, &mut entries[1], axes, low, bounds, narrow);
            if !leaves.is_empty() {
                S::test_leaves(tree, &mut culler, &frustum.origin, leaves);
            }
            if entries[1].is_empty() {
                if culler.has_new_tests && culler.finish_to_depth::<S>(self.space.length_to_world(far)) {
                    culler.write_hits::<S>(hits);
                    return true;
                }
                frustum.slopes = culler.ray_bounds.slopes;
                continue;
            }

            // Depth first through the levels: lows and steps say which quarter of each level's slab is next.
            let mut level = 1;
            let mut lows = [low; LEVELS as usize + 1];
            let mut steps = [0; LEVELS as usize + 1];
            while level > 0 {
                if steps[level] == 4 {
                    level -= 1;
                    continue;
                }
                let quarter = if is_forward { steps[level] } else { 3 - steps[level] };
                steps[level] += 1;
                let shift = 2 * (LEVELS - level as u32);
                let low = lows[level] + (quarter << shift);
                let (near, far) = frustum.depths(low, 1 << shift);
                if far < 0.0 {
                    continue;
                }
                let Some(bounds) = frustum.cells(near, far) else { continue };
                let (above, below) = entries.split_at_mut(level + 1);
                let children = &mut below[0];
                let narrow = frustum.narrow(near, far, 1 << shift);
                let n_before = leaves.len();
                tree.enter_children::<S, N>(
                    &culler,
                    &above[level],
                    children,
                    axes,
                    quarter as u32,
                    low,
                    shift,
                    bounds,
                    narrow,
                    leaves,
                );
                if leaves.len() > n_before {
                    if n_before == 0 {
                        pending_near_depth = near;
                    }
                    let area = frustum.area(far).max(1.0);
                    coverage += (leaves.len() - n_before) as f64 * f64::from(1u32 << shift).powi(2) / area;
                    if coverage >= FULL_COVERAGE || leaves.len() >= MOST_LEAVES {
                        coverage = 0.0;
                        S::test_leaves(tree, &mut culler, &frustum.origin, leaves);
                    }
                }
                if !children.is_empty() {
                    level += 1;
                    (lows[level], steps[level]) = (low, 0);
                } else if culler.has_new_tests {
                    // What waits may lie before what was tested since.
                    let tested_to = if leaves.is_empty() { far } else { pending_near_depth.min(far) };
                    if culler.finish_to_depth::<S>(self.space.length_to_world(tested_to)) {
                        culler.write_hits::<S>(hits);
                        return true;
                    }
                    frustum.slopes = culler.ray_bounds.slopes;
                }
            }
        }
        S::test_leaves(tree, &mut culler, &frustum.origin, leaves);
        culler.finish_to_depth::<S>(f64::INFINITY);
        culler.write_hits::<S>(hits);
        true
    }
}

impl Tree {
    /// Tests the triangles of leaves.
    #[inline(always)]
    pub(crate) fn test_leaves<S: PacketKernel, const N: usize>(
        &self,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<PendingLeaf<N>>,
    ) {
        // One after the other, so that memory is waited for only once.
        for leaf in &*leaves {
            let references = self.references_of(leaf.number);
            self.boxes.prefetch::<S>(references.clone());
            let mut at = references.start;
            while at < references.end {
                S::prefetch(&self.references, at);
                at += 16;
            }
        }
        for leaf in &*leaves {
            let references = self.references_of(leaf.number);
            let mut corner_from_origin = [0.0; 3];
            for local_axis in 0..3 {
                corner_from_origin[local_axis] = f64::from(leaf.low[local_axis]) - origin[local_axis];
            }
            let bytes = self.boxes.leaf_bytes(references.clone());
            let boxes = LeafBoxes::new(
                bytes,
                culler.ray_bounds.axes,
                culler.ray_bounds.sign < 0.0,
                corner_from_origin,
                leaf.size,
            );
            culler.gather::<S>(&boxes, &self.references[references], &leaf.rays);
        }
        culler.drop_recently_tested::<S>();
        leaves.clear();
        culler.has_new_tests = true;
    }

    /// Adds the triangles of leaf bricks to the culler, and the nodes of others to the entries.
    #[inline(always)]
    #[expect(clippy::too_many_arguments, reason = "inlined into the loop whose variables these are")]
    fn enter_bricks<S: PacketKernel, const N: usize>(
        &self,
        culler: &Culler<'_, N>,
        leaves: &mut Vec<PendingLeaf<N>>,
        entries: &mut Vec<NodeEntry<N>>,
        axes: [usize; 3],
        low: i32,
        bounds: CellBounds,
        narrow: Option<NarrowSlab<'_>>,
    ) {
        entries.clear();
        let shift = 2 * LEVELS;
        let strides = [1, self.dims[0] as usize, self.dims[0] as usize * self.dims[1] as usize];
        let first = (low >> shift) as usize * strides[axes[0]];
        for v in bounds.v[0] >> shift..=bounds.v[1] >> shift {
            for u in bounds.u[0] >> shift..=bounds.u[1] >> shift {
                let brick = self.bricks[first + u as usize * strides[axes[1]] + v as usize * strides[axes[2]]];
                if brick == Self::EMPTY {
                    continue;
                }
                let (u, v) = (u << shift, v << shift);
                let rays = culler.rays_through_cell::<S>(&culler.active, narrow.as_ref(), u, v, BRICK_SIZE);
                if rays.is_empty() {
                    continue;
                }
                if brick & Self::LEAF == 0 {
                    entries.push(NodeEntry { node: brick, u, v, rays });
                } else {
                    leaves.push(PendingLeaf {
                        number: brick & !Self::LEAF,
                        low: [low, u, v],
                        size: BRICK_SIZE as i32,
                        rays,
                    });
                }
            }
        }
    }

    /// The same for the children of nodes in one quarter of their slab.
    #[inline(always)]
    #[expect(clippy::too_many_arguments, reason = "inlined into the loop whose variables these are")]
    fn enter_children<S: PacketKernel, const N: usize>(
        &self,
        culler: &Culler<'_, N>,
        entries: &[NodeEntry<N>],
        children: &mut Vec<NodeEntry<N>>,
        axes: [usize; 3],
        quarter: u32,
        low: i32,
        shift: u32,
        bounds: CellBounds,
        narrow: Option<NarrowSlab<'_>>,
        leaves: &mut Vec<PendingLeaf<N>>,
    ) {
        children.clear();
        let slab = AXIS_PLANES[axes[0]] << (quarter << (2 * axes[0]));
        for entry in entries {
            let node = &self.nodes[entry.node as usize];
            let u = [(bounds.u[0] - entry.u) >> shift, (bounds.u[1] - entry.u) >> shift];
            let v = [(bounds.v[0] - entry.v) >> shift, (bounds.v[1] - entry.v) >> shift];
            if u[0] > 3 || u[1] < 0 || v[0] > 3 || v[1] < 0 {
                continue;
            }
            let within =
                slab & slab_mask(axes[1], u[0].max(0), u[1].min(3)) & slab_mask(axes[2], v[0].max(0), v[1].min(3));
            let mut left = node.occupied & within;
            while left != 0 {
                let bit = left.trailing_zeros();
                let before = (left & left.wrapping_neg()) - 1;
                left &= left - 1;
                let u = entry.u + ((bit >> (2 * axes[1]) & 3) << shift) as i32;
                let v = entry.v + ((bit >> (2 * axes[2]) & 3) << shift) as i32;
                let rays = culler.rays_through_cell::<S>(&entry.rays, narrow.as_ref(), u, v, 1 << shift);
                // Both are written and one or none is kept, without a branch, for nobody can predict which.
                let (is_met, is_divided) = (!rays.is_empty(), node.divided >> bit & 1 == 1);
                let child = node.first_node + (node.divided & before).count_ones();
                children.push(NodeEntry { node: child, u, v, rays });
                children.truncate(children.len() - usize::from(!is_met || !is_divided));
                let number = node.first_leaf + (node.occupied & !node.divided & before).count_ones();
                S::prefetch(&self.leaf_starts, number as usize);
                leaves.push(PendingLeaf { number, low: [low, u, v], size: 1 << shift, rays });
                leaves.truncate(leaves.len() - usize::from(!is_met || is_divided));
            }
        }
    }
}

/// For each axis the children of a node that have coordinate 0 along it; shifted by 4^axis for each further one.
const AXIS_PLANES: [u64; 3] = [0x1111_1111_1111_1111, 0x000f_000f_000f_000f, 0xffff];

/// The children of a node with coordinates `first..=last` along an axis.
#[inline(always)]
fn slab_mask(axis: usize, first: i32, last: i32) -> u64 {
    const RANGES: [[[u64; 4]; 4]; 3] = {
        let mut ranges = [[[0; 4]; 4]; 3];
        let mut axis = 0;
        while axis < 3 {
            let mut first = 0;
            while first < 4 {
                let mut last = first;
                let mut mask = 0;
                while last < 4 {
                    mask |= AXIS_PLANES[axis] << (last << (2 * axis));
                    ranges[axis][first][last] = mask;
                    last += 1;
                }
                first += 1;
            }
            axis += 1;
        }
        ranges
    };
    RANGES[axis][first as usize & 3][last as usize & 3]
}

/// The least cell that packets can go through, in world units: the inverse of a depth within a smaller one may be more than
/// single precision holds, and farther hits could not be told from nearer ones.
const SMALLEST_CELL_SIZE: f64 = 1e-30;

/// The least component along the major axis, so that it has an inverse.
const LEAST_COMPONENT: f32 = 1e-30;

/// The axis along which the packets advance most, if all rays advance the same way.
#[inline(always)]
fn major_axis(packets: &[&Packet]) -> Option<usize> {
    let [x, y, z] = [0, 1, 2].map(|axis| packets[0].directions[axis][0].abs());
    let axis = if x >= y && x >= z {
        0
    } else if y >= z {
        1
    } else {
        2
    };
    let sign = packets[0].directions[axis][0].signum();
    let mut same = true;
    for packet in packets {
        for along in packet.directions[axis] {
            same &= along * sign >= LEAST_COMPONENT && along.is_finite();
        }
    }
    same.then_some(axis)
}

/// Leaves wait until together they cover as much as the packet, for then they may well end it.
const FULL_COVERAGE: f64 = 1.0;

/// Leaves that wait at most.
const MOST_LEAVES: usize = 64;
