//! Measurements of very large models, with small ones: `make large`, also where a model does not fit, and `lab detail`.

use std::process::Command;

use serde_json::Value;

use crate::process::{Program, generate_statue};

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
        let is_told = said.contains("error: 100000000 triangles need 4.9 GB of memory and 5.6 GB of disk in ")
            && said.contains("; this machine lacks that: ask for fewer triangles");
        assert!(!status.success() && is_told && !said.contains("bytes a triangle"), "{said}");
    }
}

#[test]
fn a_stand_in_as_coarse_as_samples_reads_less_and_shows_about_the_same() {
    let folder = tempfile::tempdir_in(std::env::current_exe().unwrap().parent().unwrap()).unwrap();
    let [model, out] = ["statue.ply", "figures"].map(|name| folder.path().join(name));
    generate_statue(300_000, &model);
    let mut command = Program::command("lab");
    command.arg("detail").arg(&model).args(["--size", "96x48", "--cells", "0.25,2", "--out"]).arg(&out);
    let said = Program::succeed(command);
    let text = std::fs::read_to_string(out.join("detail.csv")).unwrap();
    let mut lines = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let names = lines.next().unwrap();
    let rows: Vec<_> = lines.collect();
    let field = |row: &[&str], name: &str| row[names.iter().position(|it| *it == name).unwrap()].to_owned();
    let number = |row: &[&str], name: &str| field(row, name).parse::<f64>().unwrap();
    let of_whole: Vec<_> =
        rows.iter().filter(|row| field(row, "view") == "whole" && number(row, "samples") == 1.0).collect();
    let [itself, fine, coarse] = of_whole[..] else { panic!("{said}") };
    assert!(number(itself, "psnr") > 25.0 && number(itself, "lost_db") == 0.0, "{text}");
    assert!(number(fine, "lost_db") < number(coarse, "lost_db"), "{text}");
    for stand_in in [fine, coarse] {
        assert!(number(stand_in, "triangles") < number(itself, "triangles"), "{text}");
        // Empty where the system does not tell, or keeps files in memory.
        if !field(itself, "touched_mb").is_empty() {
            let part = number(stand_in, "touched_mb") / number(itself, "touched_mb");
            assert!(part < 0.9 && (part - number(stand_in, "touched_part")).abs() < 1e-6, "{text}");
        }
    }
    assert!(std::fs::read_to_string(out.join("detail.svg")).unwrap().contains("dB lost"));
    let left = std::fs::read_dir(&out).unwrap().flatten().map(|entry| entry.path());
    assert_eq!(left.filter(|path| path.extension().is_some_and(|it| it == "raywall")).count(), 0);
}
