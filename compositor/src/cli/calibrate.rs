//! Aligns a wall with a camera: patterns on the wall, photographs from a folder, corners or meshes into the wall file, and
//! with `--light` what evens out the projectors' light.

mod photos;
mod session;

use std::{
    fs,
    io::{self, IsTerminal},
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::mpsc,
    thread,
};

use anyhow::{Context, bail};
use clap::builder::{PathBufValueParser, TypedValueParser};
use glam::DVec2;
use image::metadata::Orientation;
use renderer::cli::{
    check_writable,
    picture_args::with_ending,
    say,
    stop::{self, Stopped},
};
use shared::printable::{counted, printable_line};

use self::{
    photos::{Photo, Watch},
    session::{Rules, Session},
};
use crate::{
    calibration::{Codebook, Placement, Plan, Reading, Verdict, check_again, judge, judge_again, judge_light},
    control::alignment::{findings::CanvasPicture, save},
    gpu::RgbImage,
    wall::Wall,
    window::{Page, Waker, WindowLoop, Wish},
};

/// The wall file, and where photographs of its patterns come from.
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
    /// After a bump: find the projectors that have moved since the file was written, from one photograph or a few of the whole
    /// wall, and leave the others as they are
    #[arg(long, conflicts_with_all = ["light", "place", "marks"])]
    pub again: bool,
    /// With --photos: show what was found on the wall's outputs, where Enter writes it and Escape does not
    #[arg(long, requires = "photos")]
    pub show: bool,
    /// Write what was found without asking, once nothing speaks against it
    #[arg(long, conflicts_with = "show")]
    pub yes: bool,
    /// Draw what was found of each projector into this file
    #[arg(long, value_name = "FILE.png",
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "png")))]
    pub report: Option<PathBuf>,
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

/// Shows, reads, solves, asks and writes.
pub fn run(args: &CalibrateArgs) -> anyhow::Result<()> {
    let wall = Wall::load(&args.file)?;
    let fault_of = |problem: String| anyhow::anyhow!("{}: {problem}", args.file.display());
    let plan = Plan::of_wall(&wall).map_err(fault_of)?;
    if args.again {
        check_again(&wall).map_err(fault_of)?;
    }
    if let Some(folder) = &args.patterns {
        return write_patterns(args, &wall, &plan, folder);
    }
    check_writable(&args.file)?;
    check_report(args)?;
    let Some(folder) = &args.photos else {
        return match &args.watch {
            Some(folder) => watch(args, &wall, &plan, folder),
            None => show(args, &wall, &plan),
        };
    };
    let codebook = Codebook::new(&plan);
    let mut photos = Vec::new();
    for path in photos::in_folder(folder)? {
        let photo = Photo::read(&path, &codebook).map_err(|fault| tracing::warn!("{fault}"));
        photos.extend(photo.inspect(|photo| tracing::info!("{}", photo.reading.line(&wall))));
    }
    if photos.is_empty() {
        bail!("no photograph was read, so {} stays as it was", args.file.display());
    }
    let verdict = verdict(args, &wall, &plan, &photos)?;
    tell(args, &wall, &verdict)?;
    if args.show {
        return show_findings(args, &wall, &plan, photos, verdict);
    }
    check(args, &verdict)?;
    // Who runs this in a script reads nothing; a person at a terminal does.
    if !args.yes && io::stdin().is_terminal() && io::stdout().is_terminal() {
        say(format_args!("write this into {}? y or n, then Enter", args.file.display()))?;
        let mut answer = String::new();
        io::stdin().read_line(&mut answer)?;
        if is_yes(&answer) != Some(true) {
            return discarded(args);
        }
    }
    write(args, &verdict)
}

/// The drawing must not take the place of a file that goes in.
fn check_report(args: &CalibrateArgs) -> anyhow::Result<()> {
    let Some(report) = &args.report else { return Ok(()) };
    let folder_of =
        |path: &Path| fs::canonicalize(path.parent().filter(|it| *it != Path::new("")).unwrap_or(Path::new(".")));
    let folders: Vec<PathBuf> =
        args.photos.iter().chain(&args.watch).filter_map(|folder| fs::canonicalize(folder).ok()).collect();
    let is_among_photos = folder_of(report).is_ok_and(|folder| folders.contains(&folder));
    // A link to a photograph, or a photograph that is one.
    let files = folders.iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten().flatten().map(|it| it.path());
    let is_input = fs::canonicalize(report)
        .is_ok_and(|path| files.chain([args.file.clone()]).any(|it| fs::canonicalize(it).is_ok_and(|it| it == path)));
    if is_among_photos || is_input {
        bail!("--report {}: name a file that is not among the photographs, and not the wall file", report.display());
    }
    Ok(())
}

fn is_yes(answer: &str) -> Option<bool> {
    match answer.trim() {
        "y" | "Y" | "yes" => Some(true),
        "n" | "N" | "no" => Some(false),
        _ => None,
    }
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
            let path = folder.join(name);
            if image::image_dimensions(&path).is_ok_and(|size| size != (part.width, part.height)) {
                bail!("{} is there, and no pattern of this wall: name another folder", path.display());
            }
            let rgb = plan.draw(pattern, wall, part).into_flattened();
            RgbImage { size: [part.width, part.height], rgb }.write_png(&path)?;
        }
    }
    say(format_args!(
        "wrote {} for each output into {}; when you have photographed them: compositor calibrate FILE{} --photos FOLDER",
        counted(n_patterns(args, plan), "pattern"),
        folder.display(),
        if args.light { " --light" } else { "" }
    ))
}

const WITHOUT_WINDOW: &str =
    "write the patterns with --patterns, show them by other means, and read the photographs with --photos";

/// Shows the patterns, for a camera whose photographs come later.
fn show(args: &CalibrateArgs, wall: &Wall, plan: &Plan) -> anyhow::Result<()> {
    let window = WindowLoop::new(WITHOUT_WINDOW)?;
    stop_with(&window);
    let n_patterns = n_patterns(args, plan);
    tracing::info!("{}: Space shows the next, Escape ends", counted(n_patterns, "pattern"));
    let mut session = session(args, wall, plan);
    let on_wish = |wish| {
        let shown = session.on_wish(wish);
        log_page(&shown, n_patterns);
        shown
    };
    window.calibrate(wall, plan, Page::Pattern(0), Box::new(on_wish))?;
    say(format_args!(
        "put the photographs into a folder, then: compositor calibrate {}{}{} --photos FOLDER",
        args.file.display(),
        if args.light { " --light" } else { "" },
        if args.again { " --again" } else { "" }
    ))
}

/// Shows what photographs of a folder tell, and writes it if somebody accepts it.
fn show_findings(
    args: &CalibrateArgs,
    wall: &Wall,
    plan: &Plan,
    photos: Vec<Photo>,
    verdict: Verdict,
) -> anyhow::Result<()> {
    let window = WindowLoop::new("leave out --show")?;
    stop_with(&window);
    let mut session = session(args, wall, plan).with_verdict(photos, verdict);
    let answers = Answers::new(window.waker());
    answers.ask(session.asks(), args)?;
    let first = session.page();
    let on_wish = |wish| session.on_wish(answers.heard(wish));
    window.calibrate(wall, plan, first, Box::new(on_wish))?;
    finish(args, session)
}

/// Shows the patterns while photographs come in; then what was found, which is written if somebody accepts it.
fn watch(args: &CalibrateArgs, wall: &Wall, plan: &Plan, folder: &Path) -> anyhow::Result<()> {
    let window = WindowLoop::new(WITHOUT_WINDOW)?;
    stop_with(&window);
    let (waker, (sender, news)) = (window.waker(), mpsc::channel());
    let report = move |photo| {
        // The window may have closed.
        let _ = sender.send(photo);
        waker.wake();
    };
    let watch = Watch::start(folder, plan.clone(), report)?;
    let n_patterns = n_patterns(args, plan);
    tracing::info!(
        "watching {}: take {} from each place; Tab shows what was seen, Enter what was found",
        folder.display(),
        counted(n_patterns, "photograph")
    );
    let mut session = session(args, wall, plan);
    let answers = Answers::new(window.waker());
    let mut outcome = Ok(());
    let on_wish = |wish| {
        let mut page = None;
        let shown = match answers.heard(wish) {
            Wish::News => news.try_iter().try_for_each(|photo| match photo {
                Ok(photo) => {
                    tracing::info!("{}", photo.reading.line(wall));
                    page = session.on_photo(photo)?.or(page.take());
                    ControlFlow::Continue(())
                }
                Err(fault) => {
                    tracing::warn!("{fault}");
                    ControlFlow::Continue(())
                }
            }),
            wish => session.on_wish(wish).map_continue(|shown| page = shown),
        };
        session.log.drain(..).for_each(|line| tracing::warn!("{line}"));
        if let Some(verdict) = session.take_news() {
            outcome = tell(args, wall, verdict).and_then(|()| answers.ask(session.asks(), args));
        }
        let shown = shown.map_continue(|()| page);
        log_page(&shown, n_patterns);
        if outcome.is_err() { ControlFlow::Break(()) } else { shown }
    };
    window.calibrate(wall, plan, Page::Pattern(0), Box::new(on_wish))?;
    drop(watch);
    outcome?;
    finish(args, session)
}

fn session<'a>(args: &'a CalibrateArgs, wall: &'a Wall, plan: &'a Plan) -> Session<'a> {
    let rules = Rules {
        n_patterns: n_patterns(args, plan),
        watches: args.watch.is_some(),
        accepts: args.yes,
        forces: args.force,
        is_again: args.again,
    };
    Session::new(wall, plan, rules, Box::new(|photos| verdict(args, wall, plan, photos)))
}

fn log_page(shown: &ControlFlow<(), Option<Page>>, n_patterns: u32) {
    if let ControlFlow::Continue(Some(Page::Pattern(pattern))) = shown {
        tracing::info!("pattern {} of {n_patterns} is on the wall", pattern + 1);
    }
}

/// Writes what was found if somebody accepted it.
fn finish(args: &CalibrateArgs, session: Session<'_>) -> anyhow::Result<()> {
    let file = args.file.display();
    if let Some(stopped) = Stopped::by_signal(format!("stopped before anything was written: {file} stays as it was")) {
        return Err(stopped.into());
    }
    match session.into_verdict() {
        Some(verdict) => write(args, &verdict),
        None => discarded(args),
    }
}

fn discarded(args: &CalibrateArgs) -> anyhow::Result<()> {
    say(format_args!("nothing was written: {} stays as it was", args.file.display()))
}

/// Answers at the terminal, beside keys on the wall.
struct Answers {
    waker: Waker,
    heard: mpsc::Receiver<bool>,
    sender: mpsc::Sender<bool>,
    is_asked: std::cell::Cell<bool>,
}

impl Answers {
    fn new(waker: Waker) -> Self {
        let (sender, heard) = mpsc::channel();
        Self { waker, heard, sender, is_asked: false.into() }
    }

    /// Says how to answer, if there is something to accept; listens from the first time on.
    fn ask(&self, asks: bool, args: &CalibrateArgs) -> anyhow::Result<()> {
        if !asks || args.yes {
            return Ok(());
        }
        let listens = io::stdin().is_terminal() && is_in_foreground();
        let terminal = if listens { ", or y and n here" } else { "" };
        say(format_args!(
            "on the wall, Enter writes this into {}, and Escape does not{terminal}",
            args.file.display()
        ))?;
        if listens && !self.is_asked.replace(true) {
            let (sender, waker) = (self.sender.clone(), self.waker.clone());
            // It ends with the program, at the latest: nothing interrupts a terminal's line.
            thread::Builder::new().name("answers".to_owned()).spawn(move || {
                for answer in io::stdin().lines().map_while(Result::ok).filter_map(|line| is_yes(&line)) {
                    if sender.send(answer).is_err() {
                        break;
                    }
                    waker.wake();
                }
            })?;
        }
        Ok(())
    }

    /// The wish that was heard at the terminal in place of news, if any.
    fn heard(&self, wish: Wish) -> Wish {
        let answer = if wish == Wish::News { self.heard.try_recv().ok() } else { None };
        answer.map_or(wish, |is_yes| if is_yes { Wish::Accept } else { Wish::Discard })
    }
}

/// Whether the terminal's lines are this program's: to read them in the background would stop it.
fn is_in_foreground() -> bool {
    let Ok(stat) = fs::read_to_string("/proc/self/stat") else { return true };
    // The fields after the name in brackets: state, parent, group, session, terminal, the terminal's group.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    fields.get(2) == fields.get(5)
}

fn stop_with(window: &WindowLoop) {
    let waker = window.waker();
    stop::on_signal(move |_| waker.close());
}

fn verdict(args: &CalibrateArgs, wall: &Wall, plan: &Plan, photos: &[Photo]) -> anyhow::Result<Verdict> {
    if args.again {
        let readings: Vec<_> = photos.iter().map(|photo| photo.reading.clone()).collect();
        return Ok(judge_again(wall, plan, &readings));
    }
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

/// Says what was found, and draws it if asked to.
fn tell(args: &CalibrateArgs, wall: &Wall, verdict: &Verdict) -> anyhow::Result<()> {
    let Verdict { wall: new_wall, found, faults, projectors } = verdict;
    for line in found {
        say(printable_line(line))?;
    }
    for fault in faults {
        say(format_args!("fault: {}", printable_line(fault)))?;
    }
    if let Some(report) = &args.report {
        let picture = CanvasPicture::of_findings(new_wall.as_ref().unwrap_or(wall), projectors, faults);
        picture.image().write_png(report)?;
        say(format_args!("drawn in {}", report.display()))?;
    }
    Ok(())
}

/// Whether there is something to write, and nothing speaks against it.
fn check(args: &CalibrateArgs, Verdict { wall, faults, .. }: &Verdict) -> anyhow::Result<()> {
    let file = args.file.display();
    if !faults.is_empty() && wall.is_some() && !args.force {
        bail!(
            "{} above, so {file} stays as it was: mend what is named there, or write what was found with --force",
            counted(faults.len(), "fault")
        );
    }
    if wall.is_none() && !faults.is_empty() {
        bail!(
            "nothing of this can be written, so {file} stays as it was: mend the {} above",
            counted(faults.len(), "fault")
        );
    }
    Ok(())
}

/// Writes what was found, and keeps the old file.
fn write(args: &CalibrateArgs, Verdict { wall, .. }: &Verdict) -> anyhow::Result<()> {
    let Some(wall) = wall else { return discarded(args) };
    let old = save::keep_old(&args.file)?;
    save::save_projectors(&args.file, &save::save_meshes(&args.file, wall)?)?;
    let what = match (wall.surface().is_some(), args.light) {
        (true, false) => "meshes",
        (false, false) => "corners",
        (true, true) => "meshes and light",
        (false, true) => "corners and light",
    };
    say(format_args!(
        "wrote the {what} into {}; the old file is {}; N on the wall shows the alignment grid",
        args.file.display(),
        old.display()
    ))
}
