//! Memory in temporary files, in which a model is built that takes more memory than a program may.
//!
//! While a [`Spill`] lasts, every large block that the program allocates is a file without a name, reserved on the disk and
//! mapped. A watcher gives its pages back to the system when the program holds too many; they stay in the file, and come
//! back where they are used again. So sorting, ordering and measuring a mesh need no second version for models that do not
//! fit: they read and write mostly one part after the other, which disks do well.
//!
//! Nothing here allocates where the allocator calls it.

use std::{
    alloc::Layout,
    fs::{self, File},
    io,
    os::fd::{AsRawFd, FromRawFd},
    path::Path,
    ptr,
    sync::{
        atomic::{AtomicI32, AtomicU32, AtomicUsize, Ordering::SeqCst},
        mpsc::{self, RecvTimeoutError},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use shared::printable::counted;

/// Smaller blocks stay in memory: each file takes an entry of the system's tables.
const LEAST_BYTES: usize = 1 << 20;

/// Most blocks at a time: below the 65,530 mappings that Linux allows a process.
const MOST_BLOCKS: usize = 1 << 14;

/// The watcher gives so much back at once, in a few milliseconds.
const PIECE_BYTES: usize = 1 << 25;

/// Blocks begin at multiples of it.
const PAGE: usize = 4096;

/// How often the watcher looks: pages that the system still has come back sixteen at a time, up to 60 GB a second.
const WATCH_INTERVAL: Duration = Duration::from_millis(2);

/// File systems in memory, by the numbers of their kinds: tmpfs and ramfs.
const IN_MEMORY: [i64; 2] = [0x0102_1994, 0x8584_58f6];

/// The folder of the files, open, while a spill lasts; else −1.
static FOLDER: AtomicI32 = AtomicI32::new(-1);

/// Blocks that the disk had no room for.
static N_REFUSED: AtomicU32 = AtomicU32::new(0);

static BLOCKS: [Block; MOST_BLOCKS] =
    [const { Block { address: AtomicUsize::new(0), n_bytes: AtomicUsize::new(0) } }; MOST_BLOCKS];

/// A block, or none.
struct Block {
    /// 0 for none, [`TAKEN`] while a block is made or released; the lowest bit is set while its pages are given back.
    address: AtomicUsize,
    n_bytes: AtomicUsize,
}

/// No address: blocks begin at multiples of a page.
const TAKEN: usize = 2;

/// Set in the address of a block that must stay for a moment.
const BUSY: usize = 1;

impl Block {
    /// Gives pages of the block, if there is one, back to the system: a piece from a byte on, a multiple of a page. They stay
    /// in the file. Returns where the piece ends, if more of the block follows.
    fn give_back(&self, from: usize) -> Option<usize> {
        let address = self.address.load(SeqCst);
        let is_block = address > TAKEN && address & BUSY == 0;
        if !is_block || self.address.compare_exchange(address, address | BUSY, SeqCst, SeqCst).is_err() {
            return None;
        }
        let n_left = self.n_bytes.load(SeqCst).saturating_sub(from);
        let n_bytes = n_left.min(PIECE_BYTES);
        // SAFETY: the block is mapped until it is no longer busy, shared with its file, which keeps its contents.
        unsafe { libc::madvise((address + from) as *mut libc::c_void, n_bytes, libc::MADV_DONTNEED) };
        self.address.store(address, SeqCst);
        (n_bytes < n_left).then_some(from + n_bytes)
    }
}

/// A zeroed block in a file; null if no spill lasts, the block is small, or there is no room.
#[inline]
pub(super) fn allocate(layout: Layout) -> *mut u8 {
    let folder = FOLDER.load(SeqCst);
    if folder < 0 || layout.size() < LEAST_BYTES || layout.align() > PAGE {
        return ptr::null_mut();
    }
    allocate_in(folder, layout.size())
}

#[cold]
fn allocate_in(folder: i32, n_bytes: usize) -> *mut u8 {
    let is_free = |block: &&Block| block.address.compare_exchange(0, TAKEN, SeqCst, SeqCst).is_ok();
    let Some(block) = BLOCKS.iter().find(is_free) else { return ptr::null_mut() };
    let address = temporary_file(folder).ok().and_then(|file| map(&file, n_bytes));
    if address.is_none() {
        N_REFUSED.fetch_add(1, SeqCst);
    }
    block.n_bytes.store(n_bytes, SeqCst);
    block.address.store(address.unwrap_or(0), SeqCst);
    address.unwrap_or(0) as *mut u8
}

/// A file without a name, which goes with its last mapping.
fn temporary_file(folder: i32) -> io::Result<File> {
    let flags = libc::O_TMPFILE | libc::O_RDWR | libc::O_CLOEXEC;
    // SAFETY: the path ends with a zero; the folder is open, or the call fails.
    let descriptor = unsafe { libc::openat(folder, c".".as_ptr(), flags, 0o600) };
    if descriptor < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: nobody else has this descriptor.
    Ok(unsafe { File::from_raw_fd(descriptor) })
}

/// The address of a file that is extended to so many bytes, all of them reserved: a page without a place on the disk would
/// end the process when it is written.
fn map(file: &File, n_bytes: usize) -> Option<usize> {
    let descriptor = file.as_raw_fd();
    // SAFETY: the file is open; the system chooses where no other memory is.
    let address = unsafe {
        if libc::fallocate(descriptor, 0, 0, libc::off_t::try_from(n_bytes).ok()?) != 0 {
            return None;
        }
        libc::mmap(ptr::null_mut(), n_bytes, libc::PROT_READ | libc::PROT_WRITE, libc::MAP_SHARED, descriptor, 0)
    };
    (address != libc::MAP_FAILED).then_some(address as usize)
}

/// Whether memory of this size at this address is a block.
#[inline]
pub(super) fn is_block(pointer: *mut u8, n_bytes: usize) -> bool {
    n_bytes >= LEAST_BYTES && (pointer as usize).is_multiple_of(PAGE) && find(pointer).is_some()
}

/// Whether new memory of this size is a block, as far as there is room.
#[inline]
pub(super) fn takes(n_bytes: usize) -> bool {
    n_bytes >= LEAST_BYTES && FOLDER.load(SeqCst) >= 0
}

#[cold]
fn find(pointer: *mut u8) -> Option<&'static Block> {
    BLOCKS.iter().find(|block| block.address.load(SeqCst) & !BUSY == pointer as usize)
}

/// Releases memory that is a block of this size.
///
/// # Safety
///
/// Nobody uses the memory any more.
#[cold]
pub(super) unsafe fn release(pointer: *mut u8, n_bytes: usize) {
    let Some(block) = find(pointer) else { return };
    while block.address.compare_exchange(pointer as usize, TAKEN, SeqCst, SeqCst).is_err() {
        thread::yield_now();
    }
    // SAFETY: the caller's; the block's pages are not being given back.
    unsafe { libc::munmap(pointer.cast(), n_bytes) };
    block.address.store(0, SeqCst);
}

/// While it lasts, large blocks of memory are temporary files. At most one lasts at a time.
#[derive(Debug)]
pub struct Spill {
    _folder: File,
    /// Its end ends the watcher.
    end: Option<mpsc::Sender<()>>,
    watcher: Option<JoinHandle<()>>,
}

impl Spill {
    /// Begins with files in this folder, and keeps the program within about so many bytes of memory, as far as its small
    /// blocks allow.
    ///
    /// # Errors
    /// The folder is in memory itself, its disk is full or takes no files without names, or another spill lasts.
    pub fn begin(folder: &Path, most_bytes: u64) -> io::Result<Self> {
        let opened = File::open(folder)?;
        if IN_MEMORY.contains(&(rustix::fs::fstatfs(&opened)?.f_type as i64)) {
            return Err(io::Error::other("it is in memory itself"));
        }
        let tried = temporary_file(opened.as_raw_fd())?;
        // SAFETY: the file is open.
        if unsafe { libc::fallocate(tried.as_raw_fd(), 0, 0, LEAST_BYTES as libc::off_t) } != 0 {
            return Err(io::Error::last_os_error());
        }
        if FOLDER.compare_exchange(-1, opened.as_raw_fd(), SeqCst, SeqCst).is_err() {
            return Err(io::Error::other("another model is being built in temporary files"));
        }
        let (end, ended) = mpsc::channel::<()>();
        let watch = move || {
            let mut hand = Hand::default();
            while ended.recv_timeout(WATCH_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                hand.give_back_near(most_bytes);
            }
        };
        let watcher = thread::Builder::new().name("spill".to_owned()).spawn(watch);
        // Without a watcher, the system alone decides which pages stay.
        Ok(Self { _folder: opened, end: Some(end), watcher: watcher.ok() })
    }
}

impl Drop for Spill {
    fn drop(&mut self) {
        FOLDER.store(-1, SeqCst);
        self.end = None;
        // A panic has been told of.
        let _ = self.watcher.take().map(JoinHandle::join);
        let n_refused = N_REFUSED.swap(0, SeqCst);
        if n_refused > 0 {
            tracing::warn!(
                "{} did not fit on the disk of temporary files and stayed in memory: free some of that disk",
                counted(n_refused, "large block")
            );
        }
    }
}

/// The hand of a clock that goes round all blocks (Corbató, "A Paging Experiment with the Multics System", 1969), without the
/// bits that tell what was used: what is needed comes back from the system's cache in microseconds.
#[derive(Default)]
struct Hand {
    block: usize,
    /// The next byte of it.
    from: usize,
}

impl Hand {
    /// Gives pieces of blocks back until the program holds five eighths of so many bytes, if it holds three quarters: more come
    /// while they go.
    fn give_back_near(&mut self, most_bytes: u64) {
        let is_above = |n_bytes: u64| resident_bytes().is_some_and(|held| held > n_bytes);
        if !is_above(most_bytes / 4 * 3) {
            return;
        }
        let mut n_passed = 0;
        while n_passed < MOST_BLOCKS {
            let block = &BLOCKS[self.block];
            let is_there = block.address.load(SeqCst) > TAKEN;
            match block.give_back(self.from) {
                Some(next) => self.from = next,
                None => {
                    *self = Self { block: (self.block + 1) % MOST_BLOCKS, from: 0 };
                    n_passed += 1;
                }
            }
            if is_there && !is_above(most_bytes / 8 * 5) {
                break;
            }
        }
    }
}

/// Bytes that the program holds in memory, in files too.
fn resident_bytes() -> Option<u64> {
    let counts = fs::read_to_string("/proc/self/statm").ok()?;
    Some(counts.split(' ').nth(1)?.parse::<u64>().ok()? * PAGE as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_keep_their_contents_while_their_pages_are_given_back() {
        // A disk, unlike the folder for temporary files on many machines.
        let folder = std::env::current_exe().unwrap().parent().unwrap().to_owned();
        let spill = match Spill::begin(&folder, 1) {
            Ok(spill) => spill,
            Err(error) => return println!("skipped: {}: {error}", folder.display()),
        };
        assert!(Spill::begin(&folder, 1).is_err(), "one at a time");
        let n_bytes = 5 * LEAST_BYTES + 7;
        let layout = Layout::from_size_align(n_bytes, 64).unwrap();
        assert!(allocate(Layout::from_size_align(LEAST_BYTES - 1, 1).unwrap()).is_null());
        let blocks = [0u8, 1].map(|nth| (nth, allocate(layout)));
        for (nth, pointer) in blocks {
            assert!(is_block(pointer, n_bytes) && !is_block(pointer.wrapping_add(PAGE), n_bytes));
            // SAFETY: the block has so many bytes, and nobody else has it.
            let bytes = unsafe { std::slice::from_raw_parts_mut(pointer, n_bytes) };
            assert!(bytes.iter().all(|&byte| byte == 0));
            for round in 0..20u8 {
                bytes.iter_mut().enumerate().for_each(|(at, byte)| *byte = (at as u8) ^ nth ^ round);
                thread::sleep(Duration::from_millis(5));
                BLOCKS.iter().for_each(|block| _ = block.give_back(0));
                assert!(bytes.iter().enumerate().all(|(at, &byte)| byte == (at as u8) ^ nth ^ round));
            }
        }
        drop(spill);
        assert!(allocate(layout).is_null() && blocks.iter().all(|&(_, pointer)| is_block(pointer, n_bytes)));
        for (_, pointer) in blocks {
            // SAFETY: nothing uses the block.
            unsafe { release(pointer, n_bytes) };
            assert!(!is_block(pointer, n_bytes));
        }
    }

    #[test]
    fn a_folder_in_memory_or_that_is_none_takes_no_files() {
        for folder in ["/dev/shm", "/proc", "/nowhere"] {
            assert!(Spill::begin(Path::new(folder), 1).is_err(), "{folder}");
        }
    }
}
