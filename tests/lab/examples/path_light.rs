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
use lab::light::render_lights;
use renderer::{
    cli::picture_args::PictureArgs,
    model::scene::LoadedMesh,
    render::{
        path::{GROUND_LIGHT, SUN_LIGHT, ZENITH_LIGHT},
        shade::CLAY,
    },
};
use shared::protocol::{FrameSpec, SampleRange};

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
        let samples = SampleRange::all(first, (end - first).min(SampleRange::LARGEST_COUNT));
        let spec = FrameSpec { samples, ..spec };
        let (lights, cpu) = render_lights(&scene, &spec, |_, sums, (block, index)| sums.lights[block][index]);
        sums.iter_mut().zip(lights).for_each(|(sum, light)| *sum += light.as_dvec3());
        cpu_s += cpu.as_secs_f64();
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
