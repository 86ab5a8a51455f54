//! Compares pictures whose pixels stop at a noise with pictures whose pixels all get equally many samples.
//!
//!     cargo run --release -p lab --example path_noise -- --model dragon.ply --rays path
//!
//! Both are compared with a picture of other samples. Errors are roots of mean squares over the pixels that show the model: of
//! the light that a display shows, in levels of 255, and of linear light before exposure and tone mapping, in thousandths.
//! Parts are those of the samples that a uniform picture of the same error takes, which is interpolated: for the whole
//! picture, the same of its rays, and for the pixels that show the model alone. The least part is that of samples in proportion
//! to the standard deviation of each pixel, or square of pixels, which nobody knows beforehand, where the square of the error
//! falls as the number of samples rises.

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
    division::FrameSize,
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

/// A picture's pixels: light as a display shows it in levels, linear light in thousandths, the number of samples, and that of
/// their rays.
struct Picture {
    pixels: Vec<([Vec3; 2], [u32; 2])>,
    cpu_s: f64,
}

/// Of a picture: samples of a pixel, as many samples as take its rays if none is left out, samples of a pixel that shows the
/// model, and the errors.
struct Outcome {
    n_samples: [f64; 3],
    errors: [f64; 2],
}

/// The mean of independent pictures, the squares of each pixel's deviations from it, summed over channels and pictures, and the
/// number of rays that samples take.
#[derive(Default)]
struct Reference {
    means: Vec<[Vec3; 2]>,
    squares: Vec<[f64; 2]>,
    /// Of each pixel, for each of its samples.
    rays: Vec<f64>,
    n_pictures: u32,
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

    let reference = reference(args.reference, render);
    // Pixels without noise are background.
    let first = render(SampleRange::CENTRE).pixels;
    let is_seen: Vec<bool> = first.iter().zip(&reference.means).map(|((light, _), mean)| light != mean).collect();
    let n_seen = is_seen.iter().filter(|&&is_seen| is_seen).count() as f64;
    let outcome = |Picture { pixels, .. }: &Picture| {
        let of_seen = pixels.iter().zip(&reference.means).zip(&is_seen).filter(|(_, is_seen)| **is_seen);
        let seen: Vec<_> = of_seen.map(|(pixel, _)| pixel).collect();
        let error = |kind: usize| {
            let squares = seen.iter().map(|((light, _), mean)| f64::from((light[kind] - mean[kind]).length_squared()));
            (squares.sum::<f64>() / (3.0 * n_seen)).sqrt()
        };
        let of_seen = seen.iter().map(|((_, [n, _]), _)| f64::from(*n)).sum::<f64>() / n_seen;
        let of_all = pixels.iter().map(|&(_, [n, _])| f64::from(n)).sum::<f64>() / pixels.len() as f64;
        let n_rays = pixels.iter().map(|&(_, [_, n_rays])| f64::from(n_rays)).sum::<f64>();
        let of_rays = n_rays / reference.rays.iter().sum::<f64>();
        Outcome { n_samples: [of_all, of_rays, of_seen], errors: [error(0), error(1)] }
    };

    println!("{:.1} % of the pixels show the model", 100.0 * n_seen / is_seen.len() as f64);
    if reference.n_pictures > 1 {
        println!("least parts of samples shown and of linear light, and of rays, for squares of so many pixels a side");
        for side in [1, 2, 4, 8] {
            let [[shown, shown_rays], [linear, linear_rays]] =
                [0, 1].map(|kind| reference.least_parts(kind, side, spec.size));
            println!("  {side:8} {shown:8.2} {linear:8.2} {shown_rays:8.2} {linear_rays:8.2}");
        }
    }
    println!("uniform: samples, error shown, error of linear light, s of CPU time");
    let mut uniform = Vec::new();
    for &count in &args.uniform {
        let picture = render(SampleRange::all(0, count));
        let outcome = outcome(&picture);
        let [shown, linear] = outcome.errors;
        println!("  {count:8} {shown:8.3} {linear:8.3} {:8.2}", picture.cpu_s);
        uniform.push(outcome);
    }
    println!(
        "adaptive: limit, samples of a pixel, of one that shows the model, error shown, error of linear light, s of CPU time, \
         parts of the whole picture at equal error shown and of linear light, of its rays, of the model"
    );
    for &noise in &args.noise {
        let picture = render(SampleRange { noise, ..SampleRange::all(0, SampleRange::LARGEST_COUNT) });
        let Outcome { n_samples, errors } = outcome(&picture);
        print!(
            "  {noise:8} {:8.1} {:8.1} {:8.3} {:8.3} {:8.2}",
            n_samples[0], n_samples[2], errors[0], errors[1], picture.cpu_s
        );
        let parts = n_samples.map(|n| [0, 1].map(|kind| n / uniform_of(&uniform, kind, errors[kind])));
        parts.as_flattened().iter().for_each(|part| print!(" {part:8.2}"));
        println!();
    }
    Ok(())
}

/// The mean light of pictures of other samples, of several frames, as these have a limited number.
fn reference(n_samples: u32, render: impl Fn(SampleRange) -> Picture) -> Reference {
    let count = n_samples.min(SampleRange::LARGEST_COUNT);
    let mut reference = Reference::default();
    for frame in 0..n_samples.div_ceil(count) {
        reference.add(&render(SampleRange::all(first_sample(0, frame, count), count)));
    }
    reference
}

impl Reference {
    /// Adds a picture: Welford, "Note on a Method for Calculating Corrected Sums of Squares and Products" (1962).
    fn add(&mut self, picture: &Picture) {
        self.n_pictures += 1;
        self.means.resize(picture.pixels.len(), [Vec3::ZERO; 2]);
        self.squares.resize(picture.pixels.len(), [0.0; 2]);
        self.rays.resize(picture.pixels.len(), 0.0);
        for (rays, &(_, [n_samples, n_rays])) in self.rays.iter_mut().zip(&picture.pixels) {
            *rays += (f64::from(n_rays) / f64::from(n_samples) - *rays) / f64::from(self.n_pictures);
        }
        for ((mean, squares), (light, _)) in self.means.iter_mut().zip(&mut self.squares).zip(&picture.pixels) {
            for kind in 0..2 {
                let difference = light[kind] - mean[kind];
                mean[kind] += difference / self.n_pictures as f32;
                squares[kind] += f64::from(difference.dot(light[kind] - mean[kind]));
            }
        }
    }

    /// The parts of a uniform picture's samples, and of its rays, that a picture of the same error takes, if the samples of each
    /// square of pixels are in proportion to its standard deviation.
    fn least_parts(&self, kind: usize, side: u32, size: FrameSize) -> [f64; 2] {
        let (columns, rows) = (size.xres().div_ceil(side), size.yres().div_ceil(side));
        let mut squares = vec![[0.0; 3]; (columns * rows) as usize];
        for (at, (squared, rays)) in (0..).zip(self.squares.iter().zip(&self.rays)) {
            let (i, j) = (at % size.xres(), at / size.xres());
            let of_square = &mut squares[(j / side * columns + i / side) as usize];
            [squared[kind], 1.0, *rays].iter().zip(of_square).for_each(|(it, sum)| *sum += it);
        }
        let sum = |of: &dyn Fn(&[f64; 3]) -> f64| squares.iter().map(of).sum::<f64>();
        // The root of an estimated variance is too small, by a part of a quarter over its degrees of freedom.
        let too_small = 1.0 - 0.25 / f64::from((self.n_pictures - 1) * side * side);
        [1, 2].map(|cost| {
            let roots = sum(&|square| (square[0] * square[cost]).sqrt()) / too_small;
            roots * roots / (sum(&|square| square[0]) * sum(&|square| square[cost]))
        })
    }
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
        let linear = sums.lights[block][index] * (1000.0 / sums.n_samples as f32);
        ([shown, linear], [sums.n_samples, sums.n_rays((block, index))])
    };
    let (pixels, cpu) = render_lights(scene, spec, of_pixel);
    Picture { pixels, cpu_s: cpu.as_secs_f64() }
}
