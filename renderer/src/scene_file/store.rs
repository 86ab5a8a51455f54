//! Loads scenes: from a scene file that is named, from the cache, or by building them.

use std::{
    io,
    path::{Path, PathBuf},
    thread::{self, JoinHandle},
};

use shared::{printable::bytes, scene::Treatment};

use crate::{
    formats::sources::{Sources, Stamp},
    grid::{GridOptions, MemoryBudget, Storage},
    memory::spill::Spill,
    model::scene::{self, LoadError, ModelInfo, SceneSource},
    render::scene::Scene,
    scene_file::{
        cache::Cache,
        fault::{Fault, SceneFileError},
        file::{self, SceneFile, is_scene_file},
        head::Hash,
        lock::Lock,
        seals::Seals,
        travelling::TravellingFile,
    },
};

/// Scenes of fewer bytes are built about as fast as files of them are found.
const WORTHWHILE_BYTES: usize = 8_000_000;

/// The steps of a process until a scene is ready.
#[derive(Clone, Copy, Debug, PartialEq, Eq, strum::Display)]
#[expect(missing_docs, reason = "the names say it")]
pub enum Stage {
    #[strum(serialize = "waiting for another process that loads")]
    Waiting,
    #[strum(serialize = "loading")]
    Loading,
    #[strum(serialize = "building the grid of")]
    Building,
    #[strum(serialize = "writing the scene file of")]
    Writing,
    #[strum(serialize = "checking the scene file of")]
    Checking,
}

/// Receives the stage and the fraction of all that is done, 0 to 1, from any thread.
pub type Report<'a> = &'a (dyn Fn(Stage, f32) + Sync);

/// Which scenes the cache keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Keep {
    /// Those that take longer to build than to open.
    IfWorthwhile,
    /// All.
    Always,
}

/// A scene, and what is told of its model.
pub struct StoredScene {
    /// The facts of the model.
    pub info: ModelInfo,
    /// The scene itself.
    pub scene: Scene,
    /// Whether its arrays lie in a file that other processes share.
    pub is_mapped: bool,
    /// Seals the scene's file meanwhile.
    sealing: Option<JoinHandle<()>>,
}

impl StoredScene {
    /// Waits until the scene's file is on the disk, for a program that ends at once: the next one need not check it then.
    pub fn finish(self) {
        // A panic has been told of.
        let _ = self.sealing.map(JoinHandle::join);
    }
}

/// Loads scenes.
#[derive(Clone, Debug, Default)]
pub struct SceneStore {
    /// Without one, models are built at each start.
    cache: Option<Cache>,
    /// Why there is none, if that is not as it should be.
    fault: Option<String>,
}

impl SceneStore {
    /// A store with this cache.
    pub fn new(cache: Option<Cache>) -> Self {
        Self { cache, fault: None }
    }

    /// A store with the user's cache.
    pub fn of_user() -> Self {
        match Cache::of_user() {
            Ok(cache) => Self::new(Some(cache)),
            Err(fault) => Self { cache: None, fault: Some(fault) },
        }
    }

    /// Whether a model need not be read, as a scene file of it is there.
    pub fn has(&self, source: &SceneSource, treatment: Treatment) -> bool {
        let SceneSource::File(path) = source else { return false };
        is_scene_file(path) || self.cached(path, treatment).is_some()
    }

    /// The scene file of a model in the cache.
    fn cached(&self, model: &Path, treatment: Treatment) -> Option<(PathBuf, SceneFile)> {
        // Faults are told where the scene is loaded.
        let open = |path: PathBuf| open_cached(&path, model).ok().flatten().map(|file| (path, file));
        self.cache.as_ref()?.paths(model, treatment).find_map(open)
    }

    /// The cache, if there is one; else why not, and the cure.
    pub(crate) fn cache(&self) -> Result<&Cache, String> {
        self.cache.as_ref().ok_or_else(|| {
            self.fault.clone().unwrap_or_else(|| "it keeps no scene files: start it without --no-cache".to_owned())
        })
    }

    /// The scene file of a model, to give it to other machines: the one that is there, or one that is made in the cache, on the
    /// current rayon pool.
    ///
    /// # Errors
    /// The cause and the cure.
    pub fn travelling(
        &self,
        model: &Path,
        treatment: Treatment,
        options: &GridOptions,
        report: Report<'_>,
    ) -> Result<TravellingFile, String> {
        let open = |(path, file): (Option<PathBuf>, SceneFile)| {
            TravellingFile::new(file, path).map_err(|error| error.to_string())
        };
        if is_scene_file(model) {
            return open((None, open_named(model, treatment).map_err(|error| error.to_string())?));
        }
        if let Some((path, file)) = self.cached(model, treatment) {
            return open((Some(path), file));
        }
        let cache = self.cache()?;
        let storage = if options.storage.is_tree() { options.storage } else { Storage::Tree };
        let options = GridOptions { storage, ..*options };
        let made = self.load_cached(cache, model, treatment, &options, Keep::Always, report);
        made.map_err(|error| error.to_string())?.finish();
        let file = self.cached(model, treatment);
        let no_file = || format!("no scene file of {} can be made here: see the wall's log", model.display());
        let (path, file) = file.ok_or_else(no_file)?;
        open((Some(path), file))
    }

    /// The facts of a model: from a scene file if there is one, which takes no time, or by reading the model.
    ///
    /// # Errors
    /// The model, or the scene file in its place, cannot be read.
    pub fn describe(
        &self,
        source: &SceneSource,
        treatment: Treatment,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<ModelInfo, LoadError> {
        if let SceneSource::File(path) = source {
            if is_scene_file(path) {
                let file = open_named(path, treatment)?;
                return Ok(file.record.info);
            }
            if let Some((_, file)) = self.cached(path, treatment) {
                return Ok(file.record.info);
            }
        }
        scene::load(source, treatment, progress).map(|loaded| loaded.info(loaded.mesh.facing().is_some()))
    }

    /// Loads a scene on the current rayon pool.
    ///
    /// # Errors
    /// The model, or the scene file in its place, cannot be read. A scene file that is only in the cache is built anew.
    pub fn load(
        &self,
        source: &SceneSource,
        treatment: Treatment,
        options: &GridOptions,
        report: Report<'_>,
    ) -> Result<StoredScene, LoadError> {
        if let SceneSource::File(path) = source {
            if is_scene_file(path) {
                let progress = |done| report(Stage::Checking, done);
                let scene = self.take(open_named(path, treatment)?, path, None, &progress);
                return Ok(scene.map_err(|fault| error_of(path, fault))?);
            }
            if let Some(cache) = self.cache.as_ref().filter(|_| options.storage.is_tree()) {
                return self.load_cached(cache, path, treatment, options, Keep::IfWorthwhile, report);
            }
        }
        let built = build(source, treatment, options, &std::env::temp_dir(), report)?;
        if let (Some(fault), SceneSource::File(_)) = (&self.fault, source)
            && is_worthwhile(&built.scene)
        {
            tracing::warn!("{fault}; models are built at each start");
        }
        Ok(built.into())
    }

    fn load_cached(
        &self,
        cache: &Cache,
        model: &Path,
        treatment: Treatment,
        options: &GridOptions,
        keep: Keep,
        report: Report<'_>,
    ) -> Result<StoredScene, LoadError> {
        let path = cache.path(model, treatment, options);
        let before = Stamp::at(&path);
        let find = || {
            let tell = |fault: &Fault| tell_of_rebuild(&path, model, fault);
            let file = open_cached(&path, model).inspect_err(tell).ok().flatten();
            let file = file.filter(|file| file.suits(options.memory_budget))?;
            let scene = self.take(file, &path, None, &|done| report(Stage::Checking, done)).inspect_err(tell).ok()?;
            Cache::touch(&path);
            Some(scene)
        };
        if let Some(scene) = find() {
            return Ok(scene);
        }

        // One process builds; others use its file.
        let lock = Lock::take(&Cache::lock_of(&path), &|done| report(Stage::Waiting, done));
        let lock = lock.unwrap_or_else(|error| {
            tracing::warn!("{}: the scene is not kept in the cache: {error}", model.display());
            None
        });
        if Stamp::at(&path) != before
            && let Some(scene) = find()
        {
            return Ok(scene);
        }
        let report = |stage: Stage, done: f32| {
            lock.iter().for_each(|lock| lock.tell(done));
            report(stage, done);
        };
        let built = build(&SceneSource::File(model.to_owned()), treatment, options, cache.folder(), &report)?;
        if lock.is_none() || keep == Keep::IfWorthwhile && !is_worthwhile(&built.scene) {
            return Ok(built.into());
        }
        self.keep(cache, &path, model, built, &report)
    }

    /// Writes a scene into the cache, drops it, and takes it from there: other processes then share its memory. If that fails,
    /// the scene stays as it was built.
    fn keep(
        &self,
        cache: &Cache,
        path: &Path,
        model: &Path,
        mut built: Built,
        report: Report<'_>,
    ) -> Result<StoredScene, LoadError> {
        let progress = |done: f32| report(Stage::Writing, 0.9 + 0.1 * done);
        let mut write = || -> Result<(SceneFile, Hash), Fault> {
            let Some(sources) = &built.sources else {
                return Err(io::Error::other("the model changed while it was read, or just before").into());
            };
            if !cache.make_room(built.scene.n_bytes() as u64, path) {
                let n_bytes = bytes(built.scene.n_bytes() as u64);
                return Err(io::Error::other(format!("it has {n_bytes}, more than the cache may have")).into());
            }
            let new = file::begin(path)?;
            let hash =
                file::write(new.file(), &mut built.scene, &built.info, (Some(sources), built.budget), &progress)?;
            new.appear()?;
            Ok((SceneFile::open(path)?, hash))
        };
        match write() {
            Ok((file, hash)) => {
                drop(built);
                Cache::touch(path);
                Ok(self.take(file, path, Some(hash), &progress).map_err(|fault| error_of(path, fault))?)
            }
            Err(fault) => {
                // "Cannot be read" would be said of a file that was written.
                let cause = if let Fault::Io(error) = &fault { error.to_string() } else { fault.to_string() };
                tracing::warn!("{}: the scene is not kept in the cache: {cause}", model.display());
                Ok(built.into())
            }
        }
    }

    /// The seals of a file that is mapped: nobody else may write it, and it lies on the cache's disk. Another machine may
    /// change files on other disks and leave all that this one is told of them; if it can do so on the cache's, it can make
    /// seals as well.
    fn seals_for(&self, file: &SceneFile, path: &Path) -> Option<Seals> {
        let reason = match &self.cache {
            None => "there is no cache",
            Some(_) if !file.is_private() => "others may write it (copy it with `install -m 644`)",
            Some(cache) if !file.is_on_disk_of(cache.folder()) => {
                "it is on another disk than the cache (copy it there)"
            }
            Some(cache) => return Some(cache.seals.clone()),
        };
        tracing::info!("{}: is checked at each start, and read in place of mapped: {reason}", path.display());
        None
    }

    /// The scene of a file. All of it is checked, unless it is sealed, or is the one that this process has just `written`.
    fn take(
        &self,
        file: SceneFile,
        path: &Path,
        written: Option<Hash>,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<StoredScene, Fault> {
        let (stamp, hash) = (file.stamp(), file.head.hash);
        let seals = self.seals_for(&file, path);
        let is_mapped = seals.is_some();
        let is_sealed = seals.as_ref().is_some_and(|seals| seals.has(&stamp, &hash));
        let (info, own) = (file.record.info.clone(), file.file().try_clone()?);
        let scene = file.into_scene(is_mapped, is_sealed || written == Some(hash), progress)?;
        let seal = |seals: Seals| {
            // Without a seal, the next start checks the file again.
            thread::Builder::new().name("seal".to_owned()).spawn(move || drop(seals.seal(&own, &stamp, &hash))).ok()
        };
        let sealing = seals.filter(|_| !is_sealed).and_then(seal);
        Ok(StoredScene { info, scene, is_mapped, sealing })
    }
}

/// Builds a model's scene on the current rayon pool and writes it to a file, which may travel to other machines. Returns what
/// is told of the model, and the bytes of the file.
///
/// # Errors
/// The model cannot be read, or the file cannot be written.
pub fn build_file(
    source: &SceneSource,
    treatment: Treatment,
    options: &GridOptions,
    out: &Path,
    report: Report<'_>,
) -> anyhow::Result<(ModelInfo, u64)> {
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Built { info, scene, budget, _spill, .. } = build(source, treatment, options, folder, report)?;
    if let Some(shortage) = scene.grid.shortage() {
        tracing::warn!("{source}: {shortage}");
    }
    let new = file::begin(out)?;
    let progress = |done: f32| report(Stage::Writing, 0.9 + 0.1 * done);
    file::write_last(new.file(), scene, &info, (None, budget), &progress)?;
    let n_bytes = new.file().metadata()?.len();
    new.finish()?;
    Ok((info, n_bytes))
}

/// A scene that was built.
struct Built {
    info: ModelInfo,
    sources: Option<Sources>,
    scene: Scene,
    /// The budget that the grid had.
    budget: MemoryBudget,
    /// Lasts while the scene is written.
    _spill: Option<Spill>,
}

impl From<Built> for StoredScene {
    fn from(Built { info, scene, .. }: Built) -> Self {
        Self { info, scene, is_mapped: false, sealing: None }
    }
}

/// Builds a scene; one that takes more than the memory budget in temporary files in a folder.
fn build(
    source: &SceneSource,
    treatment: Treatment,
    options: &GridOptions,
    temporary: &Path,
    report: Report<'_>,
) -> Result<Built, LoadError> {
    // The paper's grids have as many cells as the budget allows.
    let spill = options.storage.is_tree().then(|| spill(source, options.memory_budget, temporary)).flatten();
    let budget = if spill.is_some() { *MemoryBudget::RANGE.end() } else { options.memory_budget };
    let options = GridOptions { memory_budget: budget, ..*options };
    let loaded = scene::load(source, treatment, &|done| report(Stage::Loading, 0.5 * done))?;
    let (mut info, sources) = (loaded.info(false), loaded.sources.clone());
    let scene = Scene::build(loaded.treated().mesh, &options, &|done| report(Stage::Building, 0.5 + 0.4 * done));
    info.is_solid = scene.mesh().facing().is_some();
    Ok(Built { info, sources, scene, budget, _spill: spill })
}

/// Begins a spill if building a model takes more memory than it may.
fn spill(source: &SceneSource, budget: MemoryBudget, folder: &Path) -> Option<Spill> {
    let SceneSource::File(path) = source else { return None };
    // A binary PLY file has 19 bytes a triangle, and building its scene takes twice as many and some more; with less, the grid
    // would be coarser.
    let peak_bytes = path.metadata().ok()?.len() / 10 * 24;
    if !budget.is_exceeded_by(peak_bytes) {
        return None;
    }
    let takes = format!("{source}: building it takes about {}, more than --memory-budget {budget}", bytes(peak_bytes));
    match Spill::begin(folder, budget.n_bytes()) {
        Ok(spill) => {
            tracing::info!("{takes}: temporary files in {} hold the rest, which takes longer", folder.display());
            Some(spill)
        }
        Err(error) => {
            tracing::warn!("{takes}; no temporary files in {} can hold the rest: {error}", folder.display());
            None
        }
    }
}

fn is_worthwhile(scene: &Scene) -> bool {
    scene.n_bytes() >= WORTHWHILE_BYTES && scene.grid.is_storable()
}

/// A scene file that an operator has named. It keeps its own treatment and grid.
fn open_named(path: &Path, treatment: Treatment) -> Result<SceneFile, SceneFileError> {
    let file = SceneFile::open(path).map_err(|fault| error_of(path, fault))?;
    let of_file = file.record.info.id.treatment();
    let default = Treatment::default();
    let keeps_crease = [of_file.crease, default.crease].contains(&treatment.crease);
    let keeps_precision = [of_file.precision, default.precision].contains(&treatment.precision);
    if !(keeps_crease && keeps_precision) {
        return Err(error_of(path, Fault::OtherTreatment { of_file, asked: treatment }));
    }
    Ok(file)
}

/// The file of a model's scene in the cache, if it is there, and neither the model nor the program has changed since.
fn open_cached(path: &Path, model: &Path) -> Result<Option<SceneFile>, Fault> {
    match SceneFile::open(path) {
        Ok(file) => {
            let is_current = file.record.sources.as_ref().is_some_and(|sources| sources.are_of(model));
            Ok(Some(file).filter(|file| is_current && file.is_by_this_builder()))
        }
        Err(Fault::Io(error)) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(fault) => Err(fault),
    }
}

fn tell_of_rebuild(path: &Path, model: &Path, fault: &Fault) {
    tracing::warn!(
        "{}: the scene in the cache cannot be used, and is built again: {}: {fault}",
        model.display(),
        path.display()
    );
}

fn error_of(path: &Path, fault: Fault) -> SceneFileError {
    SceneFileError { path: path.to_owned(), fault }
}
