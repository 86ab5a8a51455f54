//! Pictures of textured models: against pictures with a thousand samples a pixel, and against geometry.

use glam::DVec3;
use shared::{
    appearance::{Appearance, Light},
    camera::Camera,
    detail::Detail,
    division::{Division, FrameSize},
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
    srgb,
};
use strum::VariantArray;

use crate::{
    grid::{GridOptions, Storage, traced::TracedMesh},
    intersect::InstructionSet,
    model::{
        material::{Image, Material, Materials, TextureUse, Wrap},
        mesh::Mesh,
    },
    render::scene::Scene,
};

const IDENTITY: [[f32; 3]; 2] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];

fn spec(eye: DVec3, target: DVec3, size: FrameSize) -> FrameSpec {
    let aspect = f64::from(size.xres()) / f64::from(size.yres());
    FrameSpec {
        scene: SceneId::Statue { triangles: 0, treatment: Default::default() },
        camera: Camera::look_at(eye, target, DVec3::Z, 0.7, aspect).unwrap(),
        size,
        view: ShadingMode::Shaded,
        rays: LightingMode::Primary,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    }
}

fn scene(mesh: Mesh) -> Scene {
    Scene::build(mesh, &GridOptions::default(), &|_| ())
}

/// A square of the plane z = 0 around zero, whose coordinates run `n` times from 0 to 1.
fn plane(half_side: f32, n: f32, image: Image) -> Mesh {
    let texture = TextureUse { image: 0, wrap: [Wrap::Repeat; 2], transform: IDENTITY };
    Mesh {
        vertices: [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
            .map(|[x, y]: [f32; 2]| [x * half_side, y * half_side, 0.0])
            .to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        texture_coordinates: [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(|at| at.map(|x: f32| x * n)).to_vec(),
        materials: Materials {
            materials: vec![Material { base_color_texture: Some(texture), ..Material::default() }],
            images: vec![image],
            of_triangles: Vec::new(),
        },
        ..Mesh::default()
    }
}

/// Squares of a checkerboard, 16 a side.
fn checkerboard(side: u32) -> Image {
    let is_white = |x: u32, y: u32| (x * 16 / side + y * 16 / side).is_multiple_of(2);
    let texel = |x: u32, y: u32| if is_white(x, y) { [250, 240, 230, 255] } else { [10, 20, 60, 255] };
    Image {
        width: side,
        height: side,
        texels: (0..side * side).map(|index| texel(index % side, index / side)).collect(),
    }
}

/// Peak signal-to-noise ratio of encoded samples, in decibels.
fn psnr(picture: &[u8], reference: &[u8]) -> f64 {
    let squares = picture.iter().zip(reference).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
    10.0 * (255.0f64.powi(2) / (squares.sum::<f64>() / picture.len() as f64)).log10()
}

/// Side of the square of samples that a pixel has in the reference.
const FINER: u32 = 33;

/// An image with each texel as a square of as many as fit `side`: blends reach a part of a texel, so it shows nearest texels.
fn enlarged(image: &Image, side: u32) -> Image {
    let times = side / image.width;
    let texel = |x: u32, y: u32| image.texels[(y / times * image.width + x / times) as usize];
    Image {
        width: side,
        height: side,
        texels: (0..side * side).map(|index| texel(index % side, index / side)).collect(),
    }
}

/// PSNR with one sample a pixel, against the mean of [`FINER`]² samples: of the picture, and of one without a filter, in which
/// a sample shows the nearest texel.
///
/// A frame of [`FINER`] times the size has footprints too small for any filter, and its centre samples are the picture's.
fn quality(mesh: &Mesh, eye: DVec3, target: DVec3) -> [f64; 2] {
    let [width, height] = [96, 48];
    let picture = scene(mesh.clone()).render_frame(&spec(eye, target, FrameSize::new(width, height).unwrap())).0;
    let finer_spec = spec(eye, target, FrameSize::new(FINER * width, FINER * height).unwrap());
    let finer = scene(mesh.clone()).render_frame(&finer_spec).0;
    let finer_at = |x: u32, y: u32, channel: u32| finer[((y * FINER * width + x) * 3 + channel) as usize];
    let mut reference = Vec::new();
    for (y, x, channel) in (0..height).flat_map(|y| (0..width).flat_map(move |x| (0..3).map(move |c| (y, x, c)))) {
        let of_pixel = (0..FINER * FINER).map(|n| finer_at(x * FINER + n % FINER, y * FINER + n / FINER, channel));
        let sum: f64 = of_pixel.map(|value| f64::from(srgb::decode(value))).sum();
        reference.push(srgb::encode((sum / f64::from(FINER * FINER)) as f32));
    }
    // Every 33rd sample of the finer frame, of which every 33rd row has pixels' centres.
    let images = mesh.materials.images.iter().map(|image| enlarged(image, 2048)).collect();
    let nearest = Mesh { materials: Materials { images, ..mesh.materials.clone() }, ..mesh.clone() };
    let share = Division::Interleaved.task(FINER / 2, FINER).share(finer_spec.size).unwrap();
    let first = FINER / 2 * width;
    let mut unfiltered = Vec::new();
    let nearest = scene(nearest);
    for row in 0..height {
        let units = first + row * FINER * width..first + (row * FINER + 1) * width;
        nearest.render(&finer_spec, &share, units, &mut unfiltered);
    }
    [psnr(&picture, &reference), psnr(&unfiltered, &reference)]
}

#[test]
fn one_sample_of_a_texture_is_nearly_as_good_as_a_thousand() {
    let (eye, horizon, below) = (DVec3::new(0.3, -9.0, 1.0), DVec3::new(0.0, 0.0, 0.2), DVec3::new(0.0, -7.5, 0.0));
    for (name, mesh, eye, target, least) in [
        ("to the horizon", plane(60.0, 30.0, checkerboard(256)), eye, horizon, 34.0),
        ("from above", plane(60.0, 100.0, checkerboard(512)), DVec3::new(0.0, -1.0, 9.0), DVec3::ZERO, 25.0),
        ("magnified", plane(60.0, 6.0, checkerboard(64)), eye, below, 35.0),
    ] {
        let [filtered, unfiltered] = quality(&mesh, eye, target);
        println!("{name}: {filtered:.1} dB, {unfiltered:.1} dB without a filter");
        assert!(filtered >= unfiltered + 3.0, "{name}: {filtered} dB, {unfiltered} dB without a filter");
        assert!(filtered >= least, "{name}: {filtered} dB");
    }
}

/// Adds a quad with a material.
fn add_quad(mesh: &mut Mesh, corners: [[f32; 3]; 4], coordinates: [[f32; 2]; 4], material: u16) {
    let first = mesh.vertices.len() as u32;
    mesh.vertices.extend(corners);
    mesh.texture_coordinates.extend(coordinates);
    mesh.triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    mesh.materials.of_triangles.extend([material; 2]);
}

const N_BARS: u32 = 8;

/// A floor behind two fences, whose bars are geometry, or texels of a mask. Each fence of texels has a wall of nothing in the
/// same plane.
fn fences(has_mask: bool) -> Mesh {
    // Two texels a bar, two a gap.
    let texel = |x: u32| [255, 255, 255, if (x / 2).is_multiple_of(2) { 255 } else { 0 }];
    let width = 4 * N_BARS;
    let image = Image { width, height: 4, texels: (0..4 * width).map(|index| texel(index % width)).collect() };
    let texture = TextureUse { image: 0, wrap: [Wrap::Clamp, Wrap::Repeat], transform: IDENTITY };
    let plain = Material { base_color: [0.5, 0.4, 0.3, 1.0], ..Material::default() };
    let masked = Material { base_color_texture: Some(texture), alpha_cutoff: Some(0.5), ..plain.clone() };
    let nothing = Material { base_color: [1.0, 0.0, 0.0, 0.2], alpha_cutoff: Some(0.5), ..Material::default() };
    let mut mesh = Mesh {
        materials: Materials { materials: vec![plain, masked, nothing], images: vec![image], ..Materials::default() },
        ..Mesh::default()
    };
    add_quad(&mut mesh, [[-5.0, -5.0, -1.0], [5.0, -5.0, -1.0], [5.0, 5.0, -1.0], [-5.0, 5.0, -1.0]], [[0.0; 2]; 4], 0);
    let quad = |from: f32, to: f32, z: f32| [[from, -1.0, z], [to, -1.0, z], [to, 1.0, z], [from, 1.0, z]];
    let whole = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    for z in [0.0, 0.5] {
        if has_mask {
            add_quad(&mut mesh, quad(-2.0, 2.0, z), whole, 2);
            add_quad(&mut mesh, quad(-2.0, 2.0, z), whole, 1);
        } else {
            let step = 4.0 / N_BARS as f32;
            let bar = |index: u32| -2.0 + step * index as f32;
            (0..N_BARS).for_each(|index| add_quad(&mut mesh, quad(bar(index), bar(index) + 0.5 * step, z), whole, 0));
        }
    }
    mesh
}

#[test]
fn a_mask_looks_and_casts_shadows_as_the_same_geometry_does() {
    let scenes = [false, true].map(|has_mask| scene(fences(has_mask)));
    for rays in [LightingMode::Primary, LightingMode::Shadows, LightingMode::AmbientOcclusion] {
        let spec = spec(DVec3::new(0.7, -3.0, 4.0), DVec3::ZERO, FrameSize::new(200, 100).unwrap());
        let [bars, masks] = scenes.each_ref().map(|scene| scene.render_frame(&FrameSpec { rays, ..spec }).0);
        let differs = |(a, b): (&[u8], &[u8])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 2);
        let n_other = bars.chunks(3).zip(masks.chunks(3)).filter(|pair| differs(*pair)).count();
        let n_lit = bars.chunks(3).filter(|color| color[0] > 100).count();
        // Rays that pass a bar's edge within rounding.
        assert!(n_other < 40 && n_lit > 4000, "{rays}: {n_other} of 20000 samples differ, {n_lit} are lit");
    }
}

#[test]
fn neither_structure_nor_instructions_nor_division_change_masked_and_textured_pictures() {
    let mut mesh = fences(true);
    mesh.materials.images.push(checkerboard(64));
    let texture = TextureUse { image: 1, wrap: [Wrap::Mirror; 2], transform: [[2.0, 1.0, 0.1], [-1.0, 2.0, 0.3]] };
    mesh.materials.materials[1].metallic_roughness_texture = Some(texture);
    mesh.materials.materials[1].emissive_texture = Some(texture);
    mesh.materials.materials[1].emissive = [0.1, 0.2, 0.0];
    for (rays, clip) in
        LightingMode::VARIANTS.iter().flat_map(|rays| [None, "x:40".parse().ok()].map(|clip| (*rays, clip)))
    {
        let size = FrameSize::new(61, 37).unwrap();
        let appearance = Appearance { clip, ..Appearance::default() };
        let samples = SampleRange::all(1, 2);
        let spec = FrameSpec { rays, appearance, samples, ..spec(DVec3::new(0.7, -3.0, 4.0), DVec3::ZERO, size) };
        let mut frames = Vec::new();
        for instructions in InstructionSet::available() {
            let grid = scene(mesh.clone()).grid.with_instructions(instructions);
            frames.push(Scene::from(grid).render_frame(&spec).0);
        }
        let options = GridOptions { storage: Storage::Plain, ..GridOptions::default() };
        let scene = Scene::build(mesh.clone(), &options, &|_| ());
        frames.push(scene.render_frame(&spec).0);
        let mut frame = vec![0; frames[0].len()];
        for machine in 0..3 {
            let share = Division::Interleaved.task(machine, 3).share(size).unwrap();
            let mut rgb = Vec::new();
            scene.render(&spec, &share, 0..share.count(), &mut rgb);
            let samples = (0..share.count()).flat_map(|unit| share.samples(unit).iter());
            for ((i, j), color) in samples.zip(rgb.chunks_exact(3)) {
                let at = (j * size.xres() + i) as usize * 3;
                frame[at..at + 3].copy_from_slice(color);
            }
        }
        frames.push(frame);
        assert!(frames.iter().all(|frame| frame == &frames[0]), "{rays} {clip:?}");
    }
}

#[test]
fn unlit_surfaces_show_their_texture_in_any_light() {
    const COLOR: [u8; 3] = [200, 90, 7];
    let image = Image { width: 1, height: 1, texels: vec![[COLOR[0], COLOR[1], COLOR[2], 255]] };
    let size = FrameSize::new(16, 8).unwrap();
    let shown = |is_unlit: bool, rays: LightingMode, light: Light| {
        let mut mesh = plane(9.0, 1.0, image.clone());
        mesh.materials.materials[0].is_unlit = is_unlit;
        let appearance = Appearance { light, ..Appearance::default() };
        let spec = FrameSpec { rays, appearance, ..spec(DVec3::new(0.0, -1.0, 2.0), DVec3::ZERO, size) };
        scene(mesh).render_frame(&spec).0
    };
    for &rays in LightingMode::VARIANTS {
        for (_, light) in Light::PRESETS {
            assert!(shown(true, rays, light).chunks_exact(3).all(|color| color == COLOR), "{rays} {light:?}");
        }
    }
    let light = Light::PRESETS[0].1;
    assert!(shown(false, LightingMode::Primary, light).chunks_exact(3).all(|color| color != COLOR));
}

#[test]
fn picks_go_through_gaps() {
    let scene = scene(fences(true));
    let spec = spec(DVec3::new(0.0, 0.0, 5.0), DVec3::new(0.0, 0.01, 0.0), FrameSize::new(64, 32).unwrap());
    let picked = |x: f32| scene.probe(&spec.camera, [x, 0.5], None).and_then(|hit| hit.triangle);
    let triangles: Vec<_> = (0..40).filter_map(|step| picked(0.3 + 0.01 * step as f32)).collect();
    // Quads in order: the floor, and nothing and a fence, twice.
    assert!(triangles.iter().all(|triangle| [0, 1, 4, 5, 8, 9].contains(triangle)), "{triangles:?}");
    assert!(triangles.iter().any(|triangle| *triangle < 2) && triangles.iter().any(|triangle| *triangle >= 8));
}

#[test]
fn memory_is_counted() {
    let mut mesh = fences(true);
    // No twins, of which only one would be kept.
    (0..).zip(&mut mesh.vertices).for_each(|(n, vertex)| vertex[2] += n as f32);
    let (n_triangles, of_vertices_and_materials) = (mesh.triangles.len() as u64, TracedMesh::bytes_in_order(&mesh));
    let traced = scene(mesh).mesh().n_bytes() as u64;
    let expected = of_vertices_and_materials + n_triangles * TracedMesh::BYTES_PER_TRIANGLE;
    assert!((expected / 10 * 9..=expected).contains(&traced), "{traced} bytes, not {expected}");
}
