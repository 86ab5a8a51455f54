//! MPCDI files: what the wall writes is read by Python's standard library, and the other way round.

use std::{f64::consts::PI, fs, path::Path, process::Command};

use compositor::wall::Wall;
use glam::DVec2;

use crate::{process::Program, room::bent};

fn python(arguments: &[&str]) -> Option<String> {
    python_of("mpcdi.py", arguments)
}

/// Runs a script beside this file; `None` on a machine without Python.
pub(crate) fn python_of(script: &str, arguments: &[&str]) -> Option<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("src").join(script);
    let Ok(output) = Command::new("python3").arg(script).args(arguments).output() else {
        println!("not tested: there is no python3");
        return None;
    };
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    Some(String::from_utf8(output.stdout).unwrap())
}

pub(crate) fn run(arguments: &[&str]) -> (Option<i32>, String) {
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

    // The picture's shape comes back, too.
    let (code, said) = run(&["import", &path("ours.mpcdi"), &path("theirs.toml"), "--width", "3.1416"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("gamma is 2.2: set \"srgb\" for those") && said.contains("--height"), "{said}");
    let theirs = Wall::load(Path::new(&path("theirs.toml"))).unwrap();
    assert!((theirs.canvas_m()[1] - 0.75).abs() < 1e-3, "{:?}", theirs.canvas_m());
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
fn no_file_is_written_over_and_an_error_leaves_none() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let text = "canvas_m = [2.0, 0.75]\n[grid]\ncolumns = 2\nrows = 1\npixels = [64, 48]\noverlap = [0.1, 0.0]\n";
    fs::write(path("ours.toml"), text).unwrap();
    assert_eq!(run(&["export", &path("ours.toml"), &path("ours.mpcdi")]).0, Some(0));
    let files = || {
        let mut names: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|it| it.unwrap().file_name()).collect();
        names.sort();
        names
    };
    let before = files();
    for size in ["--width=0", "--width=nan", "--width=-3", "--width=1e9", "--height=inf"] {
        let (code, said) = run(&["import", &path("ours.mpcdi"), &path("new.toml"), size]);
        assert!(code == Some(1) && said.contains("give metres from 0.01 to 1000"), "{size:?}: {said}");
        assert_eq!(files(), before);
    }
    let (code, said) = run(&["import", &path("ours.mpcdi"), &path("new.toml"), "--shape", "dome"]);
    assert!(code == Some(1) && said.contains("leave out --shape and --angle"), "{said}");
    assert_eq!(files(), before);
    // A mesh file of another wall: the first one, which was free, is gone again.
    fs::write(path("new.2.pfm"), "another's").unwrap();
    let (code, said) = run(&["import", &path("ours.mpcdi"), &path("new.toml")]);
    assert!(code == Some(1) && said.contains("new.2.pfm is there already") && said.contains("name another"), "{said}");
    assert_eq!(fs::read_to_string(path("new.2.pfm")).unwrap(), "another's");
    assert_eq!(files().len(), before.len() + 1, "{:?}", files());
    // A disk that fills up, here by a limit to files that the meshes keep and the wall file does not.
    fs::write(path("wide.toml"), text.replace("columns = 2", "columns = 12")).unwrap();
    assert_eq!(run(&["export", &path("wide.toml"), &path("wide.mpcdi")]).0, Some(0));
    let before = files();
    let mut limited = Command::new("bash");
    limited.args(["-c", "ulimit -f 1; exec \"$0\" \"$@\""]).arg(Program::command("compositor").get_program());
    limited.args(["import", &path("wide.mpcdi"), &path("full.toml")]);
    let (status, said) = Program::start(limited).wait();
    assert!(
        status.code() == Some(1) && said.contains("full.toml: ") && said.contains("let files grow larger"),
        "{said}"
    );
    assert_eq!(files(), before);
    // Inputs and other files are no place for an export.
    for name in ["ours.toml", "new.2.pfm", "ours.mpcdi"] {
        let old = fs::read(path(name)).unwrap();
        let (code, said) = run(&["export", &path("ours.toml"), &path(name)]);
        assert!(code == Some(1) && said.contains("is there already: name another MPCDI file"), "{said}");
        assert_eq!(fs::read(path(name)).unwrap(), old);
    }
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
