//! Finds the bricks and children of nodes in a slab that packets may pass.

use super::{
    NodeEntry, PendingLeaf,
    cull::Culler,
    frustum::{CellBounds, NarrowSlab},
    kernel::PacketKernel,
};
use crate::grid::tree::{BRICK_SIZE, LEVELS, Tree};

impl Tree {
    /// Collects the occupied bricks of a slab that some rays may pass: leaves in `leaves`, divided bricks in `entries`.
    #[inline(always)]
    #[expect(clippy::too_many_arguments, reason = "inlined into the loop whose variables these are")]
    pub(super) fn enter_bricks<S: PacketKernel, const N: usize>(
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
        // Visit each occupied brick within the bounds.
        let first = (low >> shift) as usize * strides[axes[0]];
        for v in bounds.v[0] >> shift..=bounds.v[1] >> shift {
            for u in bounds.u[0] >> shift..=bounds.u[1] >> shift {
                let brick = self.bricks[first + u as usize * strides[axes[1]] + v as usize * strides[axes[2]]];
                if brick == Self::EMPTY {
                    continue;
                }

                // Keep it with the rays that may pass it.
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

    /// Collects the occupied children of `entries`, in one quarter of their slab, that some rays may pass: leaves in
    /// `leaves`, divided children in `children`.
    #[inline(always)]
    #[expect(clippy::too_many_arguments, reason = "inlined into the loop whose variables these are")]
    pub(super) fn enter_children<S: PacketKernel, const N: usize>(
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
            // Mask the children that lie in the quarter and within the bounds.
            let node = &self.nodes[entry.node as usize];
            let u = [(bounds.u[0] - entry.u) >> shift, (bounds.u[1] - entry.u) >> shift];
            let v = [(bounds.v[0] - entry.v) >> shift, (bounds.v[1] - entry.v) >> shift];
            if u[0] > 3 || u[1] < 0 || v[0] > 3 || v[1] < 0 {
                continue;
            }
            let within =
                slab & slab_mask(axes[1], u[0].max(0), u[1].min(3)) & slab_mask(axes[2], v[0].max(0), v[1].min(3));

            // Visit each occupied one.
            let mut left = node.occupied & within;
            while left != 0 {
                let bit = left.trailing_zeros();
                let before = (left & left.wrapping_neg()) - 1;
                left &= left - 1;

                // Find the rays that may pass the child.
                let u = entry.u + ((bit >> (2 * axes[1]) & 3) << shift) as i32;
                let v = entry.v + ((bit >> (2 * axes[2]) & 3) << shift) as i32;
                let rays = culler.rays_through_cell::<S>(&entry.rays, narrow.as_ref(), u, v, 1 << shift);

                // Write it as a node and as a leaf, and keep one or neither: a branch here would be unpredictable.
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

/// For each axis the mask of the children with coordinate 0 along it; shifted left by 4^axis for each further
/// coordinate.
const AXIS_PLANES: [u64; 3] = [0x1111_1111_1111_1111, 0x000f_000f_000f_000f, 0xffff];

/// Mask of the children with coordinates `first..=last` along an axis.
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
