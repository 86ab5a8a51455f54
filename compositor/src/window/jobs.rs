//! File operations, one after the other on a thread of their own.

use std::{
    sync::mpsc,
    thread::{self, JoinHandle},
};

use super::waker::Waker;

/// A note or a problem for the operator.
pub(super) type Outcome = Result<Option<String>, String>;
/// A file operation.
pub(super) type Job = Box<dyn FnOnce() -> Outcome + Send>;

/// Runs jobs in order; dropping it waits for the last one.
pub(super) struct Jobs {
    waker: Waker,
    worker: Option<(mpsc::Sender<Job>, JoinHandle<()>)>,
    outcomes: (mpsc::Sender<Outcome>, mpsc::Receiver<Outcome>),
}

impl Jobs {
    pub(super) fn new(waker: Waker) -> Self {
        Self { waker, worker: None, outcomes: mpsc::channel() }
    }

    /// Runs a job after those before it; [`Jobs::poll`] returns its outcome.
    pub(super) fn add(&mut self, job: Job) {
        if self.worker.is_none() {
            match self.start() {
                Ok(worker) => self.worker = Some(worker),
                Err(error) => return tracing::error!("cannot start a thread for files: {error}"),
            }
        }
        if let Some((jobs, _)) = &self.worker {
            // The thread runs until this sender is dropped.
            let _ = jobs.send(job);
        }
    }

    /// The outcome of a job that has ended.
    pub(super) fn poll(&self) -> Option<Outcome> {
        self.outcomes.1.try_recv().ok()
    }

    fn start(&self) -> std::io::Result<(mpsc::Sender<Job>, JoinHandle<()>)> {
        let (sender, jobs) = mpsc::channel::<Job>();
        let (waker, outcomes) = (self.waker.clone(), self.outcomes.0.clone());
        let task = move || {
            for job in jobs {
                // The receiver is gone once the window is closed.
                let _ = outcomes.send(job());
                waker.wake();
            }
        };
        Ok((sender, thread::Builder::new().name("files".to_owned()).spawn(task)?))
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
