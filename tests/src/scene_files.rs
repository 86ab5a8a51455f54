//! Scene files with the real programs: built once, shared, and cut while they are in use.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use crate::process::Program;

/// A model that is worth a place in the cache.
fn model(folder: &Path) -> PathBuf {
    let path = folder.join("statue.ply");
    let mut command = Program::command("renderer");
    command.args(["generate", "statue", "--triangles", "150000"]).arg(&path);
    Program::succeed(command);
    path
}

/// A program that keeps its scenes in this folder.
fn program(name: &str, folder: &Path) -> Command {
    let mut command = Program::command(name);
    command.env("XDG_CACHE_HOME", folder);
    command
}

fn wall(folder: &Path, model: &Path, n_frames: u32) -> Command {
    let mut command = program("compositor", folder);
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "2", "--size", "128x64"]);
    command.args(["--frames", &n_frames.to_string()]).arg(model);
    command
}

/// The scene in the cache of a folder.
fn cached(folder: &Path) -> PathBuf {
    let entries = fs::read_dir(folder.join("raywall")).unwrap().flatten().map(|entry| entry.path());
    entries.into_iter().find(|path| path.extension().is_some_and(|it| it == "raywall")).expect("a scene")
}

#[test]
fn wall_and_render_servers_build_a_model_once_and_show_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let (folder, model) = (folder.path(), model(folder.path()));
    let shown = |model: &Path, name: &str, args: &[&str]| {
        let picture = folder.join(name);
        let mut command = wall(folder, model, 2);
        command.args(args).arg("--screenshot").arg(&picture);
        (Program::succeed(command), fs::read(picture).unwrap())
    };
    let (said, picture) = shown(&model, "first.png", &[]);
    assert_eq!(said.matches(", mapped").count(), 2, "{said}");
    let (said, again) = shown(&model, "second.png", &[]);
    assert!(said.matches(", mapped").count() == 2 && picture == again, "{said}");
    let (said, again) = shown(&model, "third.png", &["--no-cache"]);
    assert!(!said.contains(", mapped") && picture == again, "{said}");

    // A scene file takes the model's place, on the wall and on its render servers.
    let file = folder.join("statue.raywall");
    let mut command = program("renderer", folder);
    command.arg("build").arg(&model).arg(&file);
    let said = Program::succeed(command);
    assert!(said.contains("statue.raywall: 1"), "{said}");
    let (said, again) = shown(&file, "fourth.png", &[]);
    assert!(said.matches(", mapped").count() == 2 && picture == again, "{said}");

    let cache = |args: &[&str]| {
        let mut command = program("renderer", folder);
        command.arg("cache").args(args);
        Program::succeed(command)
    };
    assert!(cache(&[]).contains("statue.ply: 1") && cache(&[]).contains(": 1 scene, "), "{}", cache(&[]));
    assert!(cache(&["--clear"]).contains(" are free again") && cache(&[]).contains(": 0 scenes, 0 "), "{}", cache(&[]));
}

#[cfg(target_os = "linux")]
#[test]
fn a_scene_file_that_is_cut_ends_its_render_servers_but_not_the_wall() {
    let folder = tempfile::tempdir().unwrap();
    let (folder, model) = (folder.path(), model(folder.path()));
    let mut wall = Program::start(wall(folder, &model, 1_000_000));
    wall.wait_for("render server local-1 is ready");
    wall.wait_for("render server local-2 is ready");
    fs::File::options().write(true).open(cached(folder)).unwrap().set_len(4096).unwrap();
    wall.wait_for("error: a scene file was cut while it was in use");
    wall.wait_for("ended (signal: 7 (SIGBUS)) and stays away");
    wall.signal("TERM");
    let (_, said) = wall.wait();
    assert!(!said.contains("panicked"), "{said}");
}
