//! A scene file that is given to other machines.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom},
    sync::{Mutex, PoisonError},
};

use shared::scene::SceneId;

use crate::scene_file::{file::SceneFile, head::Hash};

/// An open scene file, whose bytes may be read from any thread.
#[derive(Debug)]
pub struct TravellingFile {
    file: Mutex<File>,
    /// The scene that it holds.
    pub scene: SceneId,
    /// Its length.
    pub n_bytes: u64,
    /// Stands for all of it.
    pub hash: Hash,
}

impl TravellingFile {
    pub(crate) fn of(file: &SceneFile) -> io::Result<Self> {
        let (n_bytes, hash) = (file.head.n_bytes() as u64, file.head.hash);
        Ok(Self { file: Mutex::new(file.file().try_clone()?), scene: file.record.info.id, n_bytes, hash })
    }

    /// Fills `bytes` with those of the file from `first` on.
    ///
    /// # Errors
    /// The file has been cut, or its disk fails.
    pub fn read_at(&self, first: u64, bytes: &mut [u8]) -> io::Result<()> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(first))?;
        file.read_exact(bytes)
    }
}
