//! Cost and error of light: rays from the eye alone, with shadows, with ambient occlusion, and paths, beside many paths.

use anyhow::Result;
use glam::DVec3;
use renderer::render::scene::Scene;
use serde::Serialize;
use shared::{
    appearance::{Appearance, Background},
    camera::Camera,
    division::FrameSize,
    noise::NoiseLimit,
    protocol::{FrameSpec, LightingMode, SampleRange},
    scene::SceneId,
    srgb,
};

use super::{
    peers::Peer,
    picture::{distinct, flip},
};
use crate::{
    farm::frame_spec,
    light::{first_sample, render_lights},
    plot::{Axis, COLORS, Figure, Mark, Plot, Point, Series, significant},
    statistics::{mean, median, milliseconds},
};

pub(super) struct Settings {
    pub(super) size: FrameSize,
    /// Paths of each pixel of the reference, a multiple of [`SampleRange::LARGEST_COUNT`].
    pub(super) n_reference_paths: u32,
    /// Samples a pixel of rays that miss a part of the light: more would not help.
    pub(super) samples: Vec<u32>,
    /// Paths a pixel.
    pub(super) paths: Vec<u32>,
    /// Where pixels of adaptive pictures stop.
    pub(super) noise: Vec<NoiseLimit>,
}

impl Settings {
    /// Those of a quick run, or of a thorough one.
    pub(super) fn new(size: Option<FrameSize>, is_quick: bool) -> Result<Self> {
        let size = size.map_or_else(|| FrameSize::new(256, if is_quick { 128 } else { 144 }), Ok)?;
        let noise = ["8", "4", "2"].map(str::parse).into_iter().collect::<Result<_, _>>()?;
        let (n_reference_paths, largest, most_paths) = if is_quick { (256, 4, 16) } else { (1024, 16, 128) };
        let powers = |most: u32| (0..=most.ilog2()).map(|log| 1 << log).collect();
        let (samples, paths) = (powers(largest), powers(most_paths));
        Ok(Self { size, n_reference_paths, samples, paths, noise })
    }
}

/// One kind of rays and number of samples with one camera: a line of the table.
#[derive(Clone, Debug, Serialize)]
pub(super) struct LightRow {
    camera: String,
    rays: String,
    /// Samples a pixel, or the noise in levels at which pixels stop.
    setting: String,
    /// Samples of the mean pixel.
    samples: f64,
    /// Tracing and shading, all threads together.
    cpu_ms: f64,
    /// Root of the mean square error of linear light, over channels and the pixels that show the model; 1 is white.
    light_rmse: f64,
    /// Mean FLIP difference, 0 to 1.
    flip: f64,
}

/// A picture's linear light, row by row from the bottom, its samples, and its CPU time.
struct Picture {
    lights: Vec<DVec3>,
    n_samples: f64,
    cpu_ms: f64,
}

/// Measures all settings with one camera. `done` gets each row, and the fraction done.
pub(super) fn measure(
    scene: &Scene,
    (name, camera): (&str, &Camera),
    settings: &Settings,
    mut done: impl FnMut(Option<LightRow>, f32) -> Result<()>,
) -> Result<()> {
    let size = settings.size;
    let render = |rays, samples| render(scene, (camera, size), rays, samples);

    // Frames have a limited number of samples.
    let frames = settings.n_reference_paths / SampleRange::LARGEST_COUNT;
    let mut truth = vec![DVec3::ZERO; size.n_samples() as usize];
    for frame in 0..frames {
        let first = first_sample(0, frame, SampleRange::LARGEST_COUNT);
        let picture = render(LightingMode::Path, SampleRange::all(first, SampleRange::LARGEST_COUNT));
        truth.iter_mut().zip(picture.lights).for_each(|(sum, light)| *sum += light / f64::from(frames));
        done(None, 0.5 * (frame + 1) as f32 / frames as f32)?;
    }
    let encoded_truth = encode(&truth);

    let others = [LightingMode::Primary, LightingMode::Shadows, LightingMode::AmbientOcclusion];
    let kinds = others.map(|rays| (rays, &settings.samples)).into_iter().chain([(LightingMode::Path, &settings.paths)]);
    let counted = kinds.flat_map(|(rays, counts)| counts.iter().map(move |&n| (rays, SampleRange::all(0, n))));
    let adaptive = settings
        .noise
        .iter()
        .map(|&noise| (LightingMode::Path, SampleRange { noise, ..SampleRange::all(0, SampleRange::LARGEST_COUNT) }));
    let pictures: Vec<_> = counted.chain(adaptive).collect();
    for (index, &(rays, samples)) in pictures.iter().enumerate() {
        // One time of a short picture is too noisy.
        let n_repeats = if samples.count <= 4 { 3 } else { 1 };
        let times: Vec<_> = (1..n_repeats).map(|_| render(rays, samples).cpu_ms).collect();
        let picture = render(rays, samples);
        let row = LightRow {
            camera: name.to_owned(),
            rays: series_name(rays, samples.noise),
            setting: if samples.noise == NoiseLimit::NONE {
                samples.count.to_string()
            } else {
                samples.noise.to_string()
            },
            samples: picture.n_samples,
            cpu_ms: median(times.into_iter().chain([picture.cpu_ms])),
            light_rmse: rmse(&truth, &picture.lights),
            flip: flip(&encoded_truth, &encode(&picture.lights), size),
        };
        done(Some(row), 0.5 + 0.5 * (index + 1) as f32 / pictures.len() as f32)?;
    }
    Ok(())
}

fn series_name(rays: LightingMode, noise: NoiseLimit) -> String {
    match rays {
        LightingMode::Path if noise != NoiseLimit::NONE => "path, until a noise".to_owned(),
        rays => rays.to_string(),
    }
}

/// Before black, so that whatever hits nothing adds no light.
fn render(scene: &Scene, (camera, size): (&Camera, FrameSize), rays: LightingMode, samples: SampleRange) -> Picture {
    let appearance = Appearance { background: Background::plain([0; 3]), ..Appearance::default() };
    let of_model = frame_spec(SceneId::Statue { triangles: 0, treatment: Default::default() }, *camera, size);
    let spec = FrameSpec { rays, samples, appearance, ..of_model };
    let (pixels, cpu) = render_lights(scene, &spec, |_, sums, (block, index)| {
        (sums.lights[block][index].as_dvec3() / f64::from(sums.n_samples), f64::from(sums.n_samples))
    });
    let (lights, n_samples): (Vec<_>, Vec<_>) = pixels.into_iter().unzip();
    Picture { lights, n_samples: mean(n_samples), cpu_ms: milliseconds(cpu) }
}

/// Over the pixels that have light in truth.
fn rmse(truth: &[DVec3], lights: &[DVec3]) -> f64 {
    let lit = truth.iter().zip(lights).filter(|(truth, _)| **truth != DVec3::ZERO);
    (mean(lit.map(|(truth, light)| (*truth - *light).length_squared())) / 3.0).sqrt()
}

fn encode(lights: &[DVec3]) -> Vec<u8> {
    lights.iter().flat_map(|light| light.as_vec3().to_array().map(srgb::encode)).collect()
}

/// The chart: means over all cameras.
pub(super) fn figure(title: String, notes: Vec<String>, rows: &[LightRow], peers: &[Peer]) -> Figure {
    let rmse = plot(rows, "RMSE of linear light", |row| row.light_rmse, of_peers(peers));
    let flip = plot(rows, "mean FLIP difference", |row| row.flip, Vec::new());
    Figure { title, notes, rows: vec![(560, vec![rmse]), (560, vec![flip])] }
}

/// A line for each ray tracer, in the colours that our own leave.
fn of_peers(peers: &[Peer]) -> Vec<Series> {
    let point = |peer: &Peer| {
        let label = peer.samples.map_or_else(String::new, |n| n.to_string());
        Some(Point { label, ..Point::new(peer.cpu_ms?.log10() - 3.0, peer.light_rmse?.log10()) })
    };
    let names = distinct(peers.iter().map(|peer| &*peer.name)).into_iter();
    let series = names.zip(COLORS.into_iter().rev().cycle()).map(|(name, color)| {
        let points = peers.iter().filter(|peer| peer.name == name).filter_map(point).collect();
        Series { name: name.to_owned(), color, mark: Mark::Circle, is_joined: true, points }
    });
    series.filter(|series| !series.points.is_empty()).collect()
}

fn plot(rows: &[LightRow], title: &'static str, value: impl Fn(&LightRow) -> f64, of_peers: Vec<Series>) -> Plot {
    let series = distinct(rows.iter().map(|row| &*row.rays)).into_iter().zip(COLORS).map(|(name, color)| {
        let of_series = || rows.iter().filter(|row| row.rays == name);
        let point = |setting: &str| {
            let of_setting = || of_series().filter(|row| row.setting == setting);
            let cpu_s = mean(of_setting().map(|row| (row.cpu_ms / 1e3).log10()));
            let value = mean(of_setting().map(|row| value(row).max(1e-9).log10()));
            Point { label: setting.to_owned(), ..Point::new(cpu_s, value) }
        };
        let points = distinct(of_series().map(|row| &*row.setting)).into_iter().map(point).collect();
        Series { name: name.to_owned(), color, mark: Mark::Disc, is_joined: true, points }
    });
    Plot {
        title: "labels: samples a pixel, or the noise at which pixels stop".to_owned(),
        x: Axis { title: "CPU seconds per picture", label: significant, range: None },
        y: Axis { title, label: significant, range: None },
        series: series.chain(of_peers).collect(),
    }
    .with_front()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_count_where_the_truth_has_light() {
        let truth = [DVec3::ONE, DVec3::ZERO, DVec3::splat(0.5)];
        let lights = [DVec3::new(0.9, 1.0, 1.0), DVec3::ONE, DVec3::splat(0.5)];
        assert!((rmse(&truth, &lights) - (0.01f64 / 6.0).sqrt()).abs() < 1e-12);
        assert_eq!(rmse(&truth, &truth), 0.0);
    }
}
