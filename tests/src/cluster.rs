//! What a cluster is started with, and two hosts: network namespaces with a slow link between them.

use std::{path::Path, process::Command};

use crate::{
    farm::Files,
    process::{GENEROUS, Program},
};

fn config(name: &str) -> String {
    format!("{}/../wall-config/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Runs a command; what it printed, if it can be run and succeeds.
fn run(command: &str) -> Result<String, String> {
    let mut words = command.split(' ');
    let output = Command::new(words.next().unwrap()).args(words).output().map_err(|error| error.to_string())?;
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    if output.status.success() { Ok(said) } else { Err(said) }
}

#[test]
fn the_systemd_unit_is_one_that_systemd_takes() {
    if let Err(reason) = run("systemd-analyze --version") {
        return println!("skipped: no systemd-analyze: {reason}");
    }
    let said = run(&format!("systemd-analyze verify {}", config("raywall-renderer@.service"))).unwrap();
    assert_eq!(said, "", "systemd has something to say about the unit");
}

#[test]
fn the_slurm_script_is_one_that_a_shell_takes_and_says_what_it_lacks() {
    let script = config("render-servers.sbatch");
    run(&format!("sh -n {script}")).unwrap();
    let said = run(&format!("sh {script}")).unwrap_err();
    assert!(said.contains("give the address of the wall"), "{said}");
}

/// Two namespaces, each a host, and a link of 20 Mbit/s from the node to the wall; they go when this is dropped.
struct TwoHosts {
    wall: String,
    node: String,
}

impl TwoHosts {
    fn new() -> Result<Self, String> {
        let id = std::process::id();
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
        run(&format!("ip netns exec {node} tc qdisc add dev eth0 root tbf rate 20mbit burst 32kb latency 100ms"))?;
        Ok(hosts)
    }

    /// A program as the tests know it, on one of the hosts.
    fn on(host: &str, program: &Command) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", host]).arg(program.get_program()).args(program.get_args());
        command.envs(program.get_envs().filter_map(|(name, value)| Some((name, value?))));
        command
    }
}

impl Drop for TwoHosts {
    fn drop(&mut self) {
        // One that was never made need not go.
        let _ = run(&format!("ip netns delete {}", self.node));
        let _ = run(&format!("ip netns delete {}", self.wall));
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_node_behind_a_slow_link_renders_the_right_frames_with_a_key() {
    let hosts = match TwoHosts::new() {
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
        .args(["--local", "0", "--frames", "12", "--wall"])
        .arg(files.path("wall.toml"))
        .arg("--camera")
        .arg(files.path("camera.toml"))
        .arg("--stats")
        .arg(files.path("stats.json"));
    let mut wall = Program::start(TwoHosts::on(&hosts.wall, &with_key(wall, &key)));
    wall.wait_for("listening on ");
    let mut node = Program::command("renderer");
    node.args(["connect", "10.77.0.1:7117", "--name", "far", "--threads", "1"]);
    let started_at = std::time::Instant::now();
    let _node = Program::start(TwoHosts::on(&hosts.node, &with_key(node, &key)));
    let (status, said) = wall.wait();
    assert!(status.success() && started_at.elapsed() < GENEROUS, "{said}");
    let frames = files.frames();
    assert!(frames.iter().all(|frame| frame["samples_blake3"] == *expected));
    // The link does limit: no more bytes came than it passes in this time, and in its buffer.
    let n_bytes: f64 = frames.iter().map(|frame| frame["bytes_in"].as_f64().unwrap()).sum();
    assert!(n_bytes * 8.0 < 20e6 * started_at.elapsed().as_secs_f64() + 8.0 * 65_536.0, "{n_bytes} bytes");
}
