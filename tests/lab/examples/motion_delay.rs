//! Measures how long the first frame of a motion takes to arrive: when no other frame is in flight, and while the wall
//! refines to its own resolution, which the motion interrupts.
//!
//!     cargo build --release && cargo run --release -p lab --example motion_delay -- --rounds 50
//!
//! Render servers answer at once with synthetic pictures, so that links are measured; `tests/link.sh` puts them behind a
//! slow one. The two cases alternate, so that a busy machine slows both alike. Frames are not displayed.

use std::time::{Duration, Instant};

use clap::Parser;
use compositor::farm::RenderGoal;
use glam::DVec3;
use lab::{
    farm::{MeasuredFarm, SyntheticServers, frame_spec, goal},
    statistics::{milliseconds, quantiles},
};
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
    protocol::FrameSpec,
    scene::SceneId,
};

/// Measures how long a motion waits for a refinement that it interrupts
#[derive(Parser)]
struct Args {
    /// Render servers
    #[arg(long, default_value_t = 4)]
    nodes: u32,
    /// Motions in each case
    #[arg(long, default_value_t = 50)]
    rounds: u32,
    /// Samples of a frame in motion
    #[arg(long, default_value = "512x288")]
    size: FrameSize,
    /// Samples of the wall's own resolution
    #[arg(long, default_value = "4096x2304")]
    native: FrameSize,
    /// The longest time of refinement before the camera moves, in milliseconds
    #[arg(long, default_value_t = 1000)]
    longest_ms: u32,
    #[command(flatten)]
    servers: SyntheticServers,
    /// How frames are divided among render servers: interleaved, tiled or dynamic
    #[arg(long, default_value_t = Division::Dynamic)]
    division: Division,
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    anyhow::ensure!(args.native != args.size, "--native equals --size: there is nothing to refine");
    let goal = RenderGoal { repeat: false, ..goal(args.division, args.nodes) };
    let mut wall = Wall { farm: MeasuredFarm::start(args.servers.listen, goal)?, n_motions: 0 };
    let _servers = args.servers.start(args.nodes, wall.farm.farm.address())?;
    // Connections measure which encoding their links are faster with.
    for _ in 0..5 {
        wall.move_camera(args.size)?;
        wall.refine(args.native)?;
        wall.farm.next_frame()?;
    }
    let (mut alone_ms, mut refining_ms) = (vec![], vec![]);
    for round in 1..=args.rounds {
        alone_ms.push(wall.move_camera(args.size)?);
        wall.refine(args.native)?;
        // Multiples of the golden ratio spread evenly over the time, in step with no period.
        let part = (f64::from(round) * 0.618_033_988_749_895).fract();
        std::thread::sleep(Duration::from_secs_f64(part * f64::from(args.longest_ms) * 1e-3));
        refining_ms.push(wall.move_camera(args.size)?);
    }
    println!("{} render servers, {}, {} motions in each case", args.nodes, args.division, args.rounds);
    println!("{:<32}{:>9}{:>9}", "to the first frame of a motion", "p50 ms", "p99 ms");
    for (name, times_ms) in [("at rest", alone_ms), ("while refining", refining_ms)] {
        let [p50, p99] = quantiles(times_ms, [0.5, 0.99]);
        println!("{name:<32}{p50:>9.1}{p99:>9.1}");
    }
    Ok(())
}

/// A wall without a display, whose camera moves in steps.
struct Wall {
    farm: MeasuredFarm,
    n_motions: u32,
}

impl Wall {
    fn spec(&self, size: FrameSize) -> anyhow::Result<FrameSpec> {
        let eye = DVec3::new(f64::from(self.n_motions), 0.0, 5.0);
        let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Y, 0.7, 2.0)?;
        Ok(frame_spec(SceneId::Statue { triangles: 100, treatment: Default::default() }, camera, size))
    }

    /// Moves the camera and waits for its frame; returns how many milliseconds that took.
    fn move_camera(&mut self, size: FrameSize) -> anyhow::Result<f64> {
        self.n_motions += 1;
        let spec = self.spec(size)?;
        let moved_at = Instant::now();
        self.farm.farm.update_goal(|goal| (goal.spec, goal.is_refinement) = (Some(spec), false));
        while self.farm.next_frame()?.spec != spec {}
        Ok(milliseconds(moved_at.elapsed()))
    }

    /// Asks for a frame of the wall's own resolution.
    fn refine(&mut self, native: FrameSize) -> anyhow::Result<()> {
        let spec = self.spec(native)?;
        self.farm.farm.update_goal(|goal| (goal.spec, goal.is_refinement) = (Some(spec), true));
        Ok(())
    }
}
