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
use shared::{printable::printable_line, scene::Treatment};

use super::waker::{Call, Waker};
use crate::control::{
    model::Model,
    show::{Cue, ShowScene},
    sidecar::SidecarFiles,
};

/// A model with its sidecar files, or the reason why it cannot be loaded.
pub(super) type Loaded = Result<Box<(Model, SidecarFiles)>, String>;

/// A scene of a show, or the reason why it cannot be shown.
pub(super) type Prepared = Result<Box<Cue>, String>;

/// What is to be loaded.
enum Wanted {
    Model(SceneSource),
    /// A scene of a show by its number; without a model of its own, of this one.
    Scene(usize, Box<ShowScene>, SceneSource),
}

impl Wanted {
    fn source(&self) -> SceneSource {
        match self {
            Self::Model(source) => source.clone(),
            Self::Scene(_, scene, default) => scene.model.clone().map_or(default.clone(), SceneSource::File),
        }
    }
}

/// Loads the model, or the scene of a show, that was asked for last.
pub(super) struct ModelLoader {
    waker: Waker,
    treatment: Treatment,
    store: SceneStore,
    /// The name of the model that is being loaded, and the progress: the bits of an `f32`, 0 to 1.
    running: Option<(String, Arc<AtomicU32>)>,
    /// Whether that is a scene of a show.
    is_preparing: bool,
    /// The next model; a later request replaces it.
    next: Option<Wanted>,
    has_begun: bool,
}

impl ModelLoader {
    /// For models with this treatment, with their scene files. Wakes the window on progress, and calls it with
    /// each [`Loaded`].
    pub(super) fn new(waker: Waker, treatment: Treatment, store: SceneStore) -> Self {
        Self { waker, treatment, store, running: None, is_preparing: false, next: None, has_begun: false }
    }

    pub(super) fn load(&mut self, source: SceneSource) {
        self.put(Wanted::Model(source));
    }

    /// Loads a scene of a show; the answer is a [`Call::Prepared`] with its number.
    pub(super) fn prepare(&mut self, index: usize, scene: ShowScene, default: SceneSource) {
        self.put(Wanted::Scene(index, Box::new(scene), default));
    }

    fn put(&mut self, wanted: Wanted) {
        self.next = Some(wanted);
        if self.running.is_none() {
            self.load_next();
        }
    }

    /// The name of the model that is being loaded, and the progress from 0 to 1.
    pub(super) fn progress(&self) -> Option<(String, f32)> {
        let (name, progress) = self.running.as_ref()?;
        Some((name.clone(), f32::from_bits(progress.load(Ordering::Relaxed))))
    }

    /// Whether it is a scene of a show that is loaded.
    pub(super) fn is_preparing(&self) -> bool {
        self.is_preparing
    }

    /// Loads the next model, if there is one; call it once the last has come.
    pub(super) fn load_next(&mut self) {
        self.running = None;
        let Some(wanted) = self.next.take() else { return };
        let source = wanted.source();
        self.is_preparing = matches!(wanted, Wanted::Scene(..));
        let progress = Arc::new(AtomicU32::new(0));
        self.running = Some((name_of(&source), Arc::clone(&progress)));
        let (waker, treatment, store) = (self.waker.clone(), self.treatment, self.store.clone());
        if !self.is_preparing {
            tracing::info!("loading {source}");
        }
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
            let call = match wanted {
                Wanted::Model(source) => Call::Show(caught(|| {
                    let sidecars = SidecarFiles::read(&source);
                    let model = Model::load(source, treatment, &store, &report).map_err(|error| error.to_string())?;
                    Ok(Box::new((model, sidecars)))
                })),
                Wanted::Scene(index, scene, default) => {
                    let read = || Cue::read(&scene, &default, treatment, &store, &report).map(Box::new);
                    Call::Prepared(index, caught(read))
                }
            };
            drop(task);
            waker.call(call);
        };
        if let Err(error) = thread::Builder::new().name("model loader".to_owned()).spawn(load) {
            self.waker.call(Call::Show(Err(format!("cannot start a thread to load the model: {error}"))));
        }
    }
}

/// The outcome of `load`. Nothing that a panic leaves half done is used again.
fn caught<T>(load: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(load)).unwrap_or_else(|_panic| {
        Err("loading the model failed unexpectedly: see the log above, and try another file".to_owned())
    })
}

pub(super) fn name_of(source: &SceneSource) -> String {
    match source {
        SceneSource::File(path) => printable_line(&path.file_name().unwrap_or(path.as_os_str()).to_string_lossy()),
        SceneSource::Statue { .. } => "built-in statue".to_owned(),
    }
}
