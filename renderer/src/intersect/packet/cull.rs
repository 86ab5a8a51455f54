//! From the triangles in packets' way to those that some rays may hit: gathers triangles, and culls them many at a
//! time by their boxes; [`crate::intersect::packet::pairs`] tests the rest against rays, and [`crate::intersect::packet::decide`] decides.
//!
//! Everything here may only drop triangles that certainly miss, with rounding accounted for.
//! There are no closures over vectors: they would not be compiled for the caller's instruction set.
//!
//! How far away something is, is told by inverse depths along the major axis: across a triangle's plane they are linear
//! in the rays' slopes, so that no ray needs a division.

use crate::{
    grid::{
        Grid,
        traced::TracedMesh,
        tree::boxes::{BoxLanes, LeafBoxes},
    },
    intersect::{
        kernel::PacketKernel,
        packet::{
            MOST_PACKETS, Packet,
            decide::{HitScratch, NearestHits},
            frustum::NarrowSlab,
            pairs::Pair,
            prepared::{PreparedTriangles, RayBounds, SLOPE_MARGIN, UNDERFLOW_MARGIN},
            ray_set::RaySet,
        },
        ray::Hit,
        simd::Simd,
    },
};

/// From so many triangles for each ray on, a leaf's boxes are tested against its rays one by one: in a scan seen from
/// afar most triangles lie between the rays.
const RAY_BY_RAY_RATIO: usize = 3;

/// Triangles remembered as already tested, a power of two.
const N_RECENT: usize = 1024;

/// Triangles that can wait for their test, a power of two.
const N_WAITING: usize = 256;

/// Groups of rays at most, with vectors of eight.
const MOST_GROUPS: usize = MOST_PACKETS * 64 / 8;

/// The bounds of groups of rays, as many each as a vector has lanes.
#[repr(C, align(64))]
pub(crate) struct RayGroups {
    /// Least and largest slopes.
    pub(crate) u: [[f32; MOST_GROUPS]; 2],
    pub(crate) v: [[f32; MOST_GROUPS]; 2],
    /// The middles between them, of u and of v.
    pub(crate) centres: [[f32; MOST_GROUPS]; 2],
    /// The inverse of the farthest of their rays' limits.
    pub(crate) inverse_limits: [f32; MOST_GROUPS],
}

impl RayGroups {
    /// Groups that nothing passes, for they have no rays.
    const NONE: Self = Self {
        u: [[f32::INFINITY; MOST_GROUPS], [f32::NEG_INFINITY; MOST_GROUPS]],
        v: [[f32::INFINITY; MOST_GROUPS], [f32::NEG_INFINITY; MOST_GROUPS]],
        centres: [[0.0; MOST_GROUPS]; 2],
        inverse_limits: [f32::INFINITY; MOST_GROUPS],
    };
}

/// The memory of a [`Culler`], made ready anew for each: it is too much to be moved about. Vectors come first, where they
/// are aligned.
#[repr(C, align(64))]
pub(crate) struct CullScratch<const N: usize> {
    /// Slopes of the rays against the major axis.
    u: [[f32; 64]; N],
    v: [[f32; 64]; N],
    groups: RayGroups,
    hits: HitScratch<N>,
    /// Triangles that wait until a vector is full, and a vector more.
    waiting: [u32; N_WAITING + 16],
    recent: [u32; N_RECENT],
    pairs: [Pair; 64 * MOST_PACKETS],
}

impl<const N: usize> Default for CullScratch<N> {
    fn default() -> Self {
        Self {
            u: [[0.0; 64]; N],
            v: [[0.0; 64]; N],
            groups: RayGroups::NONE,
            hits: HitScratch::default(),
            waiting: [0; N_WAITING + 16],
            recent: [0; N_RECENT],
            pairs: [Pair::default(); 64 * MOST_PACKETS],
        }
    }
}

impl<const N: usize> CullScratch<N> {
    /// Finds the slopes of packets' rays against the major axis, and returns their bounds: least and largest u, least and
    /// largest v. In place of limits, which are not known yet, it leaves the inverse of the depth of each ray's t = 1.
    #[inline(always)]
    pub(crate) fn compute_slopes<S: Simd>(&mut self, packets: &[&Packet; N], axes: [usize; 3]) -> [f32; 4] {
        let (lowest, highest) = (S::splat(f32::INFINITY), S::splat(f32::NEG_INFINITY));
        let mut bounds = [lowest, highest, lowest, highest];
        for (index, packet) in packets.iter().enumerate() {
            let directions = &packet.directions;
            for lane in (0..64).step_by(S::LANES) {
                let inverse_depth = S::splat(1.0).div(S::load(&directions[axes[0]][lane..]).abs());
                let u = S::load(&directions[axes[1]][lane..]).mul(inverse_depth);
                let v = S::load(&directions[axes[2]][lane..]).mul(inverse_depth);
                u.store(&mut self.u[index][lane..]);
                v.store(&mut self.v[index][lane..]);
                inverse_depth.store(&mut self.hits.inverse_limits[index][lane..]);
                bounds = [bounds[0].min(u), bounds[1].max(u), bounds[2].min(v), bounds[3].max(v)];
            }
        }
        widen_slopes([bounds[0].reduce_min(), bounds[1].reduce_max(), bounds[2].reduce_min(), bounds[3].reduce_max()])
    }
}

/// Bounds of slopes, least and largest in turn, with rounding accounted for, and at least so much wider that none is equal
/// to what it bounds.
#[inline(always)]
fn widen_slopes(mut bounds: [f32; 4]) -> [f32; 4] {
    for index in [0, 2] {
        bounds[index] -= bounds[index].abs() * SLOPE_MARGIN + UNDERFLOW_MARGIN;
        bounds[index + 1] += bounds[index + 1].abs() * SLOPE_MARGIN + UNDERFLOW_MARGIN;
    }
    bounds
}

/// Numbers with a minus where nothing from `low` to `high` lies within the bounds.
#[inline(always)]
fn interval_miss_signs<S: Simd>(low: S, high: S, bounds: [S; 2]) -> S {
    high.sub(bounds[0]).or(bounds[1].sub(low))
}

/// Packets on their way, with the nearest hits so far.
pub(crate) struct Culler<'a, const N: usize> {
    pub(crate) u: &'a mut [[f32; 64]; N],
    pub(crate) v: &'a mut [[f32; 64]; N],
    pub(crate) groups: &'a mut RayGroups,
    pub(crate) nearest: NearestHits<'a, N>,
    waiting: &'a mut [u32; N_WAITING + 16],
    n_waiting: usize,
    /// How many of them, from the first on, [`Culler::drop_recently_tested`] has been through.
    n_deduplicated: usize,
    recent: &'a mut [u32; N_RECENT],
    /// Room for the pairs of one vector of triangles and all groups.
    pub(crate) pairs: &'a mut [Pair; 64 * MOST_PACKETS],
    mesh: &'a TracedMesh,
    /// The rays that there are.
    pub(crate) active: RaySet<N>,
    pub(crate) ray_bounds: RayBounds,
    /// Least and largest u, least and largest v, of each packet.
    pub(crate) packet_slopes: [[f32; 4]; N],
    /// The side of a finest cell in world units, rounded down.
    cell_length: f32,
    /// The inverse of the farthest limit of all rays without a final answer, per finest cell.
    least_inverse_limit: f32,
    /// A bit for each group that has rays without a final answer.
    pub(crate) unfinished_groups: u32,
    /// Whether triangles were met since [`Culler::finish_to_depth`].
    pub(crate) has_new_tests: bool,
}

impl<'a, const N: usize> Culler<'a, N> {
    /// Takes the active rays of packets in which all rays have the sign `sign` along `axes[0]`, and whose slopes `scratch`
    /// has found.
    #[inline(always)]
    pub(crate) fn new<S: Simd>(
        grid: &'a Grid,
        packets: [&'a Packet; N],
        active: RaySet<N>,
        axes: [usize; 3],
        sign: f32,
        scratch: &'a mut CullScratch<N>,
    ) -> Self {
        let mesh = &grid.mesh;
        let CullScratch { u, v, groups, hits, waiting, recent, pairs } = scratch;
        *groups = RayGroups::NONE;
        recent.fill(u32::MAX);
        let origin = packets[0].origin.to_array();
        let mut culler = Self {
            u,
            v,
            groups,
            nearest: NearestHits::new(mesh, packets, axes[0], hits),
            waiting,
            n_waiting: 0,
            n_deduplicated: 0,
            recent,
            pairs,
            mesh,
            active,
            ray_bounds: RayBounds { origin, axes, sign, slopes: [0.0; 4], reach: [1.0; 3], group_half_width: [0.0; 2] },
            packet_slopes: [[f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY]; N],
            cell_length: (grid.space.length_to_world(1.0) * (1.0 - 1e-6)) as f32,
            least_inverse_limit: 0.0,
            unfinished_groups: 0,
            has_new_tests: false,
        };
        let mut reach = [S::splat(0.0); 2];
        for (index, packet) in packets.iter().enumerate() {
            // Numbers too small for all their bits are slow to find and to calculate with: zero in their place.
            // What is too large for a number is the largest: a limit may be too far away, not too near.
            let inverse_t_max = if packet.t_max > 1e30 { 0.0 } else { ((1.0 - 1e-6) / packet.t_max).min(f32::MAX) };
            for group_of_packet in 0..64 / S::LANES {
                let lane = group_of_packet * S::LANES;
                let group = index * (64 / S::LANES) + group_of_packet;
                let (u, v) = (S::load(&culler.u[index][lane..]), S::load(&culler.v[index][lane..]));
                let inverse_depth = S::load(&culler.nearest.inverse_limits(index)[lane..]);
                let inverse_limits = inverse_depth.mul(S::splat(inverse_t_max)).sub(S::splat(UNDERFLOW_MARGIN));
                let inverse_limits = inverse_limits.max(S::splat(0.0));
                inverse_limits.store(&mut culler.nearest.inverse_limits_mut(index)[lane..]);
                let [u_low, u_high, v_low, v_high] = [u.reduce_min(), u.reduce_max(), v.reduce_min(), v.reduce_max()];
                (culler.groups.u[0][group], culler.groups.u[1][group]) = (u_low, u_high);
                (culler.groups.v[0][group], culler.groups.v[1][group]) = (v_low, v_high);
                culler.groups.inverse_limits[group] = inverse_limits.reduce_min();
                let packet_bounds = &mut culler.packet_slopes[index];
                *packet_bounds = [
                    packet_bounds[0].min(u_low),
                    packet_bounds[1].max(u_high),
                    packet_bounds[2].min(v_low),
                    packet_bounds[3].max(v_high),
                ];
                reach = [reach[0].max(u.abs()), reach[1].max(v.abs())];
                let any = active.masks[index] >> lane & ((1 << S::LANES) - 1) != 0;
                culler.unfinished_groups |= u32::from(any) << group;
            }
            let mut inactive = !active.masks[index];
            while inactive != 0 {
                culler.nearest.inverse_limits_mut(index)[inactive.trailing_zeros() as usize] = f32::INFINITY;
                inactive &= inactive - 1;
            }
        }
        // Small slopes may have lost bits.
        culler.ray_bounds.reach =
            [1.0, reach[0].reduce_max() + UNDERFLOW_MARGIN, reach[1].reduce_max() + UNDERFLOW_MARGIN];
        culler.compute_centres::<S>();
        culler.update_slope_bounds::<S>();
        culler
    }

    /// Finds the groups' middles, and how far the others' slopes are from them.
    #[inline(always)]
    fn compute_centres<S: Simd>(&mut self) {
        let half = S::splat(0.5);
        let mut reach = [S::splat(0.0); 2];
        for first_group in (0..N * (64 / S::LANES)).step_by(S::LANES) {
            let RayGroups { u, v, centres, .. } = &mut *self.groups;
            for (axis, bounds) in [u, v].into_iter().enumerate() {
                let (low, high) = (S::load(&bounds[0][first_group..]), S::load(&bounds[1][first_group..]));
                low.add(high).mul(half).store(&mut centres[axis][first_group..]);
                // Less than none where there are no rays.
                reach[axis] = high.sub(low).mul(half).max(reach[axis]);
            }
        }
        self.ray_bounds.group_half_width = [reach[0].reduce_max(), reach[1].reduce_max()];
    }

    /// Finds the bounds of the slopes of all rays without a final answer.
    #[inline(always)]
    fn update_slope_bounds<S: Simd>(&mut self) {
        let (lowest, highest) = (S::splat(f32::INFINITY), S::splat(f32::NEG_INFINITY));
        let mut lane_bounds = [lowest, highest, lowest, highest];
        for first_group in (0..N * (64 / S::LANES)).step_by(S::LANES) {
            let unfinished_groups = self.unfinished_groups >> first_group;
            let RayGroups { u, v, .. } = &*self.groups;
            lane_bounds[0] = lane_bounds[0].min(S::select(unfinished_groups, S::load(&u[0][first_group..]), lowest));
            lane_bounds[1] = lane_bounds[1].max(S::select(unfinished_groups, S::load(&u[1][first_group..]), highest));
            lane_bounds[2] = lane_bounds[2].min(S::select(unfinished_groups, S::load(&v[0][first_group..]), lowest));
            lane_bounds[3] = lane_bounds[3].max(S::select(unfinished_groups, S::load(&v[1][first_group..]), highest));
        }
        let bounds = [
            lane_bounds[0].reduce_min(),
            lane_bounds[1].reduce_max(),
            lane_bounds[2].reduce_min(),
            lane_bounds[3].reduce_max(),
        ];
        self.ray_bounds.slopes = widen_slopes(bounds);
    }

    /// Those of some rays that may pass a cell of a slab and could still have a nearer hit there: all of them where it does
    /// not pay to look. `u` and `v` are its lowest corner, in finest cells as its `size`.
    #[inline(always)]
    pub(crate) fn rays_through_cell<S: Simd>(
        &self,
        candidates: &RaySet<N>,
        narrow: Option<&NarrowSlab<'_>>,
        u: i32,
        v: i32,
        size: u32,
    ) -> RaySet<N> {
        let Some(slab) = narrow else { return *candidates };
        let size = f64::from(size);
        self.passing::<S>(candidates, slab.slopes(0, u, size), slab.slopes(1, v, size), slab.inverse_depth)
    }

    /// Those of some rays that may pass between these slopes and could still have a nearer hit beyond a depth, given as
    /// its inverse.
    #[inline(always)]
    fn passing<S: Simd>(&self, candidates: &RaySet<N>, u: [f32; 2], v: [f32; 2], inverse_depth: f32) -> RaySet<N> {
        let [u_low, u_high, v_low, v_high] = widen_slopes([u[0], u[1], v[0], v[1]]);
        let (u, v) = ([S::splat(u_low), S::splat(u_high)], [S::splat(v_low), S::splat(v_high)]);
        let inverse_depth = S::splat(inverse_depth);
        let mut rays = RaySet::NONE;
        for first_group in (0..N * (64 / S::LANES)).step_by(S::LANES) {
            let all_groups = &*self.groups;
            let beside_u = interval_miss_signs(
                S::load(&all_groups.u[0][first_group..]),
                S::load(&all_groups.u[1][first_group..]),
                u,
            );
            let beside_v = interval_miss_signs(
                S::load(&all_groups.v[0][first_group..]),
                S::load(&all_groups.v[1][first_group..]),
                v,
            );
            let before = inverse_depth.sub(S::load(&all_groups.inverse_limits[first_group..]));
            let mut groups = !beside_u.or(beside_v).or(before).sign_mask() & (self.unfinished_groups >> first_group);
            while groups != 0 {
                let first = (first_group + groups.trailing_zeros() as usize) * S::LANES;
                groups &= groups - 1;
                let (packet, first) = (first / 64 % N, first % 64);
                let (of_rays_u, of_rays_v) = (S::load(&self.u[packet][first..]), S::load(&self.v[packet][first..]));
                let (beside_u, beside_v) =
                    (interval_miss_signs(of_rays_u, of_rays_u, u), interval_miss_signs(of_rays_v, of_rays_v, v));
                let before = inverse_depth.sub(S::load(&self.nearest.inverse_limits(packet)[first..]));
                let passing = !beside_u.or(beside_v).or(before).sign_mask() & ((1u64 << S::LANES) - 1) as u32;
                rays.masks[packet] |= u64::from(passing) << first;
            }
        }
        rays.and(candidates)
    }

    /// Has the triangles of a leaf wait for their test that the rays may hit; [`Culler::drop_recently_tested`] goes through them.
    ///
    /// `rays` are those that may pass the leaf, or all.
    #[inline(always)]
    pub(crate) fn gather<S: PacketKernel>(&mut self, boxes: &LeafBoxes<'_>, triangles: &[u32], rays: &RaySet<N>) {
        let ray_by_ray = triangles.len() >= RAY_BY_RAY_RATIO * rays.count() as usize;
        for (batch, triangles) in triangles.chunks(S::LANES).enumerate() {
            if self.n_waiting + S::LANES > N_WAITING {
                self.drop_recently_tested::<S>();
                if self.n_waiting + S::LANES > N_WAITING {
                    S::test_waiting(self);
                }
            }
            let bounds = boxes.bounds::<S>(batch * S::LANES);
            let missed = bounds.miss_signs(self.ray_bounds.slopes, self.least_inverse_limit).sign_mask();
            let mut passed = !missed & (u32::MAX >> (32 - triangles.len()));
            if ray_by_ray && passed != 0 {
                passed &= self.passed_by_any_ray(&bounds, rays);
            }
            self.n_waiting += S::compress(triangles, passed, &mut self.waiting[self.n_waiting..]);
        }
    }

    /// Drops those of the waiting triangles that were met lately.
    ///
    /// Without a branch, and for several leaves together: neither whether a triangle was met before can be predicted, nor
    /// how many of a leaf's there are to look at.
    #[inline(always)]
    pub(crate) fn drop_recently_tested<S: Simd>(&mut self) {
        let mut n_waiting = self.n_deduplicated;
        for index in self.n_deduplicated..self.n_waiting {
            let triangle = self.waiting[index];
            self.mesh.prefetch::<S>(triangle);
            let recent = &mut self.recent[triangle as usize % N_RECENT];
            self.waiting[n_waiting] = triangle;
            n_waiting += usize::from(*recent != triangle);
            *recent = triangle;
        }
        self.n_waiting = n_waiting;
        self.n_deduplicated = n_waiting;
    }

    /// A bit for each box that one of some rays may pass.
    #[inline(always)]
    fn passed_by_any_ray<S: Simd>(&self, bounds: &BoxLanes<S>, rays: &RaySet<N>) -> u32 {
        let mut missed = S::splat(-0.0);
        for packet in 0..N {
            let mut left = rays.masks[packet];
            while left != 0 {
                let lane = left.trailing_zeros() as usize;
                left &= left - 1;
                let (u, v) = (self.u[packet][lane], self.v[packet][lane]);
                let inverse_limit = self.nearest.inverse_limits(packet)[lane] * self.cell_length;
                missed = missed.and(bounds.miss_signs([u, u, v, v], inverse_limit));
            }
        }
        !missed.sign_mask()
    }

    /// Ends the search up to a depth along the major axis, in world units. Returns true when no ray needs more.
    #[inline(always)]
    pub(crate) fn finish_to_depth<S: PacketKernel>(&mut self, depth: f64) -> bool {
        self.has_new_tests = false;
        if self.n_waiting > 0 {
            S::test_waiting(self);
        }
        // Before the origin nothing is settled, not even a hit there.
        let inverse_reached = S::splat(if depth < 0.0 { f32::NAN } else { ((1.0 + 1e-6) / depth) as f32 });
        let mut least_inverse_limit = f32::INFINITY;
        let unfinished_groups = self.unfinished_groups;
        let mut groups = unfinished_groups;
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let first = group * S::LANES;
            let inverse_limits = S::load(&self.nearest.inverse_limits(first / 64 % N)[first % 64..]);
            let all = ((1u64 << S::LANES) - 1) as u32;
            if inverse_reached.le(inverse_limits) == all {
                self.unfinished_groups &= !(1 << group);
            } else {
                self.groups.inverse_limits[group] = inverse_limits.reduce_min();
                least_inverse_limit = least_inverse_limit.min(inverse_limits.reduce_min());
            }
        }
        self.least_inverse_limit = least_inverse_limit * self.cell_length;
        if self.unfinished_groups != unfinished_groups && self.unfinished_groups != 0 {
            self.update_slope_bounds::<S>();
        }
        self.unfinished_groups == 0
    }

    /// Writes the hits, when all is settled.
    #[inline(always)]
    pub(crate) fn write_hits<S: Simd>(&mut self, hits: &mut [[Hit; 64]]) {
        self.nearest.write::<S>(hits);
    }

    /// Tests the waiting triangles against all rays.
    #[inline(always)]
    pub(crate) fn test_waiting<S: Simd>(&mut self) {
        let mut prepared = PreparedTriangles::default();
        let n_waiting = std::mem::take(&mut self.n_waiting);
        self.n_deduplicated = 0;
        for &triangle in &self.waiting[..n_waiting] {
            self.mesh.prefetch_corners::<S>(triangle);
        }
        // The last vector is filled up with what is there already.
        let last = self.waiting[n_waiting.max(1) - 1];
        self.waiting[n_waiting..n_waiting + 16].fill(last);
        let mut first = 0;
        while first < n_waiting {
            let n = (n_waiting - first).min(S::LANES);
            prepared.triangle_indices.copy_from_slice(&self.waiting[first..first + 16]);
            first += n;
            let left = prepared.prepare::<S>(self.mesh, &self.ray_bounds) & ((1 << n) - 1);
            if left != 0 {
                self.test_prepared::<S>(&prepared, left);
            }
        }
        self.nearest.decide_queued::<S>();
    }
}
