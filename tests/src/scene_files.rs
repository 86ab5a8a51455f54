//! Scene files with the real programs: built once, shared, and cut while they are in use.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    thread,
    time::Duration,
};

use crate::process::Program;

/// A model that is worth a place in the cache.
fn model(folder: &Path) -> PathBuf {
    let path = folder.join("statue.ply");
    let mut command = Program::command("renderer");
    command.args(["generate", "statue", "--triangles", "180000"]).arg(&path);
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

/// Runs a program; returns what it says, and the most kilobytes of memory of its own that it was seen to hold.
#[cfg(target_os = "linux")]
fn said_and_memory(mut command: Command) -> (String, u64) {
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let status = format!("/proc/{}/status", child.id());
    let mut most = 0;
    while child.try_wait().unwrap().is_none() {
        let status = fs::read_to_string(&status).unwrap_or_default();
        let held =
            status.lines().find_map(|line| line.strip_prefix("RssAnon:")?.trim().strip_suffix(" kB")?.parse().ok());
        most = most.max(held.unwrap_or(0));
        thread::sleep(Duration::from_millis(5));
    }
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.success(), "{said}");
    (said, most)
}

#[cfg(target_os = "linux")]
#[test]
fn a_model_that_takes_more_than_the_budget_is_built_in_temporary_files_and_is_the_same() {
    // A disk, unlike the folder for temporary files on many machines.
    let folder = tempfile::tempdir_in(std::env::current_exe().unwrap().parent().unwrap()).unwrap();
    let model = folder.path().join("statue.ply");
    let mut command = Program::command("renderer");
    command.args(["generate", "statue", "--triangles", "2000000"]).arg(&model);
    Program::succeed(command);
    let built = |budget: &str| {
        let file = folder.path().join(format!("{budget}.raywall"));
        let mut command = program("renderer", folder.path());
        command.args(["build", "--memory-budget", budget]).arg(&model).arg(&file);
        let (said, memory) = said_and_memory(command);
        (said, memory, fs::read(file).unwrap(), fs::read_dir(folder.path()).unwrap().count())
    };
    let (said, in_memory, file, n_files) = built("1T");
    assert!(!said.contains("temporary files"), "{said}");
    let (said, beside_files, same, n_files_after) = built("40M");
    if said.contains("no temporary files") {
        return println!("skipped: {said}");
    }
    assert!(said.contains(", more than --memory-budget 40M: temporary files in "), "{said}");
    assert!(file == same && n_files_after == n_files + 1);
    assert!(4 * beside_files < in_memory, "{beside_files} and {in_memory} KB");
}

#[cfg(target_os = "linux")]
#[test]
fn a_scene_file_that_is_cut_ends_its_render_servers_until_they_have_built_another() {
    let folder = tempfile::tempdir().unwrap();
    let (folder, model) = (folder.path(), model(folder.path()));
    let mut wall = Program::start(wall(folder, &model, 1_000_000));
    wall.wait_for("render server local-1 is ready");
    wall.wait_for("render server local-2 is ready");
    fs::File::options().write(true).open(cached(folder)).unwrap().set_len(4096).unwrap();
    wall.wait_for("error: a scene file was cut while it was in use");
    wall.wait_for("lost a file that it had mapped; it starts again in 1 s");
    wall.wait_for(" is ready");
    wall.signal("TERM");
    let (_, said) = wall.wait();
    assert!(!said.contains("panicked"), "{said}");
}
