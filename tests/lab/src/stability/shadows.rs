//! Shadow rays must neither hit the surface that they start from (acne) nor miss an occluder that touches it (contact).

use glam::{DVec3, Vec3};
use renderer::{
    grid::{Grid, GridOptions},
    intersect::{
        PacketScratch,
        ray::{Hit, Ray},
    },
    model::mesh::Mesh,
    render::{blocks::SampleBlock, secondary::SecondaryRays},
};
use shared::{
    camera::Camera,
    division::{FrameSize, SampleRect},
    protocol::{FrameSpec, LightingMode},
    scene::SceneId,
};

use super::{
    contenders::{Contender, Tally, nearest_candidate},
    solids,
};
use crate::{chart::methods::Method, farm::frame_spec};

/// Start of the rivals' shadow rays, as usual: this fraction of the way to the light.
const USUAL_EPSILON: f32 = 1e-4;

/// A sphere shades itself where it faces away from the light, and nowhere else.
pub(super) fn acne(n_rays: u64) -> Tally {
    let places = [(0.0, 1.0), (1000.0, 1.0), (0.0, 1e-6), (-1e6, 1e6), (3.0, 1e6)];
    let mut sum = Tally::default();
    for (centre, radius) in places {
        let mesh = solids::sphere([centre; 3], radius, 40);
        let centre = DVec3::splat(centre);
        let eye = centre + DVec3::new(0.5, 0.6, 1.0) * (1.5 * radius);
        let Ok(camera) = Camera::look_at(eye, centre, DVec3::Y, 0.9, 2.0) else { continue };
        let light = centre + DVec3::new(-1.0, 3.0, 2.0) * radius;
        // Near the terminator the angles of single triangles decide.
        let expect = |point: DVec3, normal: DVec3| {
            let cosine = normal.dot((light - point).normalize());
            (cosine.abs() > 1e-3 && (point - centre).length() < 1.1 * radius).then_some(cosine > 0.0)
        };
        sum += light_of(mesh, &camera, light, n_rays / places.len() as u64, expect);
    }
    sum
}

/// A wall on a floor: behind the wall the floor is dark up to the wall's foot, before it lit.
pub(super) fn contact(n_rays: u64) -> Tally {
    let offsets = [0.0, 100.0, 1e4];
    let mut sum = Tally::default();
    for offset in offsets {
        let quad = |corners: [[f32; 3]; 4]| corners.map(|corner| corner.map(|x| x + offset));
        let floor = quad([[-2.0, 0.0, -2.0], [2.0, 0.0, -2.0], [2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]]);
        let wall = quad([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [-2.0, 1.0, 0.0]]);
        let mesh = Mesh {
            vertices: [floor, wall].concat(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
            ..Mesh::default()
        };
        let offset = f64::from(offset);
        let at = |x: f64, y: f64, z: f64| DVec3::new(x, y, z) + DVec3::splat(offset);
        let light = at(0.3, 1.5, 3.0);
        // Rounding of the largest coordinate hides on which side of the wall a nearer point lies.
        let nearest = 100.0 * f64::from(f32::EPSILON) * (offset + 2.0);
        let expect = |point: DVec3, normal: DVec3| {
            let z = point.z - offset;
            (normal.y > 0.5 && z.abs() > nearest && z.abs() < 1.0).then_some(z > 0.0)
        };
        // From above: strips on both sides of the wall's foot, of decreasing width.
        for (side, width) in [1.0, 1e-2, 1e-3].into_iter().flat_map(|width: f64| [(-width, width), (width, width)]) {
            let (eye, ll) = (at(0.1, 4.0, 0.5 * side), at(-1.0, 2.0, side));
            let Ok(camera) = Camera::new(eye, ll, DVec3::X * 2.0, DVec3::NEG_Z * width) else { continue };
            sum += light_of(mesh.clone(), &camera, light, n_rays / (6 * offsets.len() as u64), expect);
        }
    }
    sum
}

/// Compares the visibility of the light at a camera's hits with `expect`, which takes a point and its normal; `None` leaves
/// the point out.
fn light_of(
    mesh: Mesh,
    camera: &Camera,
    light: DVec3,
    n_rays: u64,
    expect: impl Fn(DVec3, DVec3) -> Option<bool>,
) -> Tally {
    let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
    let side = 8 * ((n_rays / 2).isqrt() as u32 / 8).clamp(4, 256);
    let Ok(size) = FrameSize::new(2 * side, side) else { return Tally::default() };
    let spec = FrameSpec {
        rays: LightingMode::Shadows,
        ..frame_spec(SceneId::Statue { triangles: 0, treatment: Default::default() }, *camera, size)
    };
    let light = light.as_vec3();
    let mut secondary = SecondaryRays::new(&grid, &spec, None);
    secondary.key_light = light;
    let rays = camera.rays(size);
    let mut scratch = PacketScratch::default();
    let mut tally = Tally::default();
    for tile in 0..size.n_samples() / 64 {
        let (first_i, first_j) = (tile % (size.xres() / 8) * 8, tile / (size.xres() / 8) * 8);
        let samples = SampleRect { columns: first_i..first_i + 8, rows: first_j..first_j + 8 };
        let mut directions = [Vec3::ZERO; 64];
        directions.iter_mut().zip(samples.iter()).for_each(|(to, (i, j))| *to = rays.direction(i, j));
        let hits = directions.map(|direction| grid.intersect(&Ray::new(rays.eye, direction)));
        let blocks = [SampleBlock::Unit { samples, first_index: 0 }];
        let [visibility, ..] = secondary.visibility(&blocks, 0, &[directions], &[hits], &mut scratch);
        for lane in (0..64).filter(|&lane| !hits[lane].is_miss()) {
            let ray = Ray::new(rays.eye, directions[lane]);
            let (point, normal) = surface(&grid, &ray, hits[lane]);
            let Some(is_lit) = expect(point, normal) else { continue };
            tally.n_rays += 1;
            tally.count(Contender::Packets, (visibility[lane].key == 1.0) == is_lit, || {
                format!("{point} should be {}", if is_lit { "lit" } else { "dark" })
            });
            for contender in Contender::ALL {
                let Contender::Rival(method) = contender else { continue };
                let is_seen_lit = reaches_light(&grid, method, &ray, light);
                tally.count(contender, is_seen_lit == Some(is_lit), String::new);
            }
        }
    }
    tally
}

/// The intersection of a ray with a triangle's plane, and the plane's normal towards the ray's origin, in `f64`.
fn surface(grid: &Grid, ray: &Ray, hit: Hit) -> (DVec3, DVec3) {
    let [a, b, c] = grid.mesh().corners(hit.triangle).map(|corner| Vec3::from_array(corner).as_dvec3());
    let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
    let normal = (b - a).cross(c - a).normalize();
    let t = (a - origin).dot(normal) / direction.dot(normal);
    (origin + direction * t, if normal.dot(direction) > 0.0 { -normal } else { normal })
}

/// The usual way: the shadow ray starts a little beyond the ray's point at t. `None` if the method misses.
fn reaches_light(grid: &Grid, method: Method, ray: &Ray, light: Vec3) -> Option<bool> {
    let (triangle_idx, t) = nearest_candidate(grid, method, ray)?;
    let point = ray.origin + ray.direction * t as f32;
    let [a, b, c] = grid.mesh().corners(triangle_idx).map(Vec3::from_array);
    let normal = (b - a).cross(c - a);
    if normal.dot(light - point) * normal.dot(-ray.direction) <= 0.0 {
        return Some(false);
    }
    let shadow = Ray { t_min: USUAL_EPSILON, t_max: 1.0, ..Ray::new(point, light - point) };
    let mut is_lit = true;
    grid.for_each_candidate(&shadow, |triangle_idx| {
        let t = method.intersect(&shadow, &grid.mesh().corners(triangle_idx));
        is_lit &= !t.is_some_and(|t| (f64::from(shadow.t_min)..=1.0).contains(&t));
    });
    Some(is_lit)
}
