//! Finds the triangles that each ray of a frame may hit, by projecting all triangles onto the view plane.

use glam::{DMat3, DVec3, Vec3};
use renderer::{intersect::ray::Ray, model::mesh::Mesh};
use shared::{
    camera::{Camera, CameraRays},
    division::FrameSize,
};

#[derive(Clone, Copy, Debug, PartialEq, Eq, strum::Display)]
#[strum(serialize_all = "kebab-case")]
pub(crate) enum Placement {
    Near,
    /// The eye moved back to 10ⁿ model sizes, with the same view.
    #[strum(to_string = "eye-far-1e{0}")]
    EyeFar(u8),
    /// Model and eye moved [`FAR`] model sizes from the origin.
    ModelMoved,
}

/// In model sizes.
const FAR: f64 = 1e4;

impl serde::Serialize for Placement {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

pub(crate) struct PlacedModel {
    /// The moved vertices; `None` stands for the mesh's own.
    vertices: Option<Vec<[f32; 3]>>,
    pub(crate) camera: Camera,
}

impl PlacedModel {
    /// Moves model and camera to a placement; the error says why that is impossible.
    pub(crate) fn new(mesh: &Mesh, camera: &Camera, placement: Placement) -> Result<Self, String> {
        let [min, max] = mesh.bounds().corners();
        let (centre, size) = ((min + max) * 0.5, (max - min).length());
        match placement {
            Placement::Near => Ok(Self { vertices: None, camera: *camera }),
            Placement::EyeFar(decade) => {
                let forward = camera.u().cross(camera.v()).normalize();
                let depth = |point: DVec3| (point - camera.eye()).dot(forward);
                // Move the view plane into the model before the eye moves back.
                let scale = depth(centre) / depth(camera.ll());
                if scale <= 0.0 {
                    return Err("the model's centre lies behind the eye".to_owned());
                }
                let ll = camera.eye() + (camera.ll() - camera.eye()) * scale;
                let (u, v) = (camera.u() * scale, camera.v() * scale);
                let middle = ll + (u + v) * 0.5;
                let back = (camera.eye() - middle).normalize();
                let camera = Camera::new(middle + back * (10f64.powi(i32::from(decade)) * size), ll, u, v)
                    .map_err(|error| error.to_string())?;
                Ok(Self { vertices: None, camera })
            }
            Placement::ModelMoved => {
                let offset = DVec3::new(1.0, 1.0, 1.0).normalize() * (FAR * size) - centre;
                let camera = Camera::new(camera.eye() + offset, camera.ll() + offset, camera.u(), camera.v())
                    .map_err(|error| error.to_string())?;
                let moved = |&vertex: &[f32; 3]| (Vec3::from_array(vertex).as_dvec3() + offset).as_vec3().to_array();
                Ok(Self { vertices: Some(mesh.vertices.iter().map(moved).collect()), camera })
            }
        }
    }

    /// The corners of a triangle; `None` if it was rejected.
    pub(crate) fn corners(&self, mesh: &Mesh, triangle: usize) -> Option<[[f32; 3]; 3]> {
        let vertices = self.vertices.as_ref().unwrap_or(&mesh.vertices);
        let indices = mesh.triangles[triangle];
        let corners = |indices: [u32; 3]| indices.map(|index| vertices[index as usize]);
        (indices != Mesh::REJECTED).then(|| corners(indices))
    }
}

pub(crate) struct Candidates {
    rays: CameraRays,
    size: FrameSize,
    /// The end of each sample's candidates, row by row.
    ends: Vec<u32>,
    /// File indices of triangles, ascending for each sample.
    triangles: Vec<u32>,
}

/// Largest number of pairs of ray and triangle: 400 MB.
const MOST_PAIRS: u64 = 100_000_000;

/// Margin around a triangle's bounds in samples: more than the error of any useful method, and as much as a grid's cells
/// add.
const MARGIN: f64 = 0.25;

impl Candidates {
    pub(crate) fn find(mesh: &Mesh, placed: &PlacedModel, size: FrameSize) -> Result<Self, String> {
        let rays = placed.camera.rays(size);
        let mut counts = vec![0u32; size.n_samples() as usize];
        let mut n_pairs = 0;
        for_each_pair(mesh, placed, &rays, size, |sample, _| {
            counts[sample] += 1;
            n_pairs += 1;
            n_pairs <= MOST_PAIRS
        });
        if n_pairs > MOST_PAIRS {
            return Err(format!("more than {MOST_PAIRS} pairs of ray and triangle: choose a smaller --size"));
        }
        let mut ends = Vec::with_capacity(counts.len());
        let mut sum = 0;
        for count in counts {
            ends.push(sum);
            sum += count;
        }
        let mut triangles = vec![0; sum as usize];
        for_each_pair(mesh, placed, &rays, size, |sample, triangle| {
            triangles[ends[sample] as usize] = triangle;
            ends[sample] += 1;
            true
        });
        Ok(Self { rays, size, ends, triangles })
    }

    pub(crate) fn n_chunks(&self, n: usize) -> usize {
        self.ends.len().div_ceil(n)
    }

    /// Rays with their candidates, in chunks of at most `n`; rays without candidates are left out.
    pub(crate) fn chunks(&self, n: usize) -> impl Iterator<Item = Vec<(Ray, &[u32])>> {
        self.samples(n).map(|samples| samples.into_iter().map(|(_, _, ray, candidates)| (ray, candidates)).collect())
    }

    /// As [`Self::chunks`], with column and row of each sample.
    pub(crate) fn samples(&self, n: usize) -> impl Iterator<Item = Vec<(u32, u32, Ray, &[u32])>> {
        let xres = self.size.xres();
        (0..self.size.n_samples()).step_by(n).map(move |first| {
            let samples = first..(first + n as u32).min(self.size.n_samples());
            let with_candidates = samples.map(move |sample| {
                let begin = if sample == 0 { 0 } else { self.ends[sample as usize - 1] };
                let candidates = &self.triangles[begin as usize..self.ends[sample as usize] as usize];
                let (i, j) = (sample % xres, sample / xres);
                (i, j, Ray::new(self.rays.eye, self.rays.direction(i, j)), candidates)
            });
            with_candidates.filter(|(.., candidates)| !candidates.is_empty()).collect()
        })
    }
}

/// Calls `visit` with sample and triangle of each pair, in the order of triangles, until it returns false.
fn for_each_pair(
    mesh: &Mesh,
    placed: &PlacedModel,
    rays: &CameraRays,
    size: FrameSize,
    mut visit: impl FnMut(usize, u32) -> bool,
) {
    let origin = rays.eye.as_dvec3();
    // A point is eye + s·(a + x·du + y·dv), and (s, s·x, s·y) is linear in it.
    let plane = DMat3::from_cols(rays.a.as_dvec3(), rays.du.as_dvec3(), rays.dv.as_dvec3()).inverse();
    let (xres, yres) = (size.xres(), size.yres());
    for triangle in 0..mesh.triangles.len() {
        let Some(corners) = placed.corners(mesh, triangle) else { continue };
        let projected = corners.map(|corner| plane * (Vec3::from_array(corner).as_dvec3() - origin));
        if projected.iter().all(|p| p.x <= 0.0) {
            continue;
        }
        let crosses_eye = projected.iter().any(|p| p.x <= 0.0);
        let span = |axis: usize, n: u32| {
            if crosses_eye {
                return 0..n;
            }
            let positions = projected.map(|p| p[axis] / p.x);
            let low = positions.into_iter().fold(f64::INFINITY, f64::min) - MARGIN - 0.5;
            let high = positions.into_iter().fold(f64::NEG_INFINITY, f64::max) + MARGIN - 0.5;
            // Sample centres lie halfway between whole numbers.
            low.ceil().clamp(0.0, f64::from(n)) as u32..(high.floor() + 1.0).clamp(0.0, f64::from(n)) as u32
        };
        for j in span(2, yres) {
            for i in span(1, xres) {
                if !visit((j * xres + i) as usize, triangle as u32) {
                    return;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::reference::{Verdict, truth};
    use renderer::{grid::GridOptions, model::statue, render::scene::Scene};

    #[test]
    fn the_truth_among_the_candidates_is_what_the_grid_finds_wherever_the_model_stands() {
        let mesh = statue::generate(5000, &|_| ());
        let camera = Camera::look_at(DVec3::new(0.4, 1.2, 4.0), DVec3::Y * 0.9, DVec3::Y, 0.5, 2.0).unwrap();
        let size = FrameSize::new(100, 50).unwrap();
        for placement in [Placement::Near, Placement::EyeFar(1), Placement::EyeFar(4), Placement::ModelMoved] {
            let placed = PlacedModel::new(&mesh, &camera, placement).unwrap();
            let candidates = Candidates::find(&mesh, &placed, size).unwrap();
            let moved = Mesh { vertices: placed.vertices.clone().unwrap_or(mesh.vertices.clone()), ..mesh.clone() };
            let scene = Scene::build(moved, &GridOptions::default(), &|_| ());
            let (mut n_hits, mut n_unknown) = (0, 0);
            for (ray, triangles) in candidates.chunks(777).flatten() {
                let corners = triangles.iter().map(|&triangle| placed.corners(&mesh, triangle as usize).unwrap());
                let hit = scene.grid.intersect(&ray);
                match truth(&ray, corners) {
                    Verdict::Miss => assert!(hit.is_miss(), "{placement:?} {ray:?} {hit:?}"),
                    Verdict::Unknown => n_unknown += 1,
                    Verdict::Hit(t) => {
                        n_hits += 1;
                        assert!((f64::from(hit.t) - t).abs() <= 1e-7 * t, "{placement:?} {ray:?} {hit:?} {t}");
                    }
                }
            }
            assert!(n_hits > 500 && n_unknown < n_hits / 50, "{placement:?}: {n_hits} hits, {n_unknown} unknown");
        }
    }
}
