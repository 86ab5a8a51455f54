//! Hostile input: vertices and rays that are not finite, and many triangles in one place.

use glam::Vec3;
use renderer::{
    formats::ply,
    grid::{Grid, GridOptions},
    intersect::{PacketScratch, ray::Ray},
};

use super::{
    contenders::{Contender, RayBundle, Tally, tally},
    lattice::{self, Aim},
    solids,
};
use crate::random::Random;

/// Triangles with invalid corners among valid ones, read from a file.
pub(super) fn bad_vertices(n_rays: u64) -> Tally {
    let mut sum = Tally::default();
    for seed in 0..8 {
        let scene = lattice::soup(500 + seed, 20);
        let mut mesh = solids::mesh_of(&scene, 1.0);
        let (n_triangles, n_vertices) = (mesh.triangles.len(), mesh.vertices.len() as u32);
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30] {
            for axis in 0..3 {
                let mut vertex = [1.0; 3];
                vertex[axis] = bad;
                let number = mesh.vertices.len() as u32;
                mesh.vertices.push(vertex);
                mesh.triangles.extend([[number, 0, 1], [2, number, number], [number, n_vertices, 5]]);
            }
        }
        let mut file = Vec::new();
        let written = ply::write_to(&mut file, &mesh);
        let read = written.ok().and_then(|()| ply::read_from(&*file, file.len() as u64).ok()).unwrap_or_default().mesh;
        let all_rejected = read.n_rejected + n_triangles == mesh.triangles.len();
        let mut tally = lattice::one(&scene, read, 1.0, Aim::All, n_rays / 8, seed);
        tally.count(Contender::Single, all_rejected, || "an invalid vertex was accepted".to_owned());
        sum += tally;
    }
    sum
}

/// A hundred thousand triangles in one place: rays hit the first, in bounded time and memory.
pub(super) fn coincident(n_rays: u64) -> Tally {
    const N: usize = 100_000;
    let triangle = [[0, 0, 5], [16, 0, 5], [0, 16, 5]];
    let mesh = solids::mesh_of(&vec![triangle; N], 1.0);
    let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
    // Each ray tests all triangles, so there are few.
    let mut tally = tally(
        &grid,
        n_rays / 1_000_000 + 1,
        |index| {
            let mut random = Random::new(index);
            let direction = |_| Vec3::new(random.whole(1, 7) as f32, random.whole(1, 7) as f32, 5.0);
            RayBundle { origin: Vec3::ZERO, directions: (0..32).map(direction).collect() }
        },
        |_| (),
        |_, (), answer| answer.is_some_and(|(number, t)| number == 0 && (t - 1.0).abs() < 1e-6),
    );
    let is_small = grid.shortage().is_none() && grid.n_bytes() < 200 * N;
    tally.count(Contender::Single, is_small, || format!("the grid takes {} bytes", grid.n_bytes()));
    tally
}

/// Components that rays should not have.
const ODD: [f32; 10] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, 1e-45, -1e-45, -0.0, 0.0, 1.0];

/// Rays with odd components terminate, and hit nothing unless all components are finite.
pub(super) fn odd_rays(n_rays: u64) -> Tally {
    let scene = lattice::soup(600, 40);
    let grid = Grid::build(solids::mesh_of(&scene, 1.0), &GridOptions::default(), &|_| ());
    let triangles: Vec<_> =
        (0..grid.mesh().n_triangles() as u32).map(|triangle_idx| grid.mesh().corners(triangle_idx)).collect();
    let mut sum = Tally::default();
    let mut scratch = PacketScratch::default();
    for index in 0..n_rays.div_ceil(8) {
        let mut random = Random::new(index);
        let mut vector = || Vec3::from_array([(); 3].map(|()| *random.choose(&ODD)));
        let bundle = RayBundle { origin: vector(), directions: (0..8).map(|_| vector()).collect() };
        for contender in Contender::ALL {
            let answers = match contender {
                // The grid would drop the ray before a method sees it.
                Contender::Rival(method) => {
                    let hits = |ray: Ray| triangles.iter().find_map(|corners| method.intersect(&ray, corners));
                    bundle.rays().map(|ray| hits(ray).map(|t| (0, t))).collect()
                }
                _ => contender.trace(&grid, &bundle, &mut scratch),
            };
            for (ray, answer) in bundle.rays().zip(answers) {
                let is_finite = ray.origin.is_finite() && ray.direction.is_finite();
                let is_right = match answer {
                    Some((_, t)) => is_finite && t.is_finite(),
                    None => true,
                };
                sum.count(contender, is_right, || format!("{ray:?} is answered {answer:?}"));
            }
        }
        for ray in bundle.rays() {
            sum.n_rays += 1;
            let is_short = grid.cost(&ray).n_cells <= MOST_CELLS;
            sum.count(Contender::Single, is_short, || format!("{ray:?} passes {:?}", grid.cost(&ray)));
            for t_max in [f32::NAN, f32::INFINITY, -1.0] {
                let odd = Ray { t_max, ..ray };
                let may_hit = t_max == f32::INFINITY && ray.origin.is_finite() && ray.direction.is_finite();
                let is_right = may_hit || (grid.intersect(&odd).is_miss() && !grid.occluded(&odd));
                sum.count(Contender::Single, is_right, || format!("{odd:?} hits something"));
            }
        }
    }
    sum
}

/// More cells than a ray can pass here: each axis has a few hundred at most.
const MOST_CELLS: u32 = 10_000;
