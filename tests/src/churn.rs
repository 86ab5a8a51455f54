//! Render servers join, freeze, wake and die at random: every frame stays whole and right.

use std::{
    thread,
    time::{Duration, Instant},
};

use crate::{farm::RunningWall, process::Program, random::Random};

/// The test's duration; `make soak` sets ten minutes.
fn duration() -> Duration {
    let seconds = std::env::var("RAYWALL_CHURN_SECONDS").map_or(20, |seconds| seconds.parse().unwrap());
    Duration::from_secs(seconds)
}

/// Render servers at a time.
const MOST_SERVERS: usize = 5;

struct Server {
    program: Program,
    is_frozen: bool,
}

#[test]
fn frames_stay_whole_and_right_while_render_servers_come_and_go() {
    let mut wall = RunningWall::start_sized("1024x512", &["--division", "dynamic"]);
    let mut random = Random::new(1);
    let mut servers: Vec<Server> = Vec::new();
    let (mut n_joined, mut n_killed, mut n_frozen) = (0, 0, 0);
    let started = Instant::now();
    while started.elapsed() < duration() {
        let n_servers = servers.len();
        match random.below(8) {
            0..3 if n_servers < MOST_SERVERS => {
                n_joined += 1;
                let program = wall.join(&format!("churn-{n_joined}"));
                servers.push(Server { program, is_frozen: false });
            }
            // It may be in any state, even before its handshake.
            3..5 if n_servers > 0 => {
                n_killed += 1;
                servers.swap_remove(random.below(n_servers)).program.signal("KILL");
            }
            5 if n_servers > 0 => {
                let server = servers.swap_remove(random.below(n_servers));
                server.program.signal("CONT");
                server.program.signal("TERM");
            }
            6 if n_servers > 0 => {
                n_frozen += 1;
                let server = &mut servers[random.below(n_servers)];
                server.program.signal(if server.is_frozen { "CONT" } else { "STOP" });
                server.is_frozen = !server.is_frozen;
            }
            _ => {}
        }
        thread::sleep(Duration::from_millis(random.below(400) as u64));
    }
    drop(servers);
    let _last = wall.join("last");
    wall.program.wait_for("render server last is ready");
    wall.wait_for_frames(5);
    let (frames, _) = wall.end();
    let n_healed = frames.iter().filter(|frame| frame["attempts"].as_u64().unwrap() > 1).count();
    println!(
        "{} frames, {n_healed} of them healed; {n_joined} joined, {n_killed} were killed, {n_frozen} froze or woke",
        frames.len()
    );
    assert!(n_joined > 5 && n_killed > 2 && n_healed > 0);
}
