//! Traces packets of 64 rays with a common origin through the tree, up to four packets together.
//!
//! A step costs by the width of its slab, not by the rays, and four tiles in a square are only twice as wide as one.
//!
//! After Wald et al., "Ray Tracing Animated Scenes using Coherent Grid Traversal" (2006): the grid is cut into slabs
//! across the packets' major axis k, and their least and largest slopes bound the cells (u, v) that they can pass in a
//! slab. Slabs are as thick as a brick, then as a tree node's children, and so on down; a node's mask gives all
//! occupied children within the bounds at once ([`slab`]).
//!
//! [`cull`] drops triangles that certainly miss, [`pairs`] tests the others against groups of rays, and [`decide`]
//! keeps the nearest hits, with [`crate::intersect::triangle`] for doubtful ones: hits are those of single rays, bit
//! for bit.

mod cull;
#[expect(clippy::needless_range_loop, reason = "an axis, a corner or a lane indexes several arrays at once")]
mod decide;
mod frustum;
mod kernel;
#[expect(clippy::needless_range_loop, reason = "an edge indexes several arrays at once")]
mod pairs;
#[expect(clippy::needless_range_loop, reason = "an axis or an edge indexes several arrays at once")]
mod prepared;
mod ray_set;
mod slab;

#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::{
    grid::{
        Grid, Structure,
        tree::{BRICK_SIZE, LEVELS, Tree, boxes::LeafGroups},
    },
    intersect::ray::{Hit, Ray, major_axis},
    simd::{InstructionSet, Portable},
};
use cull::{CullScratch, Culler};
use frustum::Frustum;
use kernel::PacketKernel;
use ray_set::RaySet;

pub use ray_set::{MOST_PACKETS, Packet};

/// Memory that one thread reuses from packet to packet.
#[derive(Default)]
pub struct PacketScratch {
    one: Scratch<1>,
    four: Scratch<MOST_PACKETS>,
}

/// The part of it for `N` packets that are traced together.
#[derive(Default)]
struct Scratch<const N: usize> {
    /// Tree nodes that the packets pass in the current slab, by level: bricks at index 1; the last entry takes the
    /// children that are written and not kept.
    entries: [Vec<NodeEntry<N>>; LEVELS as usize + 2],
    /// Leaves that the packets pass, whose triangles wait for their test.
    leaves: Vec<PendingLeaf<N>>,
    cull: CullScratch<N>,
}

/// A tree node within the packets' bounds.
#[derive(Clone, Copy)]
struct NodeEntry<const N: usize> {
    node: u32,
    /// Its lowest corner across the major axis, in finest cells.
    u: i32,
    v: i32,
    rays: RaySet<N>,
}

/// A leaf that some rays may pass.
#[derive(Clone, Copy)]
struct PendingLeaf<const N: usize> {
    number: u32,
    /// Its lowest corner along the major axis and across, and its size, in finest cells.
    low: [i32; 3],
    size: i32,
    rays: RaySet<N>,
}

impl Grid {
    /// The nearest hit of each ray of a packet; hits of inactive lanes are undefined.
    pub fn intersect_packet(&self, packet: &Packet, scratch: &mut PacketScratch) -> [Hit; 64] {
        let mut hits = [[Hit::MISS; 64]];
        if !self.trace_together([packet], RaySet { masks: [packet.active] }, &mut scratch.one, &mut hits) {
            for (lane, hit) in hits[0].iter_mut().enumerate().filter(|(lane, _)| packet.active >> lane & 1 == 1) {
                *hit = self.intersect(&packet.ray(lane));
            }
        }
        hits[0]
    }

    /// The same for packets with a common origin that all ask for the nearest hits, or all for any, [`MOST_PACKETS`] at a time:
    /// faster, the closer they lie together. `hits` has an entry for each packet.
    pub fn intersect_packets(&self, packets: &[Packet], scratch: &mut PacketScratch, hits: &mut [[Hit; 64]]) {
        let fits = |packet: &Packet| packet.origin == packets[0].origin && packet.any_hit == packets[0].any_hit;
        debug_assert!(packets.len() == hits.len() && packets.iter().all(fits));
        for (packets, hits) in packets.chunks(MOST_PACKETS).zip(hits.chunks_mut(MOST_PACKETS)) {
            if let (Some(four), Some(hits)) = (packets.as_array::<MOST_PACKETS>(), hits.as_mut_array()) {
                let masks = std::array::from_fn(|index| four[index].active);
                if self.trace_together(four.each_ref(), RaySet { masks }, &mut scratch.four, hits) {
                    continue;
                }
            } else if packets.len() > 1 {
                // Fill up with copies of the first packet, without active rays.
                let four = std::array::from_fn(|index| packets.get(index).unwrap_or(&packets[0]));
                let masks = std::array::from_fn(|index| packets.get(index).map_or(0, |packet| packet.active));
                let mut quad_hits = [[Hit::MISS; 64]; MOST_PACKETS];
                if self.trace_together(four, RaySet { masks }, &mut scratch.four, &mut quad_hits) {
                    hits.copy_from_slice(&quad_hits[..packets.len()]);
                    continue;
                }
            }
            // A last packet alone, or packets that do not share a major axis.
            for (packet, hits) in packets.iter().zip(hits) {
                *hits = self.intersect_packet(packet, scratch);
            }
        }
    }

    /// Traces the active rays of packets together. Returns false if they must be traced one by one: the grid is no
    /// tree, its cells are too small, or the rays share no major axis.
    fn trace_together<const N: usize>(
        &self,
        packets: [&Packet; N],
        active: RaySet<N>,
        scratch: &mut Scratch<N>,
        hits: &mut [[Hit; 64]; N],
    ) -> bool {
        let Structure::Tree(tree) = &self.structure else { return false };
        if self.space.length_to_model(1.0) < SMALLEST_CELL_SIZE {
            return false;
        }
        let is_traced = match self.instructions {
            InstructionSet::Portable => Portable::march(self, tree, packets, active, scratch, hits),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => Avx2::march(self, tree, packets, active, scratch, hits),
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => Avx512::march(self, tree, packets, active, scratch, hits),
        };
        if is_traced && self.mesh.has_masks() {
            for (packet, hits) in packets.into_iter().zip(hits) {
                self.pass_gaps(packet, hits);
            }
        }
        is_traced
    }

    /// Traces rays again, alone, that hit a triangle where its material is missing.
    fn pass_gaps(&self, packet: &Packet, hits: &mut [Hit; 64]) {
        for (lane, hit) in hits.iter_mut().enumerate().filter(|(lane, _)| packet.active >> lane & 1 == 1) {
            let ray = packet.ray(lane);
            if hit.is_miss() || !self.mesh.is_passed(hit.triangle, &ray) {
                continue;
            }
            *hit = match packet.any_hit {
                true if self.occluded(&ray) => *hit,
                true => Hit::MISS,
                // All other hits are as far or farther, in `f64`.
                false => self.intersect(&Ray { t_min: ray.t_min.max(hit.t.next_down()), ..ray }),
            };
        }
    }

    /// Traces packets together, slab by slab from their origin on. Returns false, without hits, if not all rays advance
    /// the same way along one axis.
    #[inline(always)]
    fn march<S: PacketKernel, const N: usize>(
        &self,
        tree: &Tree,
        packets: [&Packet; N],
        mut active: RaySet<N>,
        scratch: &mut Scratch<N>,
        hits: &mut [[Hit; 64]; N],
    ) -> bool {
        // Choose the axes: k is the major axis, u and v lie across it.
        let Some(axis) = common_major_axis(&packets) else { return false };
        let Scratch { entries, leaves, cull } = scratch;
        let axes = [axis, (axis + 1) % 3, (axis + 2) % 3];
        let is_forward = packets[0].directions[axis][0] > 0.0;
        let origin = self.space.point_to_cells(packets[0].origin.as_dvec3());
        if !origin.is_finite() {
            return false;
        }

        // Bound all rays by a frustum, in finest cells.
        let mut frustum = Frustum {
            origin: [origin[axes[0]], origin[axes[1]], origin[axes[2]]],
            is_forward,
            slopes: cull.compute_slopes::<S>(&packets, axes),
            size: [f64::from(tree.extent[axes[1]]), f64::from(tree.extent[axes[2]])],
            cells_per_unit: self.space.cells_per_unit,
            margin: origin.abs().max_element() * (16.0 * f64::EPSILON),
        };

        // Leave packets that miss the grid before their groups are set up: saves 2 % on a board seen whole.
        let bricks_along_k = tree.dims[axis] as i32;
        let (near, far) = frustum.depths(0, tree.extent[axis] as i32);
        if far < 0.0 || frustum.cells(near, far).is_none() {
            hits.fill([Hit::MISS; 64]);
            return true;
        }

        // Set up the rays' groups, then find the first slab of bricks that rays enter within their intervals.
        let least_start = f64::from(cull.hits.set_intervals(&packets, &mut active, axis));
        let start_depth = (least_start * (1.0 - 1e-6) * self.space.cells_per_unit - frustum.margin).max(0.0);
        let mut culler =
            Culler::new::<S>(self, &tree.items, packets, active, axes, if is_forward { 1.0 } else { -1.0 }, cull);
        frustum.slopes = culler.ray_bounds.slopes;
        let entry_depth = frustum.entry_depth().max(start_depth);
        let entry_k = entry_depth - frustum.margin;
        let k = frustum.origin[0] + if is_forward { entry_k } else { -entry_k };
        let mut brick_k = (k / f64::from(BRICK_SIZE)).floor() as i32;
        if (is_forward && brick_k >= bricks_along_k) || (!is_forward && brick_k < 0) || !entry_depth.is_finite() {
            hits.fill([Hit::MISS; 64]);
            return true;
        }
        brick_k = brick_k.clamp(0, bricks_along_k - 1);

        // March from slab to slab of bricks until all rays have their hits or leave the grid.
        let mut coverage = 0.0;
        let mut pending_near_depth = 0.0f64;
        leaves.clear();
        while (0..bricks_along_k).contains(&brick_k) {
            let low = brick_k * BRICK_SIZE as i32;
            brick_k += if is_forward { 1 } else { -1 };

            // Bound the slab's cells; without any the frustum is beside the grid, and past it for good once it has
            // entered.
            let (near, far) = frustum.depths(low, BRICK_SIZE as i32);
            let Some(bounds) = frustum.cells(near, far) else {
                // A narrowed frustum may still be before the grid.
                if near > frustum.entry_depth() {
                    break;
                }
                continue;
            };

            // Collect the bricks within the bounds; test those that are leaves at once.
            let narrow = frustum.narrow(near, far, BRICK_SIZE);
            tree.enter_bricks::<S, N>(&culler, leaves, &mut entries[1], axes, low, bounds, narrow);
            if !leaves.is_empty() {
                S::test_leaves(tree, &mut culler, &frustum.origin, leaves);
            }

            // Without divided bricks the slab is done: settle the rays up to its far side.
            if entries[1].is_empty() {
                if culler.has_new_tests && culler.finish_to_depth::<S>(self.space.length_to_model(far)) {
                    culler.rays.nearest.write::<S>(hits);
                    return true;
                }
                frustum.slopes = culler.ray_bounds.slopes;
                continue;
            }

            // Descend depth first: each slab consists of four quarters, one child thick. `lows` holds the slab of each
            // level, `steps` how many of its quarters are done.
            let mut level = 1;
            let mut lows = [low; LEVELS as usize + 1];
            let mut steps = [0; LEVELS as usize + 1];
            while level > 0 {
                if steps[level] == 4 {
                    level -= 1;
                    continue;
                }

                // Take the level's next quarter, and bound the cells that the frustum passes in it.
                let quarter = if is_forward { steps[level] } else { 3 - steps[level] };
                steps[level] += 1;
                let shift = 2 * (LEVELS - level as u32);
                let low = lows[level] + (quarter << shift);
                let (near, far) = frustum.depths(low, 1 << shift);
                if far < start_depth {
                    continue;
                }
                let Some(bounds) = frustum.cells(near, far) else { continue };

                // Collect the children within the bounds: nodes for the next level, leaves for their test.
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

                // Test the pending leaves once together they may cover the packets.
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

                // Descend into the nodes; without any settle the rays, and narrow the frustum to those without a final
                // answer.
                if !children.is_empty() {
                    level += 1;
                    (lows[level], steps[level]) = (low, 0);
                } else if culler.has_new_tests {
                    // Pending leaves may lie nearer than leaves that were tested.
                    let tested_to = if leaves.is_empty() { far } else { pending_near_depth.min(far) };
                    if culler.finish_to_depth::<S>(self.space.length_to_model(tested_to)) {
                        culler.rays.nearest.write::<S>(hits);
                        return true;
                    }
                    frustum.slopes = culler.ray_bounds.slopes;
                }
            }
        }

        // Behind the last slab: test the pending leaves and settle all rays.
        S::test_leaves(tree, &mut culler, &frustum.origin, leaves);
        culler.finish_to_depth::<S>(f64::INFINITY);
        culler.rays.nearest.write::<S>(hits);
        true
    }
}

impl Tree {
    #[inline(always)]
    fn test_leaves<S: PacketKernel, const N: usize>(
        &self,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<PendingLeaf<N>>,
    ) {
        // Prefetch the boxes and items of all leaves, so that their cache misses overlap.
        for leaf in &*leaves {
            let items = self.items_of(leaf.number);
            self.items.prefetch::<S>(items.start);
            self.boxes.prefetch::<S>(items);
        }

        // Gather the triangles whose boxes some ray may pass.
        for leaf in &*leaves {
            let items = self.items_of(leaf.number);
            let mut corner_from_origin = [0.0; 3];
            for local_axis in 0..3 {
                corner_from_origin[local_axis] = f64::from(leaf.low[local_axis]) - origin[local_axis];
            }
            let groups = LeafGroups::new(
                self.boxes.of_groups(leaf.number, items.clone()),
                culler.ray_bounds.axes,
                culler.ray_bounds.sign < 0.0,
                corner_from_origin,
                leaf.size,
            );
            culler.gather::<S>(&groups, &self.boxes, items, &leaf.rays);
        }
        culler.find_triangles::<S>();
        leaves.clear();
        culler.has_new_tests = true;
    }
}

/// Smallest cell size for packets, in world units: within smaller cells inverse depths may overflow single precision,
/// and nearer hits would be confused with farther ones.
const SMALLEST_CELL_SIZE: f64 = 1e-30;

/// Least component of a direction along the major axis, so that its inverse is finite.
const LEAST_COMPONENT: f32 = 1e-30;

/// The axis along which the first ray advances most, if all rays of all packets advance the same way along it.
#[inline(always)]
fn common_major_axis(packets: &[&Packet]) -> Option<usize> {
    let axis = major_axis([0, 1, 2].map(|axis| packets[0].directions[axis][0]));
    // All rays must share the sign of the first.
    let sign = packets[0].directions[axis][0].signum();
    let mut same = true;
    for packet in packets {
        for along in packet.directions[axis] {
            same &= along * sign >= LEAST_COMPONENT && along.is_finite();
        }
    }
    same.then_some(axis)
}

/// Leaves wait until their area is this multiple of the frustum's section: then they may well hold the nearest hits.
const FULL_COVERAGE: f64 = 1.0;

const MOST_LEAVES: usize = 64;
