//! The laboratory's programs: they report what they traced.

use std::{
    io::Write,
    path::Path,
    process::{Command, Output, Stdio},
};

use renderer::render::shade::{CELLS_COLOR, TESTS_COLOR};
use serde_json::Value;
use shared::srgb;

use crate::{
    farm::Files,
    process::{Program, generate_statue},
};

/// Runs a program to its end, with `input` on its standard input.
fn run(mut command: Command, input: &str) -> Output {
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("the program starts");
    child.stdin.take().expect("piped").write_all(input.as_bytes()).expect("the program reads");
    child.wait_with_output().expect("the program ends")
}

fn answers(output: &Output) -> Vec<Value> {
    assert!(output.status.success(), "{output:?}");
    let lines = str::from_utf8(&output.stdout).expect("UTF-8").lines();
    lines.map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
}

/// Puts a small model into a folder, and a camera in our format and in the peers'.
fn prepare(folder: &Path) {
    generate_statue(3000, &folder.join("statue.ply"));
    let camera = [("eye", "0.3 0.9 4"), ("ll", "-1.6 0.1 0"), ("u", "3.2 0 0"), ("v", "0 1.8 0")];
    let peers: String = camera.iter().map(|(name, numbers)| format!("{name} {numbers}\n")).collect();
    std::fs::write(folder.join("view.cam"), peers + "light 2 4 3\nres 203 101\n").unwrap();
    let ours: String =
        camera.iter().map(|(name, numbers)| format!("{name} = [{}]\n", numbers.replace(' ', ", "))).collect();
    std::fs::write(folder.join("view.toml"), ours).unwrap();
}

#[test]
fn peer_bench_traces_what_lab_trace_traces() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    let [model, camera, hits] = ["statue.ply", "view.toml", "trace.hits"].map(|name| folder.join(name));
    let mut trace = Program::command("lab");
    trace.args(["trace", "--size", "203x101", "--light", "2,4,3", "--shadow-rays", "--json"]);
    trace.arg("--model").arg(&model).arg("--camera").arg(&camera).arg("--hits").arg(&hits);
    let traced = answers(&run(trace, "")).remove(0);

    let mut peer = Program::command("examples/peer_bench");
    peer.arg("--model").arg(&model).current_dir(folder);
    let input = "frame packet 2 3 0 view.cam\nframe single 1 2 1 view.cam\n\
        dump packet packet.hits view.cam\ndump single single.hits view.cam\nquit\nnever read\n";
    let answers = answers(&run(peer, input));
    let [ready, primary, shadows, _, _] = &answers[..] else { panic!("{answers:?}") };
    assert_eq!(ready["tris"], traced["triangles"]);
    assert_eq!(ready["mem_bytes"], traced["structure_bytes"]);
    assert_eq!(primary["cpu_ms"].as_array().unwrap().len(), 3);
    assert_eq!([&primary["rays"], &primary["hits"]], [&Value::from(203 * 101), &traced["hits"]]);
    assert!(traced["hits"].as_u64().unwrap() > 1000 && traced["shadow_rays"].as_u64().unwrap() > 500);
    for what in ["hits", "shadow_rays", "shadowed"] {
        assert_eq!(shadows[what], traced[what], "{what}");
    }
    let traced = std::fs::read(hits).unwrap();
    for dumped in ["packet.hits", "single.hits"] {
        assert!(std::fs::read(folder.join(dumped)).unwrap() == traced, "{dumped} differs");
    }
}

#[test]
fn frames_on_demand_answer_each_camera_with_a_line() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    let mut trace = Program::command("lab");
    trace.args(["trace", "--model", "statue.ply", "--size", "203x101", "--cameras", "-"]).current_dir(folder);
    let answers = answers(&run(trace, "view.toml\n\n view.toml\n"));
    let [first, second] = &answers[..] else { panic!("{answers:?}") };
    assert_eq!(first["hits"], second["hits"]);
    assert!(first["hits"].as_u64().unwrap() > 1000 && first["frame_cpu_ms"].as_f64().unwrap() > 0.0);
}

#[test]
fn a_bad_camera_path_ends_frames_on_demand() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    // No longer than a pipe's buffer, because the program need not read all of it.
    let endless = "a".repeat(1 << 16);
    for (input, n_answers, expected) in
        [("view.toml\nnone.toml\n", 1, "line 2 of the cameras: "), (&endless, 0, "a line has 65536 bytes or more")]
    {
        let mut trace = Program::command("lab");
        trace.args(["trace", "--model", "statue.ply", "--size", "64x32", "--cameras", "-"]).current_dir(folder);
        trace.stderr(Stdio::piped());
        let output = run(trace, input);
        let (answers, said) = (str::from_utf8(&output.stdout).unwrap(), str::from_utf8(&output.stderr).unwrap());
        assert!(!output.status.success() && said.contains(expected), "{said}");
        assert_eq!((answers.lines().count(), said.lines().count()), (n_answers, 1), "{said}");
    }
}

#[test]
fn a_wrong_request_or_camera_ends_with_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    std::fs::write(folder.join("flat.cam"), "eye 0 0 1\nll 0 0 0\nu 1 0 0\nv 2 0 0\n").unwrap();
    let orders = [
        ("frame plücker 1 1 0 view.cam", "packet or single"),
        ("frame packet 1 0 0 view.cam", "frames"),
        ("frame packet 1 1 0 none.cam", "none.cam"),
        ("frame packet 1 1 0 flat.cam", "no area"),
        ("frame packet 1 1 0 statue.ply", "statue.ply"),
        ("rays single 1 1 0 view.cam", "rays have 32 bytes"),
    ];
    for (order, expected) in orders {
        let mut peer = Program::command("examples/peer_bench");
        peer.args(["--model", "statue.ply"]).current_dir(folder).stderr(Stdio::piped());
        let output = run(peer, &format!("{order}\n"));
        let said = str::from_utf8(&output.stderr).unwrap();
        assert!(!output.status.success() && said.contains(expected) && !said.contains("panicked"), "{order}: {said}");
        assert_eq!(said.trim().lines().count(), 1, "{said}");
    }

    // Orders that only other ray tracers know are answered.
    let mut peer = Program::command("examples/peer_bench");
    peer.args(["--model", "statue.ply"]).current_dir(folder);
    let output = run(peer, "frame\nrays packet 1 1 0 view.rays\n");
    let said = str::from_utf8(&output.stdout).unwrap();
    assert!(output.status.success() && said.matches(r#""event":"error""#).count() == 2, "{said}");
}

#[test]
fn ray_files_are_answered_with_the_hits_of_their_rays() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    // Down the statue's axis, and past it.
    let rays: [[f32; 8]; 3] = [
        [0.0, 99.0, 0.0, 0.0, 0.0, -1.0, 0.0, f32::INFINITY],
        [0.0, 99.0, 0.0, 0.0, 0.0, -1.0, 0.0, 10.0],
        [50.0, 99.0, 0.0, 0.0, 0.0, -1.0, 0.0, f32::INFINITY],
    ];
    let bytes: Vec<u8> = rays.iter().flatten().flat_map(|number| number.to_le_bytes()).collect();
    std::fs::write(folder.join("down.rays"), bytes).unwrap();
    let answers_with = |args: &[&str]| {
        let mut peer = Program::command("examples/peer_bench");
        peer.args(["--model", "statue.ply"]).args(args).current_dir(folder);
        answers(&run(peer, "rays single 1 2 0 down.rays\nrays single 2 1 1 down.rays\n"))
    };
    let answers = answers_with(&[]);
    let portable = answers_with(&["--instructions", "portable"]);
    assert!(portable[0]["engine"].as_str().unwrap().ends_with("Portable"), "{}", portable[0]);
    assert_eq!((&portable[1]["sum"], &portable[2]["hits"]), (&answers[1]["sum"], &answers[2]["hits"]));
    for answer in &answers[1..] {
        assert_eq!((answer["rays"].as_u64(), answer["hits"].as_u64()), (Some(3), Some(1)), "{answer}");
    }
    assert!(answers[1]["sum"].as_u64() > Some(0) && answers[1]["cpu_ms"].as_array().unwrap().len() == 2);
    assert_eq!(answers.len(), 3);
}

#[test]
fn unknown_instructions_end_with_those_that_there_are() {
    let mut peer = Program::command("examples/peer_bench");
    peer.args(["--model", "statue.ply", "--instructions", "mmx"]).stderr(Stdio::piped());
    let output = run(peer, "");
    let said = str::from_utf8(&output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("this machine has portable"), "{said}");
}

#[test]
fn trace_counts_rays_that_share_no_origin_by_kind() {
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path());
    let traced = |args: &[&str]| {
        let mut trace = Program::command("lab");
        trace.args(["trace", "--model", "statue.ply", "--camera", "view.toml", "--size", "203x101"]).args(args);
        trace.current_dir(folder.path());
        run(trace, "")
    };
    let report = answers(&traced(&["--secondary-rays", "--json"])).remove(0);
    let kinds = report["secondary_rays"].as_array().unwrap();
    let names: Vec<_> = kinds.iter().map(|kind| kind["kind"].as_str().unwrap()).collect();
    assert_eq!(names, ["ao", "bounce", "bounce2", "sun"]);
    let [ao, bounce, bounce2, sun] = &kinds[..] else { panic!("{report}") };
    assert_eq!([&ao["rays"], &bounce["rays"]], [&report["hits"]; 2], "one ray for each hit");
    assert_eq!(bounce2["rays"], bounce["hits"], "the second bounce starts where the first hits");
    assert!(sun["rays"].as_u64() < ao["rays"].as_u64() && ao["hits"].as_u64() < bounce["hits"].as_u64(), "{report}");
    assert!(kinds.iter().all(|kind| kind["cpu_ns_per_ray"].as_f64() > Some(0.0)), "{report}");

    let table = traced(&["--secondary-rays"]);
    assert!(str::from_utf8(&table.stdout).unwrap().contains("\nbounce2     "), "{table:?}");
    let report = answers(&traced(&["--json"])).remove(0);
    assert_eq!(report["secondary_rays"], Value::Array(Vec::new()));
}

#[test]
fn a_wall_lights_and_cuts_its_picture_as_trace_does() {
    const SIZE: &str = "96x48";
    let files = Files::new();
    let mut hashes = Vec::new();
    let cut = ["--rays=ambient", "--clip=eye:40", "--key-light=-80,12", "--background=ffffff,102030"];
    for (appearance, division) in [
        (&["--rays=primary"][..], "tiled"),
        (&["--rays=shadows"], "interleaved"),
        (&["--rays=ambient"], "dynamic"),
        (&cut, "interleaved"),
    ] {
        let expected = files.traced_hash_with(SIZE, appearance);
        let mut wall = files.wall(SIZE);
        wall.args(["--local", "2", "--frames", "2", "--division", division]).args(appearance);
        Program::succeed(wall);
        for frame in files.frames() {
            assert_eq!(frame["samples_blake3"], expected.as_str(), "{appearance:?}, {division}");
        }
        hashes.push(expected);
    }
    hashes.sort_unstable();
    hashes.dedup();
    assert_eq!(hashes.len(), 4, "two appearances give the same picture");
}

#[test]
fn the_cost_view_shows_what_the_counters_count() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    let trace = |size: &str| {
        let mut trace = Program::command("lab");
        trace.args(["trace", "--model", "statue.ply", "--camera", "view.toml", "--view", "cost", "--json"]);
        trace.args(["--density", "32", "--image", "cost.png", "--size", size]).current_dir(folder);
        let report = answers(&run(trace, "")).remove(0);
        let count = |name: &str| report[name].as_u64().unwrap();
        let counts = (count("cell_traversals"), count("triangle_tests"));
        let per_ray = ["cell_traversals_per_ray", "triangle_tests_per_ray"].map(|name| report[name].as_f64().unwrap());
        (counts, per_ray, crate::references::read_png(&folder.join("cost.png")).unwrap())
    };
    // With one ray, the picture is one pixel that shows its cost.
    let ((n_cells, n_tests), per_ray, picture) = trace("1x1");
    let brightness = |count: u64, half: f32| count as f32 / (count as f32 + half);
    let color = [0, 1, 2].map(|channel: usize| {
        let [cells, tests] = [CELLS_COLOR, TESTS_COLOR].map(|color| srgb::decode(color[channel]));
        srgb::encode(cells * brightness(n_cells, 64.0) + tests * brightness(n_tests, 256.0))
    });
    assert!(n_cells > 0 && n_tests > 0, "the ray through the middle misses the statue");
    assert_eq!(picture.rgb, color);
    assert_eq!(per_ray, [n_cells as f64, n_tests as f64]);
    let ((n_cells, n_tests), per_ray, picture) = trace("40x20");
    assert_eq!(per_ray.map(|mean| (mean * 800.0).round() as u64), [n_cells, n_tests]);
    let n_dark = picture.rgb.chunks(3).filter(|color| color == &[0; 3]).count();
    assert!((1..800).contains(&n_dark), "{n_dark} rays cost nothing");
}

#[test]
fn a_model_without_area_is_not_charted() {
    let folder = tempfile::tempdir().unwrap();
    let model = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 2 3\n3 0 1 1\n";
    std::fs::write(folder.path().join("line.ply"), model).unwrap();
    let mut chart = Program::command("lab");
    chart.args(["chart", "--quick", "--model", "line.ply", "--out", "figures", "--charts", "memory"]);
    chart.current_dir(&folder).stderr(Stdio::piped());
    let output = run(chart, "");
    let said = str::from_utf8(&output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("has an area"), "{said}");
}

#[test]
fn charts_show_where_methods_fail_and_what_settings_cost() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    let blind = "eye = [0, 0, 9]\nll = [-1, -1, 10]\nu = [2, 0, 0]\nv = [0, 2, 0]\n";
    std::fs::write(folder.join("blind.toml"), blind).unwrap();
    std::fs::write(folder.join("points.csv"), "name,cpu_ns_per_ray,bytes_per_triangle\nsomebody else,100,70\n")
        .unwrap();
    let chart = |args: &[&str]| {
        let mut chart = Program::command("lab");
        chart.args(["chart", "--quick", "--model", "statue.ply", "--out", "figures"]).args(args).current_dir(folder);
        chart.stderr(Stdio::piped());
        run(chart, "")
    };
    let output = chart(&["--charts", "kernel", "--camera", "blind.toml"]);
    let said = str::from_utf8(&output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("blind, near: the camera sees nothing"), "{said}");

    // One camera that sees nothing does not stop the others.
    let cameras = ["--camera", "view.toml", "--camera", "blind.toml"];
    let output = chart(&[&["--charts", "kernel,memory", "--points", "points.csv"], &cameras[..]].concat());
    assert!(output.status.success(), "{output:?}");
    let json = std::fs::read(folder.join("figures/chart.json")).unwrap();
    let json: Value = serde_json::from_slice(&json).unwrap();
    assert_eq!(json["left_out"].as_array().unwrap().len(), 6, "the blind camera in its six places");
    let rows = json["kernel"].as_array().unwrap();
    assert_eq!(rows.len(), 6 * 5);
    for row in rows {
        let number = |name: &str| row[name].as_f64().unwrap();
        assert!(number("cpu_ns_per_ray") > 0.0 && number("compared") > 500.0, "{row}");
        match (row["method"].as_str().unwrap(), row["placement"].as_str().unwrap()) {
            ("raywall", _) => assert!(number("wrong_pixels") == 0.0 && number("depth_error_max") < 7e-8, "{row}"),
            ("moller-trumbore-f64", _) => assert!(number("depth_error_p999") < 1e-11, "{row}"),
            ("origin-edges-f32", "eye-far-1e4") => assert!(number("wrong_pixels") > 10.0, "{row}"),
            ("origin-edges-f32", _) => {}
            _ => assert!(number("depth_error_p50") > 1e-9, "{row}"),
        }
    }
    let csv = std::fs::read_to_string(folder.join("figures/kernel.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + rows.len());
    assert!(csv.lines().nth(1).unwrap().starts_with("view,near,origin-edges-f32,"), "{csv}");
    check_svg(folder, "kernel", &["Raywall", "Plücker f32", "Möller–Trumbore f64", "Pareto front", "CPU ns per ray"]);

    let rows = json["memory"].as_array().unwrap();
    let (mut least, mut most) = (f64::INFINITY, 0.0f64);
    for row in rows {
        let number = |name: &str| row[name].as_f64().unwrap();
        assert!(number("cpu_ns_per_ray") > 0.0 && number("build_seconds") > 0.0, "{row}");
        (least, most) = (least.min(number("bytes_per_triangle")), most.max(number("bytes_per_triangle")));
    }
    assert!(rows.len() > 10 && least > 16.0 && most > 2.0 * least, "{} rows, {least} to {most} bytes", rows.len());
    check_svg(folder, "memory", &["masks", "row-displacement, fewer levels", "somebody else"]);
}

#[test]
fn the_chart_of_light_shows_that_paths_come_closer_and_other_rays_do_not() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    prepare(folder);
    std::fs::write(folder.join("points.csv"), "name,cpu_ms,light_rmse\nsomebody else,100,0.02\n").unwrap();
    let mut chart = Program::command("lab");
    chart.args(["chart", "--quick", "--charts", "light", "--model", "statue.ply", "--camera", "view.toml"]);
    chart.args(["--size", "96x48", "--points", "points.csv", "--out", "figures"]).current_dir(folder);
    let output = run(chart, "");
    assert!(output.status.success(), "{output:?}");
    let json = std::fs::read(folder.join("figures/chart.json")).unwrap();
    let json: Value = serde_json::from_slice(&json).unwrap();
    let rows = json["light"].as_array().unwrap();
    let errors = |rays: &str, name: &str| {
        let of_rays = rows.iter().filter(|row| row["rays"] == rays);
        of_rays.map(|row| row[name].as_f64().unwrap()).collect::<Vec<_>>()
    };
    for name in ["light_rmse", "flip"] {
        let paths = errors("path", name);
        assert!(paths.len() == 5 && paths.is_sorted_by(|more, less| more > less), "{name}: {paths:?}");
        for rays in ["primary", "shadows", "ambient"] {
            let others = errors(rays, name);
            let [first, last] = [others[0], others[others.len() - 1]];
            assert!(last > 0.8 * first && last > 2.0 * paths[4], "{name} of {rays}: {others:?}, paths {paths:?}");
        }
    }
    let adaptive = errors("path, until a noise", "light_rmse");
    assert!(adaptive.len() == 3 && adaptive.is_sorted_by(|more, less| more > less), "{adaptive:?}");
    check_svg(folder, "light", &["primary", "ambient", "until a noise", "somebody else", "RMSE of linear light"]);
}

fn check_svg(folder: &Path, name: &str, labels: &[&str]) {
    let svg = std::fs::read_to_string(folder.join(format!("figures/{name}.svg"))).unwrap();
    for label in labels {
        assert!(svg.contains(label), "{label}");
    }
    let png = crate::references::read_png(&folder.join(format!("figures/{name}.png"))).unwrap();
    assert!(png.size[0] > 1000 && png.rgb.iter().any(|&byte| byte < 100), "{name}.png");
}
