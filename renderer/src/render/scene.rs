//! A mesh with its grid and sky, and the questions that one ray answers.

use std::sync::Arc;

use shared::{
    appearance::{Clip, ClipPlane},
    camera::Camera,
    division::FrameSize,
    protocol::ProbeHit,
};

use crate::{
    grid::{Grid, GridOptions, traced::TracedMesh},
    intersect::{
        clip,
        ray::{Hit, Ray},
    },
    model::mesh::Mesh,
    render::sky::SkyMap,
};

/// A mesh with its grid: all that rays need.
pub struct Scene {
    /// The grid, which holds the mesh.
    pub grid: Grid,
    /// The image that lights path-traced frames which name it.
    pub sky: Option<Arc<SkyMap>>,
}

impl Scene {
    /// Builds the grid on the current rayon pool; `progress` receives the fraction done, 0 to 1, from any thread.
    pub fn build(mesh: Mesh, options: &GridOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        Grid::build(mesh, options, progress).into()
    }

    /// The same scene under a sky image.
    #[must_use]
    pub fn with_sky(self, sky: Option<Arc<SkyMap>>) -> Self {
        Self { sky, ..self }
    }

    /// The mesh, in the grid's order.
    pub fn mesh(&self) -> &TracedMesh {
        self.grid.mesh()
    }

    /// Number of triangles that can be hit.
    pub fn n_triangles(&self) -> usize {
        self.mesh().n_triangles()
    }

    /// Bytes of mesh, grid and sky in memory.
    pub fn n_bytes(&self) -> usize {
        let sky = self.sky.as_ref().map_or(0, |sky| sky.n_bytes());
        self.mesh().n_bytes() + self.grid.n_bytes() + sky
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
    /// Uses the arithmetic of frames, so that it finds the triangle that the frame shows.
    pub fn probe(&self, camera: &Camera, at: [f32; 2], clip: Option<Clip>) -> Option<ProbeHit> {
        let camera = &self.local(camera);
        let direction = camera.rays(FrameSize::ONE).direction_through(at[0], at[1]);
        if !direction.is_finite() {
            return None;
        }
        let plane = self.clip_plane(camera, clip);
        let ray = Ray::new(camera.eye().as_vec3(), direction);
        let hit = self.with_file_index(clip::intersect(&self.grid, plane.as_ref(), ray));
        (!hit.is_miss()).then_some(ProbeHit { triangle: (!hit.is_cap()).then_some(hit.triangle), t: hit.t })
    }

    /// The plane that cuts this scene open for a camera in model space.
    pub fn clip_plane(&self, camera: &Camera, clip: Option<Clip>) -> Option<ClipPlane> {
        let [min, max] = self.mesh().bounds().corners();
        clip?.plane((min, max), camera)
    }
}

impl From<Grid> for Scene {
    /// A scene without a sky image.
    fn from(grid: Grid) -> Self {
        Self { grid, sky: None }
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, Vec3};
    use shared::{
        appearance::Appearance,
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
                scene: SceneId::Statue { triangles: 0, crease: Default::default() },
                camera: Camera::new(eye, ll, camera.u(), camera.v()).unwrap(),
                size: FrameSize::new(96, 48).unwrap(),
                view: ShadingMode::Shaded,
                rays,
                samples: SampleRange::CENTRE,
                appearance: Appearance { clip: "y:20".parse().ok(), ..Appearance::default() },
            };
            let scene = statue_at(offset);
            assert_ne!(scene.mesh().origin(), DVec3::ZERO);
            (scene.probe(&spec.camera, [0.5; 2], None), scene.render_frame(&spec).0)
        };
        for rays in [LightingMode::Primary, LightingMode::AmbientOcclusion] {
            let (hit, frame) = picture(DVec3::ZERO, rays);
            assert!(hit.is_some() && frame.chunks_exact(3).any(|color| color[0] > 100), "the statue is seen");
            assert!((hit, frame) == picture(offset, rays), "{rays}");
        }
    }
}
