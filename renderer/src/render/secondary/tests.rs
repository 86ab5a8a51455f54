use shared::{
    appearance::{Appearance, Light},
    camera::Camera,
    detail::Detail,
    division::{FrameSize, SampleRect},
    protocol::SampleRange,
    scene::SceneId,
};

use super::*;
use crate::{
    grid::GridOptions,
    intersect::InstructionSet,
    model::{mesh::Mesh, statue},
    render::scene::Scene,
};

fn spec(eye: DVec3, target: DVec3, rays: LightingMode) -> FrameSpec {
    FrameSpec {
        scene: SceneId::Statue { triangles: 0, treatment: Default::default() },
        camera: Camera::look_at(eye, target, DVec3::Y, 0.7, 2.0).unwrap(),
        size: FrameSize::new(128, 64).unwrap(),
        view: ShadingMode::Shaded,
        rays,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    }
}

/// The fraction of a surface's ambient occlusion rays that hit nothing.
fn ambient_visibility(secondary: &SecondaryRays<'_>, surface: &LiftedPoint, pixel: (u32, u32), sample: u32) -> f32 {
    let seen = Seen { point: surface.point.as_vec3(), normal: surface.normal.as_vec3(), pixel };
    let mut rays = secondary.ambient_rays(&[seen], sample);
    let mut occluded = [false; N_AO_RAYS];
    clip::occluded_rays(secondary.grid, secondary.clip.as_ref(), &mut rays, &mut occluded);
    occluded.iter().filter(|&&occluded| !occluded).count() as f32 / N_AO_RAYS as f32
}

/// Samples that are no tile, so that lanes are in the order of samples.
const ROW: SampleBlock<'_> = SampleBlock::Unit { samples: SampleRect { columns: 0..64, rows: 0..1 }, first_index: 0 };

/// The light that reaches every hit of a frame, with the ray's direction and the hit.
fn visibility(scene: &Scene, spec: &FrameSpec) -> Vec<(Vec3, Hit, LightVisibility)> {
    let secondary = SecondaryRays::new(&scene.grid, spec, scene.clip_plane(&spec.camera, spec.appearance.clip));
    let rays = spec.camera.rays(spec.size);
    let mut scratch = PacketScratch::default();
    let mut all = Vec::new();
    for (first_i, first_j) in (0..8).flat_map(|row| (0..16).map(move |column| (8 * column, 8 * row))) {
        let samples = SampleRect { columns: first_i..first_i + 8, rows: first_j..first_j + 8 };
        let mut directions = [Vec3::ZERO; 64];
        directions.iter_mut().zip(samples.iter()).for_each(|(to, (i, j))| *to = rays.direction(i, j));
        let cut = |direction| clip::intersect(&scene.grid, secondary.clip.as_ref(), Ray::new(rays.eye, direction));
        let hits = directions.map(cut);
        let blocks = [SampleBlock::Unit { samples, first_index: 0 }];
        let [visibility, ..] = secondary.visibility(&blocks, 0, &[directions], &[hits], &mut scratch);
        all.extend((0..64).map(|lane| (directions[lane], hits[lane], visibility[lane])));
    }
    all.retain(|(_, hit, _)| !hit.is_miss());
    all
}

fn ball(centre: Vec3, radius: f32) -> Mesh {
    let mut mesh = Mesh::default();
    let (rows, columns) = (40u32, 80u32);
    for row in 0..=rows {
        for column in 0..columns {
            let (sin, cos) = (std::f32::consts::PI * row as f32 / rows as f32).sin_cos();
            let (sin_around, cos_around) = (std::f32::consts::TAU * column as f32 / columns as f32).sin_cos();
            let normal = Vec3::new(sin * cos_around, cos, sin * sin_around);
            mesh.vertices.push((centre + normal * radius).to_array());
            if row < rows {
                let right = (column + 1) % columns;
                let [a, b] = [column, right].map(|column| row * columns + column);
                mesh.triangles.extend([[a, b, a + columns], [b, b + columns, a + columns]]);
            }
        }
    }
    mesh
}

#[test]
fn a_ball_does_not_shadow_itself() {
    let places = [(0.0, 1.0), (1000.0, 1.0), (0.0, 1e-6), (-1e6, 1e6), (3.0, 1e6), (50.0, 1e-1)];
    for (centre, radius) in places {
        let scene = Scene::build(ball(Vec3::splat(centre), radius), &GridOptions::default(), &|_| ());
        let (centre, radius) = (DVec3::splat(f64::from(centre)), f64::from(radius));
        for distance in [1.5, 4.0, 1e4] {
            let eye = centre + DVec3::new(0.5, 0.6, 1.0).normalize() * (distance * radius);
            let mut spec = spec(eye, centre, LightingMode::AmbientOcclusion);
            if distance > 1e3 {
                let (eye, u, v) = (spec.camera.eye(), spec.camera.u(), spec.camera.v());
                let (u, v) = (u * (4.0 / distance), v * (4.0 / distance));
                spec.camera = Camera::new(eye, centre - (u + v) * 0.5, u, v).unwrap();
            }
            let secondary = SecondaryRays::new(&scene.grid, &spec, None);
            let all = visibility(&scene, &spec);
            assert!(all.len() > 1000, "the ball is seen");
            for (direction, hit, visibility) in all {
                let LiftedPoint { point, normal } = secondary.lift.point(secondary.eye, direction, hit).unwrap();
                let facing = normal.dot(secondary.key_light.as_dvec3() - point) > secondary.lift.ray_offset;
                let expected = f32::from(u8::from(facing));
                assert_eq!(
                    (visibility.key, visibility.ambient_visibility),
                    (expected, 1.0),
                    "{centre} {radius} {distance} {point}"
                );
            }
        }
    }
}

#[test]
fn the_light_has_the_direction_that_is_asked_for() {
    let scene = Scene::build(ball(Vec3::ZERO, 1.0), &GridOptions::default(), &|_| ());
    for (name, light) in Light::PRESETS {
        // The eye is on the z axis: its right, up and back are the world's axes.
        let appearance = Appearance { light, ..Appearance::default() };
        let spec = FrameSpec { appearance, ..spec(DVec3::Z * 5.0, DVec3::ZERO, LightingMode::Shadows) };
        let secondary = SecondaryRays::new(&scene.grid, &spec, None);
        let expected = light.direction().as_vec3();
        assert!((secondary.key_direction - expected).length() < 1e-6, "{name}");
        assert!((secondary.key_light.normalize() - expected).length() < 1e-6, "{name}: {}", secondary.key_light);
        // Exactly the points that face away from the light are dark: a ball casts no shadow on itself.
        for (direction, hit, visibility) in visibility(&scene, &spec) {
            let LiftedPoint { point, normal } = secondary.lift.point(secondary.eye, direction, hit).unwrap();
            let cosine = normal.dot((secondary.key_light.as_dvec3() - point).normalize());
            assert!(cosine.abs() < 0.05 || (cosine > 0.0) == (visibility.key > 0.0), "{name}: {cosine} {visibility:?}");
        }
    }
}

#[test]
fn objects_touch_their_shadows() {
    // A wall on a floor, seen along the light: the floor behind the wall is dark up to the wall's foot.
    for offset in [0.0, 100.0f32] {
        let quad = |a: [f32; 3], b: [f32; 3], c: [f32; 3], d: [f32; 3]| [a, b, c, d].map(|p| p.map(|x| x + offset));
        let floor = quad([-2.0, 0.0, -2.0], [2.0, 0.0, -2.0], [2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]);
        let wall = quad([-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [-2.0, 1.0, 0.0]);
        let mesh = Mesh {
            vertices: [floor, wall].concat(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
            ..Mesh::default()
        };
        let scene = Scene::build(mesh, &GridOptions::default(), &|_| ());
        let at = |p: [f64; 3]| DVec3::from_array(p) + DVec3::splat(f64::from(offset));
        let spec = spec(at([0.0, 1.0, 5.0]), at([0.0; 3]), LightingMode::Shadows);
        let mut secondary = SecondaryRays::new(&scene.grid, &spec, None);
        secondary.key_light = at([0.3, 1.5, 3.0]).as_vec3();
        // Contact begins within a few units in the last place of the largest coordinate.
        let nearest = 100.0 * f64::from(f32::EPSILON) * (f64::from(offset) + 2.0);
        for (z, expected) in [(-nearest, 0.0), (-1e-2, 0.0), (-0.5, 0.0), (nearest, 1.0), (0.5, 1.0)] {
            let point = at([0.1, 0.0, z]) + DVec3::Y * secondary.lift.ray_offset;
            let surfaces: [Option<LiftedPoint>; 64] =
                std::array::from_fn(|lane| (lane == 7).then_some(LiftedPoint { point, normal: DVec3::Y }));
            let mut visibility = [[LightVisibility { key_direction: Vec3::Y, key: 0.5, ambient_visibility: 1.0 }; 64]];
            let blocks = [ROW];
            secondary.cast_shadows(&blocks, &[surfaces], &mut visibility, &mut PacketScratch::default());
            assert_eq!(visibility[0][7].key, expected, "{z} beside the wall, {offset} away");
        }
    }
}

#[test]
fn removed_parts_cast_no_shadow() {
    let sheet = |y: f32| [[-2.0, y, -2.0], [2.0, y, -2.0], [2.0, y, 2.0], [-2.0, y, 2.0]];
    let mesh = Mesh {
        vertices: [sheet(0.0), sheet(1.0)].concat(),
        triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
        ..Mesh::default()
    };
    let scene = Scene::build(mesh, &GridOptions::default(), &|_| ());
    // A floor under a lid, with the light above: dark with the lid, lit without.
    for (clip, key) in [(None, 0.0), ("y:50".parse().ok(), 1.0), ("-y:0".parse().ok(), 0.0)] {
        let appearance = Appearance { clip, ..Appearance::default() };
        let eye = DVec3::new(0.1, 0.5, 1.5);
        let spec = FrameSpec { appearance, ..spec(eye, DVec3::new(0.0, 0.0, -0.3), LightingMode::AmbientOcclusion) };
        let plane = scene.clip_plane(&spec.camera, clip);
        let mut secondary = SecondaryRays::new(&scene.grid, &spec, plane);
        secondary.key_light = Vec3::new(0.2, 3.0, 0.1);
        let surface = LiftedPoint { point: DVec3::new(0.3, secondary.lift.ray_offset, 0.2), normal: DVec3::Y };
        let surfaces = std::array::from_fn(|_| Some(LiftedPoint { ..surface }));
        let mut visibility = [[LightVisibility { key_direction: Vec3::Y, key: 0.5, ambient_visibility: 1.0 }; 64]];
        let blocks = [ROW];
        secondary.cast_shadows(&blocks, &[surfaces], &mut visibility, &mut PacketScratch::default());
        assert!(visibility[0].iter().all(|visibility| visibility.key == key), "{clip:?}");
        assert_eq!(ambient_visibility(&secondary, &surface, (1, 2), 3), 1.0, "the lid is too far away");
    }
}

#[test]
fn caps_are_lit_as_a_plane_with_nothing_on_it() {
    let scene = Scene::build(statue::generate(4000, &|_| ()), &GridOptions::default(), &|_| ());
    // A light on the eye's side reaches all of the cap, and one behind the statue nothing.
    for (azimuth, key) in [(-30, 1.0), (180, 0.0)] {
        let light = Light::new(azimuth, 20).unwrap();
        let appearance = Appearance { light, clip: "z:50".parse().ok(), ..Appearance::default() };
        let spec =
            FrameSpec { appearance, ..spec(DVec3::new(0.0, 1.7, 6.0), DVec3::Y * 1.7, LightingMode::AmbientOcclusion) };
        let caps: Vec<_> = visibility(&scene, &spec).into_iter().filter(|(_, hit, _)| hit.is_cap()).collect();
        assert!(caps.len() > 300, "{}", caps.len());
        assert!(caps.iter().all(|(.., light)| (light.key, light.ambient_visibility) == (key, 1.0)), "{azimuth}");
    }
}

/// Whether a segment hits any triangle: Möller and Trumbore in `f64`, triangle by triangle.
fn is_blocked(mesh: &Mesh, from: DVec3, to: DVec3) -> bool {
    let direction = to - from;
    (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)).any(|corners| {
        let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
        let (edge_ab, edge_ac, to_origin) = (b - a, c - a, from - a);
        let p = direction.cross(edge_ac);
        let determinant = edge_ab.dot(p);
        let q = to_origin.cross(edge_ab);
        let (u, v) = (to_origin.dot(p) / determinant, direction.dot(q) / determinant);
        let t = edge_ac.dot(q) / determinant;
        u >= 0.0 && v >= 0.0 && u + v <= 1.0 && (0.0..=1.0).contains(&t)
    })
}

#[test]
fn shadows_match_a_search_of_all_triangles() {
    let mesh = statue::generate(2000, &|_| ());
    let scene = Scene::build(mesh.clone(), &GridOptions::default(), &|_| ());
    let spec = spec(DVec3::new(0.5, 1.2, 3.0), DVec3::Y, LightingMode::Shadows);
    let secondary = SecondaryRays::new(&scene.grid, &spec, None);
    let light = secondary.key_light.as_dvec3();
    let (mut n_dark, mut n_lit, mut n_wrong) = (0, 0, 0);
    for (direction, hit, visibility) in visibility(&scene, &spec) {
        let LiftedPoint { point, normal } = secondary.lift.point(secondary.eye, direction, hit).unwrap();
        if normal.dot(light - point) < 2.0 * secondary.lift.ray_offset {
            continue;
        }
        let blocked = is_blocked(&mesh, point, light);
        n_wrong += u32::from(blocked != (visibility.key == 0.0));
        n_dark += u32::from(blocked);
        n_lit += u32::from(!blocked);
    }
    assert!(n_dark > 20 && n_lit > 500 && n_wrong == 0, "{n_dark} dark, {n_lit} lit, {n_wrong} wrong");
}

#[test]
fn a_corner_is_more_occluded_than_a_plain() {
    let quad = [[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 4.0, 0.0], [-2.0, 4.0, 0.0]];
    let floor = [[-2.0, 0.0, 4.0], [2.0, 0.0, 4.0]];
    let mesh = Mesh {
        vertices: [&quad[..], &floor[..]].concat(),
        triangles: vec![[0, 1, 2], [0, 2, 3], [0, 1, 5], [0, 5, 4]],
        ..Mesh::default()
    };
    let scene = Scene::build(mesh, &GridOptions::default(), &|_| ());
    let spec = spec(DVec3::new(0.0, 3.0, 6.0), DVec3::Y, LightingMode::AmbientOcclusion);
    let secondary = SecondaryRays::new(&scene.grid, &spec, None);
    let mean_visibility = |height: f64| {
        let surface = LiftedPoint { point: DVec3::new(0.0, height, secondary.lift.ray_offset), normal: DVec3::Z };
        let samples = (0..256).map(|sample| ambient_visibility(&secondary, &surface, (3, 4), sample));
        samples.sum::<f32>() / 256.0
    };
    assert_eq!(mean_visibility(2.0), 1.0);
    // At the foot of the wall the floor hides half of the hemisphere, and with it half of the cosine-distributed rays.
    assert!((mean_visibility(1e-3) - 0.5).abs() < 0.03, "{}", mean_visibility(1e-3));
    assert!((0.5..1.0).contains(&mean_visibility(0.1)), "{}", mean_visibility(0.1));
}

#[test]
fn bases_and_circles_have_unit_length() {
    for bits in (0..1000u32).map(|n| n.wrapping_mul(0x9e37_79b9)) {
        let [x, y] = unit_circle(bits);
        assert!((x * x + y * y - 1.0).abs() < 1e-6);
        let [other, ..] = unit_circle(bits.rotate_left(13));
        let normal = Vec3::new(x, y, other - 0.5).normalize();
        let [a, b] = tangent_basis(normal);
        let products = [a.dot(b), a.dot(normal), b.dot(normal), a.dot(a) - 1.0, b.dot(b) - 1.0];
        assert!(products.iter().all(|product| product.abs() < 1e-5), "{normal} {products:?}");
    }
    let [a, b] = tangent_basis(Vec3::NEG_Z);
    assert!(a.is_finite() && b.is_finite());
}

#[test]
fn a_stray_triangle_does_not_change_the_reach_of_light() {
    let mesh = statue::generate(6000, &|_| ());
    let build = |mesh: Mesh| Scene::build(mesh, &GridOptions::default(), &|_| ());
    let spec = spec(DVec3::new(0.0, 1.0, 4.0), DVec3::new(0.0, 1.0, 0.0), LightingMode::AmbientOcclusion);
    let reach = |scene: &Scene| {
        let secondary = SecondaryRays::new(&scene.grid, &spec, None);
        (secondary.ao_radius, secondary.key_light)
    };
    let mut with_stray = mesh.clone();
    let first = mesh.vertices.len() as u32;
    with_stray.vertices.extend([[1000.0, 0.0, 0.0], [1000.0, 1.0, 0.0], [1000.0, 0.0, 1.0]]);
    with_stray.triangles.push([first, first + 1, first + 2]);
    assert_eq!(reach(&build(with_stray)), reach(&build(mesh)));
}

#[test]
fn ambient_rays_are_the_same_alone_and_among_others_with_all_instructions() {
    let seen: Vec<_> = (0..37u32)
        .map(|n| {
            let point = Vec3::new(n as f32, -0.5 * n as f32, 3.0);
            let normal = Vec3::new(n as f32 * 0.3 - 4.0, 1.0 - n as f32 * 0.1, (n % 5) as f32 - 2.0).normalize();
            Seen { point, normal, pixel: (n * 71, 900 - n) }
        })
        .collect();
    let rays_of = |seen: &[Seen], instructions: InstructionSet| {
        let mut rays = Vec::new();
        // SAFETY: the instructions are available.
        unsafe { instructions.call(AmbientRays { seen, sample: 7, radius: 2.5, rays: &mut rays }) };
        rays
    };
    let expected: Vec<_> =
        seen.iter().flat_map(|seen| rays_of(std::slice::from_ref(seen), InstructionSet::Portable)).collect();
    for instructions in InstructionSet::available() {
        assert_eq!(rays_of(&seen, instructions), expected, "{instructions:?}");
    }
    for (ray, seen) in expected.iter().zip(seen.iter().flat_map(|seen| [seen; N_AO_RAYS])) {
        assert!((ray.direction.length() - 1.0).abs() < 1e-5 && ray.direction.dot(seen.normal) > 0.0);
        assert!(ray.origin == seen.point && (0.0..=2.5).contains(&ray.t_max));
    }
}
