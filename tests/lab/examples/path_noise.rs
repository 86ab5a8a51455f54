//! Compares pictures whose tiles stop at a noise with pictures whose pixels all get equally many samples.
//!
//!     cargo run --release -p lab --example path_noise -- --model dragon.ply --rays path
//!
//! Both are compared with a picture of other samples; the errors are roots of mean squares of encoded values, over the pixels
//! that show the model. The last column is the part of the samples that the adaptive picture takes for its error, beside a
//! uniform one of the same error, which is interpolated.

use clap::Parser;
use glam::Vec3;
use lab::light::render_lights;
use renderer::{
    cli::picture_args::PictureArgs,
    model::scene::LoadedMesh,
    render::{
        lighting::{LightSums, Lighting},
        scene::Scene,
    },
};
use shared::{
    noise::NoiseLimit,
    protocol::{FrameSpec, SampleRange},
};

/// The picture, and what to compare.
#[derive(Parser)]
struct Args {
    #[command(flatten)]
    picture: PictureArgs,

    /// Noise limits of the adaptive pictures, in levels
    #[arg(long, value_delimiter = ',', default_value = "4,2,1,0.5")]
    noise: Vec<NoiseLimit>,

    /// Samples of each pixel of the reference
    #[arg(long, default_value_t = 1024)]
    reference: u32,
}

/// A picture's encoded colours, and the samples of each pixel.
struct Picture {
    colors: Vec<[u8; 3]>,
    n_samples: Vec<u32>,
    cpu_s: f64,
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

    // The reference is the mean of several frames, as these have a limited number of samples.
    let count = args.reference.min(SampleRange::LARGEST_COUNT);
    let frames = args.reference.div_ceil(count);
    let mut sums = vec![Vec3::ZERO; spec.size.n_samples() as usize];
    for frame in 1..=frames {
        let colors = render(SampleRange::all(frame << 16, count)).colors;
        sums.iter_mut().zip(colors).for_each(|(sum, color)| *sum += Vec3::from_array(color.map(f32::from)));
    }
    let reference: Vec<Vec3> = sums.into_iter().map(|sum| sum / frames as f32).collect();
    // Pixels without noise are background.
    let first = render(SampleRange::CENTRE).colors;
    let is_seen: Vec<bool> = first.iter().zip(&reference).map(|(a, b)| a.map(f32::from) != b.to_array()).collect();
    let n_seen = is_seen.iter().filter(|&&is_seen| is_seen).count() as f64;
    let error = |picture: &Picture| {
        let of_seen = picture.colors.iter().zip(&reference).zip(&is_seen).filter(|(_, is_seen)| **is_seen);
        let squares =
            of_seen.map(|((color, truth), _)| (Vec3::from_array(color.map(f32::from)) - truth).length_squared());
        (squares.map(f64::from).sum::<f64>() / (3.0 * n_seen)).sqrt()
    };
    let mean = |picture: &Picture| {
        picture.n_samples.iter().map(|&n| f64::from(n)).sum::<f64>() / picture.n_samples.len() as f64
    };
    let of_seen = |picture: &Picture| {
        let seen = picture.n_samples.iter().zip(&is_seen).filter(|(_, is_seen)| **is_seen);
        seen.map(|(&n, _)| f64::from(n)).sum::<f64>() / n_seen
    };

    println!("{:.1} % of the pixels show the model", 100.0 * n_seen / reference.len() as f64);
    println!("uniform: samples, error, s of CPU time");
    let mut uniform = Vec::new();
    for count in (3..=8).map(|log| 1 << log) {
        let picture = render(SampleRange::all(0, count));
        uniform.push((f64::from(count), error(&picture)));
        println!("  {count:8} {:8.3} {:8.2}", error(&picture), picture.cpu_s);
    }
    println!(
        "adaptive: limit, samples of a pixel, of one that shows the model, error, s of CPU time, part of the samples"
    );
    for &noise in &args.noise {
        let picture = render(SampleRange { noise, ..SampleRange::all(0, SampleRange::LARGEST_COUNT) });
        let equal = uniform_of(&uniform, error(&picture));
        println!(
            "  {noise:8} {:8.1} {:8.1} {:8.3} {:8.2} {:8.2} {:8.2}",
            mean(&picture),
            of_seen(&picture),
            error(&picture),
            picture.cpu_s,
            mean(&picture) / equal,
            of_seen(&picture) / equal
        );
    }
    Ok(())
}

/// Samples of each pixel of a uniform picture with this error, between those that were measured or beyond the last.
fn uniform_of(measured: &[(f64, f64)], error: f64) -> f64 {
    let at = measured.iter().position(|&(_, other)| other < error).unwrap_or(measured.len() - 1).max(1);
    let [(n0, e0), (n1, e1)] = [measured[at - 1], measured[at]];
    n0 * (n1 / n0).powf((error / e0).ln() / (e1 / e0).ln())
}

fn render(scene: &Scene, spec: &FrameSpec) -> Picture {
    let of_pixel = |lighting: &Lighting<'_>, sums: &LightSums, pixel| (lighting.encode(sums, pixel), sums.n_samples);
    let (pixels, cpu) = render_lights(scene, spec, of_pixel);
    let (colors, n_samples) = pixels.into_iter().unzip();
    Picture { colors, n_samples, cpu_s: cpu.as_secs_f64() }
}
