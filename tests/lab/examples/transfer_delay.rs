//! Measures how long frames of a moving camera take while a scene file travels to a render server that lacks the model, and
//! while none does, in turns.
//!
//!     cargo build --release && cargo run --release -p lab --example transfer_delay
//!
//! In each round the camera moves in steps, each of which waits for its frame; then another render server comes, without the
//! model, and the camera moves on while that one fetches. It never renders: it is killed before it has all of the file. All
//! programs share the cores of this machine, so the transfer also takes CPU time that it would take elsewhere.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
    time::{Duration, Instant},
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
    scene::Crease,
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
}

/// The wall and the machine of the newcomer, as far as files go.
struct Machines {
    wall: PathBuf,
    far: PathBuf,
}

impl Machines {
    fn server(&self, name: &str, folder: &Path, address: &str, options: &[&str]) -> anyhow::Result<ServerProcess> {
        let mut command = Command::new(renderer_program()?);
        command.args(["connect", address, "--insecure", "--threads", "1", "--name", name]).args(options);
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
                return Ok((milliseconds(moved_at.elapsed()), !frame.stats.fetching.is_empty()));
            }
        }
    }

    /// Waits until a render server fetches, or none does any more.
    fn wait_for_transfer(&self, is_wanted: bool) -> anyhow::Result<()> {
        let started_at = Instant::now();
        let is_under_way = || {
            let nodes = self.farm.farm.status().nodes;
            nodes.iter().any(|node| node.transfer().is_some_and(|transfer| transfer.transfer.n_done > 0))
        };
        while is_under_way() != is_wanted {
            let status = || self.farm.farm.status();
            ensure!(started_at.elapsed() < TIMEOUT, "waited in vain for a transfer to begin or end: {:?}", status());
            self.farm.wait(Duration::from_millis(5));
        }
        Ok(())
    }
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let folder = tempfile::tempdir()?;
    let [wall, far] = ["wall", "far"].map(|name| folder.path().join(name));
    let machines = Machines { wall, far };
    fs::create_dir(&machines.wall)?;
    let model = machines.wall.join("statue.ply");
    ply::write(&model, &statue::generate(args.triangles, &|_| ()))?;
    // This path leads to the model here, and to nothing on the machine of the newcomer.
    std::env::set_current_dir(&machines.wall)?;
    let path = PathBuf::from("/proc/self/cwd/statue.ply");

    let cache = Cache::at(machines.wall.join("cache/raywall"), u64::MAX).map_err(|fault| anyhow!(fault))?;
    let store = SceneStore::new(Some(cache));
    let info = store.describe(&SceneSource::File(path.clone()), Crease::default(), &|_| ())?;
    let aspect = f64::from(args.size.xres()) / f64::from(args.size.yres());
    let camera = Camera::view_all(&info.shape, info.shape.up, aspect, CanvasPart::WHOLE);
    let (min, max) = info.shape.bounds;
    let goal = RenderGoal { repeat: false, scene_path: Some(path), ..goal(args.division, args.nodes) };
    let mut servers = Vec::new();
    // Dropped first: a farm that ends before its render servers reports no loss.
    let mut wall = Wall {
        farm: MeasuredFarm::start(([127, 0, 0, 1], 0).into(), goal)?,
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
                wall.wait_for_transfer(true)?;
                Some(newcomer)
            } else {
                wall.wait_for_transfer(false)?;
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
