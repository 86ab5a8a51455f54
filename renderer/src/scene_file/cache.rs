//! The cache: scene files of models that this user has shown on this machine.
//!
//! A scene's name is a hash of its model's path and of the options that it was built with, so a model that changes replaces
//! its own old scene. Beside each lies its lock, whose time says when it was last used.

use std::{
    env, fmt,
    fs::{self, DirBuilder, File},
    io,
    path::{Path, PathBuf},
    time::SystemTime,
};

use shared::{
    codec,
    scene::{SceneId, Treatment},
};

use crate::{
    grid::GridOptions,
    scene_file::{file::SceneFile, lock::Lock, seals::Seals},
};

/// The most that the scenes take on the disk, unless a cache is told otherwise.
pub const MOST_BYTES: u64 = 20_000_000_000;

/// The ending of scene files.
pub const ENDING: &str = "raywall";

/// The ending of locks.
const LOCK_ENDING: &str = "lock";

/// The ending of files that are being written.
const PART_ENDING: &str = "part";

/// The ending of scene files that are being fetched.
const FETCH_ENDING: &str = "fetch";

/// The beginning of the names of scene files that were fetched.
const FETCHED: &str = "fetched-";

/// Scene files in a folder of this user.
#[derive(Clone, Debug)]
pub struct Cache {
    folder: PathBuf,
    most_bytes: u64,
    pub(crate) seals: Seals,
}

/// A scene in the cache.
#[derive(Clone, Debug)]
pub struct CachedScene {
    path: PathBuf,
    /// The path of its model, or where it comes from; `None` if the file cannot be used.
    pub model: Option<String>,
    /// Triangles of the model.
    pub n_triangles: usize,
    /// Bytes on the disk.
    pub n_bytes: u64,
    /// When a program used it last.
    pub used_at: SystemTime,
}

/// A scene that was fetched from a wall in part.
#[derive(Clone, Debug)]
pub struct CachedPart {
    path: PathBuf,
    /// Bytes of the whole file, and triangles of its model; `None` before its head is there.
    pub whole: Option<(u64, usize)>,
    /// Bytes that are there.
    pub n_bytes: u64,
    /// When a program used it last.
    pub used_at: SystemTime,
    /// Whether a program fetches the rest.
    pub is_arriving: bool,
}

/// The variable that names the folder in which the cache lies.
pub(crate) const FOLDER_VARIABLE: &str = if cfg!(windows) { "LOCALAPPDATA" } else { "XDG_CACHE_HOME" };

impl Cache {
    /// The user's cache, whose folder is made if it is not there. See [`Cache::at`].
    ///
    /// # Errors
    /// A text that says why the cache is not used.
    pub fn of_user() -> Result<Self, String> {
        let without = || format!("there is no folder for scene files: set {FOLDER_VARIABLE} to an absolute path");
        Self::at(folder_of_user().ok_or_else(without)?, MOST_BYTES)
    }

    /// The cache in a folder that only this user may write: whoever writes there decides what is traced without checks.
    ///
    /// # Errors
    /// A text that says why the cache is not used.
    pub fn at(folder: PathBuf, most_bytes: u64) -> Result<Self, String> {
        let told = |error: &dyn fmt::Display| format!("{}: {error}", folder.display());
        let seals = folder.join("seals");
        let mut builder = DirBuilder::new();
        builder.recursive(true);
        #[cfg(unix)]
        std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
        builder.create(&seals).map_err(|error| {
            told(&format_args!("the cache cannot be made: {error}: name another folder with {FOLDER_VARIABLE}"))
        })?;
        for folder in [&folder, &seals] {
            if !is_private(folder).map_err(|error| told(&error))? {
                return Err(told(&"others may write in the cache (chmod 700)"));
            }
        }
        Ok(Self { seals: Seals::new(seals), folder, most_bytes })
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The path of the scene of a model with these options.
    pub(crate) fn path(&self, model: &Path, treatment: Treatment, options: &GridOptions) -> PathBuf {
        // The budget is part of the scene; levels of macrocells lie over other storages alone.
        let options = hash(&codec::to_bytes(&(options.storage, options.density)));
        self.folder.join(format!("{}-{options}.{ENDING}", name(model, treatment)))
    }

    /// The paths of all scenes of a model, whatever their other options.
    pub(crate) fn paths(&self, model: &Path, treatment: Treatment) -> impl Iterator<Item = PathBuf> {
        let name = name(model, treatment);
        scenes(&self.folder).filter(move |path| path.to_string_lossy().contains(&name))
    }

    /// The path of a scene that is fetched from a wall of this origin. A file's own word is all that says which scene it
    /// holds, so no other wall's file takes its place.
    pub(crate) fn fetched_path(&self, scene: SceneId, origin: &[u8; 32]) -> PathBuf {
        self.folder.join(format!("{FETCHED}{}.{ENDING}", hash(&codec::to_bytes(&(scene, origin)))))
    }

    /// The part of the scene of a path that has been fetched. Its name stays the same, so that a later process goes on with it;
    /// nobody else may write in the cache.
    pub(crate) fn part_of(path: &Path) -> PathBuf {
        path.with_extension(FETCH_ENDING)
    }

    /// The lock of the scene of a path.
    pub(crate) fn lock_of(path: &Path) -> PathBuf {
        path.with_extension(LOCK_ENDING)
    }

    /// Notes that a scene is used.
    pub(crate) fn touch(path: &Path) {
        // Fails if nothing was built here yet.
        let lock = File::open(Self::lock_of(path));
        let _ = lock.and_then(|lock| lock.set_modified(SystemTime::now()));
    }

    /// Removes scenes, those that were not used for the longest time first, until another has room in the place of the one
    /// that has its path. False if it is larger than the cache.
    pub(crate) fn make_room(&self, n_bytes: u64, path: &Path) -> bool {
        let Some(left) = self.most_bytes.checked_sub(n_bytes) else { return false };
        self.drop_parts(Some(&Self::lock_of(path)));
        let own = [path, &Self::part_of(path)];
        let parts = files(&self.folder, FETCH_ENDING).filter(|part| !is_locked(part));
        let others = scenes(&self.folder).chain(parts).filter(|other| !own.contains(&other.as_path()));
        let mut others: Vec<_> = others.filter_map(aged).collect();
        others.sort_by_key(|(_, _, used_at)| *used_at);
        let mut taken: u64 = others.iter().map(|(_, n_bytes, _)| n_bytes).sum();
        for (path, n_bytes, _) in others {
            if taken <= left {
                break;
            }
            // Processes that have it mapped keep it.
            remove(&path);
            taken -= n_bytes;
        }
        true
    }

    /// All scenes, the last used first.
    pub fn scenes(&self) -> Vec<CachedScene> {
        let cached = |(path, n_bytes, used_at): (PathBuf, u64, SystemTime)| {
            let record = SceneFile::open(&path).ok().map(|file| file.record);
            let n_triangles = record.as_ref().map_or(0, |record| record.info.n_triangles);
            let is_fetched = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(FETCHED));
            let model = record.and_then(|record| match is_fetched {
                true => Some("fetched from a wall".to_owned()),
                false => Some(record.sources?.path()),
            });
            CachedScene { path, model, n_triangles, n_bytes, used_at }
        };
        let mut scenes: Vec<_> = scenes(&self.folder).filter_map(aged).map(cached).collect();
        scenes.sort_by_key(|scene| std::cmp::Reverse(scene.used_at));
        scenes
    }

    /// All scenes that were fetched in part, the last used first.
    pub fn parts(&self) -> Vec<CachedPart> {
        let part = |(path, n_bytes, used_at): (PathBuf, u64, SystemTime)| {
            let whole = SceneFile::beginning(&path).map(|(n_bytes, info)| (n_bytes, info.n_triangles));
            let is_arriving = is_locked(&path);
            CachedPart { path, whole, n_bytes, used_at, is_arriving }
        };
        let mut parts: Vec<_> = files(&self.folder, FETCH_ENDING).filter_map(aged).map(part).collect();
        parts.sort_by_key(|part| std::cmp::Reverse(part.used_at));
        parts
    }

    /// Removes the files that builders were writing when they were killed, and returns their bytes. Removes none while a
    /// process builds, other than the caller, whose own lock this is.
    fn drop_parts(&self, own: Option<&Path>) -> u64 {
        // Listed before the locks are looked at: whoever writes one of them has its lock since before.
        let parts: Vec<_> = files(&self.folder, PART_ENDING).filter_map(aged).collect();
        let is_building = |lock: PathBuf| Some(&*lock) != own && Lock::is_held(&lock);
        if parts.is_empty() || files(&self.folder, LOCK_ENDING).any(is_building) {
            return 0;
        }
        parts.iter().for_each(|(path, ..)| remove(path));
        parts.iter().map(|(_, n_bytes, _)| n_bytes).sum()
    }

    /// Removes all scenes and seals, the parts of scenes that nobody fetches now, and what killed builders left; returns the
    /// bytes that are free again once no process uses them.
    pub fn clear(&self) -> u64 {
        let n_part_bytes = self.drop_parts(None);
        let scenes = self.scenes();
        scenes.iter().for_each(|scene| remove(&scene.path));
        let mut parts = self.parts();
        parts.retain(|part| !part.is_arriving);
        parts.iter().for_each(|part| remove(&part.path));
        self.seals.clear();
        let of_scenes: u64 = scenes.iter().map(|scene| scene.n_bytes).sum();
        of_scenes + parts.iter().map(|part| part.n_bytes).sum::<u64>() + n_part_bytes
    }
}

fn folder_of_user() -> Option<PathBuf> {
    let absolute = |name: &str| env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let of_home = || if cfg!(windows) { None } else { Some(absolute("HOME")?.join(".cache")) };
    Some(absolute(FOLDER_VARIABLE).or_else(of_home)?.join("raywall"))
}

/// Whether nobody but this user may write in a folder.
fn is_private(folder: &Path) -> io::Result<bool> {
    let metadata = fs::metadata(folder)?;
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        // SAFETY: `geteuid` always succeeds, and touches nothing.
        Ok(metadata.uid() == unsafe { libc::geteuid() } && metadata.mode() & 0o022 == 0)
    }
    #[cfg(not(unix))]
    Ok(metadata.is_dir())
}

/// Whether a process builds or fetches the scene of a path.
fn is_locked(path: &Path) -> bool {
    Lock::is_held(&Cache::lock_of(path))
}

/// The scenes in a folder.
fn scenes(folder: &Path) -> impl Iterator<Item = PathBuf> + use<> {
    files(folder, ENDING)
}

/// The files in a folder that have an ending.
fn files(folder: &Path, ending: &'static str) -> impl Iterator<Item = PathBuf> + use<> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(move |path| path.extension().is_some_and(|of_path| of_path == ending))
}

/// A scene's path, its bytes, and when it was used last.
fn aged(path: PathBuf) -> Option<(PathBuf, u64, SystemTime)> {
    let file = fs::metadata(&path).ok()?;
    let used_at = fs::metadata(Cache::lock_of(&path)).and_then(|lock| lock.modified()).or_else(|_| file.modified());
    Some((path, file.len(), used_at.ok()?))
}

/// The lock stays: another process may be waiting for it.
fn remove(path: &Path) {
    if let Err(error) = fs::remove_file(path) {
        tracing::warn!("{}: cannot be removed: {error}", path.display());
    }
}

/// The part of a name that a model gives.
fn name(model: &Path, treatment: Treatment) -> String {
    let model = std::path::absolute(model).unwrap_or_else(|_| model.to_owned());
    hash(&codec::to_bytes(&(model.as_os_str().as_encoded_bytes(), treatment)))
}

fn hash(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex()[..24].to_owned()
}
