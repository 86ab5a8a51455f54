//! Raywall for comparisons with other ray tracers: frames on demand, which alternate with theirs, so that other load on the
//! machine slows all of them alike.
//!
//! `peer_bench --model FILE.ply` answers lines on standard input with lines of JSON:
//!
//! - `frame KERNEL THREADS N SHADOW CAMERA`: traces N frames, after its threads were kept busy; KERNEL is `packet` or
//!   `single`, SHADOW is 1 for a shadow ray from each hit, else 0
//! - `dump KERNEL FILE CAMERA`: writes the hits of a frame, as `lab trace --hits` does
//! - `quit`
//!
//! Each line of a camera file is a name with numbers: `eye`, `ll`, `u`, `v` and `light` in world space, and `res`, the
//! samples across and down.

use std::{
    collections::{HashMap, hash_map::Entry},
    num::NonZero,
    path::{Path, PathBuf},
    process::ExitCode,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail, ensure};
use channel::files;
use clap::{Parser, ValueEnum};
use cpu_time::ProcessTime;
use glam::DVec3;
use lab::{
    farm::frame_spec,
    statistics::milliseconds,
    trace::{
        cameras::read_line,
        frame::{Frame, FrameOptions, Kernel},
    },
};
use rayon::ThreadPool;
use renderer::{
    cli::{self, say, scene_args::SceneArgs},
    model::scene::{self, SceneSource},
    render::{scene::Scene, threads},
};
use serde_json::json;
use shared::{camera::Camera, division::FrameSize, protocol::FrameSpec, scene::SceneId};

/// Traces frames on demand, for comparisons with other ray tracers
#[derive(Parser)]
struct Args {
    /// A PLY file
    #[arg(long, alias = "ply", value_name = "FILE")]
    model: PathBuf,

    #[command(flatten)]
    scene: SceneArgs,

    /// Threads that build the scene [default: one a core]
    #[arg(long, value_name = "N")]
    build_threads: Option<NonZero<usize>>,
}

fn main() -> ExitCode {
    cli::exit_code(serve())
}

fn serve() -> Result<()> {
    let args: Args = cli::parse();
    let started = Instant::now();
    let mesh = scene::load(&SceneSource::Ply(args.model.clone()), &|_| ())?.mesh;
    let load_s = started.elapsed().as_secs_f64();
    let (n_triangles, n_vertices) = (mesh.triangles.len(), mesh.vertices.len());
    let options = args.scene.options();
    let pool = threads::pool(args.build_threads.map(NonZero::get))?;
    let (started, started_cpu) = (Instant::now(), ProcessTime::now());
    let scene = pool.install(|| Scene::build(mesh, &options, &|_| ()));
    let engine = format!("raywall, {}, density {}", options.storage, scene.grid.figures().density);
    say(json!({
        "event": "ready", "engine": engine, "ply": args.model, "tris": n_triangles, "verts": n_vertices,
        "load_s": load_s, "build_threads": pool.current_num_threads(), "build_s": started.elapsed().as_secs_f64(),
        "build_cpu_s": started_cpu.elapsed().as_secs_f64(), "mem_bytes": scene.grid.n_bytes(),
        "mesh_bytes": scene.mesh().n_bytes(),
    }))?;

    let mut server = Server { scene, engine, pools: HashMap::new() };
    let (mut orders, mut line) = (std::io::stdin().lock(), String::new());
    while read_line(&mut orders, &mut line).context("cannot read the next order")? {
        let line = line.trim();
        let words: Vec<&str> = line.split_whitespace().collect();
        match words[..] {
            [] => (),
            ["quit"] => break,
            ["frame", kernel, n_threads, n_frames, shadow, camera] => {
                let n_frames = n_frames.parse::<NonZero<u32>>().context("frames")?.get();
                let n_threads = n_threads.parse::<NonZero<usize>>().context("threads")?.get();
                server.trace(kernel, n_threads, n_frames, shadow == "1", Path::new(camera))?;
            }
            ["dump", kernel, file, camera] => server.dump(kernel, Path::new(file), Path::new(camera))?,
            _ => bail!("\"{line}\" is not an order: see the head of peer_bench.rs"),
        }
    }
    Ok(())
}

struct Server {
    scene: Scene,
    engine: String,
    /// By number of threads.
    pools: HashMap<usize, ThreadPool>,
}

impl Server {
    fn trace(&mut self, kernel: &str, n_threads: usize, n_frames: u32, shadow: bool, camera: &Path) -> Result<()> {
        let PeerCamera { spec, light } = PeerCamera::read(camera)?;
        let light = shadow.then_some(light);
        let options = FrameOptions { kernel: named_kernel(kernel)?, light };
        let pool = match self.pools.entry(n_threads) {
            Entry::Occupied(pool) => pool.into_mut(),
            Entry::Vacant(entry) => entry.insert(threads::pool(Some(n_threads))?),
        };
        // Registers only, no memory.
        pool.broadcast(|_| {
            let start = Instant::now();
            while start.elapsed() < BEFORE_FRAMES {}
        });
        // One call for all frames: a thread that sleeps between frames is late for the next.
        let mut frame = Frame::new(spec.size);
        let costs: Vec<_> = pool.install(|| (0..n_frames).map(|_| frame.trace(&self.scene, &spec, &options)).collect());
        let last = costs[costs.len() - 1];
        say(json!({
            "event": "frames", "engine": self.engine, "mode": kernel, "threads": n_threads,
            "shadow": u8::from(shadow), "cam": camera,
            "ms": costs.iter().map(|cost| milliseconds(cost.wall)).collect::<Vec<_>>(),
            "cpu_ms": costs.iter().map(|cost| milliseconds(cost.cpu)).collect::<Vec<_>>(),
            "rays": spec.size.n_samples() as usize + last.n_shadow_rays, "hits": frame.n_hits(),
            "shadow_rays": last.n_shadow_rays, "shadowed": last.n_shadowed,
        }))
    }

    fn dump(&self, kernel: &str, file: &Path, camera: &Path) -> Result<()> {
        let options = FrameOptions { kernel: named_kernel(kernel)?, light: None };
        let PeerCamera { spec, .. } = PeerCamera::read(camera)?;
        let mut frame = Frame::new(spec.size);
        frame.trace(&self.scene, &spec, &options);
        files::write(file, |out| frame.write_hits(&self.scene, out))
            .with_context(|| format!("cannot write {}", file.display()))?;
        say(json!({ "event": "dumped" }))
    }
}

/// How long threads are kept busy before frames are timed.
///
/// The host of a virtual machine may place processors that wake up on two hyperthreads of one core, and separates them only
/// later. In the first 40 ms after frames on one thread, more than half of the frames on two took 1.1 times as long or
/// longer; from 200 ms on, one in seven. The first ray tracer of a comparison would pay for that.
const BEFORE_FRAMES: Duration = Duration::from_millis(200);

fn named_kernel(name: &str) -> Result<Kernel> {
    Kernel::from_str(name, false).map_err(|_| anyhow::anyhow!("\"{name}\" is not a kernel: write packet or single"))
}

/// A camera and a light, in the format of the other ray tracers.
struct PeerCamera {
    spec: FrameSpec,
    light: DVec3,
}

impl PeerCamera {
    fn read(path: &Path) -> Result<Self> {
        let text = files::read_text(path, 1 << 20).with_context(|| path.display().to_string())?;
        Self::parse(&text).with_context(|| format!("{} is not a camera", path.display()))
    }

    fn parse(text: &str) -> Result<Self> {
        let mut named = HashMap::from([("light", vec![3.0, 5.0, 4.0]), ("res", vec![1024.0, 512.0])]);
        for line in text.lines().map(str::trim).filter(|line| !line.is_empty()) {
            let (name, numbers) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
            let is_known = ["eye", "ll", "u", "v", "light", "res"].contains(&name);
            ensure!(is_known, "\"{name}\" is none of eye, ll, u, v, light and res");
            let numbers = numbers.split_whitespace().map(str::parse).collect::<Result<_, _>>();
            named.insert(name, numbers.with_context(|| line.to_owned())?);
        }
        let point = |name: &str| match named.get(name).map_or(&[][..], Vec::as_slice) {
            &[x, y, z] => Ok(DVec3::new(x, y, z)),
            _ => bail!("{name} needs three numbers"),
        };
        let &[xres, yres] = &named["res"][..] else { bail!("res needs two numbers") };
        let size = FrameSize::new(xres as u32, yres as u32)?;
        let camera = Camera::new(point("eye")?, point("ll")?, point("u")?, point("v")?)?;
        Ok(Self { spec: frame_spec(SceneId::Statue { triangles: 0 }, camera, size), light: point("light")? })
    }
}
