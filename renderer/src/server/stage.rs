//! The scene that a render server has at hand: one at a time, loaded and built on a thread of its own.

use std::{
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError, mpsc},
};

use anyhow::Context;
use rayon::ThreadPool;
use shared::{protocol::SceneState, scene::SceneId, structure::Structure};
use tokio::sync::watch;

use crate::{
    cli::{path_bytes, progress::Progress},
    model::scene::{self, SceneSource},
    render::tracer::{Scene, SceneOptions},
    server::canned::Canned,
};

/// What the stage is asked to show, and where it may be found.
#[derive(Clone, Debug, PartialEq)]
struct Order {
    scene: SceneId,
    path: Option<PathBuf>,
    structure: Option<Structure>,
}

/// The scene at hand, if any; shared by those who load and those who trace.
#[derive(Clone, Default)]
struct AtHand(Arc<Mutex<Option<Named>>>);

/// A scene and its identity.
type Named = (SceneId, Arc<Scene>);

impl AtHand {
    fn get(&self, id: SceneId) -> Option<Arc<Scene>> {
        let at_hand = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        at_hand.as_ref().filter(|(at_hand, _)| *at_hand == id).map(|(_, scene)| Arc::clone(scene))
    }

    fn set(&self, scene: Option<Named>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = scene;
    }
}

/// How far the stage is with the scene last asked for.
pub(crate) type Progressed = Option<(SceneId, SceneState)>;

/// What frames show.
#[derive(Clone)]
pub(crate) enum Subject {
    /// A scene, traced.
    Scene(Arc<Scene>),
    /// A picture, whatever scene the wall asks for.
    Canned(Arc<Canned>),
}

/// A render server's scene and the thread that loads it; or a picture in place of all scenes.
pub(crate) struct Stage {
    pool: Arc<ThreadPool>,
    canned: Option<Arc<Canned>>,
    at_hand: AtHand,
    orders: mpsc::Sender<Order>,
    progress: watch::Sender<Progressed>,
}

impl Stage {
    /// Starts the loading thread; it begins with `model`, if one is given, before any wall asks.
    ///
    /// `trusts_paths`: whether files that the wall names are read.
    pub(crate) fn start(
        pool: Arc<ThreadPool>,
        model: Option<PathBuf>,
        options: SceneOptions,
        trusts_paths: bool,
    ) -> anyhow::Result<Self> {
        let (orders, inbox) = mpsc::channel();
        let (progress, _) = watch::channel(None);
        let at_hand = AtHand::default();
        let loader = Loader {
            pool: Arc::clone(&pool),
            at_hand: at_hand.clone(),
            model,
            options,
            structure: None,
            trusts_paths,
            progress: progress.clone(),
        };
        std::thread::Builder::new()
            .name("load".to_owned())
            .spawn(move || loader.run(&inbox))
            .context("the loading thread does not start")?;
        Ok(Self { pool, canned: None, at_hand, orders, progress })
    }

    /// A stage that shows this picture, whatever it is asked for; nothing is loaded.
    pub(crate) fn canned(pool: Arc<ThreadPool>, canned: Canned) -> Self {
        let (orders, _) = mpsc::channel();
        let (progress, _) = watch::channel(None);
        Self { pool, canned: Some(Arc::new(canned)), at_hand: AtHand::default(), orders, progress }
    }

    /// The threads that trace.
    pub(crate) fn pool(&self) -> &Arc<ThreadPool> {
        &self.pool
    }

    /// What frames of a scene show, if it is the one at hand.
    pub(crate) fn subject(&self, id: SceneId) -> Option<Subject> {
        match &self.canned {
            Some(canned) => Some(Subject::Canned(Arc::clone(canned))),
            None => self.at_hand.get(id).map(Subject::Scene),
        }
    }

    /// Gets another scene ready, or the same in another structure.
    pub(crate) fn order(&self, scene: SceneId, path: Option<Vec<u8>>, structure: Option<Structure>) {
        if let Some(canned) = &self.canned {
            let state = SceneState::Ready { triangles: 0, bytes: canned.n_bytes() as u64, grid: None };
            self.progress.send_replace(Some((scene, state)));
            return;
        }
        // The loading thread ends only with the stage.
        let _ = self.orders.send(Order { scene, path: path.map(path_bytes::from_bytes), structure });
    }

    /// Follows the loading.
    pub(crate) fn progressed(&self) -> watch::Receiver<Progressed> {
        self.progress.subscribe()
    }
}

struct Loader {
    pool: Arc<ThreadPool>,
    at_hand: AtHand,
    model: Option<PathBuf>,
    /// As the server was started.
    options: SceneOptions,
    /// The structure of the scene at hand, if a wall had a say in it.
    structure: Option<Structure>,
    trusts_paths: bool,
    progress: watch::Sender<Progressed>,
}

impl Loader {
    fn run(mut self, orders: &mpsc::Receiver<Order>) {
        if let Some(model) = self.model.clone()
            && let Err(reason) = self.load(None, &SceneSource::Ply(model))
        {
            // Not the end: a wall may want a scene that needs no file.
            tracing::error!("{reason}");
        }
        while let Ok(mut order) = orders.recv() {
            // Only the last of several counts.
            while let Ok(later) = orders.try_recv() {
                order = later;
            }
            let state = match self.fulfil(&order) {
                Ok(scene) => SceneState::Ready {
                    triangles: scene.n_triangles() as u64,
                    bytes: scene.n_bytes() as u64,
                    grid: scene.grid().structure(),
                },
                Err(reason) => SceneState::Missing { reason },
            };
            self.progress.send_replace(Some((order.scene, state)));
        }
    }

    /// Gets a scene ready, from wherever it can be had. The error says why not, and what to do.
    fn fulfil(&mut self, order: &Order) -> Result<Arc<Scene>, String> {
        if let Some(scene) = self.at_hand.get(order.scene).filter(|_| self.structure == order.structure) {
            return Ok(scene);
        }
        self.structure = order.structure;
        let sources = match order.scene {
            SceneId::Statue { triangles } => vec![SceneSource::Statue { triangles }],
            SceneId::Mesh { .. } => {
                let named = order.path.iter().filter(|_| self.trusts_paths);
                named.chain(&self.model).cloned().map(SceneSource::Ply).collect()
            }
        };
        let mut reason = format!("it has no {}: start it with --model FILE, the file that the wall shows", order.scene);
        for source in sources {
            match self.load(Some(order.scene), &source) {
                Ok((id, scene)) if id == order.scene => return Ok(scene),
                Ok((id, _)) => {
                    reason = format!("{source} is {id}, the wall shows {}: give it the wall's own file", order.scene);
                }
                Err(error) => reason = error,
            }
        }
        Err(reason)
    }

    /// Loads and builds; what was at hand before goes first, so that two scenes never lie in memory together.
    fn load(&self, ordered: Option<SceneId>, source: &SceneSource) -> Result<(SceneId, Arc<Scene>), String> {
        let tell = |progress: f32| {
            if let Some(scene) = ordered {
                self.tell(scene, progress);
            }
        };
        self.at_hand.set(None);
        tracing::info!("loading {source}");
        let bar = Progress::new(format!("loading {source}"));
        let (id, scene) = self.pool.install(|| -> Result<_, String> {
            let loaded = scene::load(source, &|fraction| {
                bar.set(fraction * 0.5);
                tell(fraction * 0.5);
            })
            .map_err(|error| error.to_string())?;
            let scene = Scene::build(loaded.mesh, &self.wanted_options(), &|fraction| {
                bar.set(0.5 + fraction * 0.5);
                tell(0.5 + fraction * 0.5);
            });
            Ok((loaded.id, Arc::new(scene)))
        })?;
        tracing::info!("{source} is ready: {} triangles in {} MB", scene.n_triangles(), scene.n_bytes() / 1_000_000);
        if let Some(shortage) = scene.grid().shortage() {
            tracing::warn!("{source}: {shortage}");
        }
        self.at_hand.set(Some((id, Arc::clone(&scene))));
        Ok((id, scene))
    }

    /// How the scene is to be kept: as the server was started, but for what a wall has said.
    fn wanted_options(&self) -> SceneOptions {
        let mut options = self.options;
        if let Some(Structure { storage, density }) = self.structure {
            (options.grid.storage, options.grid.density) = (storage, Some(density));
        }
        options
    }

    /// Reports progress in steps of one per cent, so that the network is not kept busy with it.
    fn tell(&self, scene: SceneId, progress: f32) {
        self.progress.send_if_modified(|last| {
            let is_step = !matches!(last, Some((of, SceneState::Loading { progress: told }))
                if *of == scene && (progress - *told).abs() < 0.01);
            if is_step {
                *last = Some((scene, SceneState::Loading { progress }));
            }
            is_step
        });
    }
}
