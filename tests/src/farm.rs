//! Walls and render servers as real processes over real sockets: the picture is right whoever renders it or dies.

use std::{
    io::{Read, Write},
    net::{Shutdown, TcpStream},
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use glam::DVec3;
use renderer::{
    grid::GridOptions,
    model::{mesh::Mesh, statue},
    render::scene::Scene,
};
use serde_json::Value;
use shared::{camera::Camera, protocol::PREAMBLE};
use tempfile::TempDir;

use crate::process::{Program, generate_statue, wait_until};

/// Triangles of the statue in these tests: few, but every part of the picture shows some.
const TRIANGLES: &str = "20000";

/// Files of one test.
pub(crate) struct Files {
    folder: TempDir,
}

impl Files {
    /// Files of a small wall, and of a camera that sees the statue.
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let wall = "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = 2\nrows = 1\npixels = [64, 72]\n";
        std::fs::write(folder.path().join("wall.toml"), wall).unwrap();
        let camera =
            Camera::look_at(DVec3::new(1.0, 1.5, 4.0), DVec3::new(0.0, 0.9, 0.0), DVec3::Y, 0.6, 16.0 / 9.0).unwrap();
        std::fs::write(folder.path().join("camera.toml"), camera.to_toml()).unwrap();
        Self { folder }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn wall(&self, size: &str) -> Command {
        let mut command = Program::command("compositor");
        command
            .args(["--headless", "--listen", "127.0.0.1:0", "--triangles", TRIANGLES, "--size", size])
            .arg("--wall")
            .arg(self.path("wall.toml"))
            .arg("--camera")
            .arg(self.path("camera.toml"))
            .arg("--stats")
            .arg(self.path("stats.json"))
            .env("RUST_LOG", "compositor=debug");
        command
    }

    /// The hash of what `renderer trace` renders alone: the truth for all farms.
    pub(crate) fn traced_hash(&self, size: &str) -> String {
        self.traced_hash_with(size, &[])
    }

    /// Like `traced_hash`, with more arguments.
    pub(crate) fn traced_hash_with(&self, size: &str, args: &[&str]) -> String {
        let image = self.path("traced.png");
        let mut command = Program::command("renderer");
        command.args(["trace", "--triangles", TRIANGLES, "--size", size, "--camera"]);
        command.arg(self.path("camera.toml")).arg("--image").arg(&image).args(args);
        Program::succeed(command);
        hash_of_png(&image)
    }

    pub(crate) fn frames(&self) -> Vec<Value> {
        let stats: Value = serde_json::from_slice(&std::fs::read(self.path("stats.json")).unwrap()).unwrap();
        stats["frames"].as_array().unwrap().clone()
    }
}

/// The hash of a picture's samples, as `--stats` has it.
pub(crate) fn hash_of_png(path: &Path) -> String {
    renderer::render::image::hash_samples(&samples_of_png(path))
}

/// A picture's samples in a frame's order: bottom row first.
pub(crate) fn samples_of_png(path: &Path) -> Vec<u8> {
    let mut reader =
        png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap())).read_info().unwrap();
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut rgb).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    rgb.chunks(info.width as usize * 3).rev().flatten().copied().collect()
}

/// A wall that renders frame after frame until the test ends it.
pub(crate) struct RunningWall {
    files: Files,
    pub(crate) program: Program,
    pub(crate) address: String,
    expected: String,
}

const SIZE: &str = "256x128";

impl RunningWall {
    pub(crate) fn start() -> Self {
        Self::start_with(&[])
    }

    /// Like `start`, with more arguments.
    pub(crate) fn start_with(args: &[&str]) -> Self {
        Self::start_sized(SIZE, args)
    }

    /// Like `start_with`, with frames of another size.
    pub(crate) fn start_sized(size: &str, args: &[&str]) -> Self {
        let files = Files::new();
        let expected = files.traced_hash(size);
        let mut command = files.wall(size);
        command.args(["--frames", "1000000", "--local", "0", "--min-renderers", "1"]).args(args);
        let mut program = Program::start(command);
        let address = program.wait_for_address();
        Self { files, program, address, expected }
    }

    /// The samples that every frame must show: RGB, the bottom row first.
    pub(crate) fn expected_samples(&self) -> Vec<u8> {
        samples_of_png(&self.files.path("traced.png"))
    }

    pub(crate) fn join(&self, name: &str) -> Program {
        Self::join_at(&self.address, name, &[])
    }

    /// Starts a render server for the wall at an address.
    pub(crate) fn join_at(address: &str, name: &str, args: &[&str]) -> Program {
        let mut command = Program::command("renderer");
        command.args(["connect", address, "--name", name, "--threads", "1"]).args(args);
        Program::start(command)
    }

    pub(crate) fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        stream
    }

    /// Waits until `n_ready` render servers have become ready.
    pub(crate) fn wait_for_ready(&mut self, n_ready: usize) {
        self.program.wait_for_count(" is ready", n_ready);
    }

    /// Waits until `n_more` more frames are shown.
    pub(crate) fn wait_for_frames(&mut self, n_more: usize) {
        let n_frames = self.program.count("frame shown") + n_more;
        self.program.wait_for_count("frame shown", n_frames);
    }

    /// Ends the wall as an operator does, checks every frame that it has shown, and returns them and its output.
    pub(crate) fn end(self) -> (Vec<Value>, String) {
        self.program.signal("TERM");
        let (status, said) = self.program.wait();
        assert!(status.success(), "{said}");
        let frames = self.files.frames();
        assert!(!frames.is_empty());
        for (number, frame) in frames.iter().enumerate() {
            assert_eq!(frame["samples_blake3"], self.expected.as_str(), "frame {number} shows another picture");
            assert_eq!(frame["frame"], number + 1, "every frame is shown once, in order");
        }
        (frames, said)
    }
}

pub(crate) fn nodes_of(frame: &Value) -> Vec<&str> {
    frame["nodes"].as_array().unwrap().iter().map(|node| node["name"].as_str().unwrap()).collect()
}

#[test]
fn any_number_of_renderers_gives_the_samples_that_one_gives_alone() {
    let files = Files::new();
    let size = "83x45";
    let expected = files.traced_hash(size);
    for n_renderers in [1, 2, 3, 7, 12] {
        for division in ["interleaved", "tiled", "dynamic"] {
            let mut command = files.wall(size);
            command.args(["--local", &n_renderers.to_string(), "--frames", "3", "--division", division]);
            Program::succeed(command);
            for frame in files.frames() {
                assert_eq!(frame["samples_blake3"], expected.as_str(), "{n_renderers} renderers, {division}");
                assert_eq!(frame["division"], division);
            }
            assert_eq!(nodes_of(&files.frames()[0]).len(), n_renderers, "the first frame waits for all");
        }
    }
}

/// The line about a mesh's memory that a budget causes.
fn shortage(mesh: &Mesh, budget: &str) -> Option<String> {
    let options = GridOptions { memory_budget: budget.parse().unwrap(), ..GridOptions::default() };
    Scene::build(mesh.clone(), &options, &|_| ()).grid.shortage().map(|shortage| shortage.to_string())
}

/// The least budget in which a mesh can be loaded, and its line: the grid is as coarse as can be.
fn least_budget(mesh: &Mesh) -> (String, String) {
    let mut budgets = (400..900).map(|n| format!("{}K", 100 * n)).map(|budget| (shortage(mesh, &budget), budget));
    let (line, budget) = budgets.find(|(line, _)| line.as_ref().is_none_or(|line| !line.contains("loading"))).unwrap();
    (budget, line.unwrap())
}

#[test]
fn a_line_about_a_coarser_grid_names_a_budget_that_is_enough() {
    let mesh = statue::generate(60_000, &|_| ());
    let (_, line) = least_budget(&mesh);
    let enough = line
        .split("--memory-budget ")
        .nth(2)
        .and_then(|rest| rest.strip_suffix(" is enough, on a machine that has as much free"));
    assert_eq!(shortage(&mesh, enough.unwrap()), None, "{line}");
}

#[test]
fn render_servers_with_different_memory_give_the_same_samples() {
    let (budget, _) = least_budget(&statue::generate(TRIANGLES.parse().unwrap(), &|_| ()));
    let mut wall = RunningWall::start_with(&["--division", "interleaved"]);
    let join = |name: &str, args: &[&str]| RunningWall::join_at(&wall.address, name, args);
    let (mut little, mut much) = (join("little", &["--memory-budget", &budget]), join("much", &[]));
    much.wait_for("sets another limit");
    little.wait_for("the grid is made coarser");
    wall.wait_for_ready(2);
    wall.wait_for_frames(5);
    assert!(!much.said().contains("coarser") && !little.said().contains("sets another limit"), "{}", much.said());
    let (frames, _) = wall.end();
    assert!(frames.iter().any(|frame| nodes_of(frame).len() == 2), "both render");
}

#[test]
fn a_killed_renderer_costs_no_sample() {
    let mut wall = RunningWall::start();
    let (_staying, killed) = (wall.join("staying"), wall.join("killed"));
    wall.wait_for_ready(2);
    wall.wait_for_frames(5);
    killed.signal("KILL");
    wall.program.wait_for("killed at");
    wall.wait_for_frames(5);
    let (frames, _) = wall.end();
    assert!(frames.iter().any(|frame| nodes_of(frame).len() == 2));
    assert_eq!(nodes_of(frames.last().unwrap()), ["staying"]);
}

#[test]
fn a_stopped_renderer_is_lost_and_comes_back() {
    let mut wall = RunningWall::start();
    let (_staying, stopped) = (wall.join("staying"), wall.join("stopped"));
    wall.wait_for_ready(2);
    wall.wait_for_frames(3);
    stopped.signal("STOP");
    wall.program.wait_for("stopped has been silent for 250 ms");
    wall.wait_for_frames(3);
    wall.program.wait_for("stopped at");
    assert!(wall.program.said().contains("the peer was silent for 2000 ms"), "{}", wall.program.said());
    stopped.signal("CONT");
    wall.program.wait_for_count("render server stopped is ready", 2);
    wall.wait_for_frames(10);
    let (frames, _) = wall.end();
    assert_eq!(nodes_of(frames.last().unwrap()).len(), 2, "a render server that comes back gets tasks");
}

#[test]
fn a_renderer_that_is_silent_for_a_moment_goes_on() {
    let mut wall = RunningWall::start();
    let (_staying, stopped) = (wall.join("staying"), wall.join("stopped"));
    wall.wait_for_ready(2);
    wall.wait_for_frames(3);
    stopped.signal("STOP");
    wall.program.wait_for("stopped has been silent for 250 ms");
    stopped.signal("CONT");
    wall.program.wait_for("stopped is heard again");
    wall.wait_for_frames(6);
    let (frames, said) = wall.end();
    let last = frames.last().unwrap();
    assert_eq!((nodes_of(last).len(), &last["n_lost"]), (2, &0.into()), "{said}");
}

#[test]
fn a_newcomer_gets_tasks() {
    let mut wall = RunningWall::start();
    let _first = wall.join("first");
    wall.wait_for_frames(3);
    let _second = wall.join("second");
    wall.program.wait_for("render server second is ready");
    wall.wait_for_frames(3);
    let (frames, _) = wall.end();
    assert_eq!(nodes_of(&frames[0]), ["first"]);
    let last = frames.last().unwrap();
    assert_eq!(nodes_of(last), ["first", "second"]);
    assert!(last["nodes"][1]["share"].as_f64().unwrap() > 0.4);
}

#[test]
fn a_picture_can_be_replayed_in_place_of_tracing() {
    let mut wall = RunningWall::start();
    let picture = wall.files.path("traced.png");
    let replay = ["--replay", picture.to_str().unwrap()];
    let _first = RunningWall::join_at(&wall.address, "first", &replay);
    let _second = RunningWall::join_at(&wall.address, "second", &replay);
    wall.wait_for_ready(2);
    wall.wait_for_frames(10);
    wall.end();
}

#[test]
fn a_wall_that_restarts_finds_its_renderers_again() {
    let mut wall = RunningWall::start();
    let mut renderer = wall.join("faithful");
    wall.wait_for_frames(2);
    let address = wall.address.clone();
    wall.end();
    let files = Files::new();
    let mut command = files.wall(SIZE);
    command.args(["--listen", &address, "--local", "0", "--min-renderers", "1", "--frames", "3"]);
    // The later --listen wins.
    Program::succeed(command);
    assert_eq!(files.frames().len(), 3);
    renderer.signal("TERM");
    renderer.wait_for("connected to the wall");
    assert!(renderer.wait().0.success(), "a renderer that is told to stop has not failed");
}

#[test]
fn strangers_are_dropped_with_a_clear_line_and_the_wall_goes_on() {
    let mut wall = RunningWall::start();
    let _renderer = wall.join("good");
    wall.wait_for_frames(2);

    let mut other_version = PREAMBLE;
    other_version[7] += 1;
    wall.connect().write_all(&other_version).unwrap();
    wall.program.wait_for("build both from one commit");

    wall.connect().write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
    wall.program.wait_for("the peer speaks another protocol");

    let mut oversized = PREAMBLE.to_vec();
    oversized.extend(1_000_000_u32.to_le_bytes());
    oversized.push(0);
    wall.connect().write_all(&oversized).unwrap();
    wall.program.wait_for("a message of 1000000 bytes: at most 1024 are allowed");

    let mut garbage = PREAMBLE.to_vec();
    garbage.extend(100_u32.to_le_bytes());
    garbage.extend([0; 1]);
    garbage.extend((0..100_u32).map(|byte| (byte.wrapping_mul(2_654_435_761) >> 24) as u8));
    wall.connect().write_all(&garbage).unwrap();
    wall.program.wait_for("malformed message");

    // Half open: it sends nothing and never closes the connection.
    let mut silent = wall.connect();
    wall.program.wait_for("no handshake within");
    let mut rest = Vec::new();
    silent.read_to_end(&mut rest).unwrap();
    assert_eq!(rest, PREAMBLE, "the wall has closed the connection");

    // Closed in the middle of a message.
    let mut cut = wall.connect();
    cut.write_all(&garbage[..20]).unwrap();
    cut.shutdown(Shutdown::Write).unwrap();
    wall.program.wait_for("closed in mid-message");

    wall.wait_for_frames(3);
    let (frames, _) = wall.end();
    assert!(frames.iter().all(|frame| nodes_of(frame) == ["good"]));
}

#[test]
fn a_renderer_on_the_walls_machine_reads_the_walls_file() {
    let files = Files::new();
    generate_statue(1000, &files.path("model.ply"));
    // The wall names its file in full, from whichever folder it was started.
    let start = |address: &str, model: &Path| {
        let mut command = Program::command("compositor");
        command.args(["--headless", "--listen", address, "--local", "0", "--frames", "2", "--size", "64x32"]);
        command.arg("--model").arg(model).current_dir(files.path(""));
        Program::start(command)
    };
    let mut wall = start("127.0.0.1:0", "model.ply".as_ref());
    let address = wall.wait_for_address();
    let mut server = RunningWall::join_at(&address, "beside", &[]);
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");
    server.wait_for("has closed the connection; trying again until it answers");
    let (status, said) = start(&address, &files.path("model.ply")).wait();
    assert!(status.success(), "{said}");
    server.wait_for_count("has closed the connection; trying again until it answers", 2);
    assert!(!server.said().contains("WARN"), "an orderly end is no warning\n{}", server.said());
}

#[test]
fn a_renderer_that_cannot_read_the_walls_file_says_so_itself() {
    let files = Files::new();
    generate_statue(1000, &files.path("model.ply"));
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--frames", "1000000", "--size", "64x32"]);
    command.arg("--model").arg(files.path("model.ply")).env("RUST_LOG", "compositor=debug");
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    wall.wait_for("frame shown");
    std::fs::remove_file(files.path("model.ply")).unwrap();
    let mut server = RunningWall::join_at(&address, "beside", &[]);
    for program in [&mut server, &mut wall] {
        program.wait_for("model.ply: cannot be read: ");
        program.wait_for("; --model FILE names the file that the wall shows");
    }
}

#[test]
fn a_renderer_without_the_model_is_told_the_cure() {
    let files = Files::new();
    generate_statue(2000, &files.path("other.ply"));
    generate_statue(3000, &files.path("model.ply"));
    let mut command = Program::command("compositor");
    command
        .args(["--headless", "--listen", "127.0.0.1:0", "--local", "0", "--frames", "2", "--size", "64x32", "--model"])
        .arg(files.path("model.ply"))
        .arg("--wall")
        .arg(files.path("wall.toml"));
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    let join = |model: &str| RunningWall::join_at(&address, model, &["--model", files.path(model).to_str().unwrap()]);
    let _other = join("other.ply");
    wall.wait_for("give it the wall's own file");
    let _right = join("model.ply");
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");
}

/// A sky image of one colour.
fn write_sky(path: &Path, light: u8) {
    let header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n".to_vec();
    std::fs::write(path, [header, [light, light, light, 128].repeat(32)].concat()).unwrap();
}

#[test]
fn a_sky_image_reaches_local_servers_and_others_are_told_the_cure() {
    let files = Files::new();
    let [sky, other, picture] = ["sky.hdr", "other.hdr", "wall.png"].map(|name| files.path(name));
    write_sky(&sky, 200);
    write_sky(&other, 100);
    let mut pictures = Vec::new();
    for n_local in [1, 0] {
        let mut command = Program::command("compositor");
        command.args(["--headless", "--listen", "127.0.0.1:0", "--frames", "2", "--size", "64x32", "--rays", "path"]);
        command.args(["--triangles", "1000", "--samples", "4", "--local", &n_local.to_string(), "--sky"]).arg(&sky);
        command.arg("--wall").arg(files.path("wall.toml")).arg("--screenshot").arg(&picture);
        let mut wall = Program::start(command);
        let address = wall.wait_for_address();
        let mut servers = Vec::new();
        if n_local == 0 {
            let join = |name: &str, sky: &Path| RunningWall::join_at(&address, name, &["--sky", sky.to_str().unwrap()]);
            let mut wrong = join("wrong", &other);
            wrong.wait_for("give it the wall's own file");
            servers.extend([wrong, join("right", &sky)]);
        }
        let (status, said) = wall.wait();
        assert!(status.success(), "{said}");
        pictures.push(std::fs::read(&picture).unwrap());
    }
    assert_eq!(pictures[0], pictures[1]);
}

/// The running local render servers: the process identifiers of their wall and of themselves.
pub(crate) fn local_renderers() -> Vec<(u32, u32)> {
    let output = Command::new("ps").args(["-e", "-o", "ppid=,pid=,args="]).output().unwrap();
    let lines = String::from_utf8_lossy(&output.stdout).into_owned();
    let number = |line: &str, at: usize| line.split_whitespace().nth(at).unwrap().parse().unwrap();
    let is_one = |line: &&str| line.contains("renderer connect") && line.contains("--local");
    lines.lines().filter(is_one).map(|line| (number(line, 0), number(line, 1))).collect()
}

pub(crate) fn local_renderers_of(wall: &Program) -> Vec<u32> {
    local_renderers().into_iter().filter(|&(parent, _)| parent == wall.id()).map(|(_, pid)| pid).collect()
}

#[test]
fn local_renderers_end_with_a_wall_that_is_killed() {
    let files = Files::new();
    let mut command = files.wall("64x32");
    command.args(["--local", "2", "--frames", "1000000"]);
    let mut wall = Program::start(command);
    wall.wait_for("frame shown");
    let pids = local_renderers_of(&wall);
    assert_eq!(pids.len(), 2);
    wall.signal("KILL");
    wait_until("the local render servers end", || !local_renderers().iter().any(|(_, pid)| pids.contains(pid)));
}

#[test]
fn a_local_renderer_that_was_lost_comes_back() {
    let files = Files::new();
    let mut command = files.wall("64x32");
    command.args(["--local", "1", "--frames", "1000000"]);
    let mut wall = Program::start(command);
    wall.wait_for("frame shown");
    let pid = local_renderers_of(&wall)[0].to_string();
    let kill = |signal: &str| assert!(Command::new("kill").args([signal, &pid]).status().unwrap().success());
    kill("-STOP");
    wall.wait_for("silent for 2000 ms");
    kill("-CONT");
    wall.wait_for_count("local-1 is ready", 2);
    let n_shown = wall.count("frame shown");
    wall.wait_for_count("frame shown", n_shown + 3);
}

#[test]
fn a_local_renderer_that_is_killed_is_reported_with_a_possible_cause_and_starts_again() {
    let files = Files::new();
    let mut command = files.wall("64x32");
    command.args(["--local", "2", "--frames", "1000000"]);
    let mut wall = Program::start(command);
    wall.wait_for("frame shown");
    let pid = local_renderers_of(&wall)[0].to_string();
    assert!(Command::new("kill").args(["-KILL", &pid]).status().unwrap().success());
    wall.wait_for("because memory ran out: ");
    wall.wait_for("; it starts again in 1 s");
    // The other goes on alone, though the first frame waited for both.
    let n_frames = wall.count("frame shown");
    wall.wait_for_count("frame shown", n_frames + 5);
    wall.wait_for_count(" is ready", 3);
    assert_eq!(local_renderers_of(&wall).len(), 2);
    wall.signal("TERM");
    let (_, said) = wall.wait();
    assert_eq!(said.matches("was killed").count(), 1, "the wall ends the other one itself\n{said}");
}

#[cfg(unix)]
#[test]
fn a_model_whose_name_is_no_text_is_found_by_local_renderers() {
    use std::os::unix::ffi::OsStrExt;
    let files = Files::new();
    let model = files.folder.path().join(std::ffi::OsStr::from_bytes(b"b\xfcste.ply"));
    generate_statue(1000, &model);
    let mut command = Program::command("compositor");
    command
        .args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--frames", "1", "--size", "64x32", "--wall"])
        .arg(files.path("wall.toml"))
        .arg("--model")
        .arg(&model);
    let said = Program::succeed(command);
    assert!(said.contains("local-1 is ready"), "{said}");
}
