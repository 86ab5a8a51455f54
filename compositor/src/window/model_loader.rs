//! Loads models on a thread of their own, one at a time.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
        mpsc,
    },
    thread,
};

use renderer::model::scene::SceneSource;

use super::waker::Waker;
use crate::control::{model::Model, sidecar::SidecarFiles};

/// Loads the model that was asked for last.
pub(super) struct ModelLoader {
    waker: Waker,
    running: Option<Loading>,
    /// The next model; a later request replaces it.
    next: Option<SceneSource>,
}

struct Loading {
    name: String,
    /// The bits of an `f32`, 0 to 1.
    progress: Arc<AtomicU32>,
    outcome: mpsc::Receiver<Result<(Model, SidecarFiles), String>>,
}

impl ModelLoader {
    /// Wakes the window on progress, and when [`ModelLoader::poll`] has an outcome.
    pub(super) fn new(waker: Waker) -> Self {
        Self { waker, running: None, next: None }
    }

    /// Loads a model, after the one that is being loaded.
    pub(super) fn load(&mut self, source: SceneSource) {
        self.next = Some(source);
        self.start_next();
    }

    /// The name of the model that is being loaded, and the progress from 0 to 1.
    pub(super) fn progress(&self) -> Option<(String, f32)> {
        let loading = self.running.as_ref()?;
        Some((loading.name.clone(), f32::from_bits(loading.progress.load(Ordering::Relaxed))))
    }

    /// A loaded model with its sidecar files, or the reason why it cannot be loaded.
    pub(super) fn poll(&mut self) -> Option<Result<(Model, SidecarFiles), String>> {
        let outcome = match self.running.as_ref()?.outcome.try_recv() {
            Ok(outcome) => outcome,
            Err(mpsc::TryRecvError::Empty) => return None,
            Err(mpsc::TryRecvError::Disconnected) => {
                Err("loading the model failed unexpectedly: see the log above, and try another file".to_owned())
            }
        };
        self.running = None;
        self.start_next();
        Some(outcome)
    }

    fn start_next(&mut self) {
        if self.running.is_some() {
            return;
        }
        let Some(source) = self.next.take() else { return };
        let (sender, outcome) = mpsc::channel();
        let progress = Arc::new(AtomicU32::new(0));
        self.running = Some(Loading { name: name_of(&source), progress: Arc::clone(&progress), outcome });
        let waker = self.waker.clone();
        let load = move || {
            let report = |fraction: f32| {
                let percent = |fraction: f32| (fraction * 100.0) as u32;
                let before = f32::from_bits(progress.swap(fraction.to_bits(), Ordering::Relaxed));
                if percent(before) != percent(fraction) {
                    waker.wake();
                }
            };
            let sidecars = SidecarFiles::read(&source);
            let model = Model::load(source, &report).map(|model| (model, sidecars)).map_err(|error| error.to_string());
            // The receiver is gone once the window is closed.
            let _ = sender.send(model);
        };
        let waker = self.waker.clone();
        let spawned = thread::Builder::new().name("model loader".to_owned()).spawn(move || {
            // Wakes the window even if a panic drops the sender.
            let _wake = WakeOnDrop(waker);
            load();
        });
        if let Err(error) = spawned {
            tracing::error!("cannot start a thread to load the model: {error}");
        }
    }
}

struct WakeOnDrop(Waker);

impl Drop for WakeOnDrop {
    fn drop(&mut self) {
        self.0.wake();
    }
}

/// The name of a model on screen.
pub(super) fn name_of(source: &SceneSource) -> String {
    match source {
        SceneSource::Ply(path) => path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
        SceneSource::Statue { .. } => "built-in statue".to_owned(),
    }
}
