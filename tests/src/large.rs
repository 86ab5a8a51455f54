//! `make large` with a small model, and one that does not fit.

use std::process::Command;

use serde_json::Value;

use crate::process::Program;

#[test]
fn large_models_are_measured_from_their_files_to_frames() {
    let folder = tempfile::tempdir().unwrap();
    let files = folder.path().join("files");
    let large = |args: &[&str]| {
        let mut command = Program::command("lab");
        command.arg("large").args(args).arg("--folder").arg(&files).env("RUST_LOG", "error");
        command
    };
    let said = Program::succeed(large(&["--triangles", "100000,150000", "--json"]));
    let rows: Vec<Value> = serde_json::from_str(&said).unwrap();
    assert_eq!(rows.len(), 2, "{said}");
    for (row, triangles) in rows.iter().zip([100_000.0, 150_000.0]) {
        let figure = |name: &str| row.pointer(name).and_then(Value::as_f64).unwrap_or_else(|| panic!("{name}: {row}"));
        let near = |value: f64, expected: f64| (0.998..1.002).contains(&(value / expected));
        assert!(near(figure("/triangles"), triangles), "{row}");
        let bytes_per_triangle = figure("/scene_bytes_per_triangle");
        assert!(near(bytes_per_triangle, figure("/scene_bytes") / figure("/triangles")), "{row}");
        assert!((40.0..90.0).contains(&bytes_per_triangle), "{row}");
        for time in ["/build_s", "/first_start_s", "/second_start_s", "/whole/frame_ms", "/close/frame_ms"] {
            assert!(figure(time) > 0.0, "{time}: {row}");
        }
        for speed in ["/whole/mpixel_per_core_s", "/close/mpixel_per_core_s"] {
            assert!((0.1..1000.0).contains(&figure(speed)), "{speed}: {row}");
        }
        if cfg!(target_os = "linux") {
            // Two render servers hold the mapped file once.
            let (scene, one, two) = (figure("/scene_bytes"), figure("/pss_bytes/0"), figure("/pss_bytes/1"));
            assert!(one > scene / 4.0 && two > one && two < one + scene, "{row}");
            assert!(figure("/build_peak_bytes") > 18.0 * triangles, "{row}");
        }
    }
    let left: Vec<_> = std::fs::read_dir(&files).unwrap().flatten().map(|entry| entry.file_name()).collect();
    assert!(left.is_empty(), "{left:?}");

    if cfg!(target_os = "linux") {
        let mut limited = Command::new("sh");
        limited.args(["-c", "ulimit -v 4000000; exec \"$0\" \"$@\""]);
        let large = large(&["--triangles", "1000,100000000"]);
        limited.arg(large.get_program()).args(large.get_args()).env("RUST_LOG", "error");
        let (status, said) = Program::start(limited).wait();
        let is_told = said.contains("error: 100000000 triangles need 6.5 GB of memory and 6.4 GB of disk in ")
            && said.contains("; this machine lacks that: ask for fewer triangles");
        assert!(!status.success() && is_told && !said.contains("bytes a triangle"), "{said}");
    }
}
