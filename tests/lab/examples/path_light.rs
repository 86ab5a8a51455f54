//! Traces the paths of one picture, and writes its linear light with everything that another renderer needs to make the same:
//! `tests/lab/beside_mitsuba.py` does.
//!
//!     cargo run --release -p lab --example path_light -- --model dragon.ply --rays path --samples 64 --out dragon.json
//!
//! Beside `dragon.json` lies `dragon.f32`: red, green and blue of each pixel as little-endian `f32`, row by row from the bottom,
//! without the background.

use std::path::PathBuf;

use anyhow::Context;
use channel::files;
use clap::Parser;
use glam::DVec3;
use renderer::{
    cli::picture_args::PictureArgs,
    model::scene::LoadedMesh,
    render::{
        parallel::work_off,
        path::{GROUND_LIGHT, SUN_LIGHT, ZENITH_LIGHT},
        scene::Scene,
        shade::CLAY,
    },
};
use shared::{
    division::Division,
    protocol::{FrameSpec, SampleRange},
};

/// The picture, its samples, and the file to write.
#[derive(Parser)]
struct Args {
    #[command(flatten)]
    picture: PictureArgs,

    /// Paths of each pixel
    #[arg(long, default_value_t = 64)]
    samples: u32,

    /// Number of the first: pictures of other samples are independent, and even at multiples of a power of two
    #[arg(long, default_value_t = 4096)]
    first: u32,

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

    // Frames have a limited number of samples.
    let mut sums = vec![DVec3::ZERO; spec.size.n_samples() as usize];
    let mut cpu_s = 0.0;
    let end = args.first + args.samples;
    for first in (args.first..end).step_by(SampleRange::LARGEST_COUNT as usize) {
        let samples = SampleRange { first, count: (end - first).min(SampleRange::LARGEST_COUNT) };
        cpu_s += add_lights(&scene, &FrameSpec { samples, ..spec }, &mut sums);
    }
    let mean = |sum: &DVec3| (*sum / f64::from(args.samples)).as_vec3().to_array().map(f32::to_le_bytes);
    let pixels: Vec<u8> = sums.iter().map(mean).collect::<Vec<_>>().as_flattened().as_flattened().to_vec();

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
    let pixels_file = args.out.with_extension("f32");
    files::write(&pixels_file, |out| out.write_all(&pixels)).context("cannot write the pixels")?;
    files::write(&args.out, |out| writeln!(out, "{report}")).context("cannot write the report")?;
    println!("{}: {} samples a pixel, {cpu_s:.2} s of CPU time", args.out.display(), args.samples);
    Ok(())
}

/// Adds the light of a frame's samples to `sums`, on the current rayon pool; returns the CPU time of all threads.
fn add_lights(scene: &Scene, spec: &FrameSpec, sums: &mut [DVec3]) -> f64 {
    let share = Division::Tiled.task(0, 1).share(spec.size).expect("one machine renders any frame");
    let of_threads = work_off(0..share.count(), |next| {
        let mut lights = Vec::new();
        for tile in std::iter::from_fn(next) {
            let pixels: Vec<_> = share.samples(tile).iter().collect();
            scene.sum_lights(spec, &share, tile..tile + 1, |_, sums, (block, index), at| {
                lights.push((pixels[at], sums.lights[block][index].as_dvec3()));
            });
        }
        lights
    });
    of_threads
        .into_iter()
        .map(|(lights, cpu)| {
            lights.into_iter().for_each(|((i, j), light)| sums[(j * spec.size.xres() + i) as usize] += light);
            cpu.as_secs_f64()
        })
        .sum()
}
