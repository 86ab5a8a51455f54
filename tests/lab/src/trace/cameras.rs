//! `lab trace --cameras -`: frames on demand, the model loaded and built once.

use std::{
    io::{BufRead, Write},
    path::Path,
};

use anyhow::{Context, Result};
use renderer::{
    cli::{read_line, trace::read_camera},
    render::{
        frame::Frame,
        tracer::{FrameRequest, Scene},
    },
};
use serde::Serialize;

use super::frame::{self, FrameOptions};

/// One line of the answer.
#[derive(Serialize)]
struct FrameReport {
    frame_ms: f64,
    frame_cpu_ms: f64,
    hits: usize,
    shadow_rays: usize,
    shadowed: usize,
    mrays_per_second: f64,
}

/// Reads the path of a camera file from each line, traces one frame, and answers with a line of JSON.
///
/// The first wrong camera ends it with an error; so does the end of the input, without one.
pub(super) fn run(
    scene: &Scene,
    request: &FrameRequest,
    options: &FrameOptions,
    mut paths: impl BufRead,
    mut answers: impl Write,
) -> Result<()> {
    let mut frame = Frame::default();
    let mut line = String::new();
    let mut n_lines = 0;
    while read_line(&mut paths, &mut line).context("cannot read the next camera's path")? {
        n_lines += 1;
        let path = line.trim();
        if path.is_empty() {
            continue;
        }
        let camera = read_camera(Path::new(path)).with_context(|| format!("line {n_lines} of the cameras"))?;
        let request = FrameRequest { camera, ..*request };
        let (cost, counts) = frame::trace(&mut frame, scene, &request, options);
        let n_rays = request.size.n_samples() as usize + counts.n_shadow_rays;
        let report = FrameReport {
            frame_ms: cost.wall.as_secs_f64() * 1e3,
            frame_cpu_ms: cost.cpu.as_secs_f64() * 1e3,
            hits: frame.n_hits(),
            shadow_rays: counts.n_shadow_rays,
            shadowed: counts.n_shadowed,
            mrays_per_second: n_rays as f64 / cost.wall.as_secs_f64() / 1e6,
        };
        writeln!(answers, "{}", serde_json::to_string(&report)?).context("cannot write the answer")?;
        answers.flush().context("cannot write the answer")?;
    }
    Ok(())
}
