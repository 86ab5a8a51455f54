//! The paper's experiment, run as a user runs it.

use std::path::Path;

use serde_json::Value;

use crate::process::Program;

fn bench(out: &Path, args: &[&str]) -> Program {
    let mut command = Program::command("lab");
    command.args(["bench", "--triangles", "1000", "--size", "64x32"]).args(args).arg("--out").arg(out);
    Program::start(command)
}

fn figures(out: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(out.join("bench.json")).unwrap()).unwrap()
}

#[test]
fn the_experiment_measures_predicts_and_draws() {
    let folder = tempfile::tempdir().unwrap();
    // A folder that does not exist yet.
    let out = folder.path().join("figures");
    let small = ["--nodes", "0..2", "--seconds", "0.05", "--predict", "12", "--predict-frames", "2", "--predict-size"];
    let (status, said) = bench(&out, &[&small[..], &["64x32"]].concat()).wait();
    assert!(status.success(), "{said}");
    let figures = figures(&out);
    let measured = figures["measured"].as_array().unwrap();
    assert_eq!(measured.len(), 1 + 2 * 3, "the display alone, and each division with one and two render servers");
    for row in &measured[1..] {
        // Three bytes a sample, and the chunks' headers.
        let bytes_in = row["bytes_in"].as_f64().unwrap();
        assert!((6144.0..9000.0).contains(&bytes_in), "{row}");
        assert!(row["frame_ms_median"].as_f64().unwrap() > 0.0 && row["n_frames"].as_u64().unwrap() >= 5, "{row}");
    }
    let predicted = figures["predicted"].as_array().unwrap();
    for row in predicted {
        let binds = if row["compute_ms"].as_f64() >= row["link_ms"].as_f64() { "compute" } else { "link" };
        assert_eq!(row["binds"], binds, "{row}");
        assert!(
            row["over_bound"].as_f64().unwrap() > 0.99 && row["imbalance_median"].as_f64().unwrap() >= 1.0,
            "{row}"
        );
    }
    for row in predicted {
        let cpu_over_alone = row["cpu_over_alone"].as_f64().unwrap();
        assert!(if row["n_nodes"] == 1 { cpu_over_alone == 1.0 } else { cpu_over_alone > 0.0 }, "{row}");
    }
    assert!(said.contains("each task is traced alone on one core, 4 to 16 times"), "{said}");
    assert!(predicted.iter().any(|row| row["n_nodes"] == 12 && row["n_slow"] == 1));
    let lines = std::fs::read_to_string(out.join("predicted.csv")).unwrap().lines().count();
    assert_eq!(lines, 1 + predicted.len());
    for chart in
        ["bytes-per-frame.svg", "time-per-frame.svg", "predicted-64x32-still.svg", "predicted-64x32-moving.svg"]
    {
        let svg = std::fs::read_to_string(out.join(chart)).unwrap();
        assert!(svg.starts_with("<svg") && svg.contains("dynamic"), "{chart}");
    }
}

#[cfg(unix)]
#[test]
fn an_interrupted_experiment_leaves_its_measurements() {
    let folder = tempfile::tempdir().unwrap();
    let mut program = bench(folder.path(), &["--nodes", "0..64", "--seconds", "0.05", "--predict", "none"]);
    program.wait_for("measured interleaved");
    program.signal("TERM");
    let (status, said) = program.wait();
    assert!(status.success() && said.contains("stopped: results so far"), "{said}");
    assert!(figures(folder.path())["measured"].as_array().unwrap().len() >= 2);
}

/// A closure in a kernel is not compiled for the kernel's instruction set: its instructions become calls, and frames take up
/// to 1.4 times as long, with the same bits.
#[cfg(target_arch = "x86_64")]
#[test]
fn the_renderer_calls_no_function_for_a_vector_instruction() {
    let program = std::fs::read(Program::command("renderer").get_program()).unwrap();
    let is_called = program.windows(7).any(|bytes| bytes == b"_mm512_");
    assert!(!is_called, "nm shows the functions, and objdump -d their callers");
}
