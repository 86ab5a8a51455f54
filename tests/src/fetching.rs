//! Scenes that travel: render servers without the model fetch the wall's scene file, with the real programs over real sockets.

use std::{
    fs,
    io::{Read, Seek, SeekFrom, Write},
    net::TcpStream,
    path::{Path, PathBuf},
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::SeqCst},
    },
    time::Duration,
};

use serde_json::Value;
use shared::{
    codec::HEADER_BYTES,
    protocol::{PREAMBLE, ToServer, ToWall},
    scene::{SceneId, Treatment},
};
use tempfile::TempDir;

use crate::{
    liars::{self, message},
    process::{Program, generate_statue},
    proxy::{self, Direction},
};

/// Two machines, as far as files go: each has a folder and a cache of its own.
struct Machines(TempDir);

/// The scene file of this many triangles has about 17 MB.
const TRIANGLES: u32 = 320_000;

/// A chunk of a scene file.
const CHUNK: usize = 1 << 20;

impl Machines {
    /// The wall's machine has a model, and the other does not.
    fn new() -> Self {
        let machines = Self(tempfile::tempdir().unwrap());
        ["wall", "node"].iter().for_each(|machine| fs::create_dir(machines.path(machine)).unwrap());
        generate_statue(TRIANGLES, &machines.path("wall/statue.ply"));
        machines
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// A program on one of the machines.
    fn on(&self, machine: &str, mut command: Command) -> Command {
        command.current_dir(self.path(machine)).env("XDG_CACHE_HOME", self.path(machine).join("cache"));
        command
    }

    /// A wall, whose model has a path that leads to another place on the other machine.
    fn wall(&self, args: &[&str]) -> (Program, String) {
        let mut command = self.on("wall", Program::command("compositor"));
        command.args(["/proc/self/cwd/statue.ply", "--headless", "--listen", "127.0.0.1:0", "--size", "128x64"]);
        command.args(["--min-renderers", "1", "--stats", "stats.json"]).args(args);
        let mut wall = Program::start(command);
        let address = wall.wait_for_address();
        (wall, address)
    }

    fn node_command(&self, address: &str, args: &[&str]) -> Command {
        let mut command = self.on("node", Program::command("renderer"));
        command.args(["connect", address, "--name", "far", "--threads", "1"]).args(args);
        command
    }

    fn node(&self, address: &str, args: &[&str]) -> Program {
        Program::start(self.node_command(address, args))
    }

    /// The files in the other machine's cache that have an ending.
    fn in_cache(&self, ending: &str) -> Vec<PathBuf> {
        let entries = fs::read_dir(self.path("node/cache/raywall")).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|it| it == ending)).collect()
    }

    fn frames(&self) -> Vec<Value> {
        let stats: Value = serde_json::from_slice(&fs::read(self.path("wall/stats.json")).unwrap()).unwrap();
        stats["frames"].as_array().unwrap().clone()
    }

    /// The hash of the frame that a render server with the model renders.
    fn expected(&self) -> Value {
        let (wall, _) = self.wall(&["--local", "1", "--frames", "1"]);
        assert!(wall.wait().0.success());
        self.frames()[0]["samples_blake3"].clone()
    }
}

#[test]
fn a_node_without_the_model_fetches_it_once_and_renders_the_same_bits() {
    let machines = Machines::new();
    let key = machines.path("wall.key");
    let mut make_key = Program::command("renderer");
    make_key.arg("key").arg(&key);
    Program::succeed(make_key);
    let key = key.to_str().unwrap();
    for is_second in [false, true] {
        let (wall, address) = machines.wall(&["--local", "0", "--frames", "2", "--key", key]);
        let mut node = machines.node(&address, &["--key", key]);
        let (status, said) = wall.wait();
        assert!(status.success(), "{said}");
        assert_eq!(said.contains("render servers may fetch"), !is_second, "{said}");
        node.wait_for("triangles in ");
        assert!(node.said().contains(", mapped"), "{}", node.said());
        let frames = machines.frames();
        assert!(frames.iter().all(|frame| frame["nodes"][0]["name"] == "far"), "{frames:?}");
        let shown = frames[0]["samples_blake3"].clone();
        assert_eq!(shown, machines.expected());
    }
    assert_eq!((machines.in_cache("raywall").len(), machines.in_cache("fetch").len()), (1, 0));
    let mut cache = machines.on("node", Program::command("renderer"));
    cache.arg("cache");
    assert!(Program::succeed(cache).starts_with("fetched from a wall: 3"));
}

#[test]
fn a_transfer_that_is_cut_goes_on_where_it_was_and_a_wrong_chunk_is_refused() {
    let machines = Machines::new();
    let (mut wall, address) = machines.wall(&["--local", "0", "--frames", "1000000"]);
    // Connection 0 renders. The first transfer is cut, the second changed, and the third left alone.
    let sent: Arc<[AtomicUsize; 8]> = Arc::default();
    let counted = Arc::clone(&sent);
    let far = proxy::start_cutting(&address, 16 * 1024, move |number, direction, bytes| {
        if direction == Direction::ToWall {
            return true;
        }
        let n_before = counted[number.min(7)].fetch_add(bytes.len(), SeqCst);
        let holds = |place: usize| (n_before..n_before + bytes.len()).contains(&place);
        let (is_cut, is_changed) = (holds(5 * CHUNK + CHUNK / 2), holds(4 * CHUNK + 20_000));
        if number == 2 && is_changed {
            bytes[4 * CHUNK + 20_000 - n_before] ^= 1;
        }
        !(number == 1 && is_cut)
    });
    let mut node = machines.node(&far, &[]);
    // Five megabytes came before the cut, and four before the wrong one: none of them again.
    node.wait_for("it cannot fetch the model: the wall's scene file: its megabyte number 10 is damaged");
    wall.wait_for("render server far cannot render yet: it cannot fetch ");
    node.wait_for("is ready: ");
    wall.wait_for("render server far is ready");
    let n_bytes = fs::metadata(&machines.in_cache("raywall")[0]).unwrap().len() as usize;
    let n_sent: Vec<_> = sent.iter().map(|sent| sent.load(SeqCst)).collect();
    let headers = 10_000;
    assert!((5 * CHUNK..6 * CHUNK).contains(&n_sent[1]), "{n_sent:?}");
    assert!(n_sent[3] < n_bytes - 9 * CHUNK + headers, "{n_sent:?} of {n_bytes}");
    wall.signal("TERM");
    let (_, said) = wall.wait();
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn a_part_that_a_node_leaves_is_listed_and_cleared() {
    let machines = Machines::new();
    let (mut wall, address) = machines.wall(&["--local", "0", "--frames", "1000000"]);
    let sent: Arc<[AtomicUsize; 8]> = Arc::default();
    // Each transfer brings two chunks.
    let far = proxy::start_cutting(&address, 16 * 1024, move |number, direction, bytes| {
        let is_counted = number > 0 && direction == Direction::ToServer;
        !is_counted || sent[number.min(7)].fetch_add(bytes.len(), SeqCst) < 2 * CHUNK + CHUNK / 2
    });
    let node = machines.node(&far, &[]);
    wall.wait_for("render server far cannot render yet: it cannot fetch ");
    drop(node);
    let cache = |args: &[&str]| {
        let mut command = machines.on("node", Program::command("renderer"));
        command.arg("cache").args(args);
        Program::succeed(command)
    };
    let listed = cache(&[]);
    let is_told = listed.starts_with(&format!("fetched from a wall in part: {TRIANGLES}"))
        && listed.contains(" MB of 17 MB, used ");
    assert!(is_told && listed.contains(": 0 scenes, 1 part, "), "{listed}");
    assert!(cache(&["--clear"]).contains(" MB are free again") && machines.in_cache("fetch").is_empty());
    assert!(cache(&[]).contains(": 0 scenes, 0 B of at most"), "{}", cache(&[]));
}

#[test]
fn a_file_that_is_damaged_at_the_wall_is_made_again() {
    let machines = Machines::new();
    assert!(machines.wall(&["--local", "1", "--frames", "1"]).0.wait().0.success());
    let (mut wall, address) = machines.wall(&["--local", "0", "--frames", "1000000"]);
    let kept = scene_file(&machines.path("wall/cache/raywall"));
    let mut file = fs::File::options().read(true).write(true).open(&kept).unwrap();
    file.seek(SeekFrom::Start(9_500_000)).unwrap();
    file.write_all(b"changed").unwrap();
    let mut node = machines.node(&address, &[]);
    wall.wait_for("render server far is ready");
    node.wait_for("is ready: ");
    wall.signal("TERM");
    let (_, said) = wall.wait();
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn walls_without_a_key_have_fetched_files_of_their_own() {
    let machines = Machines::new();
    for n_files in [1, 2] {
        let (wall, address) = machines.wall(&["--local", "0", "--frames", "1000000"]);
        let mut node = machines.node(&address, &[]);
        node.wait_for("is ready: ");
        assert_eq!(machines.in_cache("raywall").len(), n_files);
        wall.signal("TERM");
        wall.wait();
    }
}

#[test]
fn a_node_takes_no_more_than_its_operator_allows() {
    let machines = Machines::new();
    let (mut wall, address) = machines.wall(&["--local", "0", "--frames", "1000000"]);
    let mut limited = machines.node(&address, &["--fetch-limit", "16M"]);
    let told = "it cannot fetch the model: its scene file has 17 MB, more than --fetch-limit 16M: raise it";
    limited.wait_for(told);
    wall.wait_for(told);
    drop(limited);
    let mut alone = machines.node(&address, &["--no-fetch"]);
    alone.wait_for("cannot be read: No such file");
    std::thread::sleep(Duration::from_millis(300));
    assert!(!alone.said().contains("fetch"), "{}", alone.said());
    drop(alone);
    let mut without = machines.node(&address, &["--no-cache"]);
    without.wait_for("it cannot be fetched: it keeps no scene files: start it without --no-cache");
    drop(without);
    let mut homeless = machines.node_command(&address, &[]);
    homeless.env_remove("HOME").env_remove("XDG_CACHE_HOME");
    let mut homeless = Program::start(homeless);
    homeless.wait_for("it cannot be fetched: there is no folder for scene files");
    drop(homeless);
    assert!(machines.in_cache("fetch").is_empty() && machines.in_cache("raywall").is_empty());

    // A disk that takes five megabytes of a file: the rest of it is for others.
    let node = machines.node_command(&address, &[]);
    let mut full = machines.on("node", Command::new("bash"));
    full.args(["-c", "trap '' XFSZ; ulimit -f 5000; exec \"$0\" \"$@\""]).arg(node.get_program()).args(node.get_args());
    let mut full = Program::start(full);
    full.wait_for("it cannot fetch the model: its scene file cannot be written to ");
    wall.wait_for("free some of the disk, or name a folder on another with XDG_CACHE_HOME");
    assert!(machines.in_cache("fetch").is_empty() && machines.in_cache("raywall").is_empty());
}

#[test]
fn frames_go_on_while_a_scene_travels() {
    let machines = Machines::new();
    let expected = machines.expected();
    let (mut wall, address) = machines.wall(&["--local", "1", "--frames", "1000000"]);
    wall.wait_for("render server local-1 is ready");
    let _node = machines.node(&address, &[]);
    wall.wait_for("render server far is ready");
    // A busy machine takes a while for the frame that includes the newcomer.
    std::thread::sleep(Duration::from_secs(2));
    wall.signal("TERM");
    assert!(wall.wait().0.success());
    let frames = machines.frames();
    assert!(frames.iter().all(|frame| frame["samples_blake3"] == expected && frame["n_lost"] == 0));
    // None on a machine so busy that all of it came between two frames.
    for node in frames.iter().filter_map(|frame| frame["fetching"].as_array()?.first()) {
        assert!(node["name"] == "far" && node["n_done"].as_u64() <= node["n_bytes"].as_u64(), "{node}");
    }
    assert!(frames.last().unwrap()["nodes"].as_array().unwrap().len() == 2, "it takes part");
}

/// Opens a transfer of a scene.
fn ask(address: &str, scene: SceneId) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.write_all(&[&PREAMBLE[..], &message(&ToWall::FetchScene { scene })].concat()).unwrap();
    stream.read_exact(&mut [0; PREAMBLE.len()]).unwrap();
    stream
}

#[test]
fn a_wall_gives_nothing_but_its_scene() {
    let machines = Machines::new();
    let (mut wall, address) = machines.wall(&["--local", "1", "--frames", "1000000"]);
    wall.wait_for("render server local-1 is ready");
    let other = SceneId::Mesh { blake3: [7; 32], treatment: Treatment::default() };
    let refused = ToServer::Refused { reason: "it shows another model".to_owned() };
    assert_eq!(liars::receive(&mut ask(&address, other)).unwrap(), refused);

    // A render server may fetch the scene that it is told to load.
    let mut server = TcpStream::connect(&address).unwrap();
    liars::shake_hands(&mut server, "asks").unwrap();
    let scene = loop {
        if let ToServer::LoadScene { scene, .. } = liars::receive(&mut server).unwrap() {
            break scene;
        }
    };
    let file = |stream: &mut TcpStream| loop {
        match liars::receive(stream).unwrap() {
            ToServer::SceneFileAwaited { .. } => {}
            ToServer::SceneFile { n_bytes, .. } => break n_bytes,
            other => panic!("{other:?}"),
        }
    };
    let n_bytes = file(&mut ask(&address, scene));
    for (first, n_asked) in [(n_bytes, 1), (u64::MAX, 1), (0, 0), (0, CHUNK as u32 + 1), (n_bytes - 10, 11)] {
        let mut stream = ask(&address, scene);
        assert_eq!(file(&mut stream), n_bytes);
        stream.write_all(&message(&ToWall::FetchPart { first, n_bytes: n_asked })).unwrap();
        assert_eq!(stream.read_to_end(&mut Vec::new()).unwrap(), 0, "{n_asked} bytes from {first} on");
    }
    // The bytes are those of the file.
    let mut stream = ask(&address, scene);
    file(&mut stream);
    stream.write_all(&message(&ToWall::FetchPart { first: n_bytes - 4096, n_bytes: 4096 })).unwrap();
    let mut part = vec![0; HEADER_BYTES + 4096];
    stream.read_exact(&mut part).unwrap();
    let cached = scene_file(&machines.path("wall/cache/raywall"));
    assert!(fs::read(cached).unwrap().ends_with(&part[HEADER_BYTES..]));
}

fn scene_file(folder: &Path) -> PathBuf {
    let mut entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.find(|path| path.extension().is_some_and(|it| it == "raywall")).expect("a scene file")
}
