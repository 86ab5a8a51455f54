//! How long the first frame of a motion takes to arrive: while nothing else is on its way, and while the wall's own
//! resolution is, which the motion makes stale.
//!
//!     cargo build --release && cargo run --release -p compositor --example motion_delay -- --rounds 50
//!
//! Render servers answer at once with noise or a picture, so that links are what is measured; `tests/link.sh` has them behind
//! a slow one. The two are measured in turn, so that a busy machine slows both alike. Frames are not shown.

mod blank;

use std::{
    sync::mpsc,
    time::{Duration, Instant},
};

use anyhow::ensure;
use blank::{BlankArgs, BlankServers};
use clap::Parser;
use compositor::farm::{Farm, Frame, RenderGoal};
use glam::DVec3;
use shared::{
    appearance::Appearance,
    camera::Camera,
    division::{Division, FrameSize},
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};
use tokio::net::TcpListener;

/// Measures how long a motion waits for what it makes stale.
#[derive(Parser)]
struct Args {
    /// Render servers
    #[arg(long, default_value_t = 4)]
    nodes: u32,
    /// Motions of each kind
    #[arg(long, default_value_t = 50)]
    rounds: u32,
    /// Samples of a moving camera's frame
    #[arg(long, default_value = "512x288")]
    size: FrameSize,
    /// Samples of the wall's own resolution
    #[arg(long, default_value = "4096x2304")]
    native: FrameSize,
    /// How long the wall's own resolution is on its way before the camera moves, at most, in milliseconds
    #[arg(long, default_value_t = 1000)]
    longest_ms: u32,
    #[command(flatten)]
    servers: BlankArgs,
    /// Who renders what
    #[arg(long, default_value = Division::Dynamic.name())]
    division: Division,
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let listener = runtime.block_on(TcpListener::bind(args.servers.listen))?;
    let wanted = RenderGoal {
        spec: None,
        scene_path: None,
        is_refinement: false,
        division: args.division,
        min_renderers: args.nodes,
        repeat: false,
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
    let mut wall = Wall { farm, woken, n_motions: 0 };
    let _servers = BlankServers::start(args.nodes, wall.farm.address(), &args.servers)?;
    // Connections find out what their links take.
    for _ in 0..5 {
        wall.move_on(args.size)?;
        wall.refine(args.native)?;
        wall.next()?;
    }
    let (mut alone_ms, mut amid_ms) = (vec![], vec![]);
    for round in 1..=args.rounds {
        alone_ms.push(wall.move_on(args.size)?);
        wall.refine(args.native)?;
        // Evenly spread over the time, in an order that no period of anything else meets.
        let part = (f64::from(round) * 0.618_033_988_749_895).fract();
        std::thread::sleep(Duration::from_secs_f64(part * f64::from(args.longest_ms) * 1e-3));
        amid_ms.push(wall.move_on(args.size)?);
    }
    println!("{} render servers, {}, {} motions of each kind", args.nodes, args.division.name(), args.rounds);
    println!("{:<32}{:>9}{:>9}", "to the first frame of a motion", "p50 ms", "p99 ms");
    for (name, mut times_ms) in [("at rest", alone_ms), ("while it is refined", amid_ms)] {
        times_ms.sort_by(f64::total_cmp);
        let at = |part: f64| times_ms[((times_ms.len() - 1) as f64 * part).round() as usize];
        println!("{name:<32}{:>9.1}{:>9.1}", at(0.5), at(0.99));
    }
    Ok(())
}

/// A wall whose frames nobody sees.
struct Wall {
    farm: Farm,
    woken: mpsc::Receiver<()>,
    n_motions: u32,
}

impl Wall {
    fn spec(&self, size: FrameSize) -> anyhow::Result<FrameSpec> {
        let eye = DVec3::new(f64::from(self.n_motions), 0.0, 5.0);
        Ok(FrameSpec {
            scene: SceneId::Statue { triangles: 100 },
            camera: Camera::look_at(eye, DVec3::ZERO, DVec3::Y, 0.7, 2.0)?,
            size,
            view: ShadingMode::Shaded,
            rays: LightingMode::default(),
            samples: SampleRange::CENTRE,
            appearance: Appearance::default(),
        })
    }

    /// Moves the camera, and waits for its frame: for how many milliseconds.
    fn move_on(&mut self, size: FrameSize) -> anyhow::Result<f64> {
        self.n_motions += 1;
        let spec = self.spec(size)?;
        let moved_at = Instant::now();
        self.farm.update_goal(|wanted| (wanted.spec, wanted.is_refinement) = (Some(spec), false));
        while self.next()?.spec != spec {}
        Ok(moved_at.elapsed().as_secs_f64() * 1e3)
    }

    fn refine(&mut self, native: FrameSize) -> anyhow::Result<()> {
        let spec = self.spec(native)?;
        self.farm.update_goal(|wanted| (wanted.spec, wanted.is_refinement) = (Some(spec), true));
        Ok(())
    }

    fn next(&self) -> anyhow::Result<Frame> {
        loop {
            if let Some(frame) = self.farm.take_frame() {
                return Ok(frame);
            }
            let waited = self.woken.recv_timeout(Duration::from_secs(60));
            ensure!(waited != Err(mpsc::RecvTimeoutError::Timeout), "no frame comes: {:?}", self.farm.status());
        }
    }
}
