//! Path-traced light beside closed forms.

use std::f64::consts::PI;

use shared::{
    appearance::Appearance,
    camera::Camera,
    detail::Detail,
    division::{FrameSize, SampleRect},
    path_light::PathLight,
    protocol::{LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};

use super::{
    sight::{Expected, N_LIGHTS, Sights},
    splitting::MOST_PATHS,
    *,
};
use crate::{
    grid::GridOptions,
    model::{
        material::{Material, Materials},
        mesh::Mesh,
        statue,
    },
    render::{sampling::circle_point, scene::Scene},
};

pub(super) fn spec(eye: DVec3, target: DVec3, bounces: u8) -> FrameSpec {
    let path = PathLight::new(40, bounces, 0).unwrap();
    FrameSpec {
        scene: SceneId::Statue { triangles: 0, treatment: Default::default() },
        camera: Camera::look_at(eye, target, DVec3::Y, 0.7, 2.0).unwrap(),
        size: FrameSize::new(64, 32).unwrap(),
        view: ShadingMode::Shaded,
        rays: LightingMode::Path,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance { path, ..Appearance::default() },
    }
}

pub(super) fn build(mesh: Mesh) -> Scene {
    Scene::build(mesh, &GridOptions::default(), &|_| ())
}

/// A ball of flat triangles around zero, with the radius 1.
pub(super) fn ball() -> Mesh {
    let mut mesh = Mesh::default();
    let (rows, columns) = (24u32, 48u32);
    for (row, column) in (0..=rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
        let (sin, cos) = (PI * f64::from(row) / f64::from(rows)).sin_cos();
        let (sin_around, cos_around) = (2.0 * PI * f64::from(column) / f64::from(columns)).sin_cos();
        mesh.vertices.push(DVec3::new(sin * cos_around, cos, sin * sin_around).as_vec3().to_array());
        if row < rows {
            let [a, b] = [column, (column + 1) % columns].map(|column| row * columns + column);
            mesh.triangles.extend([[a, a + columns, b], [b, a + columns, b + columns]]);
        }
    }
    mesh
}

pub(super) fn colored(mesh: Mesh, color: [u8; 3]) -> Mesh {
    Mesh { colors: vec![color; mesh.vertices.len()], ..mesh }
}

/// Nothing but a sky.
fn set_sky(tracer: &mut PathTracer<'_>, zenith: Vec3, ground: Vec3) {
    tracer.lights.sun = Sun::new(DVec3::Y, 4.0, Vec3::ZERO);
    tracer.lamp = None;
    tracer.lights.sky = Sky { up: Vec3::Y, zenith, ground };
}

/// The mean light of `n_samples` samples at each hit of a frame, with the hit and the point.
pub(super) fn lights(
    scene: &Scene,
    spec: &FrameSpec,
    n_samples: u32,
    set: impl Fn(&mut PathTracer<'_>),
) -> Vec<(Hit, DVec3, DVec3)> {
    lights_of((PixelPaths::default(), Sights::default()), scene, spec, n_samples, set).0
}

/// The same if all pixels' paths are traced like this; and the number of rays.
fn lights_of(
    (paths_of_all, sights_of_all): (PixelPaths, Sights),
    scene: &Scene,
    spec: &FrameSpec,
    n_samples: u32,
    set: impl Fn(&mut PathTracer<'_>),
) -> (Vec<(Hit, DVec3, DVec3)>, u32) {
    let mut tracer = PathTracer::new(scene, spec, None);
    set(&mut tracer);
    let shader = Shader::new(scene.mesh(), spec, None);
    let rays = spec.camera.rays(spec.size);
    let (mut all, mut n_rays) = (Vec::new(), 0);
    for (first_i, first_j) in (0..4).flat_map(|row| (0..8).map(move |column| (8 * column, 8 * row))) {
        let samples = SampleRect { columns: first_i..first_i + 8, rows: first_j..first_j + 8 };
        let mut directions = [Vec3::ZERO; 64];
        directions.iter_mut().zip(samples.iter()).for_each(|(to, (i, j))| *to = rays.direction(i, j));
        let hits = directions.map(|direction| scene.grid.intersect(&Ray::new(rays.eye, direction)));
        let blocks = [SampleBlock::Unit { samples, first_index: 0 }];
        let (mut pixels, mut sights) = ([paths_of_all; 64], vec![sights_of_all.clone(); 64]);
        let (mut sums, n_at_once) = ([Vec3::ZERO; 64], n_samples.min(MOST_PATHS));
        for start in (n_samples..2 * n_samples).step_by(n_at_once as usize) {
            let (mut paths, mut lights) = (Vec::new(), vec![Vec3::ZERO; 256 * n_at_once as usize]);
            for (first, sample) in (0..).step_by(256).zip(start..start + n_at_once) {
                let (rays, samples) = ((&[directions][..], [Vec3::ZERO; 2]), sample..start + n_at_once);
                let hits = (&[hits][..], &[[Vec3::ZERO; 64]][..]);
                tracer.begin(&blocks, samples, rays, hits, (first, &mut pixels), &mut paths);
            }
            let found = PixelSums { lights: &mut lights, pixels: &mut pixels, sights: &mut sights };
            tracer.add_lights(&shader, paths, found);
            lights.iter().zip((0..256).cycle()).filter(|(_, at)| *at < 64).for_each(|(light, at)| sums[at] += *light);
        }
        n_rays += pixels.iter().map(|pixel| pixel.n_camera_rays + pixel.n_other_rays).sum::<u32>();
        all.extend((0..64).filter(|&at| !hits[at].is_miss()).map(|at| {
            let point = rays.eye.as_dvec3() + directions[at].as_dvec3() * f64::from(hits[at].t);
            (hits[at], point, sums[at].as_dvec3() / f64::from(n_samples))
        }));
    }
    assert!(all.len() > 200, "{} hits", all.len());
    (all, n_rays)
}

#[test]
fn whatever_rays_are_expected_to_find_the_mean_light_is_the_same() {
    // The statue has lit and shaded sides, edges of shadows, and folds that see more of the statue.
    let scene = build(statue::generate(3000, &|_| ()));
    let spec = spec(DVec3::new(0.6, 1.5, 3.0), DVec3::Y * 1.4, 1);
    let n_samples = 256;
    let (truth, all_rays) = lights_of((PixelPaths::default(), Sights::default()), &scene, &spec, n_samples, |_| ());
    for (is_blocked, traced_part) in [(false, 0.5), (true, 0.5), (false, 0.125), (true, 0.125), (true, 1.0)] {
        let expected = Some(Expected { is_blocked, traced_part });
        // Of each path. Some surfaces face away from the sun, and send it no ray; where the path would have met another surface,
        // two more are left out.
        let (of_sun, of_sky) = (0.4..=1.0, 1.0..=3.0);
        for (lights, range) in [(0..1, of_sun), (1..N_LIGHTS, of_sky)] {
            let mut sights = Sights::default();
            sights.expected[lights].fill(expected);
            let (lights, n_rays) = lights_of((PixelPaths::default(), sights), &scene, &spec, n_samples, |_| ());
            let (sum, squares) = differences(&lights, &truth);
            let left_out = f64::from(all_rays - n_rays) / f64::from(n_samples * lights.len() as u32);
            assert!(sum.abs() <= 4.0 * f64::sqrt(squares) + 1e-6, "{expected:?}: {sum} of {}", f64::sqrt(squares));
            let part = left_out / f64::from(1.0 - traced_part).max(1e-9);
            assert!(
                traced_part == 1.0 || (range.start() - 0.01..range.end() + 0.01).contains(&part),
                "{expected:?}: {part} of {range:?}"
            );
        }
    }
}

#[test]
fn however_many_paths_share_a_camera_ray_the_mean_light_is_the_same() {
    let scene = build(statue::generate(3000, &|_| ()));
    let spec = spec(DVec3::new(0.6, 1.5, 3.0), DVec3::Y * 1.4, 1);
    let n_samples = 256;
    let (truth, all_rays) = lights_of((PixelPaths::default(), Sights::default()), &scene, &spec, n_samples, |_| ());
    for n_paths in [2, 4] {
        let paths = PixelPaths { n_paths, ..PixelPaths::default() };
        let (lights, n_rays) = lights_of((paths, Sights::default()), &scene, &spec, n_samples, |_| ());
        let (sum, squares) = differences(&lights, &truth);
        assert!(sum != 0.0 && sum.abs() <= 4.0 * f64::sqrt(squares), "{n_paths}: {sum} of {}", f64::sqrt(squares));
        // Of the pixels that show the model, and of the others.
        let shared = f64::from(all_rays - n_rays) / (1.0 - 1.0 / f64::from(n_paths)) / f64::from(n_samples);
        let n = lights.len() as f64;
        assert!((2048.0 + 0.4 * n..=2048.0 + n).contains(&shared), "{n_paths}: {shared} camera and sun rays, {n} hits");
    }
}

/// The sum of the differences of pixels' light, and that of their squares.
fn differences(some: &[(Hit, DVec3, DVec3)], others: &[(Hit, DVec3, DVec3)]) -> (f64, f64) {
    let differences = some.iter().zip(others).map(|((.., a), (.., b))| a.x - b.x);
    differences.fold((0.0, 0.0), |(sum, squares), it| (sum + it, squares + it * it))
}

/// Asserts that pixels differ from the truth by no more than `noise` of it (root of the mean square), and on average by no
/// more than four standard errors.
pub(super) fn check(pixels: impl Iterator<Item = (DVec3, DVec3)>, noise: f64) {
    let errors: Vec<_> = pixels.map(|(light, truth)| (light - truth) / truth).collect();
    for axis in 0..3 {
        let n = errors.len() as f64;
        let mean = errors.iter().map(|error| error[axis]).sum::<f64>() / n;
        let square = errors.iter().map(|error| error[axis] * error[axis]).sum::<f64>() / n;
        let standard_error = (square / n).sqrt();
        assert!(square.sqrt() < noise, "noise of {}", square.sqrt());
        assert!(mean.abs() < 4.0 * standard_error + 1e-6, "{mean} ± {standard_error}");
    }
}

#[test]
fn in_a_white_furnace_nothing_is_seen() {
    // A surface that scatters everything has the sky's light, however often light bounces.
    let eye = DVec3::new(1.0, 2.5, 4.0);
    let sky = Vec3::new(0.7, 0.5, 0.3);
    let white_ball = build(colored(ball(), [255; 3]));
    for (_, _, light) in lights(&white_ball, &spec(eye, DVec3::ZERO, 4), 16, |tracer| set_sky(tracer, sky, sky)) {
        assert!((light - sky.as_dvec3()).abs().max_element() < 1e-5, "{light}");
    }
    let statue = build(colored(statue::generate(3000, &|_| ()), [255; 3]));
    let statue_spec = spec(DVec3::new(0.6, 1.7, 3.0), DVec3::Y * 1.5, 64);
    let all = lights(&statue, &statue_spec, 16, |tracer| set_sky(tracer, sky, sky));
    let n_darker = all.iter().filter(|(_, _, light)| (*light - sky.as_dvec3()).abs().max_element() > 1e-4).count();
    // In its deepest folds a few paths have not left after 64 bounces.
    assert!(n_darker * 50 < all.len(), "{n_darker} of {}", all.len());
    assert!(all.iter().all(|(_, _, light)| light.cmple(sky.as_dvec3() + 1e-4).all()));
}

#[test]
fn a_convex_surface_has_its_albedo_in_an_even_sky() {
    // The light of these bytes is stored to within 5e-6: see `PackedRgb`.
    let color = [61, 43, 255];
    let scene = build(colored(ball(), color));
    let albedo = Vec3::from_array(color.map(shared::srgb::decode)).as_dvec3();
    for bounces in [0, 1, 4] {
        let spec = spec(DVec3::new(1.0, 2.5, 4.0), DVec3::ZERO, bounces);
        for (_, _, light) in lights(&scene, &spec, 4, |tracer| set_sky(tracer, Vec3::ONE, Vec3::ONE)) {
            assert!((light - albedo).abs().max_element() < 1e-5, "{light}");
        }
    }
}

#[test]
fn a_closed_sphere_gathers_the_light_that_it_gives_off() {
    // The mean of r + r² + … of the light that its surface gives off.
    let (albedo, given_off) = (0.5, 0.25);
    let material =
        Material { base_color: [albedo, albedo, albedo, 1.0], emissive: [given_off; 3], ..Material::default() };
    let mesh = Mesh { materials: Materials { materials: vec![material], ..Materials::default() }, ..ball() };
    let scene = build(mesh);
    for (bounces, noise) in [(0, 1e-5), (1, 1e-5), (3, 0.02), (64, 0.1)] {
        let spec = spec(DVec3::new(0.1, 0.2, 0.3), DVec3::Z * -0.5, bounces);
        let truth = f64::from(given_off) * (1.0 - 0.5f64.powi(i32::from(bounces) + 1)) / 0.5;
        let all = lights(&scene, &spec, 64, |tracer| set_sky(tracer, Vec3::ONE, Vec3::ONE));
        check(all.into_iter().map(|(_, _, light)| (light, DVec3::splat(truth))), noise);
    }
}

#[test]
fn a_ball_under_a_sky_of_two_colours_is_lit_by_its_normals() {
    let (zenith, ground) = (Vec3::new(0.2, 0.5, 1.0), Vec3::new(0.6, 0.3, 0.1));
    let scene = build(colored(ball(), [255; 3]));
    let spec = spec(DVec3::new(1.0, 0.5, 4.0), DVec3::ZERO, 2);
    let all = lights(&scene, &spec, 64, |tracer| set_sky(tracer, zenith, ground));
    let truth = |hit: Hit| {
        // The mean direction of a hemisphere, by the cosine, is two thirds of its normal.
        let [a, ..] = scene.mesh().corners(hit.triangle);
        let normal = scene.mesh().normal(hit.triangle).normalize();
        let normal = normal * normal.dot(Vec3::from_array(a).as_dvec3()).signum();
        let part = 0.5 + 0.5 * (2.0 / 3.0) * normal.y;
        ground.as_dvec3().lerp(zenith.as_dvec3(), part)
    };
    check(all.into_iter().map(|(hit, _, light)| (light, truth(hit))), 0.02);
}

#[test]
fn the_sun_s_shadow_has_the_penumbra_of_a_disc() {
    // A floor, and above it half a ceiling: its edge hides a segment of the sun's disc.
    let (height, half_size) = (1.0f32, 40.0);
    let quad = |low: f32, high: f32, y: f32| {
        [[low, y, -half_size], [high, y, -half_size], [high, y, half_size], [low, y, half_size]]
    };
    let mesh = Mesh {
        vertices: [quad(-half_size, half_size, 0.0), quad(0.0, half_size, height)].concat(),
        triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
        ..Mesh::default()
    };
    let scene = build(colored(mesh, [255; 3]));
    let spec = spec(DVec3::new(-0.3, 0.5, 0.0), DVec3::new(0.02, 0.0, 0.0), 0);
    let degrees = 30.0f64;
    let all = lights(&scene, &spec, 256, |tracer| {
        tracer.lights.sun = Sun::new(DVec3::Y, degrees, Vec3::ONE);
        tracer.lamp = None;
        tracer.lights.sky = Sky { up: Vec3::Y, zenith: Vec3::ZERO, ground: Vec3::ZERO };
    });
    let (mut n_partly, mut errors) = (0, Vec::new());
    for (_, point, light) in all.into_iter().filter(|(hit, ..)| scene.mesh().file_index(hit.triangle) < 2) {
        // Directions (x, y, z) of the disc are visible where x < −point.x · y / height: in the plane across the sun a half of
        // an ellipse, by numbers.
        let sine = (degrees / 2.0).to_radians().sin();
        let n = 200;
        let visible = (0..n * n).filter_map(|cell| {
            let [x, z] = [cell % n, cell / n].map(|k| (f64::from(k) + 0.5) / f64::from(n) * 2.0 - 1.0);
            let (x, z) = (x * sine, z * sine);
            let y = (1.0 - x * x - z * z).sqrt();
            (x.hypot(z) < sine).then_some(point.x + x / y * f64::from(height) < 0.0)
        });
        let (n_visible, n_all) = visible.fold((0, 0), |(n, all), visible| (n + u32::from(visible), all + 1));
        let truth = f64::from(n_visible) / f64::from(n_all);
        n_partly += u32::from(truth > 0.02 && truth < 0.98);
        errors.push(light.x - truth);
    }
    let n = errors.len() as f64;
    let square = errors.iter().map(|error| error * error).sum::<f64>() / n;
    let mean = errors.iter().sum::<f64>() / n;
    assert!(n_partly > 100 && square.sqrt() < 0.01, "{n_partly} in the penumbra, noise of {}", square.sqrt());
    assert!(mean.abs() < 4.0 * (square / n).sqrt() + 1e-3, "{mean}");
}

#[test]
fn gloss_reflects_no_more_than_all_light() {
    let surface = |cosine: f32| {
        let to_eye = Vec3::new((1.0 - cosine * cosine).sqrt(), 0.0, cosine);
        Surface { to_eye, geometric: Vec3::Z, shading: Vec3::Z, color: Vec3::ONE }
    };
    for (roughness, metallic) in [(0.0, 0.0), (0.3, 1.0), (0.6, 0.5), (1.0, 0.0), (1.0, 1.0)] {
        for cosine in [0.05, 0.4, 0.9, 1.0] {
            let scattering = Scattering::glossy(&surface(cosine), roughness, metallic, 0.0);
            let random = |index: u32, dimension: u32| PixelSample::new((7, 9), index).pair(dimension);
            // By directions that follow the surface, and by all directions of the hemisphere.
            let n = 1 << 14;
            let (mut followed, mut squares, mut everywhere, mut density) = (0.0, 0.0, 0.0, 0.0);
            for index in 0..n {
                let next = scattering.sample(random(index, 0)[0], random(index, 1));
                let weight = if next.density > 0.0 { next.weight.x } else { 0.0 };
                followed += f64::from(weight) / f64::from(n);
                squares += f64::from(weight * weight) / f64::from(n);
                let [u, v] = random(index, 2);
                let ([x, y], z) = (circle_point(v), u);
                let radius = (1.0 - z * z).sqrt();
                let (part, of_direction) = scattering.toward(Vec3::new(x * radius, y * radius, z));
                everywhere += f64::from(part.x) * 2.0 * PI / f64::from(n);
                density += f64::from(of_direction) * 2.0 * PI / f64::from(n);
            }
            assert!(followed <= 1.001 && followed > 0.15, "{roughness} {metallic} {cosine}: {followed}");
            let standard_error = ((squares - followed * followed).max(0.0) / f64::from(n)).sqrt();
            // Narrow highlights fall between directions that do not follow them.
            if roughness >= 0.3 {
                let difference = (followed - everywhere).abs();
                assert!(
                    difference < 0.03 + 4.0 * standard_error,
                    "{roughness} {metallic} {cosine}: {followed} {everywhere}"
                );
                assert!(density < 1.02, "{roughness} {metallic} {cosine}: {density}");
            }
        }
    }
}

#[test]
fn rare_paths_see_blurred_reflections_and_those_of_mirrors_sharp_ones() {
    assert_eq!(least_roughness(f32::INFINITY), 0.0, "the eye's own rays");
    assert_eq!([0.01, std::f32::consts::FRAC_1_PI].map(least_roughness), [0.5; 2], "diffuse light");
    let surface = |to_eye: Vec3| Surface { to_eye, geometric: Vec3::Z, shading: Vec3::Z, color: Vec3::ONE };
    let to_eye = Vec3::new(0.6, 0.0, 0.8);
    let mirror = Scattering::glossy(&surface(to_eye), 0.0, 1.0, 0.0);
    let least = |direction: Vec3| least_roughness(mirror.toward(direction).1);
    assert!(least(Vec3::new(-0.6, 0.0, 0.8)) < 0.11, "a smooth surface is shown as it is");
    assert_eq!(least(Vec3::new(0.6, 0.0, 0.8)), 0.5, "chance leads there");
    // The sun's highlight on a smooth surface is never brighter than the path's density allows.
    for log in -2..12 {
        let density = 1.7f32.powi(log);
        let seen = Scattering::glossy(&surface(Vec3::Z), 0.0, 1.0, least_roughness(density));
        let brightest = seen.toward(Vec3::Z).0.x * PI as f32;
        assert!(brightest < 3.2 * density.max(SCATTERED_DENSITY), "{density}: {brightest}");
    }
}

#[test]
fn a_room_is_about_as_bright_as_its_outside() {
    let scene = build(colored(ball(), [203; 3]));
    let mean = |eye: DVec3| {
        let all = lights(&scene, &spec(eye, DVec3::new(0.0, 0.1, -0.2), 4), 16, |_| ());
        all.iter().map(|(_, _, light)| light.y).sum::<f64>() / all.len() as f64
    };
    let outside = mean(DVec3::new(1.0, 2.0, 4.0));
    for eye in [DVec3::new(0.1, 0.2, 0.3), DVec3::new(0.5, 0.0, 0.6)] {
        let part = mean(eye) / outside;
        assert!((0.45..1.5).contains(&part), "{eye}: {part}");
    }
}

#[test]
fn as_the_eye_comes_in_the_lamp_fades_in() {
    // A ball without its upper third.
    let mut mesh = ball();
    mesh.triangles.retain(|corners| corners.iter().all(|&corner| mesh.vertices[corner as usize][1] < 0.4));
    let scene = build(mesh);
    let on_the_ground = |height: f64| {
        let lamp = Lamp::at(&scene.grid, None, DVec3::Y * height, Vec3::ONE);
        lamp.map_or(0.0, |lamp| lamp.toward(DVec3::NEG_Y).1.x / PI as f32)
    };
    let mut last = on_the_ground(1.5);
    assert_eq!(last, 0.0);
    for step in 1..=230 {
        let next = on_the_ground(1.5 - 0.01 * f64::from(step));
        assert!((next - last).abs() < 0.04, "{step}: {next} after {last}");
        last = next;
    }
    assert!(last > 0.2 && last < 0.8, "{last}");
}

#[test]
fn within_a_model_there_is_light() {
    let statue = statue::generate(3000, &|_| ());
    let scene = build(statue);
    for bounces in [0, 4] {
        let spec = spec(DVec3::new(0.0, 0.5, 0.0), DVec3::new(0.1, 0.6, -1.0), bounces);
        let all = lights(&scene, &spec, 16, |_| ());
        assert!(all.iter().all(|(_, _, light)| light.is_finite() && light.max_element() < 4.0));
        let n_lit = all.iter().filter(|(_, _, light)| light.min_element() > 0.02).count();
        assert!(n_lit * 20 > all.len() * 19, "{n_lit} of {}", all.len());
    }
}
