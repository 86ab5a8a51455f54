//! Rays that share nothing: from origins of their own, in batches of any size and order, with bad rays among good ones.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use renderer::{
    grid::{Grid, GridOptions, Storage},
    intersect::{InstructionSet, ray::Ray},
    model::mesh::Mesh,
};

use super::{
    contenders::{self, Answer, Contender, RayBundle, Tally, batch, tally},
    exact::{self, ExactTruth},
    lattice::{self, Aim},
    solids::{self, Lattice},
};
use crate::random::Random;

/// Radii of spheres about one centre: a billion to one.
const RADII: [f64; 10] = [1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1e0, 1e1, 1e2, 1e3, 1e4];

/// The sphere of triangles lies between these radii, relative to the sphere's.
const SHELL: [f64; 2] = [0.95, 1.0 + 1e-5];

/// Divides the number of rays, because the rays near the centre meet all triangles of the smallest spheres.
const COSTLY: u64 = 8;

/// Rays from between spheres, each of its own length, anywhere or grazing the next sphere within: every ray hits that one or
/// the one around, as its distance from the centre says.
pub(super) fn scales(n_rays: u64) -> Tally {
    let mut mesh = Mesh::default();
    for radius in RADII {
        let sphere = solids::sphere([0.0; 3], radius, 8);
        let first = mesh.vertices.len() as u32;
        mesh.triangles.extend(sphere.triangles.iter().map(|corners| corners.map(|vertex| vertex + first)));
        mesh.vertices.extend(sphere.vertices);
    }
    let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
    tally(
        &grid,
        n_rays / COSTLY / 4 + 1,
        |index| {
            let mut random = Random::new(index);
            let outer = *random.choose(&RADII[1..]);
            let unit = |random: &mut Random| random.point().as_dvec3().try_normalize().unwrap_or(DVec3::X);
            let origin = unit(&mut random) * (outer * (0.11 + 0.8 * f64::from(random.unit())));
            let direction = |lane: usize| {
                let target = match lane {
                    0 | 1 => unit(&mut random) * outer,
                    // Where rays from here touch the sphere within, or almost.
                    _ => {
                        let (inner, distance) = (0.1 * outer, origin.length());
                        let across = origin.cross(unit(&mut random)).try_normalize().unwrap_or(DVec3::Y);
                        let sine = inner / distance;
                        let touched =
                            origin / distance * (inner * sine) + across * (inner * (1.0 - sine * sine).sqrt());
                        touched * (0.94 + 0.07 * f64::from(random.unit()))
                    }
                };
                ((target - origin) * 2f64.powi(random.whole(-20, 20))).as_vec3()
            };
            RayBundle { directions: (0..4).map(direction).collect(), origin: origin.as_vec3() }
        },
        shells_ahead,
        |ray, ahead, answer| {
            answer.is_some_and(|(_, t)| {
                let at = (ray.origin.as_dvec3() + ray.direction.as_dvec3() * t).length();
                ahead.iter().flatten().any(|radius| (SHELL[0] * radius..=SHELL[1] * radius).contains(&at))
            })
        },
    )
}

/// The radii of the spheres that a ray from between two of them can hit first: the inner one, the outer one, or both where
/// only the triangles decide.
fn shells_ahead(ray: &Ray) -> [Option<f64>; 2] {
    let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3().normalize());
    let outer = RADII.into_iter().find(|radius| *radius > origin.length());
    let inner = RADII.into_iter().rfind(|radius| *radius < origin.length());
    let nearest = origin.cross(direction).length();
    match inner {
        Some(inner) if origin.dot(direction) < 0.0 && nearest < SHELL[1] * inner => {
            [Some(inner), outer.filter(|_| nearest > SHELL[0] * inner)]
        }
        _ => [None, outer],
    }
}

/// Rays of a batch: none, one, as many as are prepared together and one more or less, and many.
const BATCH_SIZES: [usize; 8] = [0, 1, 32, 63, 64, 65, 129, 1000];

/// Integer rays with limits of their own, in batches of several sizes, among rays that cannot be traced: a bad ray changes
/// no other's answer, nor does the order of a batch or the instruction set.
pub(super) fn mixed(n_rays: u64) -> Tally {
    let scenes: Vec<_> = (0..6).map(|seed| lattice::soup(700 + seed, 4 + 6 * seed as usize)).collect();
    let mean_size = BATCH_SIZES.iter().sum::<usize>() as u64 / BATCH_SIZES.len() as u64;
    let n_batches = n_rays.div_ceil(mean_size * scenes.len() as u64);
    let of_scene = |(scene, seed): (&Lattice, u64)| {
        let grid = || Grid::build(solids::mesh_of(scene, 1.0), &GridOptions::default(), &|_| ());
        let grids: Vec<_> = InstructionSet::available().into_iter().map(|set| grid().with_instructions(set)).collect();
        (0..n_batches).into_par_iter().map(|index| mixed_batch(scene, &grids, index << 8 | seed)).sum::<Tally>()
    };
    scenes.iter().zip(0..).map(of_scene).sum()
}

/// Tries one batch with one grid for each instruction set.
fn mixed_batch(scene: &Lattice, grids: &[Grid], seed: u64) -> Tally {
    let mut random = Random::new(seed);
    let n_rays = BATCH_SIZES[seed as usize / 256 % BATCH_SIZES.len()];
    let mut rays: Vec<(Ray, Option<ExactTruth>)> = Vec::new();
    while rays.len() < n_rays {
        let of_bundle: Vec<_> = lattice::bundle(scene, 1.0, Aim::All, &mut random).rays().collect();
        let ray = *random.choose(&of_bundle);
        rays.push(if random.bits() & 3 == 0 {
            (spoilt(ray, &mut random), None)
        } else {
            limited(scene, ray, &mut random)
        });
    }
    let batch_of = |order: &[usize]| order.iter().map(|&index| rays[index].0).collect::<Vec<_>>();
    let in_order: Vec<_> = (0..n_rays).collect();
    let mut shuffled = in_order.clone();
    for index in (1..n_rays).rev() {
        shuffled.swap(index, random.whole(0, index as i32) as usize);
    }

    let mut tally = Tally { n_rays: n_rays as u64, ..Tally::default() };
    for grid in grids {
        let answers = batch(grid, &batch_of(&in_order));
        let of_shuffled = batch(grid, &batch_of(&shuffled));
        let occluded = contenders::occluded(grid, &batch_of(&shuffled));
        for (place, &index) in shuffled.iter().enumerate() {
            let (ray, truth) = &rays[index];
            let answer: Answer = answers[index];
            let is_right = truth.as_ref().map_or(answer.is_none(), |truth| truth.allows(answer));
            let is_same = of_shuffled[place] == answer && occluded[place] == answer.is_some();
            tally.count(Contender::Batches, is_right && is_same, || {
                format!("{ray:?} is answered {answer:?} in its place among {n_rays}, {:?} shuffled", of_shuffled[place])
            });
        }
    }
    tally
}

/// Integer rays that lie close together and lead the same way, or almost, with limits of their own: they are hidden as each
/// is alone.
pub(super) fn together(n_rays: u64) -> Tally {
    const N_RAYS: usize = 32;
    let scenes: Vec<_> = (0..6).map(|seed| lattice::soup(900 + seed, 4 + 6 * seed as usize)).collect();
    let n_batches = n_rays.div_ceil((N_RAYS * scenes.len()) as u64);
    let of_scene = |(scene, seed): (&Lattice, u64)| {
        // The compact tree has its hierarchy over leaves, and the other over triangles.
        let grid = |set, storage| {
            let options = GridOptions { storage, ..GridOptions::default() };
            Grid::build(solids::mesh_of(scene, 1.0), &options, &|_| ()).with_instructions(set)
        };
        let sets = InstructionSet::available().into_iter();
        let grids: Vec<_> =
            sets.flat_map(|set| [Storage::Tree, Storage::Compact].map(|storage| grid(set, storage))).collect();
        let of_batch = |index: u64| {
            let mut random = Random::new(index << 8 | seed);
            let first = lattice::bundle(scene, 1.0, Aim::All, &mut random);
            let (spread, widening) = (random.whole(0, 2), random.whole(0, 1));
            let mut near = |most: i32| Vec3::from([(); 3].map(|()| random.whole(-most, most) as f32));
            let rays = [(); N_RAYS].map(|()| Ray {
                origin: first.origin + near(spread),
                ..Ray::new(Vec3::ZERO, first.directions[0] * 32.0 + near(widening))
            });
            let rays = rays.map(|ray| limited(scene, ray, &mut random));
            let batch: Vec<_> = rays.iter().map(|(ray, _)| *ray).collect();
            let mut tally = Tally { n_rays: N_RAYS as u64, ..Tally::default() };
            for grid in &grids {
                let answers = self::batch(grid, &batch);
                let occluded = contenders::occluded(grid, &batch);
                for (((ray, truth), answer), occluded) in rays.iter().zip(answers).zip(occluded) {
                    let is_right = truth.as_ref().is_some_and(|truth| truth.allows(answer));
                    tally.count(Contender::Batches, is_right && occluded == answer.is_some(), || {
                        format!("{ray:?} is answered {answer:?}, hidden: {occluded}")
                    });
                }
            }
            tally
        };
        (0..n_batches).into_par_iter().map(of_batch).sum::<Tally>()
    };
    scenes.iter().zip(0..).map(of_scene).sum()
}

/// A good ray, in half of the cases with limits, and its truth.
fn limited(scene: &Lattice, ray: Ray, random: &mut Random) -> (Ray, Option<ExactTruth>) {
    let whole = |vector: Vec3| vector.to_array().map(|x| x as i32);
    let truth = exact::truth(scene, whole(ray.origin), whole(ray.direction));
    let [t_min, t_max] = match random.whole(0, 3) {
        0 => [0.0, 2.0 * random.unit()],
        1 => [random.unit(), 1.0 + random.unit()],
        2 => [0.0, f32::INFINITY],
        _ => [0.0, f32::MAX],
    };
    (Ray { t_min, t_max, ..ray }, Some(truth.within(t_min, t_max)))
}

/// A ray that can hit nothing: with a component or a limit that is no number, from far too far away, without a direction, or
/// empty.
fn spoilt(mut ray: Ray, random: &mut Random) -> Ray {
    let bad = *random.choose(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY]);
    let axis = random.whole(0, 2) as usize;
    match random.whole(0, 6) {
        0 => ray.origin[axis] = bad,
        1 => ray.direction[axis] = bad,
        2 => ray.direction = Vec3::ZERO,
        3 => ray.t_min = f32::NAN,
        4 => ray.t_max = *random.choose(&[f32::NAN, f32::NEG_INFINITY, -1.0]),
        5 => [ray.t_min, ray.t_max] = [random.unit() + 1.0, random.unit() - 1e-3],
        _ => [ray.origin, ray.direction] = [Vec3::splat(f32::MAX), ray.direction.abs()],
    }
    ray
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use renderer::{grid::Storage, intersect::ray::Hit, render::threads};
    use strum::VariantArray;

    use super::{super::strategies, *};
    use crate::chart::reference::{self, Verdict};

    /// The answers to rays in batches of `n_rays`, on as many threads as the pool has: file index and bits of t, and whether
    /// anything is hit.
    fn answers(grid: &Grid, rays: &[Ray], n_rays: usize) -> Vec<(u32, u32, bool)> {
        let of_batch = |rays: &[Ray]| {
            let mut hits = vec![Hit::MISS; rays.len()];
            grid.intersect_rays(rays, &mut hits);
            let bits = |hit: Hit| {
                (if hit.is_miss() { hit.triangle } else { grid.mesh().file_index(hit.triangle) }, hit.t.to_bits())
            };
            let occluded = contenders::occluded(grid, rays);
            hits.into_iter()
                .zip(occluded)
                .map(|(hit, occluded)| (bits(hit).0, bits(hit).1, occluded))
                .collect::<Vec<_>>()
        };
        rays.par_chunks(n_rays).flat_map_iter(of_batch).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn a_ray_has_one_answer_however_it_is_traced(
            (mesh, rays) in strategies::mesh().prop_flat_map(|mesh| {
                let rays = prop::collection::vec(strategies::ray(&mesh), 1..150);
                (Just(mesh), rays)
            }),
        ) {
            let pool = threads::pool(Some(3)).unwrap();
            let triangles: Vec<_> = (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)).collect();
            let mut expected = None;
            for &storage in Storage::VARIANTS {
                let mut grid = Grid::build(mesh.clone(), &GridOptions { storage, ..GridOptions::default() }, &|_| ());
                for set in InstructionSet::available() {
                    grid = grid.with_instructions(set);
                    let expected = &*expected.get_or_insert_with(|| answers(&grid, &rays, 1));
                    for n_rays in [1, 7, 64, rays.len()] {
                        let found = pool.install(|| answers(&grid, &rays, n_rays));
                        prop_assert_eq!(&found, expected, "{:?}, {:?}, {} rays in a call", storage, set, n_rays);
                    }
                    let backwards: Vec<_> = rays.iter().rev().copied().collect();
                    let mut found = answers(&grid, &backwards, rays.len());
                    found.reverse();
                    prop_assert_eq!(&found, expected, "{:?}, {:?}, backwards", storage, set);
                }
            }
            for (ray, (number, t, occluded)) in rays.iter().zip(expected.unwrap_or_default()) {
                let t = f64::from(f32::from_bits(t));
                prop_assert_eq!(number != u32::MAX, occluded);
                let is_right = match reference::truth(ray, triangles.iter().copied()) {
                    Verdict::Unknown => true,
                    Verdict::Miss => !occluded,
                    Verdict::Hit(depth) if occluded => (t - depth).abs() <= 1e-4 * depth.max(1e-6),
                    Verdict::Hit(depth) => depth > f64::from(ray.t_max) * (1.0 - 1e-6),
                };
                prop_assert!(is_right, "{:?} is answered {} at {}", ray, number, t);
            }
        }
    }

    #[test]
    fn rays_between_spheres_know_what_is_ahead() {
        let ahead =
            |origin: f32, direction: [f32; 3]| shells_ahead(&Ray::new(Vec3::X * origin, Vec3::from_array(direction)));
        assert_eq!(ahead(5.0, [1.0, 0.0, 0.0]), [None, Some(10.0)]);
        assert_eq!(ahead(5.0, [-1.0, 0.0, 0.0]), [Some(1.0), None]);
        assert_eq!(ahead(5.0, [-1.0, 0.2, 0.0]), [Some(1.0), Some(10.0)]);
        assert_eq!(ahead(5.0, [-1.0, 0.5, 0.0]), [None, Some(10.0)]);
    }
}
