//! The bytes of a scene file.

use std::{
    fmt,
    fs::File,
    io::{self, Read},
    ops::Deref,
    sync::Once,
};

use bytemuck::{Pod, Zeroable};
use memmap2::Mmap;

/// Bytes of a page: sections begin at multiples of it.
pub(crate) const PAGE: usize = 4096;

/// A whole file, mapped or read. Its first byte lies at the beginning of a page.
pub(crate) enum FileBytes {
    /// Shared with all processes that map the file, and read by the system as it is needed.
    Mapped(Mmap),
    /// In memory of its own.
    Read { pages: Vec<Page>, n_bytes: usize },
}

/// Has a process say why it ends when a file that it has mapped is cut, or its disk fails: the system ends it by a signal.
fn tell_of_lost_pages() {
    #[cfg(unix)]
    {
        extern "C" fn tell(_signal: libc::c_int) {
            const LINE: &[u8] = b"error: a scene file was cut while it was in use, or its disk fails: \
                start the program again, which checks the file\n";
            // SAFETY: a signal handler may call `write`, which reads no more than the line.
            unsafe { libc::write(libc::STDERR_FILENO, LINE.as_ptr().cast(), LINE.len()) };
        }
        static ONCE: Once = Once::new();
        ONCE.call_once(|| {
            // SAFETY: all zeros are an action, whose other fields are set here. The handler makes one call that handlers may
            // make. It runs once; the load that failed is then tried again, and its signal ends the process.
            unsafe {
                let mut action: libc::sigaction = std::mem::zeroed();
                action.sa_sigaction = tell as extern "C" fn(libc::c_int) as libc::sighandler_t;
                action.sa_flags = libc::SA_RESETHAND;
                libc::sigaction(libc::SIGBUS, &action, std::ptr::null_mut());
            }
        });
    }
}

/// A page of memory.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(4096))]
pub(crate) struct Page([u8; PAGE]);

impl FileBytes {
    /// Maps a file that nobody changes: one that changes under its readers changes what they have checked.
    ///
    /// # Errors
    /// The system cannot map it.
    pub(crate) fn map(file: &File) -> io::Result<Self> {
        tell_of_lost_pages();
        // SAFETY: scene files are written beside their names and renamed when they are whole; nobody but this user may
        // write those that are mapped, which lie on the disk of this user's cache. If one is cut nevertheless, the system ends the process by a signal.
        Ok(Self::Mapped(unsafe { Mmap::map(file)? }))
    }

    /// Reads a file of `n_bytes` bytes, which may be a file that others may write.
    ///
    /// # Errors
    /// The file cannot be read, or is shorter.
    pub(crate) fn read(mut file: impl Read, n_bytes: usize) -> io::Result<Self> {
        let mut pages = vec![Page::zeroed(); n_bytes.div_ceil(PAGE)];
        file.read_exact(&mut bytemuck::cast_slice_mut(&mut pages)[..n_bytes])?;
        Ok(Self::Read { pages, n_bytes })
    }

    /// A file in memory.
    pub(crate) fn copy(bytes: &[u8]) -> Self {
        Self::read(bytes, bytes.len()).expect("a slice has as many bytes as it has")
    }
}

impl Deref for FileBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::Read { pages, n_bytes } => &bytemuck::cast_slice(pages)[..*n_bytes],
        }
    }
}

impl fmt::Debug for FileBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let how = if matches!(self, Self::Mapped(_)) { "mapped" } else { "read" };
        write!(f, "{} bytes, {how}", self.len())
    }
}
