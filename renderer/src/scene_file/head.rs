//! The head of a scene file: which sections follow, and the checksums of all that follows.
//!
//! Numbers are little endian, as in memory. A head is the [`Prefix`], an [`Entry`] for each section, the BLAKE3 hash of each
//! [`CHUNK`] of the body, and the record. The body begins at the next page; in it each section begins a page, with zeros
//! between. The prefix holds a hash of the whole head, so this one hash stands for every byte of the file.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use crate::scene_file::{
    bytes::PAGE,
    fault::{Damage, Fault},
};

/// The first bytes of every scene file.
pub(crate) const MAGIC: [u8; 8] = *b"RAYWALL\0";

/// It changes with every change of what sections or records hold.
pub(crate) const VERSION: u32 = 15;

/// As this machine's memory holds it.
const BYTE_ORDER: u32 = 0x0403_0201;

/// Bytes of the body that have a hash of their own.
pub(crate) const CHUNK: usize = 1 << 20;

/// The longest record; a scene of 65,536 materials has a tenth of it.
pub(crate) const LONGEST_RECORD: usize = 1 << 26;

/// Most sections: each of 65,536 materials may have three textures and a mask of its own.
const MOST_SECTIONS: u64 = 1 << 19;

/// The longest body: no memory budget is larger. Its hashes take 32 MB.
const LONGEST_BODY: u64 = 1 << 40;

/// A BLAKE3 hash.
pub(crate) type Hash = [u8; blake3::OUT_LEN];

/// Bytes that tell the size of a file and of its head.
pub(crate) const PREFIX_BYTES: usize = size_of::<Prefix>();

/// The first bytes.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Prefix {
    magic: [u8; 8],
    byte_order: u32,
    version: u32,
    n_record_bytes: u64,
    n_body_bytes: u64,
    n_sections: u64,
    /// Of the head, with zeros in this place.
    hash: Hash,
}

/// A section's name and its place in the file.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Entry {
    /// With zeros behind it.
    name: [u8; 24],
    first: u64,
    n_bytes: u64,
}

/// Sizes, as a file's first bytes tell them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Extent {
    n_sections: usize,
    n_chunks: usize,
    /// Bytes of the head.
    pub(crate) n_head_bytes: usize,
    /// Bytes of the file.
    pub(crate) n_bytes: usize,
}

/// The head of a file.
#[derive(Clone, Debug)]
pub(crate) struct Head {
    entries: Vec<Entry>,
    hashes: Vec<Hash>,
    /// Names all that the sections hold and how they belong together.
    pub(crate) record: Vec<u8>,
    n_body_bytes: usize,
    /// Stands for every byte of the file.
    pub(crate) hash: Hash,
}

impl Extent {
    /// The extent of a file that begins like this.
    pub(crate) fn of(prefix: &[u8; PREFIX_BYTES]) -> Result<Self, Fault> {
        let prefix: Prefix = bytemuck::pod_read_unaligned(prefix);
        match prefix {
            Prefix { magic, .. } if magic != MAGIC => Err(Fault::NotASceneFile),
            Prefix { byte_order, .. } if byte_order != BYTE_ORDER => Err(Fault::ByteOrder),
            Prefix { version, .. } if version != VERSION => Err(Fault::Version(version)),
            _ => prefix.extent().ok_or(Fault::Damaged(Damage::Head)),
        }
    }
}

impl Prefix {
    /// `None` if no scene is so large.
    fn extent(&self) -> Option<Extent> {
        let [n_sections, n_body_bytes, n_record_bytes] =
            [self.n_sections, self.n_body_bytes, self.n_record_bytes].map(usize::try_from);
        let (n_sections, n_body_bytes, n_record_bytes) = (n_sections.ok()?, n_body_bytes.ok()?, n_record_bytes.ok()?);
        // Bounds what is allocated for a head: a file that is long may be empty.
        if self.n_sections > MOST_SECTIONS || self.n_body_bytes > LONGEST_BODY || n_record_bytes > LONGEST_RECORD {
            return None;
        }
        let n_chunks = n_body_bytes.div_ceil(CHUNK);
        let n_table_bytes = n_sections.checked_mul(size_of::<Entry>())?.checked_add(n_chunks * size_of::<Hash>())?;
        let n_head_bytes = PREFIX_BYTES.checked_add(n_table_bytes)?.checked_add(n_record_bytes)?;
        let n_bytes = n_head_bytes.checked_next_multiple_of(PAGE)?.checked_add(n_body_bytes)?;
        Some(Extent { n_sections, n_chunks, n_head_bytes, n_bytes })
    }
}

impl Head {
    /// The head of a file with these sections, in order, and this record.
    pub(crate) fn new(sections: &[(&str, &[u8])], record: Vec<u8>) -> Self {
        let mut at = 0;
        let place = |&(name, bytes): &(&str, &[u8])| {
            let first = at;
            at += bytes.len().next_multiple_of(PAGE);
            let mut entry = Entry { name: [0; 24], first: first as u64, n_bytes: bytes.len() as u64 };
            entry.name[..name.len()].copy_from_slice(name.as_bytes());
            entry
        };
        let entries: Vec<_> = sections.iter().map(place).collect();
        let n_body_bytes = at;
        let mut head = Self { entries, hashes: Vec::new(), record, n_body_bytes, hash: Hash::default() };
        head.hashes =
            (0..n_body_bytes.div_ceil(CHUNK)).into_par_iter().map(|chunk| head.hash_of(chunk, sections)).collect();
        // Places so far count from the body's beginning.
        let first_in_body = head.body().start as u64;
        head.entries.iter_mut().for_each(|entry| entry.first += first_in_body);
        head.hash = hash_of_head(&head.to_bytes());
        head
    }

    /// The hash of a chunk of the body that these sections make, whose places count from the body's beginning.
    fn hash_of(&self, chunk: usize, sections: &[(&str, &[u8])]) -> Hash {
        let mut hasher = blake3::Hasher::new();
        let (mut at, end) = (chunk * CHUNK, ((chunk + 1) * CHUNK).min(self.n_body_bytes));
        let after = self.entries.partition_point(|entry| entry.first as usize <= at);
        for (entry, (_, bytes)) in self.entries.iter().zip(sections).skip(after.saturating_sub(1)) {
            let (first, n_page_bytes) = (entry.first as usize, bytes.len().next_multiple_of(PAGE));
            let end = end.min(first + n_page_bytes);
            if at < end && first <= at {
                let of_section = &bytes[(at - first).min(bytes.len())..(end - first).min(bytes.len())];
                hasher.update(of_section);
                hasher.update(&ZEROS[..end - at - of_section.len()]);
                at = end;
            }
        }
        *hasher.finalize().as_bytes()
    }

    /// Reads the head of a file of `n_bytes` bytes from all bytes of the head.
    pub(crate) fn from_bytes(bytes: &[u8], n_bytes: u64) -> Result<Self, Fault> {
        let damaged = Fault::Damaged(Damage::Head);
        let Some(prefix) = bytes.first_chunk() else { return Err(Fault::NotASceneFile) };
        let extent = Extent::of(prefix)?;
        if extent.n_bytes as u64 != n_bytes {
            return Err(Fault::Damaged(Damage::Length { of_file: n_bytes, expected: extent.n_bytes as u64 }));
        }
        let Some(bytes) = bytes.get(..extent.n_head_bytes) else { return Err(damaged) };
        let Prefix { hash, n_body_bytes, .. } = bytemuck::pod_read_unaligned(prefix);
        if hash_of_head(bytes) != hash {
            return Err(damaged);
        }
        let (entries, rest) = bytes[PREFIX_BYTES..].split_at(extent.n_sections * size_of::<Entry>());
        let (hashes, record) = rest.split_at(extent.n_chunks * size_of::<Hash>());
        let entries = entries.chunks_exact(size_of::<Entry>()).map(bytemuck::pod_read_unaligned).collect();
        let hashes = hashes.as_chunks().0.to_vec();
        Ok(Self { entries, hashes, record: record.to_vec(), n_body_bytes: n_body_bytes as usize, hash })
    }

    /// The bytes of the head.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let prefix = Prefix {
            magic: MAGIC,
            byte_order: BYTE_ORDER,
            version: VERSION,
            n_record_bytes: self.record.len() as u64,
            n_body_bytes: self.n_body_bytes as u64,
            n_sections: self.entries.len() as u64,
            hash: self.hash,
        };
        let tables: [&[u8]; 2] = [bytemuck::cast_slice(&self.entries), self.hashes.as_flattened()];
        [bytemuck::bytes_of(&prefix), tables[0], tables[1], &self.record].concat()
    }

    /// The bytes of a file that the body takes.
    pub(crate) fn body(&self) -> Range<usize> {
        let n_table_bytes = size_of_val(&*self.entries) + self.n_body_bytes.div_ceil(CHUNK) * size_of::<Hash>();
        let first = (PREFIX_BYTES + n_table_bytes + self.record.len()).next_multiple_of(PAGE);
        first..first + self.n_body_bytes
    }

    /// The number of bytes of the file.
    pub(crate) fn n_bytes(&self) -> usize {
        self.body().end
    }

    /// The bytes of a file that hold the section of a number; `None` unless it has this name.
    pub(crate) fn section(&self, number: usize, name: &str) -> Option<Range<usize>> {
        let Entry { name: of_file, first, n_bytes } = self.entries.get(number)?;
        let (of_name, rest) = of_file.split_at_checked(name.len())?;
        let range = usize::try_from(*first).ok()?..usize::try_from(first.checked_add(*n_bytes)?).ok()?;
        let is_named = of_name == name.as_bytes() && rest.iter().all(|&byte| byte == 0);
        (is_named && range.start >= self.body().start && range.end <= self.body().end).then_some(range)
    }

    /// The number of sections.
    pub(crate) fn n_sections(&self) -> usize {
        self.entries.len()
    }

    /// The bytes of a file that a chunk takes; none behind the last.
    pub(crate) fn chunk(&self, number: usize) -> Range<usize> {
        let Range { start, end } = self.body();
        (start + number * CHUNK).min(end)..(start + (number + 1) * CHUNK).min(end)
    }

    /// The chunk that begins at a byte of the file, if one does.
    pub(crate) fn chunk_at(&self, first: u64) -> Option<usize> {
        let of_body = usize::try_from(first).ok()?.checked_sub(self.body().start)?;
        (of_body.is_multiple_of(CHUNK) && of_body / CHUNK < self.hashes.len()).then_some(of_body / CHUNK)
    }

    /// Whether these are the bytes of a chunk.
    pub(crate) fn is_chunk(&self, number: usize, bytes: &[u8]) -> bool {
        bytes.len() == self.chunk(number).len()
            && self.hashes.get(number).is_some_and(|hash| blake3::hash(bytes).as_bytes() == hash)
    }

    /// Compares the chunks of a file with their hashes, in parallel; `progress` receives the fraction done, from any thread.
    pub(crate) fn check_chunks(&self, file: &[u8], progress: &(dyn Fn(f32) + Sync)) -> Result<(), Fault> {
        let done = std::sync::atomic::AtomicUsize::new(0);
        let body = file.get(self.body()).ok_or(Fault::Damaged(Damage::Head))?;
        let is_wrong = |(chunk, hash): &(&[u8], &Hash)| {
            let is_wrong = blake3::hash(chunk).as_bytes() != *hash;
            progress((done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1) as f32 / self.hashes.len() as f32);
            is_wrong
        };
        match body.par_chunks(CHUNK).zip(&self.hashes).enumerate().find_any(|(_, chunk)| is_wrong(chunk)) {
            Some((chunk, _)) => Err(Fault::Damaged(Damage::Chunk(chunk))),
            None => Ok(()),
        }
    }

    /// The head of a file with hashes that fit its contents; `None` if its sizes do not.
    pub(crate) fn repaired(file: &[u8]) -> Option<Self> {
        let extent = Extent::of(file.first_chunk()?).ok()?;
        let mut bytes = file.get(..extent.n_head_bytes)?.to_vec();
        let fit = |bytes: &mut Vec<u8>| {
            let hash = hash_of_head(bytes);
            bytes[PREFIX_BYTES - size_of::<Hash>()..PREFIX_BYTES].copy_from_slice(&hash);
            Self::from_bytes(bytes, file.len() as u64).ok()
        };
        let mut head = fit(&mut bytes)?;
        head.hashes = file[head.body()].chunks(CHUNK).map(|chunk| *blake3::hash(chunk).as_bytes()).collect();
        fit(&mut head.to_bytes())
    }
}

/// Between sections.
pub(crate) const ZEROS: [u8; PAGE] = [0; PAGE];

fn hash_of_head(bytes: &[u8]) -> Hash {
    let before = PREFIX_BYTES - size_of::<Hash>();
    let mut hasher = blake3::Hasher::new();
    hasher.update(&bytes[..before]).update(&Hash::default()).update(&bytes[PREFIX_BYTES..]);
    *hasher.finalize().as_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file of these sections.
    fn file(sections: &[(&str, &[u8])]) -> Vec<u8> {
        let head = Head::new(sections, b"record".to_vec());
        let mut file = head.to_bytes();
        for (_, bytes) in sections {
            file.resize(file.len().next_multiple_of(PAGE), 0);
            file.extend(*bytes);
        }
        file.resize(file.len().next_multiple_of(PAGE), 0);
        file
    }

    fn read(file: &[u8]) -> Result<Head, Fault> {
        let head = Head::from_bytes(file, file.len() as u64)?;
        head.check_chunks(file, &|_| ())?;
        Ok(head)
    }

    #[test]
    fn sections_come_back_from_their_pages() {
        let long: Vec<u8> = (0..2 * CHUNK + 5000).map(|at| (at * at / 7) as u8).collect();
        let sections: [(&str, &[u8]); 5] =
            [("a", &[1; 3]), ("none", &[]), ("long", &long), ("page", &[3; PAGE]), ("vertices of a mesh", &[4; 9])];
        let file = file(&sections);
        let head = read(&file).unwrap();
        assert_eq!((head.n_sections(), head.n_bytes(), &*head.record), (5, file.len(), &b"record"[..]));
        for (number, (name, bytes)) in sections.into_iter().enumerate() {
            let range = head.section(number, name).unwrap();
            assert!(range.start.is_multiple_of(PAGE) && file[range] == *bytes, "{name}");
            assert!(head.section(number, "other").is_none() && head.section(number, "").is_none());
        }
    }

    #[test]
    fn any_changed_byte_and_any_other_length_is_found() {
        let sections: [(&str, &[u8]); 2] = [("a", &[1; 5]), ("b", &[2; 5000])];
        let whole = file(&sections);
        for at in (0..whole.len()).filter(|at| *at < 500 || at.is_multiple_of(37)) {
            let mut changed = whole.clone();
            changed[at] ^= 0x10;
            // Bytes between head and body belong to neither.
            let head = read(&whole).unwrap();
            let is_between = (head.to_bytes().len()..head.body().start).contains(&at);
            assert_eq!(read(&changed).is_ok(), is_between, "byte {at}");
        }
        for n in [0, 1, PREFIX_BYTES - 1, PREFIX_BYTES, PAGE, whole.len() - 1] {
            assert!(read(&whole[..n]).is_err(), "{n} bytes");
        }
        let longer = [&*whole, &[0]].concat();
        assert!(matches!(read(&longer), Err(Fault::Damaged(Damage::Length { .. }))));
    }

    #[test]
    fn files_of_others_are_told_apart() {
        let told = |change: fn(&mut Vec<u8>)| {
            let mut file = file(&[("a", &[1; 5])]);
            change(&mut file);
            read(&file).unwrap_err().to_string()
        };
        assert!(told(|file| file[0] = b'r').contains("is no scene file"));
        assert!(told(|file| file[8..12].reverse()).contains("byte order"));
        assert!(told(|file| file[12] = 99).contains("version 99"));
        // Sizes that no file has are refused before anything is allocated.
        for at in [16, 24, 32] {
            let mut file = file(&[("a", &[1; 5])]);
            file[at..at + 8].fill(0xff);
            assert!(read(&file).is_err(), "number at {at}");
        }
    }
}
