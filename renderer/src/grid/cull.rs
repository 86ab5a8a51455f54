//! From the triangles in a packet's way to those that some rays may hit: gathers triangles, and culls them many at a
//! time; [`super::decide`] decides the rest.
//!
//! Everything here may only drop pairs of ray and triangle that certainly miss, with rounding accounted for.
//! There are no closures over vectors: they would not be compiled for the caller's instruction set.

use super::{
    Grid,
    boxes::{Bounds, LeafBoxes},
    decide::NearestHits,
    kernel::Kernel,
    packet::Packet,
    prepared::{Bundle, Prepared, SLOPE_MARGIN},
};
use crate::{ray::Hit, simd::Simd, traced::TracedMesh};

/// From so many triangles for each ray on, a leaf's boxes are tested against its rays one by one: in a scan seen from
/// afar most triangles lie between the rays.
const MANY_TRIANGLES_PER_RAY: usize = 5;

/// Triangles remembered as already tested, a power of two.
const N_RECENT: usize = 256;

/// Triangles that can wait for their test, a power of two.
const N_WAITING: usize = 256;

/// The bounds of a group of rays: as many as a vector has lanes.
#[derive(Clone, Copy, Default)]
struct Group {
    u: [f32; 2],
    v: [f32; 2],
    /// The farthest of its rays' limits.
    limit: f32,
}

/// A packet on its way, with the nearest hits so far.
pub(super) struct Culler<'a> {
    mesh: &'a TracedMesh,
    packet: &'a Packet,
    pub(super) bundle: Bundle,
    /// Finest cells in a world unit, rounded up.
    cells_per_unit: f32,
    /// Slopes of the rays against the major axis.
    u: [f32; 64],
    v: [f32; 64],
    nearest: NearestHits<'a>,
    groups: [Group; 8],
    /// The farthest limit of all rays without a final answer, in finest cells.
    farthest: f32,
    /// A bit for each group that has rays without a final answer.
    live: u32,
    /// Triangles that wait until a vector is full.
    waiting: [u32; N_WAITING],
    n_waiting: usize,
    recent: [u32; N_RECENT],
    /// Whether triangles were met since [`Culler::settle`].
    pub(super) touched: bool,
}

impl<'a> Culler<'a> {
    /// Takes a packet whose active rays all have the sign `sign` along `axes[0]`, and duplicates in the other entries.
    #[inline(always)]
    pub(super) fn new<S: Simd>(grid: &'a Grid, packet: &'a Packet, axes: [usize; 3], sign: f32) -> Self {
        let mesh = &grid.mesh;
        let mut culler = Self {
            mesh,
            cells_per_unit: (grid.space.cells_per_unit() * (1.0 + 1e-6)) as f32,
            packet,
            bundle: Bundle { origin: packet.origin.to_array(), axes, sign, slopes: [0.0; 4], reach: [0.0; 3] },
            u: [0.0; 64],
            v: [0.0; 64],
            nearest: NearestHits::new(mesh, packet, axes[0]),
            groups: [Group::default(); 8],
            farthest: f32::INFINITY,
            live: 0,
            waiting: [0; N_WAITING],
            n_waiting: 0,
            recent: [u32::MAX; N_RECENT],
            touched: false,
        };
        let directions = &packet.directions;
        for group in 0..64 / S::LANES {
            let first = group * S::LANES;
            let depth = S::load(&directions[axes[0]][first..]).abs();
            let u = S::load(&directions[axes[1]][first..]).div(depth);
            let v = S::load(&directions[axes[2]][first..]).div(depth);
            u.store(&mut culler.u[first..]);
            v.store(&mut culler.v[first..]);
            let limits = depth.mul(S::splat(packet.t_max * (1.0 + 1e-6)));
            limits.store(&mut culler.nearest.limits[first..]);
            culler.groups[group] =
                Group { u: [u.least(), u.greatest()], v: [v.least(), v.greatest()], limit: limits.greatest() };
            for axis in 0..3 {
                let reach = S::load(&directions[axis][first..]).abs().greatest();
                culler.bundle.reach[axis] = culler.bundle.reach[axis].max(reach);
            }
            let any = packet.active >> first & ((1 << S::LANES) - 1) != 0;
            culler.live |= u32::from(any) << group;
        }
        let mut inactive = !packet.active;
        while inactive != 0 {
            culler.nearest.limits[inactive.trailing_zeros() as usize] = f32::NEG_INFINITY;
            inactive &= inactive - 1;
        }
        culler.find_slopes::<S>();
        culler
    }

    /// Finds the bounds of the slopes of all rays without a final answer.
    #[inline(always)]
    fn find_slopes<S: Simd>(&mut self) {
        let mut bounds = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
        for group in 0..64 / S::LANES {
            if self.live >> group & 1 == 1 {
                let Group { u, v, .. } = &self.groups[group];
                bounds = [bounds[0].min(u[0]), bounds[1].max(u[1]), bounds[2].min(v[0]), bounds[3].max(v[1])];
            }
        }
        for index in [0, 2] {
            bounds[index] -= bounds[index].abs() * SLOPE_MARGIN;
            bounds[index + 1] += bounds[index + 1].abs() * SLOPE_MARGIN;
        }
        self.bundle.slopes = bounds;
    }

    /// A bit for each of some rays that may pass between these slopes and could still have a nearer hit beyond a depth.
    #[inline(always)]
    pub(super) fn passing<S: Simd>(&self, among: u64, u: [f32; 2], v: [f32; 2], depth: f32) -> u64 {
        let (u_low, u_high) = (S::splat(u[0] - u[0].abs() * SLOPE_MARGIN), S::splat(u[1] + u[1].abs() * SLOPE_MARGIN));
        let (v_low, v_high) = (S::splat(v[0] - v[0].abs() * SLOPE_MARGIN), S::splat(v[1] + v[1].abs() * SLOPE_MARGIN));
        let depth = S::splat(depth);
        let mut rays = 0;
        for group in 0..64 / S::LANES {
            let first = group * S::LANES;
            if among >> first & ((1 << S::LANES) - 1) == 0 {
                continue;
            }
            let u = S::load(&self.u[first..]);
            let v = S::load(&self.v[first..]);
            let passing = u_low.up_to(u)
                & u.up_to(u_high)
                & v_low.up_to(v)
                & v.up_to(v_high)
                & depth.up_to(S::load(&self.nearest.limits[first..]));
            rays |= u64::from(passing) << first;
        }
        rays & among
    }

    /// Tests the triangles of a leaf soon that the rays may hit, unless they were tested lately.
    ///
    /// `rays` are those that may pass the leaf, or all.
    #[inline(always)]
    pub(super) fn add<S: Kernel>(&mut self, boxes: &LeafBoxes<'_>, triangles: &[u32], rays: u64) {
        let ray_by_ray = triangles.len() >= MANY_TRIANGLES_PER_RAY * rays.count_ones() as usize;
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
    fn passed_by_any<S: Simd>(&self, bounds: &Bounds<S>, rays: u64) -> u32 {
        let mut passed = 0;
        let mut left = rays;
        while left != 0 {
            let ray = left.trailing_zeros() as usize;
            left &= left - 1;
            let (u, v) = (self.u[ray], self.v[ray]);
            passed |= bounds.passed_by([u, u, v, v], self.nearest.limits[ray] * self.cells_per_unit);
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
        for group in 0..64 / S::LANES {
            if self.live >> group & 1 == 0 {
                continue;
            }
            let limits = S::load(&self.nearest.limits[group * S::LANES..]);
            let all = ((1u64 << S::LANES) - 1) as u32;
            if limits.up_to(reached) == all {
                self.live &= !(1 << group);
            } else {
                self.groups[group].limit = limits.greatest();
                farthest = farthest.max(limits.greatest());
            }
        }
        self.farthest = farthest * self.cells_per_unit;
        self.live == 0
    }

    /// Writes the hits, when all is settled.
    #[inline(always)]
    pub(super) fn write_hits(&self, hits: &mut [Hit; 64]) {
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
        // All pairs of a group of rays and a triangle in one mask and one loop, whose end is hard to predict.
        let mut pairs = 0;
        for group in 0..64 / S::LANES {
            let Group { u, v, limit } = self.groups[group];
            let met = triangles
                & S::load(&prepared.u[0]).up_to(S::splat(u[1]))
                & S::splat(u[0]).up_to(S::load(&prepared.u[1]))
                & S::load(&prepared.v[0]).up_to(S::splat(v[1]))
                & S::splat(v[0]).up_to(S::load(&prepared.v[1]))
                & S::load(&prepared.depth).up_to(S::splat(limit));
            pairs |= u64::from(met * (self.live >> group & 1)) << (group * S::LANES);
        }
        let mut rays = [0; 16];
        while pairs != 0 {
            let pair = pairs.trailing_zeros() as usize;
            pairs &= pairs - 1;
            let (group, lane) = (pair / S::LANES, pair % S::LANES);
            rays[lane] |= self.test_pair::<S>(prepared, lane, group * S::LANES);
        }
        let mut left = 0;
        for lane in 0..16 {
            left |= u32::from(rays[lane] != 0) << lane;
        }
        while left != 0 {
            let lane = left.trailing_zeros() as usize;
            left &= left - 1;
            let (place, rays) = (prepared.places[lane], rays[lane]);
            self.nearest.propose::<S>(place, rays);
        }
    }

    /// A bit for each ray that may hit a prepared triangle, of as many as there are lanes from number `first` on.
    #[inline(always)]
    fn test_pair<S: Simd>(&self, prepared: &Prepared, lane: usize, first: usize) -> u64 {
        let [x, y, z] = &self.packet.directions;
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
        let passing = S::splat(prepared.depth[lane]).up_to(S::load(&self.nearest.limits[first..]))
            & !(low.below(S::splat(-margin)) & S::splat(margin).below(high));
        u64::from(passing) << first
    }
}
