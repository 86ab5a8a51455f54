//! Tests prepared triangles against groups of rays: by their bounds, then in single precision.
//!
//! Certain misses are dropped, certain hits kept with bounds of their depth; [`super::decide`] decides the rest.

use crate::{
    intersect::packet::{decide::NearestHits, prepared::PreparedTriangles, ray_set::MOST_PACKETS},
    simd::Simd,
};

/// Most groups of rays: with vectors of eight.
const MOST_GROUPS: usize = MOST_PACKETS * 64 / 8;

/// Bounds of all groups, one group a lane.
#[repr(C, align(64))]
pub(super) struct RayGroups {
    /// Least and largest slopes of the rays that had an interval left when the group was last narrowed.
    pub(super) u: [[f32; MOST_GROUPS]; 2],
    pub(super) v: [[f32; MOST_GROUPS]; 2],
    /// The inverse of the farthest limit of a group's rays.
    pub(super) inverse_limits: [f32; MOST_GROUPS],
    /// A bit for each of those rays.
    pub(super) left: [u32; MOST_GROUPS],
}

impl RayGroups {
    /// Groups without rays, whose bounds nothing overlaps.
    pub(super) const NONE: Self = Self {
        u: [[f32::INFINITY; MOST_GROUPS], [f32::NEG_INFINITY; MOST_GROUPS]],
        v: [[f32::INFINITY; MOST_GROUPS], [f32::NEG_INFINITY; MOST_GROUPS]],
        inverse_limits: [f32::INFINITY; MOST_GROUPS],
        left: [0; MOST_GROUPS],
    };
}

/// The rays of packets, in groups, with their nearest hits so far.
pub(super) struct PacketRays<'a, const N: usize> {
    pub(super) u: &'a mut [[f32; 64]; N],
    pub(super) v: &'a mut [[f32; 64]; N],
    pub(super) groups: &'a mut RayGroups,
    pub(super) nearest: NearestHits<'a, N>,
    /// Room for the pairs of one vector of triangles and all groups.
    pub(super) pairs: &'a mut [Pair; 64 * MOST_PACKETS],
    /// Least and largest u, least and largest v, of each packet.
    pub(super) packet_slopes: [[f32; 4]; N],
    /// A bit for each group that has rays without a final answer.
    pub(super) unfinished_groups: u32,
}

/// A triangle, and a group of rays of which some may hit it.
#[derive(Clone, Copy, Default)]
pub(super) struct Pair {
    /// The triangle's lane among the prepared ones.
    lane: u8,
    /// The group's packet, and its first lane there.
    packet: u8,
    first: u8,
    /// A bit for each ray of the group that hits the triangle or misses it by no more than the rounding error.
    possible: u16,
    /// A bit for each ray whose line certainly passes the triangle.
    certain: u16,
}

impl<const N: usize> PacketRays<'_, N> {
    /// Tests the prepared triangles in the mask `triangles` against all rays.
    #[inline(always)]
    pub(super) fn test_prepared<S: Simd>(&mut self, prepared: &PreparedTriangles, triangles: u32) {
        // Test the bounds of the packets. Each step runs for all packets, so that their latencies overlap.
        let mut hit_by_packet = [0; N];
        for packet in 0..N {
            let [u_low, u_high, v_low, v_high] = self.packet_slopes[packet];
            hit_by_packet[packet] = triangles & overlaps_slopes::<S>(prepared, [u_low, u_high], [v_low, v_high]);
        }

        // Test the bounds of the groups of each packet that is left: one, for most triangles.
        let mut met = [0; N];
        for packet in 0..N {
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

        // Test the rays of each pair, and keep those with a possible hit; no branch, as three of four pairs have none.
        let mut n_pairs = 0;
        for packet in 0..N {
            let mut left = met[packet];
            while left != 0 {
                let pair = left.trailing_zeros() as usize;
                left &= left - 1;
                let pair = self.test_sides::<S>(prepared, pair % S::LANES, packet, pair / S::LANES * S::LANES);
                self.pairs[n_pairs] = pair;
                n_pairs += usize::from(pair.possible != 0);
            }
        }

        // Compute the depths of possible hits.
        for index in 0..n_pairs {
            self.record_pair::<S>(prepared, self.pairs[index]);
        }
    }

    /// A bit for each prepared triangle that rays of a group may hit.
    #[inline(always)]
    fn group_may_hit<S: Simd>(&self, prepared: &PreparedTriangles, group: usize) -> u32 {
        let RayGroups { u, v, inverse_limits, .. } = &*self.groups;
        let (u_low, u_high) = (S::splat(u[0][group]), S::splat(u[1][group]));
        let (v_low, v_high) = (S::splat(v[0][group]), S::splat(v[1][group]));
        // Bound the sides of the edges too: a large triangle may pass diagonally beside the group.
        let mut sides = [u_low; 3];
        for edge in 0..3 {
            let (along_u, along_v) = (S::load(&prepared.sides[edge][1]), S::load(&prepared.sides[edge][2]));
            let greatest = S::load(&prepared.greatest_sides[edge]);
            let of_u = along_u.mul(u_low).max(along_u.mul(u_high));
            sides[edge] = along_v.mul_add(v_low, greatest).max(along_v.mul_add(v_high, greatest)).add(of_u);
        }
        overlaps_slopes::<S>(prepared, [u[0][group], u[1][group]], [v[0][group], v[1][group]])
            & S::splat(inverse_limits[group]).le(S::load(&prepared.inverse_depth))
            & !sides[0].min(sides[1]).min(sides[2]).lt(S::splat(0.0))
    }

    /// Bounds the slopes of a group's rays again, of those in the mask `rays`.
    #[inline(always)]
    pub(super) fn narrow_group<S: Simd>(&mut self, group: usize, rays: u32) {
        let (packet, first) = (group * S::LANES / 64 % N, group * S::LANES % 64);
        let RayGroups { u, v, left, .. } = &mut *self.groups;
        left[group] = rays;
        for (bounds, slopes) in [(u, &*self.u), (v, &*self.v)] {
            let slopes = S::load(&slopes[packet][first..]);
            bounds[0][group] = S::select(rays, slopes, S::splat(f32::INFINITY)).reduce_min();
            bounds[1][group] = S::select(rays, slopes, S::splat(f32::NEG_INFINITY)).reduce_max();
        }
    }

    /// Tests a prepared triangle against a packet's group of rays from lane `first` on.
    #[inline(always)]
    fn test_sides<S: Simd>(&self, prepared: &PreparedTriangles, lane: usize, packet: usize, first: usize) -> Pair {
        let (u, v) = (S::load(&self.u[packet][first..]), S::load(&self.v[packet][first..]));
        let mut sides = [u; 3];
        for edge in 0..3 {
            sides[edge] = dot_direction::<S>(&prepared.sides[edge], lane, u, v);
        }

        // A ray passes the triangle if all sides have one sign, by more than the margin.
        let margin = prepared.side_margin[lane];
        let low = sides[0].min(sides[1]).min(sides[2]);
        let high = sides[0].max(sides[1]).max(sides[2]);
        // Least absolute side where the signs agree, else negative.
        let inside = low.max(S::splat(0.0).sub(high));

        // Only triangles that begin before the ray's limit can be hit.
        let inverse_limits = S::load(&self.nearest.hits.inverse_limits[packet][first..]);
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

    /// Keeps the certain hits of a pair, and queues the others for the exact test.
    #[inline(always)]
    fn record_pair<S: Simd>(&mut self, prepared: &PreparedTriangles, pair: Pair) {
        let (lane, packet, first) = (usize::from(pair.lane), usize::from(pair.packet) % N, usize::from(pair.first));
        let (possible, certain) = (u32::from(pair.possible), u32::from(pair.certain));
        let (u, v) = (S::load(&self.u[packet][first..]), S::load(&self.v[packet][first..]));

        // Bound the inverse depths of the hits.
        let inverse_depths = dot_direction::<S>(&prepared.plane, lane, u, v);
        let [relative, absolute] = &prepared.plane_margins;
        let error = inverse_depths.abs().mul_add(S::splat(relative[lane]), S::splat(absolute[lane]));
        let bounds = [inverse_depths.sub(error), inverse_depths.add(error)];

        // Keep estimates; queue uncertain rays, and hits whose bounds overlap with others.
        let triangle = prepared.triangle_indices[lane];
        let undecided = self.nearest.keep_estimate::<S>(triangle, packet, first, certain, bounds);
        let rest = possible & !certain | undecided;
        if rest != 0 {
            self.nearest.queue_exact_test::<S>(triangle, 64 * packet + first, rest);
        }

        // Where any hit will do, a group whose rays all have one needs no further triangle.
        if self.nearest.packets[packet].any_hit {
            let inverse_limits = S::load(&self.nearest.hits.inverse_limits[packet][first..]);
            let is_finished = inverse_limits.lt(S::splat(f32::INFINITY)) == 0;
            self.unfinished_groups &= !(u32::from(is_finished) << ((64 * packet + first) / S::LANES));
        }
    }
}

/// A bit for each prepared triangle whose bounds of slopes overlap these.
#[inline(always)]
fn overlaps_slopes<S: Simd>(prepared: &PreparedTriangles, u: [f32; 2], v: [f32; 2]) -> u32 {
    S::load(&prepared.u[0]).le(S::splat(u[1]))
        & S::splat(u[0]).le(S::load(&prepared.u[1]))
        & S::load(&prepared.v[0]).le(S::splat(v[1]))
        & S::splat(v[0]).le(S::load(&prepared.v[1]))
}

/// Dot product of a prepared vector with the rays' directions, of length 1 along the major axis.
#[inline(always)]
fn dot_direction<S: Simd>(vector: &[[f32; 16]; 3], lane: usize, u: S, v: S) -> S {
    u.mul_add(S::splat(vector[1][lane]), v.mul_add(S::splat(vector[2][lane]), S::splat(vector[0][lane])))
}
