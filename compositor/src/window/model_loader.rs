//! Loads models on a thread of their own, one at a time.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    thread,
};

use renderer::{cli::stop::Task, model::scene::SceneSource, scene_file::SceneStore};
use shared::{printable::printable_line, scene::Crease};

use super::waker::{Call, Waker};
use crate::control::{model::Model, sidecar::SidecarFiles};

/// A model with its sidecar files, or the reason why it cannot be loaded.
pub(super) type Loaded = Result<Box<(Model, SidecarFiles)>, String>;

/// Loads the model that was asked for last.
pub(super) struct ModelLoader {
    waker: Waker,
    crease: Crease,
    store: SceneStore,
    /// The name of the model that is being loaded, and the progress: the bits of an `f32`, 0 to 1.
    running: Option<(String, Arc<AtomicU32>)>,
    /// The next model; a later request replaces it.
    next: Option<SceneSource>,
    has_begun: bool,
}

impl ModelLoader {
    /// For models that are as smooth as `crease` says, with their scene files. Wakes the window on progress, and calls it with
    /// each [`Loaded`].
    pub(super) fn new(waker: Waker, crease: Crease, store: SceneStore) -> Self {
        Self { waker, crease, store, running: None, next: None, has_begun: false }
    }

    pub(super) fn load(&mut self, source: SceneSource) {
        self.next = Some(source);
        if self.running.is_none() {
            self.load_next();
        }
    }

    /// The name of the model that is being loaded, and the progress from 0 to 1.
    pub(super) fn progress(&self) -> Option<(String, f32)> {
        let (name, progress) = self.running.as_ref()?;
        Some((name.clone(), f32::from_bits(progress.load(Ordering::Relaxed))))
    }

    /// Loads the next model, if there is one; call it once the last has come.
    pub(super) fn load_next(&mut self) {
        self.running = None;
        let Some(source) = self.next.take() else { return };
        let progress = Arc::new(AtomicU32::new(0));
        self.running = Some((name_of(&source), Arc::clone(&progress)));
        let (waker, crease, store) = (self.waker.clone(), self.crease, self.store.clone());
        tracing::info!("loading {source}");
        // Without its first model the wall shows nothing; later, it goes on showing the old one.
        let task = (!std::mem::replace(&mut self.has_begun, true)).then(|| Task::named(format!("loading {source}")));
        let load = move || {
            let report = |fraction: f32| {
                let percent = |fraction: f32| (fraction * 100.0) as u32;
                let before = f32::from_bits(progress.swap(fraction.to_bits(), Ordering::Relaxed));
                if percent(before) != percent(fraction) {
                    waker.wake();
                }
            };
            let load = || {
                let sidecars = SidecarFiles::read(&source);
                let model = Model::load(source, crease, &store, &report).map_err(|error| error.to_string())?;
                Ok(Box::new((model, sidecars)))
            };
            // Nothing that a panic leaves half done is used again.
            let loaded = catch_unwind(AssertUnwindSafe(load)).unwrap_or_else(|_panic| {
                Err("loading the model failed unexpectedly: see the log above, and try another file".to_owned())
            });
            drop(task);
            waker.call(Call::Show(loaded));
        };
        if let Err(error) = thread::Builder::new().name("model loader".to_owned()).spawn(load) {
            self.waker.call(Call::Show(Err(format!("cannot start a thread to load the model: {error}"))));
        }
    }
}

pub(super) fn name_of(source: &SceneSource) -> String {
    match source {
        SceneSource::File(path) => printable_line(&path.file_name().unwrap_or(path.as_os_str()).to_string_lossy()),
        SceneSource::Statue { .. } => "built-in statue".to_owned(),
    }
}
