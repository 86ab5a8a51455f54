//! From the triangles in a packet's way to its hits: gathers triangles, culls them many at a time, lets
//! [`crate::triangle`] decide the rest.
//!
//! Everything here may only drop pairs of ray and triangle that certainly miss, with rounding accounted for.
//! There are no closures over vectors: they would not be compiled for the caller's instruction set.

use super::{
    Grid,
    boxes::{Bounds, LeafBoxes},
    kernel::Kernel,
    packet::Packet,
    prepared::{Bundle, Prepared, SLOPE_MARGIN},
};
use crate::{
    ray::Hit,
    simd::{Real, Simd},
    traced::TracedMesh,
    triangle::{self, Planes},
};

/// From so many triangles for each ray on, a leaf's boxes are tested against its rays one by one: in a scan seen from
/// afar most triangles lie between the rays.
const MANY_TRIANGLES_PER_RAY: usize = 5;

/// From so many rays on that may hit a triangle, it is made ready for all of them, not for each anew.
const MANY_RAYS: u32 = 4;

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
    /// Coordinates of all vertices.
    coordinates: &'a [f32],
    packet: &'a Packet,
    pub(super) bundle: Bundle,
    /// Finest cells in a world unit, rounded up.
    cells_per_unit: f32,
    /// Slopes of the rays against the major axis.
    u: [f32; 64],
    v: [f32; 64],
    /// Depth along the major axis beyond which a triangle cannot matter to a ray any more, in world units.
    limits: [f32; 64],
    groups: [Group; 8],
    /// The farthest limit of all rays without a final answer, in finest cells.
    farthest: f32,
    /// A bit for each group that has rays without a final answer.
    live: u32,
    nearest_t: [f64; 64],
    nearest_triangle: [u32; 64],
    /// Triangles that wait until a vector is full.
    waiting: [u32; N_WAITING],
    n_waiting: usize,
    recent: [u32; N_RECENT],
    /// Pairs that wait for a decision: ray and triangle.
    candidates: [(u8, u32); 8],
    n_candidates: usize,
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
            coordinates: mesh.coordinates(),
            packet,
            bundle: Bundle { origin: packet.origin.to_array(), axes, sign, slopes: [0.0; 4], reach: [0.0; 3] },
            u: [0.0; 64],
            v: [0.0; 64],
            limits: [f32::INFINITY; 64],
            groups: [Group::default(); 8],
            farthest: f32::INFINITY,
            live: 0,
            nearest_t: [f64::from(Hit::MISS.t); 64],
            nearest_triangle: [Hit::MISS.triangle; 64],
            waiting: [0; N_WAITING],
            n_waiting: 0,
            recent: [u32::MAX; N_RECENT],
            candidates: [(0, 0); 8],
            n_candidates: 0,
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
            limits.store(&mut culler.limits[first..]);
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
            culler.limits[inactive.trailing_zeros() as usize] = f32::NEG_INFINITY;
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
                & depth.up_to(S::load(&self.limits[first..]));
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
            passed |= bounds.passed_by([u, u, v, v], self.limits[ray] * self.cells_per_unit);
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
            let limits = S::load(&self.limits[group * S::LANES..]);
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

    /// The hits, when all is settled.
    #[inline(always)]
    pub(super) fn hits(&self) -> [Hit; 64] {
        // What was never hit has the triangle and the t of a miss.
        std::array::from_fn(|lane| Hit { triangle: self.nearest_triangle[lane], t: self.nearest_t[lane] as f32 })
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
        if self.n_candidates > 0 {
            self.decide::<S>();
        }
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
            if rays.count_ones() >= MANY_RAYS {
                self.decide_triangle::<S>(place, rays);
            } else {
                self.decide_later::<S>(place, rays);
            }
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
        let passing = S::splat(prepared.depth[lane]).up_to(S::load(&self.limits[first..]))
            & !(low.below(S::splat(-margin)) & S::splat(margin).below(high));
        u64::from(passing) << first
    }

    /// Keeps pairs of rays and a triangle until there are enough of them for one decision.
    #[inline(always)]
    fn decide_later<S: Simd>(&mut self, triangle: u32, mut rays: u64) {
        while rays != 0 {
            self.candidates[self.n_candidates] = (rays.trailing_zeros() as u8, triangle);
            rays &= rays - 1;
            self.n_candidates += 1;
            if self.n_candidates == S::Double::LANES {
                self.decide::<S>();
            }
        }
    }

    /// Lets the canonical routine decide which of some rays hit a triangle.
    #[inline(always)]
    fn decide_triangle<S: Simd>(&mut self, triangle: u32, rays: u64) {
        let corners = self.mesh.corners(triangle).map(|corner| corner.map(f64::from));
        let origin = self.packet.origin.to_array().map(f64::from);
        let planes = Planes::new(origin, corners).splat::<S::Double>();
        let lanes = (1 << S::Double::LANES) - 1;
        let mut left = rays;
        while left != 0 {
            let first = left.trailing_zeros() as usize / S::Double::LANES * S::Double::LANES;
            let these = (left >> first) as u32 & lanes;
            left &= !(u64::from(lanes) << first);
            let [x, y, z] = &self.packet.directions;
            let decision = planes.decide([
                S::Double::load(&x[first..]),
                S::Double::load(&y[first..]),
                S::Double::load(&z[first..]),
            ]);
            let mut all_t = [0.0; 8];
            decision.t.store(&mut all_t);
            let mut hits = these & !decision.certain_miss;
            while hits != 0 {
                let lane = hits.trailing_zeros() as usize;
                hits &= hits - 1;
                self.keep(first + lane, triangle, all_t[lane], decision.uncertain >> lane & 1 == 1);
            }
        }
    }

    /// Lets the canonical routine decide the candidates, and keeps the nearest hits.
    #[inline(always)]
    fn decide<S: Simd>(&mut self) {
        let mut directions = [[0.0; 8]; 3];
        let mut corners = [[[0.0; 8]; 3]; 3];
        for (slot, &(ray, triangle)) in self.candidates[..self.n_candidates].iter().enumerate() {
            for axis in 0..3 {
                directions[axis][slot] = self.packet.directions[axis][ray as usize];
            }
            let indices = self.mesh.indices(triangle);
            for corner in 0..3 {
                let vertex = 3 * indices[corner] as usize;
                for axis in 0..3 {
                    corners[corner][axis][slot] = self.coordinates[vertex + axis];
                }
            }
        }
        let mut vectors = [[S::Double::splat(0.0); 3]; 5];
        for axis in 0..3 {
            vectors[3][axis] = S::Double::load(&directions[axis]);
            vectors[4][axis] = S::Double::splat(f64::from(self.packet.origin[axis]));
            for corner in 0..3 {
                vectors[corner][axis] = S::Double::load(&corners[corner][axis]);
            }
        }
        let [a, b, c, direction, origin] = vectors;
        let decision = Planes::new(origin, [a, b, c]).decide(direction);
        let mut all_t = [0.0; 8];
        decision.t.store(&mut all_t);
        let mut left = !decision.certain_miss & ((1 << self.n_candidates) - 1);
        while left != 0 {
            let slot = left.trailing_zeros() as usize;
            left &= left - 1;
            let (ray, triangle) = self.candidates[slot];
            self.keep(ray as usize, triangle, all_t[slot], decision.uncertain >> slot & 1 == 1);
        }
        self.n_candidates = 0;
    }

    /// Keeps a hit if it is a ray's nearest so far.
    #[inline(always)]
    fn keep(&mut self, ray: usize, triangle: u32, t: f64, is_uncertain: bool) {
        let t = if is_uncertain {
            match self.decide_exactly(ray, triangle) {
                Some(exact) => exact,
                None => return,
            }
        } else {
            t
        };
        let nearest = self.nearest_t[ray];
        let range = f64::from(self.packet.t_min)..=f64::from(self.packet.t_max);
        if range.contains(&t)
            && (t < nearest
                || t == nearest
                    && triangle != self.nearest_triangle[ray]
                    && self.is_before(triangle, self.nearest_triangle[ray]))
        {
            self.nearest_t[ray] = t;
            self.nearest_triangle[ray] = triangle;
            let depth = t * f64::from(self.packet.directions[self.bundle.axes[0]][ray].abs());
            let limit = (depth * (1.0 + 1e-6)) as f32;
            if self.packet.any_hit {
                self.limits[ray] = f32::NEG_INFINITY;
            } else if limit < self.limits[ray] {
                self.limits[ray] = limit;
            }
        }
    }

    /// Of triangles at the same t the first in the file wins.
    #[cold]
    #[inline(never)]
    fn is_before(&self, triangle: u32, other: u32) -> bool {
        self.mesh.number(triangle) < self.mesh.number(other)
    }

    #[cold]
    #[inline(never)]
    fn decide_exactly(&self, ray: usize, triangle: u32) -> Option<f64> {
        triangle::intersect_exactly(&self.packet.ray(ray), &self.mesh.corners(triangle))
    }
}
