//! How long a wall takes to notice that a render server is gone, to show a whole frame again, and to use a new one.
//!
//!     cargo build --release && cargo run --release -p compositor --example healing -- --rounds 40
//!
//! In each round one of the render servers is killed, or frozen so that its connection stays open, while frame after frame
//! is rendered; another is started in its place. All run on this machine, so each has a part of its cores only.

use std::{
    process::{Child, Command},
    sync::mpsc,
    time::{Duration, Instant},
};

use anyhow::{Context, ensure};
use clap::Parser;
use compositor::farm::{Farm, Frame, RenderGoal};
use shared::{
    appearance::Appearance,
    camera::Camera,
    division::{Division, FrameSize},
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};
use tokio::net::TcpListener;

/// Measures detection, healing and newcomers.
#[derive(Parser)]
struct Args {
    /// Render servers
    #[arg(long, default_value_t = 4)]
    nodes: u32,
    /// Render servers to lose, every other one killed and every other one frozen
    #[arg(long, default_value_t = 40)]
    rounds: u32,
    /// Triangles of the statue that is rendered
    #[arg(long, default_value_t = 100_000)]
    triangles: u32,
}

/// How long anything may take before something is wrong.
const PATIENCE: Duration = Duration::from_secs(20);

/// A wall without a display.
struct Wall {
    farm: Farm,
    woken: mpsc::Receiver<()>,
    /// The last whole frame.
    last: Option<Frame>,
}

impl Wall {
    /// Takes frames until something holds; when it did.
    fn wait_until(&mut self, what: &str, mut holds: impl FnMut(&Self) -> bool) -> anyhow::Result<Instant> {
        let started_at = Instant::now();
        loop {
            if let Some(frame) = self.farm.take_frame() {
                self.last = Some(frame);
            }
            if holds(self) {
                return Ok(Instant::now());
            }
            ensure!(started_at.elapsed() < PATIENCE, "waited in vain until {what}: {:?}", self.farm.status());
            // A wall that is asked once a millisecond is asked often enough.
            let _ = self.woken.recv_timeout(Duration::from_millis(1));
        }
    }

    fn is_heard(&self, name: &str) -> bool {
        self.farm.status().nodes.iter().any(|node| node.name == name && !node.is_silent)
    }

    fn last_frame(&self) -> u64 {
        self.last.as_ref().map_or(0, |frame| frame.stats.frame)
    }

    /// Whether the last whole frame is in part the work of a render server.
    fn shows_work_of(&self, name: &str) -> bool {
        self.last
            .as_ref()
            .is_some_and(|frame| frame.stats.nodes.iter().any(|node| node.name == name && node.share > 0.0))
    }
}

/// A render server, ended when it is dropped, in whatever state it is.
struct Server {
    name: String,
    process: Child,
}

impl Server {
    fn start(wall: &Wall, number: u32) -> anyhow::Result<Self> {
        let example = std::env::current_exe()?;
        let folder = example.parent().and_then(|examples| examples.parent()).context("an example lies in a folder")?;
        let name = format!("node-{number}");
        let process = Command::new(folder.join("renderer"))
            .args(["connect", &wall.farm.address().to_string(), "--threads", "1", "--name", &name])
            .env("RUST_LOG", "error")
            .spawn()
            .context("the program `renderer` is not built: cargo build --release")?;
        Ok(Self { name, process })
    }

    fn signal(&self, name: &str) -> anyhow::Result<()> {
        let status = Command::new("kill").args([format!("-{name}"), self.process.id().to_string()]).status()?;
        ensure!(status.success(), "a render server has ended by itself");
        Ok(())
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0"))?;
    let eye = glam::DVec3::new(1.0, 1.5, 4.0);
    let spec = FrameSpec {
        scene: SceneId::Statue { triangles: args.triangles },
        camera: Camera::look_at(eye, glam::DVec3::new(0.0, 0.9, 0.0), glam::DVec3::Y, 0.6, 2.0)?,
        size: FrameSize::PAPER,
        view: ShadingMode::Shaded,
        rays: LightingMode::default(),
        samples: SampleRange::CENTRE,
        appearance: Appearance::default(),
    };
    let wanted = RenderGoal {
        spec: Some(spec),
        scene_path: None,
        is_refinement: false,
        division: Division::Dynamic,
        min_renderers: 1,
        repeat: true,
        in_flight: 2,
        encoding: None,
        moved_at: Instant::now(),
    };
    let (wake, woken) = mpsc::sync_channel(1);
    let guard = runtime.enter();
    let farm = Farm::start(listener, None, wanted, move || {
        let _ = wake.try_send(());
    })?;
    drop(guard);
    let mut wall = Wall { farm, woken, last: None };
    let mut servers = Vec::new();
    for number in 1..=args.nodes {
        servers.push(Server::start(&wall, number)?);
    }
    // Detection, and from the failure to a whole frame; of those killed and of those frozen.
    let mut lost = [(vec![], vec![]), (vec![], vec![])];
    let (mut frames_ms, mut first_work_ms, mut ready_ms) = (vec![], vec![], vec![]);
    for round in 0..args.rounds {
        wall.wait_until("all render", |wall| servers.iter().all(|server| wall.shows_work_of(&server.name)))?;
        frames_ms.push(wall.last.as_ref().map_or(0.0, |frame| frame.stats.render_ms));
        let victim = servers.remove(round as usize % servers.len());
        let is_frozen = round % 2 == 1;
        let failed_at = Instant::now();
        victim.signal(if is_frozen { "STOP" } else { "KILL" })?;
        let noticed_at = wall.wait_until("it is noticed", |wall| !wall.is_heard(&victim.name))?;
        let last = wall.last_frame();
        let healed_at = wall.wait_until("a frame is whole", |wall| wall.last_frame() > last)?;
        let (detection_ms, healing_ms) = &mut lost[usize::from(is_frozen)];
        detection_ms.push(milliseconds(noticed_at - failed_at));
        healing_ms.push(milliseconds(healed_at - failed_at));
        drop(victim);

        let started_at = Instant::now();
        let newcomer = Server::start(&wall, args.nodes + 1 + round)?;
        let is_ready =
            |wall: &Wall| wall.farm.status().nodes.iter().any(|node| node.name == newcomer.name && node.is_ready());
        let ready_at = wall.wait_until("a newcomer is ready", is_ready)?;
        let works_at = wall.wait_until("a newcomer renders", |wall| wall.shows_work_of(&newcomer.name))?;
        ready_ms.push(milliseconds(ready_at - started_at));
        first_work_ms.push(milliseconds(works_at - ready_at));
        servers.push(newcomer);
    }
    println!("{} render servers, {} losses{:>34}{:>9}{:>9}", args.nodes, args.rounds, "p50 ms", "p99 ms", "max ms");
    let [(killed, killed_healed), (frozen, frozen_healed)] = lost;
    row("killed: noticed", killed);
    row("killed: a whole frame is there", killed_healed);
    row("frozen: noticed", frozen);
    row("frozen: a whole frame is there", frozen_healed);
    row("newcomer: from starting its process to having the scene", ready_ms);
    row("newcomer: from there to a whole frame with its work", first_work_ms);
    row("a frame without a loss", frames_ms);
    Ok(())
}

fn row(name: &str, mut values: Vec<f64>) {
    values.sort_by(f64::total_cmp);
    let at = |part: f64| values.get(((values.len() as f64 * part).ceil() as usize).saturating_sub(1));
    if let (Some(p50), Some(p99), Some(max)) = (at(0.5), at(0.99), values.last()) {
        println!("{name:<56}{p50:>9.0}{p99:>9.0}{max:>9.0}");
    }
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
