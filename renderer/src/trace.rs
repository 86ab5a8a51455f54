//! `renderer trace`: traces frames without a network, and measures them.

mod cameras;
pub mod frame;
mod shadows;

use std::{
    io::Read,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context, Result, ensure};
use clap::Args;
use glam::Vec3;
use serde::Serialize;
use shared::{
    camera::{Camera, UpAxis},
    division::FrameSize,
    protocol::{RayTree, SampleRange, View},
};

use crate::{
    cli::say,
    grid::{Choice, GridFigures},
    image,
    look_args::LookArgs,
    progress::Progress,
    scene::{self, SceneSource},
    scene_args::SceneArgs,
    statue, threads,
    tracer::{FrameRequest, Scene},
};

use frame::{Frame, FrameOptions, Kernel};

/// What to trace, and what to write.
#[derive(Args, Debug)]
pub struct TraceArgs {
    /// A PLY file; without it the built-in statue is traced
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,

    /// Triangles of the built-in statue
    #[arg(long, value_name = "N", default_value_t = statue::DEFAULT_TRIANGLES, conflicts_with = "model",
        value_parser = clap::value_parser!(u32).range(100..=100_000_000))]
    triangles: u32,

    /// A camera file with eye, ll, u and v; without it the whole model is seen
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,

    /// Trace one frame for each camera file whose path stands on a line of standard input, and answer each with a line
    /// of JSON; one that cannot be read ends it; the only value is -
    #[arg(long, value_name = "-", conflicts_with_all = ["camera", "frames", "image", "hits"])]
    cameras: Option<String>,

    /// Follow the rays of a tile together, or each alone
    #[arg(long, value_name = "KERNEL", value_enum, default_value_t)]
    kernel: Kernel,

    /// Also trace a ray from each hit to the light
    #[arg(long, conflicts_with = "clip")]
    shadow_rays: bool,

    /// Where the light of the shadow rays stands, in world space
    #[arg(long, value_name = "X,Y,Z", default_value = "3,5,4", value_parser = point)]
    light: Vec3,

    /// Which axis of the model points up, when the whole model is seen: x, y or z
    #[arg(long, value_name = "AXIS", default_value = "y")]
    up: UpAxis,

    /// Samples across and down
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value_t = FrameSize::PAPER, allow_hyphen_values = true)]
    size: FrameSize,

    /// Threads that build and trace; without it as many as there are cores
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,

    /// How often the frame is traced, for measuring
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    frames: u32,

    /// What the picture shows: shaded, normals, or cost (cells passed in red, triangles tested in green)
    #[arg(long, value_name = "VIEW", default_value = "shaded")]
    view: View,

    /// By which rays the picture is lit: primary, shadows or ambient
    #[arg(long, value_name = "RAYS", default_value = RayTree::default().name())]
    rays: RayTree,

    /// Write the picture, as PNG
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,

    /// Write the hits: per sample, bottom row first, little endian, the triangle in file order as u32 (0xffffffff for
    /// none) and t as f32 in units of the ray's direction (infinite for none)
    #[arg(long, value_name = "FILE")]
    hits: Option<PathBuf>,

    /// Also print how the grid was chosen, and what other ways to keep the scene are predicted to take
    #[arg(long, conflicts_with = "cameras")]
    explain: bool,

    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,

    /// How the picture looks
    #[command(flatten)]
    look: LookArgs,

    /// How the scene is made ready
    #[command(flatten)]
    scene: SceneArgs,
}

fn point(text: &str) -> Result<Vec3, String> {
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z]) if x.is_finite() && y.is_finite() && z.is_finite() => Ok(Vec3::new(x, y, z)),
        _ => Err("a point is three finite numbers, as in 3,5,4".to_owned()),
    }
}

/// What was measured. Times of frames are in milliseconds, one entry per frame.
#[derive(Debug, Serialize)]
struct Report {
    triangles: usize,
    vertices: usize,
    rejected: usize,
    load_seconds: f64,
    build_seconds: f64,
    mesh_bytes: usize,
    structure_bytes: usize,
    grid: GridFigures,
    /// How the grid was chosen, if that was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    choice: Option<Choice>,
    /// `None` where the system does not tell.
    peak_rss_bytes: Option<u64>,
    hits: usize,
    /// Rays from hits to the light.
    shadow_rays: usize,
    /// Hits that the light does not reach.
    shadowed: usize,
    /// Rays of a frame over the median of `frame_ms`.
    mrays_per_second: f64,
    /// Wall time of tracing.
    frame_ms: Vec<f64>,
    /// CPU time of all threads for making rays, following them and writing the hits.
    frame_cpu_ms: Vec<f64>,
    /// CPU time of all threads for shading the hits.
    shade_cpu_ms: Vec<f64>,
    /// Cells that the primary rays of a frame pass when each is followed alone, and triangles that they are tested
    /// against: all of them, and per ray.
    cell_traversals: u64,
    triangle_tests: u64,
    cell_traversals_per_ray: f64,
    triangle_tests_per_ray: f64,
}

/// Loads, builds, traces, and writes what was asked for.
pub fn run(args: &TraceArgs) -> Result<()> {
    threads::pool(args.threads.map(usize::from))?.install(|| run_in_pool(args))
}

fn run_in_pool(args: &TraceArgs) -> Result<()> {
    // What is asked for is checked before a large model is read.
    if let Some(source) = &args.cameras {
        ensure!(source == "-", "--cameras {source}: cameras are only read from standard input, which is written as -");
    }
    let options = FrameOptions { kernel: args.kernel, light: args.shadow_rays.then_some(args.light) };
    let camera = args.camera.as_deref().map(read_camera).transpose()?;
    let (source, name) = match &args.model {
        Some(path) => (SceneSource::Ply(path.clone()), path.display().to_string()),
        None => (SceneSource::Statue { triangles: args.triangles }, "the statue".to_owned()),
    };
    let (mesh, load_seconds) = timed(|| {
        let progress = Progress::new(format!("loading {name}"));
        scene::load(&source, &|done| progress.set(done))
    });
    let mesh = mesh?.mesh;
    let (triangles, vertices, rejected) = (mesh.triangles.len(), mesh.vertices.len(), mesh.n_rejected);
    let (scene, build_seconds) = timed(|| {
        let progress = Progress::new("building the grid");
        Scene::build(mesh, &args.scene.options(), &|done| progress.set(done))
    });
    if let Some(shortage) = scene.grid().shortage() {
        tracing::warn!("{name}: {shortage}");
    }

    let camera = camera.unwrap_or_else(|| {
        let bounds = scene.mesh().bounds();
        let [min, max] = [bounds.min, bounds.max].map(|corner| Vec3::from_array(corner).as_dvec3());
        Camera::view_all(min, max, args.up, CANVAS_ASPECT)
    });
    let request = FrameRequest {
        camera,
        size: args.size,
        view: args.view,
        rays: args.rays,
        samples: SampleRange::CENTRE,
        look: args.look.look(),
    };
    if args.cameras.is_some() {
        return cameras::run(&scene, &request, &options, std::io::stdin().lock(), std::io::stdout().lock());
    }

    let (mut frame_ms, mut frame_cpu_ms, mut shade_cpu_ms) = (Vec::new(), Vec::new(), Vec::new());
    let mut frame = Frame::default();
    let mut cost = frame::Cost::default();
    for _ in 0..args.frames {
        cost = frame.trace(&scene, &request, &options);
        frame_ms.push(milliseconds(cost.wall));
        frame_cpu_ms.push(milliseconds(cost.cpu));
        shade_cpu_ms.push(milliseconds(frame.shade(&scene, &request)));
    }

    // Counting follows each ray alone, so it is done only for those who see the figures.
    let cost_sum = if args.json { frame::cost_sum(&scene, &request) } else { frame::CostSum::default() };
    let per_ray = |sum: u64| sum as f64 / f64::from(args.size.n_samples());
    let report = Report {
        triangles,
        vertices,
        rejected,
        load_seconds,
        build_seconds,
        mesh_bytes: scene.mesh().n_bytes(),
        structure_bytes: scene.grid().n_bytes(),
        grid: scene.grid().figures(),
        choice: args.explain.then(|| scene.grid().choice().clone()),
        peak_rss_bytes: peak_rss_bytes(),
        hits: frame.n_hits(),
        shadow_rays: cost.n_shadow_rays,
        shadowed: cost.n_shadowed,
        mrays_per_second: (args.size.n_samples() as usize + cost.n_shadow_rays) as f64 / median(&frame_ms) / 1e3,
        frame_ms,
        frame_cpu_ms,
        shade_cpu_ms,
        cell_traversals: cost_sum.n_cells,
        triangle_tests: cost_sum.n_tests,
        cell_traversals_per_ray: per_ray(cost_sum.n_cells),
        triangle_tests_per_ray: per_ray(cost_sum.n_tests),
    };
    if let Some(path) = &args.image {
        image::write_png(path, args.size, &frame.rgb).with_context(|| cannot_write(path))?;
    }
    if let Some(path) = &args.hits {
        image::write_whole(path, |out| frame.write_hits(&scene, out)).with_context(|| cannot_write(path))?;
    }
    if args.json {
        say(serde_json::to_string(&report)?)?;
    } else {
        say(table(&report, args.size))?;
    }
    Ok(())
}

/// The wall's canvas is 16:9 whatever the number of samples on it.
const CANVAS_ASPECT: f64 = 16.0 / 9.0;

/// Reads and checks a camera file.
pub fn read_camera(path: &Path) -> Result<Camera> {
    let mut text = String::new();
    // A limit, for a device or a model named by mistake would be read for ever.
    std::fs::File::open(path)
        .and_then(|file| file.take(1 << 20).read_to_string(&mut text))
        .with_context(|| format!("cannot read the camera {}", path.display()))?;
    Camera::from_toml(&text).with_context(|| format!("{} is no camera", path.display()))
}

fn cannot_write(path: &Path) -> String {
    format!("cannot write {}", path.display())
}

fn timed<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = work();
    (result, start.elapsed().as_secs_f64())
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// The most memory that this process ever had, as Linux tells it.
fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

fn table(report: &Report, size: FrameSize) -> String {
    let megabytes = |bytes: usize| bytes as f64 / 1e6;
    [
        format!("triangles   {} ({} rejected), {} vertices", report.triangles, report.rejected, report.vertices),
        format!("load        {:.2} s", report.load_seconds),
        format!("build       {:.2} s", report.build_seconds),
        format!(
            "memory      mesh {:.1} MB, grid {:.1} MB",
            megabytes(report.mesh_bytes),
            megabytes(report.structure_bytes)
        ),
        format!("frame       {size} samples, {} hits", report.hits),
        format!(
            "median      {:.2} ms, {:.2} ms of CPU; shading {:.2} ms of CPU",
            median(&report.frame_ms),
            median(&report.frame_cpu_ms),
            median(&report.shade_cpu_ms)
        ),
        format!("speed       {:.2} million rays a second", report.mrays_per_second),
    ]
    .into_iter()
    .chain(report.choice.as_ref().map(Choice::explanation))
    .collect::<Vec<_>>()
    .join("\n")
}
