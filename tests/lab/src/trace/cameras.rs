//! `renderer trace --cameras -`: frames on demand, the model loaded and built once.

use std::{
    io::{BufRead, Write},
    path::Path,
};

use anyhow::{Context, Result};
use serde::Serialize;

use super::{
    frame::{Frame, FrameOptions},
    milliseconds, read_camera,
};
use crate::{
    cli::read_line,
    tracer::{FrameRequest, Scene},
};

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
        let cost = frame.trace(scene, &request, options);
        let n_rays = request.size.n_samples() as usize + cost.n_shadow_rays;
        let report = FrameReport {
            frame_ms: milliseconds(cost.wall),
            frame_cpu_ms: milliseconds(cost.cpu),
            hits: frame.n_hits(),
            shadow_rays: cost.n_shadow_rays,
            shadowed: cost.n_shadowed,
            mrays_per_second: n_rays as f64 / cost.wall.as_secs_f64() / 1e6,
        };
        writeln!(answers, "{}", serde_json::to_string(&report)?).context("cannot write the answer")?;
        answers.flush().context("cannot write the answer")?;
    }
    Ok(())
}
