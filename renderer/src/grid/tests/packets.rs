//! Packets against single rays: the same hits, bit for bit.

use glam::Vec3;
use proptest::prelude::*;
use shared::appearance::ClipPlane;

use super::{GridOptions, build, build_modes, point, soup, with_file_index};
use crate::{
    grid::Grid,
    intersect::{
        InstructionSet, MOST_PACKETS, Packet, PacketScratch,
        ray::{Hit, Ray},
        triangle,
    },
    model::mesh::Mesh,
};

/// Checks that packets, alone or together, and single rays have the same hits, bit for bit, with every instruction set
/// and in every mode: for unbounded rays, for intervals that begin or end at a hit or next to it, and for all or some packets
/// that a plane cuts there.
fn check_packets(grids: &[Grid], packets: &[Packet; MOST_PACKETS]) {
    check_range(grids, packets);
    let mut all_t = Vec::new();
    for packet in packets {
        let hits = (0..64).map(|lane| grids[0].intersect(&packet.ray(lane)));
        all_t.extend(hits.filter(|hit| !hit.is_miss()).map(|hit| hit.t));
    }
    all_t.sort_by(f32::total_cmp);
    if let Some(&t) = all_t.get(all_t.len() / 2) {
        for (t_min, t_max) in [(0.0, t), (0.0, t.next_down()), (t, f32::MAX), (t.next_up(), f32::MAX), (t, t)] {
            check_range(grids, &packets.each_ref().map(|packet| Packet { t_min, t_max, ..*packet }));
        }
        let Ray { origin, direction, .. } = packets[0].ray(0);
        let point = origin.as_dvec3() + direction.as_dvec3() * f64::from(t);
        for (normal, n_whole) in [(-direction.as_dvec3(), 0), (direction.as_dvec3(), 2)] {
            let plane = ClipPlane { normal, offset: normal.dot(point) };
            let mut cut = packets.each_ref().map(|packet| Packet { ..*packet });
            cut.iter_mut().skip(n_whole).for_each(|packet| packet.clip = Some(plane));
            check_range(grids, &cut);
        }
    }
}

/// Checks one interval. Triangle indices differ from mode to mode, so file indices are compared.
fn check_range(grids: &[Grid], packets: &[Packet; MOST_PACKETS]) {
    let single = |grid: &Grid, packet: &Packet, lane| with_file_index(grid, grid.intersect(&packet.ray(lane)));
    let expected = packets.each_ref().map(|packet| std::array::from_fn(|lane| single(&grids[0], packet, lane)));
    for grid in grids {
        let mut scratch = PacketScratch::default();
        // Old content of the hits must not matter.
        let noise = [[Hit { triangle: 0, t: 1.0 }; 64]; MOST_PACKETS];
        for n_packets in [1, MOST_PACKETS - 1, MOST_PACKETS] {
            let mut hits = noise;
            let (packets, hits) = (&packets[..n_packets], &mut hits[..n_packets]);
            grid.intersect_packets(packets, &mut scratch, hits);
            for ((packet, hits), expected) in packets.iter().zip(hits).zip(&expected) {
                hits.iter_mut().for_each(|hit| *hit = with_file_index(grid, *hit));
                check_hits(grid, packet, hits, expected);
            }
        }
        let for_any_hit = packets.each_ref().map(|packet| Packet { any_hit: true, ..*packet });
        let mut hits = noise;
        grid.intersect_packets(&for_any_hit, &mut scratch, &mut hits);
        for ((packet, hits), expected) in packets.iter().zip(&hits).zip(&expected) {
            check_any_hits(grid, packet, hits, expected);
        }
        let packet = &packets[0];
        let alone = std::array::from_fn(|lane| single(grid, packet, lane));
        check_hits(grid, packet, &alone, &expected[0]);
        for (lane, hit) in expected[0].iter().enumerate() {
            assert_eq!(grid.occluded(&packet.ray(lane)), !hit.is_miss());
        }
    }
}

/// Checks that rays hit some triangle exactly where a nearest hit is expected.
fn check_any_hits(grid: &Grid, packet: &Packet, hits: &[Hit; 64], expected: &[Hit; 64]) {
    for lane in (0..64).filter(|lane| packet.active >> lane & 1 == 1) {
        let (hit, ray) = (hits[lane], packet.ray(lane));
        let is_hit = || triangle::intersect(&ray, &grid.mesh.corners(hit.triangle)).is_some();
        let is_right = if hit.is_miss() { expected[lane].is_miss() } else { is_hit() };
        assert!(is_right, "{:?}: {ray:?} hits {hit:?}, nearest {:?}", grid.instructions, expected[lane]);
    }
}

fn check_hits(grid: &Grid, packet: &Packet, hits: &[Hit; 64], expected: &[Hit; 64]) {
    for lane in (0..64).filter(|lane| packet.active >> lane & 1 == 1) {
        let (hit, expected) = (hits[lane], expected[lane]);
        let same = hit.triangle == expected.triangle && hit.t.to_bits() == expected.t.to_bits();
        let (instructions, ray, storage) = (grid.instructions, packet.ray(lane), grid.figures().storage);
        assert!(same, "{storage}, {instructions:?}: {lane}, {ray:?} hits {hit:?} instead of {expected:?}");
    }
}

/// A grid for each instruction set of this machine, portable ones first, and one in every mode.
fn build_all(mesh: &Mesh) -> Vec<Grid> {
    let sets = InstructionSet::available().into_iter();
    sets.map(|set| build(mesh).with_instructions(set)).chain(build_modes(mesh)).collect()
}

/// Rays from a point through an 8×8 raster around another.
#[expect(clippy::needless_range_loop, reason = "a lane indexes three arrays at once")]
pub(crate) fn raster(origin: Vec3, target: Vec3, spacing: f32, active: u64) -> Packet {
    let forward = target - origin;
    let right = forward.any_orthogonal_vector().normalize() * spacing;
    let up = right.cross(forward).normalize() * spacing;
    let mut directions = [[0.0; 64]; 3];
    for lane in 0..64 {
        let direction = forward + right * (lane % 8) as f32 + up * (lane / 8) as f32;
        (0..3).for_each(|axis| directions[axis][lane] = direction[axis]);
    }
    Packet { origin, directions, active, ..Packet::NONE }
}

/// The packet of this raster, and those beside, above, and diagonal to it.
fn rasters(origin: Vec3, target: Vec3, spacing: f32, active: u64) -> [Packet; MOST_PACKETS] {
    let packet = raster(origin, target, spacing, active);
    let [right, up] = [1, 8].map(|lane| packet.ray(lane).direction - packet.ray(0).direction);
    let beside = |columns: f32, rows: f32| {
        let step = (right * columns + up * rows) * 8.0;
        let directions = std::array::from_fn(|axis| packet.directions[axis].map(|along| along + step[axis]));
        Packet { directions, ..packet }
    };
    [beside(0.0, 0.0), beside(1.0, 0.0), beside(0.0, 1.0), beside(1.0, 1.0)]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn packets_hit_what_single_rays_hit(
        corners in proptest::collection::vec([point(), point(), point()], 1..200),
        origin in point(),
        target in point(),
        (far, spacing) in prop_oneof![Just((1.0f32, 0.25f32)), Just((30.0, 1.0)), Just((1e5, 0.01)), Just((1e-3, 2.0))],
        active in prop_oneof![Just(u64::MAX), 1..=u64::MAX],
    ) {
        let mesh = soup(corners);
        let grids = build_all(&mesh);
        let (origin, target) = (Vec3::from_array(origin) * far, Vec3::from_array(target));
        if origin != target {
            check_packets(&grids, &rasters(origin, target, spacing, active));
        }
    }

    #[test]
    fn packets_of_unrelated_rays_hit_what_single_rays_hit(
        corners in proptest::collection::vec([point(), point(), point()], 1..60),
        origin in point(),
        directions in proptest::collection::vec(point(), 64 * MOST_PACKETS),
    ) {
        let mesh = soup(corners);
        let grids = build_all(&mesh);
        let mut packets = rasters(Vec3::from_array(origin), Vec3::ZERO, 1.0, u64::MAX);
        for (ray, direction) in directions.iter().enumerate() {
            (0..3).for_each(|axis| packets[ray / 64].directions[axis][ray % 64] = direction[axis]);
        }
        check_packets(&grids, &packets);
        // And with one component that all rays of a packet share, then all packets.
        for shared in [[5.0, 5.0, -5.0, 5.0], [5.0; MOST_PACKETS]] {
            packets.iter_mut().zip(shared).for_each(|(packet, along)| packet.directions[2] = [along; 64]);
            check_packets(&grids, &packets);
        }
    }
}

#[test]
fn packets_hit_a_scan_from_near_and_far() {
    let mesh = crate::model::statue::generate(60_000, &|_| ());
    let grids = [build_all(&mesh), build_all(&mesh.clone().snapped(12.try_into().unwrap()))];
    let bounds = mesh.bounds();
    let (low, high) = (Vec3::from_array(bounds.min), Vec3::from_array(bounds.max));
    let (centre, size) = ((low + high) * 0.5, (high - low).max_element());
    for (index, distance) in [0.1, 0.6, 1.5, 10.0, 1e4, 1e9].into_iter().enumerate() {
        for step in 0..5 {
            let angle = step as f32 * 0.7 + index as f32;
            let origin = centre + Vec3::new(angle.cos(), (angle * 3.1).sin() * 0.4, angle.sin()) * (size * distance);
            let target = low + (high - low) * Vec3::new(0.3, step as f32 / 25.0, 0.6);
            check_range(&grids[step % 2], &rasters(origin, target, size / 300.0, u64::MAX));
            // Away from the scan.
            check_range(&grids[step % 2], &rasters(origin, origin + (origin - centre), size / 300.0, u64::MAX));
        }
    }
}

/// Pseudo-random numbers in 0..1.
fn random_numbers() -> impl FnMut() -> f32 {
    let mut state = 1u64;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    }
}

/// Triangles of many sizes within a cube of side `scale`: full and sparse leaves at all depths, several layers in one
/// leaf.
fn uneven_soup(n_triangles: u32, scale: f32, random: &mut impl FnMut() -> f32) -> Mesh {
    let triangle = |_| {
        let size = 0.4 * random().powi(6) + 0.002;
        let corner = [random(), random(), random()];
        std::array::from_fn(|_| corner.map(|x| (x + size * random()) * scale))
    };
    soup((0..n_triangles).map(triangle).collect())
}

/// Packets with a common origin: every third time within a cube of side 1, else outside of it.
fn around_a_cube(step: usize, spacing: f32, random: &mut impl FnMut() -> f32) -> [Packet; MOST_PACKETS] {
    let from = Vec3::new(random(), random(), random());
    let origin = if step.is_multiple_of(3) { from } else { Vec3::splat(0.5) + (from - 0.5) * 6.0 };
    let target = Vec3::new(random(), random(), random());
    rasters(origin, target, spacing, u64::MAX)
}

#[test]
fn packets_hit_an_uneven_soup_from_within_and_without() {
    let mut random = random_numbers();
    let grids = build_all(&uneven_soup(20_000, 1.0, &mut random));
    for step in 0..12 {
        let spacing = [0.0003, 0.003, 0.03][step % 3];
        check_packets(&grids, &around_a_cube(step, spacing, &mut random));
    }
}

/// Inverses of depths and of ray ends overflow single precision here, and both are subnormal.
#[test]
fn packets_hit_a_soup_of_subnormal_size() {
    for (scale, per_direction) in [(3e-39, 1.0), (1e-39, 1.0), (1e-42, 1.0), (1e-25, 1e15)] {
        let mut random = random_numbers();
        let grids = build_all(&uneven_soup(1_000, scale, &mut random));
        for step in 0..6 {
            let packets = around_a_cube(step, 0.03, &mut random);
            check_packets(
                &grids,
                &packets.map(|packet| Packet {
                    origin: packet.origin * scale,
                    directions: packet.directions.map(|along| along.map(|d| d * per_direction)),
                    ..packet
                }),
            );
        }
    }
}

/// Ends that are no numbers, in the wrong order, or have no inverse in single precision.
#[test]
fn packets_with_unusual_intervals_hit_what_single_rays_hit() {
    let mut mesh = Mesh::default();
    for depth in [1e-29f32, 1.0] {
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend([[-1.0, -1.0, depth], [1.0, -1.0, depth], [0.0, 1.0, depth]]);
        mesh.triangles.push([first, first + 1, first + 2]);
    }
    let grids = build_all(&mesh);
    let packets = rasters(Vec3::ZERO, Vec3::Z, 0.01, 0xffff_0000_ffff_ffff);
    for along in [1.0, 1e10] {
        for (t_min, t_max) in [
            (f32::NAN, f32::MAX),
            (0.0, f32::NAN),
            (-0.0, f32::INFINITY),
            (f32::INFINITY, f32::INFINITY),
            (0.5, 0.25),
            (0.0, 0.0),
            (0.0, -1.0),
            (2e-39, f32::MAX),
            (2e-29, f32::MAX),
            (0.0, 2e-39),
        ] {
            check_range(
                &grids,
                &packets.each_ref().map(|packet| Packet {
                    directions: packet.directions.map(|axis| axis.map(|component| component * along)),
                    t_min,
                    t_max,
                    ..*packet
                }),
            );
        }
    }
}

/// A part of a packet may have its hits before the rest enters the grid.
#[test]
fn rays_that_enter_the_grid_late_are_not_lost_when_others_have_their_hits() {
    // A plate with two walls near its edge, and small triangles elsewhere, which make its bricks small.
    let mut mesh = Mesh::default();
    let mut add = |corners: [[f32; 3]; 3]| {
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend(corners);
        mesh.triangles.push([first, first + 1, first + 2]);
    };
    for [low, high] in [[40.0, 55.0], [75.0, 90.0]] {
        add([[5.0, low, -1.0], [5.0, high, -1.0], [5.0, high, 2.0]]);
        add([[5.0, low, -1.0], [5.0, high, 2.0], [5.0, low, 2.0]]);
    }
    for number in 0..2000u16 {
        let [x, y] = [30.0 + f32::from(number % 40) * 1.75, f32::from(number / 40) * 2.0];
        add([[x, y, 0.0], [x + 1.0, y, 0.0], [x, y + 1.0, 1.0]]);
    }
    add([[0.0; 3], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]);
    let options = GridOptions { density: Some(256.0), ..GridOptions::default() };

    // From outside: half of the rays pass the plate's edge at y = 43, the others at y = 73.
    let slope = |lane: usize| if lane < 32 { 0.94 } else { 0.6 } + (lane % 32) as f32 * 1e-3;
    let ones = [1.0; 64];
    let directions = [std::array::from_fn(slope), ones, [0.0; 64]];
    let packet = Packet { origin: Vec3::new(-50.0, -10.0, 0.5), directions, active: u64::MAX, ..Packet::NONE };
    for set in InstructionSet::available() {
        let grid = Grid::build(mesh.clone(), &options, &|_| ()).with_instructions(set);
        let expected: [Hit; 64] = std::array::from_fn(|lane| grid.intersect(&packet.ray(lane)));
        assert!(expected.iter().all(|hit| !hit.is_miss()), "all rays hit a wall");
        let hits = grid.intersect_packet(&packet, &mut PacketScratch::default());
        check_hits(&grid, &packet, &hits, &expected);
    }
}
