//! What bounds the wall's rate: render servers that answer at once, beside `iperf3` over as many connections.
//!
//!     cargo build --release && cargo run --release -p compositor --example link_rate -- --seconds 3
//!
//! All processes run on this machine and share its cores, and so do those of `iperf3`, which only copies: half of its rate
//! leaves as much time for checking the samples and putting them in their places as copying takes. Frames are not shown.
//! In turn, so that a busy machine slows each alike; rates are medians.

mod blank;

use std::{
    process::{Command, Stdio},
    sync::mpsc,
    time::{Duration, Instant},
};

use anyhow::{Context, bail, ensure};
use blank::{BlankArgs, BlankServers};
use clap::Parser;
use compositor::farm::{Farm, RenderGoal};
use shared::{
    appearance::Appearance,
    camera::Camera,
    division::{Division, FrameSize},
    protocol::{Encoding, FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};
use tokio::net::TcpListener;

/// Measures how fast the wall takes samples.
#[derive(Parser)]
struct Args {
    /// Render servers, and connections of iperf3
    #[arg(long, default_value_t = 12)]
    nodes: u32,
    /// Seconds for each measurement
    #[arg(long, default_value_t = 3)]
    seconds: u64,
    /// Rounds; figures are medians
    #[arg(long, default_value_t = 3)]
    rounds: u32,
    /// Samples of a frame
    #[arg(long, default_value_t = FrameSize::PAPER)]
    size: FrameSize,
    /// Frames rendered at a time
    #[arg(long, default_value_t = 2)]
    in_flight: u32,
    /// Leave iperf3 out
    #[arg(long)]
    alone: bool,
    #[command(flatten)]
    servers: BlankArgs,
    /// How samples travel: raw or lz4; without it, as each link is measured to be faster
    #[arg(long)]
    encoding: Option<Encoding>,
    /// Measure only this division
    #[arg(long)]
    division: Option<Division>,
}

/// What was measured in one go.
#[derive(Clone, Copy, Default)]
struct Rate {
    frames_per_s: f64,
    gbit_per_s: f64,
    /// CPU seconds of this process and of the render servers, per frame, in milliseconds.
    wall_ms: f64,
    servers_ms: f64,
    place_ms: f64,
    /// Bytes received per frame, in parts of the samples'.
    encoded: f64,
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let listener = runtime.block_on(TcpListener::bind(args.servers.listen))?;
    let camera = Camera::look_at(glam::DVec3::Z, glam::DVec3::ZERO, glam::DVec3::Y, 0.7, 2.0)?;
    let spec = FrameSpec {
        scene: SceneId::Statue { triangles: 100 },
        camera,
        size: args.size,
        view: ShadingMode::Shaded,
        rays: LightingMode::default(),
        samples: SampleRange::CENTRE,
        appearance: Appearance::default(),
    };
    let wanted = RenderGoal {
        spec: None,
        scene_path: None,
        is_refinement: false,
        division: Division::Tiled,
        min_renderers: args.nodes,
        repeat: true,
        in_flight: args.in_flight,
        encoding: args.encoding,
        moved_at: Instant::now(),
    };
    let (wake, woken) = mpsc::sync_channel(1);
    let guard = runtime.enter();
    let farm = Farm::start(listener, None, wanted, move || {
        let _ = wake.try_send(());
    })?;
    drop(guard);
    let servers = BlankServers::start(args.nodes, farm.address(), &args.servers)?;
    let divisions: Vec<_> = args.division.map_or_else(|| Division::ALL.to_vec(), |division| vec![division]);
    let mut rates = vec![vec![]; divisions.len()];
    let mut iperf = vec![];
    for _ in 0..args.rounds {
        if !args.alone {
            farm.update_goal(|wanted| wanted.spec = None);
            iperf.push(iperf3_gbit_per_s(args.nodes, args.seconds)?);
        }
        for (division, rates) in divisions.iter().zip(&mut rates) {
            farm.update_goal(|wanted| (wanted.spec, wanted.division) = (Some(spec), *division));
            rates.push(measure(&farm, &woken, &servers, *division, Duration::from_secs(args.seconds))?);
        }
    }
    let iperf = median(&iperf, |&rate| rate);
    println!("{} connections, {} a frame, {} in flight", args.nodes, args.size, args.in_flight);
    println!(
        "{:<12}{:>9}{:>9}{:>10}{:>30}{:>8}",
        "", "samples", "of", "frames", "CPU ms a frame:      render", "bytes"
    );
    println!("{:<12}{:>9}{:>9}{:>10}{:>30}{:>8}", "", "Gbit/s", "iperf3", "per s", "wall  placing  servers", "sent");
    println!("{:<12}{iperf:>9.2}", "iperf3");
    for (division, rates) in divisions.iter().zip(&rates) {
        let of = |figure: fn(&Rate) -> f64| median(rates, figure);
        let gbit_per_s = of(|rate| rate.gbit_per_s);
        println!(
            "{:<12}{gbit_per_s:>9.2}{:>8.0}%{:>10.0}{:>12.2}{:>9.2}{:>9.2}{:>8.2}",
            division.name(),
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
        "{n_cores} cores have {n_cores}000 ms of CPU a second: rate times wall and render servers' ms says how much of that is used."
    );
    Ok(())
}

/// Takes frames for so long, once the division asked for has arrived.
fn measure(
    farm: &Farm,
    woken: &mpsc::Receiver<()>,
    servers: &BlankServers,
    division: Division,
    duration: Duration,
) -> anyhow::Result<Rate> {
    let next = || -> anyhow::Result<_> {
        loop {
            if let Some(frame) = farm.take_frame() {
                return Ok(frame);
            }
            ensure!(
                woken.recv_timeout(Duration::from_secs(20)) != Err(mpsc::RecvTimeoutError::Timeout),
                "no frame comes: {:?}",
                farm.status()
            );
        }
    };
    for _ in 0..5 {
        while next()?.stats.division != division {}
    }
    let (wall_s, servers_s, started_at) = (cpu_s(std::process::id())?, cpu_s_of(servers)?, Instant::now());
    let (mut n_frames, mut n_bytes, mut place_ms, mut n_received) = (0.0, 0.0, 0.0, 0.0);
    while started_at.elapsed() < duration {
        let frame = next()?;
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

fn cpu_s_of(servers: &BlankServers) -> anyhow::Result<f64> {
    servers.0.iter().map(|server| cpu_s(server.id())).sum()
}

/// CPU time of a process so far, in user and system mode.
fn cpu_s(process: u32) -> anyhow::Result<f64> {
    let text = std::fs::read_to_string(format!("/proc/{process}/stat"))?;
    let fields = text.rsplit(')').next().context("a process has a name")?;
    let ticks = fields.split_whitespace().skip(11).take(2).map(str::parse::<f64>);
    // The kernel counts a hundred to the second on every machine that has /proc.
    Ok(ticks.sum::<Result<f64, _>>()? / 100.0)
}

/// The payload that `iperf3` moves over loopback.
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

fn median<T>(values: &[T], figure: impl Fn(&T) -> f64) -> f64 {
    let mut figures: Vec<_> = values.iter().map(figure).collect();
    figures.sort_by(f64::total_cmp);
    figures.get(figures.len() / 2).copied().unwrap_or(f64::NAN)
}
