//! The files that a model was read from, and whether they are still the same.

use std::{
    fs::{self, Metadata},
    path::Path,
    time::{Duration, SystemTime},
};

use serde::{Deserialize, Serialize};

use crate::formats::companions::Companions;

/// The state of a file, as far as the system tells it without reading: another content has another stamp.
///
/// Programs can set a file's length and time, but not the time of its last change, nor the number that a new file gets; only
/// another machine that writes the same disk can.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    n_bytes: u64,
    /// Times since 1970, in seconds and nanoseconds.
    modified: Option<(u64, u32)>,
    changed: Option<(i64, i64)>,
    /// The numbers of the disk and of the file on it.
    place: Option<(u64, u64)>,
}

/// A clock's step: a file that is written twice within one has the same time. Linux steps by at most 10 ms.
const CLOCK_STEP: Duration = Duration::from_millis(20);

/// The same of file systems that keep whole seconds; FAT keeps every other.
const COARSE_STEP: Duration = Duration::from_secs(2);

impl Stamp {
    /// The stamp of a file.
    pub fn of(file: &Metadata) -> Self {
        let since_1970 = file.modified().ok().and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
        let modified = since_1970.map(|time| (time.as_secs(), time.subsec_nanos()));
        #[cfg(unix)]
        let (changed, place) = {
            use std::os::unix::fs::MetadataExt;
            (Some((file.ctime(), file.ctime_nsec())), Some((file.dev(), file.ino())))
        };
        #[cfg(not(unix))]
        let (changed, place) = (None, None);
        Self { n_bytes: file.len(), modified, changed, place }
    }

    /// The stamp of the file of a path, if it is there.
    pub fn at(path: &Path) -> Option<Self> {
        fs::metadata(path).ok().map(|file| Self::of(&file))
    }

    /// Whether a change from now on gives another stamp: the last one is longer ago than a step of the file's clock.
    pub fn is_settled(&self, now: SystemTime) -> bool {
        let Some((seconds, nanoseconds)) = self.modified else { return false };
        let step = if nanoseconds == 0 { COARSE_STEP } else { CLOCK_STEP };
        let since_1970 = |seconds, nanoseconds| SystemTime::UNIX_EPOCH + Duration::new(seconds, nanoseconds);
        let changed = self.changed.and_then(|(seconds, nanoseconds)| {
            Some(since_1970(u64::try_from(seconds).ok()?, u32::try_from(nanoseconds).ok()?))
        });
        let last = changed.into_iter().fold(since_1970(seconds, nanoseconds), SystemTime::max);
        now.duration_since(last).is_ok_and(|age| age > step)
    }
}

/// The answer to a model that names another file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Companion {
    /// The folder of the file that names it, relative to the model's.
    pub(super) folder: String,
    /// The name that it gives.
    pub(super) name: String,
    /// The path of the file that was found, in this system's encoding, and its stamp.
    found: Option<(Vec<u8>, Option<Stamp>)>,
}

impl Companion {
    pub(super) fn new(folder: &str, name: &str, found: Option<&Path>) -> Self {
        let found = found.map(|path| (path.as_os_str().as_encoded_bytes().to_vec(), Stamp::at(path)));
        Self { folder: folder.to_owned(), name: name.to_owned(), found }
    }
}

/// A model's file and all files that it names, as they were when they were read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sources {
    /// The model's path, in this system's encoding.
    path: Vec<u8>,
    stamp: Stamp,
    companions: Vec<Companion>,
}

impl Sources {
    /// Those of a model that was read just now, and had this stamp before; `None` if there is no telling whether they have
    /// changed since.
    pub(super) fn new(path: &Path, stamp: Stamp, companions: &Companions, began_at: SystemTime) -> Option<Self> {
        let sources = Self { path: bytes_of(path), stamp, companions: companions.found()? };
        let stamps = sources.companions.iter().filter_map(|companion| companion.found.as_ref()?.1.as_ref());
        let are_settled = stamps.chain([&sources.stamp]).all(|stamp| stamp.is_settled(began_at));
        (are_settled && sources.are_unchanged(path)).then_some(sources)
    }

    /// Whether the model of a path was read from these files, and would be read from the same again.
    pub fn are_of(&self, path: &Path) -> bool {
        self.path == bytes_of(path) && self.are_unchanged(path)
    }

    /// The model's path, for people.
    pub fn path(&self) -> String {
        String::from_utf8_lossy(&self.path).into_owned()
    }

    fn are_unchanged(&self, path: &Path) -> bool {
        let companions = Companions::beside(path);
        let is_same = |companion: &Companion| {
            let found = companions.find(&companion.folder, &companion.name).ok();
            Companion::new(&companion.folder, &companion.name, found.as_deref()) == *companion
        };
        Stamp::at(path).as_ref() == Some(&self.stamp) && self.companions.iter().all(is_same)
    }
}

/// A path's bytes, wherever the program was started.
fn bytes_of(path: &Path) -> Vec<u8> {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned()).into_os_string().into_encoded_bytes()
}

#[cfg(test)]
mod tests {
    use std::{path::PathBuf, thread::sleep};

    use super::*;
    use crate::formats::file;

    /// An OBJ with a material library and a texture, and one texture that is missing.
    fn model(folder: &Path) -> PathBuf {
        let path = folder.join("a.obj");
        fs::write(&path, "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n").unwrap();
        fs::write(folder.join("a.mtl"), "newmtl m\nmap_Kd b.png\nmap_Ke c.png\n").unwrap();
        fs::write(folder.join("b.png"), "no image").unwrap();
        sleep(2 * CLOCK_STEP);
        path
    }

    #[test]
    fn every_file_of_a_model_that_changes_appears_or_vanishes_is_noticed() {
        let changes: [fn(&Path); 7] = [
            |folder| fs::write(folder.join("a.obj"), "v 0 0 0\n").unwrap(),
            |folder| fs::write(folder.join("a.mtl"), "newmtl m\nmap_Kd c.png\nmap_Ke b.png\n").unwrap(),
            |folder| fs::write(folder.join("b.png"), "no photo").unwrap(),
            |folder| fs::remove_file(folder.join("b.png")).unwrap(),
            |folder| fs::write(folder.join("c.png"), "").unwrap(),
            |folder| {
                fs::create_dir(folder.join("textures")).unwrap();
                fs::write(folder.join("textures/c.png"), "").unwrap();
            },
            // The same length and time as before.
            |folder| {
                let path = folder.join("b.png");
                let time = fs::metadata(&path).unwrap().modified().unwrap();
                fs::write(&path, "on image").unwrap();
                fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
            },
        ];
        for (number, change) in changes.into_iter().enumerate() {
            let folder = tempfile::tempdir().unwrap();
            let path = model(folder.path());
            let sources = file::read_with_sources(&path, &|_| ()).unwrap().1.expect("nothing changes");
            assert!(sources.are_of(&path) && !sources.are_of(&folder.path().join("b.obj")));
            change(folder.path());
            assert!(!sources.are_of(&path), "change {number}");
        }
    }

    #[test]
    fn a_model_that_changes_while_it_is_read_has_no_sources() {
        let folder = tempfile::tempdir().unwrap();
        let path = model(folder.path());
        let touch = |_: f32| fs::write(folder.path().join("b.png"), "another").unwrap();
        assert!(file::read_with_sources(&path, &touch).unwrap().1.is_none());
        // The clock has not gone on since the last change: another one might have the same time.
        assert!(file::read_with_sources(&path, &|_| ()).unwrap().1.is_none());
    }

    #[test]
    fn a_stamp_is_settled_once_the_file_s_clock_has_gone_on() {
        let at = |milliseconds| SystemTime::UNIX_EPOCH + Duration::from_millis(milliseconds);
        let fine = Stamp { n_bytes: 0, modified: Some((10, 5)), changed: Some((10, 3_000_000)), place: None };
        assert!(!fine.is_settled(at(10_000)) && !fine.is_settled(at(10_022)) && fine.is_settled(at(10_024)));
        let coarse = Stamp { modified: Some((10, 0)), changed: None, ..fine.clone() };
        assert!(!coarse.is_settled(at(11_900)) && coarse.is_settled(at(12_001)));
        assert!(!Stamp { modified: None, ..fine }.is_settled(at(99_000)));
    }
}
