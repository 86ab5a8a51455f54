//! Measures the wall's own work, which limited the paper's wall: placing, uploading and drawing a frame, beside the best
//! that this machine can do.
//!
//! Measurements alternate, so that other load on the machine slows all of them alike; figures are medians.

use std::{
    fmt::Write,
    time::{Duration, Instant},
};

use anyhow::Context;
use compositor::{
    cli::headless::Headless,
    farm::{FrameSamples, SamplePlacer},
    wall::Wall,
};
use cpu_time::ProcessTime;
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer, images::Image};
use renderer::cli::say;
use serde::Serialize;
use shared::{
    division::{Division, FrameSize},
    protocol::CHUNK_BYTES,
};

use super::bare_draw::BareDraw;
use crate::{
    random::Random,
    statistics::{median, milliseconds},
};

/// Measured rounds, however long they take.
const FEWEST_ROUNDS: usize = 5;

/// Rounds that do not count: they create pipelines and fault in memory.
const N_FIRST: usize = 2;

/// The results.
#[derive(Debug, Serialize)]
struct DisplayTimings {
    adapter: String,
    wall: String,
    rows: Vec<DisplayRow>,
    /// Placing, uploading and drawing a full frame of the usual size, relative to its bare draw: elapsed time, and CPU
    /// time, which other programs do not disturb and which holds all work of a software adapter.
    whole_over_bare: f64,
    whole_over_bare_cpu: f64,
    /// The same of a frame with one sample for each pixel of the wall.
    native_over_bare: f64,
    native_over_bare_cpu: f64,
}

/// Medians of one kind of work. Steps that it does not have are `None`.
#[derive(Debug, Serialize)]
struct DisplayRow {
    what: String,
    place_ms: Option<f64>,
    upload_ms: Option<f64>,
    draw_ms: Option<f64>,
    /// On the GPU's own clock.
    gpu_draw_ms: Option<f64>,
    whole_ms: f64,
    /// CPU time of all threads, those of a software adapter included.
    cpu_ms: f64,
}

/// One measurement.
#[derive(Clone, Copy, Debug, Default)]
struct Timing {
    place: Option<Duration>,
    upload: Option<Duration>,
    draw: Option<Duration>,
    gpu_draw_ms: Option<f64>,
    whole: Duration,
    cpu: Duration,
}

/// Indices of rows.
const FULL: usize = 1;
const FULL_NATIVE: usize = 2;
const BARE: usize = 3;
const BARE_NATIVE: usize = 4;

/// Measures for `duration` and prints the results.
pub(super) fn run(wall: Wall, size: FrameSize, duration: Duration, is_json: bool) -> anyhow::Result<()> {
    let figures = measure(wall, size, duration)?;
    if is_json {
        say(serde_json::to_string_pretty(&figures).context("results are plain numbers")?)
    } else {
        say(figures.table())
    }
}

fn measure(wall: Wall, size: FrameSize, duration: Duration) -> anyhow::Result<DisplayTimings> {
    let wall_size @ [width, height] = wall.output_size();
    let mut headless = Headless::new(wall)?;
    let native = FrameSize::new(width, height)?;
    let blank = vec![u32::from_ne_bytes([0, 0, 0, 255]); size.n_samples() as usize];
    let (full, full_native) = (NoiseFrame::new(size), NoiseFrame::new(native));
    let bare = BareDraw::new(headless.gpu(), wall_size, size, &full.placed()?)?;
    let bare_native = BareDraw::new(headless.gpu(), wall_size, native, &full_native.placed()?)?;
    let pixels = vec![0x55_u32; native.n_samples() as usize];
    let mut copy = pixels.clone();
    let mut resizer = Resize::new(size, native, &full.placed()?)?;

    let names = [
        format!("blank frame, {size}"),
        format!("full frame, {size}"),
        format!("full frame, {native}"),
        format!("bare bilinear draw, {size}"),
        format!("bare bilinear draw, {native}"),
        "memcpy of the wall's pixels".to_owned(),
        format!("fast_image_resize, {size}"),
    ];
    let mut samples = vec![Vec::new(); names.len()];
    let started_at = Instant::now();
    let mut n_rounds = 0;
    while n_rounds < N_FIRST + FEWEST_ROUNDS || started_at.elapsed() < duration {
        for (index, samples) in samples.iter_mut().enumerate() {
            // A frame of another size needs another texture: create it before the measurement.
            match index {
                0 => drop(headless.upload_and_draw(size, &blank)?),
                FULL_NATIVE => drop(full_native.shown(&mut headless)?),
                _ => {}
            }
            let sample = timed(|| match index {
                0 => shown(&mut headless, size, &blank),
                FULL => full.shown(&mut headless),
                FULL_NATIVE => full_native.shown(&mut headless),
                BARE | BARE_NATIVE => {
                    let bare = if index == BARE { &bare } else { &bare_native };
                    Ok(Timing { draw: Some(bare.draw(headless.gpu())?), ..Timing::default() })
                }
                5 => {
                    copy.copy_from_slice(std::hint::black_box(&pixels));
                    std::hint::black_box(&copy);
                    Ok(Timing::default())
                }
                _ => resizer.resize().map(|()| Timing::default()),
            })?;
            if n_rounds >= N_FIRST {
                samples.push(sample);
            }
        }
        n_rounds += 1;
    }
    let rows: Vec<_> = names.into_iter().zip(&samples).map(|(what, samples)| DisplayRow::new(what, samples)).collect();
    Ok(DisplayTimings {
        adapter: headless.gpu().name(),
        wall: format!("{width}x{height}"),
        whole_over_bare: rows[FULL].whole_ms / rows[BARE].whole_ms,
        whole_over_bare_cpu: rows[FULL].cpu_ms / rows[BARE].cpu_ms,
        native_over_bare: rows[FULL_NATIVE].whole_ms / rows[BARE_NATIVE].whole_ms,
        native_over_bare_cpu: rows[FULL_NATIVE].cpu_ms / rows[BARE_NATIVE].cpu_ms,
        rows,
    })
}

/// Adds the elapsed and the CPU time of all of `act`.
fn timed(act: impl FnOnce() -> anyhow::Result<Timing>) -> anyhow::Result<Timing> {
    let (started_at, cpu) = (Instant::now(), ProcessTime::now());
    let sample = act()?;
    Ok(Timing { whole: started_at.elapsed(), cpu: cpu.elapsed(), ..sample })
}

fn shown(headless: &mut Headless, size: FrameSize, rgba: &[u32]) -> anyhow::Result<Timing> {
    let (upload, draw) = headless.upload_and_draw(size, rgba)?;
    Ok(Timing { upload: Some(upload), draw: Some(draw), gpu_draw_ms: headless.gpu_draw_ms(), ..Timing::default() })
}

/// A frame of noise, in the encoding of render servers.
struct NoiseFrame {
    size: FrameSize,
    rgb: Vec<u8>,
    placing: SamplePlacer,
}

impl NoiseFrame {
    fn new(size: FrameSize) -> Self {
        // Bytes that repeat would flatter caches.
        let mut random = Random::new(1);
        let rgb = (0..3 * size.n_samples()).map(|_| random.bits() as u8).collect();
        Self { size, rgb, placing: SamplePlacer::default() }
    }

    fn placed(&self) -> anyhow::Result<FrameSamples> {
        Ok(self.placing.place(self.size, Division::default(), &self.rgb, CHUNK_BYTES)?)
    }

    fn shown(&self, headless: &mut Headless) -> anyhow::Result<Timing> {
        let started_at = Instant::now();
        let samples = self.placed()?;
        let place = started_at.elapsed();
        Ok(Timing { place: Some(place), ..shown(headless, self.size, &samples)? })
    }
}

/// The same scaling on one CPU core.
struct Resize {
    resizer: Resizer,
    options: ResizeOptions,
    from: Image<'static>,
    to: Image<'static>,
}

impl Resize {
    fn new(from: FrameSize, to: FrameSize, rgba: &[u32]) -> anyhow::Result<Self> {
        let bytes = bytemuck::cast_slice(rgba).to_vec();
        Ok(Self {
            resizer: Resizer::new(),
            options: ResizeOptions::new().resize_alg(ResizeAlg::Interpolation(FilterType::Bilinear)).use_alpha(false),
            from: Image::from_vec_u8(from.xres(), from.yres(), bytes, PixelType::U8x4)?,
            to: Image::new(to.xres(), to.yres(), PixelType::U8x4),
        })
    }

    fn resize(&mut self) -> anyhow::Result<()> {
        Ok(self.resizer.resize(&self.from, &mut self.to, &self.options)?)
    }
}

impl DisplayRow {
    fn new(what: String, samples: &[Timing]) -> Self {
        let median_of = |of: &dyn Fn(&Timing) -> Option<f64>| {
            let values: Vec<f64> = samples.iter().filter_map(of).collect();
            (!values.is_empty()).then(|| median(values))
        };
        let part = |of: fn(&Timing) -> Option<Duration>| median_of(&|sample| of(sample).map(milliseconds));
        Self {
            what,
            place_ms: part(|sample| sample.place),
            upload_ms: part(|sample| sample.upload),
            draw_ms: part(|sample| sample.draw),
            gpu_draw_ms: median_of(&|sample| sample.gpu_draw_ms),
            whole_ms: part(|sample| Some(sample.whole)).unwrap_or(0.0),
            cpu_ms: part(|sample| Some(sample.cpu)).unwrap_or(0.0),
        }
    }
}

impl DisplayTimings {
    /// The results as text.
    fn table(&self) -> String {
        let Self { adapter, wall, rows, .. } = self;
        let mut table = format!("a wall of {wall} pixels, drawn by {adapter}; medians in ms\n");
        // Writing to a string cannot fail.
        let _ = writeln!(
            table,
            "{:<36}{:>9}{:>9}{:>9}{:>10}{:>9}{:>9}",
            "", "place", "upload", "draw", "GPU draw", "whole", "CPU"
        );
        for row in rows {
            let _ = write!(table, "{:<36}", row.what);
            for (figure, width) in [(row.place_ms, 9), (row.upload_ms, 9), (row.draw_ms, 9), (row.gpu_draw_ms, 10)] {
                let text = figure.map_or_else(String::new, |ms| format!("{ms:.2}"));
                let _ = write!(table, "{text:>width$}");
            }
            let _ = writeln!(table, "{:>9.2}{:>9.2}", row.whole_ms, row.cpu_ms);
        }
        for (row, over_bare, over_bare_cpu) in [
            (FULL, self.whole_over_bare, self.whole_over_bare_cpu),
            (FULL_NATIVE, self.native_over_bare, self.native_over_bare_cpu),
        ] {
            let what = &rows[row].what;
            let _ =
                writeln!(table, "{what}, relative to the bare draw: {over_bare:.2}; in CPU time: {over_bare_cpu:.2}");
        }
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
        let figures = match measure(wall.clone(), size, Duration::ZERO) {
            Ok(figures) => figures,
            Err(error) if error.to_string().contains("no graphics driver") => return println!("skipped: {error}"),
            Err(error) => panic!("{error}"),
        };
        assert_eq!(figures.rows.len(), 7);
        assert!(figures.rows.iter().all(|row| row.whole_ms > 0.0), "{figures:?}");
        assert!(figures.rows[FULL].place_ms.is_some() && figures.rows[BARE].draw_ms.is_some());
        assert!(figures.table().contains("fast_image_resize, 32x16"));

        // Bare draw and wall draw the same picture.
        let mut headless = Headless::new(wall).unwrap();
        let full = NoiseFrame::new(size);
        let samples = full.placed().unwrap();
        let bare = BareDraw::new(headless.gpu(), [64, 36], size, &samples).unwrap();
        bare.draw(headless.gpu()).unwrap();
        let bare = bare.read(headless.gpu()).unwrap();
        headless.upload_and_draw(size, &samples).unwrap();
        let wall = headless.image().unwrap();
        let differs = |(a, b): (&u8, &u8)| a.abs_diff(*b) > 2;
        assert_eq!(bare.rgb.len(), 3 * 64 * 36);
        assert_eq!(bare.rgb.iter().zip(&wall.rgb).filter(|&pair| differs(pair)).count(), 0);
    }
}
