//! Works off the shares that a wall asks for: one at a time, each by all tracing threads, samples sent as they are done.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use cpu_time::ThreadTime;
use rayon::{ThreadPool, prelude::*};
use shared::{
    codec::{self, CHUNK_HEADER_BYTES, HEADER_BYTES},
    division::{Share, TILE_SIZE, Work},
    protocol::{CHUNK_BYTES, Chunk, FrameId, Picture, ToWall, WorkId, WorkTimings},
};
use tokio::sync::mpsc;

use crate::tracer::{FrameRequest, Scene};

/// Blocks of a share for each thread: enough that the threads end together.
const BLOCKS_PER_THREAD: u32 = 8;

/// The fewest samples in a block: below it, sending costs more than tracing.
const SMALLEST_BLOCK: u32 = 512;

/// A share of a frame to render.
pub(crate) struct Job {
    pub(crate) frame: FrameId,
    pub(crate) work_id: WorkId,
    pub(crate) picture: Picture,
    pub(crate) work: Work,
    pub(crate) scene: Arc<Scene>,
    /// Set when nobody wants the answer any more.
    pub(crate) cancelled: Arc<AtomicBool>,
    pub(crate) received_at: Instant,
}

/// Works off jobs in order until no more can come.
pub(crate) fn run(mut jobs: mpsc::UnboundedReceiver<Job>, pool: &ThreadPool, outbox: &mpsc::Sender<Vec<u8>>) {
    while let Some(job) = jobs.blocking_recv() {
        let share = match job.work.share(job.picture.size) {
            Ok(share) => share,
            Err(error) => {
                tracing::warn!("the wall asks for a share that does not exist: {error}");
                continue;
            }
        };
        let timings = pool.install(|| job.render(&share, outbox));
        if !job.cancelled.load(Relaxed) {
            let done = ToWall::WorkDone { frame: job.frame, work_id: job.work_id, timings };
            let mut bytes = Vec::new();
            codec::encode(&done, &mut bytes).expect("timings are short");
            // Without a writer the conversation is over, and so are its jobs.
            let _ = outbox.blocking_send(bytes);
        }
    }
}

impl Job {
    fn render(&self, share: &Share<'_>, outbox: &mpsc::Sender<Vec<u8>>) -> WorkTimings {
        let started_at = Instant::now();
        let (cpu_us, send_us) = (AtomicU64::new(0), AtomicU64::new(0));
        let Picture { camera, size, view, samples, .. } = self.picture;
        let request = FrameRequest { camera, size, view, samples };
        let n_per_block = block_units(share, rayon::current_num_threads() as u32);
        let n_blocks = share.count().div_ceil(n_per_block);
        (0..n_blocks).into_par_iter().for_each(|block| {
            if self.cancelled.load(Relaxed) {
                return;
            }
            let cpu_started = ThreadTime::now();
            let first = block * n_per_block;
            let units = first..(first + n_per_block).min(share.count());
            let mut rgb = Vec::new();
            self.scene.render(&request, share, units.clone(), &mut rgb);
            let chunk = Chunk {
                frame: self.frame,
                work_id: self.work_id,
                first_unit: units.start,
                n_units: units.len() as u32,
                rgb: &rgb,
            };
            let mut message = Vec::with_capacity(HEADER_BYTES + CHUNK_HEADER_BYTES + rgb.len());
            chunk.encode(&mut message);
            cpu_us.fetch_add(cpu_started.elapsed().as_micros() as u64, Relaxed);
            let sending_since = Instant::now();
            if outbox.blocking_send(message).is_err() {
                self.cancelled.store(true, Relaxed);
            }
            send_us.fetch_add(sending_since.elapsed().as_micros() as u64, Relaxed);
        });
        WorkTimings {
            queued_us: microseconds(started_at - self.received_at),
            trace_us: microseconds(started_at.elapsed()),
            trace_cpu_us: u32::try_from(cpu_us.into_inner()).unwrap_or(u32::MAX),
            send_us: u32::try_from(send_us.into_inner()).unwrap_or(u32::MAX),
        }
    }
}

/// How many units of a share make a block, so that it fits one chunk.
fn block_units(share: &Share<'_>, n_threads: u32) -> u32 {
    let n_samples = if share.count() == 0 { 1 } else { share.samples(0).count() };
    let largest_unit = if n_samples == 1 { 1 } else { TILE_SIZE * TILE_SIZE };
    let most = CHUNK_BYTES as u32 / (3 * largest_unit);
    let fewest = (SMALLEST_BLOCK / largest_unit).max(1);
    share.count().div_ceil(n_threads * BLOCKS_PER_THREAD).clamp(fewest, most)
}

fn microseconds(duration: Duration) -> u32 {
    u32::try_from(duration.as_micros()).unwrap_or(u32::MAX)
}
