//! `lab chart`: charts of speed against accuracy, memory, sharpness and light, measured on any model.

pub(crate) mod candidates;
mod kernel;
mod light;
mod measure;
mod memory;
pub(crate) mod methods;
mod peers;
mod picture;
pub(crate) mod reference;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::{Args, ValueEnum};
use renderer::{
    cli::{
        picture_args::{ModelArgs, read_camera},
        progress::Progress,
        say,
    },
    grid::MemoryBudget,
    intersect::InstructionSet,
    model::mesh::Mesh,
    render::scene::Scene,
};
use serde::Serialize;
use serde_json::json;
use shared::{
    camera::{Camera, CanvasPart},
    division::FrameSize,
};

use self::peers::Peer;
pub(crate) use self::picture::{FIRST_REFERENCE_SAMPLE, psnr};
use crate::{files, plot::Figure};

/// The charts, and the folder of their files.
#[derive(Args, Debug)]
pub struct ChartArgs {
    #[command(flatten)]
    model: ModelArgs,

    /// A camera file with eye, ll, u and v; may be repeated [default: a camera that sees the whole model]
    #[arg(long, value_name = "FILE")]
    camera: Vec<PathBuf>,

    /// The folder for charts, as SVG and PNG, and results, as CSV and JSON; created if missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Charts, separated by commas: kernel (speed against depth errors and wrong pixels), memory (speed against bytes and
    /// build time), image (time against sharpness), light (time against the error of light)
    #[arg(long, value_name = "CHARTS", value_enum, value_delimiter = ',', default_value = "kernel,memory,image,light")]
    charts: Vec<Chart>,

    /// Samples across and down of the charts but image [default: 1024x512, of light 256x144; with --quick 256x128]
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    size: Option<FrameSize>,

    /// Memory for building a scene; settings that do not fit are left out
    #[arg(long, value_name = "SIZE", default_value_t = MemoryBudget::default())]
    memory_budget: MemoryBudget,

    /// A CSV file of other ray tracers to add to the charts; columns: name, cpu_ns_per_ray, depth_error_p999,
    /// wrong_per_million, bytes_per_triangle, build_seconds, cpu_ms, flip, psnr, light_rmse, samples; all but name may be missing
    #[arg(long, value_name = "FILE")]
    points: Option<PathBuf>,

    /// Fewer rays, settings and repetitions: two or three minutes for a million triangles, with more noise
    #[arg(long)]
    quick: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, strum::Display)]
#[strum(serialize_all = "lowercase")]
enum Chart {
    Kernel,
    Memory,
    Image,
    Light,
}

/// Measures, and writes the results so far after each step.
pub(crate) fn run(args: &ChartArgs) -> Result<()> {
    // Wrong arguments are found before a large model is read.
    let cameras = args.camera.iter().map(|path| Ok((name_of(path), read_camera(path)?))).collect::<Result<Vec<_>>>()?;
    let peers = args.points.as_deref().map(peers::read).transpose()?.unwrap_or_default();
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make the folder {}", args.out.display()))?;
    let name = args.model.path().map_or_else(|| args.model.source().to_string(), name_of);
    let mut mesh = args.model.load()?.mesh;
    // Rivals and reference know no origin: all compare in the coordinates of the mesh.
    let origin = std::mem::take(&mut mesh.origin);
    let cameras = if cameras.is_empty() {
        vec![("whole model".to_owned(), view_all(&mesh, 16.0 / 9.0))]
    } else {
        cameras.into_iter().map(|(name, camera)| (name, camera.relative_to(origin))).collect()
    };
    let mut session = Session {
        args,
        name,
        n_triangles: mesh.triangles.len(),
        mesh,
        cameras,
        peers,
        kernel: kernel::Results::default(),
        image: Vec::new(),
        light: Vec::new(),
        memory: Vec::new(),
        left_out: Vec::new(),
    };
    for &chart in &args.charts {
        match chart {
            Chart::Kernel => session.chart_kernel()?,
            Chart::Memory => session.chart_memory()?,
            Chart::Image => session.chart_image()?,
            Chart::Light => session.chart_light()?,
        }
        if session.is_charted(chart) {
            say(format_args!("wrote {}", args.out.join(format!("{chart}.svg")).display()))?;
        }
    }
    let is_any = args.charts.iter().any(|&chart| session.is_charted(chart));
    ensure!(is_any, "nothing was measured: {}", session.left_out.join("; "));
    Ok(())
}

fn name_of(path: &Path) -> String {
    path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

pub(crate) fn view_all(mesh: &Mesh, aspect: f64) -> Camera {
    let shape = mesh.shape();
    Camera::view_all(&shape, shape.up, aspect, CanvasPart::WHOLE)
}

struct Session<'a> {
    args: &'a ChartArgs,
    name: String,
    mesh: Mesh,
    n_triangles: usize,
    cameras: Vec<(String, Camera)>,
    peers: Vec<Peer>,
    kernel: kernel::Results,
    image: Vec<picture::PictureRow>,
    light: Vec<light::LightRow>,
    memory: Vec<memory::MemoryRow>,
    /// Measurements that are impossible, with reasons.
    left_out: Vec<String>,
}

impl Session<'_> {
    fn chart_kernel(&mut self) -> Result<()> {
        let quick = self.args.quick;
        let settings = kernel::Settings {
            size: self.size()?,
            n_repeats: if quick { 15 } else { 9 },
            decades: if quick { vec![0, 2, 4, 6] } else { (0..=6).collect() },
        };
        for (name, camera) in self.cameras.clone() {
            for placement in settings.placements() {
                let progress = Progress::new(format!("measuring {name}, {placement}"));
                let measured =
                    self.kernel.measure(&self.mesh, (&name, &camera), placement, &settings, &|done| progress.set(done));
                drop(progress);
                if let Err(reason) = measured {
                    self.leave_out(format!("{name}, {placement}: {reason}"));
                }
                if !self.kernel.rows.is_empty() {
                    let title = format!("Intersection methods: speed and accuracy on {}", self.name);
                    let reading = "Left is faster, down is more accurate; the dashed line is the Pareto front. \
                        Depth: the dot is the error at 99.9 % of hits, the bar spans from the median to the maximum.";
                    let figure = self.kernel.figure(title, self.notes(settings.size, reading), &self.peers);
                    self.write(Chart::Kernel, &self.kernel.rows, &figure)?;
                }
            }
        }
        if self.kernel.rows.is_empty() { Ok(()) } else { say(self.kernel.table()?) }
    }

    fn chart_memory(&mut self) -> Result<()> {
        let quick = self.args.quick;
        let settings = memory::Settings {
            size: self.size()?,
            n_repeats: if quick { 21 } else { 7 },
            densities: if quick { vec![4.0, 32.0, 128.0] } else { (0..8).map(|n| f64::from(1 << n)).collect() },
            uniform_densities: if quick { vec![4.0, 32.0] } else { vec![1.0, 4.0, 32.0] },
            memory_budget: self.args.memory_budget,
        };
        let progress = Progress::new("measuring scene structures");
        let cameras = self.cameras.iter().map(|(_, camera)| *camera).collect();
        let mesh = std::mem::take(&mut self.mesh);
        let baseline = memory::Baseline::new(&mesh, cameras, &settings);
        let chosen = baseline.chosen_density();
        let variants = if baseline.is_empty() { Vec::new() } else { settings.variants(chosen) };
        if variants.is_empty() {
            self.leave_out("scene structures: no triangle of the model can be hit".to_owned());
        }
        for (index, variant) in variants.iter().enumerate() {
            progress.set(index as f32 / variants.len() as f32);
            match baseline.measure(variant, &settings)? {
                Ok(row) => self.memory.push(row),
                Err(reason) => self.leave_out(format!("{}: {reason}", variant.name())),
            }
            if !self.memory.is_empty() {
                let title = format!("Scene structures: speed, memory and build time on {}", self.name);
                let reading = "Left is smaller or sooner built, down is faster; the dashed line is the Pareto front. \
                    All hits are the same, bit for bit, but for those of fewer bits.";
                let figure = memory::figure(title, self.notes(settings.size, reading), &self.memory, &self.peers);
                self.write(Chart::Memory, &self.memory, &figure)?;
            }
        }
        drop(progress);
        drop(baseline);
        self.mesh = mesh;
        if self.memory.is_empty() {
            return Ok(());
        }
        say(files::table(&self.memory)?)?;
        memory::verdict(&self.memory, chosen).map_or(Ok(()), say)
    }

    fn chart_image(&mut self) -> Result<()> {
        let quick = self.args.quick;
        let sizes = [(512, 256), (1024, 512), (2048, 1152), (4096, 2304)];
        let sizes = sizes[..if quick { 3 } else { 4 }]
            .iter()
            .map(|&(xres, yres)| FrameSize::new(xres, yres))
            .collect::<Result<Vec<_>, _>>()?;
        let native = sizes[sizes.len() - 1];
        let n_reference_samples = if quick { 16 } else { 64 };
        let samples = if quick { vec![1, 4, 16] } else { vec![1, 2, 4, 8, 16] };
        let settings = picture::Settings { native, n_reference_samples, sizes, samples };
        let scene = self.build_scene();
        let reading = format!(
            "Left is faster, down is closer to a picture of {native} pixels with {n_reference_samples} samples each; \
             the dashed line is the Pareto front."
        );
        for (name, camera) in self.cameras.clone() {
            let progress = Progress::new(format!("comparing pictures of {name}"));
            picture::measure(&scene, (&name, &camera), &settings, |row, done| {
                progress.set(done);
                let Some(row) = row else { return Ok(()) };
                self.image.push(row);
                let title = format!("Resolution and samples: time and sharpness on {}", self.name);
                let figure = picture::figure(title, self.notes(native, &reading), &self.image, &self.peers);
                self.write(Chart::Image, &self.image, &figure)
            })?;
        }
        say(files::table(&self.image)?)
    }

    fn chart_light(&mut self) -> Result<()> {
        let settings = light::Settings::new(self.args.size, self.args.quick)?;
        let reading = format!(
            "Left is faster, down is closer to a picture of {} paths a pixel; the dashed line is the Pareto front.",
            settings.n_reference_paths
        );
        let scene = self.build_scene();
        for (name, camera) in self.cameras.clone() {
            let progress = Progress::new(format!("lighting {name}"));
            light::measure(&scene, (&name, &camera), &settings, |row, done| {
                progress.set(done);
                let Some(row) = row else { return Ok(()) };
                self.light.push(row);
                let title = format!("Light: time and error on {}", self.name);
                let figure = light::figure(title, self.notes(settings.size, &reading), &self.light, &self.peers);
                self.write(Chart::Light, &self.light, &figure)
            })?;
        }
        say(files::table(&self.light)?)
    }

    fn build_scene(&self) -> Scene {
        let progress = Progress::new("building the grid");
        let options = renderer::grid::GridOptions { memory_budget: self.args.memory_budget, ..Default::default() };
        Scene::build(self.mesh.clone(), &options, &|done| progress.set(done))
    }

    fn is_charted(&self, chart: Chart) -> bool {
        match chart {
            Chart::Kernel => !self.kernel.rows.is_empty(),
            Chart::Memory => !self.memory.is_empty(),
            Chart::Image => !self.image.is_empty(),
            Chart::Light => !self.light.is_empty(),
        }
    }

    fn size(&self) -> Result<FrameSize> {
        let quick = if self.args.quick { Some(FrameSize::new(256, 128)?) } else { None };
        Ok(self.args.size.or(quick).unwrap_or(FrameSize::PAPER))
    }

    fn leave_out(&mut self, line: String) {
        tracing::warn!("left out {line}");
        self.left_out.push(line);
    }

    fn notes(&self, size: FrameSize, reading: &str) -> Vec<String> {
        let (n_triangles, instructions) = (self.n_triangles, InstructionSet::best());
        let n_cameras = self.cameras.len();
        let views = if n_cameras == 1 { "1 view".to_owned() } else { format!("{n_cameras} views") };
        vec![format!("{n_triangles} triangles, {size}, {views}, {instructions:?}"), reading.to_owned()]
    }

    fn write(&self, chart: Chart, rows: &[impl Serialize], figure: &Figure) -> Result<()> {
        let folder = &self.args.out;
        let json = json!({
            "model": self.name, "instructions": format!("{:?}", InstructionSet::best()), "kernel": self.kernel.rows,
            "memory": self.memory, "image": self.image, "light": self.light, "points": self.peers, "left_out": self.left_out,
        });
        files::write(folder, &format!("{chart}.csv"), files::csv(rows)?.as_bytes())?;
        files::write(folder, "chart.json", serde_json::to_string_pretty(&json)?.as_bytes())?;
        figure.write(folder, &chart.to_string())
    }
}
