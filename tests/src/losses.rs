//! Farms that lose most of themselves, and peers that wear walls and render servers down. The nodes here are threads that
//! answer with the right picture, so that hundreds fit on few cores.

use std::{
    collections::{BTreeMap, VecDeque},
    io::{Read, Write},
    net::{Shutdown, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed},
    },
    thread,
    time::{Duration, Instant},
};

use channel::key::Key;
use shared::{
    codec::{self, HEADER_BYTES},
    protocol::{DEFAULT_PORT, PREAMBLE, SECURE_PREAMBLE, SceneState, ToServer, ToWall},
    scene::SceneId,
};

use crate::{
    farm::RunningWall,
    liars::{answer_tasks, lie, message, receive, shake_hands},
    process::{GENEROUS, Program, generate_statue, wait_until},
    random::Random,
};

/// Render servers of a large farm; `make soak` has as many as a wall takes.
fn n_nodes() -> usize {
    if std::env::var_os("RAYWALL_CHURN_SECONDS").is_some() { 512 } else { 64 }
}

/// Nodes that answer every task with the samples of a picture.
struct Crowd {
    rgb: Arc<Vec<u8>>,
    streams: BTreeMap<usize, TcpStream>,
    n_joined: usize,
    /// Nodes that were given a task. The wall's log leaves lines out if many join.
    n_busy: Arc<AtomicUsize>,
}

impl Crowd {
    fn new(wall: &RunningWall) -> Self {
        Self { rgb: Arc::new(wall.expected_samples()), streams: BTreeMap::new(), n_joined: 0, n_busy: Arc::default() }
    }

    /// Has nodes join until there are `n_nodes`, and waits until the wall gives them tasks.
    fn fill(&mut self, wall: &RunningWall, n_nodes: usize) {
        while self.streams.len() < n_nodes {
            self.n_joined += 1;
            let (mut stream, rgb, name) = (wall.connect(), Arc::clone(&self.rgb), format!("crowd-{}-", self.n_joined));
            // One after the other: a wall shakes hands with few at a time, and these do not try again.
            shake_hands(&mut stream, &name).unwrap();
            self.streams.insert(self.n_joined, stream.try_clone().unwrap());
            let n_busy = Arc::clone(&self.n_busy);
            thread::spawn(move || {
                let mut is_new = true;
                answer_tasks(&mut stream, |asked| {
                    if std::mem::take(&mut is_new) {
                        n_busy.fetch_add(1, Relaxed);
                    }
                    [asked.chunks(&rgb).concat(), asked.done()].concat()
                })
            });
        }
        wait_until("every node has a task", || self.n_busy.load(Relaxed) == self.n_joined);
    }

    /// Kills nodes at random, all at once.
    fn kill(&mut self, n_killed: usize, random: &mut Random) {
        for _ in 0..n_killed {
            let index = random.below(self.streams.len());
            let number = *self.streams.keys().nth(index).unwrap();
            let _ = self.streams.remove(&number).unwrap().shutdown(Shutdown::Both);
        }
    }
}

#[test]
fn the_survivors_of_a_mass_death_finish_every_frame() {
    let mut random = Random::new(21);
    for division in ["interleaved", "tiled", "dynamic"] {
        let mut wall = RunningWall::start_with(&["--division", division, "--in-flight", "3"]);
        let (mut crowd, n_nodes) = (Crowd::new(&wall), n_nodes());
        for n_killed in [1, n_nodes / 10, n_nodes / 2, n_nodes * 95 / 100, n_nodes - 1] {
            crowd.fill(&wall, n_nodes);
            wall.wait_for_frames(2);
            // At any phase of a frame.
            thread::sleep(Duration::from_millis(random.below(30) as u64));
            crowd.kill(n_killed, &mut random);
            wall.wait_for_frames(3);
        }
        let said = wall.program.said();
        assert!(!said.contains("did not read its messages"), "an honest node was dropped\n{said}");
        let (frames, _) = wall.end();
        assert!(frames.iter().any(|frame| frame["attempts"].as_u64().unwrap() > 1), "no frame was healed");
    }
}

#[test]
fn newcomers_finish_what_a_mute_node_was_given() {
    for division in ["interleaved", "tiled", "dynamic"] {
        for in_flight in ["1", "3"] {
            let mut wall = RunningWall::start_with(&["--division", division, "--in-flight", in_flight]);
            let (mut stream, n_tasks) = (wall.connect(), Arc::new(AtomicUsize::new(0)));
            // It answers pings, and no task.
            let counted = Arc::clone(&n_tasks);
            thread::spawn(move || {
                lie(&mut stream, "mute", |_| {
                    counted.fetch_add(1, Relaxed);
                    Vec::new()
                })
            });
            wait_until("the mute node has a task", || n_tasks.load(Relaxed) > 0);
            let _honest = [wall.join("first"), wall.join("second"), wall.join("third")];
            wall.wait_for_frames(4);
            wall.end();
        }
    }
}

#[test]
#[cfg(target_os = "linux")]
fn a_node_that_loses_its_scene_again_and_again_leaks_no_frames() {
    let mut wall = RunningWall::start_sized("1024x512", &["--division", "tiled"]);
    let _honest = wall.join("honest");
    wall.wait_for_frames(10);
    let before = peak_memory_mb(&wall.program);
    let mut stream = wall.connect();
    thread::spawn(move || -> std::io::Result<()> {
        shake_hands(&mut stream, "forgetful")?;
        let mut wanted = None;
        loop {
            match receive(&mut stream)? {
                ToServer::LoadScene { scene, .. } => wanted = Some(scene),
                ToServer::Ping { sent_us } => stream.write_all(&message(&ToWall::Pong { sent_us }))?,
                ToServer::RenderFrame { .. } => {
                    let scene = wanted.expect("a scene comes before tasks");
                    let state = SceneState::Loading { progress: 0.5 };
                    stream.write_all(&message(&ToWall::SceneState { scene, state }))?;
                }
                _ => {}
            }
            if let Some(scene) = wanted {
                let state = SceneState::Ready { triangles: 1, bytes: 1, grid: None };
                stream.write_all(&message(&ToWall::SceneState { scene, state }))?;
            }
        }
    });
    wall.program.wait_for("render server forgetful is ready");
    wall.wait_for_frames(200);
    // A frame takes two megabytes.
    let grown_mb = peak_memory_mb(&wall.program) - before;
    assert!(grown_mb < 150, "the wall has grown by {grown_mb} MB");
    wall.end();
}

#[test]
fn the_node_after_the_last_is_told_why_it_is_refused() {
    let mut wall = RunningWall::start();
    let _joined: Vec<_> = (0..512)
        .map(|number| {
            let mut stream = wall.connect();
            shake_hands(&mut stream, &format!("{number}")).unwrap();
            stream
        })
        .collect();
    wall.program.wait_for("render server 511 joined");
    let mut stream = wall.connect();
    shake_hands(&mut stream, "late").unwrap();
    let refusal = (0..100).find_map(|_| match receive(&mut stream).unwrap() {
        ToServer::Refused { reason } => Some(reason),
        _ => None,
    });
    assert_eq!(refusal.as_deref(), Some("512 render servers have joined already"));
}

#[test]
fn a_node_that_comes_and_goes_fills_no_log() {
    let mut wall = RunningWall::start();
    let _honest = wall.join("honest");
    wall.wait_for_frames(2);
    let started_at = Instant::now();
    for _ in 0..12 {
        let mut stream = wall.connect();
        shake_hands(&mut stream, "flapping").unwrap();
    }
    for _ in 0..200 {
        wall.connect().write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
    }
    wall.wait_for_frames(2);
    let n_seconds = started_at.elapsed().as_secs() as usize + 1;
    assert!(started_at.elapsed() > Duration::from_secs(2), "a node that flaps must wait");
    for line in ["render server flapping joined", "render server flapping at", "another protocol"] {
        let n_lines = wall.program.count(line);
        assert!((1..=n_seconds + 3).contains(&n_lines), "\"{line}\" {n_lines} times in {n_seconds} s");
    }
    wall.end();
}

fn hello(name: &str) -> Vec<u8> {
    [&PREAMBLE[..], &message(&ToWall::Hello { name: name.to_owned(), threads: 1 })].concat()
}

/// Has three peers connect, send what `opening` makes of the connection's number, and leave, as fast as they can.
#[cfg(target_os = "linux")]
fn check_flood(waits_for_welcome: bool, opening: impl Fn(usize) -> Vec<u8> + Sync) {
    let wall = RunningWall::start();
    let (number, is_over) = (AtomicUsize::new(0), AtomicBool::new(false));
    let flood = || {
        let ends_at = Instant::now() + 2 * GENEROUS;
        while !is_over.load(Relaxed) && Instant::now() < ends_at {
            // Fails if this machine has no more ports.
            let Ok(mut stream) = TcpStream::connect(&wall.address) else { continue };
            stream.set_read_timeout(Some(Duration::from_secs(3))).unwrap();
            // Fails if the wall has closed the connection.
            let _ = stream.write_all(&opening(number.fetch_add(1, Relaxed)));
            if waits_for_welcome {
                let _ = stream.read_exact(&mut [0; PREAMBLE.len() + HEADER_BYTES + 1]);
            }
        }
    };
    let (elapsed, n_connections) = thread::scope(|scope| {
        let started_at = Instant::now();
        (0..3).for_each(|_| drop(scope.spawn(flood)));
        thread::sleep(Duration::from_secs(if n_nodes() > 64 { 20 } else { 3 }));
        let (elapsed, n_connections) = (started_at.elapsed(), number.load(Relaxed));
        let _honest = wall.join("honest");
        wait_until("an honest node renders", || wall.program.count("frame shown") > 2);
        is_over.store(true, Relaxed);
        (elapsed, n_connections)
    });
    // Those of four farms of 512 at once, two a millisecond afterwards, and those that the system queues.
    let most = 2048 + 2 * elapsed.as_millis() as usize + 1024;
    assert!(n_connections < most + 100, "{n_connections} connections in {elapsed:?}, in place of {most}");
    let said = wall.program.said();
    let n_lines = said.lines().filter(|line| !line.contains("frame shown")).count();
    // A farm's worth at once, and few afterwards.
    assert!(n_lines < 2300 + 10 * elapsed.as_secs() as usize, "{n_lines} lines of {number:?} connections");
}

#[test]
#[cfg(target_os = "linux")]
fn nodes_that_flap_are_slowed_down_cost_few_lines_and_keep_nobody_out() {
    check_flood(false, |number| hello(&format!("flapping-{}", number % 3)));
    check_flood(true, |number| hello(&format!("flapping-{number}")));
}

#[test]
#[cfg(target_os = "linux")]
fn strangers_are_slowed_down_cost_few_lines_and_keep_nobody_out() {
    check_flood(false, |number| hello(&format!("hasty-{number}")));
    check_flood(false, |number| [format!("{number} /").as_bytes(), &[number as u8; 20]].concat());
}

#[test]
#[cfg(target_os = "linux")]
fn two_thousand_connections_that_say_nothing_keep_nobody_out() {
    let mut wall = RunningWall::start();
    let before_mb = peak_memory_mb(&wall.program);
    // The wall has dropped the older ones: it keeps 64.
    let mut silent = VecDeque::new();
    for _ in 0..2000 {
        silent.push_back(wall.connect());
        if silent.len() > 300 {
            silent.pop_front();
        }
    }
    let _honest = wall.join("honest");
    wall.wait_for_frames(3);
    let grown_mb = peak_memory_mb(&wall.program) - before_mb;
    assert!(grown_mb < 200, "the wall has grown by {grown_mb} MB");
    wall.end();
}

#[test]
fn a_peer_that_shakes_hands_byte_by_byte_is_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let key = folder.path().join("wall.key");
    Key::random().unwrap().write(&key).unwrap();
    let with_key = ["--key", key.to_str().unwrap()];
    for (args, opening) in [(&[][..], hello("slow")), (&with_key[..], [&SECURE_PREAMBLE[..], &[0; 48]].concat())] {
        let mut wall = RunningWall::start_with(args);
        let mut stream = wall.connect();
        let started_at = Instant::now();
        for byte in opening {
            // Fails when the wall closes the connection.
            if stream.write_all(&[byte]).is_err() {
                break;
            }
            thread::sleep(Duration::from_millis(300));
        }
        assert!(started_at.elapsed() < Duration::from_secs(4), "{:?}", started_at.elapsed());
        wall.program.wait_for("no handshake within 2 s");
    }
}

/// A wall that a render server has connected to.
fn accept_renderer(args: &[&str]) -> (Program, TcpStream) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let program = RunningWall::join_at(&listener.local_addr().unwrap().to_string(), "renderer", args);
    (program, listener.accept().unwrap().0)
}

#[test]
fn a_wall_that_shakes_hands_byte_by_byte_is_left() {
    let (mut renderer, mut stream) = accept_renderer(&[]);
    thread::spawn(move || {
        for byte in PREAMBLE {
            stream.write_all(&[byte])?;
            thread::sleep(Duration::from_millis(700));
        }
        std::io::Result::Ok(())
    });
    renderer.wait_for("no handshake within 2 s");
}

#[test]
fn a_render_server_that_is_refused_waits_longer_each_time() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let _renderer = RunningWall::join_at(&listener.local_addr().unwrap().to_string(), "renderer", &[]);
    let mut refusal = PREAMBLE.to_vec();
    codec::encode(&ToServer::Welcome, &mut refusal).unwrap();
    codec::encode(&ToServer::Refused { reason: "the wall is full".to_owned() }, &mut refusal).unwrap();
    let mut last: Option<Instant> = None;
    let mut pauses = Vec::new();
    while pauses.len() < 5 {
        let mut stream = listener.accept().unwrap().0;
        pauses.extend(last.map(|last| last.elapsed()));
        stream.read_exact(&mut hello("renderer")).unwrap();
        stream.write_all(&refusal).unwrap();
        last = Some(Instant::now());
        stream.shutdown(Shutdown::Write).unwrap();
        // Until the render server has closed the connection.
        let _ = stream.read_to_end(&mut Vec::new());
    }
    assert!(pauses.is_sorted(), "{pauses:?}");
    // Longer than a wall that restarts is given.
    assert!(pauses[4] > Duration::from_millis(1500), "{pauses:?}");
}

#[test]
fn an_address_of_version_six_without_a_port_connects() {
    // Another wall may have the port, or the machine no such addresses.
    let Ok(listener) = TcpListener::bind(("::1", DEFAULT_PORT)) else { return };
    for address in ["::1", "[::1]"] {
        let _renderer = RunningWall::join_at(address, "renderer", &[]);
        let mut stream = listener.accept().unwrap().0;
        stream.write_all(&PREAMBLE).unwrap();
        let mut greeting = hello("renderer");
        stream.read_exact(&mut greeting).unwrap();
        assert_eq!(greeting, hello("renderer"));
    }
}

#[test]
#[cfg(target_os = "linux")]
fn orders_do_not_pile_up_while_a_scene_is_loaded() {
    let (mut renderer, mut stream) = accept_renderer(&[]);
    stream.write_all(&PREAMBLE).unwrap();
    let mut send = |message: &ToServer| {
        let mut bytes = Vec::new();
        codec::encode(message, &mut bytes).unwrap();
        stream.write_all(&bytes).unwrap();
    };
    let load_scene = |triangles, n_bytes| ToServer::LoadScene {
        scene: SceneId::Statue { triangles, treatment: Default::default() },
        path: Some(vec![b'x'; n_bytes]),
        structure: None,
        sky: None,
    };
    send(&ToServer::Welcome);
    send(&load_scene(3_000_000, 1));
    renderer.wait_for("loading");
    for triangles in 1000..7000 {
        send(&load_scene(triangles, 250_000));
    }
    renderer.wait_for_count("is ready", 2);
    let peak_mb = peak_memory_mb(&renderer);
    assert!(peak_mb < 1000, "1500 MB of orders, and a peak of {peak_mb} MB");
}

#[test]
fn a_model_that_is_back_is_found_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    generate_statue(1000, path("wall.ply").as_ref());
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "0", "--min-renderers", "1"]);
    command.args(["--frames", "3", "--size", "64x32", "--model", &path("wall.ply")]);
    let mut wall = Program::start(command);
    let _renderer = RunningWall::join_at(&wall.wait_for_address(), "late", &["--model", &path("own.ply")]);
    wall.wait_for("render server late cannot render yet: ");
    std::fs::copy(path("wall.ply"), path("own.ply")).unwrap();
    let copied_at = Instant::now();
    wall.wait_for("render server late is ready");
    // Within a second, and what a busy machine needs to load it.
    assert!(copied_at.elapsed() < Duration::from_secs(3), "{:?}", copied_at.elapsed());
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");
}

/// The most memory that a program has had, in megabytes.
#[cfg(target_os = "linux")]
fn peak_memory_mb(program: &Program) -> i64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", program.id())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<i64>().unwrap() / 1024
}
