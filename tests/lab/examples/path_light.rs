//! Traces the paths of independent pictures, and writes their linear light with everything that another renderer needs to make
//! the same: `tests/lab/beside_mitsuba.py` does.
//!
//!     cargo run --release -p lab --example path_light -- --model dragon.ply --rays path --samples 64 --pictures 4 --out dragon.json
//!
//! Beside `dragon.json` lies `dragon.f32`, one picture after the other: red, green and blue of each pixel as little-endian `f32`,
//! row by row from the bottom, without the background.

use std::{io, path::PathBuf, time::Duration};

use anyhow::Context;
use channel::files;
use clap::Parser;
use glam::{DVec3, Vec3};
use lab::light::{first_sample, render_lights};
use renderer::{
    cli::picture_args::PictureArgs,
    model::scene::LoadedMesh,
    render::{
        path::{GROUND_LIGHT, SUN_LIGHT, ZENITH_LIGHT},
        scene::Scene,
        shade::CLAY,
    },
};
use shared::protocol::{FrameSpec, SampleRange};

/// The picture, its samples, how often it is made, and the file to write.
#[derive(Parser)]
struct Args {
    #[command(flatten)]
    picture: PictureArgs,

    /// Paths of each pixel
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=1 << 20))]
    samples: u32,

    /// Number of pictures
    #[arg(long, default_value_t = 1)]
    pictures: u32,

    /// Number of the first picture: those of other numbers are independent
    #[arg(long, default_value_t = 0)]
    first_picture: u32,

    /// The JSON file to write
    #[arg(long)]
    out: PathBuf,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    args.picture.pool()?.install(|| run(&args))
}

fn run(args: &Args) -> anyhow::Result<()> {
    let camera = args.picture.read_camera()?;
    let sky = args.picture.read_sky()?;
    let LoadedMesh { id, mesh, .. } = args.picture.model.load()?;
    let shape = mesh.shape();
    let mut spec = args.picture.spec(id, camera.unwrap_or_else(|| args.picture.view_all(&shape)));
    let mut scene = args.picture.build(mesh);
    args.picture.light(&mut spec, &mut scene, &shape, sky);

    let mut cpu_s = Vec::new();
    let pixels_file = args.out.with_extension("f32");
    files::write(&pixels_file, |out| {
        for picture in (args.first_picture..).take(args.pictures as usize) {
            let (light, cpu) = light_of_picture(&scene, &spec, args.samples, picture);
            cpu_s.push(cpu.as_secs_f64());
            out.write_all(
                light
                    .iter()
                    .map(|light| light.to_array().map(f32::to_le_bytes))
                    .collect::<Vec<_>>()
                    .as_flattened()
                    .as_flattened(),
            )?;
        }
        io::Result::Ok(())
    })
    .context("cannot write the pixels")?;

    let camera = spec.camera;
    let [right, up] = [camera.u(), camera.v()].map(DVec3::normalize);
    let to_light = spec.appearance.light.direction();
    let to_sun = (right * to_light.x + up * to_light.y + right.cross(up) * to_light.z).normalize();
    let report = serde_json::json!({
        "width": spec.size.xres(), "height": spec.size.yres(), "samples": args.samples, "cpu_s": cpu_s,
        "eye": camera.eye(), "ll": camera.ll(), "u": camera.u(), "v": camera.v(),
        "to_sun": to_sun, "sun_degrees": spec.appearance.path.sun_degrees(), "sun": SUN_LIGHT,
        "up": up, "zenith": ZENITH_LIGHT, "ground": GROUND_LIGHT,
        "albedo": CLAY, "bounces": spec.appearance.path.bounces(),
    });
    files::write(&args.out, |out| writeln!(out, "{report}")).context("cannot write the report")?;
    let (file, n, samples) = (args.out.display(), args.pictures, args.samples);
    println!("{file}: {n} pictures of {samples} samples a pixel, {:.2} s of CPU time", cpu_s.iter().sum::<f64>());
    Ok(())
}

/// The mean light of a picture's samples, row by row from the bottom, and its CPU time.
fn light_of_picture(scene: &Scene, spec: &FrameSpec, samples: u32, picture: u32) -> (Vec<Vec3>, Duration) {
    let mut sums = vec![DVec3::ZERO; spec.size.n_samples() as usize];
    let mut cpu = Duration::ZERO;
    // Frames have a limited number of samples.
    for (frame, start) in (0..samples).step_by(SampleRange::LARGEST_COUNT as usize).enumerate() {
        let count = (samples - start).min(SampleRange::LARGEST_COUNT);
        let samples = SampleRange::all(first_sample(picture, frame as u32, count), count);
        let spec = FrameSpec { samples, ..*spec };
        let (lights, cpu_of_frame) = render_lights(scene, &spec, |_, sums, (block, index)| sums.lights[block][index]);
        sums.iter_mut().zip(lights).for_each(|(sum, light)| *sum += light.as_dvec3());
        cpu += cpu_of_frame;
    }
    (sums.iter().map(|sum| (*sum / f64::from(samples)).as_vec3()).collect(), cpu)
}
