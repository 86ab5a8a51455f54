//! Cost and sharpness of the wall's picture by resolution, samples and scaling.

use anyhow::Result;
use nv_flip::{DEFAULT_PIXELS_PER_DEGREE, FlipImageRgb8, FlipPool};
use rayon::prelude::*;
use renderer::render::scene::Scene;
use serde::Serialize;
use shared::{
    camera::Camera,
    division::FrameSize,
    protocol::{FrameSpec, SampleRange},
    scene::SceneId,
    srgb,
};

use super::peers::{self, Peer};
use crate::{
    farm::frame_spec,
    plot::{Axis, COLORS, Figure, Mark, Plot, Point, Series, significant},
    statistics::{mean, median, milliseconds},
};

pub(super) struct Settings {
    pub(super) native: FrameSize,
    /// Samples a pixel of the reference picture.
    pub(super) n_reference_samples: u32,
    /// Resolutions of frames, the native one last.
    pub(super) sizes: Vec<FrameSize>,
    pub(super) samples: Vec<u32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Scaling {
    Nearest,
    /// In linear light, as on the wall.
    Bilinear,
}

/// One resolution, number of samples and scaling with one camera: a line of the table.
#[derive(Clone, Debug, Serialize)]
pub(super) struct PictureRow {
    camera: String,
    size: String,
    samples: u32,
    scaling: Scaling,
    /// Tracing and shading, all threads together.
    cpu_ms: f64,
    /// Mean FLIP difference, 0 to 1.
    flip: f64,
    /// In decibels; infinite for equal pictures.
    psnr: f64,
}

/// First sample of the reference: frames and reference have no sample in common.
pub(crate) const FIRST_REFERENCE_SAMPLE: u32 = 1 << 20;

/// Measures all settings with one camera. `done` gets each row, and the fraction done.
pub(super) fn measure(
    scene: &Scene,
    (name, camera): (&str, &Camera),
    settings: &Settings,
    mut done: impl FnMut(Option<PictureRow>, f32) -> Result<()>,
) -> Result<()> {
    let native = settings.native;
    let range = SampleRange::all(FIRST_REFERENCE_SAMPLE, settings.n_reference_samples);
    // Progress counts rays; a comparison costs about as much as some rays a pixel.
    let rays = |size: FrameSize, n_samples: u32| f64::from(size.n_samples()) * f64::from(n_samples);
    let comparison = rays(native, 8);
    let n_scalings = |size: FrameSize| if size == native { 1.0 } else { 2.0 };
    let cost = |size: FrameSize, n_samples: u32| rays(size, n_samples) + comparison * n_scalings(size);
    let settings = || settings.sizes.iter().flat_map(|&size| settings.samples.iter().map(move |&n| (size, n)));
    let of_reference = rays(native, range.count);
    let total = of_reference + settings().map(|(size, n_samples)| cost(size, n_samples)).sum::<f64>();

    let (reference, _) = render(scene, camera, native, range);
    let mut n_done = of_reference;
    done(None, (n_done / total) as f32)?;
    for (size, n_samples) in settings() {
        let samples = SampleRange::all(0, n_samples);
        // One time of a small frame is too noisy.
        let n_repeats = if rays(size, n_samples) < 4e6 { 3 } else { 1 };
        let (mut rgb, mut times) = (Vec::new(), Vec::new());
        for _ in 0..n_repeats {
            let (frame, cpu_ms) = render(scene, camera, size, samples);
            times.push(cpu_ms);
            rgb = frame;
        }
        let cpu_ms = median(times);
        let scalings: &[_] = if size == native { &[Scaling::Nearest] } else { &[Scaling::Nearest, Scaling::Bilinear] };
        n_done += cost(size, n_samples);
        for &scaling in scalings {
            let scaled = scale(&rgb, size, native, scaling);
            let (flip, psnr) = (flip(&reference, &scaled, native), psnr(&reference, &scaled));
            let (camera, size) = (name.to_owned(), size.to_string());
            let row = PictureRow { camera, size, samples: n_samples, scaling, cpu_ms, flip, psnr };
            done(Some(row), (n_done / total) as f32)?;
        }
    }
    Ok(())
}

/// A frame row by row from the bottom, and the CPU milliseconds of all threads.
fn render(scene: &Scene, camera: &Camera, size: FrameSize, samples: SampleRange) -> (Vec<u8>, f64) {
    let spec = FrameSpec {
        samples,
        ..frame_spec(SceneId::Statue { triangles: 0, treatment: Default::default() }, *camera, size)
    };
    let (rgb, cpu) = scene.render_frame(&spec);
    (rgb, milliseconds(cpu))
}

fn scale(rgb: &[u8], from: FrameSize, to: FrameSize, scaling: Scaling) -> Vec<u8> {
    let (xres, yres) = (from.xres() as usize, from.yres() as usize);
    let linear: Vec<f32> = rgb.iter().map(|&byte| srgb::decode(byte)).collect();
    let at = |i: usize, j: usize| 3 * (j.min(yres - 1) * xres + i.min(xres - 1));
    // Nearest sample, lower neighbour, and the fraction of the way to the next.
    let position = |pixel: usize, n_pixels: u32, n: usize| {
        let centre = (pixel as f32 + 0.5) * n as f32 / n_pixels as f32;
        let beyond = (centre - 0.5).max(0.0);
        (centre as usize, beyond as usize, beyond.fract())
    };
    let mut out = vec![0; 3 * to.n_samples() as usize];
    out.par_chunks_mut(3 * to.xres() as usize).enumerate().for_each(|(y, row)| {
        let (nearest_j, j, part_j) = position(y, to.yres(), yres);
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let (nearest_i, i, part_i) = position(x, to.xres(), xres);
            match scaling {
                Scaling::Nearest => {
                    let at = at(nearest_i, nearest_j);
                    pixel.copy_from_slice(&rgb[at..at + 3]);
                }
                Scaling::Bilinear => {
                    let corners = [at(i, j), at(i + 1, j), at(i, j + 1), at(i + 1, j + 1)];
                    for (channel, byte) in pixel.iter_mut().enumerate() {
                        let [a, b, c, d] = corners.map(|corner| linear[corner + channel]);
                        let (low, high) = (a + (b - a) * part_i, c + (d - c) * part_i);
                        *byte = srgb::encode(low + (high - low) * part_j);
                    }
                }
            }
        }
    });
    out
}

/// The mean FLIP difference: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images" (2020).
pub(super) fn flip(reference: &[u8], picture: &[u8], size: FrameSize) -> f64 {
    let image = |rgb: &[u8]| FlipImageRgb8::with_data(size.xres(), size.yres(), rgb);
    let errors = nv_flip::flip(image(reference), image(picture), DEFAULT_PIXELS_PER_DEGREE);
    f64::from(FlipPool::from_image(&errors).mean())
}

/// In decibels; infinite for equal pictures.
pub(crate) fn psnr(reference: &[u8], picture: &[u8]) -> f64 {
    let squares = reference.iter().zip(picture).map(|(&a, &b)| u64::from(a.abs_diff(b)).pow(2));
    let mean = squares.sum::<u64>() as f64 / reference.len() as f64;
    10.0 * (255.0 * 255.0 / mean).log10()
}

/// The chart: means over all cameras.
pub(super) fn figure(title: String, notes: Vec<String>, rows: &[PictureRow], peers: &[Peer]) -> Figure {
    let of_flip = peers::series(peers, |peer| Some((peer.cpu_ms?.log10(), peer.flip?.log10())));
    let of_psnr = peers::series(peers, |peer| Some((peer.cpu_ms?.log10(), -peer.psnr?)));
    let title_of_flip = "mean FLIP difference from the reference";
    let flip = plot(rows, title_of_flip, significant, |row| row.flip.max(1e-6).log10(), of_flip);
    // Negated, so that down is better.
    let psnr = plot(rows, "PSNR in dB", |decibels| format!("{:.0}", -decibels), |row| -row.psnr.min(99.0), of_psnr);
    Figure { title, notes, rows: vec![(560, vec![flip]), (560, vec![psnr])] }
}

/// The different ones, in the order of their first.
pub(super) fn distinct<'a>(values: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut distinct = Vec::new();
    for value in values {
        if !distinct.contains(&value) {
            distinct.push(value);
        }
    }
    distinct
}

fn plot(
    rows: &[PictureRow],
    title: &'static str,
    label: fn(f64) -> String,
    value: impl Fn(&PictureRow) -> f64,
    of_peers: impl Iterator<Item = Series>,
) -> Plot {
    let sizes = distinct(rows.iter().map(|row| &*row.size));
    let names = sizes.iter().flat_map(|size| [(size, Scaling::Nearest), (size, Scaling::Bilinear)]);
    let series = names.filter_map(|(&size, scaling)| {
        let of_series = || rows.iter().filter(|row| row.size == size && row.scaling == scaling);
        let mut samples: Vec<_> = of_series().map(|row| row.samples).collect();
        samples.sort_unstable();
        samples.dedup();
        let point = |&n: &u32| {
            let mean = |value: &dyn Fn(&PictureRow) -> f64| mean(of_series().filter(|row| row.samples == n).map(value));
            Point { label: n.to_string(), ..Point::new(mean(&|row| row.cpu_ms.log10()), mean(&value)) }
        };
        let (scaling_name, mark) = match scaling {
            _ if Some(&size) == sizes.last() => ("native", Mark::Disc),
            Scaling::Nearest => ("nearest", Mark::Circle),
            Scaling::Bilinear => ("bilinear", Mark::Disc),
        };
        let color = COLORS[sizes.iter().position(|&other| other == size).unwrap_or(0) % COLORS.len()];
        let points: Vec<_> = samples.iter().map(point).collect();
        let name = format!("{size} {scaling_name}");
        (!points.is_empty()).then_some(Series { name, color, mark, is_joined: true, points })
    });
    Plot {
        title: "labels: samples a pixel; hollow points: scaled to the nearest sample; filled points: bilinearly"
            .to_owned(),
        x: Axis { title: "CPU ms per frame", label: significant, range: None },
        y: Axis { title, label, range: None },
        series: series.chain(of_peers).collect(),
    }
    .with_front()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(xres: u32, yres: u32) -> FrameSize {
        FrameSize::new(xres, yres).unwrap()
    }

    #[test]
    fn scaling_to_its_own_size_changes_nothing_and_bilinear_mixes_linear_light() {
        let rgb: Vec<u8> = (0..4 * 3 * 3).map(|n| (n * 37 % 256) as u8).collect();
        for scaling in [Scaling::Nearest, Scaling::Bilinear] {
            assert_eq!(scale(&rgb, size(4, 3), size(4, 3), scaling), rgb, "{scaling:?}");
        }
        let black_and_white = [[0; 3], [255; 3]].concat();
        let nearest = scale(&black_and_white, size(2, 1), size(4, 1), Scaling::Nearest);
        assert_eq!(nearest.iter().step_by(3).copied().collect::<Vec<_>>(), [0, 0, 255, 255]);
        let bilinear = scale(&black_and_white, size(2, 1), size(4, 1), Scaling::Bilinear);
        let expected = [0.0, 0.25, 0.75, 1.0].map(srgb::encode);
        assert_eq!(bilinear.iter().step_by(3).copied().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn differences_are_measured() {
        let grey = vec![100; 64 * 64 * 3];
        let other = vec![110; 64 * 64 * 3];
        assert_eq!((flip(&grey, &grey, size(64, 64)), psnr(&grey, &grey)), (0.0, f64::INFINITY));
        assert!((psnr(&grey, &other) - 28.13).abs() < 0.01, "20·log10(25.5)");
        assert!((0.005..0.3).contains(&flip(&grey, &other, size(64, 64))));
    }
}
