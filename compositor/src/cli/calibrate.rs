//! Aligns a wall with a camera: patterns on the wall, photographs from a folder, corners or meshes into the wall file, and
//! with `--light` what evens out the projectors' light.

mod photos;

use std::{
    fs,
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::mpsc,
};

use anyhow::{Context, bail};
use glam::DVec2;
use image::metadata::Orientation;
use renderer::cli::{
    check_writable, say,
    stop::{self, Stopped},
};
use shared::printable::{counted, printable_line};

use self::photos::{Photo, Watch};
use crate::{
    calibration::{Codebook, Placement, Plan, Reading, Verdict, judge, judge_light},
    control::alignment::save,
    gpu::RgbImage,
    wall::Wall,
    window::WindowLoop,
};

/// Aligns a wall with a camera: shows patterns, reads photographs of them, and writes corners or meshes, and light
///
/// Without --photos and --patterns, the patterns are shown on the wall's outputs: Space shows the next one, Escape ends.
/// With --watch, each photograph of a pattern shows the next one by itself. The order of photographs does not matter.
#[derive(Clone, Debug, clap::Args)]
pub struct CalibrateArgs {
    /// The wall file: it gets what was found, unless a projector was not found or does not fit
    pub file: PathBuf,
    /// Read all photographs in this folder (JPEG, PNG, TIFF), and show nothing
    #[arg(long, value_name = "FOLDER", conflicts_with_all = ["watch", "patterns"])]
    pub photos: Option<PathBuf>,
    /// Read photographs as a camera puts them into this folder, while the patterns are shown
    #[arg(long, value_name = "FOLDER", conflicts_with = "patterns")]
    pub watch: Option<PathBuf>,
    /// Write the patterns of each output into this folder as PNG, to show them by other means
    #[arg(long, value_name = "FOLDER")]
    pub patterns: Option<PathBuf>,
    /// Measure light, too: as many patterns again, from which gamma, black levels, gains and fall-off are written
    #[arg(long)]
    pub light: bool,
    /// Where the canvas lies on the wall: where the file's corners have it, as large as is lit, or at its four corners in the
    /// file [default: keep if corners were moved before or nothing overlaps, else largest]
    #[arg(long, value_name = "PLACE", conflicts_with = "marks")]
    pub place: Option<Place>,
    /// The canvas's corners are at these pixels of a photograph: upper left, upper right, lower right, lower left
    #[arg(long, value_name = "PHOTO=X,Y,X,Y,X,Y,X,Y", value_parser = marks)]
    pub marks: Option<Marks>,
    /// Write what was found of all projectors, whatever speaks against it
    #[arg(long)]
    pub force: bool,
}

/// Where the canvas lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Place {
    /// Where the corners in the file have it, on average: also for screens with bezels
    Keep,
    /// As large as possible with every part of it lit
    Largest,
    /// At its four corners in the file: drag these by hand, and the others follow
    Corners,
}

/// The corners of the canvas in a photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Marks {
    photo: String,
    at: [DVec2; 4],
}

fn marks(text: &str) -> Result<Marks, String> {
    let fault =
        || "expected the photograph's name and eight numbers: IMG_1.JPG=120,80,3900,95,3880,2310,130,2290".to_owned();
    let (photo, numbers) = text.rsplit_once('=').ok_or_else(fault)?;
    let numbers: Vec<f64> = numbers.split(',').map(str::parse).collect::<Result<_, _>>().map_err(|_| fault())?;
    let [a, b, c, d, e, f, g, h] = numbers[..] else { return Err(fault()) };
    let at = [[a, b], [c, d], [e, f], [g, h]].map(DVec2::from);
    if at.iter().all(|at| at.is_finite()) { Ok(Marks { photo: photo.to_owned(), at }) } else { Err(fault()) }
}

/// Shows, reads, solves and writes.
pub fn run(args: &CalibrateArgs) -> anyhow::Result<()> {
    let wall = Wall::load(&args.file)?;
    let plan = Plan::of_wall(&wall).map_err(|problem| anyhow::anyhow!("{}: {problem}", args.file.display()))?;
    if let Some(folder) = &args.patterns {
        return write_patterns(args, &wall, &plan, folder);
    }
    check_writable(&args.file)?;
    let photos = match (&args.photos, &args.watch) {
        (Some(folder), _) => {
            let codebook = Codebook::new(&plan);
            let mut photos = Vec::new();
            for path in photos::in_folder(folder)? {
                let photo = Photo::read(&path, &codebook).map_err(|fault| tracing::warn!("{fault}"));
                photos.extend(photo.inspect(|photo| tracing::info!("{}", photo.reading.line(&wall))));
            }
            photos
        }
        (None, Some(folder)) => watch(args, &wall, &plan, folder)?,
        (None, None) => return show(args, &wall, &plan),
    };
    if photos.is_empty() {
        bail!("no photograph was read, so {} stays as it was", args.file.display());
    }
    let verdict = verdict(args, &wall, &plan, &photos)?;
    finish(args, &verdict)
}

/// The number of patterns to show.
fn n_patterns(args: &CalibrateArgs, plan: &Plan) -> u32 {
    if args.light { plan.n_with_light() } else { plan.n_patterns() }
}

fn write_patterns(args: &CalibrateArgs, wall: &Wall, plan: &Plan, folder: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let monitors = wall.monitors();
    for (index, part) in wall.output_parts().into_iter().enumerate() {
        // Names of monitors are letters and digits; anything else could leave the folder.
        let is_plain = |letter: char| letter.is_ascii_alphanumeric() || letter == '-';
        let output = monitors.get(index).map(|(name, _)| name.replace(|letter| !is_plain(letter), "_"));
        for pattern in 0..n_patterns(args, plan) {
            let name = match &output {
                Some(output) => format!("{output}-pattern-{}.png", pattern + 1),
                None => format!("pattern-{}.png", pattern + 1),
            };
            let rgb = plan.draw(pattern, wall, part).into_flattened();
            RgbImage { size: [part.width, part.height], rgb }.write_png(&folder.join(name))?;
        }
    }
    say(format_args!(
        "wrote {} for each output into {}; when you have photographed them: compositor calibrate FILE{} --photos FOLDER",
        counted(n_patterns(args, plan), "pattern"),
        folder.display(),
        if args.light { " --light" } else { "" }
    ))
}

/// Shows the patterns, for a camera whose photographs come later.
fn show(args: &CalibrateArgs, wall: &Wall, plan: &Plan) -> anyhow::Result<()> {
    let window = WindowLoop::new()?;
    stop_with(&window);
    let n_patterns = n_patterns(args, plan);
    tracing::info!("{}: Space shows the next, Escape ends", counted(n_patterns, "pattern"));
    window.show_patterns(wall, (plan, n_patterns), Box::new(ControlFlow::Continue))?;
    say(format_args!(
        "put the photographs into a folder, then: compositor calibrate {}{} --photos FOLDER",
        args.file.display(),
        if args.light { " --light" } else { "" }
    ))
}

/// Shows the patterns while photographs come in; ends when all projectors were found and fit, or a person ends it.
fn watch(args: &CalibrateArgs, wall: &Wall, plan: &Plan, folder: &Path) -> anyhow::Result<Vec<Photo>> {
    let window = WindowLoop::new()?;
    stop_with(&window);
    let (waker, (sender, news)) = (window.waker(), mpsc::channel());
    let report = move |photo| {
        // The window may have closed.
        let _ = sender.send(photo);
        waker.wake();
    };
    let watch = Watch::start(folder, plan.clone(), report)?;
    let n_patterns = n_patterns(args, plan);
    tracing::info!("watching {}: take {} from each place", folder.display(), counted(n_patterns, "photograph"));
    let mut photos: Vec<Photo> = Vec::new();
    let on_news = |pattern: u32| {
        let mut next = pattern;
        for photo in news.try_iter() {
            match photo {
                Ok(photo) => {
                    tracing::info!("{}", photo.reading.line(wall));
                    let is_last = next + 1 == n_patterns;
                    let is_shown = photo.reading.patterns().contains(&next);
                    photos.push(photo);
                    if !is_shown {
                        continue;
                    }
                    next = (next + 1) % n_patterns;
                    if !is_last {
                        continue;
                    }
                    match verdict(args, wall, plan, &photos) {
                        Ok(verdict) if verdict.faults.is_empty() => return ControlFlow::Break(()),
                        Ok(verdict) => verdict.faults.iter().for_each(|fault| tracing::warn!("{fault}")),
                        Err(error) => tracing::warn!("{error:#}"),
                    }
                }
                Err(fault) => tracing::warn!("{fault}"),
            }
        }
        ControlFlow::Continue(next)
    };
    window.show_patterns(wall, (plan, n_patterns), Box::new(on_news))?;
    drop(watch);
    match Stopped::by_signal(format!("stopped before anything was written: {} stays as it was", args.file.display())) {
        Some(stopped) => Err(stopped.into()),
        None => Ok(photos),
    }
}

fn stop_with(window: &WindowLoop) {
    let waker = window.waker();
    stop::on_signal(move |_| waker.close());
}

fn verdict(args: &CalibrateArgs, wall: &Wall, plan: &Plan, photos: &[Photo]) -> anyhow::Result<Verdict> {
    let placement = match (&args.marks, args.place) {
        (Some(Marks { photo, at }), _) => {
            let shot = photos.iter().position(|it| it.reading.name == *photo);
            let shot = shot.with_context(|| format!("--marks {photo}: no photograph of this name was read"))?;
            let Photo { reading, orientation } = &photos[shot];
            Some(Placement::Marks { shot, at: at.map(|at| stored(at, reading.shot.size, *orientation)) })
        }
        (None, Some(Place::Keep)) => Some(Placement::Keep),
        (None, Some(Place::Largest)) => Some(Placement::Largest),
        (None, Some(Place::Corners)) => Some(Placement::Corners),
        (None, None) => None,
    };
    let readings: Vec<_> = photos.iter().map(|photo| photo.reading.clone()).collect();
    let shows_places = readings.iter().any(|reading| !reading.shot.sightings.is_empty());
    let shows_light = readings.iter().any(|reading| !reading.light.samples.is_empty());
    let verdict = match (args.light && shows_light && !shows_places, &args.marks) {
        (true, None) => {
            let found = vec!["no photograph shows patterns of places, so corners stay as the file has them".to_owned()];
            Verdict { wall: None, found, faults: Vec::new(), projectors: Vec::new() }
        }
        _ => judge(wall, plan, &readings, placement.as_ref()),
    };
    Ok(if args.light { with_light(wall, verdict, &readings) } else { verdict })
}

/// The verdict with light, which is measured where the corners that were found have projectors' pixels.
fn with_light(wall: &Wall, verdict: Verdict, readings: &[Reading]) -> Verdict {
    let Verdict { wall: aligned, mut found, mut faults, projectors } = verdict;
    let light = judge_light(aligned.as_ref().unwrap_or(wall), readings);
    found.extend(light.found);
    faults.extend(light.faults);
    Verdict { wall: light.wall.or(aligned), found, faults, projectors }
}

/// A pixel of a photograph as it is stored, from that of the photograph as viewers show it.
fn stored(at: DVec2, [width, height]: [usize; 2], orientation: Orientation) -> DVec2 {
    let [width, height] = [width as f64, height as f64];
    match orientation {
        Orientation::Rotate90 => DVec2::new(at.y, height - at.x),
        Orientation::Rotate180 => DVec2::new(width - at.x, height - at.y),
        Orientation::Rotate270 => DVec2::new(width - at.y, at.x),
        // Cameras mirror no photographs.
        _ => at,
    }
}

/// Says what was found, and writes it if nothing speaks against that.
fn finish(args: &CalibrateArgs, Verdict { wall, found, faults, .. }: &Verdict) -> anyhow::Result<()> {
    for line in found {
        say(printable_line(line))?;
    }
    for fault in faults {
        say(format_args!("fault: {}", printable_line(fault)))?;
    }
    let file = args.file.display();
    let Some(wall) = wall else { bail!("nothing was found, so {file} stays as it was: see the faults above") };
    if !faults.is_empty() && !args.force {
        bail!(
            "{} above, so {file} stays as it was: mend what they name, or write what was found with --force",
            counted(faults.len(), "fault")
        );
    }
    let old = save::keep_old(&args.file)?;
    save::save_projectors(&args.file, &save::save_meshes(&args.file, wall)?)?;
    let what = match (wall.surface().is_some(), args.light) {
        (true, false) => "meshes",
        (false, false) => "corners",
        (true, true) => "meshes and light",
        (false, true) => "corners and light",
    };
    say(format_args!(
        "wrote the {what} into {file}; the old file is {}; N on the wall shows the alignment grid",
        old.display()
    ))
}
