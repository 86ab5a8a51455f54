//! Rays in a scene that a plane cuts open.
//!
//! The plane cuts each ray's interval, also in packets.
//!
//! A ray that enters the kept half and then leaves a solid entered it within the solid: its hit is the cap, in the plane.
//! Rays that only ask for any hit need no cap, because the side on which they leave the solid hides as much.

use glam::Vec3;
use shared::appearance::ClipPlane;

use crate::{
    grid::Grid,
    intersect::{
        Packet, PacketScratch,
        ray::{Hit, Ray},
    },
    model::solid::Facing,
};

/// The part of a ray that a plane keeps, if any; without a plane the whole ray.
///
/// The crossing is computed in `f64` and rounded once, to the next number beyond the plane, so triangles in the plane
/// are kept. A ray has the same bits alone and in any packet.
#[inline]
pub fn clip_ray(clip: Option<&ClipPlane>, ray: Ray) -> Option<Ray> {
    let Some(ClipPlane { normal, offset }) = clip else { return Some(ray) };
    let distance = offset - normal.dot(ray.origin.as_dvec3());
    let slope = normal.dot(ray.direction.as_dvec3());
    if slope == 0.0 {
        return (distance >= 0.0).then_some(ray);
    }
    let t = (distance / slope) as f32;
    let ray = if slope > 0.0 {
        Ray { t_max: ray.t_max.min(t.next_up()), ..ray }
    } else {
        Ray { t_min: ray.t_min.max(t.next_down()), ..ray }
    };
    (ray.t_min <= ray.t_max).then_some(ray)
}

/// The nearest hit on the part of a ray that a plane keeps.
pub fn intersect(grid: &Grid, clip: Option<&ClipPlane>, ray: Ray) -> Hit {
    clip_ray(clip, ray).map_or(Hit::MISS, |kept| or_cap(grid, &ray, &kept, grid.intersect(&kept)))
}

/// The hit of the part of a ray that a plane keeps, or the cap in its place.
fn or_cap(grid: &Grid, ray: &Ray, kept: &Ray, hit: Hit) -> Hit {
    let enters = kept.t_min > ray.t_min;
    let Some(facing) = grid.mesh().facing().filter(|_| enters && !hit.is_miss()) else { return hit };
    let along = grid.mesh().normal(hit.triangle).dot(ray.direction.as_dvec3());
    let leaves_solid = if facing == Facing::Outward { along > 0.0 } else { along < 0.0 };
    if leaves_solid { Hit { triangle: Hit::CAP, t: kept.t_min } } else { hit }
}

/// [`Grid::intersect_rays`] on the parts of rays that a plane keeps.
pub fn intersect_rays(grid: &Grid, clip: Option<&ClipPlane>, rays: &[Ray], hits: &mut [Hit]) {
    if clip.is_none() {
        return grid.intersect_rays(rays, hits);
    }
    let kept = |ray: &Ray| clip_ray(clip, *ray).unwrap_or(NOTHING);
    let kept: Vec<_> = rays.iter().map(kept).collect();
    grid.intersect_rays(&kept, hits);
    for ((hit, ray), kept) in hits.iter_mut().zip(rays).zip(&kept) {
        *hit = or_cap(grid, ray, kept, *hit);
    }
}

/// A ray of which nothing is left.
pub(super) const NOTHING: Ray = Ray { origin: Vec3::ZERO, direction: Vec3::X, t_min: 0.0, t_max: f32::NEG_INFINITY };

/// [`Grid::occluded_rays`] on the parts of rays that a plane keeps; the rays are cut.
pub fn occluded_rays(grid: &Grid, clip: Option<&ClipPlane>, rays: &mut [Ray], occluded: &mut [bool]) {
    if clip.is_some() {
        for ray in &mut *rays {
            *ray = clip_ray(clip, *ray).unwrap_or(NOTHING);
        }
    }
    grid.occluded_rays(rays, occluded);
}

/// [`Grid::intersect_packets`] with the caps of cuts, where the nearest hits are asked for.
pub fn intersect_packets(grid: &Grid, packets: &[Packet], scratch: &mut PacketScratch, hits: &mut [[Hit; 64]]) {
    grid.intersect_packets(packets, scratch, hits);
    if grid.mesh().facing().is_none() {
        return;
    }
    for (packet, hits) in packets.iter().zip(hits).filter(|(packet, _)| packet.clip.is_some() && !packet.any_hit) {
        for (lane, hit) in hits.iter_mut().enumerate().filter(|(_, hit)| !hit.is_miss()) {
            *hit = or_cap(grid, &packet.whole_ray(lane), &packet.ray(lane), *hit);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{PI, TAU};

    use glam::DVec3;
    use shared::{
        appearance::{Clip, ClipSide},
        camera::Camera,
        division::FrameSize,
    };
    use strum::VariantArray;

    use super::*;
    use crate::{
        grid::{GridOptions, Storage},
        intersect::InstructionSet,
        model::{mesh::Mesh, statue},
        render::scene::Scene,
    };

    fn scene(mesh: &Mesh, storage: Storage, instructions: InstructionSet) -> Scene {
        let options = GridOptions { storage, ..GridOptions::default() };
        let grid = Scene::build(mesh.clone(), &options, &|_| ()).grid;
        grid.with_instructions(instructions).into()
    }

    /// The packets of a frame.
    fn packets(camera: &Camera, size: FrameSize) -> Vec<Packet> {
        let rays = camera.rays(size);
        let tiles = (0..size.yres() / 8).flat_map(|row| (0..size.xres() / 8).map(move |column| (column, row)));
        let packet = |(column, row): (u32, u32)| {
            let mut directions = [[0.0; 64]; 3];
            for lane in 0..64 {
                let direction = rays.direction(8 * column + lane % 8, 8 * row + lane / 8);
                (0..3).for_each(|axis| directions[axis][lane as usize] = direction[axis]);
            }
            Packet { origin: rays.eye, directions, active: u64::MAX, ..Packet::NONE }
        };
        tiles.map(packet).collect()
    }

    /// Asserts that packets hit as single rays do; returns each ray with its hit, by file index.
    fn check(scene: &Scene, plane: &ClipPlane, packets: &[Packet]) -> Vec<(Ray, Hit)> {
        let (grid, clip, mut scratch) = (&scene.grid, Some(plane), PacketScratch::default());
        let mut answers = Vec::new();
        for packet in packets {
            let packet = Packet { clip: Some(*plane), ..*packet };
            let for_any_hit = Packet { any_hit: true, ..packet };
            let mut hits = [[Hit::MISS; 64]];
            intersect_packets(grid, std::slice::from_ref(&packet), &mut scratch, &mut hits);
            let [hits] = hits;
            let any = grid.intersect_packet(&for_any_hit, &mut scratch);
            let mut occluded = [false; 64];
            occluded_rays(
                grid,
                clip,
                &mut std::array::from_fn::<_, 64, _>(|lane| packet.whole_ray(lane)),
                &mut occluded,
            );
            for lane in 0..64 {
                let ray = packet.whole_ray(lane);
                let hit = scene.with_file_index(hits[lane]);
                assert_eq!(hit, scene.with_file_index(intersect(grid, clip, ray)), "{ray:?} {plane:?}");
                let of_single = clip_ray(clip, ray).is_some_and(|kept| !grid.intersect(&kept).is_miss());
                assert_eq!(occluded[lane], of_single, "{ray:?} {plane:?}");
                assert_eq!(!any[lane].is_miss(), of_single, "{ray:?} {plane:?}");
                answers.push((ray, hit));
            }
        }
        answers
    }

    /// A ray's first hit on the plane's side, by testing all triangles in `f64`: triangle, t, and whether it is
    /// certain.
    fn search(mesh: &Mesh, plane: &ClipPlane, ray: &Ray) -> (Option<(u32, f64)>, bool) {
        let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let (mut nearest, mut doubtful) = (None, f64::INFINITY);
        for triangle in 0..mesh.triangles.len() {
            let Some([a, b, c]) = mesh.corners(triangle).map(|corners| corners.map(|p| Vec3::from_array(p).as_dvec3()))
            else {
                continue;
            };
            let (edge_ab, edge_ac, to_origin) = (b - a, c - a, origin - a);
            let p = direction.cross(edge_ac);
            let determinant = edge_ab.dot(p);
            let q = to_origin.cross(edge_ab);
            let (u, v) = (to_origin.dot(p) / determinant, direction.dot(q) / determinant);
            let (t, inside) = (edge_ac.dot(q) / determinant, u.min(v).min(1.0 - u - v));
            let distance = plane.offset - plane.normal.dot(origin + direction * t);
            if !(t.is_finite() && t >= 0.0 && inside >= -1e-7 && distance >= -1e-6) {
                continue;
            }
            if inside < 1e-7 || distance < 1e-6 {
                doubtful = doubtful.min(t);
            } else if nearest.is_none_or(|(_, before)| t < before) {
                nearest = Some((triangle as u32, t));
            }
        }
        let is_doubtful = doubtful.is_finite() && nearest.is_none_or(|(_, t)| doubtful <= t);
        (nearest, !is_doubtful)
    }

    #[test]
    fn rays_hit_as_in_a_search_of_all_kept_triangles() {
        let mesh = statue::generate(1500, &|_| ());
        let size = FrameSize::new(32, 16).unwrap();
        let (mut n_hits, mut n_inner, mut n_caps, mut n_doubtful) = (0, 0, 0, 0);
        let best = scene(&mesh, Storage::Tree, InstructionSet::best());
        let eyes = [DVec3::new(0.6, 1.5, 2.5), DVec3::new(-2.0, 0.4, -0.3), DVec3::new(0.05, 0.9, 0.02)];
        for (eye, (index, from)) in
            eyes.into_iter().flat_map(|eye| ClipSide::VARIANTS.iter().copied().enumerate().map(move |from| (eye, from)))
        {
            let camera = Camera::look_at(eye, DVec3::new(0.0, 0.8, 0.1), DVec3::Y, 0.8, 2.0).unwrap();
            let clip = Clip::new(from, 380 + 40 * index as u16).unwrap();
            let plane = best.clip_plane(&camera, Some(clip)).unwrap();
            for (ray, hit) in check(&best, &plane, &packets(&camera, size)) {
                let (expected, is_certain) = search(&mesh, &plane, &ray);
                // A ray that enters the kept half and leaves the statue first meets the cap.
                let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
                let (distance, slope) = (plane.offset - plane.normal.dot(origin), plane.normal.dot(direction));
                let expected = expected.map(|(triangle, t)| {
                    let [a, b, c] = mesh.corners(triangle as usize).unwrap().map(|p| Vec3::from(p).as_dvec3());
                    let is_cap = distance < 0.0 && (b - a).cross(c - a).dot(direction) > 0.0;
                    if is_cap { (Hit::CAP, distance / slope) } else { (triangle, t) }
                });
                let whole = best.grid.intersect(&ray);
                n_doubtful += u32::from(!is_certain);
                n_hits += u32::from(!hit.is_miss());
                n_inner += u32::from(!hit.is_miss() && hit.t > whole.t);
                n_caps += u32::from(hit.is_cap());
                if is_certain {
                    assert_eq!(
                        expected.map(|(triangle, _)| triangle),
                        (!hit.is_miss()).then_some(hit.triangle),
                        "{clip} {ray:?}"
                    );
                    assert!(expected.is_none_or(|(_, t)| (t - f64::from(hit.t)).abs() < 1e-6 * t), "{clip} {ray:?}");
                }
            }
        }
        let all = (n_hits, n_inner, n_caps, n_doubtful);
        assert!(n_hits > 1000 && n_inner > 300 && n_caps > 300 && n_doubtful < 30, "{all:?}");
    }

    /// A torus around the z axis; with a radius of 0 around the axis, and half of the tube, a ball.
    fn torus(radius: f64, tube: f64, turns: f64) -> Mesh {
        let (n_around, n_across) = (256u32, 128u32);
        let mut mesh = Mesh::default();
        for (i, j) in (0..n_around).flat_map(|i| (0..=n_across).map(move |j| (i, j))) {
            let around = f64::from(i) / f64::from(n_around) * TAU;
            // Both ends of a row are the same point, and so are the poles of all rows.
            let across = f64::from(if turns == 1.0 { j % n_across } else { j }) / f64::from(n_across) * TAU * turns;
            let is_pole = turns != 1.0 && (j == 0 || j == n_across);
            let (from_axis, z) = if is_pole {
                (0.0, 1.0 - 2.0 * f64::from(j) / f64::from(n_across))
            } else {
                (across.sin(), across.cos())
            };
            let from_axis = radius + tube * from_axis;
            mesh.vertices
                .push(DVec3::new(from_axis * around.cos(), from_axis * around.sin(), tube * z).as_vec3().into());
            if j < n_across {
                let (a, b) = (i * (n_across + 1) + j, (i + 1) % n_around * (n_across + 1) + j);
                mesh.triangles.extend([[a, a + 1, b + 1], [a, b + 1, b]]);
            }
        }
        mesh
    }

    fn joined(mut mesh: Mesh, other: &Mesh) -> Mesh {
        let n = mesh.vertices.len() as u32;
        mesh.vertices.extend(&other.vertices);
        mesh.triangles.extend(other.triangles.iter().map(|corners| corners.map(|vertex| vertex + n)));
        mesh
    }

    fn turned_inside_out(mut mesh: Mesh) -> Mesh {
        mesh.triangles.iter_mut().for_each(|corners| corners.swap(1, 2));
        mesh
    }

    #[test]
    fn caps_cover_the_matter_in_the_plane() {
        // Distance to the surface where the plane cuts; negative within the matter.
        let in_torus = |p: DVec3| (p.truncate().length() - 1.0).hypot(p.z) - 0.4;
        let in_shell = |p: DVec3| (p.length() - 1.0).max(0.6 - p.length());
        let solid_torus = torus(1.0, 0.4, 1.0);
        let shell = joined(torus(0.0, 1.0, 0.5), &turned_inside_out(torus(0.0, 0.6, 0.5)));
        type Solid<'a> = (&'a Mesh, &'a dyn Fn(DVec3) -> f64, &'a str, f64);
        let solids: [Solid<'_>; 4] = [
            (&solid_torus, &in_torus, "z:50", PI * (1.4 * 1.4 - 0.6 * 0.6)),
            (&solid_torus, &in_torus, "-x:50", 2.0 * PI * 0.4 * 0.4),
            (&shell, &in_shell, "y:50", PI * (1.0 - 0.6 * 0.6)),
            (&shell, &in_shell, "eye:25", PI * (0.75 - (0.6 * 0.6 - 0.25))),
        ];
        for (mesh, distance, clip, area) in solids {
            for mesh in [mesh.clone(), turned_inside_out(mesh.clone())] {
                let scene = scene(&mesh, Storage::Tree, InstructionSet::best());
                let size = FrameSize::new(256, 128).unwrap();
                let clip: Clip = clip.parse().unwrap();
                // The eye looks straight at the plane, so all samples cover the same area of it.
                let side = match clip.side() {
                    ClipSide::MinusX => -DVec3::X,
                    ClipSide::Y => DVec3::Y,
                    _ => DVec3::Z,
                };
                let up = if side == DVec3::Y { DVec3::Z } else { DVec3::Y };
                let camera = Camera::look_at(side * 5.0, DVec3::ZERO, up, 0.7, 2.0).unwrap();
                let plane = scene.clip_plane(&camera, Some(clip)).unwrap();
                let (mut n_caps, mut of_sample) = (0.0, 0.0);
                for (ray, hit) in check(&scene, &plane, &packets(&camera, size)) {
                    let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
                    let t = (plane.offset - plane.normal.dot(origin)) / plane.normal.dot(direction);
                    let distance = distance(origin + direction * t);
                    // Flat triangles lie within 0.001 of the surface.
                    if distance.abs() > 1e-3 {
                        assert_eq!(hit.is_cap(), distance < 0.0, "{clip} {ray:?} {distance}");
                    }
                    assert!(!hit.is_cap() || (f64::from(hit.t) - t).abs() < 1e-6 * t, "{clip} {ray:?}");
                    n_caps += f64::from(u8::from(hit.is_cap()));
                    of_sample = t * t * camera.u().length() * camera.v().length() / size.n_samples() as f64;
                }
                assert!((n_caps * of_sample / area - 1.0).abs() < 0.01, "{clip} {}", n_caps * of_sample / area);
            }
        }
    }

    #[test]
    fn open_surfaces_show_their_inside() {
        let mut mesh = torus(1.0, 0.4, 1.0);
        mesh.triangles.truncate(mesh.triangles.len() - 1);
        let scene = scene(&mesh, Storage::Tree, InstructionSet::best());
        let camera = Camera::look_at(DVec3::Z * 5.0, DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap();
        let plane = scene.clip_plane(&camera, "z:50".parse().ok()).unwrap();
        let answers = check(&scene, &plane, &packets(&camera, FrameSize::new(64, 32).unwrap()));
        assert!(answers.iter().any(|(_, hit)| !hit.is_miss()) && !answers.iter().any(|(_, hit)| hit.is_cap()));
    }

    #[test]
    fn every_structure_and_instruction_set_cuts_the_same() {
        let mesh = statue::generate(4000, &|_| ());
        let camera = Camera::look_at(DVec3::new(0.6, 1.5, 2.5), DVec3::Y * 0.9, DVec3::Y, 0.6, 2.0).unwrap();
        let packets = packets(&camera, FrameSize::new(64, 32).unwrap());
        let scenes: Vec<_> = InstructionSet::available()
            .into_iter()
            .map(|instructions| (Storage::Tree, instructions))
            .chain([(Storage::Plain, InstructionSet::best()), (Storage::RowDisplacement, InstructionSet::Portable)])
            .map(|(storage, instructions)| scene(&mesh, storage, instructions))
            .collect();
        for &from in ClipSide::VARIANTS {
            let answers = scenes.iter().map(|scene| {
                let plane = scene.clip_plane(&camera, Some(Clip::new(from, 450).unwrap())).unwrap();
                check(scene, &plane, &packets)
            });
            let answers: Vec<_> = answers.collect();
            assert!(answers.iter().all(|other| *other == answers[0]), "{from:?}");
        }
    }

    #[test]
    fn triangles_in_the_plane_are_kept() {
        // Two sheets that span the bounds, and one halfway, in the plane.
        let sheet = |z: f32| [[-1.0, -1.0, z], [1.0, -1.0, z], [1.0, 1.0, z], [-1.0, 1.0, z]];
        let mesh = Mesh {
            vertices: [sheet(-1.0), sheet(0.0), sheet(1.0)].concat(),
            triangles: (0..3).flat_map(|n| [[4 * n, 4 * n + 1, 4 * n + 2], [4 * n, 4 * n + 2, 4 * n + 3]]).collect(),
            ..Mesh::default()
        };
        let scene = scene(&mesh, Storage::Tree, InstructionSet::best());
        for (clip, eye_z, expected) in [
            ("z:50", 3.0, 1),
            ("z:50", -3.0, 0),
            ("-z:50", -3.0, 1),
            ("z:0", 3.0, 2),
            ("-z:50", 3.0, 2),
            ("z:51", 3.0, 0),
        ] {
            let camera = Camera::look_at(DVec3::new(0.3, 0.2, eye_z), DVec3::ZERO, DVec3::Y, 0.2, 2.0).unwrap();
            let plane = scene.clip_plane(&camera, Some(clip.parse().unwrap())).unwrap();
            for (ray, hit) in check(&scene, &plane, &packets(&camera, FrameSize::new(64, 32).unwrap())) {
                assert_eq!(hit.triangle / 2, expected, "{clip} {eye_z} {ray:?}");
            }
        }
    }

    #[test]
    fn degenerate_rays_are_clipped_without_nan() {
        let plane = ClipPlane { normal: DVec3::X, offset: 0.5 };
        let clip_ray =
            |origin: f32, direction: f32| clip_ray(Some(&plane), Ray::new(Vec3::splat(origin), Vec3::X * direction));
        assert_eq!(
            (clip_ray(0.0, 0.0).map(|ray| ray.t_max), clip_ray(1.0, 0.0)),
            (Some(f32::MAX), None),
            "along the plane"
        );
        assert_eq!(clip_ray(1.0, 1.0), None, "all beyond it");
        assert_eq!(clip_ray(0.0, -1.0).map(|ray| (ray.t_min, ray.t_max)), Some((0.0, f32::MAX)), "all before it");
        for odd in [f32::NAN, f32::INFINITY, -f32::INFINITY, f32::MAX, 1e-45] {
            for ray in [clip_ray(odd, 1.0), clip_ray(0.0, odd), clip_ray(odd, odd)].into_iter().flatten() {
                assert!(!ray.t_min.is_nan() && !ray.t_max.is_nan(), "{odd}: {ray:?}");
            }
        }
    }
}
