//! Closed surfaces, seen from inside: every ray must hit.

use glam::{DVec3, Vec3};
use renderer::{
    grid::{Grid, GridOptions},
    intersect::ray::Ray,
    model::mesh::Mesh,
};

use super::{
    contenders::{RayBundle, Tally, tally},
    solids,
};
use crate::random::Random;

const RAYS_PER_BUNDLE: usize = 64;

#[derive(Clone, Copy)]
pub(super) enum Aim {
    Anywhere,
    /// Every vertex and every edge midpoint, in turn.
    VerticesAndEdges,
}

/// Rays from inside a sphere of triangles. Hits must also lie on the sphere, as far as coordinates resolve it.
pub(super) fn sphere(centre: [f64; 3], radius: f64, aim: Aim, n_rays: u64) -> Tally {
    let mesh = solids::sphere(centre, radius, 16);
    let targets = targets(&mesh);
    let centre = DVec3::from_array(centre);
    let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
    let coarseness = centre.abs().max_element() * f64::from(f32::EPSILON) / radius;
    let shell = 0.97 - 2.0 * coarseness..=1.001 + 2.0 * coarseness;
    tally(
        &grid,
        n_rays.div_ceil(RAYS_PER_BUNDLE as u64),
        |index| {
            let mut random = Random::new(index);
            let origin = (centre + random.point().as_dvec3() * (0.4 * radius)).as_vec3();
            let direction = |lane: usize| match aim {
                Aim::Anywhere => random.point(),
                Aim::VerticesAndEdges => targets[(index as usize * RAYS_PER_BUNDLE + lane) % targets.len()] - origin,
            };
            let mut directions: Vec<Vec3> = (0..RAYS_PER_BUNDLE).map(direction).collect();
            directions.retain(|&direction| direction != Vec3::ZERO);
            RayBundle { origin, directions }
        },
        |_| (),
        |ray, (), answer| answer.is_some_and(|(_, t)| shell.contains(&((at(ray, t) - centre).length() / radius))),
    )
}

fn at(ray: &Ray, t: f64) -> DVec3 {
    ray.origin.as_dvec3() + ray.direction.as_dvec3() * t
}

/// All vertices and all edge midpoints.
fn targets(mesh: &Mesh) -> Vec<Vec3> {
    let vertex = |number: u32| Vec3::from_array(mesh.vertices[number as usize]);
    let edges = mesh.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
    // Two triangles share each edge; in one of them its vertex numbers ascend.
    let midpoints =
        edges.filter(|(p, q)| p < q).map(|(p, q)| ((vertex(p).as_dvec3() + vertex(q).as_dvec3()) * 0.5).as_vec3());
    (0..mesh.vertices.len() as u32).map(vertex).chain(midpoints).collect()
}

/// Rays inside a box, along planes between cells: every ray hits one of the box's six sides.
pub(super) fn cell_planes(n_rays: u64) -> Tally {
    const N: i32 = 12;
    // Four cells a unit: all cells of the tree end at multiples of 1/4ⁿ.
    let options = GridOptions { density: Some(64.0), ..GridOptions::default() };
    let grid = Grid::build(solids::mesh_of(&solids::cube(N), 1.0), &options, &|_| ());
    let expected = |ray: &Ray| {
        let exits = (0..3).filter(|&axis| ray.direction[axis] != 0.0).map(|axis| {
            let direction = f64::from(ray.direction[axis]);
            let side = if direction > 0.0 { f64::from(N) } else { 0.0 };
            (side - f64::from(ray.origin[axis])) / direction
        });
        exits.fold(f64::INFINITY, f64::min)
    };
    tally(
        &grid,
        n_rays.div_ceil(16),
        |index| {
            let mut random = Random::new(index);
            let origin = [(); 3].map(|()| random.whole(1, 16 * N - 1) as f32 / 16.0);
            let origin = Vec3::from_array(if random.bits() & 1 == 0 { origin.map(f32::ceil) } else { origin });
            let origin = origin.min(Vec3::splat(N as f32 - 0.25));
            let directions = (0..16).map(|_| {
                let mut direction = [(); 3].map(|()| random.whole(-16, 16) as f32 / 16.0);
                // Parallel to one plane, or to two.
                (0..=random.whole(0, 1)).for_each(|_| direction[random.whole(0, 2) as usize] = 0.0);
                let direction = Vec3::from_array(direction);
                let signs = [(); 3].map(|()| random.whole(0, 1) as f32 * 2.0 - 1.0);
                if direction == Vec3::ZERO { Vec3::X } else { direction * Vec3::from_array(signs) }
            });
            RayBundle { origin, directions: directions.collect() }
        },
        expected,
        |_, &expected, answer| answer.is_some_and(|(_, t)| (t - expected).abs() <= 1e-5 * expected),
    )
}

/// Rays from both sides at a plane of slivers, a million times as long as wide: every ray hits.
pub(super) fn slivers(n_rays: u64) -> Tally {
    const N: i32 = 32;
    const LENGTH: i32 = 1_000_000;
    let at = |x: i32, y: i32| [x, y, x + 2 * y];
    let pairs = (0..N).flat_map(|x| {
        let [a, b, c, d] = [at(x, 0), at(x + 1, 0), at(x + 1, LENGTH), at(x, LENGTH)];
        [[a, b, c], [a, c, d]]
    });
    let grid = Grid::build(solids::mesh_of(&pairs.collect(), 1.0), &GridOptions::default(), &|_| ());
    tally(
        &grid,
        n_rays.div_ceil(16),
        |index| {
            let mut random = Random::new(index);
            let origin = [random.whole(-N, 2 * N), random.whole(0, LENGTH), random.whole(-LENGTH, 4 * LENGTH)];
            let side = origin[2] - origin[0] - 2 * origin[1];
            let origin = if side == 0 { [origin[0], origin[1], origin[2] - 7] } else { origin };
            let directions = (0..16).map(|_| {
                let [x, y, z] = at(random.whole(0, N), random.whole(0, LENGTH));
                Vec3::new((x - origin[0]) as f32, (y - origin[1]) as f32, (z - origin[2]) as f32)
            });
            RayBundle { origin: Vec3::from_array(origin.map(|x| x as f32)), directions: directions.collect() }
        },
        |_| (),
        |_, (), answer| answer.is_some_and(|(_, t)| (t - 1.0).abs() <= 1e-4),
    )
}
