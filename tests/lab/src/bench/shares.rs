//! Measures the cost of tasks: each is traced alone on one thread, as a render server traces it.

use std::{collections::HashMap, rc::Rc, time::Duration};

use cpu_time::ThreadTime;
use renderer::{render::scene::Scene, server::task::chunk_units};
use shared::{
    codec::{CHUNK_HEADER_BYTES, HEADER_BYTES},
    division::Task,
    protocol::{Chunk, Encoding, FrameId, FrameSpec, RunCosts, TaskId},
};

use super::replay::{TracedChunk, TracedShare};

/// Least number of passes over all shares of a frame; of each part the fastest time counts. The first pass fills the
/// caches, which on a render server the frame before has filled.
pub(super) const FEWEST_PASSES: u32 = 4;

/// Passes end when this many in a row have made no share faster…
const SETTLED_PASSES: u32 = 2;

/// …by more than this fraction: other load on this machine delays some shares and not others.
const LEAST_GAIN: f64 = 0.01;

pub(super) const MOST_PASSES: u32 = 16;

#[derive(Debug, Default)]
struct Passes {
    n_done: u32,
    /// Passes in a row that made no share faster.
    n_settled: u32,
}

impl Passes {
    /// Adds a pass that made a share faster by at most this fraction of its time.
    fn add(&mut self, largest_gain: f64) {
        self.n_done += 1;
        self.n_settled = if largest_gain > LEAST_GAIN { 0 } else { self.n_settled + 1 };
    }

    fn are_enough(&self) -> bool {
        self.n_done >= MOST_PASSES || self.n_done >= FEWEST_PASSES && self.n_settled >= SETTLED_PASSES
    }
}

/// Traces shares and keeps their costs, because each link needs the same shares again.
pub(super) struct ShareTracer<'a> {
    scene: &'a Scene,
    known: HashMap<String, Rc<TracedShare>>,
    n_frames: u32,
    /// Called before each pass with the number of the traced frame and of the pass, both from 1.
    on_pass: &'a dyn Fn(u32, u32),
}

impl<'a> ShareTracer<'a> {
    pub(super) fn new(scene: &'a Scene, on_pass: &'a dyn Fn(u32, u32)) -> Self {
        Self { scene, known: HashMap::new(), n_frames: 0, on_pass }
    }

    pub(super) fn trace(
        &mut self,
        tasks: &[(FrameSpec, Task)],
        is_stopped: impl Fn() -> bool,
    ) -> Option<Vec<Rc<TracedShare>>> {
        // Specs hold floats and have no hash; their debug text is exact.
        let keys: Vec<_> = tasks.iter().map(|task| format!("{task:?}")).collect();
        let new: Vec<_> = (0..tasks.len()).filter(|&index| !self.known.contains_key(&keys[index])).collect();
        let mut traced: Vec<Option<TracedShare>> = vec![None; new.len()];
        let mut passes = Passes::default();
        self.n_frames += u32::from(!new.is_empty());
        while !new.is_empty() && !passes.are_enough() {
            (self.on_pass)(self.n_frames, passes.n_done + 1);
            let mut largest_gain = 0.0f64;
            for (&index, so_far) in new.iter().zip(&mut traced) {
                if is_stopped() {
                    return None;
                }
                let (spec, task) = &tasks[index];
                let once_more = trace(self.scene, spec, task);
                *so_far = Some(match so_far.take() {
                    Some(so_far) => {
                        let before = so_far.cpu();
                        let fastest = so_far.fastest(&once_more);
                        largest_gain = largest_gain.max(1.0 - fastest.cpu().as_secs_f64() / before.as_secs_f64());
                        fastest
                    }
                    None => once_more,
                });
            }
            passes.add(largest_gain);
        }
        let new = new.into_iter().map(|index| keys[index].clone());
        self.known.extend(new.zip(traced.into_iter().flatten().map(Rc::new)));
        Some(keys.iter().map(|key| Rc::clone(&self.known[key])).collect())
    }
}

impl TracedShare {
    /// Combines two tracings: the faster time of each measured run, and of the rest of each chunk. Small parts are seldom
    /// disturbed.
    fn fastest(mut self, other: &Self) -> Self {
        let rests: Vec<_> =
            (0..self.chunks.len()).map(|chunk| self.beside_runs(chunk).min(other.beside_runs(chunk))).collect();
        self.costs.cpu_ns.iter_mut().zip(&other.costs.cpu_ns).for_each(|(ns, other)| *ns = (*ns).min(*other));
        for (chunk, rest) in rests.into_iter().enumerate() {
            self.chunks[chunk].cpu = self.in_runs(chunk) + rest;
        }
        self
    }

    fn cpu(&self) -> Duration {
        self.chunks.iter().map(|chunk| chunk.cpu).sum()
    }

    /// CPU time of a chunk's measured runs; 0 if none were measured.
    fn in_runs(&self, chunk: usize) -> Duration {
        let RunCosts { run_units, cpu_ns } = &self.costs;
        let TracedChunk { first_unit, n_units, .. } = self.chunks[chunk];
        let index = |unit: u32| (unit.div_ceil((*run_units).max(1)) as usize).min(cpu_ns.len());
        Duration::from_nanos(
            cpu_ns[index(first_unit)..index(first_unit + n_units)].iter().map(|&ns| u64::from(ns)).sum(),
        )
    }

    /// CPU time of a chunk beside its measured runs.
    fn beside_runs(&self, chunk: usize) -> Duration {
        self.chunks[chunk].cpu.saturating_sub(self.in_runs(chunk))
    }
}

/// Traces a share on the calling thread, with the chunks and clocks of a render server.
fn trace(scene: &Scene, spec: &FrameSpec, task: &Task) -> TracedShare {
    let share = task.share(spec.size).expect("the scheduler makes works that fit their frame");
    let (n_per_chunk, n_per_cost) = chunk_units(&share, 1, spec.samples.count);
    let mut traced = TracedShare { costs: RunCosts { run_units: n_per_cost, ..RunCosts::default() }, chunks: vec![] };
    for first_unit in (0..share.count()).step_by(n_per_chunk as usize) {
        let started_at = ThreadTime::now();
        let mut measured_until = started_at;
        let end = (first_unit + n_per_chunk).min(share.count());
        let mut rgb = Vec::new();
        for first in (first_unit..end).step_by(n_per_cost as usize) {
            scene.render(spec, &share, first..(first + n_per_cost).min(end), &mut rgb);
            if share.is_on_curve() {
                let now = ThreadTime::now();
                let cpu_ns = now.duration_since(measured_until).as_nanos();
                traced.costs.cpu_ns.push(u32::try_from(cpu_ns).unwrap_or(u32::MAX));
                measured_until = now;
            }
        }
        let n_units = end - first_unit;
        let (frame, task_id) = (FrameId(0), TaskId(0));
        let mut message = Vec::with_capacity(HEADER_BYTES + CHUNK_HEADER_BYTES + rgb.len());
        Chunk { frame, task_id, first_unit, n_units, rgb: &rgb }.encode(Encoding::Raw, &mut message);
        let (n_bytes, cpu) = (message.len() as u64, started_at.elapsed());
        traced.chunks.push(TracedChunk { first_unit, n_units, n_bytes, cpu });
    }
    traced
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_traced_until_none_becomes_faster() {
        let n_passes = |gains: &mut dyn Iterator<Item = f64>| {
            let mut passes = Passes::default();
            while !passes.are_enough() {
                passes.add(gains.next().unwrap());
            }
            passes.n_done
        };
        assert_eq!(n_passes(&mut std::iter::repeat(0.001)), 4);
        assert_eq!(n_passes(&mut std::iter::repeat(0.3)), 16);
        let gains = [0.0, 0.2, 0.05, 0.0, 0.1, 0.0, 0.002];
        assert_eq!(n_passes(&mut gains.into_iter().chain(std::iter::repeat(0.5))), 7);
    }

    #[test]
    fn the_fastest_time_of_each_part_counts() {
        let share = |chunk_ns: [u64; 2], cpu_ns: &[u32]| TracedShare {
            chunks: [(0, 4), (4, 2)]
                .into_iter()
                .zip(chunk_ns)
                .map(|((first_unit, n_units), ns)| {
                    let cpu = Duration::from_nanos(ns);
                    TracedChunk { first_unit, n_units, n_bytes: 1, cpu }
                })
                .collect(),
            costs: RunCosts { run_units: 2, cpu_ns: cpu_ns.to_vec() },
        };
        // 30 and 60 in runs, 10 and 5 beside them; then 50 and 20, 3 and 9.
        let fastest = share([40, 65], &[10, 20, 60]).fastest(&share([53, 29], &[15, 35, 20]));
        assert_eq!(fastest, share([33, 25], &[10, 20, 20]));
        // Without measured runs, the faster time of each chunk.
        assert_eq!(share([40, 65], &[]).fastest(&share([53, 29], &[])), share([40, 29], &[]));
    }
}
