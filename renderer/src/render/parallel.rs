//! Divides work among the tracing threads, for render servers, `trace` and measurements.

use std::{
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use cpu_time::ThreadTime;

/// How long a thread without parts spins before it sleeps: waking it for the next frame cost up to 0.4 % of a frame.
const AWAKE: Duration = Duration::from_millis(1);

/// Processes `parts` on the current rayon pool: calls `task` once per thread, with a function that returns the next part
/// until none is left.
///
/// Returns each call's result and CPU time. A thread that another program keeps from its core delays nothing: the other
/// threads take its parts, and its call too.
pub fn work_off<P: Send, T: Send>(
    parts: impl Iterator<Item = P> + Send,
    task: impl Fn(&mut dyn FnMut() -> Option<P>) -> T + Sync,
) -> Vec<(T, Duration)> {
    let parts = Mutex::new(parts);
    let n_at_work = AtomicUsize::new(0);
    let task = || {
        n_at_work.fetch_add(1, Ordering::Relaxed);
        let start = ThreadTime::now();
        let result = task(&mut || parts.lock().ok()?.next());
        // Spinning does not count as CPU time.
        let cpu = start.elapsed();
        n_at_work.fetch_sub(1, Ordering::Relaxed);
        let done = Instant::now();
        while n_at_work.load(Ordering::Relaxed) > 0 && done.elapsed() < AWAKE {
            // With more threads than cores, another thread may need this core.
            thread::yield_now();
        }
        (result, cpu)
    };
    let mut results: Vec<_> = (0..rayon::current_num_threads()).map(|_| None).collect();
    rayon::scope(|scope| {
        for result in &mut results {
            scope.spawn(|_| *result = Some(task()));
        }
    });
    results.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::threads;

    #[test]
    fn every_part_is_taken_once() {
        for n_threads in [1, 2, 16] {
            let pool = threads::pool(Some(n_threads)).unwrap();
            let taken = pool.install(|| work_off(0..1000, |next| std::iter::from_fn(next).collect::<Vec<_>>()));
            assert_eq!(taken.len(), n_threads);
            let mut taken: Vec<_> = taken.into_iter().flat_map(|(taken, _)| taken).collect();
            taken.sort_unstable();
            assert!(taken.into_iter().eq(0..1000), "{n_threads} threads");
        }
    }
}
