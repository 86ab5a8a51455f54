//! From the triangles in packets' way to those that some rays may hit: gathers triangles, and culls them many at a
//! time; [`super::decide`] decides the rest.
//!
//! Everything here may only drop pairs of ray and triangle that certainly miss, with rounding accounted for.
//! There are no closures over vectors: they would not be compiled for the caller's instruction set.

use super::{
    Grid,
    boxes::{Bounds, LeafBoxes},
    decide::NearestHits,
    kernel::Kernel,
    packet::{MOST_PACKETS, Packet},
    prepared::{Bundle, Prepared, SLOPE_MARGIN},
    ray_set::RaySet,
};
use crate::{ray::Hit, simd::Simd, traced::TracedMesh};

/// From so many triangles for each ray on, a leaf's boxes are tested against its rays one by one: in a scan seen from
/// afar most triangles lie between the rays.
const MANY_TRIANGLES_PER_RAY: usize = 5;

/// Triangles remembered as already tested, a power of two.
const N_RECENT: usize = 1024;

/// Triangles that can wait for their test, a power of two.
const N_WAITING: usize = 256;

/// Groups of rays at most, with vectors of eight.
const MOST_GROUPS: usize = MOST_PACKETS * 64 / 8;

/// The bounds of groups of rays, as many each as a vector has lanes.
#[repr(C, align(64))]
struct Groups {
    /// Least and largest slopes.
    u: [[f32; MOST_GROUPS]; 2],
    v: [[f32; MOST_GROUPS]; 2],
    /// The farthest of their rays' limits.
    limits: [f32; MOST_GROUPS],
}

/// Packets on their way, with the nearest hits so far. Vectors come first, where they are aligned.
#[repr(C, align(64))]
pub(super) struct Culler<'a, const N: usize> {
    /// Slopes of the rays against the major axis.
    u: [[f32; 64]; N],
    v: [[f32; 64]; N],
    groups: Groups,
    nearest: NearestHits<'a, N>,
    /// Triangles that wait until a vector is full.
    waiting: [u32; N_WAITING],
    n_waiting: usize,
    mesh: &'a TracedMesh,
    packets: [&'a Packet; N],
    /// The rays that there are.
    pub(super) active: RaySet<N>,
    pub(super) bundle: Bundle,
    /// Finest cells in a world unit, rounded up.
    cells_per_unit: f32,
    /// The farthest limit of all rays without a final answer, in finest cells.
    farthest: f32,
    /// A bit for each group that has rays without a final answer.
    live: u32,
    recent: [u32; N_RECENT],
    /// Whether triangles were met since [`Culler::settle`].
    pub(super) touched: bool,
}

impl<'a, const N: usize> Culler<'a, N> {
    /// Takes the active rays of packets in which all rays have the sign `sign` along `axes[0]`.
    #[inline(always)]
    pub(super) fn new<S: Simd>(
        grid: &'a Grid,
        packets: [&'a Packet; N],
        active: RaySet<N>,
        axes: [usize; 3],
        sign: f32,
    ) -> Self {
        let mesh = &grid.mesh;
        let mut culler = Self {
            mesh,
            cells_per_unit: (grid.space.cells_per_unit() * (1.0 + 1e-6)) as f32,
            packets,
            active,
            bundle: Bundle { origin: packets[0].origin.to_array(), axes, sign, slopes: [0.0; 4], reach: [0.0; 3] },
            u: [[0.0; 64]; N],
            v: [[0.0; 64]; N],
            nearest: NearestHits::new(mesh, packets, axes[0]),
            // Those of no rays are passed by nothing.
            groups: Groups {
                u: [[f32::INFINITY; MOST_GROUPS], [f32::NEG_INFINITY; MOST_GROUPS]],
                v: [[f32::INFINITY; MOST_GROUPS], [f32::NEG_INFINITY; MOST_GROUPS]],
                limits: [f32::NEG_INFINITY; MOST_GROUPS],
            },
            farthest: f32::INFINITY,
            live: 0,
            waiting: [0; N_WAITING],
            n_waiting: 0,
            recent: [u32::MAX; N_RECENT],
            touched: false,
        };
        for (index, packet) in packets.iter().enumerate() {
            let directions = &packet.directions;
            for group_of_packet in 0..64 / S::LANES {
                let lane = group_of_packet * S::LANES;
                let group = index * (64 / S::LANES) + group_of_packet;
                let depth = S::load(&directions[axes[0]][lane..]).abs();
                let u = S::load(&directions[axes[1]][lane..]).div(depth);
                let v = S::load(&directions[axes[2]][lane..]).div(depth);
                u.store(&mut culler.u[index][lane..]);
                v.store(&mut culler.v[index][lane..]);
                let limits = depth.mul(S::splat(packet.t_max * (1.0 + 1e-6)));
                limits.store(&mut culler.nearest.limits[index][lane..]);
                (culler.groups.u[0][group], culler.groups.u[1][group]) = (u.least(), u.greatest());
                (culler.groups.v[0][group], culler.groups.v[1][group]) = (v.least(), v.greatest());
                culler.groups.limits[group] = limits.greatest();
                for axis in 0..3 {
                    let reach = S::load(&directions[axis][lane..]).abs().greatest();
                    culler.bundle.reach[axis] = culler.bundle.reach[axis].max(reach);
                }
                let any = active.of_packets[index] >> lane & ((1 << S::LANES) - 1) != 0;
                culler.live |= u32::from(any) << group;
            }
            let mut inactive = !active.of_packets[index];
            while inactive != 0 {
                culler.nearest.limits[index][inactive.trailing_zeros() as usize] = f32::NEG_INFINITY;
                inactive &= inactive - 1;
            }
        }
        culler.find_slopes::<S>();
        culler
    }

    /// Finds the bounds of the slopes of all rays without a final answer.
    #[inline(always)]
    fn find_slopes<S: Simd>(&mut self) {
        let mut bounds = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
        for group in 0..N * (64 / S::LANES) {
            if self.live >> group & 1 == 1 {
                let Groups { u, v, .. } = &self.groups;
                bounds[0] = bounds[0].min(u[0][group]);
                bounds[1] = bounds[1].max(u[1][group]);
                bounds[2] = bounds[2].min(v[0][group]);
                bounds[3] = bounds[3].max(v[1][group]);
            }
        }
        for index in [0, 2] {
            bounds[index] -= bounds[index].abs() * SLOPE_MARGIN;
            bounds[index + 1] += bounds[index + 1].abs() * SLOPE_MARGIN;
        }
        self.bundle.slopes = bounds;
    }

    /// Those of some rays that may pass between these slopes and could still have a nearer hit beyond a depth.
    #[inline(always)]
    pub(super) fn passing<S: Simd>(&self, among: &RaySet<N>, u: [f32; 2], v: [f32; 2], depth: f32) -> RaySet<N> {
        let (u_low, u_high) = (S::splat(u[0] - u[0].abs() * SLOPE_MARGIN), S::splat(u[1] + u[1].abs() * SLOPE_MARGIN));
        let (v_low, v_high) = (S::splat(v[0] - v[0].abs() * SLOPE_MARGIN), S::splat(v[1] + v[1].abs() * SLOPE_MARGIN));
        let depth = S::splat(depth);
        let mut rays = RaySet::NONE;
        for first_group in (0..N * (64 / S::LANES)).step_by(S::LANES) {
            let Groups { u, v, limits } = &self.groups;
            let mut groups = u_low.up_to(S::load(&u[1][first_group..]))
                & S::load(&u[0][first_group..]).up_to(u_high)
                & v_low.up_to(S::load(&v[1][first_group..]))
                & S::load(&v[0][first_group..]).up_to(v_high)
                & depth.up_to(S::load(&limits[first_group..]))
                & (self.live >> first_group);
            while groups != 0 {
                let first = (first_group + groups.trailing_zeros() as usize) * S::LANES;
                groups &= groups - 1;
                let (packet, first) = (first / 64 % N, first % 64);
                let u = S::load(&self.u[packet][first..]);
                let v = S::load(&self.v[packet][first..]);
                let passing = u_low.up_to(u)
                    & u.up_to(u_high)
                    & v_low.up_to(v)
                    & v.up_to(v_high)
                    & depth.up_to(S::load(&self.nearest.limits[packet][first..]));
                rays.of_packets[packet] |= u64::from(passing) << first;
            }
        }
        rays.and(among)
    }

    /// Tests the triangles of a leaf soon that the rays may hit, unless they were tested lately.
    ///
    /// `rays` are those that may pass the leaf, or all.
    #[inline(always)]
    pub(super) fn add<S: Kernel>(&mut self, boxes: &LeafBoxes<'_>, triangles: &[u32], rays: &RaySet<N>) {
        let ray_by_ray = triangles.len() >= MANY_TRIANGLES_PER_RAY * rays.count() as usize;
        let mut new_from = self.n_waiting;
        for (batch, triangles) in triangles.chunks(S::LANES).enumerate() {
            if self.n_waiting + S::LANES > N_WAITING {
                self.drop_recent::<S>(new_from);
                S::test(self);
                new_from = 0;
            }
            let bounds = boxes.bounds::<S>(batch * S::LANES);
            let mut passed = bounds.passed_by(self.bundle.slopes, self.farthest) & (u32::MAX >> (32 - triangles.len()));
            if ray_by_ray && passed != 0 {
                passed &= self.passed_by_any(&bounds, rays);
            }
            self.n_waiting += S::pick(triangles, passed, &mut self.waiting[self.n_waiting..]);
        }
        self.drop_recent::<S>(new_from);
    }

    /// Drops triangles that were met lately from those that wait, from number `new_from` on.
    ///
    /// Without a branch: whether a triangle was met before cannot be predicted.
    #[inline(always)]
    fn drop_recent<S: Simd>(&mut self, new_from: usize) {
        let mut n_waiting = new_from;
        for index in new_from..self.n_waiting {
            let triangle = self.waiting[index];
            self.mesh.prefetch::<S>(triangle);
            let recent = &mut self.recent[triangle as usize % N_RECENT];
            self.waiting[n_waiting] = triangle;
            n_waiting += usize::from(*recent != triangle);
            *recent = triangle;
        }
        self.n_waiting = n_waiting;
    }

    /// A bit for each box that one of some rays may pass.
    #[inline(always)]
    fn passed_by_any<S: Simd>(&self, bounds: &Bounds<S>, rays: &RaySet<N>) -> u32 {
        let mut passed = 0;
        for packet in 0..N {
            let mut left = rays.of_packets[packet];
            while left != 0 {
                let lane = left.trailing_zeros() as usize;
                left &= left - 1;
                let (u, v) = (self.u[packet][lane], self.v[packet][lane]);
                passed |= bounds.passed_by([u, u, v, v], self.nearest.limits[packet][lane] * self.cells_per_unit);
            }
        }
        passed
    }

    /// Ends the search up to a depth along the major axis, in world units. Returns true when no ray needs more.
    #[inline(always)]
    pub(super) fn settle<S: Kernel>(&mut self, depth: f64) -> bool {
        self.touched = false;
        if self.n_waiting > 0 {
            S::test(self);
        }
        let reached = S::splat((depth * (1.0 - 1e-6)) as f32);
        let mut farthest = f32::NEG_INFINITY;
        let live = self.live;
        let mut groups = live;
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let first = group * S::LANES;
            let limits = S::load(&self.nearest.limits[first / 64 % N][first % 64..]);
            let all = ((1u64 << S::LANES) - 1) as u32;
            if limits.up_to(reached) == all {
                self.live &= !(1 << group);
            } else {
                self.groups.limits[group] = limits.greatest();
                farthest = farthest.max(limits.greatest());
            }
        }
        self.farthest = farthest * self.cells_per_unit;
        if self.live != live && self.live != 0 {
            self.find_slopes::<S>();
        }
        self.live == 0
    }

    /// Writes the hits, when all is settled.
    #[inline(always)]
    pub(super) fn write_hits(&self, hits: &mut [[Hit; 64]]) {
        self.nearest.write(hits);
    }

    /// Tests the waiting triangles against all rays.
    #[inline(always)]
    pub(super) fn test_waiting<S: Simd>(&mut self) {
        let mut prepared = Prepared::default();
        let n_waiting = self.n_waiting;
        self.n_waiting = 0;
        for &triangle in &self.waiting[..n_waiting] {
            self.mesh.prefetch_corners::<S>(triangle);
        }
        let mut first = 0;
        while first < n_waiting {
            let n = (n_waiting - first).min(S::LANES);
            for lane in 0..S::LANES {
                prepared.places[lane] = self.waiting[first + if lane < n { lane } else { 0 }];
            }
            first += n;
            let left = prepared.prepare::<S>(self.mesh, &self.bundle) & ((1 << n) - 1);
            if left == 0 {
                continue;
            }
            self.test_prepared::<S>(&prepared, left);
        }
        self.nearest.decide_rest::<S>();
    }

    /// Tests prepared triangles against all rays.
    #[inline(always)]
    fn test_prepared<S: Simd>(&mut self, prepared: &Prepared, triangles: u32) {
        let mut rays = [RaySet::<N>::NONE; 16];
        let mut left = 0;
        for packet in 0..N {
            // All pairs of a group of rays and a triangle in one mask and one loop, whose end is hard to predict.
            let mut pairs = 0;
            for group_of_packet in 0..64 / S::LANES {
                let group = packet * (64 / S::LANES) + group_of_packet;
                let Groups { u, v, limits } = &self.groups;
                let met = triangles
                    & S::load(&prepared.u[0]).up_to(S::splat(u[1][group]))
                    & S::splat(u[0][group]).up_to(S::load(&prepared.u[1]))
                    & S::load(&prepared.v[0]).up_to(S::splat(v[1][group]))
                    & S::splat(v[0][group]).up_to(S::load(&prepared.v[1]))
                    & S::load(&prepared.depth).up_to(S::splat(limits[group]));
                pairs |= u64::from(met * (self.live >> group & 1)) << (group_of_packet * S::LANES);
            }
            while pairs != 0 {
                let pair = pairs.trailing_zeros() as usize;
                pairs &= pairs - 1;
                let (first, lane) = (pair / S::LANES * S::LANES, pair % S::LANES);
                let of_group = self.test_pair::<S>(prepared, lane, packet, first);
                rays[lane].of_packets[packet] |= u64::from(of_group) << first;
                left |= u32::from(of_group != 0) << lane;
            }
        }
        while left != 0 {
            let lane = left.trailing_zeros() as usize;
            left &= left - 1;
            self.nearest.propose::<S>(prepared.places[lane], &rays[lane]);
        }
    }

    /// A bit for each ray that may hit a prepared triangle, of a packet's group of rays from number `first` on.
    #[inline(always)]
    fn test_pair<S: Simd>(&self, prepared: &Prepared, lane: usize, packet: usize, first: usize) -> u32 {
        let [x, y, z] = &self.packets[packet].directions;
        let direction = [S::load(&x[first..]), S::load(&y[first..]), S::load(&z[first..])];
        let mut sides = [direction[0]; 3];
        for edge in 0..3 {
            let normal = &prepared.normals[edge];
            sides[edge] = direction[0].mul_add(
                S::splat(normal[0][lane]),
                direction[1].mul_add(S::splat(normal[1][lane]), direction[2].mul(S::splat(normal[2][lane]))),
            );
        }
        let margin = prepared.side_margin[lane];
        let low = sides[0].min(sides[1]).min(sides[2]);
        let high = sides[0].max(sides[1]).max(sides[2]);
        S::splat(prepared.depth[lane]).up_to(S::load(&self.nearest.limits[packet][first..]))
            & !(low.below(S::splat(-margin)) & S::splat(margin).below(high))
    }
}
