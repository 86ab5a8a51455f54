//! The pool of tracing threads.

use anyhow::Context;
use rayon::{ThreadPool, ThreadPoolBuilder};

/// Starts `n_threads` threads, by default one for each core.
///
/// With one thread for each core, each is pinned to its own: after a pause, some virtual machines' kernels let two threads
/// share a core for whole frames while another core is idle.
pub fn pool(n_threads: Option<usize>) -> anyhow::Result<ThreadPool> {
    let n_threads = n_threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    let cores = core_affinity::get_core_ids().unwrap_or_default();
    ThreadPoolBuilder::new()
        .num_threads(n_threads)
        .thread_name(|index| format!("trace-{index}"))
        .start_handler(move |index| {
            if cores.len() == n_threads {
                // Failure is harmless: a system without affinity schedules as it likes.
                core_affinity::set_for_current(cores[index]);
            }
        })
        .build()
        .context("cannot start the tracing threads")
}

#[cfg(test)]
#[cfg(target_os = "linux")]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// The cores that each thread of a pool may run on.
    fn cores(pool: &ThreadPool) -> Vec<BTreeSet<usize>> {
        pool.broadcast(|_| core_affinity::get_core_ids().unwrap().iter().map(|core| core.id).collect())
    }

    #[test]
    fn each_thread_has_a_core_where_there_are_as_many() {
        let all: BTreeSet<_> = core_affinity::get_core_ids().unwrap().iter().map(|core| core.id).collect();
        let of_threads = cores(&pool(Some(all.len())).unwrap());
        assert!(of_threads.iter().all(|of_thread| of_thread.len() == 1));
        assert_eq!(of_threads.into_iter().flatten().collect::<BTreeSet<_>>(), all);

        let too_many = cores(&pool(Some(all.len() + 1)).unwrap());
        assert!(too_many.iter().all(|of_thread| *of_thread == all));
    }
}
