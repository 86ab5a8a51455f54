//! SIGTERM and Ctrl-C end every program soon, in every phase, with a status and a line that say what was cut off.

use std::{
    fs,
    path::Path,
    thread,
    time::{Duration, Instant},
};

use glam::DVec3;
use shared::camera::{Camera, CameraPath, UpAxis};

use crate::{
    farm::{Files, local_renderers, local_renderers_of},
    process::{Program, wait_until},
};

/// A program that is told to stop ends within a second; a busy machine may take longer.
const SOON: Duration = Duration::from_secs(5);

/// A statue of this many triangles takes a minute to generate: far more than [`SOON`].
const HUGE: [&str; 2] = ["--triangles", "80000000"];

/// Exit codes of programs whose work a signal has cut off.
const INTERRUPTED: i32 = 130;
const TERMINATED: i32 = 143;

/// Sends a signal; returns the exit code and the output.
fn stop(program: Program, signal: &str) -> (Option<i32>, String) {
    program.signal(signal);
    let signalled_at = Instant::now();
    let (status, said) = program.wait();
    let took = signalled_at.elapsed();
    assert!(took < SOON, "it took {took:?} to stop\n{said}");
    (status.code(), said)
}

/// Sends a signal that must cut off work; returns the line that says so.
fn cut_off(program: Program, signal: &str) -> String {
    let (code, said) = stop(program, signal);
    let expected = if signal == "INT" { INTERRUPTED } else { TERMINATED };
    assert_eq!(code, Some(expected), "{said}");
    let lines: Vec<_> = said.lines().filter(|line| line.starts_with("stopped ")).collect();
    let [line] = lines[..] else { panic!("not one line says what was cut off\n{said}") };
    line.to_owned()
}

/// Waits until a program is at what it began last.
fn a_moment() {
    thread::sleep(Duration::from_millis(500));
}

/// Writes triangles that coincide: a ray that hits one tests them all.
fn write_coincident(n_triangles: usize, path: &Path) {
    let header = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
         element face {n_triangles}\nproperty list uchar int vertex_indices\nend_header\n"
    );
    let corners = [0.0_f32, 0.0, 0.0, 1.0, 0.3, 0.2, 0.0, 1.0, 0.5].map(f32::to_le_bytes);
    let face = [&[3][..], [0_i32, 1, 2].map(i32::to_le_bytes).as_flattened()].concat();
    let file = [header.as_bytes(), corners.as_flattened(), &face.repeat(n_triangles)].concat();
    fs::write(path, file).expect("the folder can be written");
}

#[test]
fn a_wall_that_loads_is_cut_off_and_its_local_servers_end_quietly() {
    for signal in ["TERM", "INT"] {
        let mut command = Program::command("compositor");
        command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1"]).args(HUGE);
        let mut wall = Program::start(command);
        wall.wait_for("connected to the wall");
        wall.wait_for("loading the built-in statue");
        a_moment();
        let servers = local_renderers_of(&wall);
        assert_eq!(servers.len(), 1);
        assert_eq!(cut_off(wall, signal), "stopped while loading the built-in statue");
        wait_until("the local server ends", || !local_renderers().iter().any(|(_, id)| servers.contains(id)));
    }
}

#[test]
fn single_commands_are_cut_off_and_leave_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let start = |args: &[&str]| {
        let mut command = Program::command("renderer");
        command.args(args).current_dir(folder.path());
        let program = Program::start(command);
        a_moment();
        program
    };
    let trace = start(&["trace", "--image", "statue.png", HUGE[0], HUGE[1]]);
    assert_eq!(cut_off(trace, "INT"), "stopped while loading the built-in statue");
    let generate = start(&["generate", "statue", HUGE[0], HUGE[1], "statue.ply"]);
    assert_eq!(cut_off(generate, "TERM"), "stopped while generating 80000000 triangles");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Starts a server for a wall of its own, and tells it to stop while its first task takes a minute.
fn stop_at_first_task(wall_args: &[&str], server_args: &[&str]) {
    let files = Files::new();
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "0", "--wall"]).arg(files.path("wall.toml"));
    command.args(wall_args);
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    let mut command = Program::command("renderer");
    command.args(["connect", &address, "--name", "busy", "--threads", "1"]).args(server_args);
    let server = Program::start(command);
    wall.wait_for("busy is ready");
    a_moment();
    let (code, said) = stop(server, "TERM");
    assert_eq!(code, Some(0), "a server that is told to stop has not failed\n{said}");
    wall.wait_for("busy at");
    let line = cut_off(wall, "INT");
    assert!(line.starts_with("stopped before the first frame"), "{line}");
}

#[test]
fn a_server_stops_in_the_middle_of_a_heavy_task() {
    stop_at_first_task(&["--size", "4096x2304", "--rays", "ambient"], &[]);
}

#[test]
fn triangles_that_coincide_delay_no_end() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("coincident.ply");
    let model = ["--model", path.to_str().unwrap()];
    write_coincident(2_000_000, &path);
    let mut command = Program::command("renderer");
    command.args(["connect", "127.0.0.1:9"]).args(model);
    let mut server = Program::start(command);
    server.wait_for("loading");
    a_moment();
    assert_eq!(cut_off(server, "TERM"), format!("stopped while loading {}", path.display()));
    // Each chunk takes a server ten seconds.
    write_coincident(500_000, &path);
    stop_at_first_task(&model, &model);
}

#[test]
fn a_film_that_is_cut_off_keeps_its_complete_pictures() {
    let files = Files::new();
    let folder = files.path("film");
    // Large pictures: their writers are at work whenever the signal comes.
    let wall = "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = 2\nrows = 1\npixels = [960, 1080]\n";
    fs::write(files.path("wall.toml"), wall).unwrap();
    let start = Camera::from_toml(&fs::read_to_string(files.path("camera.toml")).unwrap()).unwrap();
    let path = CameraPath::new(vec![(0.0, start), (60.0, start.orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2))], UpAxis::Y);
    fs::write(files.path("path.toml"), path.unwrap().to_toml()).unwrap();
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--triangles", "20000", "--size", "64x36", "--local", "1"]);
    command.arg("--wall").arg(files.path("wall.toml")).arg("--path").arg(files.path("path.toml"));
    command.args(["--fps", "30", "--pictures"]).arg(&folder);
    let wall = Program::start(command);
    wait_until("three pictures are written", || folder.join("picture-000003.png").exists());
    let line = cut_off(wall, "TERM");
    let names: Vec<_> =
        fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    let (n_written, folder) = (names.len(), folder.display());
    assert_eq!(
        line,
        format!(
            "stopped after {n_written} of 1801 pictures; those in {folder} are complete: the same command with --resume goes on"
        )
    );
    for name in names {
        let picture = crate::references::read_png(&files.path("film").join(&name)).unwrap();
        assert_eq!(picture.size, [1920, 1080], "{name}");
    }
}

#[test]
fn a_video_that_is_cut_off_leaves_nothing() {
    if std::process::Command::new("ffmpeg").arg("-version").stdout(std::process::Stdio::null()).status().is_err() {
        return println!("skipped: ffmpeg is not installed");
    }
    let files = Files::new();
    let start = Camera::from_toml(&fs::read_to_string(files.path("camera.toml")).unwrap()).unwrap();
    let path = CameraPath::new(vec![(0.0, start), (600.0, start.orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2))], UpAxis::Y);
    fs::write(files.path("path.toml"), path.unwrap().to_toml()).unwrap();
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--triangles", "20000", "--local", "1", "--size", "64x36"]);
    command.arg("--wall").arg(files.path("wall.toml")).arg("--path").arg(files.path("path.toml"));
    command.arg("--film").arg(files.path("film.mp4"));
    let mut wall = Program::start(command);
    wall.wait_for("picture 1 of 18001");
    let line = cut_off(wall, "INT");
    assert!(line.contains(" of 18001 pictures; ") && line.contains("film.mp4 is not written"), "{line}");
    let names = fs::read_dir(files.path("")).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let left: Vec<_> = names.filter(|name| !name.ends_with(".toml")).collect();
    assert!(left.is_empty(), "{left:?}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_window_that_waits_for_its_first_model_is_cut_off() {
    let session = crate::x_session::XSession::start([640, 360]);
    let start = |args: &[&str]| {
        let mut command = session.wall(&["--local", "1"]);
        command.args(HUGE).args(args);
        let mut wall = Program::start(command);
        wall.wait_for("loading the built-in statue");
        session.wait_for_window("Raywall");
        wall
    };
    assert_eq!(cut_off(start(&[]), "INT"), "stopped while loading the built-in statue");
    // The supervisor hands on what the wall says.
    assert_eq!(cut_off(start(&["--kiosk"]), "TERM"), "stopped while loading the built-in statue");
}
