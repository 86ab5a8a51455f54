//! Compares pictures whose tiles stop at a noise with pictures whose pixels all get equally many samples.
//!
//!     cargo run --release -p lab --example path_noise -- --model dragon.ply --rays path
//!
//! Both are compared with a picture of other samples. Errors are roots of mean squares over the pixels that show the model: of
//! the light that a display shows, in levels of 255, and of linear light before exposure and tone mapping, in thousandths.
//! Parts are those of the samples that a uniform picture of the same error takes, which is interpolated: for the whole
//! picture, and for the pixels that show the model alone. The least part is that of samples in proportion to each tile's error,
//! which nobody knows beforehand, where the square of the error falls as the number of samples rises.

use clap::Parser;
use glam::Vec3;
use lab::light::{first_sample, render_lights};
use renderer::{
    cli::picture_args::PictureArgs,
    model::scene::LoadedMesh,
    render::{
        lighting::{LightSums, Lighting},
        scene::Scene,
    },
};
use shared::{
    division::{Division, FrameSize},
    noise::NoiseLimit,
    protocol::{FrameSpec, SampleRange},
};

/// The picture, and what to compare.
#[derive(Parser)]
struct Args {
    #[command(flatten)]
    picture: PictureArgs,

    /// Noise limits of the adaptive pictures, in levels
    #[arg(long, value_delimiter = ',', default_value = "2,1.5,1,0.5,0.25")]
    noise: Vec<NoiseLimit>,

    /// Samples of each pixel of the uniform pictures
    #[arg(long, value_delimiter = ',', default_value = "8,16,32,64,128,256")]
    uniform: Vec<u32>,

    /// Samples of each pixel of the reference
    #[arg(long, default_value_t = 1024)]
    reference: u32,
}

/// A picture's pixels: light as a display shows it in levels, linear light in thousandths, and the number of samples.
struct Picture {
    pixels: Vec<([Vec3; 2], u32)>,
    cpu_s: f64,
}

/// Of a picture: samples of a pixel and of one that shows the model, the errors, and of a uniform picture's samples the least
/// part with which tiles of any numbers have its errors.
struct Outcome {
    n_samples: [f64; 2],
    errors: [f64; 2],
    least_parts: [f64; 2],
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    args.picture.pool()?.install(|| run(&args))
}

fn run(args: &Args) -> anyhow::Result<()> {
    let camera = args.picture.read_camera()?;
    let LoadedMesh { id, mesh, .. } = args.picture.model.load()?;
    let spec = args.picture.spec(id, camera.unwrap_or_else(|| args.picture.view_all(&mesh.shape())));
    let scene = args.picture.build(mesh);
    let render = |samples: SampleRange| render(&scene, &FrameSpec { samples, ..spec });

    let reference = mean_of(args.reference, render);
    // Pixels without noise are background.
    let first = render(SampleRange::CENTRE).pixels;
    let is_seen: Vec<bool> = first.iter().zip(&reference).map(|((light, _), mean)| light != mean).collect();
    let n_seen = is_seen.iter().filter(|&&is_seen| is_seen).count() as f64;
    let outcome = |Picture { pixels, .. }: &Picture| {
        let seen =
            || pixels.iter().zip(&reference).zip(&is_seen).filter(|(_, is_seen)| **is_seen).map(|(pixel, _)| pixel);
        let error = |kind: usize| {
            let squares = seen().map(|((light, _), mean)| f64::from((light[kind] - mean[kind]).length_squared()));
            (squares.sum::<f64>() / (3.0 * n_seen)).sqrt()
        };
        let of_seen = seen().map(|((_, n), _)| f64::from(*n)).sum::<f64>() / n_seen;
        let of_all = pixels.iter().map(|&(_, n)| f64::from(n)).sum::<f64>() / pixels.len() as f64;
        Outcome {
            n_samples: [of_all, of_seen],
            errors: [error(0), error(1)],
            least_parts: [0, 1].map(|kind| least_part(pixels, &reference, kind, spec.size)),
        }
    };

    println!("{:.1} % of the pixels show the model", 100.0 * n_seen / reference.len() as f64);
    println!(
        "uniform: samples, error shown, error of linear light, s of CPU time, least parts shown and of linear light"
    );
    let mut uniform = Vec::new();
    for &count in &args.uniform {
        let picture = render(SampleRange::all(0, count));
        let outcome = outcome(&picture);
        let ([shown, linear], least) = (outcome.errors, outcome.least_parts);
        let cpu_s = picture.cpu_s;
        println!("  {count:8} {shown:8.3} {linear:8.3} {cpu_s:8.2} {:8.2} {:8.2}", least[0], least[1]);
        uniform.push(outcome);
    }
    println!(
        "adaptive: limit, samples of a pixel, of one that shows the model, error shown, error of linear light, s of CPU time, \
         parts of the whole picture at equal error shown and of linear light, parts of the model"
    );
    for &noise in &args.noise {
        let picture = render(SampleRange { noise, ..SampleRange::all(0, SampleRange::LARGEST_COUNT) });
        let Outcome { n_samples, errors, .. } = outcome(&picture);
        let [all, seen] = n_samples.map(|n| [0, 1].map(|kind| n / uniform_of(&uniform, kind, errors[kind])));
        println!(
            "  {noise:8} {:8.1} {:8.1} {:8.3} {:8.3} {:8.2} {:8.2} {:8.2} {:8.2} {:8.2}",
            n_samples[0], n_samples[1], errors[0], errors[1], picture.cpu_s, all[0], all[1], seen[0], seen[1]
        );
    }
    Ok(())
}

/// The mean light of pictures of other samples, of several frames, as these have a limited number.
fn mean_of(n_samples: u32, render: impl Fn(SampleRange) -> Picture) -> Vec<[Vec3; 2]> {
    let count = n_samples.min(SampleRange::LARGEST_COUNT);
    let n_frames = n_samples.div_ceil(count);
    let pictures = (0..n_frames).map(|frame| render(SampleRange::all(first_sample(0, frame, count), count)).pixels);
    let add = |mut sums: Vec<([Vec3; 2], u32)>, pixels: Vec<([Vec3; 2], u32)>| {
        sums.iter_mut().zip(pixels).for_each(|((sum, _), (light, _))| (0..2).for_each(|kind| sum[kind] += light[kind]));
        sums
    };
    let sums = pictures.reduce(add).unwrap_or_default();
    sums.into_iter().map(|(sum, _)| sum.map(|sum| sum / n_frames as f32)).collect()
}

/// The part of a uniform picture's samples that it takes, for the same error, if each tile's are in proportion to its own error.
fn least_part(pixels: &[([Vec3; 2], u32)], reference: &[[Vec3; 2]], kind: usize, size: FrameSize) -> f64 {
    let (mut sum, mut sum_of_squares) = (0.0, 0.0);
    let tiles = Division::Tiled.task(0, 1).share(size).expect("one machine renders any frame");
    for tile in 0..tiles.count() {
        let samples = tiles.samples(tile);
        let squared_error = |(i, j): (u32, u32)| {
            let at = (j * size.xres() + i) as usize;
            f64::from((pixels[at].0[kind] - reference[at][kind]).length_squared())
        };
        let n = f64::from(samples.count());
        let of_tile = samples.iter().map(squared_error).sum::<f64>();
        sum += (n * of_tile).sqrt();
        sum_of_squares += of_tile;
    }
    sum * sum / (f64::from(size.n_samples()) * sum_of_squares)
}

/// Samples of each pixel of a uniform picture with this error, between those that were measured or beyond the last.
fn uniform_of(measured: &[Outcome], kind: usize, error: f64) -> f64 {
    let at = measured.iter().position(|other| other.errors[kind] < error).unwrap_or(measured.len() - 1).max(1);
    let [(n0, e0), (n1, e1)] = [at - 1, at].map(|at| (measured[at].n_samples[0], measured[at].errors[kind]));
    n0 * (n1 / n0).powf((error / e0).ln() / (e1 / e0).ln())
}

fn render(scene: &Scene, spec: &FrameSpec) -> Picture {
    let of_pixel = |lighting: &Lighting<'_>, sums: &LightSums, (block, index): (usize, usize)| {
        let shown = Vec3::from_array(lighting.encode(sums, (block, index)).map(f32::from));
        ([shown, sums.lights[block][index] * (1000.0 / sums.n_samples as f32)], sums.n_samples)
    };
    let (pixels, cpu) = render_lights(scene, spec, of_pixel);
    Picture { pixels, cpu_s: cpu.as_secs_f64() }
}
