//! Measures how long a wall takes to notice a lost render server, to complete a frame again, and to use a new server.
//!
//!     cargo build --release && cargo run --release -p lab --example healing -- --rounds 40
//!
//! In each round one render server is killed, or frozen so that its connection stays open, while the wall renders frame
//! after frame; another is started in its place. All of them share the cores of this machine.
//!
//!     cargo run --release -p lab --example healing -- --nodes 64 --lose 1,10,50,95 --rounds 20
//!
//! kills so many percent of them at once instead, at a random phase of a frame.

use std::{
    process::Command,
    time::{Duration, Instant},
};

use anyhow::ensure;
use clap::Parser;
use compositor::farm::{Frame, RenderGoal};
use glam::DVec3;
use lab::{
    farm::{MeasuredFarm, ServerProcess, frame_spec, goal},
    statistics::{milliseconds, quantiles},
};
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
    scene::SceneId,
};

/// Measures how a wall survives losses and uses new render servers
#[derive(Parser)]
struct Args {
    /// Render servers
    #[arg(long, default_value_t = 4)]
    nodes: u32,
    /// Rounds, each of which loses one render server: killed and frozen ones in turn
    #[arg(long, default_value_t = 40)]
    rounds: u32,
    /// Triangles of the built-in statue
    #[arg(long, default_value_t = 100_000)]
    triangles: u32,
    /// Kill so many percent of the render servers at once, in as many rounds
    #[arg(long, value_name = "PERCENT", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..100))]
    lose: Vec<u32>,
}

/// Nothing that the wall is expected to do takes longer.
const TIMEOUT: Duration = Duration::from_secs(20);

struct Wall {
    farm: MeasuredFarm,
    newest: Option<Frame>,
}

impl Wall {
    /// Takes frames until a condition holds, and returns when it did.
    fn wait_until(&mut self, condition: &str, mut holds: impl FnMut(&Self) -> bool) -> anyhow::Result<Instant> {
        let started_at = Instant::now();
        loop {
            if let Some(frame) = self.farm.farm.take_frame() {
                self.newest = Some(frame);
            }
            if holds(self) {
                return Ok(Instant::now());
            }
            let status = || self.farm.farm.status();
            ensure!(started_at.elapsed() < TIMEOUT, "waited in vain until {condition}: {:?}", status());
            // The state of a node changes without a wake-up call too.
            self.farm.wait(Duration::from_millis(1));
        }
    }

    fn start_server(&self, number: u32) -> anyhow::Result<ServerProcess> {
        ServerProcess::start(format!("node-{number}"), self.farm.farm.address(), "", &[])
    }

    fn is_responding(&self, name: &str) -> bool {
        self.farm.farm.status().nodes.iter().any(|node| node.name == name && !node.is_silent)
    }

    fn newest_number(&self) -> u64 {
        self.newest.as_ref().map_or(0, |frame| frame.stats.frame)
    }

    /// Whether a render server traced a part of the newest frame.
    fn shows_share_of(&self, name: &str) -> bool {
        let nodes = self.newest.iter().flat_map(|frame| &frame.stats.nodes);
        nodes.into_iter().any(|node| node.name == name && node.share > 0.0)
    }
}

fn signal(servers: &[ServerProcess], name: &str) -> anyhow::Result<()> {
    let numbers = servers.iter().map(|server| server.id().to_string());
    let status = Command::new("kill").arg(format!("-{name}")).args(numbers).status()?;
    ensure!(status.success(), "a render server has ended by itself");
    Ok(())
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let camera = Camera::look_at(DVec3::new(1.0, 1.5, 4.0), DVec3::new(0.0, 0.9, 0.0), DVec3::Y, 0.6, 2.0)?;
    let spec = frame_spec(
        SceneId::Statue { triangles: args.triangles, treatment: Default::default() },
        camera,
        FrameSize::PAPER,
    );
    let goal = RenderGoal { spec: Some(spec), ..goal(Division::Dynamic, 1) };
    let mut wall = Wall { farm: MeasuredFarm::start(([127, 0, 0, 1], 0).into(), goal)?, newest: None };
    let mut servers = (1..=args.nodes).map(|number| wall.start_server(number)).collect::<Result<Vec<_>, _>>()?;
    if !args.lose.is_empty() {
        return lose_many(&args, &mut wall, servers);
    }
    // Times from a failure until it is noticed and until a frame is complete, of killed and of frozen render servers.
    let mut lost = [(vec![], vec![]), (vec![], vec![])];
    let (mut frames_ms, mut first_share_ms, mut ready_ms) = (vec![], vec![], vec![]);
    for round in 0..args.rounds {
        wall.wait_until("all render", |wall| servers.iter().all(|server| wall.shows_share_of(&server.name)))?;
        frames_ms.extend(wall.newest.as_ref().map(|frame| frame.stats.render_ms));
        let victim = servers.remove(round as usize % servers.len());
        let is_frozen = round % 2 == 1;
        let failed_at = Instant::now();
        signal(std::slice::from_ref(&victim), if is_frozen { "STOP" } else { "KILL" })?;
        let noticed_at = wall.wait_until("the loss is noticed", |wall| !wall.is_responding(&victim.name))?;
        let newest = wall.newest_number();
        let healed_at = wall.wait_until("a frame is complete", |wall| wall.newest_number() > newest)?;
        let (detection_ms, healing_ms) = &mut lost[usize::from(is_frozen)];
        detection_ms.push(milliseconds(noticed_at - failed_at));
        healing_ms.push(milliseconds(healed_at - failed_at));
        drop(victim);

        let started_at = Instant::now();
        let newcomer = wall.start_server(args.nodes + 1 + round)?;
        let is_ready = |wall: &Wall| {
            wall.farm.farm.status().nodes.iter().any(|node| node.name == newcomer.name && node.is_ready())
        };
        let ready_at = wall.wait_until("a newcomer is ready", is_ready)?;
        let rendered_at = wall.wait_until("a newcomer renders", |wall| wall.shows_share_of(&newcomer.name))?;
        ready_ms.push(milliseconds(ready_at - started_at));
        first_share_ms.push(milliseconds(rendered_at - ready_at));
        servers.push(newcomer);
    }
    println!("{} render servers, {} losses{:>34}{:>9}{:>9}", args.nodes, args.rounds, "p50 ms", "p99 ms", "max ms");
    let [(killed, killed_healed), (frozen, frozen_healed)] = lost;
    for (name, times_ms) in [
        ("killed: until noticed", killed),
        ("killed: until the next complete frame", killed_healed),
        ("frozen: until noticed", frozen),
        ("frozen: until the next complete frame", frozen_healed),
        ("newcomer: from the start of its process to its scene", ready_ms),
        ("newcomer: from there to a frame with its share", first_share_ms),
        ("a frame without a loss", frames_ms),
    ] {
        if !times_ms.is_empty() {
            print_row(name, times_ms);
        }
    }
    Ok(())
}

fn print_row(name: &str, times_ms: Vec<f64>) {
    let [p50, p99, max] = quantiles(times_ms, [0.5, 0.99, 1.0]);
    println!("{name:<56}{p50:>9.0}{p99:>9.0}{max:>9.0}");
}

/// Kills many render servers at once, and measures the time until the next whole frame.
fn lose_many(args: &Args, wall: &mut Wall, mut servers: Vec<ServerProcess>) -> anyhow::Result<()> {
    println!(
        "{} render servers, {} losses of each size{:>19}{:>9}{:>9}",
        args.nodes, args.rounds, "p50 ms", "p99 ms", "max ms"
    );
    for &percent in &args.lose {
        let n_lost = (args.nodes * percent).div_ceil(100).min(args.nodes - 1) as usize;
        let (mut frames_ms, mut healed_ms) = (Vec::new(), Vec::new());
        for round in 0..args.rounds {
            wall.wait_until("all render", |wall| servers.iter().all(|server| wall.shows_share_of(&server.name)))?;
            let frame_ms = wall.newest.as_ref().map_or(0.0, |frame| frame.stats.render_ms);
            frames_ms.push(frame_ms);
            // The golden ratio spreads the phases evenly.
            let phase = (f64::from(round) * 0.618).fract();
            std::thread::sleep(Duration::from_secs_f64(frame_ms * phase / 1e3));
            let lost: Vec<_> = servers.drain(..n_lost).collect();
            while let Some(frame) = wall.farm.farm.take_frame() {
                wall.newest = Some(frame);
            }
            let newest = wall.newest_number();
            let failed_at = Instant::now();
            signal(&lost, "KILL")?;
            let healed_at = wall.wait_until("a frame is complete", |wall| wall.newest_number() > newest)?;
            healed_ms.push(milliseconds(healed_at - failed_at));
            drop(lost);
            for index in 0..n_lost as u32 {
                servers.push(wall.start_server(args.nodes * (percent * args.rounds + round + 1) + index)?);
            }
        }
        for (name, times_ms) in [("until the next whole frame", healed_ms), ("a frame without a loss", frames_ms)] {
            print_row(&format!("{percent} % killed at once ({n_lost}): {name}"), times_ms);
        }
    }
    Ok(())
}
