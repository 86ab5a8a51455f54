//! MPCDI files of views and of points in space: what the wall writes is read by Python's standard library, and the other way
//! round.

use std::{fs, path::Path};

use compositor::wall::{Surface, Wall};
use glam::{DVec2, DVec3};

use crate::{
    mpcdi::{python_of, run},
    room::{bent, rig::Rig},
};

fn python(arguments: &[&str]) -> Option<String> {
    python_of("mpcdi_space.py", arguments)
}

/// Lines of a name and numbers.
fn rows(text: &str) -> Vec<(String, Vec<f64>)> {
    let row = |line: &str| {
        let (name, numbers) = line.split_once('\t').unwrap();
        (name.to_owned(), numbers.split('\t').map(|number| number.parse().unwrap()).collect())
    };
    text.lines().map(row).collect()
}

/// A wall with the meshes that are true in the room, in a folder.
fn wall_of(rig: &Rig, n_points: [usize; 2], surface: &str, folder: &Path) -> Wall {
    let wall = rig.true_wall(n_points);
    for mesh in wall.projectors().iter().filter_map(|projector| projector.mesh.as_ref()) {
        fs::write(folder.join(mesh.file()), mesh.to_pfm(wall.canvas_m())).unwrap();
    }
    // Tables follow plain keys.
    let text = wall.to_toml().replacen("[[projector]]", &format!("{surface}[[projector]]"), 1);
    fs::write(folder.join("ours.toml"), text).unwrap();
    Wall::load(&folder.join("ours.toml")).unwrap()
}

/// How far distances through the room between pixels of an imported wall are from the true ones, in pixels.
fn farthest_px(theirs: &Wall, rig: &Rig, scale: f64) -> f64 {
    let surface = theirs.surface().unwrap();
    let mut points: Vec<[DVec3; 2]> = Vec::new();
    for (projector, stands) in theirs.projectors().iter().zip(&rig.projectors) {
        for n in 0..64 {
            let part = (DVec2::new(f64::from(n % 8), f64::from(n / 8)) + 0.5) / 8.0;
            let px = part * projector.output.size();
            let place = theirs.canvas_at(projector.output.origin() + px) * DVec2::from(theirs.canvas_m());
            points.push([scale * surface.in_space(place), rig.surface.in_space(stands.point(px))]);
        }
    }
    let px_m = rig.wall.canvas_m()[0] / 3.0 / 256.0;
    let mut farthest: f64 = 0.0;
    for (n, a) in points.iter().enumerate() {
        for b in &points[..n] {
            farthest = farthest.max((a[0].distance(b[0]) - a[1].distance(b[1])).abs() / px_m);
        }
    }
    farthest
}

#[test]
fn curved_and_folded_walls_are_exported_as_views_and_points_and_imported_again() {
    let walls = [
        (bent::cylinder([256, 192], ["", bent::UPSIDE_DOWN]), [33, 25], "cylinder", 2.0),
        (bent::fold([256, 192], ["", bent::UPSIDE_DOWN]), [257, 49], "fold", 1.0),
        (bent::dome(false, [256, 192], ["", bent::UPSIDE_DOWN]), [33, 25], "dome", 2.2),
    ];
    for (rig, n_points, shape, reach_m) in walls {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        let [width_m, height_m] = rig.wall.canvas_m();
        let surface = match shape {
            "dome" => format!("[surface.dome]\nradius_m = 2.2\nat_m = [{}, {}]\n", width_m / 2.0, height_m / 2.0),
            "fold" => format!("[surface.fold]\nat_m = {}\nangle = 120.0\n", width_m / 2.0),
            _ => format!("[surface.cylinder]\nradius_m = 2.0\nat_m = {}\n", width_m / 2.0),
        };
        wall_of(&rig, n_points, &surface, folder.path());
        // The eye, and the middle of the wall in the room.
        let eye = DVec3::new(width_m / 2.0, height_m / 2.0, reach_m);
        for profile in ["3d", "a3"] {
            let file = path(&format!("ours-{profile}.mpcdi"));
            let (code, said) = run(&["export", &path("ours.toml"), &file, "--profile", profile]);
            assert_eq!(code, Some(0), "{said}");
            let Some(read) = python(&["read", &file]) else { return };
            for ((_, numbers), stands) in rows(&read).iter().zip(&rig.projectors) {
                for sample in numbers.chunks(5) {
                    let truth = rig.surface.in_space(stands.point(DVec2::new(sample[0], sample[1]) + 0.5));
                    let read = DVec3::new(sample[2], sample[3], sample[4]);
                    let away = if profile == "3d" {
                        (truth - eye).length() * read.normalize().distance((truth - eye).normalize())
                    } else {
                        (read + DVec3::new(width_m / 2.0, 0.0, 0.0)).distance(truth)
                    };
                    // A pixel is four millimetres wide.
                    assert!(away < 0.0006, "{shape} {profile}: {sample:?} {truth} {away}");
                }
            }
            let wall_file = path(&format!("theirs-{profile}.toml"));
            let mut arguments = vec!["import", &file, &wall_file, "--shape", shape];
            if (shape, profile) == ("fold", "3d") {
                arguments.extend(["--angle", "120"]);
            }
            let (code, said) = run(&arguments);
            assert_eq!(code, Some(0), "{said}");
            let theirs = Wall::load(Path::new(&wall_file)).unwrap();
            let scale = match theirs.surface() {
                Some(Surface::Cylinder { radius_m, .. }) => 2.0 / radius_m,
                Some(Surface::Dome { radius_m, .. }) => 2.2 / radius_m,
                // A view does not say how far the eye is from the edge: distances between pixels do.
                _ if profile == "3d" => scale_of(&theirs, &rig),
                other => {
                    assert!(
                        matches!(other, Some(Surface::Fold { angle, .. }) if (angle - 120.0).abs() < 0.01),
                        "{other:?}"
                    );
                    1.0
                }
            };
            if profile == "a3" {
                assert!((scale - 1.0).abs() < 1e-4, "{scale}");
            } else {
                assert!(said.contains("angles are the standard's, as the overlaps confirm"), "{said}");
                assert!((theirs.canvas_m()[0] - 4.0).abs() < 1e-9, "{said}");
            }
            let away = farthest_px(&theirs, &rig, scale);
            println!("{shape} {profile}: within {away:.3} pixels");
            assert!(away < 0.25, "{shape} {profile}: {away}");
            if (shape, profile) == ("dome", "a3") {
                // Its middle is that of the points, and its canvas the largest rectangle around that.
                continue;
            }
            // Nearly all of the picture, which alpha maps end.
            let [width, height] = theirs.canvas_m().map(|side| scale * side);
            let is_whole = |ours: f64, theirs: f64| (0.97..1.005).contains(&(theirs / ours));
            assert!(is_whole(width_m, width) && is_whole(height_m, height), "{width} {height}");
        }
        // Points of another shape are refused.
        let (code, said) = run(&["import", &path("ours-a3.mpcdi"), &path("none.toml")]);
        assert!(code == Some(1) && said.contains("give --shape, as the wall is"), "{said}");
        assert!(!folder.path().join("none.toml").exists());
    }
}

/// The ratio of distances on the wall to those on an imported canvas.
fn scale_of(theirs: &Wall, rig: &Rig) -> f64 {
    let ends = |index: usize, n: f64| {
        let px = DVec2::new(0.1 + 0.8 * n, 0.5) * 256.0 * DVec2::new(1.0, 0.75);
        let output = theirs.projectors()[index].output.origin() + px;
        (theirs.canvas_at(output) * DVec2::from(theirs.canvas_m()), rig.projectors[index].point(px))
    };
    let ((a, true_a), (b, true_b)) = (ends(0, 0.0), ends(0, 1.0));
    true_a.distance(true_b) / a.distance(b)
}

#[test]
fn the_overlaps_say_how_a_writer_means_its_angles() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    for (reading, expected) in [
        ("standard", "angles are the standard's, as the overlaps confirm"),
        ("library", "angles are not the standard's"),
    ] {
        let (file, wall_file) = (path(&format!("{reading}.mpcdi")), path(&format!("{reading}.toml")));
        let Some(truth) = python(&["write", &file, reading]) else { return };
        let (code, said) = run(&["import", &file, &wall_file]);
        assert!(code == Some(0) && said.contains(expected), "{said}");
        let wall = Wall::load(Path::new(&wall_file)).unwrap();
        let mut pairs: Vec<[DVec2; 2]> = Vec::new();
        for ((name, numbers), projector) in rows(&truth).iter().zip(wall.projectors()) {
            assert_eq!(*name, projector.name);
            for sample in numbers.chunks(4) {
                let px = projector.output.origin() + DVec2::new(sample[0], sample[1]) + 0.5;
                pairs.push([wall.canvas_at(px) * DVec2::from(wall.canvas_m()), DVec2::new(sample[2], sample[3])]);
            }
        }
        // The same places, up to where the canvas begins and how large it is.
        let scale = (pairs[30][1] - pairs[0][1]).x / (pairs[30][0] - pairs[0][0]).x;
        let slide = pairs[0][1] - scale * pairs[0][0];
        let away = pairs.iter().map(|[ours, truth]| (scale * *ours + slide).distance(*truth)).fold(0.0, f64::max);
        // A pixel is 0.008 of the eye's distance wide.
        assert!(away < 0.0006, "{reading}: {away}");
    }
    let Some(_) = python(&["write", &path("none.mpcdi"), "none"]) else { return };
    let (code, said) = run(&["import", &path("none.mpcdi"), &path("none.toml")]);
    assert!(code == Some(1) && said.contains("by no reading of yaw, pitch and roll"), "{said}");
    assert!(!folder.path().join("none.toml").exists());
    let Some(_) = python(&["write", &path("holes.mpcdi"), "holes"]) else { return };
    let (code, said) = run(&["import", &path("holes.mpcdi"), &path("none.toml")]);
    assert!(code == Some(1) && said.contains("\"upper left\": its warp has pixels without numbers"), "{said}");
    // A fold needs its angle, and no other shape has one.
    let (code, said) = run(&["import", &path("standard.mpcdi"), &path("none.toml"), "--shape", "fold"]);
    assert!(code == Some(1) && said.contains("give --angle 120"), "{said}");
    let (code, said) = run(&["import", &path("standard.mpcdi"), &path("none.toml"), "--angle", "90"]);
    assert!(code == Some(1) && said.contains("--angle is that of --shape fold"), "{said}");
}

#[test]
fn projectors_that_meet_without_an_overlap_make_one_canvas() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let text = "canvas_m = [4.0, 1.5]\n[grid]\ncolumns = 2\nrows = 1\npixels = [160, 120]\noverlap = [0, 0]\n";
    fs::write(path("ours.toml"), text).unwrap();
    for profile in ["3d", "a3"] {
        let (mpcdi, wall) = (path(&format!("{profile}.mpcdi")), path(&format!("{profile}.toml")));
        let (code, said) = run(&["export", &path("ours.toml"), &mpcdi, "--profile", profile]);
        assert_eq!(code, Some(0), "{said}");
        let (code, said) = run(&["import", &mpcdi, &wall, "--width", "4"]);
        assert!(code == Some(0) && said.contains("counts as flat") == (profile == "3d"), "{said}");
        let [width_m, height_m] = Wall::load(Path::new(&wall)).unwrap().canvas_m();
        assert!((width_m - 4.0).abs() < 1e-9 && (height_m - 1.5).abs() < 0.05, "{width_m} {height_m}");
    }
}

#[test]
fn what_an_import_guesses_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let text = "canvas_m = [6.0, 1.5]\n[grid]\ncolumns = 2\nrows = 1\npixels = [160, 120]\noverlap = [0.1, 0.1]\n";
    fs::write(path("ours.toml"), text).unwrap();
    let (code, said) = run(&["export", &path("ours.toml"), &path("ours.mpcdi"), "--profile", "a3"]);
    assert_eq!(code, Some(0), "{said}");
    let (code, said) = run(&["import", &path("ours.mpcdi"), &path("theirs.toml")]);
    assert!(code == Some(0) && said.contains("set \"srgb\" for those") && !said.contains("is a guess"), "{said}");
    let Some(_) = python(&["strip", &path("ours.mpcdi"), &path("plain.mpcdi")]) else { return };
    let (code, said) = run(&["import", &path("plain.mpcdi"), &path("plain.toml")]);
    assert!(code == Some(0) && said.contains("no unit that is known, so its width is a guess"), "{said}");
    assert!(said.contains("gamma is \"srgb\", as the file says none") && !said.contains("set \"srgb\""), "{said}");
    let (code, said) = run(&["import", &path("plain.mpcdi"), &path("sized.toml"), "--width", "6"]);
    assert!(code == Some(0) && !said.contains("is a guess"), "{said}");
}

#[test]
fn coarse_projectors_go_round_and_round() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let text = "canvas_m = [4.0, 1.5]\n[grid]\ncolumns = 2\nrows = 1\npixels = [80, 60]\noverlap = [0.05, 0.0]\n";
    fs::write(path("0.toml"), text).unwrap();
    let mut flat: &[&str] = &[];
    for round in 0..2 {
        for profile in ["3d", "a3"] {
            let (wall, mpcdi, next) = (
                path(&format!("{round}.toml")),
                path(&format!("{round}-{profile}.mpcdi")),
                path(&format!("{}.toml", round + 1)),
            );
            let (code, said) = run(&[&["export", &wall, &mpcdi, "--profile", profile], flat].concat());
            assert_eq!(code, Some(0), "{said}");
            let _ = fs::remove_file(&next);
            for n in 1..=2 {
                let _ = fs::remove_file(path(&format!("{}.{n}.pfm", round + 1)));
            }
            let (code, said) = run(&["import", &mpcdi, &next, "--width", "4"]);
            assert_eq!(code, Some(0), "{said}");
            let [width_m, height_m] = Wall::load(Path::new(&next)).unwrap().canvas_m();
            assert!((width_m - 4.0).abs() < 1e-9 && (height_m - 1.5).abs() < 0.1, "{width_m} {height_m}");
        }
        // The wall has meshes now.
        flat = &["--flat"];
    }
    for (rig, shape, surface) in [
        (bent::cylinder([80, 60], ["", ""]), "cylinder", "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.57\n"),
        (bent::dome(false, [80, 60], ["", ""]), "dome", "[surface.dome]\nradius_m = 2.2\nat_m = [1.5, 0.375]\n"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        wall_of(&rig, [17, 13], surface, folder.path());
        let (code, said) = run(&["export", &path("ours.toml"), &path("ours.mpcdi"), "--profile", "3d"]);
        assert_eq!(code, Some(0), "{said}");
        let (code, said) = run(&["import", &path("ours.mpcdi"), &path("theirs.toml"), "--shape", shape]);
        assert!(code == Some(0) && said.contains("as the overlaps confirm"), "{said}");
    }
}

#[test]
fn meshes_without_a_shape_are_exported_as_a_picture_only() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    wall_of(&bent::cylinder([64, 48], ["", ""]), [17, 13], "", folder.path());
    for profile in ["3d", "a3"] {
        let (code, said) = run(&["export", &path("ours.toml"), &path("ours.mpcdi"), "--profile", profile]);
        assert!(code == Some(1) && said.contains("add [surface] if it is not flat, or export profile 2d"), "{said}");
        assert!(said.contains("if it is flat, add --flat"), "{said}");
    }
    assert!(!folder.path().join("ours.mpcdi").exists());
    let text = fs::read_to_string(path("ours.toml")).unwrap();
    let surface = "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.5\n[[projector]]";
    fs::write(path("curved.toml"), text.replacen("[[projector]]", surface, 1)).unwrap();
    let (code, said) = run(&["export", &path("curved.toml"), &path("ours.mpcdi"), "--profile", "a3", "--flat"]);
    assert!(code == Some(1) && said.contains("leave out --flat"), "{said}");
    let (code, said) = run(&["export", &path("curved.toml"), "/dev/stdout"]);
    assert!(code == Some(1) && said.contains("no ordinary file"), "{said}");
}
