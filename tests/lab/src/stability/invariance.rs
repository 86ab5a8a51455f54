//! Transformations that must not change a hit: scale and position of the scene, its structure, division and instructions.

use glam::Vec3;
use rayon::prelude::*;
use renderer::{
    grid::{Grid, GridOptions, Storage},
    intersect::{
        InstructionSet, PacketScratch,
        ray::{Hit, Ray},
    },
    model::{mesh::Mesh, statue},
    render::scene::Scene,
};
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
};
use strum::VariantArray;

use super::contenders::{Answer, Contender, RayBundle, Tally};
use crate::{chart::view_all, random::Random, trace::frame::trace_share};

/// Scaling by a power of two changes no bit of any hit.
pub(super) fn scale(n_rays: u64) -> Tally {
    let mesh = statue::generate(3000, &|_| ());
    let scaled = |exponent| {
        let by = |vector: Vec3| vector * 2f32.powi(exponent);
        compare(&mesh, n_rays / 4, by, by, |before, after| before == after)
    };
    [-40, -20, 20, 40].into_iter().map(scaled).sum()
}

/// A translation that rounds no coordinate leaves the triangles of all hits.
pub(super) fn translation(n_rays: u64) -> Tally {
    let mut mesh = statue::generate(3000, &|_| ());
    for x in mesh.vertices.as_flattened_mut() {
        *x = on_lattice(*x);
    }
    let offsets =
        [Vec3::X * 16.0, Vec3::new(-1024.0, 512.0, 3.0), Vec3::splat(4096.0), Vec3::new(0.25, -8000.0, 8000.0)];
    let triangle = |answer: Answer| answer.map(|(file_index, _)| file_index);
    let is_same = |before, after| triangle(before) == triangle(after);
    let moved = |offset| compare(&mesh, n_rays / 4, |point| point + offset, |direction| direction, is_same);
    offsets.into_iter().map(moved).sum()
}

/// Rounds to multiples of 2⁻¹⁰, which have at most 24 bits below 2¹³.
fn on_lattice(x: f32) -> f32 {
    (x * 1024.0).round() / 1024.0
}

/// Traces the same rays before and after a transformation of points and directions; `is_same` compares the answers.
fn compare(
    mesh: &Mesh,
    n_rays: u64,
    point: impl Fn(Vec3) -> Vec3 + Sync,
    direction: impl Fn(Vec3) -> Vec3 + Sync,
    is_same: impl Fn(Answer, Answer) -> bool + Sync,
) -> Tally {
    let changed = Mesh {
        vertices: mesh.vertices.iter().map(|&vertex| point(Vec3::from_array(vertex)).to_array()).collect(),
        ..mesh.clone()
    };
    let grids = [mesh.clone(), changed].map(|mesh| Grid::build(mesh, &GridOptions::default(), &|_| ()));
    let one = |scratch: &mut PacketScratch, index: u64| {
        let mut random = Random::new(index);
        let origin = (Vec3::Y + random.point() * 8.0).to_array().map(on_lattice);
        let origin = Vec3::from_array(origin);
        // Roughly towards the model.
        let mut towards = || Vec3::from_array((Vec3::Y + random.point() * 3.0 - origin).to_array().map(on_lattice));
        let before = RayBundle { origin, directions: (0..32).map(|_| towards()).collect() };
        let after = RayBundle {
            origin: point(origin),
            directions: before.directions.iter().map(|&towards| direction(towards)).collect(),
        };
        let mut tally = Tally { n_rays: 32, ..Tally::default() };
        for contender in Contender::ALL {
            let [before, after_answers] = [(&grids[0], &before), (&grids[1], &after)]
                .map(|(grid, bundle)| contender.trace(grid, bundle, scratch));
            for ((ray, before), after) in after.rays().zip(before).zip(after_answers) {
                tally.count(contender, is_same(before, after), || format!("{ray:?}: {before:?} becomes {after:?}"));
            }
        }
        tally
    };
    (0..n_rays.div_ceil(32)).into_par_iter().map_init(PacketScratch::default, one).sum()
}

/// Every instruction set, storage, density, number of threads and division gives one hash of all hits, in packets, in batches
/// and alone.
pub(super) fn one_hash(n_rays: u64) -> Tally {
    let mesh = statue::generate(20_000, &|_| ());
    let camera = view_all(&mesh, 16.0 / 9.0);
    let mut ways = Vec::new();
    for &storage in Storage::VARIANTS {
        for density in [1.0, 32.0, 128.0].map(Some) {
            for n_threads in [1, 2] {
                ways.push((GridOptions { storage, density, ..GridOptions::default() }, n_threads));
            }
        }
    }
    let sets = InstructionSet::available();
    let divisions = [(Division::Tiled, 1), (Division::Tiled, 3), (Division::Interleaved, 5), (Division::Dynamic, 2)];
    let n_frames = (ways.len() * sets.len() * divisions.len()) as u64;
    let height = (n_rays / n_frames / 2).isqrt().clamp(16, 512) as u32;
    let Ok(size) = FrameSize::new(2 * height, height) else { return Tally::default() };

    let mut sum = Tally::default();
    let mut expected: Option<blake3::Hash> = None;
    for (options, n_threads) in ways {
        let Ok(pool) = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build() else { continue };
        let mut scene = pool.install(|| Scene::build(mesh.clone(), &options, &|_| ()));
        for &set in &sets {
            scene.grid = scene.grid.with_instructions(set);
            for (contender, n_rays) in [(Contender::Single, 1), (Contender::Batches, 1000)] {
                let hits = pool.install(|| hits_in_batches(&scene, &camera, size, n_rays));
                let is_same = *expected.get_or_insert(hits) == hits;
                sum.count(contender, is_same, || format!("{options:?}, {set:?}, {n_threads} threads give other hits"));
            }
            for (division, n_machines) in divisions {
                let hits = pool.install(|| hits(&scene, &camera, size, division, n_machines));
                let is_same = *expected.get_or_insert(hits) == hits;
                let mut tally = Tally { n_rays: u64::from(size.n_samples()), ..Tally::default() };
                tally.count(Contender::Packets, is_same, || {
                    format!("{options:?}, {set:?}, {division:?} give other hits")
                });
                sum += tally;
            }
        }
    }
    sum
}

/// The hash of a frame's hits, row by row. Its machines trace their shares one after the other, the last first.
fn hits(scene: &Scene, camera: &Camera, size: FrameSize, division: Division, n_machines: u32) -> blake3::Hash {
    let rays = camera.rays(size);
    let mut rows = vec![Hit::MISS; size.n_samples() as usize];
    for machine in (0..n_machines).rev() {
        let task = division.task(machine, n_machines);
        let Ok(share) = task.share(size) else { continue };
        trace_share(scene, &rays, &share, |block, hits| {
            for ((i, j), &hit) in block.samples().zip(hits) {
                rows[(j * size.xres() + i) as usize] = scene.with_file_index(hit);
            }
        });
    }
    hash(&rows)
}

/// The hash of a frame's hits, row by row, traced on all threads with `n_rays` rays in a call.
fn hits_in_batches(scene: &Scene, camera: &Camera, size: FrameSize, n_rays: usize) -> blake3::Hash {
    let rays = camera.rays(size);
    let samples = (0..size.n_samples()).map(|sample| rays.direction(sample % size.xres(), sample / size.xres()));
    let rays: Vec<_> = samples.map(|direction| Ray::new(rays.eye, direction)).collect();
    let mut hits = vec![Hit::MISS; rays.len()];
    let batches = rays.par_chunks(n_rays).zip(hits.par_chunks_mut(n_rays));
    batches.for_each(|(rays, hits)| {
        scene.grid.intersect_rays(rays, hits);
        hits.iter_mut().for_each(|hit| *hit = scene.with_file_index(*hit));
    });
    hash(&hits)
}

fn hash(hits: &[Hit]) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    for hit in hits {
        hasher.update(&hit.triangle.to_le_bytes());
        hasher.update(&hit.t.to_bits().to_le_bytes());
    }
    hasher.finalize()
}
