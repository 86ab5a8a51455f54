//! What takes a disk's time: done one after the other on a thread of its own, and told of in words.

use std::{
    sync::mpsc,
    thread::{self, JoinHandle},
};

use super::Waker;

/// What came of a job: what an operator should read, if anything.
pub(super) type Outcome = Result<Option<String>, String>;
type Job = Box<dyn FnOnce() -> Outcome + Send>;

/// Jobs in the order in which they were given; none is left undone when the window closes.
pub(super) struct Jobs {
    waker: Waker,
    worker: Option<(mpsc::Sender<Job>, JoinHandle<()>)>,
    outcomes: (mpsc::Sender<Outcome>, mpsc::Receiver<Outcome>),
}

impl Jobs {
    pub(super) fn new(waker: Waker) -> Self {
        Self { waker, worker: None, outcomes: mpsc::channel() }
    }

    /// Does a job as soon as those before are done; what came of it is told by [`Jobs::poll`].
    pub(super) fn add(&mut self, job: impl FnOnce() -> Outcome + Send + 'static) {
        if self.worker.is_none() {
            match self.start() {
                Ok(worker) => self.worker = Some(worker),
                Err(error) => return tracing::error!("no thread to write files on: {error}"),
            }
        }
        if let Some((jobs, _)) = &self.worker {
            // The thread ends only with this.
            let _ = jobs.send(Box::new(job));
        }
    }

    /// What came of a job, once that is known.
    pub(super) fn poll(&self) -> Option<Outcome> {
        self.outcomes.1.try_recv().ok()
    }

    fn start(&self) -> std::io::Result<(mpsc::Sender<Job>, JoinHandle<()>)> {
        let (sender, jobs) = mpsc::channel::<Job>();
        let (waker, outcomes) = (self.waker.clone(), self.outcomes.0.clone());
        let task = move || {
            for job in jobs {
                // Nobody waits for it once the window is closed.
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
            // A panic has been told of by then.
            let _ = thread.join();
        }
    }
}
