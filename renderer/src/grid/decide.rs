//! The last step of a packet's way: [`crate::triangle`] decides which rays hit a triangle, many at a time, and the
//! nearest hits are kept.

use super::{packet::Packet, ray_set::RaySet};
use crate::{
    ray::Hit,
    simd::{Real, Simd},
    traced::TracedMesh,
    triangle::{self, Planes},
};

/// From so many rays on that may hit a triangle, it is made ready for all of them, not for each anew.
const MANY_RAYS: u32 = 4;

/// The nearest hits of some packets so far, ray after ray of one packet after the other.
#[repr(C, align(64))]
pub(super) struct NearestHits<'a, const N: usize> {
    /// Depth along the major axis beyond which a triangle cannot matter to a ray any more, in world units.
    pub(super) limits: [[f32; 64]; N],
    t: [[f64; 64]; N],
    triangles: [[u32; 64]; N],
    mesh: &'a TracedMesh,
    /// Coordinates of all vertices.
    coordinates: &'a [f32],
    packets: [&'a Packet; N],
    /// The packets' major axis.
    axis: usize,
    /// Pairs that wait for a decision: ray and triangle.
    candidates: [(u8, u32); 8],
    n_candidates: usize,
}

impl<'a, const N: usize> NearestHits<'a, N> {
    #[inline(always)]
    pub(super) fn new(mesh: &'a TracedMesh, packets: [&'a Packet; N], axis: usize) -> Self {
        Self {
            mesh,
            coordinates: mesh.coordinates(),
            packets,
            axis,
            limits: [[f32::INFINITY; 64]; N],
            t: [[f64::from(Hit::MISS.t); 64]; N],
            triangles: [[Hit::MISS.triangle; 64]; N],
            candidates: [(0, 0); 8],
            n_candidates: 0,
        }
    }

    /// Writes the hits, when all is decided.
    #[inline(always)]
    pub(super) fn write(&self, hits: &mut [[Hit; 64]]) {
        // What was never hit has the triangle and the t of a miss.
        for (packet, hits) in hits.iter_mut().take(N).enumerate() {
            for lane in 0..64 {
                hits[lane] = Hit { triangle: self.triangles[packet][lane], t: self.t[packet][lane] as f32 };
            }
        }
    }

    /// Decides now or soon which of some rays hit a triangle.
    #[inline(always)]
    pub(super) fn propose<S: Simd>(&mut self, triangle: u32, rays: &RaySet<N>) {
        if rays.count() >= MANY_RAYS {
            self.decide_triangle::<S>(triangle, rays);
        } else {
            self.decide_later::<S>(triangle, rays);
        }
    }

    /// Decides what still waits.
    #[inline(always)]
    pub(super) fn decide_rest<S: Simd>(&mut self) {
        if self.n_candidates > 0 {
            self.decide::<S>();
        }
    }

    /// Keeps pairs of rays and a triangle until there are enough of them for one decision.
    #[inline(always)]
    fn decide_later<S: Simd>(&mut self, triangle: u32, rays: &RaySet<N>) {
        for packet in 0..N {
            let mut left = rays.of_packets[packet];
            while left != 0 {
                let ray = 64 * packet + left.trailing_zeros() as usize;
                left &= left - 1;
                self.candidates[self.n_candidates] = (ray as u8, triangle);
                self.n_candidates += 1;
                if self.n_candidates == S::Double::LANES {
                    self.decide::<S>();
                }
            }
        }
    }

    /// Decides which of some rays hit a triangle.
    #[inline(always)]
    fn decide_triangle<S: Simd>(&mut self, triangle: u32, rays: &RaySet<N>) {
        let corners = self.mesh.corners(triangle).map(|corner| corner.map(f64::from));
        let origin = self.packets[0].origin.to_array().map(f64::from);
        let planes = Planes::new(origin, corners).splat::<S::Double>();
        let lanes = (1 << S::Double::LANES) - 1;
        for packet in 0..N {
            let mut left = rays.of_packets[packet];
            while left != 0 {
                let first = left.trailing_zeros() as usize / S::Double::LANES * S::Double::LANES;
                let these = (left >> first) as u32 & lanes;
                left &= !(u64::from(lanes) << first);
                let [x, y, z] = &self.packets[packet].directions;
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
                    self.keep(64 * packet + first + lane, triangle, all_t[lane], decision.uncertain >> lane & 1 == 1);
                }
            }
        }
    }

    /// Decides the candidates.
    #[inline(always)]
    fn decide<S: Simd>(&mut self) {
        let mut directions = [[0.0; 8]; 3];
        let mut corners = [[[0.0; 8]; 3]; 3];
        for (slot, &(ray, triangle)) in self.candidates[..self.n_candidates].iter().enumerate() {
            for axis in 0..3 {
                directions[axis][slot] = self.packets[ray as usize / 64].directions[axis][ray as usize % 64];
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
            vectors[4][axis] = S::Double::splat(f64::from(self.packets[0].origin[axis]));
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
        let nearest = self.t[ray / 64 % N][ray % 64];
        let (index, lane) = (ray / 64 % N, ray % 64);
        let packet = self.packets[index];
        let range = f64::from(packet.t_min)..=f64::from(packet.t_max);
        if range.contains(&t)
            && (t < nearest
                || t == nearest
                    && triangle != self.triangles[index][lane]
                    && self.is_before(triangle, self.triangles[index][lane]))
        {
            self.t[index][lane] = t;
            self.triangles[index][lane] = triangle;
            let depth = t * f64::from(packet.directions[self.axis][lane].abs());
            let limit = (depth * (1.0 + 1e-6)) as f32;
            if packet.any_hit {
                self.limits[index][lane] = f32::NEG_INFINITY;
            } else if limit < self.limits[index][lane] {
                self.limits[index][lane] = limit;
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
        triangle::intersect_exactly(&self.packets[ray / 64].ray(ray % 64), &self.mesh.corners(triangle))
    }
}
