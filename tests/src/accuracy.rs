//! Hits on real models against a reference in `f64` without a grid: it projects every triangle onto the view plane and
//! tests it against the rays of the samples that it covers.

use std::path::Path;

use glam::{DMat3, DVec3, Vec3};
use renderer::{
    formats::file,
    grid::GridOptions,
    intersect::{MOST_PACKETS, Packet, PacketScratch, ray::Hit},
    model::mesh::Mesh,
    render::{blocks::for_each_group, scene::Scene, tracer::set_camera_rays},
};
use shared::{
    camera::{Camera, CameraRays, CanvasPart, UpAxis},
    division::{Division, FrameSize},
};

use crate::process::shared_folder;

/// The nearest hit of each sample, row by row from the bottom: file index and t.
type Reference = Vec<Option<(u32, f64)>>;

/// Möller and Trumbore's test in `f64`, edges included.
fn intersect(corners: [DVec3; 3], origin: DVec3, direction: DVec3) -> Option<f64> {
    let [a, b, c] = corners;
    let (edge_ab, edge_ac) = (b - a, c - a);
    let p = direction.cross(edge_ac);
    let determinant = edge_ab.dot(p);
    let to_origin = origin - a;
    let q = to_origin.cross(edge_ab);
    let (u, v) = (to_origin.dot(p) / determinant, direction.dot(q) / determinant);
    let t = edge_ac.dot(q) / determinant;
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t >= 0.0).then_some(t)
}

fn reference(mesh: &Mesh, rays: &CameraRays, size: FrameSize) -> Reference {
    let origin = rays.eye.as_dvec3();
    // A point is eye + s·(a + x·du + y·dv), and (s, s·x, s·y) is linear in it.
    let plane = DMat3::from_cols(rays.a.as_dvec3(), rays.du.as_dvec3(), rays.dv.as_dvec3()).inverse();
    let (xres, yres) = (size.xres(), size.yres());
    let mut nearest: Reference = vec![None; size.n_samples() as usize];
    for triangle in 0..mesh.triangles.len() {
        let Some(corners) = mesh.corners(triangle) else { continue };
        let corners = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
        let projected = corners.map(|corner| plane * (corner - origin));
        if projected.iter().all(|p| p.x <= 0.0) {
            continue;
        }
        // One sample of margin is far more than the rays' rounding to single precision.
        let span = |axis: usize, n: u32| {
            if projected.iter().any(|p| p.x <= 0.0) {
                return 0..n;
            }
            let places = projected.map(|p| p[axis] / p.x);
            let low = places.into_iter().fold(f64::INFINITY, f64::min) - 1.0;
            let high = places.into_iter().fold(f64::NEG_INFINITY, f64::max) + 1.0;
            low.clamp(0.0, f64::from(n)) as u32..high.clamp(0.0, f64::from(n)) as u32
        };
        for j in span(2, yres) {
            for i in span(1, xres) {
                let Some(t) = intersect(corners, origin, rays.direction(i, j).as_dvec3()) else { continue };
                let nearest = &mut nearest[(j * xres + i) as usize];
                if nearest.is_none_or(|(_, nearest_t)| t < nearest_t) {
                    *nearest = Some((triangle as u32, t));
                }
            }
        }
    }
    nearest
}

pub(crate) fn hits(scene: &Scene, rays: &CameraRays, size: FrameSize) -> Vec<Hit> {
    let task = Division::Tiled.task(0, 1);
    let share = task.share(size).unwrap();
    let mut rows = vec![Hit::MISS; size.n_samples() as usize];
    let mut packets = [Packet::NONE; MOST_PACKETS];
    let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
    let mut scratch = PacketScratch::default();
    for_each_group(&share, 0..share.count(), |blocks| {
        let (packets, hits) = (&mut packets[..blocks.len()], &mut hits[..blocks.len()]);
        packets.iter_mut().zip(blocks).for_each(|(packet, block)| set_camera_rays(packet, rays, block, 0));
        scene.trace_group(blocks, packets, &mut scratch, hits);
        for (block, hits) in blocks.iter().zip(hits) {
            for ((i, j), &hit) in block.samples().zip(&*hits) {
                rows[(j * size.xres() + i) as usize] = scene.with_file_index(hit);
            }
        }
    });
    rows
}

fn check(name: &str, hits: &[Hit], reference: &Reference) {
    let (mut lost, mut invented, mut others) = (0, 0, 0);
    let mut errors = Vec::new();
    for (hit, truth) in hits.iter().zip(reference) {
        match (hit.is_miss(), truth) {
            (true, None) => (),
            (true, Some(_)) => lost += 1,
            (false, None) => invented += 1,
            (false, &Some((triangle, t))) => {
                others += usize::from(triangle != hit.triangle);
                errors.push((f64::from(hit.t) - t).abs() / t);
            }
        }
    }
    assert!(errors.len() > 50_000, "{name}: the camera hardly sees the model");
    errors.sort_by(f64::total_cmp);
    let (worst, p999) = (errors[errors.len() - 1], errors[errors.len() * 999 / 1000]);
    assert!(
        lost == 0 && invented == 0 && others <= 10 && worst <= 1e-4 && p999 <= 7e-7,
        "{name}: {lost} lost, {invented} invented, {others} with another triangle, depth off by {p999:e} (p99.9), {worst:e} (worst)"
    );
}

fn check_model(models: &Path, name: &str) {
    let mesh = file::read(&models.join(format!("{name}.ply")), &|_| ()).unwrap().mesh;
    let scene = Scene::build(mesh.clone(), &GridOptions::default(), &|_| ());
    for view in ["full", "close"] {
        let camera = std::fs::read_to_string(models.join(format!("{name}.{view}.toml"))).unwrap();
        let rays = Camera::from_toml(&camera).unwrap().rays(FrameSize::PAPER);
        let reference = reference(&mesh, &rays, FrameSize::PAPER);
        check(&format!("{name}.{view}"), &hits(&scene, &rays, FrameSize::PAPER), &reference);
    }
}

#[test]
fn a_scanned_dragon_is_hit_as_in_f64() {
    let Some(folder) = shared_folder() else { return };
    check_model(&folder.join("models"), "dragon");
}

#[test]
fn a_million_triangles_of_cad_are_hit_as_in_f64() {
    let Some(folder) = shared_folder() else { return };
    check_model(&folder.join("models"), "kicad-1m");
}

#[test]
fn the_statue_is_hit_as_in_f64() {
    let mesh = renderer::model::statue::generate(200_000, &|_| ());
    let scene = Scene::build(mesh.clone(), &GridOptions::default(), &|_| ());
    let camera = Camera::view_all(&mesh.shape(), UpAxis::Y, 16.0 / 9.0, CanvasPart::WHOLE);
    let rays = camera.rays(FrameSize::PAPER);
    let reference = reference(&mesh, &rays, FrameSize::PAPER);
    check("statue", &hits(&scene, &rays, FrameSize::PAPER), &reference);
}
