//! `renderer chart`: speed against accuracy of the ways to intersect rays with triangles, measured on any model.

pub(crate) mod candidates;
mod draw;
mod measure;
pub(crate) mod methods;
pub(crate) mod reference;
mod table;

use std::{
    io::Write,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, ensure};
use clap::Args;
use glam::Vec3;
use serde_json::json;
use shared::{
    camera::{Camera, UpAxis},
    division::FrameSize,
};

use crate::{
    cli::say,
    grid::InstructionSet,
    image,
    mesh::Mesh,
    progress::Progress,
    scene::{self, SceneSource},
    statue,
    trace::read_camera,
};
use candidates::{Candidates, Placed, Placement};
use draw::Panel;
use measure::Measurement;
use methods::Method;
use table::Row;

/// What to measure, and where to write it.
#[derive(Args, Debug)]
pub struct ChartArgs {
    /// A PLY file; without it the built-in statue is measured
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,

    /// Triangles of the built-in statue
    #[arg(long, value_name = "N", default_value_t = statue::DEFAULT_TRIANGLES, conflicts_with = "model",
        value_parser = clap::value_parser!(u32).range(100..=100_000_000))]
    triangles: u32,

    /// A camera file with eye, ll, u and v; may be given several times; without it the whole model is seen
    #[arg(long, value_name = "FILE")]
    camera: Vec<PathBuf>,

    /// The folder for chart.svg, chart.csv and chart.json; it is made if it is not there
    #[arg(long, value_name = "DIR")]
    out: PathBuf,

    /// Samples across and down [default: 1024x512; with --quick 256x128]
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    size: Option<FrameSize>,

    /// Fewer rays and repetitions: a minute at most, with more noise
    #[arg(long)]
    quick: bool,
}

/// How often each method takes its turn; the median counts.
const N_REPEATS: usize = 9;
const N_REPEATS_QUICK: usize = 3;

/// Measures, and writes what it has after each view.
pub fn run(args: &ChartArgs) -> Result<()> {
    let cameras = args.camera.iter().map(|path| Ok((name_of(path), read_camera(path)?))).collect::<Result<Vec<_>>>()?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make the folder {}", args.out.display()))?;
    let (source, name) = match &args.model {
        Some(path) => (SceneSource::Ply(path.clone()), name_of(path)),
        None => (SceneSource::Statue { triangles: args.triangles }, "the built-in statue".to_owned()),
    };
    let mesh = {
        let progress = Progress::new(format!("loading {name}"));
        scene::load(&source, &|done| progress.set(done))?.mesh
    };
    let cameras = if cameras.is_empty() { vec![("whole model".to_owned(), view_all(&mesh))] } else { cameras };
    let quick_size = if args.quick { FrameSize::new(256, 128).ok() } else { None };
    let size = args.size.or(quick_size).unwrap_or(FrameSize::PAPER);
    let n_repeats = if args.quick { N_REPEATS_QUICK } else { N_REPEATS };

    let mut results = Results {
        name,
        mesh,
        size,
        rows: Vec::new(),
        pooled: Default::default(),
        n_pairs: 0,
        n_rays: 0,
        skipped: Vec::new(),
    };
    for (camera_name, camera) in &cameras {
        for placement in Placement::ALL {
            results.measure(camera_name, camera, placement, n_repeats)?;
            results.write(&args.out)?;
        }
    }
    ensure!(!results.rows.is_empty(), "nothing was measured: {}", results.skipped.join("; "));
    say(results.table())?;
    say(format_args!("wrote {}", args.out.join("chart.svg").display()))
}

fn name_of(path: &Path) -> String {
    path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn view_all(mesh: &Mesh) -> Camera {
    let bounds = mesh.bounds();
    let [min, max] = [bounds.min, bounds.max].map(|corner| Vec3::from_array(corner).as_dvec3());
    Camera::view_all(min, max, UpAxis::Y, 16.0 / 9.0)
}

/// What was measured so far.
struct Results {
    name: String,
    mesh: Mesh,
    size: FrameSize,
    rows: Vec<Row>,
    /// Over all cameras, by placement and method.
    pooled: [Option<Vec<Measurement>>; Placement::ALL.len()],
    /// All pairs of ray and candidate, and all rays that have candidates.
    n_pairs: usize,
    n_rays: usize,
    /// What could not be measured, and why.
    skipped: Vec<String>,
}

impl Results {
    /// Measures one view; one that nothing can be measured on is noted.
    fn measure(&mut self, camera_name: &str, camera: &Camera, placement: Placement, n_repeats: usize) -> Result<()> {
        let progress = Progress::new(format!("measuring {camera_name}, {}", placement.name()));
        let measured = Placed::new(&self.mesh, camera, placement).and_then(|placed| {
            let candidates = Candidates::find(&self.mesh, &placed, self.size)?;
            let measured = measure::measure(&self.mesh, &placed, &candidates, n_repeats, &|done| progress.set(done));
            let sees_something = measured.iter().any(|measurement| measurement.n_hits() > 0);
            if sees_something {
                Ok((measured, candidates.n_pairs(), candidates.n_rays()))
            } else {
                Err("the camera sees nothing of the model".to_owned())
            }
        });
        drop(progress);
        let measured = match measured {
            Ok((measured, n_pairs, n_rays)) => {
                self.n_pairs += n_pairs;
                self.n_rays += n_rays;
                measured
            }
            Err(reason) => {
                let line = format!("{camera_name}, {}: {reason}", placement.name());
                tracing::warn!("left out {line}");
                self.skipped.push(line);
                return Ok(());
            }
        };
        for (&method, measurement) in Method::ALL.iter().zip(&measured) {
            self.rows.push(Row::new(camera_name, placement, method, measurement));
        }
        match &mut self.pooled[placement as usize] {
            Some(pooled) => pooled.iter_mut().zip(&measured).for_each(|(sum, measurement)| sum.add(measurement)),
            none => *none = Some(measured),
        }
        Ok(())
    }

    fn panels(&self) -> Vec<Panel> {
        let pooled = Placement::ALL.into_iter().zip(&self.pooled);
        pooled
            .filter_map(|(placement, measured)| {
                let of_methods = Method::ALL.into_iter().zip(measured.as_ref()?);
                let rows = of_methods.map(|(method, measurement)| Row::new("all", placement, method, measurement));
                Some(Panel { placement, rows: rows.collect() })
            })
            .collect()
    }

    /// Replaces the files by what is known now.
    fn write(&self, folder: &Path) -> Result<()> {
        let panels = self.panels();
        let subtitle = format!(
            "{} triangles, {} samples a view, {} candidates a ray on average, {:?}",
            self.mesh.triangles.len(),
            self.size,
            self.n_pairs.checked_div(self.n_rays).unwrap_or(0),
            InstructionSet::best()
        );
        let reading = "Further left is faster, further down more accurate; dashed is the Pareto front. \
            Depth: 99.9 % of hits are within ●, the bar goes from the median to the worst.";
        let title = format!("Rays against triangles: speed and accuracy on {}", self.name);
        let json = json!({
            "model": self.name, "triangles": self.mesh.triangles.len(), "size": self.size.to_string(),
            "instructions": format!("{:?}", InstructionSet::best()), "rows": self.rows, "left_out": self.skipped,
        });
        let svg = if panels.is_empty() { None } else { Some(draw::svg(&title, [&subtitle, reading], &panels)?) };
        let files = [
            ("chart.csv", Some(table::to_csv(&self.rows))),
            ("chart.json", Some(serde_json::to_string_pretty(&json)?)),
            ("chart.svg", svg),
        ];
        for (name, content) in files {
            let path = folder.join(name);
            let Some(content) = content else { continue };
            image::write_whole(&path, |out: &mut dyn Write| out.write_all(content.as_bytes()))
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }

    /// For people: all methods at all placements.
    fn table(&self) -> String {
        let mut lines = vec![format!(
            "{:12} {:20} {:>9} {:>10} {:>10} {:>10} {:>8} {:>9} {:>9}",
            "placement", "method", "ns/ray", "p50", "p99.9", "max", "wrong", "compared", "undecided"
        )];
        for row in self.panels().iter().flat_map(|panel| &panel.rows) {
            lines.push(format!(
                "{:12} {:20} {:9.1} {:10.1e} {:10.1e} {:10.1e} {:8} {:9} {:9}",
                row.placement.name(),
                row.method.label(),
                row.cpu_ns_per_ray,
                row.depth_error_p50,
                row.depth_error_p999,
                row.depth_error_max,
                row.wrong_pixels,
                row.compared,
                row.undecided
            ));
        }
        lines.join("\n")
    }
}
