//! A scene file that is given to other machines.

use std::{
    fs::File,
    io::{Read, Seek, SeekFrom},
    path::PathBuf,
    sync::{Mutex, PoisonError},
};

use shared::scene::SceneId;

use crate::scene_file::{
    fault::{Damage, Fault},
    file::SceneFile,
    head::{Hash, Head},
};

/// An open scene file, whose bytes may be read from any thread.
#[derive(Debug)]
pub struct TravellingFile {
    file: Mutex<File>,
    head: Head,
    /// Its path, if it is in the cache.
    cached: Option<PathBuf>,
    /// The scene that it holds.
    pub scene: SceneId,
    /// Its length.
    pub n_bytes: u64,
    /// Stands for all of it.
    pub hash: Hash,
}

impl TravellingFile {
    /// An open file, and its path if it is in the cache.
    pub(crate) fn new(opened: SceneFile, cached: Option<PathBuf>) -> Result<Self, Fault> {
        let file = Mutex::new(opened.file().try_clone()?);
        let (scene, head) = (opened.record.info.id, opened.head);
        Ok(Self { file, scene, n_bytes: head.n_bytes() as u64, hash: head.hash, head, cached })
    }

    /// Fills `bytes` with those of the file from `first` on. Whole chunks are checked.
    ///
    /// # Errors
    /// The file has been cut or changed, or its disk fails. If it is in the cache, it is removed from there.
    pub fn read_at(&self, first: u64, bytes: &mut [u8]) -> Result<(), Fault> {
        let read = self.read_checked(first, bytes);
        if let (Err(_), Some(path)) = (&read, &self.cached) {
            // Another may have removed it already.
            let _ = std::fs::remove_file(path);
        }
        read
    }

    fn read_checked(&self, first: u64, bytes: &mut [u8]) -> Result<(), Fault> {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(first))?;
        file.read_exact(bytes)?;
        drop(file);
        match self.head.chunk_at(first) {
            Some(number) if self.head.chunk(number).len() == bytes.len() && !self.head.is_chunk(number, bytes) => {
                Err(Damage::Chunk(number).into())
            }
            _ => Ok(()),
        }
    }
}
