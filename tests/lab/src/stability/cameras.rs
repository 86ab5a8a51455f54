//! Cameras: their rays against rays in `f64`, and degenerate cameras.

use glam::{DMat3, DVec2, DVec3, Vec3};
use rayon::prelude::*;
use renderer::{
    grid::{Grid, GridOptions},
    intersect::{PacketScratch, ray::Ray},
    model::{mesh::Mesh, statue},
};
use shared::{camera::Camera, division::FrameSize};

use super::{
    contenders::{Answer, Contender, RayBundle, Tally, tally},
    solids,
};
use crate::chart::{
    candidates::{Candidates, PlacedModel, Placement},
    reference::{self, Verdict},
    view_all,
};

/// Distance from an edge, in pixels, below which the rounding of a ray to `f32` decides.
const NEAR_EDGE: f64 = 1e-3;

/// Relative depth error that one pixel in a thousand may exceed.
const DEPTH_P999: f64 = 1e-6;

/// Compares pictures of the statue with those of a camera whose rays are not rounded.
pub(super) fn against_f64(n_rays: u64) -> Tally {
    let mesh = statue::generate(100_000, &|_| ());
    let grid = Grid::build(mesh.clone(), &GridOptions::default(), &|_| ());
    let full = view_all(&mesh, 16.0 / 9.0);
    let eyes = [(0.5, 1.9, 2.0, 2.6), (-2.0, 2.8, 1.5, 2.4), (3.0, 4.0, -3.0, 1.7)];
    let close = |&(x, y, z, up): &(f64, f64, f64, f64)| {
        Camera::look_at(DVec3::new(x, y, z), DVec3::Y * up, DVec3::Y, 0.5, 16.0 / 9.0).ok()
    };
    let cameras: Vec<_> = [full].into_iter().chain(eyes.iter().filter_map(close)).collect();
    let height = (n_rays / 2 / cameras.len() as u64).isqrt().clamp(64, 1024) as u32;
    let Ok(size) = FrameSize::new(2 * height, height) else { return Tally::default() };
    cameras.iter().map(|camera| picture(&mesh, &grid, camera, size)).sum()
}

fn picture(mesh: &Mesh, grid: &Grid, camera: &Camera, size: FrameSize) -> Tally {
    let Ok(placed) = PlacedModel::new(mesh, camera, Placement::Near) else { return Tally::default() };
    let Ok(candidates) = Candidates::find(mesh, &placed, size) else { return Tally::default() };
    let (eye, xres, yres) = (camera.eye(), f64::from(size.xres()), f64::from(size.yres()));
    // A point is eye + s·((ll − eye) + x·u/xres + y·v/yres), and s is its t.
    let plane = DMat3::from_cols(camera.ll() - eye, camera.u() / xres, camera.v() / yres).inverse();
    let project = |corner: [f32; 3]| plane * (Vec3::from_array(corner).as_dvec3() - eye);
    let chunks: Vec<_> = candidates.samples(64).collect();
    let tallies = chunks.into_par_iter().map_init(PacketScratch::default, |scratch, chunk| {
        let mut tally = Tally::default();
        let directions = chunk.iter().map(|&(_, _, ray, _)| ray.direction).collect();
        let Some(&(_, _, Ray { origin, .. }, _)) = chunk.first() else { return (tally, Default::default()) };
        let truths: Vec<_> = chunk
            .iter()
            .map(|&(i, j, _, triangles)| {
                let pixel = DVec2::new(f64::from(i) + 0.5, f64::from(j) + 0.5);
                let corners = triangles.iter().filter_map(|&triangle| mesh.corners(triangle as usize));
                truth(pixel, corners.map(|corners| corners.map(project)))
            })
            .collect();
        let bundle = RayBundle { origin, directions };
        let mut n_far_off = [0; Contender::ALL.len()];
        tally.n_rays = truths.iter().flatten().count() as u64;
        for (&contender, n_far_off) in Contender::ALL.iter().zip(&mut n_far_off) {
            for (answer, truth) in contender.trace(grid, &bundle, scratch).into_iter().zip(&truths) {
                let Some(depth) = *truth else { continue };
                let is_right = answer.is_some() == depth.is_some();
                tally.count(contender, is_right, || format!("{answer:?} instead of {depth:?}"));
                if let (Some((_, t)), Some(depth)) = (answer, depth) {
                    *n_far_off += u64::from((t - depth).abs() > DEPTH_P999 * depth);
                }
            }
        }
        (tally, n_far_off)
    });
    let add = |(mut sum, mut n_far_off): (Tally, [u64; Contender::ALL.len()]),
               (tally, others): (Tally, [u64; Contender::ALL.len()])| {
        sum += tally;
        n_far_off.iter_mut().zip(others).for_each(|(sum, other)| *sum += other);
        (sum, n_far_off)
    };
    let (mut tally, n_far_off) = tallies.reduce(Default::default, add);
    for (contender, n_far_off) in Contender::ALL.into_iter().zip(n_far_off) {
        let is_right = n_far_off * 1000 <= tally.n_rays;
        tally.count(contender, is_right, || format!("the depths of {n_far_off} pixels are off"));
    }
    tally
}

/// The depth of the nearest triangle at a pixel; corners are (s, s·x, s·y). `None` if an edge is too near.
fn truth(pixel: DVec2, triangles: impl Iterator<Item = [DVec3; 3]>) -> Option<Option<f64>> {
    let mut nearest: Option<f64> = None;
    for corners in triangles {
        if corners.iter().any(|corner| corner.x <= 0.0) {
            return None;
        }
        let [a, b, c] = corners.map(|corner| DVec2::new(corner.y, corner.z) / corner.x - pixel);
        let areas = [(b, c), (c, a), (a, b)].map(|(p, q)| p.perp_dot(q));
        if [(b, c), (c, a), (a, b)].into_iter().any(|(p, q)| distance_of_origin(p, q) < NEAR_EDGE) {
            return None;
        }
        if areas.iter().all(|&area| area > 0.0) || areas.iter().all(|&area| area < 0.0) {
            // 1/s is linear on the view plane.
            let inverse: f64 = areas.iter().zip(corners).map(|(area, corner)| area / corner.x).sum();
            let depth = areas.iter().sum::<f64>() / inverse;
            nearest = Some(nearest.map_or(depth, |nearest| nearest.min(depth)));
        }
    }
    Some(nearest)
}

/// The distance of the origin from the segment from p to q.
fn distance_of_origin(p: DVec2, q: DVec2) -> f64 {
    let along = q - p;
    let part = (-p.dot(along) / along.length_squared()).clamp(0.0, 1.0);
    if part.is_nan() { p.length() } else { (p + along * part).length() }
}

/// Cameras in the model, mirrored, upside down, and with an aspect ratio of a million or a millionth.
pub(super) fn degenerate(n_rays: u64) -> Tally {
    let mesh = solids::sphere([0.3, -0.2, 0.1], 1.0, 8);
    let grid = Grid::build(mesh.clone(), &GridOptions::default(), &|_| ());
    let (eye, ll) = (DVec3::new(1.0, 1.5, 4.0), DVec3::new(-1.4, -1.3, 0.0));
    let (u, v) = (DVec3::X * 3.2, DVec3::Y * 2.4);
    let inside = DVec3::new(0.3, -0.1, 0.2);
    let on_surface = Vec3::from_array(mesh.vertices[40]).as_dvec3();
    let cameras = [
        Camera::new(eye, ll, u, v),
        Camera::new(eye, ll + u, -u, v),
        Camera::new(eye, ll + v, u, -v),
        Camera::new(eye, ll, v, u),
        Camera::new(inside, inside - (u + v) * 0.5 + DVec3::NEG_Z, u, v),
        Camera::new(on_surface, on_surface - (u + v) * 0.5 + DVec3::NEG_Z, u, v),
        Camera::new(eye, ll, u, v * 1e-6),
        Camera::new(eye, ll, u * 1e-6, v),
        Camera::new(eye, ll - u * 5e5, u * 1e6, v),
        Camera::new(eye, ll + DVec3::Z * 3.9, u, v),
    ];
    let n_cameras = cameras.len() as u64;
    let mut sum = Tally::default();
    for camera in cameras {
        let Ok(camera) = camera else {
            sum.count(Contender::Single, false, || "a valid camera is refused".to_owned());
            continue;
        };
        sum += rays_of(&mesh, &grid, &camera, n_rays / n_cameras / COSTLY);
    }
    let nan = DVec3::new(0.0, f64::NAN, 0.0);
    let wrong =
        [(eye, ll, u * 0.0, v), (eye, ll, u, u * 2.0), (ll, ll, u, v), (ll + u * 3.0, ll, u, v), (nan, ll, u, v)];
    for (eye, ll, u, v) in wrong {
        let is_refused = Camera::new(eye, ll, u, v).is_err();
        sum.count(Contender::Single, is_refused, || format!("an invalid camera is accepted: {eye} {ll} {u} {v}"));
    }
    sum
}

/// Divides the number of rays, because the reference tests each ray against each triangle.
const COSTLY: u64 = 4;

/// Compares all rays of a camera with [`reference::truth`] over all triangles, where it decides.
pub(super) fn rays_of(mesh: &Mesh, grid: &Grid, camera: &Camera, n_rays: u64) -> Tally {
    let height = ((n_rays / 2).isqrt() as u32 / 8 * 8).clamp(8, 1024);
    let Ok(size) = FrameSize::new(2 * height, height) else { return Tally::default() };
    let rays = camera.rays(size);
    let triangles: Vec<_> = (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)).collect();
    let tiles_per_row = size.xres() / 8;
    tally(
        grid,
        u64::from(size.n_samples() / 64),
        |tile| {
            let (i, j) = (tile as u32 % tiles_per_row * 8, tile as u32 / tiles_per_row * 8);
            let directions = (0..64).map(|sample_idx| rays.direction(i + sample_idx % 8, j + sample_idx / 8)).collect();
            RayBundle { origin: rays.eye, directions }
        },
        |ray| reference::truth(ray, triangles.iter().copied()),
        |_, truth, answer: Answer| match (truth, answer) {
            (Verdict::Unknown, _) | (Verdict::Miss, None) => true,
            (Verdict::Hit(depth), Some((_, t))) => (t - depth).abs() <= 1e-4 * depth.max(1e-6),
            _ => false,
        },
    )
}
