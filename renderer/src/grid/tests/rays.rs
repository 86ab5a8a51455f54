//! Rays that share nothing, many at a time.

use super::*;
use crate::{
    intersect::{InstructionSet, RayCost},
    model::statue,
};

/// Directions of every kind: random, along axes, almost along axes, with zeros of either sign.
fn direction() -> impl Strategy<Value = Vec3> {
    let component =
        prop_oneof![4 => -1.0..1.0f32, 1 => prop::sample::select(vec![0.0, -0.0, 1.0, -1.0, 1e-13, -1e-13, 1e-30])];
    prop::array::uniform3(component)
        .prop_map(Vec3::from_array)
        .prop_filter("a direction", |direction| *direction != Vec3::ZERO)
}

/// A ray from a triangle's surface, lifted off by part of its size, or from anywhere.
fn ray(mesh: &Mesh) -> impl Strategy<Value = Ray> + use<> {
    let corners: Vec<_> = (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)).collect();
    let on_surface = (prop::sample::select(corners), prop::array::uniform3(0.0..1.0f32), -1.0..1.0f32).prop_map(
        |(corners, weights, lift)| {
            let [a, b, c] = corners.map(Vec3::from_array);
            let [u, v, w] = weights;
            (a * u + b * v + c * w) / (u + v + w).max(1e-3) + (b - a).cross(c - a).normalize_or_zero() * lift * 1e-3
        },
    );
    let anywhere = prop::array::uniform3(-8.0..8.0f32).prop_map(Vec3::from_array);
    let length = prop_oneof![2 => Just(f32::MAX), 1 => Just(f32::INFINITY), 3 => 0.0..2.0f32, 1 => Just(0.0f32)];
    (prop_oneof![3 => on_surface, 1 => anywhere], direction(), length)
        .prop_map(|(origin, direction, t_max)| Ray { t_max, ..Ray::new(origin, direction) })
}

/// The same grid as larger scans have it: the hierarchy lies over the tree's leaves.
fn over_leaves(mut grid: Grid) -> Grid {
    let Structure::Tree(tree) = &mut grid.structure else { panic!("no tree") };
    tree.hierarchy = tree.hierarchy_over_leaves();
    grid
}

/// The same grid, in which all rays that lead the same way go together, however fine its triangles are.
fn in_bundles(mut grid: Grid) -> Grid {
    let Structure::Tree(tree) = &mut grid.structure else { panic!("no tree") };
    tree.hierarchy.typical_area = f32::INFINITY;
    grid
}

/// Each of the rays together is occluded where it hits something alone, with any instructions.
fn check_occluded(mut grid: Grid, rays: &[Ray]) -> Result<(), TestCaseError> {
    for instructions in InstructionSet::available() {
        grid = grid.with_instructions(instructions);
        let mut occluded = vec![false; rays.len()];
        grid.occluded_rays(rays, &mut occluded);
        for (ray, occluded) in rays.iter().zip(occluded) {
            prop_assert_eq!(occluded, !grid.intersect(ray).is_miss(), "{:?}: {:?}", instructions, ray);
        }
    }
    Ok(())
}

/// Rays that begin close together and lead the same way, or almost.
fn rays_together(mesh: &Mesh) -> impl Strategy<Value = Vec<Ray>> + use<> {
    let size = prop_oneof![Just(0.0f32), Just(1e-5), Just(1e-2), Just(0.5)];
    let difference = || (prop::array::uniform3(-1.0..1.0f32), prop::array::uniform3(-1.0..1.0f32), 0.0..2.0f32);
    (ray(mesh), size.clone(), size, prop::collection::vec(difference(), 16..40)).prop_map(
        |(first, spread, widening, differences)| {
            let together = |(origin, direction, length): ([f32; 3], [f32; 3], f32)| Ray {
                origin: first.origin + Vec3::from(origin) * spread,
                direction: first.direction + Vec3::from(direction) * (widening * 0.05 * first.direction.length()),
                t_min: 0.0,
                t_max: if length < 1.0 { length } else { first.t_max },
            };
            differences.into_iter().map(together).collect()
        },
    )
}

/// Many rays that begin close together and lead anywhere, most of them short, and some that no grid can hold.
fn rays_around(mesh: &Mesh) -> impl Strategy<Value = Vec<Ray>> + use<> {
    let spread = prop_oneof![Just(0.0f32), Just(1e-3), Just(0.1), Just(2.0)];
    let length = || prop_oneof![4 => 0.0..0.3f32, 1 => 0.0..3.0f32];
    let far = (prop::sample::select(vec![Vec3::X, Vec3::NEG_Y, Vec3::Z]), prop::sample::select(vec![1e15, f32::NAN]));
    let each =
        || (prop::array::uniform3(-1.0..1.0f32), direction(), length(), prop::option::weighted(0.1, far.clone()));
    (ray(mesh), spread, prop::collection::vec(each(), 30..200)).prop_map(|(first, spread, each)| {
        let around = |(origin, direction, t_max, far): ([f32; 3], Vec3, f32, Option<(Vec3, f32)>)| {
            let origin = first.origin + Vec3::from(origin) * spread;
            // Along an axis, single precision aims well from far away.
            let from_far = far.map(|(axis, distance)| Ray::new(origin - axis * distance, axis));
            from_far.unwrap_or(Ray { t_max, ..Ray::new(origin, direction) })
        };
        each.into_iter().map(around).collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn rays_that_begin_close_together_are_occluded_as_alone(
        (mesh, rays) in prop_oneof![Just(cube(4)), Just(statue::generate(6000, &|_| ()))].prop_flat_map(|mesh| {
            let rays = rays_around(&mesh);
            (Just(mesh), rays)
        }),
    ) {
        for grid in [build(&mesh), over_leaves(build(&mesh))] {
            check_occluded(grid, &rays)?;
        }
    }

    #[test]
    fn rays_alone_between_bundles_are_occluded_as_alone(
        (mesh, rays) in Just(statue::generate(6000, &|_| ())).prop_flat_map(|mesh| {
            let parts = (rays_around(&mesh), rays_together(&mesh), rays_around(&mesh), rays_together(&mesh));
            (Just(mesh), parts)
        }),
    ) {
        let (alone, bundle, others, another) = rays;
        let parts = [(alone.clone(), 48), (bundle, 16), (others, 64), (another, 16), (alone, 33)];
        let rays: Vec<_> = parts.into_iter().flat_map(|(rays, n)| rays.into_iter().cycle().take(n)).collect();
        check_occluded(in_bundles(build(&mesh)), &rays)?;
    }

    #[test]
    fn rays_that_go_together_are_occluded_as_alone(
        (mesh, rays) in prop_oneof![Just(cube(4)), Just(statue::generate(6000, &|_| ()))].prop_flat_map(|mesh| {
            let rays = rays_together(&mesh);
            (Just(mesh), rays)
        }),
    ) {
        let compact = GridOptions { storage: Storage::Compact, ..GridOptions::default() };
        let compact = Grid::build(mesh.clone(), &compact, &|_| ());
        for grid in [build(&mesh), over_leaves(build(&mesh)), compact] {
            check_occluded(in_bundles(grid), &rays)?;
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(8))]

    /// The statue's leaves have many groups of boxes.
    #[test]
    fn rays_from_surfaces_hit_as_by_brute_force_in_any_batch_with_any_instructions(
        rays in prop::collection::vec(ray(&statue::generate(6000, &|_| ())), 1..80),
        precision in prop_oneof![Just(0), Just(10u8)],
    ) {
        let mesh = statue::generate(6000, &|_| ()).snapped(precision.try_into().unwrap());
        let (mut hits, mut occluded) = (vec![Hit::MISS; rays.len()], vec![false; rays.len()]);
        let grid = build(&mesh);
        grid.intersect_rays(&rays, &mut hits);
        hits.iter_mut().for_each(|hit| *hit = with_file_index(&grid, *hit));
        grid.occluded_rays(&rays, &mut occluded);
        for (index, ray) in rays.iter().enumerate() {
            prop_assert_eq!(with_file_index(&grid, grid.intersect(ray)), hits[index]);
            prop_assert_eq!(occluded[index], !hits[index].is_miss());
            let whole = Ray { t_max: f32::MAX, ..*ray };
            check(&mesh, &grid, &whole);
            let unlimited = with_file_index(&grid, grid.intersect(&whole));
            let is_beyond = unlimited.t > ray.t_max;
            prop_assert!(hits[index] == unlimited || (hits[index].is_miss() && is_beyond), "{:?}", ray);
        }
        for instructions in InstructionSet::available() {
            for grid in [build(&mesh), over_leaves(build(&mesh))] {
                let (grid, mut same) = (grid.with_instructions(instructions), vec![Hit::MISS; rays.len()]);
                grid.intersect_rays(&rays, &mut same);
                same.iter_mut().for_each(|hit| *hit = with_file_index(&grid, *hit));
                prop_assert_eq!(&same, &hits, "{:?}", instructions);
            }
        }
    }
}

#[test]
fn no_ray_leaves_a_closed_mesh_on_a_coarse_lattice() {
    let mesh = statue::generate(20_000, &|_| ()).snapped(8.try_into().unwrap());
    let has_area = |&triangle: &usize| {
        let [a, b, c] = mesh.corners(triangle).unwrap().map(Vec3::from_array);
        (b - a).cross(c - a) != Vec3::ZERO
    };
    assert!((0..mesh.triangles.len()).filter(has_area).count() < mesh.triangles.len() - 100, "few lose their area");
    let grid = build(&mesh);
    let [low, high] = mesh.bounds().corners().map(glam::DVec3::as_vec3);
    let into = Ray::new(Vec3::new(2.0 * high.x, 0.5 * (low.y + high.y), 0.5 * (low.z + high.z)), -Vec3::X);
    let first = grid.intersect(&into).t;
    let second = grid.intersect(&Ray { t_min: first * 1.01, ..into }).t;
    let inside = into.origin + into.direction * (0.5 * (first + second));
    // Toward vertices, and points on edges.
    for [a, b, _] in (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)) {
        let [a, b] = [a, b].map(Vec3::from_array);
        for target in [a, 0.5 * (a + b), a.lerp(b, 0.3)] {
            assert!(!grid.intersect(&Ray::new(inside, target - inside)).is_miss(), "{target}");
        }
    }
}

#[test]
fn rays_that_lead_nowhere_miss_in_bounded_time() {
    let mesh = statue::generate(6000, &|_| ());
    let numbers = [0.0, -0.0, 1.0, f32::MIN_POSITIVE, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, f32::NAN];
    let mut rays = Vec::new();
    for a in numbers {
        for b in numbers {
            for (t_min, t_max) in [(0.0, f32::MAX), (a, b), (f32::NAN, 1.0), (0.0, f32::NAN), (1.0, 0.0)] {
                rays.push(Ray { origin: Vec3::new(a, 0.5, b), direction: Vec3::new(b, a, 1.0), t_min, t_max });
                rays.push(Ray { origin: Vec3::splat(a), direction: Vec3::splat(b), t_min, t_max });
            }
        }
    }
    for grid in [build(&mesh), over_leaves(build(&mesh))] {
        let mut hits = vec![Hit::MISS; rays.len()];
        grid.intersect_rays(&rays, &mut hits);
        let mut occluded = vec![false; rays.len()];
        grid.occluded_rays(&rays, &mut occluded);
        assert!(hits.iter().zip(occluded).all(|(hit, occluded)| hit.is_miss() != occluded));
        for (ray, hit) in rays.iter().zip(&hits) {
            let is_sound = ray.origin.is_finite() && ray.direction.is_finite() && ray.t_min <= ray.t_max;
            assert!(is_sound || hit.is_miss(), "{ray:?} hits {hit:?}");
            let RayCost { n_cells, n_tests } = grid.cost(ray);
            assert!(n_cells < 1000 && n_tests < 6000, "{ray:?}");
        }
    }
}

/// The pairs of such a bundle and its triangles fill several vectors. In tiny scenes, products of lengths are no normal numbers.
#[test]
fn bundles_over_small_triangles_are_occluded_as_alone() {
    for scale in [1.0, 1e-12, 1e-18, 1e12] {
        check_bundles_over_small_triangles(scale);
    }
}

fn check_bundles_over_small_triangles(scale: f32) {
    let mut mesh = statue::generate(20_000, &|_| ());
    mesh.vertices.as_flattened_mut().iter_mut().for_each(|coordinate| *coordinate *= scale);
    let [low, high] = mesh.bounds().corners().map(glam::DVec3::as_vec3);
    let (centre, size) = (0.5 * (low + high), (high - low).max_element());
    let mut rays = Vec::new();
    for bundle in 0..200 {
        let angle = 0.37 * bundle as f32;
        let toward = Vec3::new(angle.cos(), 0.2, angle.sin());
        let beside = Vec3::new(-angle.sin(), 0.0, angle.cos());
        for lane in 0..16 {
            let across = beside * (lane % 4) as f32 + Vec3::Y * (lane / 4) as f32;
            let start = centre - toward * size + Vec3::Y * (0.02 * size * (bundle % 23 - 11) as f32);
            let t_max = size * (0.3 + 0.1 * (lane * 7 % 11) as f32);
            let t_min = size * 0.01;
            rays.push(Ray { t_min, t_max, ..Ray::new(start + across * (0.004 * size), toward) });
        }
    }
    for grid in [build(&mesh), over_leaves(build(&mesh))] {
        let n_occluded = rays.iter().filter(|ray| grid.occluded(ray)).count();
        assert!((rays.len() / 4..rays.len() * 3 / 4).contains(&n_occluded), "{n_occluded}");
        check_occluded(in_bundles(grid), &rays).unwrap();
    }
}
