//! Ends a program that runs out of memory with one line and status 1; Rust's own end is an abort without a cure. Large blocks
//! have huge pages. Models that take more memory than they may are built in [`spill`].

#[cfg_attr(not(target_os = "linux"), path = "memory/no_spill.rs")]
pub mod spill;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    io::{Cursor, Write},
    process, ptr,
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    thread,
    time::Duration,
};

thread_local! {
    /// Whether this thread's code handles an allocation that fails.
    static HANDLES_FAILURE: Cell<bool> = const { Cell::new(false) };
}

/// Whether some thread is ending the program.
static IS_ENDING: AtomicBool = AtomicBool::new(false);

/// How long other threads that run out of memory wait for the end.
const LONGEST_END: Duration = Duration::from_secs(5);

/// Blocks from this size on have huge pages: the faults of small ones are up to half of the time that a model takes to load,
/// most of all on virtual machines.
const LEAST_OF_HUGE_PAGES: usize = 1 << 22;

/// The system's allocator, for the `#[global_allocator]` of a program. When memory runs out, it prints the cure and ends
/// the program; while a [`spill::Spill`] lasts, it takes large blocks from there.
///
/// Meshes, grids, messages, pictures and their libraries allocate in hundreds of places, so the failure is handled in the
/// one place that all of them pass. The hook of the standard library for this is not stable.
#[derive(Debug)]
pub struct EndingAllocator;

// SAFETY: every call goes to the system's allocator unchanged, or to `spill`, whose blocks are zeroed, lie at the beginning of a
// page and go back there. A pointer comes from one of them, or the program has ended. Advice changes no contents. Nothing here
// allocates or unwinds.
unsafe impl GlobalAlloc for EndingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let block = spill::allocate(layout);
        if !block.is_null() {
            return block;
        }
        // SAFETY: the caller's promises are those of `System`.
        finished(unsafe { System.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        let block = spill::allocate(layout);
        if !block.is_null() {
            return block;
        }
        // SAFETY: as above.
        finished(unsafe { System.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, n_bytes: usize) -> *mut u8 {
        if !spill::is_block(pointer, layout.size()) && !spill::takes(n_bytes) {
            // SAFETY: as above.
            return finished(unsafe { System.realloc(pointer, layout, n_bytes) }, n_bytes);
        }
        // Move the contents: from a block, into one, or both.
        // SAFETY: the caller's; the new memory is another, of so many bytes.
        unsafe {
            let moved = self.alloc(Layout::from_size_align_unchecked(n_bytes, layout.align()));
            if !moved.is_null() {
                ptr::copy_nonoverlapping(pointer, moved, layout.size().min(n_bytes));
                self.dealloc(pointer, layout);
            }
            moved
        }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe {
            if spill::is_block(pointer, layout.size()) {
                spill::release(pointer, layout.size());
            } else {
                System.dealloc(pointer, layout);
            }
        }
    }
}

/// Runs code that handles a failed allocation itself: the program goes on.
pub(crate) fn handling_failure<T>(allocate: impl FnOnce() -> T) -> T {
    HANDLES_FAILURE.set(true);
    let allocated = allocate();
    HANDLES_FAILURE.set(false);
    allocated
}

/// Has threads share one arena for small blocks, before they begin. Each of their own would take 64 MB of addresses, most of
/// which it never uses: too many where `ulimit -v` limits them.
pub fn share_one_arena() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: the C library takes the number, or leaves its arenas as they are.
    unsafe {
        libc::mallopt(libc::M_ARENA_MAX, 1);
    }
}

/// A block of the system, with huge pages if it is large; the end of the program if there is none.
#[inline]
fn finished(pointer: *mut u8, n_bytes: usize) -> *mut u8 {
    if pointer.is_null() && !HANDLES_FAILURE.get() {
        end(n_bytes);
    }
    if n_bytes >= LEAST_OF_HUGE_PAGES && !pointer.is_null() {
        ask_for_huge_pages(pointer);
    }
    pointer
}

/// Asks for huge pages. Where the system has none, the block keeps small ones.
///
/// The advice covers all pages of the block: of parts with and without it the system makes two mappings, and then cannot move
/// the block where it grows.
#[cfg(target_os = "linux")]
#[cold]
fn ask_for_huge_pages(block: *mut u8) {
    const PAGE: usize = 4096;
    let first = block as usize / PAGE * PAGE;
    // SAFETY: the block comes from the C library, which knows its end; the pages keep their contents.
    unsafe {
        let end = block as usize + libc::malloc_usable_size(block.cast());
        libc::madvise(first as *mut libc::c_void, end - first, libc::MADV_HUGEPAGE);
    }
}

#[cfg(not(target_os = "linux"))]
fn ask_for_huge_pages(_: *mut u8) {}

#[cold]
fn end(n_bytes: usize) -> ! {
    // Tracing threads may fail together: one prints the line. If the end itself needs memory, it is an abort after all.
    if IS_ENDING.swap(true, Relaxed) {
        thread::sleep(LONGEST_END);
        process::abort();
    }
    let mut line = [0; 256];
    let mut cursor = Cursor::new(&mut line[..]);
    // The line fits, and nothing can be done if standard error is closed.
    let _ = write_line(&mut cursor, n_bytes);
    let n_written = cursor.position() as usize;
    let _ = std::io::stderr().write_all(&line[..n_written]);
    process::exit(1);
}

fn write_line(out: &mut impl Write, n_bytes: usize) -> std::io::Result<()> {
    let (amount, unit) = if n_bytes < 1_000_000 { (n_bytes, "bytes") } else { (n_bytes / 1_000_000, "MB") };
    writeln!(
        out,
        "error: memory ran out: the system has no {amount} {unit} more. Lower --memory-budget, show a model of fewer \
         triangles, or use a machine with more memory"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_names_the_amount_and_the_cure_and_fits() {
        for (n_bytes, amount) in [(999, " 999 bytes "), (2_500_000, " 2 MB "), (usize::MAX, " 18446744073709 MB ")] {
            let mut line = [0; 256];
            let mut cursor = Cursor::new(&mut line[..]);
            write_line(&mut cursor, n_bytes).unwrap();
            let n_written = cursor.position() as usize;
            let line = str::from_utf8(&line[..n_written]).unwrap();
            assert!(line.contains(amount) && line.contains("--memory-budget") && line.ends_with("memory\n"), "{line}");
        }
    }
}
