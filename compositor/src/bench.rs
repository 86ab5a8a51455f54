//! `compositor bench`: the paper's experiment, repeated on this machine and predicted for clusters.
//!
//! `measure` runs the real wall: the paper's figures 8 and 9. `shares` traces shares one by one, and `predict` replays
//! them through the scheduler as a cluster would have traced them. `results` and `charts` write what was found, after
//! each step, so that an interrupted run leaves what it measured. `display` measures the wall's own work alone, beside
//! the least that could be done, of which `bare_draw` is a part.

mod bare_draw;
mod charts;
mod display;
mod measure;
mod predict;
mod results;
mod shares;

use std::{path::PathBuf, str::FromStr, time::Duration};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use renderer::{
    cli::{progress::Progress, say, scene_args::SceneArgs},
    model::mesh::Mesh,
    render::tracer::Scene,
};
use shared::{
    appearance::Appearance,
    camera::{Camera, UpAxis},
    division::{Division, FrameSize},
    protocol::{Encoding, FrameSpec, LightingMode, SampleRange, ShadingMode},
};

use self::{
    measure::{RealWall, Stopped},
    predict::Path,
    results::{MeasuredRow, PredictedRow, Results},
    shares::ShareTracer,
};
use crate::{
    cli::{
        args::ShowArgs,
        headless::{Headless, Wakeup, Wakeups},
        run::{network_threads, wakeups},
    },
    farm::RenderGoal,
};

/// What is measured, and where the figures go.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    /// What is shown, and where.
    #[command(flatten)]
    pub show: ShowArgs,
    /// Samples of a measured frame
    #[arg(long, value_name = "WxH", default_value_t = FrameSize::PAPER)]
    pub size: FrameSize,
    /// By which rays the picture is lit: primary, shadows or ambient
    #[arg(long, value_name = "RAYS", default_value = LightingMode::default().name())]
    pub rays: LightingMode,
    /// How scenes are made ready.
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Frames rendered at a time, 1 to 3
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=3))]
    pub in_flight: u32,
    /// Numbers of local render servers to measure, as in 0..12 or 1,2,4; none for no measurement; 0 is the display alone
    #[arg(long, value_name = "LIST", default_value = "0..12")]
    pub nodes: NodeCounts<64>,
    /// How long each number and division is measured
    #[arg(long, value_name = "S", default_value_t = 5.0, value_parser = seconds)]
    pub seconds: f64,
    /// Numbers of one-core nodes to predict; none for no prediction
    #[arg(long, value_name = "LIST", default_value = "12,64,256")]
    pub predict: NodeCounts<1024>,
    /// Samples of a predicted frame; may be given several times [default: 1024x512 and 4096x2304]
    #[arg(long, value_name = "WxH")]
    pub predict_size: Vec<FrameSize>,
    /// Frames of each prediction
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub predict_frames: u16,
    /// The folder for the figures; it is made if it is not there
    #[arg(long, value_name = "DIR", required_unless_present = "display")]
    pub out: Option<PathBuf>,
    /// Measure the wall's own work alone: placing, uploading and drawing frames, beside what this machine can do at best
    #[arg(long, conflicts_with_all = ["model", "triangles", "camera", "nodes", "predict", "predict_size", "out"])]
    pub display: bool,
    /// Write the figures of --display as JSON
    #[arg(long, conflicts_with = "out")]
    pub json: bool,
}

/// Numbers of nodes, each at most `MOST`, ascending.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeCounts<const MOST: u32>(Vec<u32>);

impl<const MOST: u32> FromStr for NodeCounts<MOST> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "none" {
            return Ok(Self(Vec::new()));
        }
        let mut counts = Vec::new();
        for part in text.split(',') {
            let (first, last) = part.split_once("..").unwrap_or((part, part));
            let number =
                |text: &str| {
                    text.trim().parse::<u32>().ok().filter(|n| *n <= MOST).ok_or_else(|| {
                        format!("\"{text}\" is no number from 0 to {MOST}: write 0..12, or 1,2,4, or none")
                    })
                };
            counts.extend(number(first)?..=number(last)?);
        }
        if counts.is_empty() {
            return Err(format!("\"{text}\" holds no number: write the smaller one first, as in 0..12"));
        }
        counts.sort_unstable();
        counts.dedup();
        Ok(Self(counts))
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().map_err(|_| format!("\"{text}\" is no number of seconds"))?;
    if (0.01..=3600.0).contains(&seconds) { Ok(seconds) } else { Err("from 0.01 to 3600 seconds are possible".into()) }
}

/// Runs the experiment.
pub fn run(args: &BenchArgs) -> anyhow::Result<()> {
    // First what fails at once: an operator learns of it before a model of minutes is read.
    let show = &args.show;
    let wall = show.load_wall()?;
    let Some(out) = &args.out else {
        return display::run(wall, args.size, Duration::from_secs_f64(args.seconds), args.json);
    };
    let camera = show.read_camera()?;
    std::fs::create_dir_all(out).with_context(|| format!("cannot make the folder {}", out.display()))?;
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut results = Results {
        model: show.model.as_ref().map_or_else(|| "built-in statue".into(), |path| path.display().to_string()),
        camera: show.camera.as_ref().map(|path| path.display().to_string()),
        n_cores,
        ..Results::default()
    };
    results.write(out)?;

    let runtime = network_threads()?;
    let (wake, wakeups) = wakeups(&runtime);
    let aspect = wall.aspect();
    let headless = if args.nodes.0.is_empty() { None } else { Some(Headless::new(wall)?) };
    let source = show.source();
    let renderer::model::scene::LoadedMesh { id, mesh } = {
        let bar = Progress::new(format!("loading {source}"));
        renderer::model::scene::load(&source, &|fraction| bar.set(fraction))?
    };
    let bounds = mesh.bounds();
    let [min, max] = [bounds.min, bounds.max].map(|corner| glam::Vec3::from(corner).as_dvec3());
    let camera = camera.unwrap_or_else(|| Camera::view_all(min, max, UpAxis::Y, aspect));
    let (size, view, rays, samples) = (args.size, ShadingMode::Shaded, args.rays, SampleRange::CENTRE);
    let spec = FrameSpec { scene: id, camera, size, view, rays, samples, appearance: Appearance::default() };
    let path = Path { spec, centre: (min + max) * 0.5, in_flight: args.in_flight };

    let sizes = if args.predict_size.is_empty() {
        vec![FrameSize::PAPER, FrameSize::new(4096, 2304)?]
    } else {
        args.predict_size.clone()
    };
    let scenarios: Vec<_> = sizes.iter().flat_map(|&size| predict::scenarios(size, &args.predict.0)).collect();
    let n_scenarios = if args.predict.0.is_empty() { 0 } else { scenarios.len() };
    let steps = Steps::new(args.nodes.0.len() * Division::ALL.len() + n_scenarios);

    let mut experiment =
        Experiment { args, out, results: &mut results, steps, wakeups: &wakeups, undisplayed: Vec::new() };
    let wanted = RenderGoal {
        spec: Some(spec),
        scene_path: show.model.clone(),
        is_refinement: false,
        division: Division::default(),
        min_renderers: 1,
        repeat: true,
        in_flight: args.in_flight,
        // The figures count the samples' own bytes, measured and predicted.
        encoding: Some(Encoding::Raw),
        moved_at: std::time::Instant::now(),
    };
    let mut outcome = Ok(());
    if let Some(mut headless) = headless {
        outcome = experiment.measure(&runtime, &mut headless, wanted, move || {
            // A call that is still waiting to be heard is enough.
            let _ = wake.try_send(Wakeup::Farm);
        })?;
    }
    if outcome.is_ok() && n_scenarios > 0 {
        outcome = experiment.predict(&path, &scenarios, mesh)?;
    }
    experiment.steps.bar.finish_and_clear();
    let end = if outcome == Err(Stopped) { "stopped: what was found so far" } else { "all figures" };
    say(format_args!("{end}: {}", out.display()))
}

/// A run of the experiment.
struct Experiment<'a> {
    args: &'a BenchArgs,
    out: &'a std::path::Path,
    results: &'a mut Results,
    steps: Steps,
    wakeups: &'a Wakeups,
    /// Measured without display, for checks of predictions.
    undisplayed: Vec<MeasuredRow>,
}

impl Experiment<'_> {
    /// The paper's figures 8 and 9.
    fn measure(
        &mut self,
        runtime: &tokio::runtime::Runtime,
        headless: &mut Headless,
        wanted: RenderGoal,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> anyhow::Result<Result<(), Stopped>> {
        let duration = Duration::from_secs_f64(self.args.seconds);
        let node_counts = &self.args.nodes.0;
        if node_counts.contains(&0) {
            self.steps.begin("the display alone");
            match measure::measure_display(headless, self.wakeups, self.args.size, duration)? {
                Ok(row) => self.add_measured(row, Division::ALL.len())?,
                Err(Stopped) => return Ok(Err(Stopped)),
            }
        }
        let mut wall = RealWall::start(runtime, headless, self.wakeups, wanted, &self.args.scene, wake)?;
        for &n_nodes in node_counts.iter().filter(|&&n_nodes| n_nodes > 0) {
            wall.grow_to(n_nodes)?;
            for division in Division::ALL {
                self.steps.begin(&format!("{n_nodes} render servers, {}", division.name()));
                match wall.measure(division, duration, true)? {
                    Ok(row) => self.add_measured(row, 1)?,
                    Err(Stopped) => return Ok(Err(Stopped)),
                }
                if n_nodes <= 2 && n_nodes as usize <= self.results.n_cores {
                    match wall.measure(division, duration, false)? {
                        Ok(row) => self.undisplayed.push(row),
                        Err(Stopped) => return Ok(Err(Stopped)),
                    }
                }
            }
        }
        Ok(Ok(()))
    }

    /// Clusters.
    fn predict(
        &mut self,
        path: &Path,
        scenarios: &[predict::Scenario],
        mesh: Mesh,
    ) -> anyhow::Result<Result<(), Stopped>> {
        self.steps.begin("building the grid");
        let scene = Scene::build(mesh, &self.args.scene.options(), &|_| ());
        let wakeups = self.wakeups;
        // Whoever asks again gets the same answer: a stop is heard once.
        let heard = std::cell::Cell::new(false);
        let is_stopped = || {
            heard.set(heard.get() || wakeups.try_iter().any(|wakeup| wakeup == Wakeup::Stop));
            heard.get()
        };
        for measured in &self.undisplayed {
            let mut tracer = ShareTracer::new(&scene);
            let Some(check) = predict::check(measured, path, &mut tracer, is_stopped) else { return Ok(Err(Stopped)) };
            self.steps.say(&format!(
                "check of the prediction, {:<11} {} nodes: {:.1} ms measured ({:.1} of CPU by the busiest), {:.1} ms predicted",
                check.division.name(),
                check.n_nodes,
                check.measured_ms,
                check.measured_busy_ms,
                check.predicted_ms
            ))?;
            self.results.checks.push(check);
        }
        for scenario in scenarios {
            let &predict::Scenario { size, is_moving, division, n_nodes, n_slow } = scenario;
            let motion = if is_moving { "moving" } else { "still" };
            self.steps.begin(&format!("predicting {n_nodes} nodes, {size}, {}, {motion}", division.name()));
            let alone_ms = |mbit_per_s: f64| {
                let is_alone = |row: &&PredictedRow| {
                    (row.division, row.is_moving, row.n_nodes) == (division, is_moving, 1)
                        && row.size == size.to_string()
                        && row.mbit_per_s == mbit_per_s
                };
                self.results.predicted.iter().find(is_alone).map(|row| row.frame_ms)
            };
            let n_frames = usize::from(self.args.predict_frames);
            let mut tracer = ShareTracer::new(&scene);
            let rows = predict::predict(scenario, path, n_frames, &mut tracer, alone_ms, is_stopped);
            let Some(rows) = rows else { return Ok(Err(Stopped)) };
            for row in &rows {
                self.steps.say(&format!(
                    "predicted {size} {motion:<6} {:<11} {n_nodes:>3} nodes{} {:>5.0} Mbit/s: {:>8.2} ms a frame, {} binds, \
                     {:.2} of it, efficiency {:.2}, imbalance {:.3} (p95 {:.3})",
                    division.name(),
                    if n_slow > 0 { " (one slow)" } else { "" },
                    row.mbit_per_s,
                    row.frame_ms,
                    row.binds,
                    row.over_bound,
                    row.efficiency,
                    row.imbalance_median,
                    row.imbalance_p95
                ))?;
            }
            self.results.predicted.extend(rows);
            self.write(1)?;
        }
        Ok(Ok(()))
    }

    fn add_measured(&mut self, row: MeasuredRow, n_steps: usize) -> anyhow::Result<()> {
        self.steps.say(&format!(
            "measured {:<11} {:>2} render servers: {:>8.1} ms a frame (p95 {:.1}), {:>9.0} bytes in, {:>5.0} out",
            row.division.map_or("display", Division::name),
            row.n_nodes,
            row.frame_ms_median,
            row.frame_ms_p95,
            row.bytes_in,
            row.bytes_out
        ))?;
        self.results.measured.push(row);
        self.write(n_steps)
    }

    /// After each step, so that an interrupted run leaves what it found.
    fn write(&mut self, n_steps: usize) -> anyhow::Result<()> {
        self.results.write(self.out)?;
        charts::draw(self.results, self.out)?;
        self.steps.bar.inc(n_steps as u64);
        Ok(())
    }
}

/// How far the experiment is, on a terminal.
struct Steps {
    bar: ProgressBar,
}

impl Steps {
    fn new(n_steps: usize) -> Self {
        let bar = ProgressBar::new(n_steps as u64);
        if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}, {eta} left") {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(100));
        Self { bar }
    }

    fn begin(&self, what: &str) {
        self.bar.set_message(what.to_owned());
    }

    fn say(&self, line: &str) -> anyhow::Result<()> {
        self.bar.suspend(|| say(line))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_nodes_are_lists_and_ranges() {
        let parse = |text: &str| text.parse::<NodeCounts<64>>().map(|counts| counts.0);
        assert_eq!(parse("0..3").unwrap(), [0, 1, 2, 3]);
        assert_eq!(parse("12,1..2,2").unwrap(), [1, 2, 12]);
        assert!(parse("none").unwrap().is_empty());
        for bad in ["", "65", "-1", "3..1", "a", "1..", "..", "0..99999999999999999999"] {
            assert!(parse(bad).unwrap_err().contains("0..12"), "{bad}");
        }
    }

    #[test]
    fn durations_are_bounded() {
        assert_eq!(seconds("0.5").unwrap(), 0.5);
        for bad in ["0", "-1", "nan", "inf", "1e9", "soon"] {
            assert!(seconds(bad).is_err(), "{bad}");
        }
    }
}
