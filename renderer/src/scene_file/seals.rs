//! Seals: this user has written or checked this very file on this machine, so that it need not be checked again.
//!
//! A seal is an empty file in the cache. Its name is a hash of the sealed file's number, length, times and hash.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
    thread,
    time::{Duration, SystemTime},
};

use channel::files;
use shared::codec;

use crate::{formats::sources::Stamp, scene_file::head::Hash};

/// More seals than this are of files that are gone.
const MOST: usize = 1000;

/// The seals in a folder.
#[derive(Clone, Debug)]
pub(crate) struct Seals {
    folder: PathBuf,
}

impl Seals {
    pub(crate) fn new(folder: PathBuf) -> Self {
        Self { folder }
    }

    /// Whether a file with this stamp and hash is sealed.
    pub(crate) fn has(&self, stamp: &Stamp, hash: &Hash) -> bool {
        self.path(stamp, hash).is_file()
    }

    /// Seals a file that is known to be sound, once it is on the disk for good: after a power cut, a file may have its
    /// length and times without its contents. Takes as long as the disk.
    ///
    /// # Errors
    /// The disk fails, or the seal cannot be written.
    pub(crate) fn seal(&self, file: &File, stamp: &Stamp, hash: &Hash) -> io::Result<()> {
        file.sync_all()?;
        // A change from now on must give another stamp.
        while !stamp.is_settled(SystemTime::now()) {
            thread::sleep(Duration::from_millis(10));
        }
        if Stamp::of(&file.metadata()?) != *stamp {
            return Err(io::Error::other("it has just changed"));
        }
        self.drop_oldest();
        match files::write_new_private(&self.path(stamp, hash), &[]) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
            written => written,
        }
    }

    /// Removes all seals.
    pub(crate) fn clear(&self) {
        entries(&self.folder).for_each(|(path, _)| drop(fs::remove_file(path)));
    }

    fn path(&self, stamp: &Stamp, hash: &Hash) -> PathBuf {
        let sealed = blake3::hash(&codec::to_bytes(&(stamp, hash)));
        self.folder.join(sealed.to_hex().as_str())
    }

    fn drop_oldest(&self) {
        let mut seals: Vec<_> = entries(&self.folder).collect();
        seals.sort_by_key(|(_, written_at)| *written_at);
        let n_old = (seals.len() + 1).saturating_sub(MOST);
        seals.iter().take(n_old).for_each(|(path, _)| drop(fs::remove_file(path)));
    }
}

fn entries(folder: &Path) -> impl Iterator<Item = (PathBuf, SystemTime)> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| Some((entry.path(), entry.metadata().ok()?.modified().ok()?)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_change_of_a_file_breaks_its_seal() {
        let folder = tempfile::tempdir().unwrap();
        let (seals, path) = (Seals::new(folder.path().to_owned()), folder.path().join("scene"));
        fs::write(&path, "content").unwrap();
        let (hash, stamp) = ([1; 32], || Stamp::at(&path).unwrap());
        let file = File::open(&path).unwrap();
        let old = stamp();
        seals.seal(&file, &old, &hash).unwrap();
        seals.seal(&file, &old, &hash).unwrap();
        assert!(seals.has(&stamp(), &hash) && !seals.has(&stamp(), &[2; 32]));
        // The same length and time, and the same bytes: only the system knows.
        let time = fs::metadata(&path).unwrap().modified().unwrap();
        fs::write(&path, "content").unwrap();
        File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
        assert!(!seals.has(&stamp(), &hash));
        assert!(seals.seal(&file, &old, &hash).is_err(), "the file is another than the one that was checked");
        seals.clear();
        assert!(!seals.has(&old, &hash));
    }
}
