//! A scene file that arrives in chunks: each is checked before it is written, and what has arrived outlasts a cut.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom, Write},
    ops::Range,
    path::{Path, PathBuf},
};

use channel::files;
use rayon::prelude::*;

use crate::scene_file::{
    fault::{Damage, Fault},
    head::{CHUNK, Extent, Hash, Head, PREFIX_BYTES},
};

/// The beginning of a scene file, beside its place: the head, then chunks in order.
///
/// Invariant: its file holds the head, if that has arrived, and whole chunks that have the hashes in it.
pub(crate) struct Part {
    path: PathBuf,
    file: File,
    /// Bytes of the whole file.
    n_bytes: u64,
    /// The hash of the whole file.
    hash: Hash,
    /// The bytes of the head until it is whole.
    arrived: Vec<u8>,
    head: Option<Head>,
    /// Chunks that have arrived.
    n_chunks: usize,
}

impl Part {
    /// Goes on with the part of a file that has this length and hash, or begins one. Reads and checks all that has arrived,
    /// on the current rayon pool.
    ///
    /// # Errors
    /// The part cannot be read or written.
    pub(crate) fn resume(path: &Path, n_bytes: u64, hash: Hash) -> io::Result<Self> {
        let file = files::open_shared(path)?;
        let mut part =
            Self { path: path.to_owned(), file, n_bytes, hash, arrived: Vec::new(), head: None, n_chunks: 0 };
        if !part.take_back()? {
            (part.head, part.n_chunks) = (None, 0);
            part.file.set_len(0)?;
            part.file.seek(SeekFrom::Start(0))?;
        }
        Ok(part)
    }

    /// Takes the head and the right chunks of an earlier transfer; false if the part is of another file.
    fn take_back(&mut self) -> io::Result<bool> {
        let n_there = self.file.metadata()?.len();
        let mut prefix = [0; PREFIX_BYTES];
        if n_there < PREFIX_BYTES as u64 {
            return Ok(false);
        }
        self.file.read_exact(&mut prefix)?;
        let Ok(extent) = Extent::of(&prefix) else { return Ok(false) };
        if extent.n_bytes as u64 != self.n_bytes || n_there < extent.n_head_bytes as u64 {
            return Ok(false);
        }
        let mut bytes = prefix.to_vec();
        bytes.resize(extent.n_head_bytes, 0);
        self.file.read_exact(&mut bytes[PREFIX_BYTES..])?;
        let Some(head) = Head::from_bytes(&bytes, self.n_bytes).ok().filter(|head| head.hash == self.hash) else {
            return Ok(false);
        };
        let first = head.body().start as u64;
        self.file.seek(SeekFrom::Start(first))?;
        // Batches bound the memory, and let all threads hash.
        let mut batch = vec![0; 64 * CHUNK];
        loop {
            let n_read = read_up_to(&mut self.file, &mut batch)?;
            let chunks = batch[..n_read].par_chunks(CHUNK).enumerate();
            let first_of_batch = self.n_chunks;
            let wrong = chunks.filter(|(number, bytes)| !head.is_chunk(first_of_batch + number, bytes));
            let n_right = wrong.map(|(number, _)| number).min().unwrap_or(n_read.div_ceil(CHUNK));
            self.n_chunks += n_right;
            if n_right < batch.len() / CHUNK {
                break;
            }
        }
        let end = head.chunk(self.n_chunks).start;
        self.file.set_len(end as u64)?;
        self.file.seek(SeekFrom::Start(end as u64))?;
        self.head = Some(head);
        Ok(true)
    }

    /// The bytes of the file that are needed `n_asked` pieces from now; each piece is one call of [`Part::put`], and no more
    /// than a chunk. `None` if there are no more, or if it is not known yet: then ask for what comes first.
    pub(crate) fn needed(&self, n_asked: usize) -> Option<Range<u64>> {
        let range = match &self.head {
            Some(head) => head.chunk(self.n_chunks + n_asked),
            None if n_asked > 0 => return None,
            None => {
                let prefix = self.arrived.first_chunk();
                let n_head_bytes = prefix
                    .map_or(PREFIX_BYTES, |prefix| Extent::of(prefix).expect("checked as it arrived").n_head_bytes);
                self.arrived.len()..n_head_bytes.min(self.arrived.len() + CHUNK)
            }
        };
        (!range.is_empty()).then_some(range.start as u64..range.end as u64)
    }

    /// Bytes that have arrived, of the whole file's.
    pub(crate) fn n_done(&self) -> u64 {
        self.head.as_ref().map_or(self.arrived.len(), |head| head.chunk(self.n_chunks).start) as u64
    }

    /// Takes the bytes that are needed next, all of them.
    ///
    /// # Errors
    /// They are not those of this file, or the disk does not take them; what had arrived before stays.
    pub(crate) fn put(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        if let Some(head) = &self.head {
            if !head.is_chunk(self.n_chunks, bytes) {
                return Err(Damage::Chunk(self.n_chunks).into());
            }
            self.file.write_all(bytes)?;
            self.n_chunks += 1;
            return Ok(());
        }
        self.arrived.extend_from_slice(bytes);
        let Some(prefix) = self.arrived.first_chunk() else { return Err(Fault::NotASceneFile) };
        let extent = Extent::of(prefix)?;
        if extent.n_bytes as u64 != self.n_bytes {
            return Err(Damage::Length { of_file: self.n_bytes, expected: extent.n_bytes as u64 }.into());
        }
        if self.arrived.len() >= extent.n_head_bytes {
            let head = Head::from_bytes(&self.arrived, self.n_bytes)?;
            if head.hash != self.hash {
                return Err(Damage::Head.into());
            }
            // The body begins at a page.
            self.arrived.resize(head.body().start, 0);
            self.file.write_all(&self.arrived)?;
            (self.arrived, self.head) = (Vec::new(), Some(head));
        }
        Ok(())
    }

    /// Gives the whole file its place.
    ///
    /// # Errors
    /// Bytes are missing, or the folder cannot be written.
    pub(crate) fn finish(self, place: &Path) -> io::Result<()> {
        if self.head.is_none() || self.needed(0).is_some() {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        files::give_place(&self.path, place)
    }
}

/// Fills as much of a buffer as a file has.
fn read_up_to(file: &mut File, buffer: &mut [u8]) -> io::Result<usize> {
    let mut n_read = 0;
    while n_read < buffer.len() {
        match file.read(&mut buffer[n_read..])? {
            0 => break,
            n => n_read += n,
        }
    }
    Ok(n_read)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_file::head::ZEROS;

    /// A file of some chunks, and its hash.
    fn scene_file() -> (Vec<u8>, Hash) {
        let long: Vec<u8> = (0..5 * CHUNK + 5000).map(|at| (at * at / 7) as u8).collect();
        let head = Head::new(&[("long", &long)], b"record".to_vec());
        let mut file = head.to_bytes();
        file.resize(head.body().start, 0);
        file.extend(long);
        file.resize(file.len().next_multiple_of(ZEROS.len()), 0);
        (file, head.hash)
    }

    /// Puts up to `most` pieces of a file.
    fn put(part: &mut Part, file: &[u8], most: usize) -> usize {
        let mut n_put = 0;
        while n_put < most
            && let Some(range) = part.needed(0)
        {
            part.put(&file[range.start as usize..range.end as usize]).unwrap();
            n_put += 1;
        }
        n_put
    }

    #[test]
    fn a_file_arrives_as_it_is_and_a_cut_costs_no_chunk_that_was_there() {
        let folder = tempfile::tempdir().unwrap();
        let [path, place] = ["a.fetch", "a.raywall"].map(|name| folder.path().join(name));
        let (file, hash) = scene_file();
        let resume = || Part::resume(&path, file.len() as u64, hash).unwrap();
        // The prefix, the rest of the head, and two chunks.
        let mut first = resume();
        assert_eq!(put(&mut first, &file, 4), 4);
        drop(first);
        // A power cut may leave the beginning of a chunk, and a disk may lose one.
        File::options().append(true).open(&path).unwrap().write_all(&file[..1000]).unwrap();
        let mut second = resume();
        // The last of six chunks is two pages.
        assert_eq!(second.n_done() as usize, file.len() - 3 * CHUNK - 2 * ZEROS.len());
        assert!(resume().finish(&place).is_err() && !place.exists());
        assert_eq!(put(&mut second, &file, 100), 4);
        second.finish(&place).unwrap();
        assert!(std::fs::read(&place).unwrap() == file && !path.exists());
        // A part of another file, or of this one with another length, is of no use.
        std::fs::copy(&place, &path).unwrap();
        assert_eq!(resume().n_done(), file.len() as u64);
        assert_eq!(Part::resume(&path, file.len() as u64, [1; 32]).unwrap().n_done(), 0);
        std::fs::write(&path, [7; 10_000]).unwrap();
        let mut anew = resume();
        put(&mut anew, &file, 100);
        anew.finish(&place).unwrap();
        assert!(std::fs::read(&place).unwrap() == file, "bytes of the other file are left");
        std::fs::copy(&place, &path).unwrap();
        let changed = File::options().write(true).open(&path).unwrap();
        std::os::unix::fs::FileExt::write_at(&changed, b"x", file.len() as u64 - 3 * CHUNK as u64).unwrap();
        let n_kept = resume().n_done();
        assert!((1..4 * CHUNK as u64).contains(&n_kept), "{n_kept}");
    }

    #[test]
    fn wrong_bytes_are_refused_and_never_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.fetch");
        let (file, hash) = scene_file();
        let resume = || Part::resume(&path, file.len() as u64, hash).unwrap();
        for n_right in 0..4 {
            let part = resume();
            part.file.set_len(0).unwrap();
            let mut part = resume();
            put(&mut part, &file, n_right);
            let (n_done, range) = (part.n_done(), part.needed(0).unwrap());
            let mut bytes = file[range.start as usize..range.end as usize].to_vec();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 4;
            let is_refused = part.put(&bytes).is_err() || part.put(&file[PREFIX_BYTES..][..n_right]).is_err();
            assert!(is_refused, "piece {n_right}");
            drop(part);
            assert!(resume().n_done() <= n_done);
        }
        // Another file than the one that was offered.
        let mut other = Part::resume(&path, file.len() as u64, [1; 32]).unwrap();
        put(&mut other, &file, 1);
        assert!(other.put(&file[PREFIX_BYTES..other.needed(0).unwrap().end as usize]).is_err());
    }
}
