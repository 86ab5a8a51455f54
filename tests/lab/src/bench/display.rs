//! Measures the wall's own work, which limited the paper's wall: placing, uploading and drawing a frame, beside the best
//! that this machine can do.
//!
//! Measurements alternate, so that other load on the machine slows all of them alike; figures are medians.

use std::{
    fmt::Write,
    hint::black_box,
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::Context;
use compositor::{
    cli::headless::Headless,
    farm::{BufferPool, FrameSamples},
    wall::{Wall, mesh::Mesh},
};
use cpu_time::ProcessTime;
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer, images::Image};
use glam::DVec2;
use renderer::cli::say;
use serde::Serialize;
use shared::{
    division::{Division, FrameSize},
    printable::counted,
    protocol::CHUNK_BYTES,
};

use super::bare_draw::BareDraw;
use crate::{
    random::Random,
    statistics::{median, milliseconds},
};

const FEWEST_ROUNDS: usize = 5;

/// Rounds that do not count: they create pipelines and fault in memory.
const N_FIRST: usize = 2;

#[derive(Debug, Serialize)]
struct DisplayTimings {
    adapter: String,
    /// Whether the adapter is software, whose work is CPU time of this process.
    is_software: bool,
    /// The driver's own threads that draw, if it is software; `None` where the system does not tell.
    n_driver_threads: Option<usize>,
    n_cores: usize,
    /// Processes that ran or wanted to in the last minute, this one included; `None` where the system does not tell.
    load: Option<f64>,
    wall: String,
    rows: Vec<DisplayRow>,
    /// Placing, uploading and drawing a full frame of the usual size, relative to its bare draw: elapsed time, and CPU
    /// time, which other programs do not disturb and which holds all work of a software adapter.
    whole_over_bare: f64,
    whole_over_bare_cpu: f64,
    /// The same of a frame with one sample for each pixel of the wall.
    native_over_bare: f64,
    native_over_bare_cpu: f64,
    /// Drawing alone, of a frame of the usual size, through meshes relative to corners: elapsed time, and CPU time.
    meshes_over_corners: f64,
    meshes_over_corners_cpu: f64,
    /// CPU time of the steps of both full frames.
    steps: [Steps; 2],
}

/// CPU times in milliseconds.
#[derive(Clone, Copy, Debug, Serialize)]
struct Steps {
    place_ms: f64,
    upload_ms: f64,
    draw_ms: f64,
}

#[derive(Debug, Serialize)]
struct DisplayRow {
    what: String,
    whole_ms: f64,
    /// CPU time of all threads, those of a software adapter included.
    cpu_ms: f64,
}

const FULL: usize = 0;
const FULL_NATIVE: usize = 1;
const BARE: usize = 2;
const BARE_NATIVE: usize = 3;
const COPY: usize = 4;
const CORNERS: usize = 6;
const MESHES: usize = 7;

pub(super) fn run(wall: Wall, size: FrameSize, duration: Duration, is_json: bool) -> anyhow::Result<()> {
    let timings = measure(wall, size, duration)?;
    if is_json {
        say(serde_json::to_string_pretty(&timings).context("results are plain numbers")?)
    } else {
        say(timings.table())
    }
}

fn measure(wall: Wall, size: FrameSize, duration: Duration) -> anyhow::Result<DisplayTimings> {
    let wall_size @ [width, height] = wall.output_size();
    let mut through = [Headless::new(with_corners(&wall)?)?, Headless::new(with_meshes(&wall)?)?];
    let mut headless = Headless::new(wall)?;
    let native = FrameSize::new(width, height)?;
    let full = [NoiseFrame::new(size), NoiseFrame::new(native)];
    let bare = [
        BareDraw::new(headless.gpu(), wall_size, size, &full[0].placed()?)?,
        BareDraw::new(headless.gpu(), wall_size, native, &full[1].placed()?)?,
    ];
    let pixels = vec![0x55_u32; native.n_samples() as usize];
    let mut copy = pixels.clone();
    // The same scaling on one CPU core.
    let bytes = bytemuck::cast_slice(&full[0].placed()?).to_vec();
    let from = Image::from_vec_u8(size.xres(), size.yres(), bytes, PixelType::U8x4)?;
    let mut to = Image::new(width, height, PixelType::U8x4);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Interpolation(FilterType::Bilinear)).use_alpha(false);
    let mut resizer = Resizer::new();

    let names = [
        format!("full frame, {size}"),
        format!("full frame, {native}"),
        format!("bare bilinear draw, {size}"),
        format!("bare bilinear draw, {native}"),
        "memcpy of the wall's pixels".to_owned(),
        format!("fast_image_resize, {size}"),
        format!("draw through corners, {size}"),
        format!("draw through meshes, {size}"),
    ];
    let mut timings = names.each_ref().map(|_| (Vec::new(), Vec::new()));
    let mut steps: [Vec<Steps>; 2] = Default::default();
    for through in &mut through {
        full[FULL].show(through)?;
    }
    let first_at = Instant::now();
    let mut n_rounds = 0;
    while n_rounds < N_FIRST + FEWEST_ROUNDS || first_at.elapsed() < duration {
        for (index, (whole_ms, cpu_ms)) in timings.iter_mut().enumerate() {
            // A frame of another size needs another texture: create it before the measurement.
            if let Some(frame) = full.get(index) {
                frame.show(&mut headless)?;
            }
            let (started_at, cpu) = (Instant::now(), ProcessTime::now());
            match index {
                FULL | FULL_NATIVE => {
                    let shown = full[index].show(&mut headless)?;
                    steps[index].extend((n_rounds >= N_FIRST).then_some(shown));
                }
                BARE | BARE_NATIVE => bare[index - BARE].draw(headless.gpu())?,
                COPY => {
                    copy.copy_from_slice(black_box(&pixels));
                    black_box(&copy);
                }
                CORNERS | MESHES => {
                    through[index - CORNERS].draw()?;
                }
                _ => resizer.resize(&from, &mut to, &options)?,
            }
            if n_rounds >= N_FIRST {
                whole_ms.push(milliseconds(started_at.elapsed()));
                cpu_ms.push(milliseconds(cpu.elapsed()));
            }
        }
        n_rounds += 1;
    }
    let row = |(what, (whole_ms, cpu_ms))| DisplayRow { what, whole_ms: median(whole_ms), cpu_ms: median(cpu_ms) };
    let rows: Vec<_> = names.into_iter().zip(timings).map(row).collect();
    let median_of = |steps: &[Steps], ms: fn(&Steps) -> f64| median(steps.iter().map(ms));
    let steps = steps.map(|steps| Steps {
        place_ms: median_of(&steps, |it| it.place_ms),
        upload_ms: median_of(&steps, |it| it.upload_ms),
        draw_ms: median_of(&steps, |it| it.draw_ms),
    });
    Ok(DisplayTimings {
        adapter: headless.gpu().name(),
        is_software: headless.gpu().adapter.get_info().device_type == wgpu::DeviceType::Cpu,
        n_driver_threads: n_driver_threads(),
        n_cores: std::thread::available_parallelism().map_or(1, usize::from),
        load: load(),
        steps,
        wall: format!("{width}x{height}"),
        whole_over_bare: rows[FULL].whole_ms / rows[BARE].whole_ms,
        whole_over_bare_cpu: rows[FULL].cpu_ms / rows[BARE].cpu_ms,
        native_over_bare: rows[FULL_NATIVE].whole_ms / rows[BARE_NATIVE].whole_ms,
        native_over_bare_cpu: rows[FULL_NATIVE].cpu_ms / rows[BARE_NATIVE].cpu_ms,
        meshes_over_corners: rows[MESHES].whole_ms / rows[CORNERS].whole_ms,
        meshes_over_corners_cpu: rows[MESHES].cpu_ms / rows[CORNERS].cpu_ms,
        rows,
    })
}

/// The wall with the corners of all projectors a pixel inwards.
fn with_corners(wall: &Wall) -> anyhow::Result<Wall> {
    let inwards = [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]];
    let warps: Vec<_> = (0..wall.projectors().len()).map(|index| (index, inwards)).collect();
    Ok(wall.with_warps(&warps)?)
}

/// The wall with a mesh for each projector, of 33 control points a side on lines that bulge by a hundredth.
fn with_meshes(wall: &Wall) -> anyhow::Result<Wall> {
    const SIDE: usize = 33;
    let mut projectors = wall.projectors().to_vec();
    for projector in &mut projectors {
        let at = |n: usize| {
            let part = DVec2::new((n % SIDE) as f64, (n / SIDE) as f64) / (SIDE - 1) as f64;
            let across = part * (1.0 - part);
            let bulge = 0.04 * DVec2::new(across.y, across.x) * (0.5 - part);
            projector.canvas.canvas_from_rect(part + bulge)
        };
        let points: Vec<DVec2> = (0..SIDE * SIDE).map(at).collect();
        let mesh = Mesh::new("bench.pfm".to_owned(), [SIDE; 2], &points)?;
        *projector = projector.clone().with_mesh(Arc::new(mesh));
    }
    Ok(Wall::new(wall.canvas_m(), wall.frame_size(), projectors)?)
}

/// A frame of noise, in the encoding of render servers.
struct NoiseFrame {
    size: FrameSize,
    rgb: Vec<u8>,
    pool: BufferPool,
}

impl NoiseFrame {
    fn new(size: FrameSize) -> Self {
        // Bytes that repeat would flatter caches.
        let mut random = Random::new(1);
        let rgb = (0..3 * size.n_samples()).map(|_| random.bits() as u8).collect();
        Self { size, rgb, pool: BufferPool::default() }
    }

    /// Places the samples as connections do, in the chunks of one render server.
    fn placed(&self) -> anyhow::Result<FrameSamples> {
        let task = Division::default().task(0, 1);
        let share = task.share(self.size).expect("one render server can have all of a frame");
        let buffer = Arc::new(self.pool.take(self.size));
        let n_units = (CHUNK_BYTES as u32 / (3 * share.units().samples_per_full_unit())).max(1);
        let mut rgb = self.rgb.as_slice();
        for first in (0..share.count()).step_by(n_units as usize) {
            let count = n_units.min(share.count() - first);
            let n_samples: u32 = (first..first + count).map(|k| share.samples(k).count()).sum();
            let (chunk, rest) = rgb.split_at(3 * n_samples as usize);
            buffer.place(&share, first, count, chunk)?;
            rgb = rest;
        }
        Ok(buffer.into_samples(self.pool.clone()))
    }

    fn show(&self, headless: &mut Headless) -> anyhow::Result<Steps> {
        let started = ProcessTime::now();
        let samples = self.placed()?;
        let place_ms = milliseconds(started.elapsed());
        headless.upload(self.size, &samples)?;
        let upload_ms = milliseconds(started.elapsed()) - place_ms;
        headless.draw()?;
        Ok(Steps { place_ms, upload_ms, draw_ms: milliseconds(started.elapsed()) - place_ms - upload_ms })
    }
}

/// The threads of this process that Mesa's software rasteriser has started, on Linux.
fn n_driver_threads() -> Option<usize> {
    let threads = std::fs::read_dir("/proc/self/task").ok()?.flatten();
    let names = threads.filter_map(|thread| std::fs::read_to_string(thread.path().join("comm")).ok());
    Some(names.filter(|name| name.starts_with("llvmpipe")).count()).filter(|n_threads| *n_threads > 0)
}

/// The load of the last minute, on Linux.
fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()
}

impl DisplayTimings {
    fn table(&self) -> String {
        let Self { adapter, wall, rows, .. } = self;
        let cores = counted(self.n_cores, "core");
        let threads = match self.n_driver_threads {
            Some(n_threads) => format!(" with {}", counted(n_threads, "thread")),
            None => String::new(),
        };
        let load = self.load.map_or(String::new(), |load| format!(", load {load}"));
        let mut table = format!("a wall of {wall} pixels, drawn by {adapter}{threads}; {cores}{load}; medians in ms\n");
        // Writing to a string cannot fail.
        let _ = writeln!(table, "{:<36}{:>9}{:>9}", "", "whole", "CPU");
        for DisplayRow { what, whole_ms, cpu_ms } in rows {
            let _ = writeln!(table, "{what:<36}{whole_ms:>9.2}{cpu_ms:>9.2}");
        }
        for (row, over_bare, over_bare_cpu) in [
            (FULL, self.whole_over_bare, self.whole_over_bare_cpu),
            (FULL_NATIVE, self.native_over_bare, self.native_over_bare_cpu),
        ] {
            let what = &rows[row].what;
            let _ =
                writeln!(table, "{what}, relative to the bare draw: {over_bare:.2}; in CPU time: {over_bare_cpu:.2}");
            let Steps { place_ms, upload_ms, draw_ms } = self.steps[row];
            let _ = writeln!(
                table,
                "  of that CPU time: placing {place_ms:.2}, uploading {upload_ms:.2}, drawing {draw_ms:.2}"
            );
        }
        let (meshes, meshes_cpu) = (self.meshes_over_corners, self.meshes_over_corners_cpu);
        let _ =
            writeln!(table, "drawing through meshes, relative to corners: {meshes:.2}; in CPU time: {meshes_cpu:.2}");
        table += match self.is_software {
            true => {
                "trust the ratio in CPU time: placing and uploading run on one thread, and drawing on all of the driver's, \
                 so the more threads it has, the larger is the first ratio\n"
            }
            false => "trust the first ratio: the work of a GPU is no CPU time\n",
        };
        table + "presenting needs a screen: a wall in a window prints its time after --frames 100"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_is_measured_and_shows_the_same_picture() {
        let text = "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = 1\nrows = 1\npixels = [64, 36]\n";
        let wall = Wall::from_toml("small.toml", text).unwrap();
        let size = FrameSize::new(32, 16).unwrap();
        let timings = match measure(wall.clone(), size, Duration::ZERO) {
            Ok(timings) => timings,
            Err(error) if error.to_string().contains("no graphics driver") => return println!("skipped: {error}"),
            Err(error) => panic!("{error}"),
        };
        assert_eq!(timings.rows.len(), 8);
        assert!(timings.rows.iter().all(|row| row.whole_ms > 0.0), "{timings:?}");
        assert!(timings.table().contains("of that CPU time: placing"), "{}", timings.table());
        assert!(timings.table().contains("fast_image_resize, 32x16"));
        let trusted = if timings.is_software { "trust the ratio in CPU time" } else { "trust the first ratio" };
        assert!(timings.table().contains(trusted), "{}", timings.table());
        let is_mesa = timings.adapter.contains("llvmpipe") && cfg!(target_os = "linux");
        assert_eq!(timings.n_driver_threads.is_some(), is_mesa, "{}", timings.table());

        // Bare draw and wall draw the same picture.
        let mut headless = Headless::new(wall).unwrap();
        let full = NoiseFrame::new(size);
        let bare = BareDraw::new(headless.gpu(), [64, 36], size, &full.placed().unwrap()).unwrap();
        bare.draw(headless.gpu()).unwrap();
        let bare = bare.read(headless.gpu()).unwrap();
        full.show(&mut headless).unwrap();
        let wall = headless.image().unwrap();
        assert_eq!(bare.rgb.len(), 3 * 64 * 36);
        assert_eq!(bare.rgb.iter().zip(&wall.rgb).filter(|(a, b)| a.abs_diff(**b) > 2).count(), 0);
    }
}
