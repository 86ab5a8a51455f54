//! `lab trace`: `renderer trace` with shadow rays, single rays, counters, and frames on demand.

pub mod cameras;
mod counts;
pub mod frame;
mod shadows;

use anyhow::{Result, ensure};
use clap::Args;
use glam::Vec3;
use renderer::cli::{
    say,
    trace::{Report, TraceArgs},
};
use serde::Serialize;

use self::frame::{FrameOptions, Kernel, RayCounts};
use crate::statistics::median;

/// The picture, and the measurements.
#[derive(Args, Debug)]
pub struct LabTraceArgs {
    /// The picture.
    #[command(flatten)]
    picture: TraceArgs,

    /// Read paths of camera files from standard input ("-", the only value), one a line; trace a frame for each and
    /// answer with a line of JSON; the first unreadable camera ends the program
    #[arg(long, value_name = "-", conflicts_with_all = ["camera", "frames", "image", "hits", "explain"])]
    cameras: Option<String>,

    /// Trace the rays of tiles in packets, or one by one
    #[arg(long, value_name = "KERNEL", value_enum, default_value_t)]
    kernel: Kernel,

    /// Also trace a shadow ray for each hit
    #[arg(long, conflicts_with = "clip")]
    shadow_rays: bool,

    /// Position of the light of the shadow rays, in world space
    #[arg(long, value_name = "X,Y,Z", default_value = "3,5,4", value_parser = point)]
    light: Vec3,
}

fn point(text: &str) -> Result<Vec3, String> {
    let numbers: Result<Vec<f32>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, z]) if x.is_finite() && y.is_finite() && z.is_finite() => Ok(Vec3::new(x, y, z)),
        _ => Err("a point is three finite numbers, as in 3,5,4".to_owned()),
    }
}

/// The results, as JSON.
#[derive(Serialize)]
struct LabReport {
    #[serde(flatten)]
    report: Report,
    /// `None` where the system does not report it.
    peak_rss_bytes: Option<u64>,
    /// Traced shadow rays.
    shadow_rays: usize,
    /// Hits that the light does not reach.
    shadowed: usize,
    /// Cells passed and triangles tested by the primary rays of a frame, traced one by one: sums, and means per ray.
    cell_traversals: u64,
    triangle_tests: u64,
    cell_traversals_per_ray: f64,
    triangle_tests_per_ray: f64,
}

/// Loads, builds and traces, and writes files and results.
///
/// # Errors
/// A file cannot be read or written.
pub fn run(args: &LabTraceArgs) -> Result<()> {
    args.picture.pool()?.install(|| run_in_pool(args))
}

fn run_in_pool(args: &LabTraceArgs) -> Result<()> {
    if let Some(source) = &args.cameras {
        ensure!(source == "-", "--cameras {source}: cameras are only read from standard input, written as -");
    }
    let options = FrameOptions { kernel: args.kernel, light: args.shadow_rays.then_some(args.light) };
    let prepared = args.picture.prepare()?;
    let (scene, spec) = (&prepared.scene, &prepared.spec);
    if args.cameras.is_some() {
        return cameras::run(scene, spec, &options, std::io::stdin().lock(), std::io::stdout().lock());
    }

    let mut counts = RayCounts::default();
    let mut report = args.picture.trace(&prepared, |frame| {
        let (cost, counted) = frame::trace(frame, scene, spec, &options);
        counts = counted;
        cost
    })?;
    let n_samples = spec.size.n_samples();
    report.mrays_per_second =
        (n_samples as usize + counts.n_shadow_rays) as f64 / median(report.frame_ms.iter().copied()) / 1e3;
    if !args.picture.json {
        return say(report.table(spec.size));
    }
    // Counting traces rays one by one, so the table does without it.
    let cost_sum = counts::cost_sum(scene, spec);
    let per_ray = |sum: u64| sum as f64 / f64::from(n_samples);
    say(serde_json::to_string(&LabReport {
        report,
        peak_rss_bytes: peak_rss_bytes(),
        shadow_rays: counts.n_shadow_rays,
        shadowed: counts.n_shadowed,
        cell_traversals: cost_sum.n_cells,
        triangle_tests: cost_sum.n_tests,
        cell_traversals_per_ray: per_ray(cost_sum.n_cells),
        triangle_tests_per_ray: per_ray(cost_sum.n_tests),
    })?)
}

/// The peak memory of this process, where Linux reports it.
fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}
