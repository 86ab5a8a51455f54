//! Packets against single rays: the same hits, bit for bit.

use glam::Vec3;
use proptest::prelude::*;

use super::{build, build_modes, in_file_order, point, soup};
use crate::{
    grid::{Grid, InstructionSet, MeshLayout, Packet, PacketScratch},
    mesh::Mesh,
};

/// Checks that with every instruction set and in every mode packets and single rays hit the same, bit for bit.
///
/// Places in the mesh differ from mode to mode, so triangles are compared by their numbers in the file.
fn check_packet(grids: &[Grid], packet: &Packet) {
    let single: Vec<_> = (0..64).map(|lane| in_file_order(&grids[0], grids[0].intersect(&packet.ray(lane)))).collect();
    for grid in grids {
        let hits = grid.intersect_packet(packet, &mut PacketScratch::default());
        for lane in (0..64).filter(|lane| packet.active >> lane & 1 == 1) {
            assert_eq!(grid.occluded(&packet.ray(lane)), !single[lane].is_miss());
            for hit in [hits[lane], grid.intersect(&packet.ray(lane))] {
                let hit = in_file_order(grid, hit);
                let expected = single[lane];
                let same = hit.triangle == expected.triangle && hit.t.to_bits() == expected.t.to_bits();
                let (instructions, origin) = (grid.instructions, packet.origin);
                let storage = grid.figures().storage;
                assert!(
                    same,
                    "{storage}, {instructions:?}: ray {lane} from {origin} hits {hit:?} instead of {expected:?}"
                );
            }
        }
    }
}

/// A grid for each instruction set of this machine and each layout of the mesh, the plain ones first, and one in every
/// mode.
fn build_all(mesh: &Mesh) -> Vec<Grid> {
    let sets = InstructionSet::available().into_iter();
    let of_set = |set| {
        [MeshLayout::Indexed, MeshLayout::Flat]
            .map(|layout| build(mesh).with_instructions(set).with_mesh_layout(layout))
    };
    sets.flat_map(of_set).chain(build_modes(mesh)).collect()
}

/// Rays from a point through an 8×8 raster around another.
#[expect(clippy::needless_range_loop, reason = "a lane indexes three arrays at once")]
pub(super) fn raster(origin: Vec3, target: Vec3, spacing: f32, active: u64) -> Packet {
    let forward = target - origin;
    let right = forward.any_orthogonal_vector().normalize() * spacing;
    let up = right.cross(forward).normalize() * spacing;
    let mut directions = [[0.0; 64]; 3];
    for lane in 0..64 {
        let direction = forward + right * (lane % 8) as f32 + up * (lane / 8) as f32;
        (0..3).for_each(|axis| directions[axis][lane] = direction[axis]);
    }
    Packet { origin, directions, active, t_min: 0.0, t_max: f32::MAX, any_hit: false }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

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
            check_packet(&grids, &raster(origin, target, spacing, active));
        }
    }

    #[test]
    fn packets_of_unrelated_rays_hit_what_single_rays_hit(
        corners in proptest::collection::vec([point(), point(), point()], 1..60),
        origin in point(),
        directions in proptest::collection::vec(point(), 64),
    ) {
        let mesh = soup(corners);
        let grids = build_all(&mesh);
        let mut packet = raster(Vec3::from_array(origin), Vec3::ZERO, 1.0, u64::MAX);
        for (lane, direction) in directions.iter().enumerate() {
            (0..3).for_each(|axis| packet.directions[axis][lane] = direction[axis]);
        }
        check_packet(&grids, &packet);
        // Once more with one that they all share.
        packet.directions[2] = [5.0; 64];
        check_packet(&grids, &packet);
    }
}

#[test]
fn packets_hit_a_scan_from_near_and_far() {
    let mesh = crate::statue::generate(60_000, &|_| ());
    let grids = build_all(&mesh);
    let bounds = mesh.bounds();
    let (low, high) = (Vec3::from_array(bounds.min), Vec3::from_array(bounds.max));
    let (centre, size) = ((low + high) * 0.5, (high - low).max_element());
    for (index, distance) in [0.1, 0.6, 1.5, 10.0, 1e4, 1e9].into_iter().enumerate() {
        for step in 0..8 {
            let angle = step as f32 * 0.7 + index as f32;
            let origin = centre + Vec3::new(angle.cos(), (angle * 3.1).sin() * 0.4, angle.sin()) * (size * distance);
            let target = low + (high - low) * Vec3::new(0.3, step as f32 / 40.0, 0.6);
            check_packet(&grids, &raster(origin, target, size / 300.0, u64::MAX));
        }
    }
}

/// Leaves of many triangles and of few at all depths, some behind each other in one leaf.
#[test]
fn packets_hit_an_uneven_soup_from_within_and_without() {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 24) as f32
    };
    let triangle = |_| {
        let size = 0.4 * random().powi(6) + 0.002;
        let corner = [random(), random(), random()];
        std::array::from_fn(|_| corner.map(|x| x + size * random()))
    };
    let mesh = soup((0..20_000).map(triangle).collect());
    let grids = build_all(&mesh);
    for step in 0..20 {
        let from = Vec3::new(random(), random(), random());
        let origin = if step % 3 == 0 { from } else { Vec3::splat(0.5) + (from - 0.5) * 6.0 };
        let target = Vec3::new(random(), random(), random());
        let spacing = [0.0003, 0.003, 0.03][step % 3];
        check_packet(&grids, &raster(origin, target, spacing, u64::MAX));
    }
}
