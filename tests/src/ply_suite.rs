//! PLY files of other programs, whole and cut: a mesh with the right counts or a clear error, in bounded memory.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};

use renderer::formats::ply;
use renderer::model::mesh::Mesh;

use crate::{process::shared_folder, random::Random};

/// A file, and another reader's counts.
struct Case {
    name: String,
    bytes: Vec<u8>,
    /// Vertices and fanned triangles, if it could read the file.
    counts: Option<(usize, usize)>,
}

/// A file; its vertices and triangles, or the beginning of the error; and the reason.
type Exception = (&'static str, Result<(usize, usize), &'static str>, &'static str);

/// Files on which the two readers differ.
const EXCEPTIONS: [Exception; 13] = [
    ("243f6e8f-brain.ply", Ok((18844, 36752)), "triangle strips are triangles"),
    ("2c90523a-hippo.ply", Ok((23105, 46202)), "triangle strips are triangles"),
    ("624c99e7-elephant.ply", Ok((19753, 39290)), "triangle strips are triangles"),
    ("08972fb9-texture_in_obj_info.ply", Ok((365, 664)), "an ASCII row may go on in the next line"),
    ("62b4edf2-fuze_ascii.ply", Ok((502, 1000)), "what a line holds beyond its row is ignored"),
    ("b4f51ced-cube_binary_header_with_RN_newline.ply", Ok((8, 12)), "lines of one header may end differently"),
    ("de808280-empty_ok_ascii.ply", Ok((0, 0)), "obj_info may stand anywhere"),
    ("14ff9e8b-crash-30d6d0f7c529b3b66b4131700b7a4580cd7082df.ply", Err("ends inside its header"), "it does"),
    ("1af59222-cube-ply-1.0_binary-comment_renamed_to_remark-invalid.ply", Err("header line 3"), "not PLY"),
    ("3e501017-cube-ply-1.0_ascii-comment_renamed_to_remark-invalid.ply", Err("header line 3"), "not PLY"),
    ("66255f87-diamond_with_bool.ply", Err("header line 13"), "nobody can know how long a bool is"),
    ("721970f1-issue623.ply", Err("row 0 of element `vertex`"), "its vertices lack the list that the header declares"),
    ("c04e8b9a-incomplete_header.ply", Err("ends inside its header"), "it does"),
];

#[test]
fn every_file_of_the_suite_is_a_mesh_or_a_clear_error() {
    for case in &suite() {
        let name = &case.name;
        let exception = EXCEPTIONS.iter().find(|(file, ..)| file == name);
        let expected = exception.map_or(case.counts.ok_or("an error"), |(_, expected, _)| *expected);
        match (read(case, case.bytes.len()), expected) {
            (Ok(mesh), Ok(counts)) => {
                // Corners of other textures or colours than their neighbours get vertices of their own.
                let may_be_split = !(mesh.texture_coordinates.is_empty() && mesh.colors.is_empty());
                let n_vertices = if may_be_split { mesh.vertices.len().min(counts.0) } else { mesh.vertices.len() };
                assert_eq!((n_vertices, mesh.triangles.len()), counts, "{name}");
                assert_eq!(mesh.n_rejected, 0, "{name}");
            }
            (Err(error), Err(beginning)) => assert!(error.starts_with(beginning), "{name}: {error}"),
            (read, expected) => {
                panic!("{name}: {expected:?} expected, {:?} read", read.map(|mesh| mesh.triangles.len()))
            }
        }
    }
}

#[test]
fn a_cut_file_is_the_whole_mesh_or_a_clear_error() {
    let suite = suite();
    let next = AtomicUsize::new(0);
    let task = || {
        while let Some(case) = suite.get(next.fetch_add(1, Ordering::Relaxed)) {
            let whole = read(case, case.bytes.len());
            for n_bytes in cuts(case) {
                let Ok(mesh) = read(case, n_bytes) else { continue };
                // The cut may have taken digits of the last number, or unused data, but never rows.
                let whole = whole.as_ref().unwrap_or_else(|error| panic!("{}: {error}, but not if cut", case.name));
                let counts = |mesh: &Mesh| (mesh.vertices.len(), mesh.triangles.len(), mesh.colors.len());
                assert_eq!(counts(&mesh), counts(whole), "{} cut to {n_bytes} bytes", case.name);
            }
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(task);
        }
    });
}

#[test]
fn false_counts_in_a_small_file_take_no_memory() {
    let vertices = "property float x\nproperty float y\nproperty float z\n";
    let header = |format: &str, rest: &str| format!("ply\nformat {format} 1.0\n{rest}end_header\n").into_bytes();
    let big = "binary_big_endian";
    let with = |mut bytes: Vec<u8>, tail: &[u8], n_times: usize| {
        (0..n_times).for_each(|_| bytes.extend(tail));
        bytes
    };
    let faces =
        |count: &str, index: &str, n: &str| format!("element face {n}\nproperty list {count} {index} vertex_indices\n");
    for (what, bytes) in [
        ("vertices", header(big, &format!("element vertex 4294967294\n{vertices}"))),
        ("vertices in ASCII", header("ascii", &format!("element vertex 18446744073709551615\n{vertices}"))),
        ("rows without properties", header(big, "element a 18446744073709551615\nelement b 18446744073709551615\n")),
        ("faces", header(big, &faces("uchar", "int", "18446744073709551615"))),
        ("a list", with(header(big, &faces("uint", "uchar", "1")), &[255], 4)),
        ("a skipped list", with(header(big, "element a 1\nproperty list uint double b\n"), &[255], 4)),
        ("a list in ASCII", with(header("ascii", &faces("int", "int", "1")), b"4294967295 ", 1)),
        ("many empty faces", with(header(big, &faces("uchar", "uchar", "1000000")), &[0], 1_000_000)),
        ("one polygon", with(header(big, &faces("uint", "uchar", "1")), &[0, 30, 0, 0], 500_000)),
        ("one line", with(header("ascii", &faces("int", "int", "1")), b"1 ", 1_000_000)),
        ("no line end", with(b"ply\ncomment ".to_vec(), b"x", 4_000_000)),
        ("many properties", with(b"ply\nformat ascii 1.0\nelement a 1\n".to_vec(), b"property int a\n", 60_000)),
    ] {
        let n_bytes = bytes.len();
        let case = Case { name: what.to_owned(), bytes, counts: None };
        // `read` asserts the bound.
        let _ = read(&case, n_bytes);
    }
}

/// Lengths to cut a file to: all of a small file; of another, all within its header and 64 more.
fn cuts(case: &Case) -> Vec<usize> {
    let n_bytes = case.bytes.len();
    let end = b"end_header";
    let header =
        case.bytes.windows(end.len()).position(|window| window == end).map_or(n_bytes, |at| at + end.len() + 2);
    if n_bytes < 4096 {
        return (0..n_bytes).collect();
    }
    let mut random = Random::new(n_bytes as u64);
    (0..header.min(n_bytes)).chain((0..64).map(|_| random.below(n_bytes))).collect()
}

/// Reads the first `n_bytes` bytes of a file; asserts little memory, no panic, and a clear error.
fn read(case: &Case, n_bytes: usize) -> Result<Mesh, String> {
    let name = &case.name;
    let bytes = &case.bytes[..n_bytes];
    let before = LIVE.get();
    PEAK.set(before);
    let read = catch_unwind(AssertUnwindSafe(|| ply::read_from(bytes, n_bytes as u64).map(|draft| draft.mesh)));
    let n_allocated = PEAK.get() - before;
    let read = read.unwrap_or_else(|_| panic!("{name} cut to {n_bytes} bytes makes the reader panic"));
    let most = MOST_FIXED_BYTES + MOST_BYTES_PER_BYTE * n_bytes;
    assert!(n_allocated <= most as isize, "{name} cut to {n_bytes} bytes takes {n_allocated} bytes of memory");
    read.map_err(|problem| {
        let text = problem.to_string();
        assert!(!text.is_empty() && text.len() < 300 && !text.contains('\n'), "{name} cut to {n_bytes} bytes: {text}");
        text
    })
}

/// ply-rs allocates this before it reads a list.
const MOST_FIXED_BYTES: usize = 1 << 20;

/// An index of one byte becomes a triangle of twelve, in a buffer that may be a quarter larger.
const MOST_BYTES_PER_BYTE: usize = 16;

/// All files of the suite; none without the folder of reference data.
fn suite() -> Vec<Case> {
    let Some(shared) = shared_folder() else { return Vec::new() };
    let folder = shared.join("ply-suite");
    let index = fs::read_to_string(folder.join("INDEX.tsv")).unwrap();
    let mut lines = index.lines().map(|line| line.split('\t').collect::<Vec<_>>());
    let head = lines.next().unwrap();
    let column = |name: &str| head.iter().position(|&title| title == name).unwrap();
    let [file, verdict, vertices, triangles] = ["file", "plyfile", "verts", "fan_tris"].map(column);
    let suite: Vec<Case> = lines
        .map(|row| Case {
            name: row[file].to_owned(),
            bytes: fs::read(folder.join(row[file])).unwrap(),
            counts: (row[verdict] == "ok").then(|| (row[vertices].parse().unwrap(), row[triangles].parse().unwrap())),
        })
        .collect();
    assert!(suite.len() > 100, "{} holds only {} files", folder.display(), suite.len());
    suite
}

/// Counts the bytes that each thread holds, so parallel tests do not disturb each other.
struct Counting;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

thread_local! {
    static LIVE: Cell<isize> = const { Cell::new(0) };
    static PEAK: Cell<isize> = const { Cell::new(0) };
}

fn count(n_bytes: isize) {
    // A thread that ends has no counters left.
    let _ = LIVE.try_with(|live| {
        live.set(live.get() + n_bytes);
        let _ = PEAK.try_with(|peak| peak.set(peak.get().max(live.get())));
    });
}

// SAFETY: every request goes to the system's allocator unchanged; counting allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        // SAFETY: the caller keeps this function's contract, which is the same.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(-(layout.size() as isize));
        // SAFETY: as above; `pointer` came from `System`.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // Both allocations may exist at once.
        count(new_size as isize);
        // SAFETY: as above.
        let new = unsafe { System.realloc(pointer, layout, new_size) };
        count(-(layout.size() as isize));
        new
    }
}
