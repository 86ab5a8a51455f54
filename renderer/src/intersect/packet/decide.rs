//! Keeps the nearest hits, and lets [`crate::intersect::triangle`] decide, many pairs of ray and triangle at a time,
//! where single precision is uncertain.
//!
//! Where single precision proves a hit, it also bounds the hit's depth, and hits whose bounds do not overlap are
//! ordered by them. So most hits that are not the nearest are dropped without the exact test, and only the t of the
//! nearest is computed, at the end.
//!
//! Each ray has an interval of its own, which a plane may have cut ([`Intervals`]): hits outside are dropped.

use crate::{
    grid::traced::TracedMesh,
    intersect::{
        margins::UNDERFLOW_MARGIN,
        packet::ray_set::{Packet, RaySet},
        ray::{Hit, Ray},
        triangle::{self, EdgePlanes, Plane, Vector, widen_corners},
    },
    simd::{Real, Simd},
};

/// Memory of [`NearestHits`]: the state of each ray of each packet.
#[repr(C, align(64))]
pub(super) struct HitScratch<const N: usize> {
    intervals: [Intervals; N],
    /// A hit at inverse depths between these is certainly within the interval.
    inverse_starts: [[f32; 64]; N],
    inverse_ends: [[f32; 64]; N],
    /// Inverse of the limit: no triangle at a greater depth along the major axis can be the nearest. Per world unit; infinite for a
    /// ray without an interval left.
    pub(super) inverse_limits: [[f32; 64]; N],
    /// The nearest of the triangles that single precision proves to be hit: the estimate.
    estimated: [[u32; 64]; N],
    /// Greatest possible inverse depth of the estimate.
    estimated_inverse_depths: [[f32; 64]; N],
    /// The nearest of the hits that were decided exactly.
    t: [[f64; 64]; N],
    triangles: [[u32; 64]; N],
}

impl<const N: usize> Default for HitScratch<N> {
    fn default() -> Self {
        Self {
            intervals: [Intervals::NONE; N],
            inverse_starts: [[0.0; 64]; N],
            inverse_ends: [[0.0; 64]; N],
            inverse_limits: [[0.0; 64]; N],
            estimated: [[Hit::MISS.triangle; 64]; N],
            estimated_inverse_depths: [[0.0; 64]; N],
            t: [[f64::from(Hit::MISS.t); 64]; N],
            triangles: [[Hit::MISS.triangle; 64]; N],
        }
    }
}

impl<const N: usize> HitScratch<N> {
    /// Sets the intervals of packets with active rays, and makes rays inactive of which a plane keeps nothing. Returns a lower
    /// bound of the depth along an axis at which rays start, in model space.
    #[inline(always)]
    pub(super) fn set_intervals(&mut self, packets: &[&Packet; N], active: &mut RaySet<N>, axis: usize) -> f32 {
        let mut least_start = f32::INFINITY;
        for (index, packet) in packets.iter().enumerate() {
            if active.masks[index] == 0 {
                continue;
            }
            if packet.clip.is_some() {
                let (empty, start) = self.intervals[index].cut(packet, axis);
                active.masks[index] &= !empty;
                least_start = least_start.min(start);
            } else {
                self.intervals[index].set([packet.t_min, packet.t_max]);
                least_start = 0.0;
            }
        }
        least_start
    }

    /// Sets the limits of a packet's rays from lane `first` on to the ends of their intervals; returns their inverses. In their
    /// place are the inverse depths of t = 1.
    #[inline(always)]
    pub(super) fn set_limits<S: Simd>(&mut self, packet: usize, first: usize) -> S {
        let margin = S::splat(UNDERFLOW_MARGIN);
        let inverse_depths = S::load(&self.inverse_limits[packet][first..]);
        let Intervals { inverse_starts, inverse_ends, inverse_limits, .. } = &self.intervals[packet];
        let inverse_starts = inverse_depths.mul_sub(S::load(&inverse_starts[first..]), margin);
        inverse_starts.store(&mut self.inverse_starts[packet][first..]);
        let inverse_ends = inverse_depths.mul_add(S::load(&inverse_ends[first..]), margin);
        inverse_ends.store(&mut self.inverse_ends[packet][first..]);
        // An infinite limit is that of a ray without an interval.
        let inverse_limits = inverse_depths.mul_sub(S::load(&inverse_limits[first..]), margin);
        let inverse_limits = inverse_limits.max(S::splat(0.0)).min(S::splat(f32::MAX));
        inverse_limits.store(&mut self.inverse_limits[packet][first..]);
        inverse_limits
    }
}

/// The intervals of a packet's rays, and bounds of them in single precision.
#[repr(C, align(64))]
struct Intervals {
    /// Empty where a plane keeps nothing.
    t_min: [f32; 64],
    t_max: [f32; 64],
    /// As [`inverse_bounds`] has them.
    inverse_starts: [f32; 64],
    inverse_ends: [f32; 64],
    inverse_limits: [f32; 64],
    /// The interval of all rays, if there is one.
    common: Option<[f32; 2]>,
}

impl Intervals {
    const NONE: Self = Self {
        t_min: [0.0; 64],
        t_max: [0.0; 64],
        inverse_starts: [0.0; 64],
        inverse_ends: [0.0; 64],
        inverse_limits: [0.0; 64],
        common: None,
    };

    /// Gives all rays an interval; most packets have that of the packets before them.
    #[inline(always)]
    fn set(&mut self, interval: [f32; 2]) {
        if self.common != Some(interval) {
            let [inverse_start, inverse_end, inverse_limit] = inverse_bounds(interval);
            (self.t_min, self.t_max) = ([interval[0]; 64], [interval[1]; 64]);
            (self.inverse_starts, self.inverse_ends) = ([inverse_start; 64], [inverse_end; 64]);
            self.inverse_limits = [inverse_limit; 64];
            self.common = Some(interval);
        }
    }

    /// Gives each ray what a plane keeps of it. Returns a bit for each of which nothing is left, and the least depth at which
    /// others start. A call of its own: its code would make all packets slower within the kernel.
    #[inline(never)]
    fn cut(&mut self, packet: &Packet, axis: usize) -> (u64, f32) {
        self.common = None;
        let (mut empty, mut least_start) = (0, f32::INFINITY);
        for lane in 0..64 {
            let Ray { direction, t_min, t_max, .. } = packet.ray(lane);
            (self.t_min[lane], self.t_max[lane]) = (t_min, t_max);
            [self.inverse_starts[lane], self.inverse_ends[lane], self.inverse_limits[lane]] =
                inverse_bounds([t_min, t_max]);
            if t_min > t_max {
                empty |= 1 << lane;
            } else {
                least_start = least_start.min(t_min * direction[axis].abs());
            }
        }
        (empty, least_start)
    }
}

/// Inverses of t: what lies between the first two is certainly within the interval, and nothing below the third is.
#[inline(always)]
fn inverse_bounds([t_min, t_max]: [f32; 2]) -> [f32; 3] {
    // Nothing is certain of ends that are not numbers, or so near that their inverse is too large.
    let inverse_start = (1.0 - 1e-6) / t_min;
    let start = match t_min {
        ..=0.0 => f32::INFINITY,
        _ if inverse_start.is_finite() => inverse_start,
        _ => f32::NAN,
    };
    let farthest = if t_max > FARTHEST_T { FARTHEST_T } else { t_max };
    let end = if t_max > 0.0 { (1.0 + 1e-6) / farthest } else { f32::INFINITY };
    // No subnormal numbers, which are slow, and no infinity: a limit may be too far, not too near.
    let limit = if t_max > FARTHEST_T { 0.0 } else { ((1.0 - 1e-6) / t_max).min(f32::MAX) };
    [start, end, limit]
}

/// The greatest t of which single precision is certain.
const FARTHEST_T: f32 = 1e30;

/// The nearest hits so far of packets that are traced together.
pub(super) struct NearestHits<'a, const N: usize> {
    pub(super) hits: &'a mut HitScratch<N>,
    mesh: &'a TracedMesh,
    pub(super) packets: [&'a Packet; N],
    axis: usize,
    /// Pairs of a ray (64·packet + lane) and a triangle that wait for the exact test.
    rays: [u8; 16],
    triangles: [u32; 16],
    n_pairs: usize,
}

impl<'a, const N: usize> NearestHits<'a, N> {
    /// No hits; the caller sets the limits.
    #[inline(always)]
    pub(super) fn new(
        mesh: &'a TracedMesh,
        packets: [&'a Packet; N],
        axis: usize,
        hits: &'a mut HitScratch<N>,
    ) -> Self {
        hits.estimated = [[Hit::MISS.triangle; 64]; N];
        hits.estimated_inverse_depths = [[0.0; 64]; N];
        hits.t = [[f64::from(Hit::MISS.t); 64]; N];
        hits.triangles = [[Hit::MISS.triangle; 64]; N];
        Self { hits, mesh, packets, axis, rays: [0; 16], triangles: [0; 16], n_pairs: 0 }
    }

    /// Decides the remaining pairs, computes the t of the estimates unless any hit will do, and writes the hits.
    #[inline(always)]
    pub(super) fn write<S: Simd>(&mut self, hits: &mut [[Hit; 64]]) {
        self.decide_queued::<S>();
        for packet in 0..N {
            if self.packets[packet].any_hit {
                self.take_estimated(packet);
                continue;
            }
            for first in (0..64).step_by(S::LANES) {
                self.intersect_estimated::<S>(packet, first);
            }
        }
        // Rays that hit nothing still have the triangle and the t of a miss, and those of any hit that t.
        for (packet, hits) in hits.iter_mut().take(N).enumerate() {
            for lane in 0..64 {
                hits[lane] = Hit { triangle: self.hits.triangles[packet][lane], t: self.hits.t[packet][lane] as f32 };
            }
        }
    }

    /// Keeps hits of a triangle as estimates where they are the nearest so far. `certain` is a mask of the packet's
    /// rays from lane `first` on that certainly hit it, at inverse depths within [least, greatest]. Returns the hits
    /// whose bounds overlap those of other hits, or the ends of the ray's interval.
    #[inline(always)]
    pub(super) fn keep_estimate<S: Simd>(
        &mut self,
        triangle: u32,
        packet: usize,
        first: usize,
        certain: u32,
        [least, greatest]: [S; 2],
    ) -> u32 {
        // Test that the whole bounds lie within the ray's interval, or before it.
        let any_hit = self.packets[packet].any_hit;
        let inverse_starts = S::load(&self.hits.inverse_starts[packet][first..]);
        let within = S::load(&self.hits.inverse_ends[packet][first..]).lt(least) & greatest.lt(inverse_starts);
        let too_near = inverse_starts.mul_add(S::splat(1.0 + 4e-6), S::splat(4.0 * UNDERFLOW_MARGIN)).lt(least);

        // Compare them with the estimate and the limit so far.
        let HitScratch { inverse_limits, estimated, estimated_inverse_depths, .. } = &mut *self.hits;
        let inverse_limits = &mut inverse_limits[packet][first..];
        let inverse_depths = &mut estimated_inverse_depths[packet][first..];
        let before = certain & within & S::load(inverse_depths).lt(least);
        let behind = greatest.lt(S::load(inverse_limits));

        // Replace the estimate where the hit is nearer, and move the limit up.
        greatest.masked_store(before, inverse_depths);
        let inverse_limit = if any_hit { S::splat(f32::INFINITY) } else { least.max(S::load(inverse_limits)) };
        inverse_limit.masked_store(before, inverse_limits);
        S::masked_fill(triangle, before, &mut estimated[packet][first..]);
        certain & !(before | behind | too_near)
    }

    /// Queues pairs of a triangle and the rays in a mask, whose first bit is ray `first`, until they fill a vector.
    #[inline(always)]
    pub(super) fn queue_exact_test<S: Simd>(&mut self, triangle: u32, first: usize, rays: u32) {
        let mut left = rays;
        while left != 0 {
            self.rays[self.n_pairs] = (first + left.trailing_zeros() as usize) as u8;
            self.triangles[self.n_pairs] = triangle;
            left &= left - 1;
            self.n_pairs += 1;
            if self.n_pairs == S::LANES {
                self.decide::<S>();
            }
        }
    }

    /// Decides the pairs that still wait.
    #[inline(always)]
    pub(super) fn decide_queued<S: Simd>(&mut self) {
        if self.n_pairs > 0 {
            self.decide::<S>();
        }
    }

    /// Decides the queued pairs in double precision, and exactly where that is uncertain.
    #[inline(always)]
    fn decide<S: Simd>(&mut self) {
        // Gather directions and corners; lanes without a pair repeat the first.
        let n_pairs = std::mem::take(&mut self.n_pairs);
        let mut directions = [[0.0; 16]; 3];
        for slot in 0..S::LANES {
            if slot >= n_pairs {
                self.triangles[slot] = self.triangles[0];
                self.rays[slot] = self.rays[0];
            }
            let ray = usize::from(self.rays[slot]);
            for axis in 0..3 {
                directions[axis][slot] = self.packets[ray / 64 % N].directions[axis][ray % 64];
            }
        }
        let [x, y, z] = &directions;
        let corners = self.mesh.gather_corners::<S>(&self.triangles);

        // Decide a vector of doubles at a time, and keep the hits.
        for first in (0..n_pairs).step_by(S::Double::LANES) {
            let planes = EdgePlanes::new(self.origin(), widen_corners(&corners, first));
            let direction = [S::Double::load(&x[first..]), S::Double::load(&y[first..]), S::Double::load(&z[first..])];
            let decision = planes.decide(direction);
            let mut all_t = [0.0; 8];
            decision.t.store(&mut all_t);
            let mut left = !decision.certain_miss & ((1 << (n_pairs - first).min(S::Double::LANES)) - 1);
            while left != 0 {
                let slot = left.trailing_zeros() as usize;
                left &= left - 1;
                let (ray, triangle) = (usize::from(self.rays[first + slot]), self.triangles[first + slot]);
                if decision.uncertain >> slot & 1 == 0 {
                    self.keep_if_nearest(ray, triangle, all_t[slot]);
                } else if let Some(t) = self.decide_exactly(ray, triangle) {
                    self.keep_if_nearest(ray, triangle, t);
                }
            }
        }
    }

    /// Takes the estimates of a packet's rays without their t: this saves up to 4 % of a frame with shadows.
    #[inline(always)]
    fn take_estimated(&mut self, packet: usize) {
        for lane in 0..64 {
            let (decided, estimated) = (self.hits.triangles[packet][lane], self.hits.estimated[packet][lane]);
            self.hits.triangles[packet][lane] = if decided == Hit::MISS.triangle { estimated } else { decided };
        }
    }

    /// Computes the t of the estimates of a vector of rays, from lane `first` on.
    #[inline(always)]
    fn intersect_estimated<S: Simd>(&mut self, packet: usize, first: usize) {
        // Find the rays that have an estimate.
        let indices = &self.hits.estimated[packet][first..];
        let all = ((1u64 << S::LANES) - 1) as u32;
        let estimated = all & !S::eq_mask(indices, Hit::MISS.triangle);
        if estimated == 0 {
            return;
        }

        // All rays hit one large triangle: set its plane up once.
        let any_triangle = indices[estimated.trailing_zeros() as usize];
        if estimated & !S::eq_mask(indices, any_triangle) == 0 {
            let corners = self.mesh.corners(any_triangle).map(|corner| corner.map(f64::from));
            let plane = Plane::new(self.origin(), corners).splat::<S::Double>();
            for half in (0..S::LANES).step_by(S::Double::LANES) {
                self.intersect_planes::<S>(packet, first + half, estimated >> half, &[any_triangle; 8], &plane);
            }
            return;
        }

        // Set up the plane of each lane's triangle.
        let mut triangles = [any_triangle; 16];
        for lane in 0..S::LANES {
            triangles[lane] = if estimated >> lane & 1 == 1 { indices[lane] } else { any_triangle };
        }
        let corners = self.mesh.gather_corners::<S>(&triangles);
        for half in (0..S::LANES).step_by(S::Double::LANES) {
            let plane = Plane::new(self.origin(), widen_corners(&corners, half));
            self.intersect_planes::<S>(packet, first + half, estimated >> half, &triangles[half..], &plane);
        }
    }

    /// Computes the t at which a packet's rays in a mask, from lane `first` on, hit the planes of their triangles.
    #[inline(always)]
    fn intersect_planes<S: Simd>(
        &mut self,
        packet: usize,
        first: usize,
        rays: u32,
        triangles: &[u32],
        plane: &Plane<S::Double>,
    ) {
        let [x, y, z] = &self.packets[packet].directions;
        let direction = [S::Double::load(&x[first..]), S::Double::load(&y[first..]), S::Double::load(&z[first..])];
        let mut all_t = [0.0; 8];
        plane.t(direction).store(&mut all_t);

        // Keep it where it is the ray's only hit, without a branch.
        let mut contested = 0u32;
        for lane in 0..S::Double::LANES {
            let (ray, is_met) = (first + lane, rays >> lane & 1 == 1);
            let is_only = is_met && self.hits.triangles[packet][ray] == Hit::MISS.triangle;
            contested |= u32::from(is_met && !is_only) << lane;
            self.hits.t[packet][ray] = if is_only { all_t[lane] } else { self.hits.t[packet][ray] };
            self.hits.triangles[packet][ray] = if is_only { triangles[lane] } else { self.hits.triangles[packet][ray] };
        }

        // Compare it with hits that were decided exactly.
        while contested != 0 {
            let lane = contested.trailing_zeros() as usize;
            contested &= contested - 1;
            self.keep_if_nearest(64 * packet + first + lane, triangles[lane], all_t[lane]);
        }
    }

    #[inline(always)]
    fn origin<R: Real>(&self) -> Vector<R> {
        let origin = self.packets[0].origin;
        [R::splat(f64::from(origin.x)), R::splat(f64::from(origin.y)), R::splat(f64::from(origin.z))]
    }

    /// Keeps a hit if it is the nearest of those that were decided exactly, and lies within the ray's interval.
    #[inline(always)]
    fn keep_if_nearest(&mut self, ray: usize, triangle: u32, t: f64) {
        let (index, lane) = (ray / 64 % N, ray % 64);
        let packet = self.packets[index];
        let (nearest, nearest_triangle) = (self.hits.t[index][lane], self.hits.triangles[index][lane]);
        let is_nearer = t < nearest
            || t == nearest && triangle != nearest_triangle && self.precedes_in_file(triangle, nearest_triangle);
        let Intervals { t_min, t_max, .. } = &self.hits.intervals[index];
        if is_nearer && (f64::from(t_min[lane])..=f64::from(t_max[lane])).contains(&t) {
            self.hits.t[index][lane] = t;
            self.hits.triangles[index][lane] = triangle;
            let depth = t * f64::from(packet.directions[self.axis][lane].abs());
            let inverse_limit =
                if packet.any_hit { f32::INFINITY } else { (((1.0 - 1e-6) / depth) as f32).min(f32::MAX) };
            let inverse_limits = &mut self.hits.inverse_limits[index];
            inverse_limits[lane] = inverse_limits[lane].max(inverse_limit);
        }
    }

    /// Whether a triangle comes before another in the file: of several at the same t the first in the file is hit.
    #[cold]
    #[inline(never)]
    fn precedes_in_file(&self, triangle: u32, other: u32) -> bool {
        self.mesh.file_index(triangle) < self.mesh.file_index(other)
    }

    /// The t of a hit in exact arithmetic, or `None` for a miss.
    #[cold]
    #[inline(never)]
    fn decide_exactly(&self, ray: usize, triangle: u32) -> Option<f64> {
        triangle::intersect_exactly(&self.packets[ray / 64].whole_ray(ray % 64), &self.mesh.corners(triangle))
    }
}
