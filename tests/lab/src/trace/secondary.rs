//! Rays that share no origin: from the points that a frame's primary rays hit, each in a direction of its own.
//!
//! [`Kind`] has the four kinds that other ray tracers are given too, made in the same way. They come tile by tile, one for
//! each sample that hit something. A ray starts on its triangle's plane, lifted off it along the normal that faces where it
//! came from: by 1e-5 of half the diagonal of the model's bounds, and by at least 2⁻²¹ of the largest coordinate. Bounces
//! take their directions from a hash of sample and bounce, cosine-distributed about that normal. Points and directions are
//! computed in `f64`, with + − × ÷ √ alone, so the rays are the same on every machine.

use std::{iter::Sum, time::Duration};

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use renderer::{
    intersect::ray::{Hit, Ray},
    render::{parallel::work_off, scene::Scene},
};
use serde::Serialize;
use shared::{
    camera::{Camera, CameraRays},
    division::{FrameSize, TILE_SIZE},
    protocol::FrameSpec,
};
use strum::VariantArray;

use crate::statistics::median;

/// The purpose of rays; all directions have unit length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, VariantArray, strum::Display)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Kind {
    /// Ambient occlusion: the directions of `Bounce`, a tenth of half the diagonal long; any hit counts.
    Ao,
    /// The first bounce, endless; the nearest hit counts.
    Bounce,
    /// The second bounce, from where rays of the first hit: neighbours have nothing in common. The nearest hit counts.
    Bounce2,
    /// Shadow rays to the upper left behind the eye, parallel and endless, from surfaces that face there; any hit counts.
    Sun,
}

impl Kind {
    /// Whether any hit of a ray answers it.
    pub fn any_hit(self) -> bool {
        matches!(self, Self::Ao | Self::Sun)
    }
}

/// Rays of one kind, traced.
#[derive(Serialize)]
pub(super) struct KindReport {
    kind: Kind,
    any_hit: bool,
    rays: usize,
    hits: usize,
    /// CPU time of all threads over the number of rays, the median of some frames; 0 without rays.
    cpu_ns_per_ray: f64,
}

impl KindReport {
    /// A line of the table.
    pub(super) fn line(&self) -> String {
        let Self { kind, any_hit, rays, hits, cpu_ns_per_ray } = self;
        let asked = if *any_hit { "any hit" } else { "nearest hit" };
        format!("{kind:<11} {cpu_ns_per_ray:.1} ns of CPU a ray, {asked}: {rays} rays, {hits} hits")
    }
}

/// Traces the rays of each kind that start in a frame, `n_times`, on the current rayon pool.
pub(super) fn measure(scene: &Scene, spec: &FrameSpec, n_times: u32) -> Vec<KindReport> {
    let maker = RayMaker::new(scene, &scene.local(&spec.camera), spec.size);
    let of_kind = |&kind: &Kind| {
        let rays = maker.rays(kind);
        let mut hits = 0;
        let times: Vec<_> = (0..n_times)
            .map(|_| {
                let (found, cpu) = trace_rays(scene, &rays, kind.any_hit());
                hits = found.n_hits;
                cpu.as_secs_f64() * 1e9 / rays.len().max(1) as f64
            })
            .collect();
        KindReport { kind, any_hit: kind.any_hit(), rays: rays.len(), hits, cpu_ns_per_ray: median(times) }
    };
    Kind::VARIANTS.iter().map(of_kind).collect()
}

/// The answers to rays, summed up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Found {
    /// Rays that hit something.
    pub n_hits: usize,
    /// Of the nearest triangles' numbers in the file, modulo 2³²; 0 for any hit.
    pub sum_of_triangles: u32,
}

impl Sum for Found {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, found| Self {
            n_hits: sum.n_hits + found.n_hits,
            sum_of_triangles: sum.sum_of_triangles.wrapping_add(found.sum_of_triangles),
        })
    }
}

/// Rays of one call: enough to keep a stream of them full.
const RAYS_PER_CALL: usize = 256;

/// Traces rays to their nearest hits, or with `any` to any hit, on the current rayon pool. Returns the CPU time of all
/// threads too.
pub fn trace_rays(scene: &Scene, rays: &[Ray], any: bool) -> (Found, Duration) {
    let call = |rays: &[Ray]| {
        if any {
            let mut occluded = [false; RAYS_PER_CALL];
            scene.grid.occluded_rays(rays, &mut occluded);
            return Found { n_hits: occluded.iter().filter(|&&occluded| occluded).count(), sum_of_triangles: 0 };
        }
        let mut hits = [Hit::MISS; RAYS_PER_CALL];
        scene.grid.intersect_rays(rays, &mut hits);
        let hits = hits.iter().filter(|hit| !hit.is_miss());
        let numbers = hits.clone().map(|hit| scene.mesh().file_index(hit.triangle));
        Found { n_hits: hits.count(), sum_of_triangles: numbers.fold(0, u32::wrapping_add) }
    };
    let of_threads = work_off(rays.chunks(RAYS_PER_CALL), |next| std::iter::from_fn(next).map(call).sum());
    (of_threads.iter().map(|&(found, _): &(Found, _)| found).sum(), of_threads.iter().map(|&(_, cpu)| cpu).sum())
}

/// Where a ray hit; model space.
struct Surface {
    /// On the triangle's plane, lifted off it.
    point: DVec3,
    /// Unit length, on the side of the ray's origin.
    normal: DVec3,
}

/// Makes rays from a camera's hits.
struct RayMaker<'a> {
    scene: &'a Scene,
    primary: CameraRays,
    size: FrameSize,
    to_sun: DVec3,
    /// How far points are lifted off their surfaces.
    lift: f64,
    ao_length: f32,
}

impl<'a> RayMaker<'a> {
    /// For a frame of `size`, seen by a camera in model space.
    fn new(scene: &'a Scene, camera: &Camera, size: FrameSize) -> Self {
        let [min, max] = scene.mesh().bounds().corners();
        let (half_diagonal, largest) = ((max - min).length() * 0.5, min.abs().max(max.abs()).max_element());
        let forward = (camera.ll() - camera.eye() + (camera.u() + camera.v()) * 0.5).normalize();
        Self {
            scene,
            primary: camera.rays(size),
            size,
            to_sun: (camera.v().normalize() - camera.u().normalize() - forward).normalize(),
            lift: (1e-5 * half_diagonal).max(largest / f64::from(1 << 21)),
            ao_length: (0.1 * half_diagonal) as f32,
        }
    }

    /// All rays of a kind, tile by tile.
    fn rays(&self, kind: Kind) -> Vec<Ray> {
        let n_tiles = self.size.x_tiles() * self.size.yres().div_ceil(TILE_SIZE);
        (0..n_tiles).into_par_iter().flat_map_iter(|tile| self.rays_of_tile(kind, tile)).collect()
    }

    fn rays_of_tile(&self, kind: Kind, tile: u32) -> Vec<Ray> {
        let (column, row) = (tile % self.size.x_tiles() * TILE_SIZE, tile / self.size.x_tiles() * TILE_SIZE);
        let (xres, yres) = self.size.into();
        let samples = (row..yres.min(row + TILE_SIZE))
            .flat_map(|j| (column..xres.min(column + TILE_SIZE)).map(move |i| (i, j)))
            .map(|(i, j)| (j * xres + i, Ray::new(self.primary.eye, self.primary.direction(i, j))));
        let first: Vec<_> = self
            .leave_hits(samples.collect(), |sample, Surface { normal, .. }| match kind {
                Kind::Sun => (normal.dot(self.to_sun) > 0.0).then_some(self.to_sun),
                Kind::Ao | Kind::Bounce | Kind::Bounce2 => Some(cosine_direction(*normal, sample, 1)),
            })
            .collect();
        let t_max = if kind == Kind::Ao { self.ao_length } else { f32::INFINITY };
        let last: Vec<_> = if kind == Kind::Bounce2 {
            self.leave_hits(first, |sample, surface| Some(cosine_direction(surface.normal, sample, 2))).collect()
        } else {
            first
        };
        last.into_iter().map(|(_, ray)| Ray { t_max, ..ray }).collect()
    }

    /// Endless rays from the hits of others, each with its sample's number, in the directions that `direction` chooses.
    fn leave_hits<'b>(
        &'b self,
        rays: Vec<(u32, Ray)>,
        direction: impl Fn(u32, &Surface) -> Option<DVec3> + 'b,
    ) -> impl Iterator<Item = (u32, Ray)> + 'b {
        let mut hits = vec![Hit::MISS; rays.len()];
        self.scene.grid.intersect_rays(&rays.iter().map(|&(_, ray)| ray).collect::<Vec<_>>(), &mut hits);
        rays.into_iter().zip(hits).filter_map(move |((sample, ray), hit)| {
            let surface = self.surface(&ray, hit)?;
            let direction = direction(sample, &surface)?.as_vec3();
            Some((sample, Ray { t_max: f32::INFINITY, ..Ray::new(surface.point.as_vec3(), direction) }))
        })
    }

    /// The surface at a hit; `None` for a miss, and for slivers too thin to have a normal.
    fn surface(&self, ray: &Ray, hit: Hit) -> Option<Surface> {
        if hit.is_miss() {
            return None;
        }
        let [a, b, c] = self.scene.mesh().corners(hit.triangle).map(|corner| Vec3::from_array(corner).as_dvec3());
        let (origin, direction) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let normal = (b - a).cross(c - a).try_normalize()?;
        let slope = normal.dot(direction);
        // A ray along the plane has no certain t there.
        let t = if slope.abs() > 1e-9 { (a - origin).dot(normal) / slope } else { f64::from(hit.t) };
        let normal = if slope > 0.0 { -normal } else { normal };
        Some(Surface { point: origin + direction * t + normal * self.lift, normal })
    }
}

/// A unit vector about a unit normal, with a density that follows the cosine of the angle between them: a point of the unit
/// disc, lifted to the hemisphere. The basis is that of Duff et al., "Building an Orthonormal Basis, Revisited" (2017).
fn cosine_direction(n: DVec3, sample: u32, bounce: u32) -> DVec3 {
    let seed = hash(sample.wrapping_add(hash(bounce)));
    let coordinate = |index: u32| (f64::from(hash(seed.wrapping_add(index))) + 0.5) / f64::from(1u32 << 31) - 1.0;
    let (mut index, mut x, mut y) = (0, coordinate(0), coordinate(1));
    while x * x + y * y >= 1.0 {
        index += 2;
        (x, y) = (coordinate(index), coordinate(index + 1));
    }
    let z = (1.0 - (x * x + y * y)).sqrt();
    let sign = 1f64.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    let tangent = DVec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x);
    let bitangent = DVec3::new(b, sign + n.y * n.y * a, -n.y);
    tangent * x + bitangent * y + n * z
}

/// Mixes bits: Jarzynski and Olano, "Hash Functions for GPU Rendering" (2020).
fn hash(x: u32) -> u32 {
    let state = x.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let word = (state >> ((state >> 28) + 4) ^ state).wrapping_mul(277_803_737);
    word >> 22 ^ word
}

#[cfg(test)]
mod tests {
    use renderer::{grid::GridOptions, model::mesh::Mesh};

    use super::*;

    /// A cube of edge length 2 about the origin, far from the origin of its coordinates.
    fn cube() -> Scene {
        let vertices = (0..8u8).map(|number| [0, 1, 2].map(|axis| f32::from(number >> axis & 1) * 2.0 + 99.0));
        let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
        let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Scene::build(
            Mesh { vertices: vertices.collect(), triangles, ..Mesh::default() },
            &GridOptions::default(),
            &|_| (),
        )
    }

    /// Rays of a kind from the hits of a camera at `eye`, and how many of them hit something.
    fn traced(eye: DVec3, kind: Kind) -> (Vec<Ray>, usize) {
        let (scene, centre) = (cube(), DVec3::splat(100.0));
        let camera = Camera::look_at(centre + eye, centre + DVec3::X * 0.1, DVec3::Y, 1.0, 2.0).unwrap();
        let rays = RayMaker::new(&scene, &scene.local(&camera), FrameSize::new(83, 41).unwrap()).rays(kind);
        let (found, _) = trace_rays(&scene, &rays, kind.any_hit());
        let (nearest, _) = trace_rays(&scene, &rays, false);
        assert_eq!(found.n_hits, nearest.n_hits, "{kind}");
        (rays, found.n_hits)
    }

    #[test]
    fn rays_are_lifted_off_the_surface_on_the_side_that_the_camera_sees() {
        let (inside, outside) = (DVec3::new(0.3, 0.2, -0.1), DVec3::new(2.5, 2.0, 3.0));
        for kind in [Kind::Bounce, Kind::Bounce2] {
            let (rays, n_hits) = traced(inside, kind);
            assert_eq!((rays.len(), n_hits), (83 * 41, 83 * 41), "in a closed room every {kind} ray hits");
        }
        let (rays, n_hits) = traced(inside, Kind::Sun);
        assert!(!rays.is_empty() && n_hits == rays.len(), "no sun shines into a closed room");
        let (rays, n_hits) = traced(inside, Kind::Ao);
        assert!(n_hits > rays.len() / 50 && n_hits < rays.len() / 5, "{n_hits} of {} short rays hit", rays.len());
        for kind in [Kind::Ao, Kind::Bounce, Kind::Sun] {
            let (rays, n_hits) = traced(outside, kind);
            assert!(
                rays.len() > 100 && n_hits == 0,
                "{n_hits} of {} {kind} rays hit the cube that they leave",
                rays.len()
            );
        }
        assert_eq!(traced(outside, Kind::Bounce2).0, []);
    }

    #[test]
    fn directions_are_cosine_distributed() {
        for normal in [DVec3::Z, DVec3::NEG_Z, DVec3::new(0.48, -0.6, 0.64)] {
            let directions: Vec<_> = (0..10_000).map(|sample| cosine_direction(normal, sample, 1)).collect();
            assert!(directions.iter().all(|direction| (direction.length() - 1.0).abs() < 1e-12));
            let mean = directions.iter().sum::<DVec3>() / 10_000.0;
            assert!((mean - normal * (2.0 / 3.0)).length() < 0.02, "the mean of cosines is 2/3, not {mean}");
        }
        assert_ne!(cosine_direction(DVec3::Z, 7, 1), cosine_direction(DVec3::Z, 7, 2));
    }
}
