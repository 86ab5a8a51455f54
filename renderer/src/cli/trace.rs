//! `renderer trace`: renders one picture without a network.

use std::{
    io::Read,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context, Result};
use clap::Args;
use glam::Vec3;
use rayon::ThreadPool;
use serde::Serialize;
use shared::{
    camera::{Camera, UpAxis},
    division::FrameSize,
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
};

use crate::{
    cli::{appearance_args::AppearanceArgs, progress::Progress, say, scene_args::SceneArgs},
    grid::{Choice, GridStats},
    model::{
        scene::{self, LoadedMesh, SceneSource},
        statue,
    },
    render::{
        frame::{Cost, Frame},
        image,
        scene::Scene,
        threads,
    },
};

/// The frame to trace and the files to write.
#[derive(Args, Debug)]
pub struct TraceArgs {
    /// A PLY file [default: the built-in statue]
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,

    /// Approximate number of triangles of the built-in statue
    #[arg(long, value_name = "N", default_value_t = statue::DEFAULT_TRIANGLES, conflicts_with = "model",
        value_parser = clap::value_parser!(u32).range(100..=100_000_000))]
    triangles: u32,

    /// A camera file with eye, ll, u and v [default: a view of the whole model]
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,

    /// The model's axis that points up when no camera is given: x, y or z
    #[arg(long, value_name = "AXIS", default_value = "y")]
    up: UpAxis,

    /// Size of the frame in samples
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value_t = FrameSize::PAPER, allow_hyphen_values = true)]
    size: FrameSize,

    /// Number of threads that build and trace [default: one for each core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,

    /// Trace the frame this many times, to measure
    #[arg(long, value_name = "K", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    frames: u32,

    /// What the picture shows: shaded, normals, or cost (cells visited in red, triangles tested in green)
    #[arg(long, value_name = "VIEW", default_value = "shaded")]
    view: ShadingMode,

    /// The rays that light the picture: primary, shadows, or ambient (shadows and ambient occlusion)
    #[arg(long, value_name = "RAYS", default_value_t = LightingMode::default())]
    rays: LightingMode,

    /// Write the picture as PNG
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,

    /// Write the hits: for each sample, bottom row first, little endian, the triangle's number in the file as u32
    /// (0xffffffff for a miss) and t as f32 in units of the ray's direction (infinite for a miss)
    #[arg(long, value_name = "FILE")]
    hits: Option<PathBuf>,

    /// Also print how the grid was chosen, and the predicted cost of other ways to store the scene
    #[arg(long)]
    explain: bool,

    /// Print the measurements as one JSON object
    #[arg(long)]
    pub json: bool,

    /// Appearance of the picture
    #[command(flatten)]
    appearance: AppearanceArgs,

    /// Options of the grid
    #[command(flatten)]
    scene: SceneArgs,
}

/// Measurements. Times of frames are in milliseconds, one entry per frame.
#[derive(Debug, Serialize)]
pub struct Report {
    triangles: usize,
    vertices: usize,
    rejected: usize,
    load_seconds: f64,
    build_seconds: f64,
    mesh_bytes: usize,
    structure_bytes: usize,
    grid: GridStats,
    /// How the grid was chosen, with `--explain`.
    #[serde(skip_serializing_if = "Option::is_none")]
    choice: Option<Choice>,
    hits: usize,
    /// Rays of a frame over the median of `frame_ms`.
    pub mrays_per_second: f64,
    /// Wall time of tracing.
    pub frame_ms: Vec<f64>,
    /// CPU time of all threads for making rays, tracing them and storing the hits.
    frame_cpu_ms: Vec<f64>,
    /// CPU time of all threads for shading the hits.
    shade_cpu_ms: Vec<f64>,
}

/// Loads, builds and traces, and writes the files that were asked for.
pub fn run(args: &TraceArgs) -> Result<()> {
    args.pool()?.install(|| {
        let prepared = args.prepare()?;
        let report = args.trace(&prepared, |frame| frame.trace(&prepared.scene, &prepared.spec))?;
        if args.json { say(serde_json::to_string(&report)?) } else { say(report.table(prepared.spec.size)) }
    })
}

/// A scene that is ready to be traced, and the frame that is asked for.
pub struct Prepared {
    /// The scene.
    pub scene: Scene,
    /// The frame.
    pub spec: FrameSpec,
    triangles: usize,
    vertices: usize,
    rejected: usize,
    load_seconds: f64,
    build_seconds: f64,
}

impl TraceArgs {
    /// The pool of threads that build and trace.
    ///
    /// # Errors
    /// The system cannot start more threads.
    pub fn pool(&self) -> Result<ThreadPool> {
        threads::pool(self.threads.map(usize::from))
    }

    /// Loads the model and builds the grid.
    ///
    /// # Errors
    /// The camera or the model cannot be read.
    pub fn prepare(&self) -> Result<Prepared> {
        // The camera is checked before a large model is read.
        let camera = self.camera.as_deref().map(read_camera).transpose()?;
        let (source, name) = match &self.model {
            Some(path) => (SceneSource::Ply(path.clone()), path.display().to_string()),
            None => (SceneSource::Statue { triangles: self.triangles }, "the statue".to_owned()),
        };
        let (loaded, load_seconds) = timed(|| {
            let progress = Progress::new(format!("loading {name}"));
            scene::load(&source, &|done| progress.set(done))
        });
        let LoadedMesh { id, mesh } = loaded?;
        let (triangles, vertices, rejected) = (mesh.triangles.len(), mesh.vertices.len(), mesh.n_rejected);
        let (scene, build_seconds) = timed(|| {
            let progress = Progress::new("building the grid");
            Scene::build(mesh, &self.scene.options(), &|done| progress.set(done))
        });
        if let Some(shortage) = scene.grid().shortage() {
            tracing::warn!("{name}: {shortage}");
        }
        let camera = camera.unwrap_or_else(|| {
            let bounds = scene.mesh().bounds();
            let [min, max] = [bounds.min, bounds.max].map(|corner| Vec3::from_array(corner).as_dvec3());
            Camera::view_all(min, max, self.up, CANVAS_ASPECT)
        });
        let spec = FrameSpec {
            scene: id,
            camera,
            size: self.size,
            view: self.view,
            rays: self.rays,
            samples: SampleRange::CENTRE,
            appearance: self.appearance.appearance(),
        };
        Ok(Prepared { scene, spec, triangles, vertices, rejected, load_seconds, build_seconds })
    }

    /// Traces and shades the frame `--frames` times, and writes picture and hits.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn trace(&self, prepared: &Prepared, mut trace: impl FnMut(&mut Frame) -> Cost) -> Result<Report> {
        let Prepared { scene, spec, triangles, vertices, rejected, load_seconds, build_seconds } = prepared;
        let (mut frame_ms, mut frame_cpu_ms, mut shade_cpu_ms) = (Vec::new(), Vec::new(), Vec::new());
        let mut frame = Frame::default();
        for _ in 0..self.frames {
            let cost = trace(&mut frame);
            frame_ms.push(milliseconds(cost.wall));
            frame_cpu_ms.push(milliseconds(cost.cpu));
            shade_cpu_ms.push(milliseconds(frame.shade(scene, spec)));
        }
        if let Some(path) = &self.image {
            image::write_png(path, spec.size, &frame.rgb).with_context(|| cannot_write(path))?;
        }
        if let Some(path) = &self.hits {
            image::write_atomically(path, |out| frame.write_hits(scene, out)).with_context(|| cannot_write(path))?;
        }
        Ok(Report {
            triangles: *triangles,
            vertices: *vertices,
            rejected: *rejected,
            load_seconds: *load_seconds,
            build_seconds: *build_seconds,
            mesh_bytes: scene.mesh().n_bytes(),
            structure_bytes: scene.grid().n_bytes(),
            grid: scene.grid().figures(),
            choice: self.explain.then(|| scene.grid().choice().clone()),
            hits: frame.n_hits(),
            mrays_per_second: f64::from(spec.size.n_samples()) / median(&frame_ms) / 1e3,
            frame_ms,
            frame_cpu_ms,
            shade_cpu_ms,
        })
    }
}

/// Aspect of the wall's canvas, whatever the frame's size in samples.
const CANVAS_ASPECT: f64 = 16.0 / 9.0;

/// Reads and checks a camera file.
pub fn read_camera(path: &Path) -> Result<Camera> {
    let mut text = String::new();
    // The limit stops at a device or a large model named by mistake.
    std::fs::File::open(path)
        .and_then(|file| file.take(1 << 20).read_to_string(&mut text))
        .with_context(|| format!("cannot read the camera {}", path.display()))?;
    Camera::from_toml(&text).with_context(|| format!("{} is not a camera file", path.display()))
}

fn cannot_write(path: &Path) -> String {
    format!("cannot write {}", path.display())
}

fn timed<T>(task: impl FnOnce() -> T) -> (T, f64) {
    let start = Instant::now();
    let result = task();
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

impl Report {
    /// The measurements as a table of text, for a frame of `size`.
    pub fn table(&self, size: FrameSize) -> String {
        let megabytes = |bytes: usize| bytes as f64 / 1e6;
        [
            format!("triangles   {} ({} rejected), {} vertices", self.triangles, self.rejected, self.vertices),
            format!("load        {:.2} s", self.load_seconds),
            format!("build       {:.2} s", self.build_seconds),
            format!(
                "memory      mesh {:.1} MB, grid {:.1} MB",
                megabytes(self.mesh_bytes),
                megabytes(self.structure_bytes)
            ),
            format!("frame       {size} samples, {} hits", self.hits),
            format!(
                "median      {:.2} ms, {:.2} ms of CPU; shading {:.2} ms of CPU",
                median(&self.frame_ms),
                median(&self.frame_cpu_ms),
                median(&self.shade_cpu_ms)
            ),
            format!("speed       {:.2} million rays a second", self.mrays_per_second),
        ]
        .into_iter()
        .chain(self.choice.as_ref().map(Choice::explanation))
        .collect::<Vec<_>>()
        .join("\n")
    }
}
