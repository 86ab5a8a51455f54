//! `lab trace`: measures frames of one render server without a network.

pub mod cameras;
mod counts;
pub mod frame;
pub mod secondary;
mod shadows;

use std::{path::PathBuf, time::Instant};

use anyhow::{Context, Result, ensure};
use channel::files;
use clap::Args;
use glam::DVec3;
use renderer::{
    cli::{picture_args::PictureArgs, say},
    grid::GridStats,
    model::scene::LoadedMesh,
    render::image,
};
use serde::Serialize;
use shared::division::FrameSize;

use self::{
    frame::{Cost, Frame, FrameOptions, Kernel},
    secondary::KindReport,
};
use crate::statistics::{median, milliseconds};

/// The frame to trace, the measurements, and the files to write.
#[derive(Args, Debug)]
pub struct TraceArgs {
    #[command(flatten)]
    picture: PictureArgs,

    /// Trace the frame this many times, to measure
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = renderer::cli::between(1_u32..=1_000_000))]
    frames: u32,

    /// Write the picture as PNG
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,

    /// Write the hits: for each sample, bottom row first, little endian, the triangle's number in the file as u32
    /// (0xffffffff for a miss, 0xfffffffe for a cap) and t as f32 in units of the ray's direction (infinite for a miss)
    #[arg(long, value_name = "FILE")]
    hits: Option<PathBuf>,

    /// Print the measurements as one JSON object
    #[arg(long)]
    json: bool,

    /// Read paths of camera files from standard input ("-", the only value), one a line; trace a frame for each and
    /// answer with a line of JSON; the first unreadable camera ends the program
    #[arg(long, value_name = "-", conflicts_with_all = ["camera", "frames", "image", "hits"])]
    cameras: Option<String>,

    /// Trace the rays of tiles in packets, or one by one
    #[arg(long, value_name = "KERNEL", value_enum, default_value_t)]
    kernel: Kernel,

    /// Also trace a shadow ray for each hit
    #[arg(long, conflicts_with = "clip")]
    shadow_rays: bool,

    /// Also trace rays that share no origin, from the hits: ambient occlusion, two bounces, and shadows of a sun
    #[arg(long, conflicts_with_all = ["clip", "cameras"])]
    secondary_rays: bool,

    /// Position of the light of the shadow rays, in world space
    #[arg(long, value_name = "X,Y,Z", default_value = "3,5,4", value_parser = point)]
    light: DVec3,
}

fn point(text: &str) -> Result<DVec3, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z]) if x.is_finite() && y.is_finite() && z.is_finite() => Ok(DVec3::new(x, y, z)),
        _ => Err("a point is three finite numbers, as in 3,5,4".to_owned()),
    }
}

/// Measurements. Times of frames are in milliseconds, one entry per frame.
#[derive(Serialize)]
struct Report {
    triangles: usize,
    vertices: usize,
    rejected: usize,
    load_seconds: f64,
    build_seconds: f64,
    mesh_bytes: usize,
    structure_bytes: usize,
    grid: GridStats,
    hits: usize,
    /// Rays of a frame over the median of `frame_ms`.
    mrays_per_second: f64,
    frame_ms: Vec<f64>,
    /// CPU time of all threads for making rays, tracing them and storing the hits.
    frame_cpu_ms: Vec<f64>,
    /// CPU time of all threads for shading the hits.
    shade_cpu_ms: Vec<f64>,
    /// `None` where the system does not report it.
    peak_rss_bytes: Option<u64>,
    shadow_rays: usize,
    /// Hits that the light does not reach.
    shadowed: usize,
    /// Cells passed and triangles tested by the primary rays of a frame, traced one by one: sums, and means per ray.
    cell_traversals: u64,
    triangle_tests: u64,
    cell_traversals_per_ray: f64,
    triangle_tests_per_ray: f64,
    /// By kind; empty unless asked for.
    secondary_rays: Vec<KindReport>,
}

/// Loads, builds and traces, and writes files and results.
pub fn run(args: &TraceArgs) -> Result<()> {
    args.picture.pool()?.install(|| run_in_pool(args))
}

fn run_in_pool(args: &TraceArgs) -> Result<()> {
    if let Some(source) = &args.cameras {
        ensure!(source == "-", "--cameras {source}: cameras are only read from standard input, written as -");
    }
    let options = FrameOptions { kernel: args.kernel, light: args.shadow_rays.then_some(args.light) };
    // The camera is checked before a large model is read.
    let camera = args.picture.read_camera()?;
    let (loaded, load_seconds) = timed(|| args.picture.model.load());
    let LoadedMesh { id, mesh, .. } = loaded?;
    let (triangles, vertices, rejected) = (mesh.triangles.len(), mesh.vertices.len(), mesh.n_rejected);
    let spec = args.picture.spec(id, camera.unwrap_or_else(|| args.picture.view_all(&mesh.shape())));
    let (scene, build_seconds) = timed(|| args.picture.build(mesh));
    if args.cameras.is_some() {
        return cameras::run(&scene, &spec, &options, std::io::stdin().lock(), std::io::stdout().lock());
    }

    let (mut frame_ms, mut frame_cpu_ms, mut shade_cpu_ms) = (Vec::new(), Vec::new(), Vec::new());
    let mut frame = Frame::new(spec.size);
    let mut cost = Cost::default();
    for _ in 0..args.frames {
        cost = frame.trace(&scene, &spec, &options);
        frame_ms.push(milliseconds(cost.wall));
        frame_cpu_ms.push(milliseconds(cost.cpu));
        shade_cpu_ms.push(milliseconds(frame.shade(&scene, &spec)));
    }
    if let Some(path) = &args.image {
        image::write_png(path, spec.size, &frame.rgb()).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(path) = &args.hits {
        files::write(path, |out| frame.write_hits(&scene, out))
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    let secondary_rays = if args.secondary_rays { secondary::measure(&scene, &spec, args.frames) } else { Vec::new() };
    // Counting traces rays one by one, so the table does without it.
    let [cell_traversals, triangle_tests] = if args.json { counts::cost_sum(&scene, &spec) } else { [0, 0] };
    let n_samples = f64::from(spec.size.n_samples());
    let report = Report {
        triangles,
        vertices,
        rejected,
        load_seconds,
        build_seconds,
        mesh_bytes: scene.mesh().n_bytes(),
        structure_bytes: scene.grid.n_bytes(),
        grid: scene.grid.figures(),
        hits: frame.n_hits(),
        mrays_per_second: (n_samples + cost.n_shadow_rays as f64) / median(frame_ms.iter().copied()) / 1e3,
        frame_ms,
        frame_cpu_ms,
        shade_cpu_ms,
        peak_rss_bytes: peak_rss_bytes(),
        shadow_rays: cost.n_shadow_rays,
        shadowed: cost.n_shadowed,
        cell_traversals,
        triangle_tests,
        cell_traversals_per_ray: cell_traversals as f64 / n_samples,
        triangle_tests_per_ray: triangle_tests as f64 / n_samples,
        secondary_rays,
    };
    if args.json { say(serde_json::to_string(&report)?) } else { say(report.table(spec.size)) }
}

fn timed<T>(task: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = task();
    (result, start.elapsed().as_secs_f64())
}

/// The peak memory of this process, where Linux reports it.
fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

impl Report {
    /// The measurements as a table of text, for a frame of `size`.
    fn table(&self, size: FrameSize) -> String {
        let megabytes = |bytes: usize| bytes as f64 / 1e6;
        let median = |values: &[f64]| median(values.iter().copied());
        let table = format!(
            "triangles   {} ({} rejected), {} vertices\n\
             load        {:.2} s\n\
             build       {:.2} s\n\
             memory      mesh {:.1} MB, grid {:.1} MB\n\
             frame       {size} samples, {} hits\n\
             median      {:.2} ms, {:.2} ms of CPU; shading {:.2} ms of CPU\n\
             speed       {:.2} million rays a second",
            self.triangles,
            self.rejected,
            self.vertices,
            self.load_seconds,
            self.build_seconds,
            megabytes(self.mesh_bytes),
            megabytes(self.structure_bytes),
            self.hits,
            median(&self.frame_ms),
            median(&self.frame_cpu_ms),
            median(&self.shade_cpu_ms),
            self.mrays_per_second,
        );
        [table].into_iter().chain(self.secondary_rays.iter().map(KindReport::line)).collect::<Vec<_>>().join("\n")
    }
}
