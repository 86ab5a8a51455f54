//! Walls and render servers with keys, as real processes: the same pictures, and no entry for anybody else.

use std::{
    io::{Read, Write},
    net::{TcpListener, TcpStream},
    path::Path,
    sync::{Arc, Mutex},
};

use channel::key::Key;
use shared::protocol::{PREAMBLE, SECURE_PREAMBLE};
use tempfile::TempDir;

use crate::{
    farm::{Files, RunningWall, nodes_of},
    process::Program,
    proxy::{self, Direction},
};

/// A folder with two keys, `wall.key` and `other.key`.
struct Keys(TempDir);

impl Keys {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for name in ["wall.key", "other.key"] {
            Key::random().unwrap().write(&folder.path().join(name)).unwrap();
        }
        Self(folder)
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).to_str().unwrap().to_owned()
    }

    fn wall(&self) -> RunningWall {
        RunningWall::start_with(&["--key", &self.path("wall.key")])
    }

    fn join(&self, address: &str, name: &str, key: &str) -> Program {
        RunningWall::join_at(address, name, &["--key", &self.path(key)])
    }
}

#[test]
fn a_key_changes_no_sample_on_any_address() {
    let (keys, files) = (Keys::new(), Files::new());
    let size = "83x45";
    let expected = files.traced_hash(size);
    for (listen, division) in [("127.0.0.1:0", "interleaved"), ("0.0.0.0:0", "tiled"), ("[::1]:0", "interleaved")] {
        if listen.starts_with('[') && TcpListener::bind(listen).is_err() {
            continue; // a machine without IPv6
        }
        let mut command = files.wall(size);
        command.args(["--listen", listen, "--key", &keys.path("wall.key")]);
        // A test says nothing to the network.
        command.args(["--local", "3", "--frames", "2", "--division", division, "--no-announce"]);
        command.env("RUST_LOG", "compositor=debug,renderer=info");
        let said = Program::succeed(command);
        assert_eq!(said.matches(", with a key").count(), 3, "{said}");
        for frame in files.frames() {
            assert_eq!(frame["samples_blake3"], expected.as_str(), "{listen}");
            assert_eq!(nodes_of(&frame).len(), 3);
        }
    }
}

#[test]
fn a_peer_without_the_key_is_refused_and_told_the_cure() {
    let keys = Keys::new();
    let mut wall = keys.wall();
    let _good = keys.join(&wall.address, "good", "wall.key");
    wall.wait_for_frames(3);

    let mut other = keys.join(&wall.address, "other", "other.key");
    wall.program.wait_for("the peer has another key: start both sides with --key and copies of one key file");
    other.wait_for("the peer refuses this side's key: start both sides with --key and copies of one key file");
    assert!(!other.said().contains("connected to the wall"), "{}", other.said());
    drop(other);

    let mut keyless = wall.join("keyless");
    wall.program.wait_for("the peer has no key, and this side has one: start the peer with a copy of it, --key FILE");
    keyless.wait_for("this side was given none: give it the peer's key file with --key FILE");
    drop(keyless);

    wall.connect().write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
    wall.program.wait_for("the peer speaks another protocol");

    let mut reflected = wall.connect();
    let mut preamble = [0; SECURE_PREAMBLE.len()];
    reflected.read_exact(&mut preamble).unwrap();
    assert_eq!(preamble, SECURE_PREAMBLE);
    reflected.write_all(&preamble).unwrap();
    reflected.write_all(&[0; 48]).unwrap();
    // The wall closes the connection, and has said so before.
    let _ = reflected.read_to_end(&mut Vec::new());

    wall.wait_for_frames(3);
    let (frames, said) = wall.end();
    assert!(frames.iter().all(|frame| nodes_of(frame) == ["good"]));
    assert_eq!(said.matches(" joined from ").count(), 1, "{said}");
    assert_eq!(said.matches("the peer has another key").count(), 1, "{said}");
}

#[test]
fn a_wall_without_a_key_and_a_renderer_with_one_are_told_the_cure() {
    let keys = Keys::new();
    let mut wall = RunningWall::start();
    let _good = wall.join("good");
    wall.wait_for_frames(3);
    let mut keyed = keys.join(&wall.address, "keyed", "wall.key");
    wall.program.wait_for("this side was given none: give it the peer's key file with --key FILE");
    keyed.wait_for("the peer has no key, and this side has one: start the peer with a copy of it, --key FILE");
    wall.wait_for_frames(3);
    let (frames, _) = wall.end();
    assert!(frames.iter().all(|frame| nodes_of(frame) == ["good"]));
}

#[test]
fn changed_or_replayed_bytes_cost_a_connection_and_no_sample() {
    let keys = Keys::new();
    let mut wall = keys.wall();
    let _good = keys.join(&wall.address, "good", "wall.key");
    wall.wait_for_frames(3);
    // The changed byte is among samples, after some frames.
    let between = TamperingProxy::start(&wall.address, 200_000);
    let mut far = keys.join(&between.address, "far", "wall.key");
    wall.program.wait_for("encrypted bytes were changed, repeated, swapped or forged on the way");
    far.wait_for("trying again until it answers");
    wall.program.wait_for_count("render server far is ready", 2);
    wall.wait_for_frames(3);

    // Replay all that the render server sent in its first connection.
    let recording = between.recording.lock().unwrap().clone();
    assert!(recording.len() > 200_000);
    let mut replay = wall.connect();
    // Fails when the wall closes the connection.
    let _ = replay.write_all(&recording);
    wall.program.wait_for("the peer replays another machine's handshake and does not have the key");

    wall.wait_for_frames(3);
    let (frames, said) = wall.end();
    assert_eq!(nodes_of(frames.last().unwrap()), ["good", "far"]);
    assert_eq!(said.matches(" joined from ").count(), 3, "{said}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_flood_of_strangers_takes_little_memory_and_keeps_nobody_out() {
    let keys = Keys::new();
    let mut wall = keys.wall();
    let _good = keys.join(&wall.address, "good", "wall.key");
    wall.wait_for_frames(20);
    let resident_kb = || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", wall.program.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmRSS")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<i64>().unwrap()
    };
    let before_kb = resident_kb();
    let n_strangers = 300;
    let strangers: Vec<TcpStream> = (0..n_strangers)
        .map(|number| {
            let mut stranger = wall.connect();
            // Every other one sends a whole preamble.
            let opening: &[u8] = if number % 2 == 0 { &SECURE_PREAMBLE } else { &PREAMBLE[..3] };
            stranger.write_all(opening).unwrap();
            stranger
        })
        .collect();
    let held_kb = resident_kb() - before_kb;
    assert!(held_kb < n_strangers * 16, "{n_strangers} strangers hold {held_kb} KB");
    let _newcomer = keys.join(&wall.address, "newcomer", "wall.key");
    wall.program.wait_for("render server newcomer is ready");
    for mut stranger in strangers {
        let mut heard = Vec::new();
        // Until the wall closes the connection, or resets it if unread bytes are left.
        let _ = stranger.read_to_end(&mut heard);
        assert!(SECURE_PREAMBLE.starts_with(&heard));
    }
    wall.wait_for_frames(3);
    let (frames, said) = wall.end();
    // The newest 64 had their two seconds; later strangers or the newcomer displaced the others.
    assert!((1..10).contains(&said.matches("no handshake within 2 s").count()), "{said}");
    assert!(said.contains("render servers lost: 0,"), "{said}");
    assert_eq!(nodes_of(frames.last().unwrap()), ["good", "newcomer"]);
}

/// A proxy that records what the first connection sends to the wall, and changes one byte of it.
struct TamperingProxy {
    address: String,
    recording: Arc<Mutex<Vec<u8>>>,
}

impl TamperingProxy {
    /// Changes the byte at `change_at`.
    fn start(wall: &str, change_at: usize) -> Self {
        let recording = Arc::new(Mutex::new(Vec::new()));
        let into = Arc::clone(&recording);
        let address = proxy::start(wall, 64 * 1024, move |number, direction, bytes| {
            if number > 0 || direction == Direction::ToServer {
                return;
            }
            let mut recording = into.lock().unwrap();
            let at = recording.len();
            recording.extend_from_slice(bytes);
            if (at..at + bytes.len()).contains(&change_at) {
                bytes[change_at - at] ^= 0x10;
            }
        });
        Self { address, recording }
    }
}

#[cfg(unix)]
#[test]
fn a_new_key_file_is_for_its_owner_alone() {
    use std::os::unix::fs::PermissionsExt;
    let keys = Keys::new();
    let path = keys.path("new.key");
    let mut command = Program::command("renderer");
    command.args(["key", &path]);
    let said = Program::succeed(command);
    assert!(said.contains(&format!("start both with --key {path}")), "{said}");
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(!said.contains(text.trim()), "the key itself is not shown");
    assert_eq!(std::fs::metadata(Path::new(&path)).unwrap().permissions().mode() & 0o777, 0o600);
    Key::read(Path::new(&path)).unwrap();
}
