//! Renders the tasks that a wall asks for: one at a time, each on all tracing threads, and sends samples as they are done.

use std::{
    collections::VecDeque,
    ops::Range,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use cpu_time::ThreadTime;
use rayon::ThreadPool;
use shared::{
    codec::{self, CHUNK_HEADER_BYTES, HEADER_BYTES},
    division::{Share, Task},
    protocol::{CHUNK_BYTES, Chunk, Encoding, FrameId, FrameSpec, RunCosts, TaskId, TaskTimings, ToWall},
};
use tokio::sync::mpsc;

use crate::{
    render::{parallel::work_off, scene::Scene},
    server::{scene_loader::RenderSource, synthetic::SyntheticPicture},
};

/// Chunks of a share for each thread: enough that the threads finish together.
const CHUNKS_PER_THREAD: u32 = 8;

/// Minimum samples in a chunk: below it, sending costs more than tracing.
const SMALLEST_CHUNK_SAMPLES: u32 = 512;

/// Maximum primary rays in a chunk, unless one unit has more: a cancelled task ends when its current chunks are done, about
/// ten milliseconds later.
const MOST_RAYS_PER_CHUNK: u32 = 1 << 16;

/// An encoded message on its way to the wall.
#[derive(Debug)]
pub(crate) struct Outgoing {
    pub(crate) bytes: Vec<u8>,
    /// Set when the wall no longer wants the message.
    pub(crate) cancelled: Arc<AtomicBool>,
}

/// A task with the scene to render, or the picture to send.
pub(crate) struct Job {
    pub(crate) frame: FrameId,
    pub(crate) task_id: TaskId,
    pub(crate) spec: FrameSpec,
    pub(crate) task: Task,
    pub(crate) encoding: Encoding,
    pub(crate) source: RenderSource,
    /// Set when the wall no longer wants the samples.
    pub(crate) cancelled: Arc<AtomicBool>,
    pub(crate) received_at: Instant,
}

/// Most jobs that may wait: a wall hands out a few, and cancels them when it wants others.
const MOST_WAITING: usize = 256;

/// The wall asks for too much.
#[derive(Debug, thiserror::Error)]
#[error("the wall asks for more than {MOST_WAITING} tasks at once")]
pub(crate) struct TooManyTasks;

/// Jobs that wait for the worker.
pub(crate) struct JobQueue {
    /// `None` once the session is over.
    waiting: Mutex<Option<VecDeque<Job>>>,
    changed: Condvar,
}

impl JobQueue {
    pub(crate) fn new() -> Self {
        Self { waiting: Mutex::new(Some(VecDeque::new())), changed: Condvar::new() }
    }

    fn lock(&self) -> MutexGuard<'_, Option<VecDeque<Job>>> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn push(&self, job: Job) -> Result<(), TooManyTasks> {
        if let Some(waiting) = &mut *self.lock() {
            if waiting.len() >= MOST_WAITING {
                return Err(TooManyTasks);
            }
            waiting.push_back(job);
        }
        self.changed.notify_one();
        Ok(())
    }

    /// Drops the jobs that were cancelled while they waited.
    pub(crate) fn drop_cancelled(&self) {
        if let Some(waiting) = &mut *self.lock() {
            waiting.retain(|job| !job.cancelled.load(Relaxed));
        }
    }

    /// Drops all jobs, and ends the worker.
    pub(crate) fn close(&self) {
        *self.lock() = None;
        self.changed.notify_one();
    }

    /// Waits for a job; `None` if the queue is closed.
    fn pop(&self) -> Option<Job> {
        let is_empty = |waiting: &mut Option<VecDeque<Job>>| waiting.as_ref().is_some_and(VecDeque::is_empty);
        let mut waiting = self.changed.wait_while(self.lock(), is_empty).unwrap_or_else(PoisonError::into_inner);
        waiting.as_mut()?.pop_front()
    }
}

/// Runs jobs in order until their queue is closed.
pub(crate) fn run(jobs: &JobQueue, pool: &ThreadPool, outbox: &mpsc::Sender<Outgoing>) {
    while let Some(job) = jobs.pop() {
        let share = match job.task.share(job.spec.size) {
            Ok(share) => share,
            Err(error) => {
                tracing::warn!("the wall asks for an impossible task: {error}");
                continue;
            }
        };
        let mut last_message = Vec::new();
        let (timings, costs) = match &job.source {
            RenderSource::Scene(scene) => pool.install(|| job.render(scene, &share, outbox)),
            RenderSource::SyntheticPicture(synthetic) => {
                job.send_synthetic(synthetic, &share, outbox, &mut last_message)
            }
        };
        if !job.cancelled.load(Relaxed) {
            let done = ToWall::TaskDone { frame: job.frame, task_id: job.task_id, timings, costs };
            codec::encode(&done, &mut last_message).expect("timings and costs are short");
            // Without a writer the session is over, and so are its jobs.
            let _ = outbox.blocking_send(Outgoing { bytes: last_message, cancelled: job.cancelled });
        }
    }
}

impl Job {
    fn render(&self, scene: &Scene, share: &Share, outbox: &mpsc::Sender<Outgoing>) -> (TaskTimings, RunCosts) {
        let started_at = Instant::now();
        let (cpu_us, send_us) = (AtomicU64::new(0), AtomicU64::new(0));
        let (units_per_chunk, units_per_run) =
            chunk_units(share, rayon::current_num_threads() as u32, self.spec.samples.count);
        let n_chunks = share.count().div_ceil(units_per_chunk);
        // Renders and sends one chunk, and measures each run of its units; off the curve, the chunk is one.
        let render = |chunk_idx: u32| {
            let mut costs = Vec::new();
            if self.cancelled.load(Relaxed) {
                return costs;
            }
            let cpu_started = ThreadTime::now();
            let first = chunk_idx * units_per_chunk;
            let units = first..(first + units_per_chunk).min(share.count());
            let mut rgb = Vec::new();
            let mut last_measured_at = cpu_started;
            for first in units.clone().step_by(units_per_run as usize) {
                let measured = first..(first + units_per_run).min(units.end);
                scene.render_unless(&self.cancelled, &self.spec, share, measured, &mut rgb);
                let now = ThreadTime::now();
                let cpu = now.duration_since(last_measured_at);
                costs.push(u32::try_from(cpu.as_nanos()).unwrap_or(u32::MAX));
                last_measured_at = now;
            }
            if self.cancelled.load(Relaxed) {
                return costs;
            }
            let message = self.chunk(units, &rgb);
            cpu_us.fetch_add(cpu_started.elapsed().as_micros() as u64, Relaxed);
            let send_started_at = Instant::now();
            self.send(message, outbox);
            send_us.fetch_add(send_started_at.elapsed().as_micros() as u64, Relaxed);
            costs
        };
        let of_threads = work_off(0..n_chunks, |next| {
            std::iter::from_fn(next).map(|chunk_idx| (chunk_idx, render(chunk_idx))).collect::<Vec<_>>()
        });
        let mut costs: Vec<_> = of_threads.into_iter().flat_map(|(costs, _)| costs).collect();
        costs.sort_unstable_by_key(|&(chunk_idx, _)| chunk_idx);
        let cpu_ns = costs.into_iter().flat_map(|(_, costs)| costs).collect();
        let timings = TaskTimings {
            queued_us: microseconds(started_at - self.received_at),
            trace_us: microseconds(started_at.elapsed()),
            trace_cpu_us: u32::try_from(cpu_us.into_inner()).unwrap_or(u32::MAX),
            send_us: u32::try_from(send_us.into_inner()).unwrap_or(u32::MAX),
        };
        let n_runs = share.count().div_ceil(units_per_run);
        // Only samples of thousands of rays have chunks so small.
        let fit = n_runs <= RunCosts::MOST_RUNS;
        (timings, if fit { RunCosts { run_units: units_per_run, cpu_ns } } else { RunCosts::default() })
    }

    /// Sends a picture's samples. Leaves the last chunk in `last_message`: sending it with `TaskDone` saves a wake-up.
    fn send_synthetic(
        &self,
        synthetic: &SyntheticPicture,
        share: &Share,
        outbox: &mpsc::Sender<Outgoing>,
        last_message: &mut Vec<u8>,
    ) -> (TaskTimings, RunCosts) {
        let started_at = Instant::now();
        for chunk in &*synthetic.chunks(&self.task, share) {
            if self.cancelled.load(Relaxed) {
                break;
            }
            if !last_message.is_empty() {
                self.send(std::mem::take(last_message), outbox);
            }
            *last_message = self.chunk(chunk.units.clone(), &chunk.rgb);
        }
        let queued_us = microseconds(started_at - self.received_at);
        (TaskTimings { queued_us, ..TaskTimings::default() }, RunCosts::default())
    }

    fn chunk(&self, units: Range<u32>, rgb: &[u8]) -> Vec<u8> {
        let Self { frame, task_id, .. } = *self;
        let chunk = Chunk { frame, task_id, first_unit: units.start, n_units: units.len() as u32, rgb };
        let mut message = Vec::with_capacity(HEADER_BYTES + CHUNK_HEADER_BYTES + rgb.len());
        chunk.encode(self.encoding, &mut message);
        message
    }

    fn send(&self, bytes: Vec<u8>, outbox: &mpsc::Sender<Outgoing>) {
        // Without a writer the session is over.
        if outbox.blocking_send(Outgoing { bytes, cancelled: Arc::clone(&self.cancelled) }).is_err() {
            self.cancelled.store(true, Relaxed);
        }
    }
}

/// Units in a chunk of a share, and units that are measured together; each sample takes `n_rays` primary rays.
pub fn chunk_units(share: &Share, n_threads: u32, n_rays: u32) -> (u32, u32) {
    let largest_unit = share.units().samples_per_full_unit();
    let most_bytes = CHUNK_BYTES as u32 / (3 * largest_unit);
    let most_rays = MOST_RAYS_PER_CHUNK / n_rays.max(1) / largest_unit;
    let units_per_run = if share.is_on_curve() { RunCosts::run_units(share).min(most_bytes) } else { 1 };
    let most = most_bytes.min(most_rays.max(units_per_run));
    let fewest = (SMALLEST_CHUNK_SAMPLES / largest_unit).clamp(1, most);
    let units_per_chunk = share.count().div_ceil(n_threads * CHUNKS_PER_THREAD).clamp(fewest, most);
    if !share.is_on_curve() {
        return (units_per_chunk, units_per_chunk);
    }
    // A chunk holds a whole number of measured runs, so that all runs of the share have the same length.
    (units_per_chunk.next_multiple_of(units_per_run).min(most / units_per_run * units_per_run), units_per_run)
}

fn microseconds(duration: Duration) -> u32 {
    u32::try_from(duration.as_micros()).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{
        appearance::Appearance,
        camera::Camera,
        detail::Detail,
        division::{Division, FrameSize},
        protocol::{LightingMode, SampleRange, ShadingMode},
        scene::{SceneId, Treatment},
    };
    use strum::VariantArray;

    use super::*;
    use crate::{grid::GridOptions, model::statue};

    #[test]
    fn costs_are_measured_in_every_division() {
        let scene = Arc::new(Scene::build(statue::generate(2000, &|_| ()), &GridOptions::default(), &|_| ()));
        let size = FrameSize::new(256, 128).unwrap();
        let camera = Camera::look_at(DVec3::splat(3.0), DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap();
        for &division in Division::VARIANTS {
            let task = division.task(1, 2);
            let share = task.share(size).unwrap();
            let job = Job {
                frame: FrameId(1),
                task_id: TaskId(1),
                spec: FrameSpec {
                    scene: SceneId::Statue { triangles: 2000, treatment: Treatment::FLAT },
                    camera,
                    size,
                    view: ShadingMode::Shaded,
                    rays: LightingMode::Primary,
                    samples: SampleRange::CENTRE,
                    detail: Detail::FULL,
                    appearance: Appearance::default(),
                },
                task,
                encoding: Encoding::Raw,
                source: RenderSource::Scene(Arc::clone(&scene)),
                cancelled: Arc::default(),
                received_at: Instant::now(),
            };
            let (outbox, _inbox) = mpsc::channel(1000);
            let (timings, costs) = job.render(&scene, &share, &outbox);
            assert!(costs.fits(share.count()) && costs.cpu_ns.len() > 4, "{division}: {costs:?}");
            let sum_us = costs.cpu_ns.iter().map(|&ns| u64::from(ns)).sum::<u64>() / 1000;
            assert!(sum_us > 0 && sum_us <= u64::from(timings.trace_cpu_us) + costs.cpu_ns.len() as u64, "{division}");
        }
    }

    #[test]
    fn chunks_fit_messages_and_hold_whole_runs() {
        for (xres, yres) in [(1, 1), (83, 45), (1024, 512), (4096, 2304), (16384, 16384), (65536, 4096)] {
            let size = FrameSize::new(xres, yres).unwrap();
            let farms = [(1, 1, 1), (12, 1, 16), (3, 64, 1), (1, 2, SampleRange::LARGEST_COUNT)];
            for (division, (machines, n_threads, n_rays)) in
                Division::VARIANTS.iter().copied().flat_map(|division| farms.map(|farm| (division, farm)))
            {
                let task = division.task(0, machines);
                let share = task.share(size).unwrap();
                let (units_per_chunk, units_per_run) = chunk_units(&share, n_threads, n_rays);
                assert_eq!(units_per_chunk % units_per_run, 0);
                let n_samples = units_per_chunk * share.units().samples_per_full_unit();
                assert!(units_per_chunk > 0 && n_samples as usize * 3 <= CHUNK_BYTES);
                assert!(
                    n_samples * n_rays <= MOST_RAYS_PER_CHUNK || units_per_chunk == units_per_run,
                    "{n_samples} · {n_rays}"
                );
                if share.is_on_curve() {
                    assert!(share.count().div_ceil(units_per_run) <= RunCosts::MOST_RUNS);
                }
            }
        }
    }
}
