//! File operations, one after the other on a thread of their own.

use std::{
    io,
    sync::mpsc,
    thread::{self, JoinHandle},
};

use super::{
    effect::Job,
    waker::{Call, Waker},
};

/// Runs jobs in order; dropping it waits for the last one.
pub(super) struct Jobs {
    waker: Waker,
    worker: Option<(mpsc::Sender<Job>, JoinHandle<()>)>,
}

impl Jobs {
    pub(super) fn new(waker: Waker) -> Self {
        Self { waker, worker: None }
    }

    /// Runs a job after those before it; its effect comes as a [`Call`].
    pub(super) fn add(&mut self, job: Job) {
        let worker = self.worker.take().map_or_else(|| self.start(), Ok);
        match worker {
            Ok(worker) => {
                // The thread runs until this sender is dropped.
                let _ = worker.0.send(job);
                self.worker = Some(worker);
            }
            Err(error) => tracing::error!("cannot start a thread for files: {error}"),
        }
    }

    fn start(&self) -> io::Result<(mpsc::Sender<Job>, JoinHandle<()>)> {
        let (sender, jobs) = mpsc::channel::<Job>();
        let waker = self.waker.clone();
        let run = move || jobs.into_iter().for_each(|job| waker.call(Call::Apply(job())));
        Ok((sender, thread::Builder::new().name("files".to_owned()).spawn(run)?))
    }
}

impl Drop for Jobs {
    fn drop(&mut self) {
        if let Some((jobs, thread)) = self.worker.take() {
            drop(jobs);
            // The panic hook has reported a panic already.
            let _ = thread.join();
        }
    }
}
