//! Measures speed and error of all methods in one run. They alternate on the same rays and candidates, every few
//! microseconds, so that other load on the machine slows all of them alike.

use cpu_time::ThreadTime;
use renderer::{grid::traced::TracedMesh, intersect::ray::Ray, model::mesh::Mesh};

use super::{
    candidates::{Candidates, PlacedModel},
    methods::{Answer, Method},
    reference::{self, Verdict},
};
use crate::statistics::{median, quantiles};

#[derive(Clone, Debug, Default)]
pub(super) struct Measurement {
    cpu_s: f64,
    n_rays: u64,
    /// Rays that the reference decides.
    pub(super) n_compared: u64,
    /// Rays that pass too close to an edge for the reference.
    pub(super) n_undecided: u64,
    pub(super) n_lost: u64,
    pub(super) n_invented: u64,
    /// Hits of a triangle that is not the nearest.
    pub(super) n_other_triangle: u64,
    /// Relative depth errors where method and reference hit.
    depth_errors: Vec<f32>,
}

/// Relative depth difference of triangles that count as equally near, for example coincident faces of two solids.
const SAME_DEPTH: f64 = 1e-12;

/// Rays of a chunk: their candidates fit the second-level cache.
const CHUNK: usize = 1024;

/// Measures all methods, in the order of [`Method::ALL`]. `progress` gets the fraction done, 0 to 1.
pub(super) fn measure(
    mesh: &Mesh,
    placed: &PlacedModel,
    candidates: &Candidates,
    n_repeats: usize,
    progress: &dyn Fn(f32),
) -> Vec<Measurement> {
    let mut measurements = vec![Measurement::default(); Method::ALL.len()];
    let n_chunks = candidates.n_chunks(CHUNK);
    for (index, chunk) in candidates.chunks(CHUNK).enumerate() {
        progress(index as f32 / n_chunks as f32);
        if !chunk.is_empty() {
            Chunk::new(mesh, placed, &chunk).measure(n_repeats, &mut measurements);
        }
    }
    measurements
}

/// Some rays, with their candidates contiguous in memory.
struct Chunk {
    rays: Vec<Ray>,
    /// One triangle for each pair of ray and candidate.
    mesh: TracedMesh,
    candidates: Vec<u32>,
    ends: Vec<usize>,
}

impl Chunk {
    fn new(mesh: &Mesh, placed: &PlacedModel, rays: &[(Ray, &[u32])]) -> Self {
        let mut pairs = Mesh::default();
        let mut ends = Vec::with_capacity(rays.len());
        for (_, triangles) in rays {
            for corners in triangles.iter().filter_map(|&triangle| placed.corners(mesh, triangle as usize)) {
                let first = pairs.vertices.len() as u32;
                pairs.vertices.extend(corners);
                pairs.triangles.push([first, first + 1, first + 2]);
            }
            ends.push(pairs.triangles.len());
        }
        let candidates: Vec<u32> = (0..pairs.triangles.len() as u32).collect();
        let mesh = TracedMesh::new(pairs, candidates.clone());
        Self { rays: rays.iter().map(|&(ray, _)| ray).collect(), mesh, candidates, ends }
    }

    fn measure(&self, n_repeats: usize, measurements: &mut [Measurement]) {
        let mut times = vec![Vec::with_capacity(n_repeats); Method::ALL.len()];
        let mut answers = vec![Vec::with_capacity(self.rays.len()); Method::ALL.len()];
        for repeat in 0..n_repeats {
            for turn in 0..Method::ALL.len() {
                let index = (turn + repeat) % Method::ALL.len();
                answers[index].clear();
                let started = ThreadTime::now();
                Method::ALL[index].run(&self.mesh, &self.rays, &self.candidates, &self.ends, &mut answers[index]);
                times[index].push(started.elapsed().as_secs_f64());
            }
        }
        let truths: Vec<_> = (0..self.rays.len()).map(|ray| self.truth(ray)).collect();
        for ((measurement, times), answers) in measurements.iter_mut().zip(times).zip(&answers) {
            measurement.cpu_s += median(times);
            measurement.n_rays += self.rays.len() as u64;
            for (ray, (&truth, &answer)) in truths.iter().zip(answers).enumerate() {
                self.compare(measurement, ray, truth, answer);
            }
        }
    }

    fn truth(&self, ray: usize) -> Verdict {
        let first = if ray == 0 { 0 } else { self.ends[ray - 1] };
        let candidates = &self.candidates[first..self.ends[ray]];
        reference::truth(&self.rays[ray], candidates.iter().map(|&triangle_idx| self.mesh.corners(triangle_idx)))
    }

    fn compare(&self, measurement: &mut Measurement, ray: usize, truth: Verdict, answer: Answer) {
        if truth == Verdict::Unknown {
            measurement.n_undecided += 1;
            return;
        }
        measurement.n_compared += 1;
        match (truth, answer) {
            (Verdict::Hit(_), None) => measurement.n_lost += 1,
            (Verdict::Hit(nearest), Some((triangle_idx, t))) => {
                let verdict = reference::verdict(&self.rays[ray], &self.mesh.corners(triangle_idx));
                let is_nearest = matches!(verdict, Verdict::Hit(t) if t <= nearest * (1.0 + SAME_DEPTH));
                measurement.n_other_triangle += u64::from(!is_nearest);
                if nearest > 0.0 {
                    measurement.depth_errors.push(((t - nearest).abs() / nearest) as f32);
                }
            }
            (_, Some(_)) => measurement.n_invented += 1,
            (_, None) => {}
        }
    }
}

impl Measurement {
    pub(super) fn add(&mut self, other: &Self) {
        self.cpu_s += other.cpu_s;
        self.n_rays += other.n_rays;
        self.n_compared += other.n_compared;
        self.n_undecided += other.n_undecided;
        self.n_lost += other.n_lost;
        self.n_invented += other.n_invented;
        self.n_other_triangle += other.n_other_triangle;
        self.depth_errors.extend_from_slice(&other.depth_errors);
    }

    pub(super) fn cpu_ns_per_ray(&self) -> f64 {
        self.cpu_s * 1e9 / self.n_rays as f64
    }

    /// Rays where method and reference hit.
    pub(super) fn n_hits(&self) -> usize {
        self.depth_errors.len()
    }

    pub(super) fn n_wrong(&self) -> u64 {
        self.n_lost + self.n_invented + self.n_other_triangle
    }

    /// Relative depth errors: median, 99.9 % and maximum.
    pub(super) fn depth_error_quantiles(&self) -> [f64; 3] {
        quantiles(self.depth_errors.iter().map(|&error| f64::from(error)), [0.5, 0.999, 1.0])
    }
}
