//! `lab trace --cameras -`: frames on demand of a scene that is built once.

use std::{
    io::{BufRead, Read, Write},
    path::Path,
};

use anyhow::{Context, Result, ensure};
use renderer::{cli::picture_args::read_camera, render::scene::Scene};
use serde::Serialize;
use shared::protocol::FrameSpec;

use super::frame::{Frame, FrameOptions};
use crate::statistics::milliseconds;

/// Limit of a line in bytes: paths are shorter on all systems.
const LONGEST_LINE: u64 = 1 << 16;

/// Replaces `line` by the next line of the input; returns false at the end of the input. An endless line is an error.
pub fn read_line(input: &mut impl BufRead, line: &mut String) -> Result<bool> {
    line.clear();
    let n_bytes = input.take(LONGEST_LINE).read_line(line)? as u64;
    ensure!(n_bytes < LONGEST_LINE, "a line has {LONGEST_LINE} bytes or more");
    Ok(n_bytes > 0)
}

#[derive(Serialize)]
struct FrameReport {
    frame_ms: f64,
    frame_cpu_ms: f64,
    hits: usize,
    shadow_rays: usize,
    shadowed: usize,
    mrays_per_second: f64,
}

/// Reads the path of a camera file from each line, traces one frame, and answers with a line of JSON, until the input ends.
///
/// # Errors
/// A camera cannot be read; the error names its line.
pub(super) fn run(
    scene: &Scene,
    request: &FrameSpec,
    options: &FrameOptions,
    mut paths: impl BufRead,
    mut answers: impl Write,
) -> Result<()> {
    let mut frame = Frame::new(request.size);
    let mut line = String::new();
    let mut n_lines = 0;
    while read_line(&mut paths, &mut line).context("cannot read the next camera's path")? {
        n_lines += 1;
        let path = line.trim();
        if path.is_empty() {
            continue;
        }
        let camera = read_camera(Path::new(path)).with_context(|| format!("line {n_lines} of the cameras"))?;
        let request = FrameSpec { camera, ..*request };
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
