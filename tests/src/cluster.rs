//! The files that start a cluster, and slow links: through a proxy, and between network namespaces.

use std::{
    path::Path,
    process::Command,
    thread,
    time::{Duration, Instant},
};

use crate::{
    farm::{Files, RunningWall, nodes_of},
    process::{GENEROUS, Program},
    proxy,
};

fn config(name: &str) -> String {
    format!("{}/../wall-config/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Runs a command; its output, or the reason why it failed.
fn run(command: &str) -> Result<String, String> {
    let mut words = command.split(' ');
    let output = Command::new(words.next().unwrap()).args(words).output().map_err(|error| error.to_string())?;
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    if output.status.success() { Ok(said) } else { Err(said) }
}

#[test]
fn systemd_accepts_the_unit() {
    if let Err(reason) = run("systemd-analyze --version") {
        return println!("skipped: no systemd-analyze: {reason}");
    }
    let said = run(&format!("systemd-analyze verify {}", config("raywall-renderer@.service"))).unwrap();
    assert_eq!(said, "", "systemd complains about the unit");
}

#[test]
fn a_shell_accepts_the_slurm_script_which_names_missing_settings() {
    let script = config("render-servers.sbatch");
    run(&format!("sh -n {script}")).unwrap();
    let said = run(&format!("sh {script}")).unwrap_err();
    assert!(said.contains("give the address of the wall"), "{said}");
}

/// The address of a proxy that passes 1 Mbit/s to and from a wall, in each direction of each connection.
fn slow_way_to(wall: &str) -> String {
    // A packet's worth every 10 ms; time lost by sleeping too long is not made up for.
    const PACKET_BYTES: usize = 1250;
    proxy::start(wall, PACKET_BYTES, |_, _, bytes| {
        thread::sleep(Duration::from_millis(10).mul_f64(bytes.len() as f64 / PACKET_BYTES as f64));
    })
}

#[test]
fn a_link_of_one_megabit_is_slow_and_not_dead() {
    let mut wall = RunningWall::start_with(&["--encoding", "raw", "--in-flight", "1"]);
    let _far = RunningWall::join_at(&slow_way_to(&wall.address), "far", &[]);
    wall.wait_for_ready(1);
    // Each frame of 98 KB occupies the link for 0.8 s, more than three times the limit of silence.
    let started_at = Instant::now();
    wall.wait_for_frames(3);
    assert!(started_at.elapsed() > Duration::from_secs(1), "the link does not limit");
    // A near server takes over some of its share.
    let _near = wall.join("near");
    wall.wait_for_ready(2);
    wall.wait_for_frames(6);
    let (frames, said) = wall.end();
    assert!(!said.contains("silent"), "{said}");
    let last = frames.last().unwrap();
    assert_eq!((nodes_of(last).len(), &last["n_lost"]), (2, &0.into()));
    let far = last["nodes"].as_array().unwrap().iter().find(|node| node["name"] == "far").unwrap();
    assert!(far["round_trip_ms"].as_f64().is_some() && far["address"].is_string(), "{far}");
    // The near server renders the late share too, so a frame takes less than half the far one's time.
    assert!(last["attempts"].as_u64().unwrap() > 1 && last["render_ms"].as_f64().unwrap() < 400.0, "{last}");
}

/// Two network namespaces with a link of limited rate from the node to the wall; dropping it deletes them.
struct TwoHosts {
    wall: String,
    node: String,
}

impl TwoHosts {
    fn new(rate: &str) -> Result<Self, String> {
        let id = format!("{}-{rate}", std::process::id());
        let hosts = Self { wall: format!("wall{id}"), node: format!("node{id}") };
        let Self { wall, node } = &hosts;
        run(&format!("ip netns add {wall}"))?;
        run(&format!("ip netns add {node}"))?;
        run(&format!("ip -n {wall} link add eth0 type veth peer name eth0 netns {node}"))?;
        for (host, address) in [(wall, "10.77.0.1/24"), (node, "10.77.0.2/24")] {
            run(&format!("ip -n {host} address add {address} dev eth0"))?;
            run(&format!("ip -n {host} link set eth0 up"))?;
            run(&format!("ip -n {host} link set lo up"))?;
        }
        run(&format!("ip netns exec {node} tc qdisc add dev eth0 root tbf rate {rate} burst 32kb latency 100ms"))?;
        Ok(hosts)
    }

    /// The same command, run on one of the hosts.
    fn on(host: &str, program: &Command) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", host]).arg(program.get_program()).args(program.get_args());
        command.envs(program.get_envs().filter_map(|(name, value)| Some((name, value?))));
        command
    }
}

impl Drop for TwoHosts {
    fn drop(&mut self) {
        // Fails for a namespace that was never made.
        let _ = run(&format!("ip netns delete {}", self.node));
        let _ = run(&format!("ip netns delete {}", self.wall));
    }
}

/// Checks `n_frames` frames that a node renders behind a link of `mbit_per_s`, with a key.
fn check_frames_behind(mbit_per_s: u32, n_frames: u32) {
    let hosts = match TwoHosts::new(&format!("{mbit_per_s}mbit")) {
        Ok(hosts) => hosts,
        Err(reason) => return println!("skipped: no network namespaces with a limited rate here: {reason}"),
    };
    let files = Files::new();
    let key = files.path("wall.key");
    let mut make_key = Program::command("renderer");
    assert!(make_key.arg("key").arg(&key).status().unwrap().success());
    let expected = files.traced_hash("256x128");
    let with_key = |mut command: Command, key: &Path| {
        command.arg("--key").arg(key);
        command
    };
    let mut wall = Program::command("compositor");
    wall.args(["--headless", "--listen", "10.77.0.1:7117", "--triangles", "20000", "--size", "256x128"])
        .args(["--local", "0", "--encoding", "raw", "--frames", &n_frames.to_string(), "--wall"])
        .arg(files.path("wall.toml"))
        .arg("--camera")
        .arg(files.path("camera.toml"))
        .arg("--stats")
        .arg(files.path("stats.json"));
    let mut wall = Program::start(TwoHosts::on(&hosts.wall, &with_key(wall, &key)));
    wall.wait_for("listening on ");
    let mut node = Program::command("renderer");
    node.args(["connect", "10.77.0.1:7117", "--name", "far", "--threads", "1"]);
    let started_at = Instant::now();
    let _node = Program::start(TwoHosts::on(&hosts.node, &with_key(node, &key)));
    let (status, said) = wall.wait();
    assert!(status.success() && started_at.elapsed() < GENEROUS, "{said}");
    let frames = files.frames();
    assert!(frames.iter().all(|frame| frame["samples_blake3"] == *expected && frame["n_lost"] == 0), "{said}");
    // The link does limit the rate: no more bytes came than it passes in this time, and its buffer.
    let n_bytes: f64 = frames.iter().map(|frame| frame["bytes_in"].as_f64().unwrap()).sum();
    assert!(
        n_bytes * 8.0 < f64::from(mbit_per_s) * 1e6 * started_at.elapsed().as_secs_f64() + 8.0 * 65_536.0,
        "{n_bytes} bytes"
    );
}

#[cfg(target_os = "linux")]
#[test]
fn a_node_behind_a_slow_link_renders_the_right_frames_with_a_key() {
    check_frames_behind(20, 12);
}

#[cfg(target_os = "linux")]
#[test]
fn a_node_behind_a_very_slow_link_renders_the_right_frames_with_a_key() {
    check_frames_behind(1, 4);
}
