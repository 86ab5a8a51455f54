//! Annotations and the ruler, with a real window, a hand, files and remotes.

use std::{fs, path::Path, thread, time::Duration};

use glam::DVec3;
use serde_json::json;
use shared::{
    camera::Camera,
    marks::{Marks, MeasurementKind, Unit},
};

use crate::{
    process::{Program, wait_until},
    remote::RemoteWall,
    x_session::SHOWN,
};

const SCREEN: [f64; 2] = [640.0, 360.0];
const MIDDLE: [i32; 2] = [320, 180];

fn read(file: &Path) -> Marks {
    Marks::from_toml(&fs::read_to_string(file).expect("the file of marks")).expect("marks")
}

fn click(wall: &RemoteWall, [x, y]: [i32; 2]) {
    wall.session.xdotool(&["mousemove", &x.to_string(), &y.to_string(), "click", "1"]);
}

/// Types the texts of a new annotation of what is under the cursor, and waits until the wall lists it.
fn annotate(wall: &RemoteWall, [x, y]: [i32; 2], label: &str, text: &str) {
    let before = wall.session.screenshot();
    wall.session.xdotool(&["mousemove", &x.to_string(), &y.to_string()]);
    wall.session.key("ctrl+a");
    wait_until("the dialog is open", || before.difference(&wall.session.screenshot(), 4) > 0.05);
    wall.session.xdotool(&["type", "--delay", "30", label]);
    wall.session.key("Tab");
    wall.session.xdotool(&["type", "--delay", "30", text]);
    wall.session.key("Return");
    wait_until("it is listed", || {
        let state = wall.state();
        state["show"]["annotations"].as_array().is_some_and(|all| all.iter().any(|it| it["label"] == label))
    });
}

#[test]
fn an_annotation_is_written_seen_hidden_gone_to_and_deleted() {
    let wall = RemoteWall::start(&["--rays", "primary"]);
    let file = wall.folder.path().join("a statue.ply.marks.toml");
    wall.session.key("o");
    let front = wall.session.steady_screenshot();
    annotate(&wall, MIDDLE, "Crack, of 1910", "Mended: hqc");
    wait_until("the file is there", || file.is_file());
    let [annotation] = &*read(&file).annotations else { panic!("one annotation") };
    assert_eq!((annotation.label(), annotation.text()), ("Crack, of 1910", "Mended: hqc"));
    assert!(annotation.view().is_some() && annotation.direction().is_some());
    // The note leaves after some seconds.
    wait_until("only the label is new", || {
        (0.001..0.02).contains(&front.difference(&wall.session.steady_screenshot(), 16))
    });
    let labelled = wall.session.steady_screenshot();
    thread::sleep(Duration::from_secs(1));
    let (n_shown, ticks) = (wall.program.count(SHOWN), wall.program.ticks());
    thread::sleep(Duration::from_secs(2));
    let spent = wall.program.ticks() - ticks;
    assert!(spent <= 4 && wall.program.count(SHOWN) == n_shown, "{spent} of 200 ticks of CPU time at rest");
    // Its label is above it and to the right.
    click(&wall, [MIDDLE[0] + 30, MIDDLE[1] - 16]);
    wait_until("its text is shown", || wall.state()["show"]["annotation"]["text"] == "Mended: hqc");
    wait_until("and seen", || labelled != wall.session.screenshot());
    wall.session.key("Escape");
    wait_until("its text is closed", || wall.state()["show"]["annotation"].is_null());
    // From behind, the point is hidden, and so is its label.
    wall.act(&json!({ "do": "orbit", "x": SCREEN[1] / SCREEN[0], "y": 0 }));
    wait_until("the back is seen", || labelled.difference(&wall.session.screenshot(), 16) > 0.02);
    let back = wall.session.steady_screenshot();
    wall.session.key("ctrl+h");
    wait_until("a note", || back != wall.session.screenshot());
    wait_until("there was nothing to hide", || back == wall.session.screenshot());
    wall.session.key("ctrl+h");
    wall.act(&json!({ "do": "orbit", "x": 0.4, "y": 0 }));
    wall.act(&json!({ "do": "go-to-annotation", "number": 1 }));
    wait_until("it is gone to", || wall.state()["show"]["annotation"]["number"] == 1);
    wall.act(&json!({ "do": "annotate", "label": "By <b>API</b>", "x": 0.5, "y": 0.6 }));
    wait_until("another is kept", || read(&file).annotations.len() == 2);
    wall.act(&json!({ "do": "delete-annotation", "number": 1 }));
    wait_until("one is left", || read(&file).annotations.len() == 1);
    assert_eq!(read(&file).annotations[0].label(), "By <b>API</b>");
    // The next picture tells remotes.
    let left = json!([{ "number": 2, "label": "By <b>API</b>" }]);
    wait_until("it alone is listed", || wall.state()["show"]["annotations"] == left);
}

/// Where the ray of a pixel meets the cube of side 2 around (0, 0, 0), from outside.
fn on_cube(camera: &Camera, [x, y]: [i32; 2]) -> DVec3 {
    let part = [f64::from(x) / SCREEN[0], 1.0 - f64::from(y) / SCREEN[1]];
    let way = camera.ll() + camera.u() * part[0] + camera.v() * part[1] - camera.eye();
    // The last of the faces towards the eye that the ray passes: slabs.
    let enters = (-way.signum() - camera.eye()) / way;
    camera.eye() + way * enters.max_element()
}

/// The direction of the face of that cube on which a point lies.
fn face(point: DVec3) -> DVec3 {
    let axis = (0..3).max_by(|&a, &b| point[a].abs().total_cmp(&point[b].abs())).expect("three axes");
    DVec3::AXES[axis] * point[axis].signum()
}

/// The length of the way between two points of that cube on different faces, in the plane across both, in small steps; and where it
/// bends.
fn way_on_cube(from: DVec3, to: DVec3) -> (f64, DVec3) {
    let across = face(from) + face(to);
    // From outside back to the cube, for each point between.
    let at = |part: f64| {
        let start = from.lerp(to, part) + across * 10.0;
        let enters = (across.signum() - start) / -across;
        let reached = (0..3).filter(|&axis| across[axis] != 0.0).map(|axis| enters[axis]).fold(f64::MIN, f64::max);
        start - across * reached
    };
    let n = 100_000;
    let points: Vec<_> = (0..=n).map(|step| at(f64::from(step) / f64::from(n))).collect();
    let length = points.array_windows().map(|[a, b]| a.distance(*b)).sum();
    let bend = points.into_iter().find(|&point| face(point) != face(from)).expect("another face");
    (length, bend)
}

#[test]
fn the_ruler_measures_a_cube_as_geometry_does() {
    let mut wall = RemoteWall::start(&[]);
    let folder = wall.folder.path().to_owned();
    let mut cube = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n\
        element face 6\nproperty list uchar int vertex_indices\nend_header\n"
        .to_owned();
    for corner in 0..8 {
        let [x, y, z] = [0, 1, 2].map(|axis| corner >> axis & 1).map(|side| 2 * side - 1);
        cube += &format!("{x} {y} {z}\n");
    }
    cube += "4 0 2 3 1\n4 4 5 7 6\n4 0 1 5 4\n4 2 6 7 3\n4 0 4 6 2\n4 1 3 7 5\n";
    fs::write(folder.join("cube.ply"), cube).unwrap();
    wall.session.key("o");
    wall.act(&json!({ "do": "open", "model": "cube.ply" }));
    wait_until("the cube is open", || wall.state()["show"]["model"] == "cube.ply");
    wall.session.steady_screenshot();
    wall.act(&json!({ "do": "orbit", "x": 0.1, "y": -0.15 }));
    let cube = wall.session.steady_screenshot();
    let file = folder.join("cube.ply.marks.toml");
    annotate(&wall, MIDDLE, "Corner", "");
    wait_until("the view is known", || file.is_file());
    let annotation = read(&file).annotations[0].clone();
    let camera = annotation.view().unwrap().camera;
    // The second lies on another face, well within it.
    let is_beside =
        |point: DVec3| face(point) != face(on_cube(&camera, MIDDLE)) && (point - face(point)).abs().max_element() < 0.8;
    let places = (0..64).flat_map(|x| (0..36).map(move |y| [10 * x, 10 * y]));
    let beside = places.into_iter().find(|&place| is_beside(on_cube(&camera, place))).expect("two faces are seen");
    let pixels = [MIDDLE, beside, [MIDDLE[0] - 20, MIDDLE[1] + 40]];
    let expected = pixels.map(|pixel| on_cube(&camera, pixel));
    let mut n_kept = 0;
    // A cursor's place has 24 bits, a point all of its own.
    let is_near = |a: DVec3, b: DVec3| a.distance(b) < 1e-5;
    assert!(is_near(annotation.at(), on_cube(&camera, MIDDLE)), "{annotation:?}");
    for (kind, n_points) in [(MeasurementKind::Distance, 2), (MeasurementKind::Surface, 2), (MeasurementKind::Angle, 3)]
    {
        wall.session.key("y");
        wall.program.wait_for("Ruler: click");
        for (index, &pixel) in pixels[..n_points].iter().enumerate() {
            click(&wall, pixel);
            // Later than the second click of a double click.
            thread::sleep(Duration::from_millis(500));
            if index + 1 < n_points {
                wall.program.wait_for(&format!("{} of {n_points} points", index + 1));
            }
        }
        n_kept += 1;
        wait_until("it is kept", || read(&file).measurements.len() == n_kept);
        let kept = read(&file).measurements[n_kept - 1].clone();
        if kind == MeasurementKind::Surface {
            continue;
        }
        assert_eq!((kept.kind(), kept.points().len()), (kind, n_points));
        for (&point, &expected) in kept.points().iter().zip(&expected) {
            assert!(is_near(point, expected), "{point} is not {expected}");
            assert!((point.abs().max_element() - 1.0).abs() < 1e-12, "{point} is not on a face");
        }
    }
    let [distance, surface, angle] = &*read(&file).measurements else { panic!("three measurements") };
    let (way, middle) = way_on_cube(expected[0], expected[1]);
    assert_eq!(surface.kind(), MeasurementKind::Surface);
    assert!((surface.value() - way).abs() < 1e-4 && way > distance.value(), "{surface:?} is not {way}");
    assert!(surface.points().iter().any(|&point| point.distance(middle) < 1e-3), "{surface:?} is not by {middle}");
    assert!((distance.value() - expected[0].distance(expected[1])).abs() < 1e-5, "{distance:?}");
    let [a, b] = [expected[0], expected[2]].map(|end| (end - expected[1]).normalize());
    assert!((angle.value() - a.dot(b).acos().to_degrees()).abs() < 1e-3, "{angle:?}");
    wall.session.key("Escape");
    wait_until("lines and values are seen", || {
        (0.005..0.2).contains(&cube.difference(&wall.session.steady_screenshot(), 16))
    });
    let mut command = Program::command("compositor");
    command.arg("annotations").arg(folder.join("cube.ply")).arg("--csv").arg(folder.join("cube.csv"));
    Program::succeed(command);
    let csv = fs::read_to_string(folder.join("cube.csv")).unwrap();
    let rows: Vec<Vec<_>> = csv.lines().map(|row| row.split(',').collect()).collect();
    assert_eq!((rows.len(), rows[1][1], rows[2][1], rows[1][3]), (4, "distance", "surface", "units"), "{csv}");
    assert_eq!(rows[1][2].parse(), Ok(distance.value()));
}

#[test]
fn annotations_go_to_voyager_and_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let run = |arguments: &[&str]| {
        let mut command = Program::command("compositor");
        command.arg("annotations").args(arguments).current_dir(folder.path());
        Program::start(command).wait()
    };
    fs::write(path("vase.ply"), "ply\n").unwrap();
    let document = json!({
        "asset": { "type": "application/si-dpo-3d.document+json", "version": "1.0" },
        "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "model": 0 }],
        "models": [{ "units": "mm", "derivatives": [], "annotations": [
            { "id": "a1", "titles": { "DE": "Riss", "EN": "Crack" }, "leads": { "EN": "<b>Mended</b>\u{202e}" },
              "position": [1.5, -2.0, 0.25], "direction": [0, 0, 2], "articleId": "x" },
            { "id": "a2", "title": "Seal", "lead": "l".repeat(2000), "position": [0, 1, 0] },
            { "id": "a3", "title": "Nowhere" } ] }]
    });
    fs::write(path("scene.svx.json"), document.to_string()).unwrap();
    let (status, said) = run(&["vase.ply", "--import", "scene.svx.json"]);
    assert!(status.success() && said.contains("2 annotations") && said.contains("a3"), "{said}");
    let marks = read(&path("vase.ply.marks.toml"));
    let [crack, seal] = &*marks.annotations else { panic!("{marks:?}") };
    assert_eq!((crack.label(), crack.text(), crack.at()), ("Crack", "<b>Mended</b>", DVec3::new(1.5, -2.0, 0.25)));
    assert_eq!((crack.direction(), marks.unit), (Some(DVec3::Z), Some(Unit::Millimetre)));
    assert!(seal.text().ends_with('…') && seal.text().chars().count() == 600);
    let (status, said) = run(&["vase.ply", "--export", "again.svx.json"]);
    assert!(status.success(), "{said}");
    fs::write(path("pot.ply"), "ply\n").unwrap();
    let (status, said) = run(&["pot.ply", "--import", "again.svx.json"]);
    assert!(status.success(), "{said}");
    assert_eq!(read(&path("pot.ply.marks.toml")), marks);
    let exported: serde_json::Value = serde_json::from_slice(&fs::read(path("again.svx.json")).unwrap()).unwrap();
    assert_eq!(exported["models"][0]["derivatives"][0]["assets"][0]["uri"], "vase.ply");
    for (name, content, fault) in [
        ("none.json", "{}", "no Voyager document"),
        ("text.json", "hello", "no Voyager document"),
        ("empty.json", r#"{"asset":{"type":"application/si-dpo-3d.document+json"},"models":[]}"#, "no annotations"),
    ] {
        fs::write(path(name), content).unwrap();
        let (status, said) = run(&["pot.ply", "--import", name]);
        assert!(!status.success() && said.contains(fault) && said.lines().count() == 1, "{name}: {said}");
    }
    let (status, said) = run(&["missing.ply", "--import", "again.svx.json"]);
    assert!(!status.success() && said.lines().count() == 1, "{said}");
}
