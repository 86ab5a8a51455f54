//! `lab detail`: what a level of detail could save. A model that is finer than the picture's samples is traced as it is, and as a
//! mesh of [clusters](renderer::model::clusters) as large as a sample, which is the most that a coarser stand-in can save: time, the bytes that a frame
//! reads ([`touched`]), and the error of the picture.

mod touched;

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result};
use clap::Args;
use rayon::ThreadPool;
use renderer::{
    cli::{progress::Progress, say},
    grid::{GridOptions, MemoryBudget},
    model::{
        clusters::clustered,
        mesh::Mesh,
        scene::{self, LoadedMesh, SceneSource},
    },
    render::{scene::Scene, threads},
    scene_file::{
        file,
        store::{StoredScene, build_file},
    },
};
use serde::Serialize;
use shared::{
    camera::Camera,
    division::FrameSize,
    printable::counted,
    protocol::{FrameSpec, SampleRange},
    scene::{SceneId, Treatment},
};

use self::touched::touched_bytes;
use crate::{
    chart::{FIRST_REFERENCE_SAMPLE, psnr},
    farm::frame_spec,
    files,
    large::{MappedScenes, views},
    plot::{Axis, COLORS, Figure, GREY, Mark, Plot, Point, Series, plain},
    statistics::{median, milliseconds},
};

/// Samples a pixel: in motion, and at rest.
const SAMPLES: [u32; 2] = [1, 16];

/// A stand-in with more than this part of a model's triangles saves nothing, and is not measured.
const MOST_KEPT: f64 = 0.9;

/// Samples a pixel of the picture that others are compared with.
const N_REFERENCE_SAMPLES: u32 = SampleRange::LARGEST_COUNT;

/// A stand-in pays if it saves a third at less than this, in decibels.
const MOST_LOST: f64 = 0.5;

/// The models and stand-ins, and the folder of the results.
#[derive(Args, Debug)]
pub struct DetailArgs {
    /// The models; a scene file of the same name with the ending .raywall is used if it is there, as `lab large --keep` leaves it
    #[arg(value_name = "MODEL", required = true)]
    models: Vec<PathBuf>,

    /// Sizes of clusters, as parts of a sample in the middle of the picture
    #[arg(long, value_name = "PART,…", value_delimiter = ',', default_value = "0.25,0.5,1,2")]
    cells: Vec<f64>,

    /// Samples of a frame
    #[arg(long, value_name = "WxH", default_value_t = FrameSize::PAPER)]
    size: FrameSize,

    /// Memory for building each scene
    #[arg(long, value_name = "SIZE", default_value = "8G")]
    memory_budget: MemoryBudget,

    /// The folder for the results; created if missing
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// One view of a model, or of a stand-in, with so many samples a pixel.
#[derive(Clone, Debug, Serialize)]
struct Row {
    model: String,
    view: &'static str,
    /// The size of clusters as a part of a sample; 0 is the model itself.
    cell: f64,
    triangles: usize,
    samples: u32,
    /// Of one thread, for tracing and shading.
    cpu_ms: f64,
    /// Of the scene file's pages that the frame reads; `None` where the system does not tell.
    touched_mb: Option<f64>,
    /// Against a picture of the model of many samples.
    psnr: f64,
    /// The three against those of the model itself.
    time_part: f64,
    touched_part: Option<f64>,
    lost_db: f64,
}

/// Measures all models, and writes `detail.csv`, `detail.svg` and `detail.png`.
///
/// # Errors
/// A model cannot be read, or a file cannot be written.
pub(crate) fn run(args: &DetailArgs) -> Result<()> {
    fs::create_dir_all(&args.out).with_context(|| format!("{}: cannot be made", args.out.display()))?;
    let lab = Lab {
        args,
        out: std::path::absolute(&args.out)?,
        all: threads::pool(None)?,
        one: threads::pool(Some(1))?,
        scenes: MappedScenes::in_folder(&args.out)?,
    };
    let mut rows = Vec::new();
    for model in &args.models {
        lab.measure(model, &mut rows)?;
        files::write(&args.out, "detail.csv", files::csv(&rows)?.as_bytes())?;
        figure(&rows).write(&args.out, "detail")?;
        say(files::table(&rows)?)?;
    }
    rows.iter().filter_map(verdict).try_for_each(say)
}

struct Lab<'a> {
    args: &'a DetailArgs,
    /// Absolute.
    out: PathBuf,
    all: ThreadPool,
    one: ThreadPool,
    scenes: MappedScenes,
}

/// A scene file, which is removed with this value if it was made here.
struct Version {
    cell: f64,
    path: PathBuf,
    is_ours: bool,
}

impl Drop for Version {
    fn drop(&mut self) {
        if self.is_ours {
            let _ = fs::remove_file(&self.path);
        }
    }
}

impl Lab<'_> {
    fn measure(&self, model: &Path, rows: &mut Vec<Row>) -> Result<()> {
        let name = model.file_stem().unwrap_or(model.as_os_str()).to_string_lossy().into_owned();
        let (source, options) = (SceneSource::File(model.to_owned()), self.options());
        let whole = self.whole(model, &source)?;
        let size = self.args.size;
        let StoredScene { info, scene, .. } = self.load(&whole.path)?;
        let cameras = views(&scene, &info.shape, size);
        let cells_of = cameras.map(|camera| (camera, sample_size(&scene, &camera, size)));
        drop(scene);
        for (view, (camera, sample)) in ["whole", "close"].into_iter().zip(cells_of) {
            let mut versions = vec![];
            {
                let progress = Progress::new(format!("coarsening {name}"));
                let load = || scene::load(&source, Treatment::default(), &|done| progress.set(0.2 * done));
                let LoadedMesh { mesh, .. } = self.all.install(|| load().map(LoadedMesh::treated))?;
                for &cell in &self.args.cells {
                    let coarse = clustered(&mesh, cell * sample);
                    if coarse.triangles.len() as f64 > MOST_KEPT * mesh.triangles.len() as f64 {
                        say(format_args!("{name}, {view}: clusters of {cell} samples leave nearly all triangles"))?;
                        continue;
                    }
                    let path = self.out.join(format!("{name}-{view}-{cell}.raywall"));
                    self.all.install(|| write_scene(coarse, &options, &path))?;
                    versions.push(Version { cell, path, is_ours: true });
                }
            }
            let versions: Vec<_> = std::iter::once(&whole).chain(&versions).collect();
            let spec = frame_spec(info.id, camera, size);
            for samples in SAMPLES {
                let measured =
                    self.measure_view(&FrameSpec { samples: SampleRange::all(0, samples), ..spec }, &versions)?;
                let Some(first) = measured.first().copied() else { continue };
                rows.extend(measured.iter().zip(&versions).map(|(measured, version)| Row {
                    model: name.clone(),
                    view,
                    cell: version.cell,
                    triangles: measured.triangles,
                    samples,
                    cpu_ms: measured.cpu_ms,
                    touched_mb: measured.touched.map(|bytes| bytes as f64 / 1e6),
                    psnr: measured.psnr,
                    time_part: measured.cpu_ms / first.cpu_ms,
                    touched_part: measured.touched.zip(first.touched).map(|(part, all)| part as f64 / all as f64),
                    lost_db: first.psnr - measured.psnr,
                }));
            }
        }
        Ok(())
    }

    /// All versions of a view; the first is the model itself.
    fn measure_view(&self, spec: &FrameSpec, versions: &[&Version]) -> Result<Vec<Measured>> {
        let progress = Progress::new("measuring");
        let render = |stored: &StoredScene| self.all.install(|| stored.scene.render_frame(spec).0);
        let touched = |version: &&Version| {
            touched_bytes(&version.path, || self.load(&version.path), |stored| drop(render(stored)))
        };
        let touched = versions.iter().map(touched).collect::<Result<Vec<_>>>()?;
        progress.set(0.5);
        let stored = versions.iter().map(|version| self.load(&version.path)).collect::<Result<Vec<_>>>()?;
        let samples = SampleRange::all(FIRST_REFERENCE_SAMPLE, N_REFERENCE_SAMPLES);
        let (reference, _) = self.all.install(|| stored[0].scene.render_frame(&FrameSpec { samples, ..*spec }));
        progress.set(0.8);
        let mut times_ms = vec![Vec::new(); versions.len()];
        // The first of each reads the file.
        let n_rounds = if spec.samples.count == 1 { 8 } else { 4 };
        for round in 0..n_rounds {
            for (stored, times_ms) in stored.iter().zip(&mut times_ms) {
                let (_, cpu) = self.one.install(|| stored.scene.render_frame(spec));
                times_ms.extend((round > 0).then(|| milliseconds(cpu)));
            }
        }
        let measured = stored.iter().zip(touched).zip(times_ms).map(|((stored, touched), times_ms)| Measured {
            triangles: stored.scene.n_triangles(),
            cpu_ms: median(times_ms),
            touched,
            psnr: psnr(&reference, &render(stored)),
        });
        Ok(measured.collect())
    }

    fn options(&self) -> GridOptions {
        GridOptions { memory_budget: self.args.memory_budget, ..GridOptions::default() }
    }

    /// The scene file of a model.
    fn whole(&self, model: &Path, source: &SceneSource) -> Result<Version> {
        let beside = std::path::absolute(model.with_extension("raywall"))?;
        if beside.is_file() {
            return Ok(Version { cell: 0.0, path: beside, is_ours: false });
        }
        let path = self.out.join("model.raywall");
        let progress = Progress::new(format!("building {source}"));
        let build = || build_file(source, Treatment::default(), &self.options(), &path, &|_, done| progress.set(done));
        self.all.install(build)?;
        Ok(Version { cell: 0.0, path, is_ours: true })
    }

    /// Maps a scene file; a new one is checked and sealed first.
    fn load(&self, path: &Path) -> Result<StoredScene> {
        self.all.install(|| {
            self.scenes.load(path)?.finish();
            self.scenes.load(path)
        })
    }
}

#[derive(Clone, Copy)]
struct Measured {
    triangles: usize,
    cpu_ms: f64,
    touched: Option<u64>,
    psnr: f64,
}

/// The side of the square that a sample covers at the surface in the middle of a view, in world space.
fn sample_size(scene: &Scene, camera: &Camera, size: FrameSize) -> f64 {
    let to_plane = camera.eye().distance(camera.target());
    let to_surface = scene.probe(camera, [0.5, 0.5], None).map_or(to_plane, |hit| camera.eye().distance(hit.point));
    camera.u().length() / f64::from(size.xres()) * to_surface / to_plane
}

fn write_scene(mesh: Mesh, options: &GridOptions, path: &Path) -> Result<()> {
    let id = SceneId::Mesh { blake3: Default::default(), treatment: Treatment::default() };
    let loaded = LoadedMesh { id, mesh, left_out: Vec::new(), sources: None };
    let info = loaded.info(false);
    let mut scene = Scene::build(loaded.mesh, options, &|_| ());
    let bytes = file::to_bytes(&mut scene, &info)?;
    drop(scene);
    let write = channel::files::write(path, |out| out.write_all(&bytes));
    write.with_context(|| format!("cannot write {}", path.display()))
}

/// Whether a stand-in pays.
fn verdict(row: &Row) -> Option<String> {
    let saves = row.time_part.min(row.touched_part.unwrap_or(1.0)) <= 2.0 / 3.0;
    (row.cell > 0.0 && saves && row.lost_db < MOST_LOST).then(|| {
        format!(
            "{}, {}, {} a pixel: clusters of {} samples pay: {:.2} of the time, {:.2} of the bytes, {:.2} dB lost",
            row.model,
            row.view,
            counted(row.samples, "sample"),
            row.cell,
            row.time_part,
            row.touched_part.unwrap_or(f64::NAN),
            row.lost_db
        )
    })
}

fn figure(rows: &[Row]) -> Figure {
    let plots = |samples: u32| {
        let time = plot(rows, samples, "part of the CPU time", |row| Some(row.time_part));
        let bytes = plot(rows, samples, "part of the bytes that a frame reads", |row| row.touched_part);
        (420, vec![time, bytes])
    };
    Figure {
        title: "Level of detail: what a coarser stand-in saves, and what it costs".to_owned(),
        notes: vec![
            format!(
                "Labels: the size of clusters, in samples. Left saves more, down loses less: dB of PSNR against a picture of \
                 {N_REFERENCE_SAMPLES} samples a pixel."
            ),
            "A stand-in pays left of and below the dashed lines: a third saved, at less than half a decibel."
                .to_owned(),
        ],
        rows: SAMPLES.map(plots).into(),
    }
}

fn plot(rows: &[Row], samples: u32, title: &'static str, part: impl Fn(&Row) -> Option<f64>) -> Plot {
    let of_samples = || rows.iter().filter(|row| row.samples == samples);
    let mut views: Vec<_> = of_samples().map(|row| (&row.model, row.view)).collect();
    views.dedup();
    let series = views.iter().enumerate().map(|(number, &(model, view))| {
        let of_view = of_samples().filter(|row| (&row.model, row.view) == (model, view));
        let point = |row: &Row| {
            let label = if row.cell > 0.0 { row.cell.to_string() } else { String::new() };
            Some(Point { label, ..Point::new(part(row)?, row.lost_db) })
        };
        let color = COLORS[number % COLORS.len()];
        let points = of_view.filter_map(point).collect();
        Series { name: format!("{model}, {view}"), color, mark: Mark::Disc, is_joined: true, points }
    });
    let bound = |points: [(f64, f64); 2]| Series::line("the rule".to_owned(), GREY, Mark::Nothing, points);
    let highest = of_samples().map(|row| row.lost_db).fold(1.0, f64::max) + 0.2;
    let lowest = of_samples().map(|row| row.lost_db).fold(-0.2, f64::min) - 0.2;
    let bounds =
        [bound([(2.0 / 3.0, lowest), (2.0 / 3.0, MOST_LOST)]), bound([(0.0, MOST_LOST), (2.0 / 3.0, MOST_LOST)])];
    Plot {
        title: format!("{} a pixel", counted(samples, "sample")),
        x: Axis { title, label: plain, range: Some(0.0..1.2) },
        y: Axis { title: "dB lost", label: plain, range: Some(lowest..highest) },
        series: series.chain(bounds).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stand_in_pays_if_it_saves_a_third_of_either_at_half_a_decibel() {
        let row = |time_part, touched_part, lost_db| Row {
            model: "statue".to_owned(),
            view: "whole",
            cell: 1.0,
            triangles: 1,
            samples: 1,
            cpu_ms: 1.0,
            touched_mb: None,
            psnr: 30.0,
            time_part,
            touched_part,
            lost_db,
        };
        for (row, pays) in [
            (row(0.6, Some(0.9), 0.4), true),
            (row(0.9, Some(0.6), -0.1), true),
            (row(0.9, Some(0.9), 0.0), false),
            (row(0.1, Some(0.1), 0.5), false),
            (row(0.9, None, 0.0), false),
            (Row { cell: 0.0, ..row(0.1, None, 0.0) }, false),
        ] {
            assert_eq!(verdict(&row).is_some(), pays, "{row:?}");
        }
    }
}
