//! The last step of a packet's way: the nearest hits are kept, and [`crate::intersect::triangle`] decides what single precision
//! cannot tell, many pairs of ray and triangle at a time.
//!
//! Where single precision is sure that a ray hits a triangle, and between which depths, it can tell hits apart that do
//! not lie too close together. So most that are not the nearest are dropped without a decision, and of the nearest only
//! its t remains to be found.

use crate::{
    grid::traced::TracedMesh,
    intersect::{
        packet::Packet,
        ray::Hit,
        simd::{Real, Simd},
        triangle::{self, EdgePlanes, Plane, Vector},
    },
};

/// The memory of [`NearestHits`]: what is known of each ray of each packet.
#[repr(C, align(64))]
pub(crate) struct HitScratch<const N: usize> {
    /// The inverse of the depth along the major axis beyond which a triangle cannot matter any more, per world unit.
    pub(crate) inverse_limits: [[f32; 64]; N],
    /// A triangle that it certainly hits, nearer than all others of which that was certain but those that were decided.
    estimated: [[u32; 64]; N],
    /// The greatest inverse depth that this hit can have.
    estimated_inverse_depths: [[f32; 64]; N],
    /// The nearest hit of those that were decided.
    t: [[f64; 64]; N],
    triangles: [[u32; 64]; N],
}

impl<const N: usize> Default for HitScratch<N> {
    fn default() -> Self {
        Self {
            inverse_limits: [[0.0; 64]; N],
            estimated: [[Hit::MISS.triangle; 64]; N],
            estimated_inverse_depths: [[0.0; 64]; N],
            t: [[f64::from(Hit::MISS.t); 64]; N],
            triangles: [[Hit::MISS.triangle; 64]; N],
        }
    }
}

/// The nearest hits of some packets so far.
pub(crate) struct NearestHits<'a, const N: usize> {
    hits: &'a mut HitScratch<N>,
    mesh: &'a TracedMesh,
    packets: [&'a Packet; N],
    /// The packets' major axis.
    axis: usize,
    /// Rays and triangles, pair by pair, that wait for a decision.
    rays: [u8; 16],
    triangles: [u32; 16],
    n_pairs: usize,
}

impl<'a, const N: usize> NearestHits<'a, N> {
    /// No hits yet, and limits that the caller must set.
    #[inline(always)]
    pub(crate) fn new(
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

    /// For each ray of a packet the inverse of the depth beyond which a triangle cannot matter to it any more.
    #[inline(always)]
    pub(crate) fn inverse_limits(&self, packet: usize) -> &[f32; 64] {
        &self.hits.inverse_limits[packet]
    }

    #[inline(always)]
    pub(crate) fn inverse_limits_mut(&mut self, packet: usize) -> &mut [f32; 64] {
        &mut self.hits.inverse_limits[packet]
    }

    /// Decides what remains, and writes the hits.
    #[inline(always)]
    pub(crate) fn write<S: Simd>(&mut self, hits: &mut [[Hit; 64]]) {
        self.decide_queued::<S>();
        for packet in 0..N {
            for first in (0..64).step_by(S::LANES) {
                self.intersect_estimated::<S>(packet, first);
            }
        }
        // What was never hit has the triangle and the t of a miss.
        for (packet, hits) in hits.iter_mut().take(N).enumerate() {
            for lane in 0..64 {
                hits[lane] = Hit { triangle: self.hits.triangles[packet][lane], t: self.hits.t[packet][lane] as f32 };
            }
        }
    }

    /// Keeps hits of a triangle by a packet's rays from number `first` on, of which single precision is certain, where
    /// they are the nearest so far. Their inverse depths lie between two bounds. Returns those that cannot be told apart
    /// from others, or from the ends of the ray.
    #[inline(always)]
    pub(crate) fn keep_estimate<S: Simd>(
        &mut self,
        triangle: u32,
        packet: usize,
        first: usize,
        certain: u32,
        [least, greatest]: [S; 2],
    ) -> u32 {
        let Packet { directions, t_min, t_max, any_hit, .. } = self.packets[packet];
        let along = S::load(&directions[self.axis][first..]).abs();
        let one = S::splat(1.0);
        let within = one.lt(least.mul(along).mul(S::splat(*t_max * (1.0 - 1e-6))))
            & greatest.mul(along).mul(S::splat(*t_min * (1.0 + 1e-6))).lt(one);
        let HitScratch { inverse_limits, estimated, estimated_inverse_depths, .. } = &mut *self.hits;
        let inverse_limits = &mut inverse_limits[packet][first..];
        let inverse_depths = &mut estimated_inverse_depths[packet][first..];
        let before = certain & within & S::load(inverse_depths).lt(least);
        let behind = greatest.lt(S::load(inverse_limits));
        greatest.masked_store(before, inverse_depths);
        let inverse_limit = if *any_hit { S::splat(f32::INFINITY) } else { least.max(S::load(inverse_limits)) };
        inverse_limit.masked_store(before, inverse_limits);
        S::masked_fill(triangle, before, &mut estimated[packet][first..]);
        certain & !(before | behind)
    }

    /// Keeps pairs of a triangle and some of the rays from number `first` on until there are enough of them for one
    /// decision.
    #[inline(always)]
    pub(crate) fn queue_exact_test<S: Simd>(&mut self, triangle: u32, first: usize, rays: u32) {
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

    /// Decides what still waits.
    #[inline(always)]
    pub(crate) fn decide_queued<S: Simd>(&mut self) {
        if self.n_pairs > 0 {
            self.decide::<S>();
        }
    }

    /// Decides the pairs.
    #[inline(always)]
    fn decide<S: Simd>(&mut self) {
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
        let corners = CornerLanes::of::<S>(self.mesh, &self.triangles);
        for first in (0..n_pairs).step_by(S::Double::LANES) {
            let planes = EdgePlanes::new(self.origin(), corners.double_lanes::<S::Double>(first));
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

    /// Finds where a packet's rays from number `first` on hit the triangles that they certainly hit.
    #[inline(always)]
    fn intersect_estimated<S: Simd>(&mut self, packet: usize, first: usize) {
        let places = &self.hits.estimated[packet][first..];
        let all = ((1u64 << S::LANES) - 1) as u32;
        let estimated = all & !S::eq_mask(places, Hit::MISS.triangle);
        if estimated == 0 {
            return;
        }
        let any_triangle = places[estimated.trailing_zeros() as usize];
        if estimated & !S::eq_mask(places, any_triangle) == 0 {
            // A large triangle.
            let corners = self.mesh.corners(any_triangle).map(|corner| corner.map(f64::from));
            let plane = Plane::new(self.origin(), corners).splat::<S::Double>();
            for half in (0..S::LANES).step_by(S::Double::LANES) {
                self.intersect_planes::<S>(packet, first + half, estimated >> half, &[any_triangle; 8], &plane);
            }
            return;
        }
        let mut triangles = [any_triangle; 16];
        for lane in 0..S::LANES {
            triangles[lane] = if estimated >> lane & 1 == 1 { places[lane] } else { any_triangle };
        }
        let corners = CornerLanes::of::<S>(self.mesh, &triangles);
        for half in (0..S::LANES).step_by(S::Double::LANES) {
            let plane = Plane::new(self.origin(), corners.double_lanes::<S::Double>(half));
            self.intersect_planes::<S>(packet, first + half, estimated >> half, &triangles[half..], &plane);
        }
    }

    /// Finds where some of a packet's rays from number `first` on hit the planes of triangles that they certainly hit.
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
        let mut contested = 0u32;
        for lane in 0..S::Double::LANES {
            let (ray, is_met) = (first + lane, rays >> lane & 1 == 1);
            let is_only = is_met && self.hits.triangles[packet][ray] == Hit::MISS.triangle;
            contested |= u32::from(is_met && !is_only) << lane;
            self.hits.t[packet][ray] = if is_only { all_t[lane] } else { self.hits.t[packet][ray] };
            self.hits.triangles[packet][ray] = if is_only { triangles[lane] } else { self.hits.triangles[packet][ray] };
        }
        while contested != 0 {
            let lane = contested.trailing_zeros() as usize;
            contested &= contested - 1;
            self.keep_if_nearest(64 * packet + first + lane, triangles[lane], all_t[lane]);
        }
    }

    /// Where all rays begin, in each lane.
    #[inline(always)]
    fn origin<R: Real>(&self) -> Vector<R> {
        let origin = self.packets[0].origin;
        [R::splat(f64::from(origin.x)), R::splat(f64::from(origin.y)), R::splat(f64::from(origin.z))]
    }

    /// Keeps a hit if it is a ray's nearest so far of those that were decided.
    #[inline(always)]
    fn keep_if_nearest(&mut self, ray: usize, triangle: u32, t: f64) {
        let (index, lane) = (ray / 64 % N, ray % 64);
        let packet = self.packets[index];
        let (nearest, nearest_triangle) = (self.hits.t[index][lane], self.hits.triangles[index][lane]);
        let is_nearer = t < nearest
            || t == nearest && triangle != nearest_triangle && self.precedes_in_file(triangle, nearest_triangle);
        if is_nearer && (f64::from(packet.t_min)..=f64::from(packet.t_max)).contains(&t) {
            self.hits.t[index][lane] = t;
            self.hits.triangles[index][lane] = triangle;
            let depth = t * f64::from(packet.directions[self.axis][lane].abs());
            let inverse_limit = if packet.any_hit { f32::INFINITY } else { ((1.0 - 1e-6) / depth) as f32 };
            let inverse_limits = &mut self.hits.inverse_limits[index];
            inverse_limits[lane] = inverse_limits[lane].max(inverse_limit);
        }
    }

    /// Of triangles at the same t the first in the file wins.
    #[cold]
    #[inline(never)]
    fn precedes_in_file(&self, triangle: u32, other: u32) -> bool {
        self.mesh.file_index(triangle) < self.mesh.file_index(other)
    }

    #[cold]
    #[inline(never)]
    fn decide_exactly(&self, ray: usize, triangle: u32) -> Option<f64> {
        triangle::intersect_exactly(&self.packets[ray / 64].ray(ray % 64), &self.mesh.corners(triangle))
    }
}

/// The corners of triangles, one in each lane: for each corner and each axis a coordinate.
struct CornerLanes([[[f32; 16]; 3]; 3]);

impl CornerLanes {
    /// Of as many triangles as there are lanes.
    #[inline(always)]
    fn of<S: Simd>(mesh: &TracedMesh, places: &[u32; 16]) -> Self {
        let in_lanes = mesh.gather_corners::<S>(places);
        let mut corners = [[[0.0; 16]; 3]; 3];
        for corner in 0..3 {
            for axis in 0..3 {
                in_lanes[corner][axis].store(&mut corners[corner][axis]);
            }
        }
        Self(corners)
    }

    /// Those from number `first` on, as many as `R` has lanes.
    #[inline(always)]
    fn double_lanes<R: Real>(&self, first: usize) -> [Vector<R>; 3] {
        let mut double = [[R::splat(0.0); 3]; 3];
        for corner in 0..3 {
            for axis in 0..3 {
                double[corner][axis] = R::load(&self.0[corner][axis][first..]);
            }
        }
        double
    }
}
