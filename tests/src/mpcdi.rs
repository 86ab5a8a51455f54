//! MPCDI files: what the wall writes is read by Python's standard library, and the other way round.

use std::{f64::consts::PI, fs, path::Path, process::Command};

use compositor::wall::Wall;
use glam::DVec2;

use crate::{process::Program, room::bent};

/// Runs `mpcdi.py`; `None` on a machine without Python.
fn python(arguments: &[&str]) -> Option<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/mpcdi.py");
    let Ok(output) = Command::new("python3").arg(script).args(arguments).output() else {
        println!("not tested: there is no python3");
        return None;
    };
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    Some(String::from_utf8(output.stdout).unwrap())
}

fn run(arguments: &[&str]) -> (Option<i32>, String) {
    let mut command = Program::command("compositor");
    command.args(arguments);
    let (status, said) = Program::start(command).wait();
    (status.code(), said)
}

#[test]
fn a_wall_that_is_exported_is_read_by_another_program_and_imported_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let rig = bent::cylinder(
        [256, 192],
        ["[optics]\ngamma = 2.2\nblack_level = 0.01\n", "[[projector]]\nname = \"row 1 column 2\"\nrotation = 180\n"],
    );
    let wall = rig.true_wall([33, 25]);
    let canvas_m = DVec2::from(wall.canvas_m());
    for mesh in wall.projectors().iter().filter_map(|projector| projector.mesh.as_ref()) {
        fs::write(path(mesh.file()), mesh.to_pfm(wall.canvas_m())).unwrap();
    }
    fs::write(path("ours.toml"), wall.to_toml()).unwrap();
    let (code, said) = run(&["export", &path("ours.toml"), &path("ours.mpcdi")]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("with 3 regions"), "{said}");

    // Each pixel's place, as Python reads it, is where the pixel truly lands on the cylinder.
    if let Some(read) = python(&["read", &path("ours.mpcdi"), &path("unpacked")]) {
        assert_eq!(read.lines().count(), 3);
        for (index, line) in read.lines().enumerate() {
            let words: Vec<&str> = line.split('\t').collect();
            assert_eq!(words[0], wall.projectors()[index].name);
            let numbers: Vec<f64> = words[1..].iter().map(|word| word.parse().unwrap()).collect();
            assert_eq!(numbers[..2], [256.0, 192.0]);
            let (at, extent) = (DVec2::new(numbers[2], numbers[3]), DVec2::new(numbers[4], numbers[5]));
            for sample in numbers[6..].chunks(4) {
                let from_top = at + DVec2::new(sample[2], sample[3]) * extent;
                let place_m = DVec2::new(from_top.x, 1.0 - from_top.y) * canvas_m;
                let px = rig.projectors[index].px(place_m);
                assert!(px.distance(DVec2::new(sample[0], sample[1]) + 0.5) < 0.02, "{line}: {px}");
            }
        }
        // White fades towards the neighbour, and black is lifted where only one projector leaks.
        let map = |name: &str| image::open(folder.path().join("unpacked").join(name)).unwrap().into_rgb8();
        let (alpha, beta) = (map("1_alpha.png"), map("1_beta.png"));
        let (alone, shared) = (alpha.get_pixel(100, 96)[1], alpha.get_pixel(253, 96)[1]);
        assert!(alone > 250 && shared < 100, "{alone} {shared}");
        assert!(beta.get_pixel(100, 96)[1] > beta.get_pixel(253, 96)[1]);
    }

    let (code, said) =
        run(&["import", &path("ours.mpcdi"), &path("theirs.toml"), "--width", "3.1416", "--height", "0.75"]);
    assert_eq!(code, Some(0), "{said}");
    let theirs = Wall::load(Path::new(&path("theirs.toml"))).unwrap();
    assert_eq!(
        theirs.projectors()[1].rotation,
        wall.projectors()[1].rotation,
        "it hangs upside down, as its warp shows"
    );
    for (index, projector) in theirs.projectors().iter().enumerate() {
        for n in 0..64 {
            let px = (DVec2::new(f64::from(n % 8), f64::from(n / 8)) + 0.5) / 8.0 * DVec2::new(256.0, 192.0);
            let place_m = theirs.canvas_at(projector.output.origin() + px) * DVec2::new(PI, 0.75);
            let truth = rig.projectors[index].px(place_m);
            assert!(truth.distance(px) < 0.1, "{px}: {truth}");
        }
    }
    let (code, said) = run(&["import", &path("ours.mpcdi"), &path("theirs.toml")]);
    assert!(code == Some(1) && said.contains("is there already"), "{said}");
}

#[test]
fn a_file_that_another_program_wrote_is_imported() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    if python(&["write", &path("theirs.mpcdi")]).is_none() {
        return;
    }
    let (code, said) = run(&["import", &path("theirs.mpcdi"), &path("wall.toml"), "--width", "6"]);
    assert_eq!(code, Some(0), "{said}");
    let wall = Wall::load(Path::new(&path("wall.toml"))).unwrap();
    assert_eq!(wall.canvas_m(), [6.0, 3.0], "the shape of the picture");
    assert_eq!(wall.neighbours(0).len(), 2, "they overlap");
    for (index, x) in [(0, 0.0), (1, 0.4)] {
        for n in 0..100 {
            let part = (DVec2::new(f64::from(n % 10), f64::from(n / 10)) + 0.5) / 10.0;
            let output = wall.projectors()[index].output;
            let shown = wall.canvas_at(output.origin() + part * output.size());
            // As the script says, from the upper left.
            let (u, v) = (0.05 + 0.9 * part.x, 0.1 + 0.8 * part.y + 0.05 * (PI * part.x).sin());
            let away_px = (shown - DVec2::new(x + 0.6 * u, 1.0 - v)) * DVec2::new(320.0 / 0.54, 240.0 / 0.8);
            assert!(away_px.length() < 0.1, "{part}: {away_px}");
        }
    }
    // Cut files, and files of other kinds, write nothing.
    let whole = fs::read(path("theirs.mpcdi")).unwrap();
    for (name, bytes) in [("cut", &whole[..whole.len() / 2]), ("empty", &[]), ("text", b"canvas_m = [1, 1]")] {
        fs::write(path(name), bytes).unwrap();
        let (code, said) = run(&["import", &path(name), &path("none.toml")]);
        assert!(code == Some(1) && said.contains("no MPCDI file"), "{said}");
        assert!(!folder.path().join("none.toml").exists() && !folder.path().join("none.1.pfm").exists());
    }
}
