//! A mesh with its grid, stand-ins and sky, and the questions that one ray answers.

use std::sync::Arc;

use glam::{DVec3, Vec3};
use shared::{
    appearance::{Clip, ClipPlane},
    camera::Camera,
    detail::Detail,
    division::FrameSize,
    protocol::ProbeHit,
};

use crate::{
    grid::{Grid, GridOptions, traced::TracedMesh},
    intersect::{
        clip,
        ray::{Hit, Ray},
    },
    model::{
        mesh::Mesh,
        stand_in::{LEAST_TRIANGLES, StandInMesh, stand_ins},
    },
    render::sky::SkyMap,
};

/// A point that lies this far behind a surface is still seen, as a part of the scene's diagonal: points of other programs are
/// rounded.
const SEEN_DEPTH: f64 = 5e-4;

/// The largest relative difference of a hit's t in `f32` and `f64`.
const SAME_T: f64 = 1e-3;

/// A mesh with its grid: all that rays need.
///
/// Frames show a stand-in where their [`Detail`] allows one; everything else asks the mesh itself.
pub struct Scene {
    /// The grid, which holds the mesh.
    pub grid: Grid,
    /// The image that lights path-traced frames which name it.
    pub sky: Option<Arc<SkyMap>>,
    /// Shown in the mesh's place where they are fine enough; the finest first.
    pub(crate) stand_ins: Vec<StandIn>,
}

/// A coarser mesh with its grid.
pub(crate) struct StandIn {
    /// Of its cells.
    pub(crate) side: f32,
    /// Without stand-ins of its own.
    pub(crate) scene: Scene,
}

impl Scene {
    /// Builds the grid, and the stand-ins of a large mesh, on the current rayon pool; `progress` receives the fraction done, 0 to 1,
    /// from any thread.
    pub fn build(mesh: Mesh, options: &GridOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        Self::build_with_stand_ins(mesh, LEAST_TRIANGLES, options, progress)
    }

    /// As [`Scene::build`], with stand-ins of a mesh that has at least this many triangles.
    pub fn build_with_stand_ins(
        mesh: Mesh,
        least_triangles: usize,
        options: &GridOptions,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Self {
        let lattice = mesh.lattice;
        let stand_ins = stand_ins(&mesh, least_triangles);
        if stand_ins.is_empty() {
            return Grid::build(mesh, options, progress).into();
        }
        progress(0.2);
        let n_bytes = stand_ins.iter().map(|coarse| coarse.mesh.n_bytes()).sum();
        let grid = Grid::build_beside(n_bytes, mesh, options, &|done| progress(0.2 + 0.7 * done));
        let n_bytes = n_bytes + grid.mesh().n_bytes() + grid.n_bytes();
        let built = stand_ins.into_iter().map(|StandInMesh { side, mesh }| {
            let scene = Grid::build_beside(n_bytes, mesh.snapped_to(lattice), options, &|_| ()).into();
            StandIn { side, scene }
        });
        Self { stand_ins: built.collect(), ..grid.into() }
    }

    /// The same scene under a sky image.
    #[must_use]
    pub fn with_sky(self, sky: Option<Arc<SkyMap>>) -> Self {
        let under_sky = |StandIn { side, scene }| StandIn { side, scene: scene.with_sky(sky.clone()) };
        Self { stand_ins: self.stand_ins.into_iter().map(under_sky).collect(), sky, ..self }
    }

    /// The grids of the scene and of its stand-ins.
    pub(crate) fn grids(&self) -> impl Iterator<Item = &Grid> {
        std::iter::once(&self.grid).chain(self.stand_ins.iter().map(|coarse| &coarse.scene.grid))
    }

    /// The same, in the same order.
    pub(crate) fn grids_mut(&mut self) -> impl Iterator<Item = &mut Grid> {
        std::iter::once(&mut self.grid).chain(self.stand_ins.iter_mut().map(|coarse| &mut coarse.scene.grid))
    }

    /// The coarsest of the scene and its stand-ins that a frame may show.
    pub fn at(&self, detail: Detail) -> &Self {
        let is_allowed = |coarse: &&StandIn| detail.allows(coarse.side);
        self.stand_ins.iter().rfind(is_allowed).map_or(self, |coarse| &coarse.scene)
    }

    /// The mesh, in the grid's order.
    pub fn mesh(&self) -> &TracedMesh {
        self.grid.mesh()
    }

    /// Number of triangles that can be hit.
    pub fn n_triangles(&self) -> usize {
        self.mesh().n_triangles()
    }

    /// Bytes of mesh, grid, stand-ins and sky in memory.
    pub fn n_bytes(&self) -> usize {
        let sky = self.sky.as_ref().map_or(0, |sky| sky.n_bytes());
        self.mesh().n_bytes() + self.grid.n_bytes() + self.n_stand_in_bytes() + sky
    }

    /// Bytes of the stand-ins in memory.
    pub fn n_stand_in_bytes(&self) -> usize {
        self.stand_ins.iter().map(|StandIn { scene, .. }| scene.mesh().n_bytes() + scene.grid.n_bytes()).sum()
    }

    /// Triangles of the stand-ins, the finest first, each with the side of its cells.
    pub fn stand_in_sizes(&self) -> impl Iterator<Item = (f32, usize)> {
        self.stand_ins.iter().map(|coarse| (coarse.side, coarse.scene.n_triangles()))
    }

    /// A camera of world space in model space, in which everything is traced.
    pub fn local(&self, camera: &Camera) -> Camera {
        camera.relative_to(self.mesh().origin())
    }

    /// The same hit with the triangle's file index in place of its triangle index.
    #[inline]
    pub fn with_file_index(&self, hit: Hit) -> Hit {
        if hit.is_miss() || hit.is_cap() { hit } else { Hit { triangle: self.mesh().file_index(hit.triangle), ..hit } }
    }

    /// The nearest triangle at a point of the view plane of a camera in world space, in fractions of its edges u and v.
    ///
    /// Uses the arithmetic of frames, so that it finds the triangle that the frame shows; the point is where the ray meets the
    /// triangle's plane, in `f64`.
    pub fn probe(&self, camera: &Camera, at: [f32; 2], clip: Option<Clip>) -> Option<ProbeHit> {
        let camera = &self.local(camera);
        let direction = camera.rays(FrameSize::ONE).direction_through(at[0], at[1]);
        if !direction.is_finite() {
            return None;
        }
        let plane = self.clip_plane(camera, clip);
        let ray = Ray::new(camera.eye().as_vec3(), direction);
        let hit = clip::intersect(&self.grid, plane.as_ref(), ray);
        if hit.is_miss() {
            return None;
        }
        let (normal, offset) = self.plane_of(hit, plane);
        let point = self.mesh().origin() + exact_point(ray, hit, (normal, offset));
        let triangle = (!hit.is_cap()).then(|| self.mesh().file_index(hit.triangle));
        let toward_eye = -normal.dot(ray.direction.as_dvec3()).signum();
        let normal = normal.normalize_or_zero() * toward_eye;
        Some(ProbeHit { triangle, t: hit.t, point, normal })
    }

    /// Whether the eye of a camera in world space sees each of these points: whether nothing lies before it, and no cut has
    /// taken it away. A point that lies in front of all surfaces is seen.
    pub fn sees(&self, camera: &Camera, points: &[DVec3], clip: Option<Clip>) -> Vec<bool> {
        let (camera, origin) = (&self.local(camera), self.mesh().origin());
        let plane = self.clip_plane(camera, clip);
        let [min, max] = self.mesh().bulk_bounds().corners();
        let depth = SEEN_DEPTH * (max - min).length();
        let is_cut_away = |point: DVec3| {
            plane.is_some_and(|ClipPlane { normal, offset }| normal.dot(point) - offset > depth * normal.length())
        };
        let is_seen = |point: &DVec3| {
            let point = *point - origin;
            let way = point - camera.eye();
            let direction = way.as_vec3();
            if is_cut_away(point) || !direction.is_finite() || direction == Vec3::ZERO {
                return false;
            }
            let hit = clip::intersect(&self.grid, plane.as_ref(), Ray::new(camera.eye().as_vec3(), direction));
            hit.is_miss() || f64::from(hit.t) >= 1.0 - depth / way.length()
        };
        points.iter().map(is_seen).collect()
    }

    /// The plane of the triangle, or the clip plane, that a ray hits, in model space: its normal, of any length, and its offset.
    fn plane_of(&self, hit: Hit, clip: Option<ClipPlane>) -> (DVec3, f64) {
        match clip {
            Some(ClipPlane { normal, offset }) if hit.is_cap() => (normal, offset),
            _ => {
                let normal = self.mesh().normal(hit.triangle);
                (normal, normal.dot(Vec3::from_array(self.mesh().corners(hit.triangle)[0]).as_dvec3()))
            }
        }
    }

    /// The plane that cuts this scene open for a camera in model space.
    pub fn clip_plane(&self, camera: &Camera, clip: Option<Clip>) -> Option<ClipPlane> {
        let [min, max] = self.mesh().bounds().corners();
        clip?.plane((min, max), camera)
    }
}

/// Where a ray meets the plane of its hit, in model space.
fn exact_point(ray: Ray, hit: Hit, (normal, offset): (DVec3, f64)) -> DVec3 {
    let [origin, direction] = [ray.origin, ray.direction].map(Vec3::as_dvec3);
    let t = (offset - normal.dot(origin)) / normal.dot(direction);
    // A ray along the plane meets all of it.
    let t = if (t - f64::from(hit.t)).abs() <= SAME_T * f64::from(hit.t).abs() { t } else { f64::from(hit.t) };
    origin + direction * t
}

impl From<Grid> for Scene {
    /// A scene without stand-ins and sky image.
    fn from(grid: Grid) -> Self {
        Self { grid, sky: None, stand_ins: Vec::new() }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, Vec3};
    use shared::{
        appearance::Appearance,
        detail::Detail,
        protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
        scene::SceneId,
    };

    use super::*;
    use crate::formats::ply;
    use crate::model::statue;

    /// Rounds to steps that `f64` holds exactly on a map grid, and that `f32` does not hold beside its zero.
    fn exact(point: DVec3) -> DVec3 {
        (point * 2f64.powi(28)).round() * 2f64.powi(-28)
    }

    /// The statue in a file of doubles, moved.
    fn statue_at(offset: DVec3) -> Scene {
        let statue = statue::generate(3000, &|_| ());
        let mut file = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty double x\nproperty double y\n\
             property double z\nelement face {}\nproperty list uchar uint vertex_index\nend_header\n",
            statue.vertices.len(),
            statue.triangles.len()
        )
        .into_bytes();
        for &vertex in &statue.vertices {
            let point = exact(Vec3::from_array(vertex).as_dvec3() * 1.1) + offset;
            file.extend(point.to_array().map(f64::to_le_bytes).as_flattened());
        }
        for triangle in &statue.triangles {
            file.push(3);
            file.extend(triangle.map(u32::to_le_bytes).as_flattened());
        }
        let mesh = ply::read_from(&*file, file.len() as u64).unwrap().mesh;
        Scene::build(mesh, &GridOptions::default(), &|_| ())
    }

    #[test]
    fn a_scene_on_a_map_grid_looks_as_it_does_at_zero() {
        let offset = DVec3::new(512_345.123, 5_412_345.678, -71.25);
        let offset = exact(offset);
        let picture = |offset: DVec3, rays| {
            let camera = Camera::look_at(DVec3::new(0.6, 1.5, 4.5), DVec3::Y * 1.6, DVec3::Y, 0.7, 2.0).unwrap();
            let [eye, ll] = [camera.eye(), camera.ll()].map(|point| exact(point) + offset);
            let spec = FrameSpec {
                scene: SceneId::Statue { triangles: 0, treatment: Default::default() },
                camera: Camera::new(eye, ll, camera.u(), camera.v()).unwrap(),
                size: FrameSize::new(96, 48).unwrap(),
                view: ShadingMode::Shaded,
                rays,
                samples: SampleRange::CENTRE,
                detail: Detail::FULL,
                appearance: Appearance { clip: "y:20".parse().ok(), ..Appearance::default() },
            };
            let scene = statue_at(offset);
            assert_ne!(scene.mesh().origin(), DVec3::ZERO);
            let hit = scene.probe(&spec.camera, [0.5; 2], None).map(|hit| (hit.triangle, hit.t));
            (hit, scene.render_frame(&spec).0)
        };
        for rays in [LightingMode::Primary, LightingMode::AmbientOcclusion] {
            let (hit, frame) = picture(DVec3::ZERO, rays);
            assert!(hit.is_some() && frame.chunks_exact(3).any(|color| color[0] > 100), "the statue is seen");
            assert!((hit, frame) == picture(offset, rays), "{rays}");
        }
    }

    /// A unit cube around (0, 0, 0), moved; its faces are exact in `f32`.
    fn cube(at: DVec3) -> Scene {
        let mut text =
            "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n\
            element face 6\nproperty list uchar int vertex_indices\nend_header\n"
                .to_owned();
        for corner in 0..8 {
            let p = at + DVec3::from_array([0, 1, 2].map(|axis| f64::from(corner >> axis & 1) - 0.5));
            text += &format!("{:?} {:?} {:?}\n", p.x, p.y, p.z);
        }
        text += "4 0 2 3 1\n4 4 5 7 6\n4 0 1 5 4\n4 2 6 7 3\n4 0 4 6 2\n4 1 3 7 5\n";
        let mesh = ply::read_from(text.as_bytes(), text.len() as u64).unwrap().mesh;
        Scene::build(mesh, &GridOptions::default(), &|_| ())
    }

    #[test]
    fn picked_points_lie_on_the_surface_to_the_last_digits() {
        for at in [DVec3::ZERO, DVec3::new(512_345.0, 5_412_345.0, 64.0)] {
            let scene = cube(at);
            let camera = Camera::look_at(at + DVec3::new(2.7, 1.9, 3.1), at, DVec3::Y, 0.5, 1.3).unwrap();
            let mut n_hits = 0;
            for step in 0..400 {
                let (x, y) = ((step % 20) as f32 / 19.0, (step / 20) as f32 / 19.0);
                let Some(hit) = scene.probe(&camera, [x, y], None) else { continue };
                let from_middle = (hit.point - at).abs().max_element();
                let faces = hit.normal.dot(hit.point - at);
                assert!((faces - 0.5).abs() < 1e-9 && hit.normal.dot(camera.eye() - hit.point) > 0.0, "{hit:?}");
                // The digits of a map grid end at a billionth of a metre.
                assert!((from_middle - 0.5).abs() <= 1e-15 * (1.0 + at.abs().max_element()), "{from_middle}");
                n_hits += 1;
            }
            assert!(n_hits > 20, "{n_hits}");
        }
    }

    #[test]
    fn a_point_is_seen_unless_something_lies_before_it_or_it_is_cut_away() {
        for at in [DVec3::ZERO, DVec3::new(512_345.0, 5_412_345.0, 64.0)] {
            let scene = cube(at);
            let camera = Camera::look_at(at + DVec3::new(2.7, 1.9, 3.1), at, DVec3::Y, 0.5, 1.3).unwrap();
            let seen = |clip: Option<&str>, points: &[[f64; 3]]| {
                let points: Vec<_> = points.iter().map(|&point| at + DVec3::from_array(point)).collect();
                scene.sees(&camera, &points, clip.map(|text| text.parse().unwrap()))
            };
            let front = [[0.5, 0.1, 0.2], [0.3, 0.5, -0.1], [0.0, 0.0, 0.5]];
            assert_eq!(seen(None, &front), [true; 3]);
            assert_eq!(seen(None, &front.map(|point| point.map(|it| -it))), [false; 3]);
            assert_eq!(seen(None, &[[0.7, 0.7, 0.7], [0.0; 3], [-9.0, 0.0, 9.0]]), [true, false, true], "in the air");
            // The first is rounded, the second lies in matter.
            assert_eq!(seen(None, &[[0.4998, 0.1, 0.2], [0.49, 0.1, 0.2]]), [true, false]);
            // The cap hides the sides behind it; what was before it is gone.
            let cut = [[0.5, 0.1, 0.2], [0.0, 0.1, 0.2], [-0.5, 0.1, 0.2], [-0.3, 0.5, 0.1], [0.3, 0.5, 0.1]];
            assert_eq!(seen(Some("x:50"), &cut), [false, true, false, true, false]);
            let [eye, nowhere] = [camera.eye() - at, DVec3::NAN].map(|point| point.to_array());
            assert_eq!(seen(None, &[eye, nowhere]), [false; 2]);
            assert_eq!(scene.sees(&camera, &[], None), [false; 0]);
        }
    }
}
