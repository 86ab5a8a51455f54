//! Measures how long frames of a moving camera take while a scene file travels to a render server that lacks the model, and
//! while none does, in turns.
//!
//!     cargo build --release && cargo run --release -p lab --example transfer_delay
//!
//! In each round the camera moves in steps, each of which waits for its frame; then another render server comes, without the
//! model, and the camera moves on while that one fetches. It never renders: it is killed before it has all of the file. All
//! programs share the cores of this machine, so the transfer also takes CPU time that it would take elsewhere.
//! `tests/link.sh` puts render servers behind a slow link.

use std::{
    fs,
    net::SocketAddr,
    path::{Path, PathBuf},
    process::Command,
    time::Instant,
};

use anyhow::{Context, anyhow, ensure};
use clap::Parser;
use compositor::farm::RenderGoal;
use glam::DVec3;
use lab::{
    farm::{MeasuredFarm, ServerProcess, TIMEOUT, frame_spec, goal, renderer_program},
    statistics::{median, milliseconds, quantiles},
};
use renderer::{
    formats::ply,
    grid::GridOptions,
    model::{scene::SceneSource, statue},
    scene_file::{SceneStore, cache::Cache},
};
use shared::{
    camera::{Camera, CanvasPart, UpAxis},
    division::{Division, FrameSize},
    protocol::FrameSpec,
    scene::Treatment,
};

/// Measures frames of a moving camera with and without a scene file under way
#[derive(Parser)]
struct Args {
    /// Rounds, each with frames of both kinds
    #[arg(long, default_value_t = 8, value_parser = renderer::cli::between(1_u32..=10_000))]
    rounds: u32,
    /// Frames of each kind in a round
    #[arg(long, default_value_t = 100, value_parser = renderer::cli::between(1_u32..=100_000))]
    frames: u32,
    /// Render servers that have the model
    #[arg(long, default_value_t = 2, value_parser = renderer::cli::between(1_u32..=64))]
    nodes: u32,
    /// Triangles of the built-in statue: its file must outlast the frames of a round, at 13 MB a second
    #[arg(long, default_value_t = 3_000_000, value_parser = renderer::cli::between(200_000..=statue::MOST_TRIANGLES))]
    triangles: u32,
    /// Samples of a frame
    #[arg(long, default_value_t = FrameSize::PAPER)]
    size: FrameSize,
    /// How frames are divided among render servers: interleaved, tiled or dynamic
    #[arg(long, default_value_t = Division::Dynamic)]
    division: Division,
    /// The address to listen on, for example in a network namespace with a link of limited rate
    #[arg(long, default_value = "127.0.0.1:0")]
    listen: SocketAddr,
    /// The command that starts render servers, for example "ip netns exec other"
    #[arg(long, default_value = "")]
    through: String,
}

/// The wall and the machine of the newcomer, as far as files go.
struct Machines {
    wall: PathBuf,
    far: PathBuf,
    /// The words of a command that starts render servers, if any.
    through: String,
}

impl Machines {
    fn server(&self, name: &str, folder: &Path, address: &str, options: &[&str]) -> anyhow::Result<ServerProcess> {
        let program = renderer_program()?.display().to_string();
        let mut words = self.through.split_whitespace().chain([program.as_str()]);
        let mut command = Command::new(words.next().context("the last word is the program")?);
        command.args(words).args(["connect", address, "--insecure", "--threads", "1", "--name", name]).args(options);
        command.current_dir(folder).env("XDG_CACHE_HOME", folder.join("cache")).env("RUST_LOG", "error");
        ServerProcess::spawn(name.to_owned(), &mut command)
    }
}

/// A wall without a display, whose camera goes round the model.
struct Wall {
    farm: MeasuredFarm,
    spec: FrameSpec,
    pivot: DVec3,
    up: UpAxis,
}

impl Wall {
    /// Moves the camera and waits for its frame; returns how many milliseconds that took, and whether a scene file was under
    /// way then.
    fn step(&mut self) -> anyhow::Result<(f64, bool)> {
        self.spec.camera = self.spec.camera.orbit(self.pivot, self.up, 0.01, 0.0);
        let (spec, moved_at) = (self.spec, Instant::now());
        self.farm.farm.update_goal(|goal| goal.spec = Some(spec));
        loop {
            let frame = self.farm.next_frame()?;
            if frame.spec == spec {
                let is_travelling = frame.stats.fetching.iter().any(|node| node.transfer.n_done > 0);
                return Ok((milliseconds(moved_at.elapsed()), is_travelling));
            }
        }
    }

    /// Moves the camera until a scene file is under way, or until none is any more: while it rests, one travels faster.
    fn move_until(&mut self, is_wanted: bool) -> anyhow::Result<()> {
        let started_at = Instant::now();
        while self.step()?.1 != is_wanted {
            let status = || self.farm.farm.status();
            ensure!(started_at.elapsed() < TIMEOUT, "waited in vain for a transfer to begin or end: {:?}", status());
        }
        Ok(())
    }
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let folder = tempfile::tempdir()?;
    let [wall, far] = ["wall", "far"].map(|name| folder.path().join(name));
    let machines = Machines { wall, far, through: args.through };
    fs::create_dir(&machines.wall)?;
    let model = machines.wall.join("statue.ply");
    ply::write(&model, &statue::generate(args.triangles, &|_| ()))?;
    // This path leads to the model here, and to nothing on the machine of the newcomer.
    std::env::set_current_dir(&machines.wall)?;
    let path = PathBuf::from("/proc/self/cwd/statue.ply");

    let cache = Cache::at(machines.wall.join("cache/raywall"), u64::MAX).map_err(|fault| anyhow!(fault))?;
    let store = SceneStore::new(Some(cache));
    let info = store.describe(&SceneSource::File(path.clone()), Treatment::default(), &|_| ())?;
    let aspect = f64::from(args.size.xres()) / f64::from(args.size.yres());
    let camera = Camera::view_all(&info.shape, info.shape.up, aspect, CanvasPart::WHOLE);
    let (min, max) = info.shape.bounds;
    let goal = RenderGoal { repeat: false, scene_path: Some(path), ..goal(args.division, args.nodes) };
    let mut servers = Vec::new();
    // Dropped first: a farm that ends before its render servers reports no loss.
    let mut wall = Wall {
        farm: MeasuredFarm::start(args.listen, goal)?,
        spec: frame_spec(info.id, camera, args.size),
        pivot: (min + max) * 0.5,
        up: info.shape.up,
    };
    wall.farm.farm.give_scene_files(store, GridOptions::default());
    let address = wall.farm.farm.address().to_string();
    let model = model.to_str().context("the folder for temporary files has a name in UTF-8")?;
    for number in 1..=args.nodes {
        let name = format!("near-{number}");
        servers.push(machines.server(&name, &machines.wall, &address, &["--model", model])?);
    }
    // Scenes are loaded, costs measured, and the scene file made.
    for _ in 0..20 {
        wall.step()?;
    }

    println!("{} render servers, {}, {} rounds of {} frames", args.nodes, args.division, args.rounds, args.frames);
    println!("{:<10}{:>20}{:>20}{:>20}", "", "without: p50, p99", "with: p50, p99", "ratio: p50, p99");
    let mut all = [Vec::new(), Vec::new()];
    let mut ratios = [Vec::new(), Vec::new()];
    for round in 0..=args.rounds {
        let mut times_ms = [Vec::new(), Vec::new()];
        // Each kind is the first as often as the other.
        for kind in if round % 2 == 0 { [0, 1] } else { [1, 0] } {
            let newcomer = if kind == 1 {
                fs::create_dir_all(&machines.far)?;
                let newcomer = machines.server("far", &machines.far, &address, &[])?;
                wall.move_until(true)?;
                Some(newcomer)
            } else {
                wall.move_until(false)?;
                None
            };
            for _ in 0..args.frames {
                let (time_ms, is_travelling) = wall.step()?;
                ensure!(
                    is_travelling == (kind == 1),
                    "the scene file has arrived before the last frame: ask for more --triangles, or fewer --frames"
                );
                times_ms[kind].push(time_ms);
            }
            drop(newcomer);
            if kind == 1 {
                fs::remove_dir_all(&machines.far)?;
            }
        }
        // The first round finds caches cold.
        if round > 0 {
            let figures = row(&round.to_string(), &times_ms);
            ratios.iter_mut().zip(figures).for_each(|(ratios, ratio)| ratios.push(ratio));
            all.iter_mut().zip(times_ms).for_each(|(all, times_ms)| all.extend(times_ms));
        }
    }
    row("all", &all);
    let [p50, p99] = ratios.map(median);
    println!("{:<10}{:>52.2}{:>8.2}", "median", p50, p99);
    Ok(())
}

/// Prints a line; returns the ratios of p50 and p99.
fn row(name: &str, times_ms: &[Vec<f64>; 2]) -> [f64; 2] {
    let [without, with] = times_ms.each_ref().map(|times_ms| quantiles(times_ms.iter().copied(), [0.5, 0.99]));
    let ratios = [with[0] / without[0], with[1] / without[1]];
    let [a, b, c] = [without, with, ratios].map(|[p50, p99]| format!("{p50:>12.2}{p99:>8.2}"));
    println!("{name:<10}{a}{b}{c}");
    ratios
}
