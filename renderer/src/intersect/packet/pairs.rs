//! Which of many rays may hit a few triangles: pairs of a triangle and a group of rays, as many rays as a vector has
//! lanes, are found by bounds, and then tested in single precision.
//!
//! What certainly misses is dropped, what certainly hits is kept with bounds of its depth, and [`crate::intersect::packet::decide`] decides
//! what is between.

use crate::intersect::{
    packet::{
        cull::{Culler, RayGroups},
        prepared::PreparedTriangles,
    },
    simd::Simd,
};

/// A triangle and a group of rays some of which may hit it.
#[derive(Clone, Copy, Default)]
pub(crate) struct Pair {
    /// The lane of the triangle among those that are prepared.
    lane: u8,
    /// The group's packet and its first ray there.
    packet: u8,
    first: u8,
    /// A bit for each ray of the group that may hit the triangle, or pass beside it by as much as rounding can do.
    possible: u16,
    /// Those of them whose lines certainly pass the triangle.
    certain: u16,
}

impl<const N: usize> Culler<'_, N> {
    /// Tests prepared triangles against all rays.
    #[inline(always)]
    pub(crate) fn test_prepared<S: Simd>(&mut self, prepared: &PreparedTriangles, triangles: u32) {
        // Step by step for all packets, for whatever decides whether to go on is known late.
        let mut hit_by_packet = [0; N];
        for packet in 0..N {
            let [u_low, u_high, v_low, v_high] = self.packet_slopes[packet];
            hit_by_packet[packet] = triangles & overlaps_slopes::<S>(prepared, [u_low, u_high], [v_low, v_high]);
        }
        let mut met = [0; N];
        for packet in 0..N {
            // Most triangles are met by one packet alone.
            if hit_by_packet[packet] == 0 {
                continue;
            }
            for group_of_packet in 0..64 / S::LANES {
                let group = packet * (64 / S::LANES) + group_of_packet;
                let group_hits = hit_by_packet[packet] & self.group_may_hit::<S>(prepared, group);
                met[packet] |=
                    u64::from(group_hits * (self.unfinished_groups >> group & 1)) << (group_of_packet * S::LANES);
            }
        }
        let mut n_pairs = 0;
        for packet in 0..N {
            let mut left = met[packet];
            while left != 0 {
                let pair = left.trailing_zeros() as usize;
                left &= left - 1;
                let pair = self.test_sides::<S>(prepared, pair % S::LANES, packet, pair / S::LANES * S::LANES);
                // Without a branch: three of four pairs are none.
                self.pairs[n_pairs] = pair;
                n_pairs += usize::from(pair.possible != 0);
            }
        }
        for index in 0..n_pairs {
            self.record_pair::<S>(prepared, self.pairs[index]);
        }
    }

    /// A bit for each prepared triangle that rays of a group may meet.
    #[inline(always)]
    fn group_may_hit<S: Simd>(&self, prepared: &PreparedTriangles, group: usize) -> u32 {
        let RayGroups { u, v, centres, inverse_limits } = &*self.groups;
        let (u_middle, v_middle) = (S::splat(centres[0][group]), S::splat(centres[1][group]));
        // Bounds across the axes meet where a large triangle passes beside the group.
        let mut sides = [u_middle; 3];
        for edge in 0..3 {
            let along_v = S::load(&prepared.sides[edge][2]).mul_add(v_middle, S::load(&prepared.group_sides[edge]));
            sides[edge] = S::load(&prepared.sides[edge][1]).mul_add(u_middle, along_v);
        }
        overlaps_slopes::<S>(prepared, [u[0][group], u[1][group]], [v[0][group], v[1][group]])
            & S::splat(inverse_limits[group]).le(S::load(&prepared.inverse_depth))
            & !sides[0].min(sides[1]).min(sides[2]).lt(S::splat(0.0))
    }

    /// Tests a prepared triangle against a packet's group of rays from number `first` on.
    #[inline(always)]
    fn test_sides<S: Simd>(&self, prepared: &PreparedTriangles, lane: usize, packet: usize, first: usize) -> Pair {
        let (u, v) = (S::load(&self.u[packet][first..]), S::load(&self.v[packet][first..]));
        let mut sides = [u; 3];
        for edge in 0..3 {
            sides[edge] = dot_direction::<S>(&prepared.sides[edge], lane, u, v);
        }
        let margin = prepared.side_margin[lane];
        let low = sides[0].min(sides[1]).min(sides[2]);
        let high = sides[0].max(sides[1]).max(sides[2]);
        // How far all sides are on one side of zero, whichever.
        let inside = low.max(S::splat(0.0).sub(high));
        let inverse_limits = S::load(&self.nearest.inverse_limits(packet)[first..]);
        let possible = inverse_limits.le(S::splat(prepared.inverse_depth[lane])) & !inside.lt(S::splat(-margin));
        let certain = possible & S::splat(margin).lt(inside);
        Pair {
            lane: lane as u8,
            packet: packet as u8,
            first: first as u8,
            possible: possible as u16,
            certain: certain as u16,
        }
    }

    /// Keeps what is certain about a pair, and has the rest decided.
    #[inline(always)]
    fn record_pair<S: Simd>(&mut self, prepared: &PreparedTriangles, pair: Pair) {
        let (lane, packet, first) = (usize::from(pair.lane), usize::from(pair.packet) % N, usize::from(pair.first));
        let (possible, certain) = (u32::from(pair.possible), u32::from(pair.certain));
        let (u, v) = (S::load(&self.u[packet][first..]), S::load(&self.v[packet][first..]));
        let inverse_depths = dot_direction::<S>(&prepared.plane, lane, u, v);
        let [relative, absolute] = &prepared.plane_margins;
        let error = inverse_depths.abs().mul_add(S::splat(relative[lane]), S::splat(absolute[lane]));
        let bounds = [inverse_depths.sub(error), inverse_depths.add(error)];
        let triangle = prepared.triangle_indices[lane];
        let undecided = self.nearest.keep_estimate::<S>(triangle, packet, first, certain, bounds);
        let rest = possible & !certain | undecided;
        if rest != 0 {
            self.nearest.queue_exact_test::<S>(triangle, 64 * packet + first, rest);
        }
    }
}

/// A bit for each prepared triangle that has slopes between these.
#[inline(always)]
fn overlaps_slopes<S: Simd>(prepared: &PreparedTriangles, u: [f32; 2], v: [f32; 2]) -> u32 {
    S::load(&prepared.u[0]).le(S::splat(u[1]))
        & S::splat(u[0]).le(S::load(&prepared.u[1]))
        & S::load(&prepared.v[0]).le(S::splat(v[1]))
        & S::splat(v[0]).le(S::load(&prepared.v[1]))
}

/// The product of a prepared triangle's vector and the directions of rays that advance by one along the major axis.
#[inline(always)]
fn dot_direction<S: Simd>(vector: &[[f32; 16]; 3], lane: usize, u: S, v: S) -> S {
    u.mul_add(S::splat(vector[1][lane]), v.mul_add(S::splat(vector[2][lane]), S::splat(vector[0][lane])))
}
