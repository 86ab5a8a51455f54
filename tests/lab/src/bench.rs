//! `lab bench`: the paper's experiment, repeated on this machine and predicted for clusters.
//!
//! [`measure`] runs the real wall, for the paper's figures 8 and 9. [`predict`] simulates clusters: [`shares`] traces tasks
//! one by one, and [`replay`] runs them through the wall's scheduler. [`results`] and [`charts`] write files after each step,
//! so that an interrupted run keeps its results. [`display`] measures the wall's own work alone, beside a [`bare_draw`].

mod bare_draw;
mod charts;
mod display;
mod measure;
mod predict;
mod replay;
mod results;
mod shares;

use std::{path::PathBuf, str::FromStr, time::Duration};

use anyhow::Context;
use compositor::{
    cli::{
        args::ShowArgs,
        headless::{Headless, Wakeup, Wakeups},
        run::{network_threads, wake_to_stop, wakeups},
    },
    farm::RenderGoal,
};
use indicatif::{ProgressBar, ProgressStyle};
use renderer::{
    cli::{say, scene_args::SceneArgs},
    model::{mesh::Mesh, scene::LoadedMesh},
    render::scene::Scene,
};
use shared::{
    division::{Division, FrameSize},
    protocol::{Encoding, FrameSpec, LightingMode},
};
use strum::VariantArray;

use self::{
    measure::{RealWall, Stopped},
    predict::Path,
    results::{MeasuredRow, PredictedRow, Results},
    shares::{FEWEST_PASSES, MOST_PASSES, ShareTracer},
};
use crate::{chart::view_all, farm};

/// The measurements, and the folder of their results.
#[derive(Clone, Debug, clap::Args)]
pub struct BenchArgs {
    #[command(flatten)]
    pub show: ShowArgs,
    /// Samples of a measured frame
    #[arg(long, value_name = "WxH", default_value_t = FrameSize::PAPER)]
    pub size: FrameSize,
    /// By which rays the picture is lit: primary, shadows, ambient or path
    #[arg(long, value_name = "RAYS", default_value_t = LightingMode::default())]
    pub rays: LightingMode,
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Frames in flight, 1 to 3
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = renderer::cli::between(1_u32..=3))]
    pub in_flight: u32,
    /// Numbers of local render servers to measure, for example 0..12 or 1,2,4; 0 is the display alone; "none" measures
    /// nothing
    #[arg(long, value_name = "LIST", default_value = "0..12")]
    pub nodes: NodeCounts<64>,
    /// Seconds of each measurement
    #[arg(long, value_name = "S", default_value_t = 5.0, value_parser = seconds)]
    pub seconds: f64,
    /// Numbers of one-core nodes to predict; "none" predicts nothing
    #[arg(long, value_name = "LIST", default_value = "12,64,256")]
    pub predict: NodeCounts<1024>,
    /// Samples of a predicted frame; may be repeated [default: 1024x512 and 4096x2304]
    #[arg(long, value_name = "WxH")]
    pub predict_size: Vec<FrameSize>,
    /// Frames of each prediction
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = renderer::cli::between(1_u16..=1000))]
    pub predict_frames: u16,
    /// The folder for the results; created if missing
    #[arg(long, value_name = "DIR", required_unless_present = "display")]
    pub out: Option<PathBuf>,
    /// Measure the wall's own work instead: placing, uploading and drawing frames, beside the best that this machine can do
    #[arg(long, conflicts_with_all = ["file", "model", "triangles", "camera", "nodes", "predict", "predict_size", "out"])]
    pub display: bool,
    /// Print the results of --display as JSON
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
            let number = |text: &str| {
                text.trim().parse::<u32>().ok().filter(|n| *n <= MOST).ok_or_else(|| {
                    format!("\"{text}\" is not a number from 0 to {MOST}: write 0..12, or 1,2,4, or none")
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
    let seconds = text.parse().map_err(|_| format!("\"{text}\" is not a number of seconds"))?;
    if (0.01..=3600.0).contains(&seconds) { Ok(seconds) } else { Err("from 0.01 to 3600 seconds are possible".into()) }
}

pub(crate) fn run(args: &BenchArgs) -> anyhow::Result<()> {
    // Errors that show at once come before a large model is read.
    let show = &args.show;
    let wall = show.load_wall()?;
    let Some(out) = &args.out else {
        return display::run(wall, args.size, Duration::from_secs_f64(args.seconds), args.json);
    };
    let camera = show.read_camera()?;
    std::fs::create_dir_all(out).with_context(|| format!("cannot make the folder {}", out.display()))?;
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut results = Results {
        model: show.model.source().to_string(),
        camera: show.camera.as_ref().map(|path| path.display().to_string()),
        n_cores,
        ..Results::default()
    };
    results.write(out)?;

    let runtime = network_threads()?;
    let (wake, wakeups) = wakeups();
    let aspect = wall.aspect();
    let headless = if args.nodes.0.is_empty() { None } else { Some(Headless::new(wall)?) };
    let LoadedMesh { id, mesh, .. } = show.model.load()?;
    // From here on, an experiment that is stopped has results.
    wake_to_stop(wake.clone());
    let [min, max] = mesh.extent();
    let camera = camera.unwrap_or_else(|| view_all(&mesh, aspect));
    let spec = FrameSpec { rays: args.rays, ..farm::frame_spec(id, camera, args.size) };
    let path = Path { spec, centre: (min + max) * 0.5, in_flight: args.in_flight };

    let sizes = if args.predict_size.is_empty() {
        vec![FrameSize::PAPER, FrameSize::new(4096, 2304)?]
    } else {
        args.predict_size.clone()
    };
    let scenarios: Vec<_> = sizes.iter().flat_map(|&size| predict::scenarios(size, &args.predict.0)).collect();
    let n_scenarios = if args.predict.0.is_empty() { 0 } else { scenarios.len() };
    let steps = ProgressBar::new((args.nodes.0.len() * Division::VARIANTS.len() + n_scenarios) as u64);
    if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len}, {eta} left") {
        steps.set_style(style);
    }
    steps.enable_steady_tick(Duration::from_millis(100));

    let mut experiment =
        Experiment { args, out, results: &mut results, steps, wakeups: &wakeups, undisplayed: Vec::new() };
    let goal = RenderGoal {
        spec: Some(spec),
        scene_path: show.model.path().map(PathBuf::from),
        in_flight: args.in_flight,
        // Measured and predicted bytes are those of plain samples.
        encoding: Some(Encoding::Raw),
        ..farm::goal(Division::default(), 1)
    };
    let mut outcome = Ok(());
    if let Some(mut headless) = headless {
        outcome = experiment.measure(&runtime, &mut headless, goal, move || {
            // One unread wake-up call is enough.
            let _ = wake.try_send(Wakeup::Farm);
        });
    }
    if outcome.is_ok() && n_scenarios > 0 {
        outcome = experiment.predict(&path, &scenarios, mesh);
    }
    experiment.steps.finish_and_clear();
    let end = match outcome {
        Err(error) if !error.is::<Stopped>() => return Err(error),
        Err(_) => "stopped: results so far",
        Ok(()) => "all results",
    };
    say(format_args!("{end}: {}", out.display()))
}

struct Experiment<'a> {
    args: &'a BenchArgs,
    out: &'a std::path::Path,
    results: &'a mut Results,
    steps: ProgressBar,
    wakeups: &'a Wakeups,
    /// Measurements without display, to check predictions with.
    undisplayed: Vec<MeasuredRow>,
}

impl Experiment<'_> {
    /// Measures the real wall: the paper's figures 8 and 9.
    fn measure(
        &mut self,
        runtime: &tokio::runtime::Runtime,
        headless: &mut Headless,
        goal: RenderGoal,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> anyhow::Result<()> {
        let duration = Duration::from_secs_f64(self.args.seconds);
        let node_counts = &self.args.nodes.0;
        if node_counts.contains(&0) {
            self.steps.set_message("the display alone");
            let row = measure::measure_display(headless, self.wakeups, self.args.size, duration)?;
            self.add_measured(row, Division::VARIANTS.len())?;
        }
        let mut wall = RealWall::start(runtime, headless, self.wakeups, goal, &self.args.scene, wake)?;
        for &n_nodes in node_counts.iter().filter(|&&n_nodes| n_nodes > 0) {
            wall.grow_to(n_nodes)?;
            for &division in Division::VARIANTS {
                self.steps.set_message(format!("{n_nodes} render servers, {division}"));
                self.add_measured(wall.measure(division, duration, true)?, 1)?;
                if n_nodes <= 2 && n_nodes as usize <= self.results.n_cores {
                    self.undisplayed.push(wall.measure(division, duration, false)?);
                }
            }
        }
        Ok(())
    }

    /// Checks the prediction on this machine, then predicts clusters.
    fn predict(&mut self, path: &Path, scenarios: &[predict::Scenario], mesh: Mesh) -> anyhow::Result<()> {
        self.steps.set_message("building the grid");
        let scene = Scene::build(mesh, &self.args.scene.options(), &|_| ());
        let wakeups = self.wakeups;
        // The wake-up call to stop comes once; the answer stays.
        let has_stopped = std::cell::Cell::new(false);
        let is_stopped = || {
            has_stopped.set(has_stopped.get() || wakeups.try_iter().any(|wakeup| wakeup == Wakeup::Stop));
            has_stopped.get()
        };
        for measured in &self.undisplayed {
            self.steps.set_message("checking the prediction");
            let mut tracer = ShareTracer::new(&scene, &|_, _| ());
            let check = predict::check(measured, path, &mut tracer, is_stopped).ok_or(Stopped)?;
            self.steps.suspend(|| say(format_args!(
                "check of the prediction, {:<11} {} nodes: {:.1} ms measured ({:.1} of CPU by the busiest), {:.1} ms predicted",
                check.division,
                check.n_nodes,
                check.measured_ms,
                check.measured_busy_ms,
                check.predicted_ms
            )))?;
            self.results.checks.push(check);
        }
        self.steps.suspend(|| say(format_args!(
            "predicting {} clusters: each task is traced alone on one core, {FEWEST_PASSES} to {MOST_PASSES} times, until its \
             time settles; that takes nearly all of the time",
            scenarios.len()
        )))?;
        for scenario in scenarios {
            let &predict::Scenario { size, is_moving, division, n_nodes, n_slow } = scenario;
            let motion = if is_moving { "moving" } else { "still" };
            let steps = self.steps.clone();
            let on_pass = move |frame, pass| {
                steps.set_message(format!(
                    "predicting {n_nodes} nodes, {size}, {division}, {motion}: tracing frame {frame}, pass {pass}"
                ));
            };
            let alone = |mbit_per_s: f64| {
                let is_alone = |row: &&PredictedRow| {
                    (row.division, row.is_moving, row.n_nodes) == (division, is_moving, 1)
                        && row.size == size.to_string()
                        && row.mbit_per_s == mbit_per_s
                };
                let row = self.results.predicted.iter().find(is_alone)?;
                Some(predict::Alone { frame_ms: row.frame_ms, compute_ms: row.compute_ms })
            };
            let n_frames = usize::from(self.args.predict_frames);
            let mut tracer = ShareTracer::new(&scene, &on_pass);
            let rows = predict::predict(scenario, path, n_frames, &mut tracer, alone, is_stopped).ok_or(Stopped)?;
            for row in &rows {
                self.steps.suspend(|| say(format_args!(
                    "predicted {size} {motion:<6} {:<11} {n_nodes:>3} nodes{} {:>5.0} Mbit/s: {:>8.2} ms a frame, {} binds, \
                     {:.2} of it, efficiency {:.2} (all tasks take {:.2} of one node's CPU time), imbalance {:.3} (p95 {:.3})",
                    division,
                    if n_slow > 0 { " (one slow)" } else { "" },
                    row.mbit_per_s,
                    row.frame_ms,
                    row.binds,
                    row.over_bound,
                    row.efficiency,
                    row.cpu_over_alone,
                    row.imbalance_median,
                    row.imbalance_p95
                )))?;
            }
            self.results.predicted.extend(rows);
            self.write(1)?;
        }
        Ok(())
    }

    fn add_measured(&mut self, row: MeasuredRow, n_steps: usize) -> anyhow::Result<()> {
        self.steps.suspend(|| {
            say(format_args!(
                "measured {:<11} {:>2} render servers: {:>8.1} ms a frame (p95 {:.1}), {:>9.0} bytes in, {:>5.0} out",
                row.division.map_or("display", Into::into),
                row.n_nodes,
                row.frame_ms_median,
                row.frame_ms_p95,
                row.bytes_in,
                row.bytes_out
            ))
        })?;
        self.results.measured.push(row);
        self.write(n_steps)
    }

    fn write(&mut self, n_steps: usize) -> anyhow::Result<()> {
        self.results.write(self.out)?;
        charts::draw(self.results, self.out)?;
        self.steps.inc(n_steps as u64);
        Ok(())
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
