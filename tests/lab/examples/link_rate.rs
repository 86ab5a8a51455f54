//! Measures the wall's maximum rate: render servers that answer at once, beside `iperf3` over as many connections.
//!
//!     cargo build --release && cargo run --release -p lab --example link_rate -- --seconds 3
//!
//! All processes share the cores of this machine. `iperf3` only copies; at half of its rate, the wall checks and places
//! samples in the time that copying takes. Measurements alternate, so that a busy machine slows all alike; figures are
//! medians. Frames are not displayed.

use std::{
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use clap::Parser;
use compositor::farm::RenderGoal;
use glam::DVec3;
use lab::{
    farm::{MeasuredFarm, ServerProcess, SyntheticServers, frame_spec, goal},
    statistics::median,
};
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
    protocol::Encoding,
    scene::SceneId,
};
use strum::VariantArray;

/// Measures how fast the wall receives and places samples
#[derive(Parser)]
struct Args {
    /// Render servers, and connections of iperf3
    #[arg(long, default_value_t = 12)]
    nodes: u32,
    /// Seconds for each measurement
    #[arg(long, default_value_t = 3)]
    seconds: u64,
    /// Rounds, of which medians are printed
    #[arg(long, default_value_t = 3)]
    rounds: u32,
    /// Samples of a frame
    #[arg(long, default_value_t = FrameSize::PAPER)]
    size: FrameSize,
    /// Frames rendered at a time
    #[arg(long, default_value_t = 2)]
    in_flight: u32,
    /// Do not measure iperf3
    #[arg(long)]
    alone: bool,
    #[command(flatten)]
    servers: SyntheticServers,
    /// How samples travel: raw or lz4 [default: the one that each link is measured to be faster with]
    #[arg(long)]
    encoding: Option<Encoding>,
    /// Measure only this division
    #[arg(long)]
    division: Option<Division>,
}

#[derive(Clone, Copy, Default)]
struct Rate {
    frames_per_s: f64,
    gbit_per_s: f64,
    /// CPU milliseconds a frame: of this process, and of all render servers together.
    wall_ms: f64,
    servers_ms: f64,
    place_ms: f64,
    /// Bytes received over bytes of samples.
    encoded: f64,
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let goal = RenderGoal { in_flight: args.in_flight, encoding: args.encoding, ..goal(Division::Tiled, args.nodes) };
    let wall = MeasuredFarm::start(args.servers.listen, goal)?;
    let camera = Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 0.7, 2.0)?;
    let spec = frame_spec(SceneId::Statue { triangles: 100, treatment: Default::default() }, camera, args.size);
    let servers = args.servers.start(args.nodes, wall.farm.address())?;
    let divisions: Vec<_> = args.division.map_or_else(|| Division::VARIANTS.to_vec(), |division| vec![division]);
    let mut rates = vec![vec![]; divisions.len()];
    let mut iperf = vec![];
    for _ in 0..args.rounds {
        if !args.alone {
            wall.farm.update_goal(|goal| goal.spec = None);
            iperf.push(iperf3_gbit_per_s(args.nodes, args.seconds)?);
        }
        for (division, rates) in divisions.iter().zip(&mut rates) {
            wall.farm.update_goal(|goal| (goal.spec, goal.division) = (Some(spec), *division));
            rates.push(measure(&wall, &servers, *division, Duration::from_secs(args.seconds))?);
        }
    }
    let iperf = if iperf.is_empty() { f64::NAN } else { median(iperf) };
    println!("{} connections, {} a frame, {} in flight", args.nodes, args.size, args.in_flight);
    println!(
        "{:<12}{:>9}{:>9}{:>10}{:>30}{:>8}",
        "", "samples", "of", "frames", "CPU ms a frame:      render", "bytes"
    );
    println!("{:<12}{:>9}{:>9}{:>10}{:>30}{:>8}", "", "Gbit/s", "iperf3", "per s", "wall  placing  servers", "sent");
    println!("{:<12}{iperf:>9.2}", "iperf3");
    for (division, rates) in divisions.iter().zip(&rates) {
        let of = |figure: fn(&Rate) -> f64| median(rates.iter().map(figure));
        let gbit_per_s = of(|rate| rate.gbit_per_s);
        println!(
            "{:<12}{gbit_per_s:>9.2}{:>8.0}%{:>10.0}{:>12.2}{:>9.2}{:>9.2}{:>8.2}",
            division.to_string(),
            100.0 * gbit_per_s / iperf,
            of(|rate| rate.frames_per_s),
            of(|rate| rate.wall_ms),
            of(|rate| rate.place_ms),
            of(|rate| rate.servers_ms),
            of(|rate| rate.encoded),
        );
    }
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    println!(
        "{n_cores} cores have {n_cores}000 ms of CPU time a second; frames times the milliseconds of wall and servers are used."
    );
    Ok(())
}

/// Takes frames for a while, from when frames of the division arrive.
fn measure(
    wall: &MeasuredFarm,
    servers: &[ServerProcess],
    division: Division,
    duration: Duration,
) -> anyhow::Result<Rate> {
    for _ in 0..5 {
        while wall.next_frame()?.stats.division != division {}
    }
    let (wall_s, servers_s, started_at) = (cpu_s(std::process::id())?, cpu_s_of(servers)?, Instant::now());
    let (mut n_frames, mut n_bytes, mut place_ms, mut n_received) = (0.0, 0.0, 0.0, 0.0);
    while started_at.elapsed() < duration {
        let frame = wall.next_frame()?;
        n_frames += 1.0;
        n_bytes += 3.0 * f64::from(frame.spec.size.n_samples());
        place_ms += frame.stats.place_ms;
        n_received += frame.stats.bytes_in as f64;
    }
    let seconds = started_at.elapsed().as_secs_f64();
    Ok(Rate {
        frames_per_s: n_frames / seconds,
        gbit_per_s: n_bytes * 8e-9 / seconds,
        wall_ms: (cpu_s(std::process::id())? - wall_s) * 1e3 / n_frames,
        servers_ms: (cpu_s_of(servers)? - servers_s) * 1e3 / n_frames,
        place_ms: place_ms / n_frames,
        encoded: n_received / n_bytes,
    })
}

fn cpu_s_of(servers: &[ServerProcess]) -> anyhow::Result<f64> {
    servers.iter().map(|server| cpu_s(server.id())).sum()
}

/// CPU seconds of a process so far, in user and system mode.
fn cpu_s(process: u32) -> anyhow::Result<f64> {
    let text = std::fs::read_to_string(format!("/proc/{process}/stat"))?;
    let fields = text.rsplit(')').next().context("a process has a name")?;
    let ticks = fields.split_whitespace().skip(11).take(2).map(str::parse::<f64>);
    // Every Linux machine counts 100 ticks a second here.
    Ok(ticks.sum::<Result<f64, _>>()? / 100.0)
}

/// Gigabits of payload a second that `iperf3` moves over loopback.
fn iperf3_gbit_per_s(n_connections: u32, seconds: u64) -> anyhow::Result<f64> {
    let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port().to_string();
    let mut server = Command::new("iperf3")
        .args(["--server", "--one-off", "--port", &port])
        .stdout(Stdio::null())
        .spawn()
        .context("iperf3 does not start: install it (apt-get install iperf3), or give --alone")?;
    std::thread::sleep(Duration::from_millis(300));
    let output = Command::new("iperf3")
        .args(["--client", "127.0.0.1", "--port", &port, "--json", "--time", &seconds.to_string()])
        .args(["--parallel", &n_connections.to_string()])
        .output()?;
    server.wait()?;
    let report: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    let rate = &report["end"]["sum_received"]["bits_per_second"];
    let Some(rate) = rate.as_f64() else { bail!("iperf3 says {report}") };
    Ok(rate * 1e-9)
}
