//! Shows on real walls: every scene comes with its own caption, whoever dies meanwhile.

use std::{fmt::Write, fs, path::Path, process::Command};

use glam::DVec3;
use serde_json::{Value, json};
use shared::camera::{Camera, UpAxis};

use crate::{
    farm::{Files, RunningWall},
    process::{Program, generate_statue, wait_until},
    remote::RemoteWall,
};

const SIZE: &str = "64x36";
const N_SCENES: usize = 50;
/// Triangles of the models.
const MODELS: [u32; 3] = [300, 2000, 20_000];

/// The camera of a scene: another for each turn of the models.
fn camera(files: &Files, index: usize) -> Camera {
    let text = fs::read_to_string(files.path("camera.toml")).expect("the wall's camera");
    let first = Camera::from_toml(&text).expect("a camera");
    first.orbit(DVec3::new(0.0, 0.9, 0.0), UpAxis::Y, (index / MODELS.len() % 2) as f64, 0.0)
}

fn wall(files: &Files) -> Command {
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--size", SIZE, "--samples", "1"]);
    command.arg("--wall").arg(files.path("wall.toml")).current_dir(files.path(""));
    command
}

/// The picture of a scene, by a wall that plays no show.
fn expected(files: &Files, index: usize) -> Vec<u8> {
    fs::write(files.path("alone.toml"), camera(files, index).to_toml()).expect("a folder of ours");
    let mut command = wall(files);
    command.arg(format!("{}.ply", index % MODELS.len())).args(["--local", "1", "--frames", "1"]);
    command.args(["--camera", "alone.toml", "--screenshot", "alone.png"]);
    Program::succeed(command);
    pixels(&files.path("alone.png"))
}

fn pixels(path: &Path) -> Vec<u8> {
    crate::references::read_png(path).unwrap_or_else(|fault| panic!("{}: {fault}", path.display())).rgb
}

#[test]
fn fifty_scenes_of_three_models_keep_their_captions_while_nodes_die() {
    let files = Files::new();
    for (index, n_triangles) in MODELS.into_iter().enumerate() {
        generate_statue(n_triangles, &files.path(&format!("{index}.ply")));
    }
    let mut show = "fade_seconds = 0\n".to_owned();
    for index in 0..N_SCENES {
        let (model, camera) = (index % MODELS.len(), camera(&files, index).to_toml());
        write!(show, "[[scene]]\nmodel = \"{model}.ply\"\nseconds = 0.2\ncaption = \"caption {index}\"\n{camera}")
            .unwrap();
    }
    // Scenes that cannot be shown are left out.
    show += "[[scene]]\nmodel = \"missing.ply\"\nseconds = 1\n[[scene]]\nmodel = \"0.ply\"\nview = 4\nseconds = 1\n";
    fs::write(files.path("tour.toml"), show).unwrap();
    let mut command = wall(&files);
    command.args(["--show", "tour.toml", "--pictures", "scenes"]);
    let mut program = Program::start(command);
    let address = program.wait_for_address();
    let join = |number: usize| RunningWall::join_at(&address, &format!("node-{number}"), &[]);
    let mut nodes: Vec<_> = (0..3).map(join).collect();
    for round in 0..5 {
        program.wait_for(&format!("scene {} of 52: ", 8 * round + 4));
        // The last time all die.
        let n_killed = if round == 4 { 3 } else { 1 };
        let killed: Vec<_> = nodes.drain(..n_killed).collect();
        assert!(round == 0 || killed[0].said().contains("was loaded ahead"), "{}", killed[0].said());
        drop(killed);
        nodes.extend((0..n_killed).map(|more| join(3 * (round + 1) + more)));
    }
    let (status, said) = program.wait();
    assert!(status.success(), "{said}");
    let captions: Vec<_> = said.lines().filter(|line| line.starts_with("scene ")).collect();
    let expected_captions: Vec<_> =
        (0..N_SCENES).map(|index| format!("scene {} of 52: caption {index}", index + 1)).collect();
    assert_eq!(captions, expected_captions);
    assert!(!said.contains("shows nothing of the model"), "{said}");
    assert!(said.contains("scene 51 is left out: ") && said.contains("missing.ply"), "{said}");
    assert!(said.contains("scene 52 is left out: ") && said.contains("Ctrl+4 on the wall keeps one"), "{said}");
    let pictures: Vec<_> =
        (0..N_SCENES).map(|index| pixels(&files.path(&format!("scenes/scene-{:04}.png", index + 1)))).collect();
    let n_kinds = 2 * MODELS.len();
    for kind in 0..n_kinds {
        let alone = expected(&files, kind);
        for (index, picture) in pictures.iter().enumerate() {
            assert_eq!(*picture == alone, index % n_kinds == kind, "scene {index} beside a picture of scene {kind}");
        }
    }
}

#[test]
fn a_show_that_cannot_be_read_is_told_in_one_line() {
    let files = Files::new();
    fs::write(files.path("tour.toml"), "[[scene]]\nview = 3\n").unwrap();
    for (file, fault) in
        [("tour.toml", "line 1: a scene without a path needs seconds"), ("no.toml", "an empty file begins a new show")]
    {
        let mut command = wall(&files);
        command.args(["--local", "0", "--show", file]);
        let (status, said) = Program::start(command).wait();
        assert!(!status.success() && said.contains(fault) && said.lines().count() == 1, "{said}");
    }
}

#[test]
fn a_show_without_a_window_that_shows_nothing_fails() {
    let files = Files::new();
    fs::write(files.path("empty.toml"), "").unwrap();
    fs::write(files.path("gone.toml"), "[[scene]]\nmodel = \"gone.ply\"\nseconds = 1\n").unwrap();
    fs::create_dir(files.path("kept")).unwrap();
    fs::write(files.path("kept/scene-0001.png"), "a picture").unwrap();
    let shows: [(&[&str], &str); 4] = [
        (&["empty.toml"], "empty.toml has no scenes yet"),
        (&["gone.toml"], "no scene was shown: the warnings above say why"),
        (&["gone.toml", "--pictures", "kept"], "kept holds pictures of a show"),
        (&["gone.toml", "--film", "a.mp4"], "cannot be used with"),
    ];
    for (arguments, fault) in shows {
        let mut command = wall(&files);
        command.args(["--local", "0", "--show"]).args(arguments);
        let (status, said) = Program::start(command).wait();
        assert!(!status.success() && said.contains(fault), "{said}");
    }
    assert_eq!(fs::read(files.path("kept/scene-0001.png")).unwrap(), b"a picture");
}

fn wait_for(wall: &RemoteWall, what: &str, is_so: impl Fn(&Value) -> bool) -> Value {
    wait_until(what, || is_so(&wall.state()));
    wall.state()
}

#[test]
fn a_wall_plays_a_show_and_remotes_hold_it_turn_its_pages_and_add_to_it() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tour.toml");
    let scenes = "# mine\nfade_seconds = 0.3\n[[scene]]\nmodel = \"a statue.ply\"\nseconds = 600\ncaption = \"One\"\n\
        [[scene]]\nlight = \"80,10\"\nends = \"order\"\ncaption = \"Two <b>\"\n[[scene]]\nmodel = \"gone.ply\"\nseconds = 1\n";
    fs::write(&file, scenes).unwrap();
    let wall = RemoteWall::start_in(folder, &["--show", "tour.toml", "--remote", "127.0.0.1:0"]);
    let one = wait_for(&wall, "the first scene", |state| state["show"]["scene"] == 1);
    assert_eq!((&one["show"]["caption"], &one["show"]["n_scenes"]), (&json!("One"), &json!(3)));
    assert_eq!(one["show"]["is_show_playing"], true);
    wall.act(&json!({ "do": "next-scene" }));
    let two = wait_for(&wall, "the second scene", |state| state["show"]["scene"] == 2);
    assert_eq!((&two["show"]["caption"], &two["controls"]["light_deg"]), (&json!("Two <b>"), &json!([80, 10])));
    // The next is missing, so the one after it follows, and the operator reads why.
    wall.act(&json!({ "do": "next-scene" }));
    let again = wait_for(&wall, "the first scene again", |state| state["show"]["scene"] == 1);
    assert!(again["farm"]["alerts"].to_string().contains("Scene 3 is left out: "), "{again}");
    wall.act(&json!({ "do": "pause-show" }));
    wait_for(&wall, "the hold", |state| state["show"]["is_show_playing"] == false);
    wall.act(&json!({ "do": "play-show" }));
    wait_for(&wall, "the show", |state| state["show"]["is_show_playing"] == true);
    // A hand holds the show, too.
    wall.act(&json!({ "do": "orbit", "x": 0.2, "y": 0.0 }));
    wait_for(&wall, "the hand", |state| state["show"]["is_show_playing"] == false);
    wall.act(&json!({ "do": "keep-scene", "caption": "From \"here\"", "seconds": 9 }));
    wait_for(&wall, "the new scene", |state| state["show"]["n_scenes"] == 4);
    let kept = fs::read_to_string(wall.folder.path().join("tour.toml")).unwrap();
    assert!(kept.starts_with(scenes) && kept.contains("seconds = 9.0") && kept.contains("a statue.ply"), "{kept}");
    wall.act(&json!({ "do": "previous-scene" }));
    let four = wait_for(&wall, "the new scene", |state| state["show"]["scene"] == 4);
    assert_eq!(four["show"]["caption"], "From \"here\"");
    // The scene on the wall is edited, and the others keep their models and words.
    wall.act(&json!({ "do": "edit-scene", "scene": 4, "caption": "Here", "seconds": 300 }));
    wait_for(&wall, "the new caption", |state| {
        state["show"]["caption"] == "Here" && state["show"]["scene_seconds"] == 300.0
    });
    wall.act(&json!({ "do": "move-scene", "scene": 4, "to": 1 }));
    let moved = wait_for(&wall, "its new place", |state| state["show"]["scene"] == 1);
    assert_eq!((&moved["show"]["caption"], &moved["show"]["n_scenes"]), (&json!("Here"), &json!(4)));
    wall.act(&json!({ "do": "delete-scene", "scene": 1 }));
    let next = wait_for(&wall, "the scene after it", |state| state["show"]["caption"] == "One");
    assert_eq!((&next["show"]["scene"], &next["show"]["n_scenes"]), (&json!(1), &json!(3)));
    let kept = fs::read_to_string(wall.folder.path().join("tour.toml")).unwrap();
    assert!(kept.starts_with("# mine\nfade_seconds = 0.3\n") && kept.matches("[[scene]]").count() == 3, "{kept}");
    for action in ["delete-scene", "edit-scene"] {
        wall.act(&json!({ "do": action, "scene": 9, "caption": "Nowhere" }));
        wait_for(&wall, "a note", |state| state["show"]["note"] == "The show has no such scene");
    }
}

#[test]
fn a_wall_shows_its_own_model_until_a_scene_of_its_show_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let tour = "repeat = false\n[[scene]]\nmodel = \"late.ply\"\nseconds = 600\ncaption = \"Here at last\"\n";
    fs::write(folder.path().join("tour.toml"), tour).unwrap();
    let wall = RemoteWall::start_in(folder, &["--show", "tour.toml", "--remote", "127.0.0.1:0"]);
    let waiting = wait_for(&wall, "the wall's own model", |state| state["show"]["model"] == "a statue.ply");
    assert_eq!((&waiting["show"]["scene"], &waiting["show"]["is_show_playing"]), (&Value::Null, &json!(true)));
    generate_statue(300, &wall.folder.path().join("late.ply"));
    let shown = wait_for(&wall, "the scene", |state| state["show"]["scene"] == 1);
    assert_eq!((&shown["show"]["model"], &shown["show"]["caption"]), (&json!("late.ply"), &json!("Here at last")));
    wall.act(&json!({ "do": "edit-scene", "scene": 1, "caption": "Edited" }));
    wait_for(&wall, "the new caption", |state| state["show"]["caption"] == "Edited");
    // What somebody has written into the file meanwhile counts, and is not lost.
    let by_hand = tour.replace("Here at last", "By hand");
    fs::write(wall.folder.path().join("tour.toml"), &by_hand).unwrap();
    wall.act(&json!({ "do": "delete-scene", "scene": 1 }));
    let read = wait_for(&wall, "the caption of the file", |state| state["show"]["caption"] == "By hand");
    assert_eq!((&read["show"]["n_scenes"], &read["farm"]["alerts"]), (&json!(1), &json!([])));
    assert_eq!(fs::read_to_string(wall.folder.path().join("tour.toml")).unwrap(), by_hand);
}
