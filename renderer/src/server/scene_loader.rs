//! Loads the scene that a render server traces, and the next one ahead, on a thread of its own.

use std::{
    ops::Range,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant, SystemTime},
};

use anyhow::Context;
use rayon::ThreadPool;
use shared::{
    printable::{bytes, counted},
    protocol::{SceneState, SkyFile},
    scene::{SceneId, Treatment},
    sky::SkyId,
    structure::Structure,
};
use tokio::sync::watch;

use crate::{
    cli::{large_file::warn_of_large_file, progress::Progress},
    grid::GridOptions,
    model::scene::SceneSource,
    render::{scene::Scene, sky::SkyMap},
    scene_file::{
        SceneStore,
        cache::Cache,
        lock::Lock,
        store::{Stage, StoredScene},
    },
    server::{
        fetch::{self, Fetcher, Watch},
        load_request::{LatestRequests, LoadRequest, Request, path_from_bytes},
        synthetic::SyntheticPicture,
    },
};

/// How often a scene that is missing is looked for.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);

/// The first and the longest pause before a scene that could not be fetched is asked for again; it doubles each time.
const FETCH_PAUSES: Range<Duration> = Duration::from_secs(2)..Duration::from_secs(60);

/// About the memory of mesh and grid of a scan, to estimate that of the built-in model.
const BYTES_PER_TRIANGLE: u64 = 64;

/// Length and time of a file, if it is there.
type FileState = Option<(u64, Option<SystemTime>)>;

/// The loaded scene, if any; shared by the loading and the tracing threads.
#[derive(Clone, Default)]
struct CurrentScene(Arc<Mutex<Option<IdentifiedScene>>>);

/// A scene that was loaded before the wall shows it.
#[derive(Clone)]
struct Prepared {
    id: SceneId,
    /// The structure that the wall chose, if it did.
    structure: Option<Structure>,
    scene: Arc<Scene>,
}

impl Prepared {
    fn meets(&self, order: &LoadRequest) -> bool {
        let sky = self.scene.sky.as_ref().map(|sky| sky.id());
        (self.id, self.structure, sky) == (order.scene, order.structure, order.sky.as_ref().map(|sky| sky.id))
    }
}

/// The part of a scene's news that a render server logs: several beside a wall would tell the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Told {
    Nothing,
    /// A grid that is coarser for lack of memory: only render servers build grids.
    Shortage,
    /// Also what files hold and lack.
    Everything,
}

/// A scene with its id.
type IdentifiedScene = (SceneId, Arc<Scene>);

impl CurrentScene {
    fn get(&self, id: SceneId) -> Option<Arc<Scene>> {
        let current = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        current.as_ref().filter(|(current, _)| *current == id).map(|(_, scene)| Arc::clone(scene))
    }

    /// Bytes of mesh and grid.
    fn n_bytes(&self) -> u64 {
        let current = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        current.as_ref().map_or(0, |(_, scene)| scene.n_bytes() as u64)
    }

    fn set(&self, scene: Option<IdentifiedScene>) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = scene;
    }
}

/// The state of the scene that was last asked for.
pub(crate) type LoadProgress = Option<(SceneId, SceneState)>;

/// Where the samples of frames come from.
#[derive(Clone)]
pub(crate) enum RenderSource {
    /// Traced in a scene.
    Scene(Arc<Scene>),
    /// Read from a picture, for any scene that the wall asks for.
    SyntheticPicture(Arc<SyntheticPicture>),
}

impl RenderSource {
    /// Whether it can render pictures that name this sky image, or none.
    pub(crate) fn has_sky(&self, sky: Option<SkyId>) -> bool {
        match self {
            Self::Scene(scene) => sky.is_none() || scene.sky.as_ref().map(|sky| sky.id()) == sky,
            Self::SyntheticPicture(_) => true,
        }
    }
}

/// Handle of the loading thread and its scene; or a synthetic picture in place of all scenes.
pub(crate) struct SceneLoader {
    pool: Arc<ThreadPool>,
    synthetic: Option<Arc<SyntheticPicture>>,
    current: CurrentScene,
    requests: Arc<LatestRequests>,
    progress: watch::Sender<LoadProgress>,
}

impl SceneLoader {
    /// Starts the loading thread, which first loads `model`, if given, before any wall asks, and logs what `told` says. `sky`
    /// is the file of the wall's sky image. Models that are not here come from the `fetcher`, if there is one.
    pub(crate) fn start(
        pool: Arc<ThreadPool>,
        (model, sky): (Option<PathBuf>, Option<PathBuf>),
        options: GridOptions,
        store: SceneStore,
        told: Told,
        fetcher: Option<Fetcher>,
    ) -> anyhow::Result<Self> {
        let requests = Arc::new(LatestRequests::default());
        let (progress, _) = watch::channel(None);
        let current = CurrentScene::default();
        let loader = LoaderThread {
            pool: Arc::clone(&pool),
            current: current.clone(),
            prepared: None,
            model,
            sky,
            options,
            store,
            structure: None,
            told,
            told_of: None,
            fetcher,
            missing: None,
            fetch_pause: FETCH_PAUSES.start,
            progress: progress.clone(),
        };
        std::thread::Builder::new()
            .name("load".to_owned())
            .spawn({
                let requests = Arc::clone(&requests);
                move || loader.run(&requests)
            })
            .context("cannot start the loading thread")?;
        Ok(Self { pool, synthetic: None, current, requests, progress })
    }

    /// A loader that loads nothing, and answers every request with this picture.
    pub(crate) fn synthetic(pool: Arc<ThreadPool>, synthetic: SyntheticPicture) -> Self {
        let (requests, current) = Default::default();
        let (progress, _) = watch::channel(None);
        Self { pool, synthetic: Some(Arc::new(synthetic)), current, requests, progress }
    }

    /// The pool of tracing threads.
    pub(crate) fn pool(&self) -> &Arc<ThreadPool> {
        &self.pool
    }

    /// The source of a scene's samples, if it is the loaded scene.
    pub(crate) fn source_for(&self, id: SceneId) -> Option<RenderSource> {
        match &self.synthetic {
            Some(synthetic) => Some(RenderSource::SyntheticPicture(Arc::clone(synthetic))),
            None => self.current.get(id).map(RenderSource::Scene),
        }
    }

    /// Orders another scene, or the same in another structure.
    pub(crate) fn order(&self, request: LoadRequest) {
        if let Some(synthetic) = &self.synthetic {
            let state = SceneState::Ready { triangles: 0, bytes: synthetic.n_bytes() as u64, grid: None };
            self.progress.send_replace(Some((request.scene, state)));
            return;
        }
        self.requests.put(Request::Load(request));
    }

    /// Has a scene loaded beside the present one, if there is memory for both: an order for it is met at once then.
    pub(crate) fn prepare(&self, request: LoadRequest) {
        if self.synthetic.is_none() {
            self.requests.put(Request::Prepare(request));
        }
    }

    /// Subscribes to the loading state.
    pub(crate) fn progressed(&self) -> watch::Receiver<LoadProgress> {
        self.progress.subscribe()
    }
}

#[derive(Clone)]
struct LoaderThread {
    pool: Arc<ThreadPool>,
    current: CurrentScene,
    /// The scene that may come next.
    prepared: Option<Prepared>,
    model: Option<PathBuf>,
    sky: Option<PathBuf>,
    /// From the server's command line.
    options: GridOptions,
    store: SceneStore,
    /// The structure that the wall chose for the loaded scene, if it did.
    structure: Option<Structure>,
    told: Told,
    /// The scene of which the log tells already; a new structure has it read again.
    told_of: Option<SceneId>,
    fetcher: Option<Fetcher>,
    /// Why the scene of an unmet order is not here, if it could not be fetched either, and when it is asked for again.
    missing: Option<(String, Instant)>,
    /// The pause after the next failure.
    fetch_pause: Duration,
    progress: watch::Sender<LoadProgress>,
}

impl LoaderThread {
    fn run(mut self, requests: &LatestRequests) {
        let mut last_reason = String::new();
        if let Some(model) = self.model.clone()
            && let Err(reason) = self.load(None, Treatment::default(), &SceneSource::File(model), None)
        {
            // Carry on: the wall may ask for a scene that needs no file.
            tracing::error!("{reason}");
            last_reason = reason;
        }
        // An order that could not be met, and the files that it needs as they were then.
        let mut unmet: Option<(LoadRequest, [FileState; 2])> = None;
        loop {
            let order = match requests.take(if unmet.is_some() { RETRY_INTERVAL } else { Duration::MAX }) {
                Some(Request::Prepare(next)) => {
                    self.prepare(&next, requests);
                    continue;
                }
                Some(Request::Load(order)) => Some(order),
                None => None,
            };
            // Files that have come back, or were replaced, are read without being asked for again.
            let have_changed = unmet.as_ref().is_some_and(|(order, files)| self.files(order) != *files);
            if order.is_some() || have_changed {
                self.missing = None;
            }
            let is_due = have_changed || self.missing.as_ref().is_some_and(|(_, fetch_at)| *fetch_at <= Instant::now());
            let Some(order) = order.or_else(|| Some(unmet.take_if(|_| is_due)?.0)) else { continue };
            let files = self.files(&order);
            let scene = order.scene;
            let state = match self.prepare_scene(&order, requests) {
                Ok(scene) => SceneState::Ready {
                    triangles: scene.n_triangles() as u64,
                    bytes: scene.n_bytes() as u64,
                    grid: scene.grid.structure(),
                },
                // The next order makes this one needless.
                Err(_) if requests.has_load() => continue,
                Err(reason) => {
                    // A wall may order the same scene over and over.
                    if reason != last_reason {
                        tracing::warn!("cannot render for the wall: {reason}");
                        last_reason.clone_from(&reason);
                    }
                    SceneState::Missing { reason }
                }
            };
            unmet = matches!(state, SceneState::Missing { .. }).then_some((order, files));
            self.progress.send_replace(Some((scene, state)));
        }
    }

    /// The file that should hold the ordered scene: the one of the command line, or the wall's own.
    fn path<'a>(&'a self, order: &'a LoadRequest) -> Option<&'a PathBuf> {
        self.model.as_ref().or(order.path.as_ref())
    }

    /// The state of both files that an order needs.
    fn files(&self, order: &LoadRequest) -> [FileState; 2] {
        let state = |path: &PathBuf| {
            let file = path.metadata().ok()?;
            Some((file.len(), file.modified().ok()))
        };
        let sky = order.sky.as_ref().and_then(|sky| self.sky_path(sky));
        [self.path(order).and_then(state), sky.as_ref().and_then(state)]
    }

    /// The file that should hold the ordered sky: the one of the command line, or the wall's own.
    fn sky_path(&self, order: &SkyFile) -> Option<PathBuf> {
        self.sky.clone().or_else(|| order.path.clone().map(path_from_bytes))
    }

    /// Reads the ordered sky. The error names the cause and the cure.
    fn read_sky(&self, order: &SkyFile) -> Result<Arc<SkyMap>, String> {
        let cure = "start it with --sky FILE, the image that lights the wall";
        let path = self.sky_path(order).ok_or_else(|| format!("it has no {}: {cure}", order.id))?;
        let sky = SkyMap::read(&path).map_err(|error| match &self.sky {
            Some(_) => error.to_string(),
            None => format!("{error}; {cure}"),
        })?;
        if sky.id() != order.id {
            return Err(format!(
                "{} is {}, the wall has {}: give it the wall's own file",
                path.display(),
                sky.id(),
                order.id
            ));
        }
        Ok(Arc::new(sky))
    }

    /// Returns the ordered scene, fetched if it is not here. The error names the cause and the cure.
    fn prepare_scene(&mut self, order: &LoadRequest, requests: &LatestRequests) -> Result<Arc<Scene>, String> {
        let sky_id = order.sky.as_ref().map(|sky| sky.id);
        if let Some(scene) = self.current.get(order.scene).filter(|_| self.structure == order.structure)
            && scene.sky.as_ref().map(|sky| sky.id()) == sky_id
        {
            return Ok(scene);
        }
        if let Some(scene) = self.prepared.take_if(|prepared| prepared.meets(order)).map(|prepared| prepared.scene) {
            self.structure = order.structure;
            self.current.set(Some((order.scene, Arc::clone(&scene))));
            tracing::info!("{} was loaded ahead", order.scene);
            return Ok(scene);
        }
        let sky = order.sky.as_ref().map(|sky| self.read_sky(sky)).transpose()?;
        let missing = match self.missing.take() {
            Some((missing, _)) => missing,
            None => match self.find_scene(order, sky.clone()) {
                Err(missing) if matches!(order.scene, SceneId::Mesh { .. }) && self.fetcher.is_some() => {
                    tracing::info!("{missing}; it is fetched from the wall");
                    missing
                }
                found => return found,
            },
        };
        let Some(fetcher) = self.fetcher.clone() else { return Err(missing) };
        let cache = match self.store.cache() {
            Ok(cache) => cache.clone(),
            Err(fault) => return Err(format!("{missing}; it cannot be fetched: {fault}")),
        };
        let fetched = self.fetch(&fetcher, &cache, (order.scene, sky.as_ref()), requests);
        match &fetched {
            Ok(_) => self.fetch_pause = FETCH_PAUSES.start,
            Err(_) => {
                // The log has the rest.
                self.missing = Some((missing, Instant::now() + self.fetch_pause));
                self.fetch_pause = (2 * self.fetch_pause).min(FETCH_PAUSES.end);
            }
        }
        fetched.map_err(|error| format!("it cannot fetch the model: {error}"))
    }

    /// Loads a scene beside the present one. If that fails, it is loaded when it is ordered.
    fn prepare(&mut self, next: &LoadRequest, requests: &LatestRequests) {
        if self.prepared.as_ref().is_some_and(|prepared| prepared.meets(next)) {
            return;
        }
        self.prepared = None;
        match self.load_beside(next, requests) {
            Ok(scene) => self.prepared = Some(Prepared { id: next.scene, structure: next.structure, scene }),
            Err(reason) => tracing::info!("{} is not loaded ahead: {reason}", next.scene),
        }
    }

    fn load_beside(&self, next: &LoadRequest, requests: &LatestRequests) -> Result<Arc<Scene>, String> {
        let too_large = || format!("both do not fit into --memory-budget {}", self.options.memory_budget);
        let file_bytes = self.path(next).and_then(|path| path.metadata().ok()).map(|file| file.len());
        let next_bytes = match next.scene {
            SceneId::Statue { triangles, .. } => u64::from(triangles) * BYTES_PER_TRIANGLE,
            // A mesh takes about as many bytes as its file, and a grid as many again.
            SceneId::Mesh { .. } => 2 * file_bytes.unwrap_or(0),
        };
        let memory_budget = self.options.memory_budget.beside(self.current.n_bytes()).ok_or_else(too_large)?;
        if memory_budget.is_exceeded_by(next_bytes) {
            return Err(too_large());
        }
        // A loader of its own, which tells the wall nothing.
        let mut beside = Self {
            current: CurrentScene::default(),
            prepared: None,
            structure: None,
            options: GridOptions { memory_budget, ..self.options },
            told: Told::Nothing,
            missing: None,
            progress: watch::Sender::new(None),
            ..self.clone()
        };
        let scene = beside.prepare_scene(next, requests)?;
        if scene.grid.shortage().is_some() { Err(too_large()) } else { Ok(scene) }
    }

    /// The scene in its file in the cache, or from the wall.
    fn fetch(
        &mut self,
        fetcher: &Fetcher,
        cache: &Cache,
        (scene, sky): (SceneId, Option<&Arc<SkyMap>>),
        requests: &LatestRequests,
    ) -> Result<Arc<Scene>, String> {
        let place = cache.fetched_path(scene, &fetcher.origin());
        let source = SceneSource::File(place.clone());
        // Of several render servers on a machine, one fetches.
        let lock = Lock::take(&Cache::lock_of(&place), &|done| self.report_progress(scene, done));
        let lock = lock.map_err(|error| format!("{}: {error}", cache.folder().display()))?;
        for is_first in [true, false] {
            if place.exists() {
                match self.load(Some(scene), scene.treatment(), &source, sky.cloned()) {
                    Ok((id, scene_of_file, _)) if id == scene => {
                        Cache::touch(&place);
                        return Ok(scene_of_file);
                    }
                    Ok((id, ..)) => tracing::warn!("{source} is {id}: it is fetched again"),
                    Err(error) => tracing::warn!("{error}: it is fetched again"),
                }
                // It was damaged here, or the wall's is wrong.
                let _ = std::fs::remove_file(&place);
            }
            if !is_first {
                break;
            }
            if lock.is_none() {
                return Err("another render server of this machine fetches it, and waits for the wall".to_owned());
            }
            let bar = Progress::new(format!("fetching {scene} from the wall"));
            let report = |progress: fetch::Progress| match progress {
                fetch::Progress::Awaited(done) => {
                    bar.tell(&format!("the wall makes the scene file of {scene}"));
                    bar.set(done);
                    self.report_progress(scene, done);
                }
                fetch::Progress::Arriving(transfer) => {
                    bar.tell(&format!("fetching {scene}: {transfer}"));
                    bar.set(transfer.fraction());
                    lock.iter().for_each(|lock| lock.tell(transfer.fraction()));
                    self.progress.send_replace(Some((scene, SceneState::Fetching(transfer))));
                }
            };
            self.current.set(None);
            let begun_at = Instant::now();
            let watch = Watch { is_wanted: &|| !requests.has_load(), report: &report };
            let fetched = self.pool.install(|| fetcher.fetch(scene, cache, &place, &watch));
            fetched.map_err(|error| error.to_string())?;
            tracing::info!("{scene} has arrived in {:.1} s", begun_at.elapsed().as_secs_f64());
        }
        Err("the wall's scene file cannot be used: the log of this render server says why".to_owned())
    }

    /// Returns the ordered scene if it is here. The error names the cause and the cure.
    fn find_scene(&mut self, order: &LoadRequest, sky: Option<Arc<SkyMap>>) -> Result<Arc<Scene>, String> {
        let ordered = order.scene;
        self.structure = order.structure;
        let source = match ordered {
            SceneId::Statue { triangles, .. } => Some(SceneSource::Statue { triangles }),
            SceneId::Mesh { .. } => self.path(order).cloned().map(SceneSource::File),
        };
        let Some(source) = source else {
            return Err(match self.fetcher {
                Some(_) => format!("it has no {ordered}"),
                None => format!("it has no {ordered}: start it with --model FILE, the file that the wall shows"),
            });
        };
        match self.load(Some(ordered), ordered.treatment(), &source, sky) {
            Ok((id, scene, _)) if id == ordered => Ok(scene),
            Ok((id, _, left_out)) => {
                let cure = format!("{source} is {id}, the wall shows {ordered}: give it the wall's own file");
                // A file that it names may be missing here, and there at the wall.
                let lines = left_out.join("; ");
                Err(if lines.is_empty() { cure } else { format!("{cure}, and all that it names: {lines}") })
            }
            Err(error) if self.model.is_none() => {
                Err(format!("{error}; --model FILE names the file that the wall shows"))
            }
            Err(error) => Err(error),
        }
    }

    /// Loads and builds a scene, and tells the parts of its file that were left out. Drops the others first, so that memory
    /// holds one.
    fn load(
        &mut self,
        ordered: Option<SceneId>,
        treatment: Treatment,
        source: &SceneSource,
        sky: Option<Arc<SkyMap>>,
    ) -> Result<(SceneId, Arc<Scene>, Vec<String>), String> {
        self.prepared = None;
        let report_progress = |progress: f32| {
            if let Some(scene) = ordered {
                self.report_progress(scene, progress);
            }
        };
        self.current.set(None);
        tracing::info!("loading {source}");
        if self.told == Told::Everything && !self.store.has(source, treatment) {
            warn_of_large_file(source, 1);
        }
        let bar = Progress::new(format!("loading {source}"));
        let report = |stage: Stage, fraction: f32| {
            bar.report(stage, source, fraction);
            report_progress(fraction);
        };
        let loaded = self.pool.install(|| self.store.load(source, treatment, &self.effective_options(), &report));
        let StoredScene { info, scene, is_mapped, .. } = loaded.map_err(|error| error.to_string())?;
        let (id, scene) = (info.id, Arc::new(scene.with_sky(sky)));
        if self.told == Told::Everything && self.told_of != Some(id) {
            info.log(source);
        }
        self.told_of = Some(id);
        tracing::info!(
            "{source} is ready: {} in {}{}",
            counted(scene.n_triangles(), "triangle"),
            bytes(scene.n_bytes() as u64),
            if is_mapped { ", mapped" } else { "" }
        );
        if let Some(shortage) = scene.grid.shortage().filter(|_| self.told != Told::Nothing) {
            tracing::warn!("{source}: {shortage}");
        }
        self.current.set(Some((id, Arc::clone(&scene))));
        Ok((id, scene, info.left_out))
    }

    /// The command line's grid options, overridden by the wall's choice.
    fn effective_options(&self) -> GridOptions {
        let mut options = self.options;
        if let Some(Structure { storage, density }) = self.structure {
            (options.storage, options.density) = (storage, Some(density));
        }
        options
    }

    /// Reports progress in steps of 1 %, to spare the network.
    fn report_progress(&self, scene: SceneId, progress: f32) {
        self.progress.send_if_modified(|last| {
            let is_step = !matches!(last, Some((of, SceneState::Loading { progress: reported }))
                if *of == scene && (progress - *reported).abs() < 0.01);
            if is_step {
                *last = Some((scene, SceneState::Loading { progress }));
            }
            is_step
        });
    }
}
