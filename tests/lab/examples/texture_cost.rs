//! Measures the cost of looks: CPU time of frames of flat triangles, and of the same model with smooth normals, with colours
//! too, and with an image wrapped around it, in turns.
//!
//!     cargo run --release -p lab --example texture_cost -- --model bunny.ply --frames 200

use std::{f32::consts::PI, path::PathBuf};

use clap::Parser;
use glam::{DVec3, Vec3};
use lab::statistics::{median, milliseconds};
use renderer::{
    cli::picture_args::PictureArgs,
    memory::EndingAllocator,
    model::{
        material::{Image, Material, Materials, TextureUse, Wrap},
        mesh::Mesh,
        scene::LoadedMesh,
    },
    render::image,
};

/// That of all programs.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

/// The frame, the measurement, and the picture to write.
#[derive(Parser)]
struct Args {
    #[command(flatten)]
    picture: PictureArgs,

    /// Measured frames of each kind; their median counts
    #[arg(long, default_value_t = 100)]
    frames: u32,

    /// Texels in a row of the image; a column has half of them
    #[arg(long, default_value_t = 4096)]
    width: u32,

    /// Write the picture with the texture as PNG
    #[arg(long)]
    image: Option<PathBuf>,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    args.picture.pool()?.install(|| run(&args))
}

fn run(args: &Args) -> anyhow::Result<()> {
    let camera = args.picture.read_camera()?;
    let LoadedMesh { id, mesh, .. } = args.picture.model.load()?;
    let spec = args.picture.spec(id, camera.unwrap_or_else(|| args.picture.view_all(&mesh.shape())));
    let flat = Mesh { normals: Vec::new(), ..mesh.clone() };
    let scenes = [
        ("flat", args.picture.build(flat)),
        ("smooth", args.picture.build(mesh.clone())),
        ("coloured", args.picture.build(colored(mesh.clone()))),
        ("textured", args.picture.build(textured(mesh, args.width))),
    ];
    let mut times = scenes.each_ref().map(|_| Vec::new());
    for _ in 0..args.frames {
        for ((_, scene), times) in scenes.iter().zip(&mut times) {
            // The frame before has another scene in the caches.
            scene.render_frame(&spec);
            times.push(milliseconds(scene.render_frame(&spec).1));
        }
    }
    if let Some(path) = &args.image {
        image::write_png(path, spec.size, &scenes[3].1.render_frame(&spec).0)?;
    }
    let times = times.map(median);
    for ((name, scene), time) in scenes.iter().zip(times) {
        let (of_flat, of_smooth) = (time / times[0], time / times[1]);
        let megabytes = scene.n_bytes() as f64 / 1e6;
        println!("{name}: {time:.2} ms, {of_flat:.3} times flat, {of_smooth:.3} times smooth, {megabytes:.1} MB");
    }
    Ok(())
}

/// A mesh with colours that differ from vertex to vertex.
fn colored(mesh: Mesh) -> Mesh {
    Mesh { colors: mesh.vertices.iter().map(|vertex| vertex.map(|x| x.to_bits().to_be_bytes()[2])).collect(), ..mesh }
}

/// A mesh with an image around its centre, as a globe has its map.
fn textured(mesh: Mesh, width: u32) -> Mesh {
    let [min, max] = mesh.bounds().corners().map(DVec3::as_vec3);
    let coordinates = |&vertex: &[f32; 3]| {
        let Vec3 { x, y, z } = (Vec3::from_array(vertex) - (min + max) * 0.5).normalize_or_zero();
        [0.5 + x.atan2(z) / (2.0 * PI), y.acos() / PI]
    };
    let texture =
        TextureUse { image: 0, wrap: [Wrap::Repeat, Wrap::Clamp], transform: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] };
    Mesh {
        texture_coordinates: mesh.vertices.iter().map(coordinates).collect(),
        materials: Materials {
            materials: vec![Material { base_color_texture: Some(texture), ..Material::default() }],
            images: vec![map(width)],
            ..Materials::default()
        },
        ..mesh
    }
}

/// A globe's map of squares with noise.
fn map(width: u32) -> Image {
    let height = width / 2;
    let texel = |x: u32, y: u32| {
        let noise = x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b);
        let noise = (noise ^ noise >> 15).wrapping_mul(0x2c1b_3c6d).to_be_bytes()[0] / 4;
        let is_dark = (x * 64 / width + y * 32 / height).is_multiple_of(2);
        let [red, green, blue] = if is_dark { [40, 60, 120] } else { [180, 150, 110] };
        [red + noise, green + noise, blue + noise, 255]
    };
    Image { width, height, texels: (0..height).flat_map(|y| (0..width).map(move |x| texel(x, y))).collect() }
}
