//! Drops triangles that rays certainly miss: gathers triangles of leaves by their boxes, many at a time;
//! [`super::pairs`] tests the others against rays.
//!
//! Every test accounts for rounding. Distances are inverse depths along the major axis.
//!
//! No closures over vectors: they would not be compiled for the caller's instruction set.

use std::ops::Range;

use crate::{
    grid::{
        Grid,
        traced::TracedMesh,
        tree::{
            boxes::{BoxLanes, GROUP, LeafGroups, PlacedGroups, QuantizedBoxes},
            items::Items,
        },
    },
    intersect::{
        margins::{SLOPE_MARGIN, UNDERFLOW_MARGIN},
        packet::{
            decide::{HitScratch, NearestHits},
            frustum::NarrowSlab,
            kernel::PacketKernel,
            pairs::{PacketRays, Pair, RayGroups},
            prepared::{PreparedTriangles, RayBounds},
            ray_set::{MOST_PACKETS, Packet, RaySet},
        },
    },
    simd::{Simd, consecutive},
};

/// Triangles per ray from which a leaf's boxes are tested ray by ray: seen from afar, most lie between the rays.
const RAY_BY_RAY_RATIO: usize = 3;

/// Slots that remember tested triangles, a power of two.
const N_RECENT: usize = 1024;

/// Most triangles that wait for their test, a power of two.
const N_WAITING: usize = 256;

/// Memory of a [`Culler`], which resets it: it is too large to move. Vectors come first, where they are aligned.
#[repr(C, align(64))]
pub(super) struct CullScratch<const N: usize> {
    /// Slopes of the rays against the major axis.
    u: [[f32; 64]; N],
    v: [[f32; 64]; N],
    groups: RayGroups,
    pub(super) hits: HitScratch<N>,
    /// Triangles that wait for their test, or items of a tree, and room for one more vector.
    waiting: [u32; N_WAITING + 16],
    /// Their vertices, by corner.
    vertices: [[u32; N_WAITING + 16]; 3],
    /// The triangle that was last gathered, by its index modulo the size.
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
            vertices: [[0; N_WAITING + 16]; 3],
            recent: [0; N_RECENT],
            pairs: [Pair::default(); 64 * MOST_PACKETS],
        }
    }
}

impl<const N: usize> CullScratch<N> {
    /// Computes the rays' slopes against the major axis, and returns their bounds: least and largest u, least and
    /// largest v. In place of limits it stores the inverse depth of each ray's t = 1; [`Culler::new`] makes limits of
    /// them.
    #[inline(always)]
    pub(super) fn compute_slopes<S: Simd>(&mut self, packets: &[&Packet; N], axes: [usize; 3]) -> [f32; 4] {
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

/// Widens bounds of slopes, least and largest in turn, by the rounding error, and so that none equals a slope within.
#[inline(always)]
fn widen_slopes(mut bounds: [f32; 4]) -> [f32; 4] {
    for index in [0, 2] {
        bounds[index] -= bounds[index].abs() * SLOPE_MARGIN + UNDERFLOW_MARGIN;
        bounds[index + 1] += bounds[index + 1].abs() * SLOPE_MARGIN + UNDERFLOW_MARGIN;
    }
    bounds
}

/// Sign bit set in lanes where [low, high] misses the bounds.
#[inline(always)]
fn interval_miss_signs<S: Simd>(low: S, high: S, bounds: [S; 2]) -> S {
    high.sub(bounds[0]).or(bounds[1].sub(low))
}

/// Sixteen numbers from index `first` on.
#[inline(always)]
fn lanes(numbers: &[u32; N_WAITING + 16], first: usize) -> &[u32; 16] {
    numbers[first..].first_chunk().expect("room for one more vector")
}

/// Packets while they are traced, with the triangles that wait for their test.
pub(super) struct Culler<'a, const N: usize> {
    pub(super) rays: PacketRays<'a, N>,
    waiting: &'a mut [u32; N_WAITING + 16],
    vertices: &'a mut [[u32; N_WAITING + 16]; 3],
    n_waiting: usize,
    /// Those that [`Culler::find_triangles`] has found, from the first on; the others are items.
    n_triangles: usize,
    recent: &'a mut [u32; N_RECENT],
    items: &'a Items,
    mesh: &'a TracedMesh,
    pub(super) active: RaySet<N>,
    pub(super) ray_bounds: RayBounds,
    /// The groups whose slopes `ray_bounds` bounds.
    bounded_groups: u32,
    /// Side of a finest cell in world units, rounded down.
    cell_length: f32,
    /// Inverse of the farthest limit of all rays without a final answer, per finest cell.
    least_inverse_limit: f32,
    /// Whether leaves were tested since the last [`Culler::finish_to_depth`].
    pub(super) has_new_tests: bool,
}

impl<'a, const N: usize> Culler<'a, N> {
    /// Sets up groups and limits. All rays have the sign `sign` along `axes[0]`, and `scratch` holds their slopes.
    #[inline(always)]
    pub(super) fn new<S: Simd>(
        grid: &'a Grid,
        items: &'a Items,
        packets: [&'a Packet; N],
        active: RaySet<N>,
        axes: [usize; 3],
        sign: f32,
        scratch: &'a mut CullScratch<N>,
    ) -> Self {
        // Reset the memory that earlier packets used.
        let mesh = &grid.mesh;
        let CullScratch { u, v, groups, hits, waiting, vertices, recent, pairs } = scratch;
        *groups = RayGroups::NONE;
        recent.fill(u32::MAX);
        let origin = packets[0].origin.to_array();
        let mut culler = Self {
            rays: PacketRays {
                u,
                v,
                groups,
                nearest: NearestHits::new(mesh, packets, axes[0], hits),
                pairs,
                packet_slopes: [[f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY]; N],
                unfinished_groups: 0,
            },
            waiting,
            vertices,
            n_waiting: 0,
            n_triangles: 0,
            recent,
            items,
            mesh,
            active,
            ray_bounds: RayBounds { origin, axes, sign, slopes: [0.0; 4], max_abs_direction: [1.0; 3] },
            bounded_groups: 0,
            cell_length: (grid.space.length_to_model(1.0) * (1.0 - 1e-6)) as f32,
            least_inverse_limit: 0.0,
            has_new_tests: false,
        };

        // Find the limits of all rays, and the bounds of each group and each packet.
        let mut max_abs_slopes = [S::splat(0.0); 2];
        for index in 0..N {
            for group_of_packet in 0..64 / S::LANES {
                let lane = group_of_packet * S::LANES;
                let group = index * (64 / S::LANES) + group_of_packet;
                let (u, v) = (S::load(&culler.rays.u[index][lane..]), S::load(&culler.rays.v[index][lane..]));
                let inverse_limits = culler.rays.nearest.hits.set_limits::<S>(index, lane);

                // Reduce the slopes to the group's bounds, and those to the packet's.
                let [u_low, u_high, v_low, v_high] = [u.reduce_min(), u.reduce_max(), v.reduce_min(), v.reduce_max()];
                (culler.rays.groups.u[0][group], culler.rays.groups.u[1][group]) = (u_low, u_high);
                (culler.rays.groups.v[0][group], culler.rays.groups.v[1][group]) = (v_low, v_high);
                culler.rays.groups.inverse_limits[group] = inverse_limits.reduce_min();
                culler.rays.groups.left[group] = ((1u64 << S::LANES) - 1) as u32;
                let packet_bounds = &mut culler.rays.packet_slopes[index];
                *packet_bounds = [
                    packet_bounds[0].min(u_low),
                    packet_bounds[1].max(u_high),
                    packet_bounds[2].min(v_low),
                    packet_bounds[3].max(v_high),
                ];
                max_abs_slopes = [max_abs_slopes[0].max(u.abs()), max_abs_slopes[1].max(v.abs())];
                let any = active.masks[index] >> lane & ((1 << S::LANES) - 1) != 0;
                culler.rays.unfinished_groups |= u32::from(any) << group;
            }
            // Inactive lanes have no interval left.
            let mut inactive = !active.masks[index];
            while inactive != 0 {
                culler.rays.nearest.hits.inverse_limits[index][inactive.trailing_zeros() as usize] = f32::INFINITY;
                inactive &= inactive - 1;
            }
        }

        // Subnormal slopes may have lost bits.
        culler.ray_bounds.max_abs_direction =
            [1.0, max_abs_slopes[0].reduce_max() + UNDERFLOW_MARGIN, max_abs_slopes[1].reduce_max() + UNDERFLOW_MARGIN];
        culler.update_slope_bounds::<S>();
        culler
    }

    /// Recomputes the bounds of the slopes of all groups without a final answer.
    #[inline(always)]
    fn update_slope_bounds<S: Simd>(&mut self) {
        let (lowest, highest) = (S::splat(f32::INFINITY), S::splat(f32::NEG_INFINITY));
        let mut lane_bounds = [lowest, highest, lowest, highest];
        for first_group in (0..N * (64 / S::LANES)).step_by(S::LANES) {
            let unfinished_groups = self.rays.unfinished_groups >> first_group;
            let RayGroups { u, v, .. } = &*self.rays.groups;
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
        self.bounded_groups = self.rays.unfinished_groups;
    }

    /// The candidates that may pass a cell of a slab and could still have a nearer hit there; all of them where
    /// `narrow` is `None` and a test does not pay. `u`, `v` and `size` are the cell's lowest corner and side, in finest
    /// cells.
    #[inline(always)]
    pub(super) fn rays_through_cell<S: Simd>(
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

    /// The candidates that may pass between these slopes and could have a nearer hit beyond 1 / `inverse_depth`.
    #[inline(always)]
    fn passing<S: Simd>(&self, candidates: &RaySet<N>, u: [f32; 2], v: [f32; 2], inverse_depth: f32) -> RaySet<N> {
        let [u_low, u_high, v_low, v_high] = widen_slopes([u[0], u[1], v[0], v[1]]);
        let (u, v) = ([S::splat(u_low), S::splat(u_high)], [S::splat(v_low), S::splat(v_high)]);
        let inverse_depth = S::splat(inverse_depth);

        // Find the groups whose bounds meet the cell, a vector of groups at a time.
        let mut rays = RaySet::NONE;
        for first_group in (0..N * (64 / S::LANES)).step_by(S::LANES) {
            let all_groups = &*self.rays.groups;
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
            let mut groups =
                !beside_u.or(beside_v).or(before).sign_mask() & (self.rays.unfinished_groups >> first_group);

            // Test the rays of these groups one by one.
            while groups != 0 {
                let first = (first_group + groups.trailing_zeros() as usize) * S::LANES;
                groups &= groups - 1;
                let (packet, first) = (first / 64 % N, first % 64);
                let (ray_u, ray_v) = (S::load(&self.rays.u[packet][first..]), S::load(&self.rays.v[packet][first..]));
                let (beside_u, beside_v) = (interval_miss_signs(ray_u, ray_u, u), interval_miss_signs(ray_v, ray_v, v));
                let before = inverse_depth.sub(S::load(&self.rays.nearest.hits.inverse_limits[packet][first..]));
                let passing = !beside_u.or(beside_v).or(before).sign_mask() & ((1u64 << S::LANES) - 1) as u32;
                rays.masks[packet] |= u64::from(passing) << first;
            }
        }
        rays.and(candidates)
    }

    /// Adds the items of a leaf whose boxes some ray may pass to those that wait. `rays` may pass the leaf.
    #[inline(always)]
    pub(super) fn gather<S: PacketKernel>(
        &mut self,
        groups: &LeafGroups<'_>,
        boxes: &QuantizedBoxes,
        items: Range<usize>,
        rays: &RaySet<N>,
    ) {
        let ray_by_ray = items.len() >= RAY_BY_RAY_RATIO * rays.count() as usize;
        let mut placed = PlacedGroups::NONE;
        for first_group in (0..groups.n()).step_by(S::LANES) {
            // Test the groups against the bounds of all rays, then the boxes of those that are left.
            let bounds = groups.bounds::<S>(first_group, &mut placed);
            let missed = bounds.miss_signs(self.ray_bounds.slopes, self.least_inverse_limit).sign_mask();
            let mut left = !missed & (u32::MAX >> (32 - (groups.n() - first_group).min(S::LANES)));
            while left != 0 {
                let lane = left.trailing_zeros() as usize;
                left &= left - 1;
                let first = items.start + (first_group + lane) * GROUP;
                let of_group = boxes.group(first, (items.end - first).min(GROUP));
                for first_box in (0..GROUP).step_by(S::LANES) {
                    let bounds = groups.boxes::<S>(&placed, lane, of_group, first_box);
                    let within = of_group.mask() >> first_box & (u32::MAX >> (32 - S::LANES));
                    self.gather_boxes::<S>(&bounds, within, first + first_box, ray_by_ray.then_some(rays));
                }
            }
        }
    }

    /// Adds the items from `first_item` on whose boxes are within a mask and some ray may pass to those that wait. Tests the
    /// boxes against the bounds of all rays, then against each of `rays`.
    #[inline(always)]
    fn gather_boxes<S: PacketKernel>(
        &mut self,
        bounds: &BoxLanes<S>,
        within: u32,
        first_item: usize,
        rays: Option<&RaySet<N>>,
    ) {
        // Make room for a vector of items.
        if self.n_waiting + S::LANES > N_WAITING {
            self.find_triangles::<S>();
            if self.n_waiting + S::LANES > N_WAITING {
                S::test_waiting(self);
            }
        }

        let missed = bounds.miss_signs(self.ray_bounds.slopes, self.least_inverse_limit).sign_mask();
        let mut passed = !missed & within;
        if let Some(rays) = rays
            && passed != 0
        {
            passed &= self.passed_by_any_ray(bounds, rays);
        }
        let numbers = S::load_bits(&consecutive(first_item as u32));
        self.n_waiting += numbers.compress_bits_to(passed, &mut self.waiting[self.n_waiting..]);
    }

    /// Replaces the items that wait by their triangles, without those that were gathered before.
    ///
    /// For several leaves together, and without a branch on what was gathered: neither new triangles nor their number are
    /// predictable.
    #[inline(always)]
    pub(super) fn find_triangles<S: Simd>(&mut self) {
        let mut n_waiting = self.n_triangles;
        for index in self.n_triangles..self.n_waiting {
            let triangle = self.items.triangle(self.waiting[index]);
            self.mesh.prefetch::<S>(triangle);
            let recent = &mut self.recent[triangle as usize % N_RECENT];
            self.waiting[n_waiting] = triangle;
            n_waiting += usize::from(*recent != triangle);
            *recent = triangle;
        }
        self.n_waiting = n_waiting;
        self.n_triangles = n_waiting;
    }

    /// A bit for each box that at least one of the rays may pass.
    #[inline(always)]
    fn passed_by_any_ray<S: Simd>(&self, bounds: &BoxLanes<S>, rays: &RaySet<N>) -> u32 {
        let mut missed = S::splat(-0.0);
        for packet in 0..N {
            let mut left = rays.masks[packet];
            while left != 0 {
                let lane = left.trailing_zeros() as usize;
                left &= left - 1;
                let (u, v) = (self.rays.u[packet][lane], self.rays.v[packet][lane]);
                let inverse_limit = self.rays.nearest.hits.inverse_limits[packet][lane] * self.cell_length;
                missed = missed.and(bounds.miss_signs([u, u, v, v], inverse_limit));
            }
        }
        !missed.sign_mask()
    }

    /// Tests the waiting triangles, and settles rays whose limit lies before a depth (world units); true if all are.
    #[inline(always)]
    pub(super) fn finish_to_depth<S: PacketKernel>(&mut self, depth: f64) -> bool {
        self.has_new_tests = false;
        if self.n_waiting > 0 {
            S::test_waiting(self);
        }

        // A group is settled when the depth lies beyond the limits of all its rays; behind the origin none is. Where any hit will
        // do, it is settled when none of its rays has an interval left.
        let inverse_reached = S::splat(if depth < 0.0 { f32::NAN } else { ((1.0 + 1e-6) / depth) as f32 });
        let all = ((1u64 << S::LANES) - 1) as u32;
        let mut least_inverse_limit = f32::INFINITY;
        let any_hit = self.rays.nearest.packets[0].any_hit;
        let mut is_narrower = false;
        let mut groups = self.rays.unfinished_groups;
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let first = group * S::LANES;
            let inverse_limits = S::load(&self.rays.nearest.hits.inverse_limits[first / 64 % N][first % 64..]);
            let left = if any_hit { inverse_limits.lt(S::splat(f32::INFINITY)) } else { all };
            if inverse_reached.le(inverse_limits) == all || left == 0 {
                self.rays.unfinished_groups &= !(1 << group);
            } else {
                self.rays.groups.inverse_limits[group] = inverse_limits.reduce_min();
                least_inverse_limit = least_inverse_limit.min(inverse_limits.reduce_min());
                if left != self.rays.groups.left[group] {
                    self.rays.narrow_group::<S>(group, left);
                    is_narrower = true;
                }
            }
        }

        // Narrow the bounds to the groups that remain.
        self.least_inverse_limit = least_inverse_limit * self.cell_length;
        is_narrower |= self.rays.unfinished_groups != self.bounded_groups;
        if is_narrower && self.rays.unfinished_groups != 0 {
            self.update_slope_bounds::<S>();
        }
        self.rays.unfinished_groups == 0
    }

    /// Tests the waiting triangles against all rays.
    #[inline(always)]
    pub(super) fn test_waiting<S: Simd>(&mut self) {
        // Find and prefetch all vertices, so that their cache misses overlap.
        let mut prepared = PreparedTriangles::default();
        let n_waiting = std::mem::take(&mut self.n_waiting);
        self.n_triangles = 0;
        for index in 0..n_waiting {
            let [a, b, c] = self.mesh.prefetch_vertices::<S>(self.waiting[index]);
            (self.vertices[0][index], self.vertices[1][index], self.vertices[2][index]) = (a, b, c);
        }

        // Fill the last vector up with copies of the last triangle.
        let last = n_waiting.max(1) - 1;
        for numbers in std::iter::once(&mut *self.waiting).chain(&mut *self.vertices) {
            let of_last = numbers[last];
            numbers[n_waiting..n_waiting + 16].fill(of_last);
        }

        // Prepare a vector of triangles at a time, and test those that the rays' bounds meet.
        let mut first = 0;
        while first < n_waiting {
            let n = (n_waiting - first).min(S::LANES);
            let [a, b, c] = &*self.vertices;
            // SAFETY: the vertices are those of waiting triangles.
            let corners =
                unsafe { self.mesh.gather_vertices::<S>([lanes(a, first), lanes(b, first), lanes(c, first)]) };
            prepared.triangle_indices = *lanes(self.waiting, first);
            first += n;
            let left = prepared.prepare::<S>(corners, &self.ray_bounds) & ((1 << n) - 1);
            if left != 0 {
                self.rays.test_prepared::<S>(&prepared, left);
            }
        }
        self.rays.nearest.decide_queued::<S>();
    }
}
