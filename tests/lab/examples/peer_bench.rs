//! Raywall for comparisons with other ray tracers: frames on demand, which alternate with theirs, so that other load on the
//! machine slows all of them alike.
//!
//! `peer_bench --model FILE.ply` answers lines on standard input with lines of JSON:
//!
//! - `frame KERNEL THREADS N SHADOW CAMERA`: traces N frames, after its threads were kept busy; KERNEL is `packet` or
//!   `single`, SHADOW is 1 for a shadow ray from each hit, else 0
//! - `rays single THREADS N ANY FILE`: traces the rays of a file N times, each on its own way, 256 in a call; ANY is 1 for any
//!   hit, 0 for the nearest
//! - `dump KERNEL FILE CAMERA`: writes the hits of a frame, as `lab trace --hits` does
//! - `quit`
//!
//! Each line of a camera file is a name with numbers: `eye`, `ll`, `u`, `v` and `light` in world space, and `res`, the
//! samples across and down.

use std::{
    collections::{HashMap, hash_map::Entry},
    fs,
    num::NonZero,
    path::{Path, PathBuf},
    process::ExitCode,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail, ensure};
use channel::files;
use clap::{Parser, ValueEnum};
use cpu_time::ProcessTime;
use glam::{DVec3, Vec3};
use lab::{
    farm::frame_spec,
    statistics::milliseconds,
    trace::{
        cameras::read_line,
        frame::{Frame, FrameOptions, Kernel},
        secondary::{Found, trace_rays},
    },
};
use rayon::ThreadPool;
use renderer::{
    cli::{self, say, scene_args::SceneArgs},
    intersect::{InstructionSet, ray::Ray},
    memory::EndingAllocator,
    model::scene::{self, SceneSource},
    render::{scene::Scene, threads},
};
use serde_json::json;
use shared::{
    camera::Camera,
    division::FrameSize,
    protocol::FrameSpec,
    scene::{SceneId, Treatment},
};

/// That of all programs.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

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

    /// Vector instructions to trace with: portable, avx2 or avx512 [default: the fastest of this machine]
    #[arg(long, value_name = "SET", value_parser = instructions)]
    instructions: Option<InstructionSet>,
}

fn instructions(name: &str) -> Result<InstructionSet, String> {
    let available = InstructionSet::available();
    let name_of = |set: &InstructionSet| format!("{set:?}").to_lowercase();
    let named = available.iter().find(|set| name_of(set) == name);
    let names: Vec<_> = available.iter().map(name_of).collect();
    named.copied().ok_or_else(|| format!("this machine has {}", names.join(", ")))
}

fn main() -> ExitCode {
    cli::exit_code(serve())
}

fn serve() -> Result<()> {
    let args: Args = cli::parse();
    let started = Instant::now();
    let mesh = scene::load(&SceneSource::File(args.model.clone()), Treatment::FLAT, &|_| ())?.mesh;
    let load_s = started.elapsed().as_secs_f64();
    let (n_triangles, n_vertices) = (mesh.triangles.len(), mesh.vertices.len());
    let options = args.scene.options();
    let pool = threads::pool(args.build_threads.map(NonZero::get))?;
    let (started, started_cpu) = (Instant::now(), ProcessTime::now());
    let mut scene = pool.install(|| Scene::build(mesh, &options, &|_| ()));
    let build_s = started.elapsed().as_secs_f64();
    let build_cpu_s = started_cpu.elapsed().as_secs_f64();
    let set = args.instructions.unwrap_or_else(InstructionSet::best);
    scene.grid = scene.grid.with_instructions(set);
    let engine = format!("raywall, {}, density {}, {set:?}", options.storage, scene.grid.figures().density);
    say(json!({
        "event": "ready", "engine": engine, "ply": args.model, "tris": n_triangles, "verts": n_vertices,
        "load_s": load_s, "build_threads": pool.current_num_threads(), "build_s": build_s, "build_cpu_s": build_cpu_s,
        "mem_bytes": scene.grid.n_bytes(),
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
            ["rays", mode @ "single", n_threads, n_repeats, any, file] => {
                let n_repeats = n_repeats.parse::<NonZero<u32>>().context("repeats")?.get();
                let n_threads = n_threads.parse::<NonZero<usize>>().context("threads")?.get();
                server.trace_rays(mode, n_threads, n_repeats, any == "1", Path::new(file))?;
            }
            ["dump", kernel, file, camera] => server.dump(kernel, Path::new(file), Path::new(camera))?,
            _ => say(json!({ "event": "error", "why": format!("\"{line}\": see the head of peer_bench.rs") }))?,
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
        let pool = pool(&mut self.pools, n_threads)?;
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

    fn trace_rays(&mut self, mode: &str, n_threads: usize, n_repeats: u32, any: bool, file: &Path) -> Result<()> {
        let rays = read_rays(file)?;
        let pool = pool(&mut self.pools, n_threads)?;
        let scene = &self.scene;
        let mut found = Found::default();
        let (mut walls, mut cpus) = (Vec::new(), Vec::new());
        pool.install(|| {
            for _ in 0..n_repeats {
                let start = Instant::now();
                let (of_all, cpu) = trace_rays(scene, &rays, any);
                found = of_all;
                walls.push(milliseconds(start.elapsed()));
                cpus.push(milliseconds(cpu));
            }
        });
        say(json!({
            "event": "frames", "engine": self.engine, "mode": mode, "threads": n_threads, "any": u8::from(any),
            "file": file, "ms": walls, "cpu_ms": cpus, "rays": rays.len(), "hits": found.n_hits,
            "sum": found.sum_of_triangles,
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

/// The pool of this many threads.
fn pool(pools: &mut HashMap<usize, ThreadPool>, n_threads: usize) -> Result<&ThreadPool> {
    Ok(match pools.entry(n_threads) {
        Entry::Occupied(pool) => pool.into_mut(),
        Entry::Vacant(entry) => entry.insert(threads::pool(Some(n_threads))?),
    })
}

/// Reads a ray file: eight little-endian `f32` a ray, origin and start of its interval, direction and end.
fn read_rays(file: &Path) -> Result<Vec<Ray>> {
    let bytes = fs::read(file).with_context(|| file.display().to_string())?;
    ensure!(bytes.len().is_multiple_of(32), "{} is no ray file: rays have 32 bytes", file.display());
    let rays = bytes.chunks_exact(32).map(|ray| {
        let n: [f32; 8] =
            std::array::from_fn(|index| f32::from_le_bytes(std::array::from_fn(|byte| ray[4 * index + byte])));
        Ray { origin: Vec3::new(n[0], n[1], n[2]), t_min: n[3], direction: Vec3::new(n[4], n[5], n[6]), t_max: n[7] }
    });
    Ok(rays.collect())
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
        Ok(Self {
            spec: frame_spec(SceneId::Statue { triangles: 0, treatment: Default::default() }, camera, size),
            light: point("light")?,
        })
    }
}
