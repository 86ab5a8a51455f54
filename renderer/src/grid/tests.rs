//! The grid against brute force: every triangle tested, in plain `f64`.

mod packets;
mod rays;

use glam::Vec3;
use proptest::prelude::*;
use strum::VariantArray;

use super::{Grid, GridOptions, MemoryBudget, Storage, Structure, build::PROGRAM_BYTES, tree::overlap::DILATION};
use crate::{
    grid::{cells::CellStructure, traced::TracedMesh},
    intersect::ray::{Hit, Ray},
    model::mesh::Mesh,
};

/// Differences below this are left to rounding.
const MARGIN: f64 = 1e-9;

/// The t of a hit: plane first, then the point against each edge. Independent of [`crate::intersect::triangle`].
///
/// Second: the point's distance from the nearest edge, positive inside, relative to the triangle's size; near 0
/// rounding decides.
fn intersect_in_f64(ray: &Ray, corners: [[f32; 3]; 3]) -> Option<(f64, f64)> {
    let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
    let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
    let normal = (b - a).cross(c - a);
    let t = (a - origin).dot(normal) / direction.dot(normal);
    let point = origin + direction * t;
    let size = normal.length();
    let inside = [(a, b), (b, c), (c, a)]
        .into_iter()
        .map(|(p, q)| (q - p).cross(point - p).dot(normal) / (size * size))
        .fold(f64::INFINITY, f64::min);
    (t.is_finite() && inside.is_finite() && t >= f64::from(ray.t_min) - MARGIN).then_some((t, inside))
}

/// Checks the grid's hit against all triangles. Where rounding decides, both answers are right.
fn check(mesh: &Mesh, grid: &Grid, ray: &Ray) {
    let hit = with_file_index(grid, grid.intersect(ray));
    let candidates: Vec<_> = (0..mesh.triangles.len())
        .filter_map(|triangle| Some((triangle as u32, intersect_in_f64(ray, mesh.corners(triangle)?)?)))
        .collect();
    let nearest_certain = candidates
        .iter()
        .filter(|(_, (t, inside))| *inside > MARGIN && *t > f64::from(ray.t_min) + MARGIN)
        .map(|(_, (t, _))| *t)
        .fold(f64::INFINITY, f64::min);
    let close = |a: f64, b: f64| (a - b).abs() <= 1e-6 * (1.0 + a.abs().max(b.abs()));
    if hit.is_miss() {
        assert!(nearest_certain.is_infinite(), "{ray:?} misses the hit at {nearest_certain}");
    } else {
        let (_, (t, inside)) =
            *candidates.iter().find(|(triangle, _)| *triangle == hit.triangle).unwrap_or_else(|| {
                panic!("{ray:?} hits {hit:?}, which it does not even approach");
            });
        assert!(
            inside > -MARGIN && close(t, f64::from(hit.t)),
            "{ray:?} hits {hit:?}; truly {t} and inside by {inside}"
        );
        assert!(t <= nearest_certain || close(t, nearest_certain), "{ray:?} hits {hit:?} behind {nearest_certain}");
    }
    assert_eq!(grid.occluded(ray), !hit.is_miss(), "{ray:?}");
}

/// The hit with the file index instead of the triangle index.
fn with_file_index(grid: &Grid, hit: Hit) -> Hit {
    if hit.is_miss() { hit } else { Hit { triangle: grid.mesh().file_index(hit.triangle), ..hit } }
}

fn build(mesh: &Mesh) -> Grid {
    Grid::build(mesh.clone(), &GridOptions::default(), &|_| ())
}

/// A grid in every mode, the default first.
fn build_modes(mesh: &Mesh) -> Vec<Grid> {
    let uniform = [Storage::Plain, Storage::RowDisplacement].into_iter();
    let modes = [(Storage::Tree, 3), (Storage::Compact, 3)].into_iter();
    let modes = modes.chain(uniform.flat_map(|storage| [(storage, 3), (storage, 0)]));
    modes
        .map(|(storage, macrocell_levels)| {
            let options = GridOptions { storage, macrocell_levels, ..GridOptions::default() };
            Grid::build(mesh.clone(), &options, &|_| ())
        })
        .collect()
}

/// [`check`] in every mode.
fn check_all(mesh: &Mesh, rays: &[Ray]) {
    for grid in build_modes(mesh) {
        rays.iter().for_each(|ray| check(mesh, &grid, ray));
    }
}

/// Triangles without common vertices.
fn soup(corners: Vec<[[f32; 3]; 3]>) -> Mesh {
    let n = corners.len() as u32;
    Mesh {
        vertices: corners.into_iter().flatten().collect(),
        triangles: (0..n).map(|triangle| [0, 1, 2].map(|corner| 3 * triangle + corner)).collect(),
        ..Mesh::default()
    }
}

/// The surface of a box of n×n×n unit cubes, in triangles of half a unit square, with corners at integers.
fn cube(n: i32) -> Mesh {
    let mut corners = Vec::new();
    for axis in 0..3 {
        for (u, v, side) in (0..n).flat_map(|u| (0..n).flat_map(move |v| [(u, v, 0), (u, v, n)])) {
            let at = |u: i32, v: i32| {
                let mut p = [0.0; 3];
                (p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3]) = (side as f32, u as f32, v as f32);
                p
            };
            corners.push([at(u, v), at(u + 1, v), at(u + 1, v + 1)]);
            corners.push([at(u, v), at(u + 1, v + 1), at(u, v + 1)]);
        }
    }
    soup(corners)
}

/// Coordinates, many of them on cell boundaries of small grids.
fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![
        (-8i32..=8).prop_map(|n| n as f32),
        (-32i32..=32).prop_map(|n| n as f32 / 4.0),
        -8.0f32..8.0,
        Just(0.0),
        Just(-0.0),
    ]
}

fn point() -> impl Strategy<Value = [f32; 3]> {
    [coordinate(), coordinate(), coordinate()]
}

fn ray() -> impl Strategy<Value = Ray> {
    (point(), point(), prop_oneof![Just(1.0f32), Just(1e4), Just(1e-4)])
        .prop_map(|(origin, direction, far)| Ray::new(Vec3::from_array(origin) * far, Vec3::from_array(direction)))
}

proptest! {
    #[test]
    fn random_triangles_are_hit_as_by_brute_force(
        corners in proptest::collection::vec([point(), point(), point()], 1..60),
        rays in proptest::collection::vec(ray(), 64),
    ) {
        let mesh = soup(corners);
        check_all(&mesh, &rays);
    }

    #[test]
    fn flat_scenes_are_hit_as_by_brute_force(
        corners in proptest::collection::vec([point(), point(), point()], 1..60),
        rays in proptest::collection::vec(ray(), 64),
        axis in 0usize..3,
    ) {
        let flat = |mut corner: [f32; 3]| {
            corner[axis] = 3.0;
            corner
        };
        let mesh = soup(corners.into_iter().map(|triangle| triangle.map(flat)).collect());
        check_all(&mesh, &rays);
    }

    #[test]
    fn rays_between_corners_of_a_box_are_hit_as_by_brute_force(
        from in [-2i32..=8, -2i32..=8, -2i32..=8],
        to in [0i32..=12, 0i32..=12, 0i32..=12],
    ) {
        let mesh = cube(6);
        let origin = Vec3::from_array(from.map(|x| x as f32));
        let target = Vec3::from_array(to.map(|x| x as f32 / 2.0));
        check_all(&mesh, &[Ray::new(origin, target - origin)]);
    }
}

#[test]
fn no_ray_leaves_a_closed_box() {
    let mesh = cube(4);
    let grids = build_modes(&mesh);
    let inside = Vec3::new(1.0, 2.0, 2.5);
    for (x, y, z) in (0..=16).flat_map(|x| (0..=16).flat_map(move |y| (0..=16).map(move |z| (x, y, z)))) {
        let target = Vec3::new(x as f32, y as f32, z as f32) / 4.0;
        if target != inside {
            // And from far outside, towards the inside.
            let inwards = Ray::new(inside + (target - inside) * 1024.0, inside - target);
            for (grid, ray) in
                grids.iter().flat_map(|grid| [(grid, Ray::new(inside, target - inside)), (grid, inwards)])
            {
                assert!(!grid.intersect(&ray).is_miss(), "{ray:?}");
            }
        }
    }
}

#[test]
fn the_first_of_equal_triangles_wins() {
    let triangle = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let mesh = soup(vec![[[5.0; 3], [6.0, 5.0, 5.0], [5.0, 6.0, 5.0]], triangle, triangle, triangle]);
    let ray = Ray::new(Vec3::new(0.25, 0.25, 4.0), Vec3::NEG_Z);
    assert_eq!(with_file_index(&build(&mesh), build(&mesh).intersect(&ray)), Hit { triangle: 1, t: 4.0 });
}

#[test]
fn a_ray_s_cost_counts_cells_and_tests_up_to_the_hit() {
    for grid in build_modes(&cube(30)) {
        check_cost(&grid);
    }
}

fn check_cost(grid: &Grid) {
    let towards = Ray::new(Vec3::new(-5.0, 4.3, 6.6), Vec3::X);
    let onto_it = grid.cost(&towards);
    // From just behind the first face to the second, through the empty inside.
    let through_it = grid.cost(&Ray { t_min: 5.5, ..towards });
    let beside_it = grid.cost(&Ray { origin: towards.origin + Vec3::Y * 50.0, ..towards });
    assert!(onto_it.n_cells > 0 && onto_it.n_tests > 0, "{onto_it:?}");
    assert!(through_it.n_cells > onto_it.n_cells, "{through_it:?} {onto_it:?}");
    assert_eq!(beside_it, crate::intersect::RayCost::default());
    let n_references = grid.figures().references;
    assert!((through_it.n_tests as usize) < n_references / 4, "{through_it:?} of {n_references}");
}

#[test]
fn empty_scenes_are_never_hit() {
    let rejected = Mesh { vertices: vec![], triangles: vec![Mesh::REJECTED; 3], n_rejected: 3, ..Mesh::default() };
    let point = soup(vec![[[1.0; 3]; 3]]);
    for mesh in [Mesh::default(), rejected, point] {
        for grid in build_modes(&mesh) {
            for direction in [Vec3::ONE, Vec3::X, -Vec3::Z, Vec3::ZERO] {
                assert!(grid.intersect(&Ray::new(Vec3::ZERO, direction)).is_miss());
            }
        }
    }
}

#[test]
fn triangles_of_every_size_and_position_are_found() {
    for scale in [1e-30f32, 1e-10, 1.0, 1e10, 1e18] {
        for offset in [0.0f32, 1.0, 1e3] {
            let at = |x: f32, y: f32| [(x + offset) * scale, (y + offset) * scale, offset * scale];
            let mesh = soup((0..20).map(|k| [at(k as f32, 0.0), at(k as f32 + 1.0, 0.0), at(k as f32, 1.0)]).collect());
            if !mesh.vertices.iter().all(|&v| Mesh::is_usable(v)) {
                continue;
            }
            for (grid, k) in build_modes(&mesh).iter().flat_map(|grid| (0..20).map(move |k| (grid, k))) {
                let target = Vec3::from_array(at(k as f32 + 0.25, 0.25));
                for back in [1.0f32, 100.0] {
                    let direction = Vec3::new(0.0, 0.0, -scale);
                    let ray = Ray::new(target - direction * back, direction);
                    assert_eq!(
                        with_file_index(grid, grid.intersect(&ray)).triangle,
                        k,
                        "scale {scale}, offset {offset}"
                    );
                }
            }
        }
    }
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let mesh = crate::model::statue::generate(60_000, &|_| ());
    let with_threads =
        |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(|| build_modes(&mesh));
    let one = with_threads(1);
    for n in [2, 5] {
        for (one, several) in one.iter().zip(with_threads(n)) {
            match (&one.structure, &several.structure) {
                (Structure::Tree(one), Structure::Tree(several)) => assert!(one == several),
                (Structure::Plain(one), Structure::Plain(several)) => assert!(one == several),
                (Structure::RowDisplacement(one), Structure::RowDisplacement(several)) => {
                    assert!(one == several);
                }
                _ => panic!("the number of threads decides nothing"),
            }
        }
    }
}

#[test]
fn rays_along_the_border_stay_inside() {
    // In the margin around the grid, where macrocells reach beyond it.
    let at = |p: f32| [[p, p, p], [p + 0.1, p, p], [p, p + 0.1, p]];
    for n in 2..12 {
        let mesh = soup((0..n).map(|k| at(if k == 0 { 0.0 } else { 9.0 + k as f32 / n as f32 })).collect());
        for grid in build_modes(&mesh) {
            let dims = match &grid.structure {
                Structure::Tree(tree) => tree.extent.map(|n| n as i32),
                Structure::Plain(grid) => grid.dims(),
                Structure::RowDisplacement(grid) => grid.dims(),
            };
            for (axis, n_cells) in dims.into_iter().enumerate() {
                let mut ray = Ray::new(Vec3::splat(9.5), Vec3::ZERO);
                ray.origin[axis] = grid.space.length_to_model(f64::from(n_cells) + 0.5 * DILATION) as f32;
                ray.direction[axis] = 1e-9;
                ray.origin[(axis + 1) % 3] = -1.0;
                ray.direction[(axis + 1) % 3] = 1.0;
                check(&mesh, &grid, &ray);
            }
        }
    }
}

#[test]
fn large_triangles_do_not_fill_memory() {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32
    };
    let mesh = soup((0..20_000).map(|_| [0; 3].map(|_| [0; 3].map(|_| random()))).collect());
    let grid = build(&mesh);
    let references = grid.figures().references;
    assert!(references < 70 * 20_000 * 4, "{references} references");
    let ray = Ray::new(Vec3::ZERO, Vec3::ONE);
    check(&mesh, &grid, &ray);
}

#[test]
fn a_grid_stays_within_its_memory_and_hits_the_same() {
    let mesh = crate::model::statue::generate(60_000, &|_| ());
    let bounds = mesh.bounds();
    let mesh_bytes = PROGRAM_BYTES + TracedMesh::peak_bytes(&mesh);
    let unlimited = build(&mesh);
    assert_eq!(unlimited.shortage(), None);
    let (low, high) = (Vec3::from_array(bounds.min), Vec3::from_array(bounds.max));
    let packet = packets::raster(high + (high - low) * 0.3, (low + high) * 0.5, (high - low).length() / 40.0, u64::MAX);
    for &storage in Storage::VARIANTS {
        // The tree never has much more than one reference a triangle.
        let all_left = if storage.is_tree() { [300_000, 310_000, 320_000] } else { [300_000, 600_000, 1_000_000] };
        for left in all_left {
            let memory_budget = (mesh_bytes + left).to_string().parse().unwrap();
            let options = GridOptions { storage, memory_budget, ..GridOptions::default() };
            let grid = Grid::build(mesh.clone(), &options, &|_| ());
            let shortage = grid.shortage().expect("the whole grid takes more").to_string();
            assert!(shortage.contains("made coarser"), "{storage} with {left}: {shortage}");
            let box_bytes = grid.figures().box_bytes.unwrap_or(0) as u64;
            let tree_bytes = grid.n_bytes() as u64 - box_bytes;
            assert!(tree_bytes <= left, "{storage}: {tree_bytes} in {left} bytes");
            let as_loaded = TracedMesh::peak_bytes(&mesh) - TracedMesh::bytes_in_order(&mesh);
            assert!(box_bytes + tree_bytes <= left + as_loaded, "{storage}: {box_bytes} bytes of boxes");
            for lane in 0..64 {
                let [limited, free] = [&grid, &unlimited].map(|g| with_file_index(g, g.intersect(&packet.ray(lane))));
                assert_eq!(limited, free);
            }
        }
    }
}

#[test]
fn whoever_follows_the_advice_on_a_budget_has_a_whole_grid() {
    // A globe: thin triangles meet at its poles, so few cells want most of the references.
    let (n_around, n_up) = (400, 60);
    let point = |around: usize, up: usize| {
        let [longitude, latitude] = [around * 2, up].map(|n| n as f32 * std::f32::consts::PI);
        let (longitude, latitude) = (longitude / n_around as f32, latitude / n_up as f32);
        [latitude.sin() * longitude.cos(), latitude.sin() * longitude.sin(), latitude.cos()]
    };
    let quads = (0..n_around).flat_map(|around| (0..n_up).map(move |up| (around, up)));
    let globe = soup(
        quads
            .flat_map(|(around, up)| {
                let [a, b] = [point(around, up), point(around + 1, up)];
                let [c, d] = [point(around, up + 1), point(around + 1, up + 1)];
                [[a, b, c], [b, d, c]]
            })
            .collect(),
    );
    let mut memory_budget = MemoryBudget::of_at_least(PROGRAM_BYTES + TracedMesh::peak_bytes(&globe) + 300_000);
    let shortage = |memory_budget| {
        let options = GridOptions { memory_budget, ..GridOptions::default() };
        Grid::build(globe.clone(), &options, &|_| ()).shortage()
    };
    let mut n_steps = 0;
    while let Some(shortage) = shortage(memory_budget) {
        let enough = shortage.enough.expect("a budget is known");
        assert!(memory_budget < enough && n_steps < 2, "{shortage}");
        (memory_budget, n_steps) = (enough, n_steps + 1);
    }
    assert!(n_steps > 0, "the first budget is enough");
}

#[test]
fn a_mesh_beyond_the_budget_gets_a_grid_and_a_line_that_says_so() {
    let mesh = crate::model::statue::generate(500_000, &|_| ());
    for &storage in Storage::VARIANTS {
        let memory_budget = "16M".parse().unwrap();
        let options = GridOptions { density: Some(32.0), storage, memory_budget, ..GridOptions::default() };
        let grid = Grid::build(mesh.clone(), &options, &|_| ());
        let shortage = grid.shortage().unwrap().to_string();
        assert!(shortage.contains("M, more than --memory-budget 16M"), "{storage}: {shortage}");
        assert!(grid.n_bytes() * 4 <= TracedMesh::peak_bytes(&mesh) as usize + PROGRAM_BYTES as usize);
        let lists = grid.figures().lists;
        assert!(lists > if storage == Storage::Compact { 400 } else { 2_500 }, "{storage} has {lists}");
    }
}

#[test]
fn distant_origins_hit_as_near_ones() {
    let mesh = cube(4);
    for grid in build_modes(&mesh) {
        for distance in [1e3f32, 1e7, 1e12, 1e18] {
            let ray = Ray::new(Vec3::new(1.7, 2.3, distance), Vec3::new(0.0, 0.0, -distance));
            assert_eq!(grid.intersect(&ray).t, (distance - 4.0) / distance, "{distance}");
            // From as far away, but away from the box or beside it.
            let aside = Ray { direction: Vec3::new(1.0, 0.0, -distance), ..ray };
            for ray in [Ray { direction: -ray.direction, ..ray }, Ray { origin: ray.origin * 2.0, ..aside }, aside] {
                assert_eq!(grid.intersect(&ray).is_miss(), !grid.occluded(&ray));
            }
            assert!(!grid.occluded(&Ray { direction: -ray.direction, ..ray }));
            assert!(!grid.occluded(&Ray { origin: ray.origin + Vec3::X * 9.0, ..ray }));
        }
    }
}

#[test]
fn a_polygon_of_one_corner_a_million_times_costs_nothing() {
    let mut mesh = cube(1);
    let triangles = mesh.triangles.len();
    mesh.triangles.extend((0..1_000_000).map(|index| [index % 2, 1, index % 2]));
    let grid = build(&mesh);
    assert_eq!(grid.mesh().n_triangles(), triangles, "triangles without area are in no cell");
    check(&mesh, &grid, &Ray::new(Vec3::new(0.3, 0.4, 9.0), -Vec3::Z));
}
