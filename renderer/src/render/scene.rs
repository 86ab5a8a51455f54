//! A mesh with its grid, and the questions that one ray answers.

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
};

/// A mesh with its grid: all that rays need.
pub struct Scene {
    /// The grid, which holds the mesh.
    pub grid: Grid,
}

impl Scene {
    /// Builds the grid on the current rayon pool; `progress` receives the fraction done, 0 to 1, from any thread.
    pub fn build(mesh: Mesh, options: &GridOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        Self { grid: Grid::build(mesh, options, progress) }
    }

    /// The mesh, in the grid's order.
    pub fn mesh(&self) -> &TracedMesh {
        self.grid.mesh()
    }

    /// Number of triangles that can be hit.
    pub fn n_triangles(&self) -> usize {
        self.mesh().n_triangles()
    }

    /// Bytes of mesh and grid in memory.
    pub fn n_bytes(&self) -> usize {
        self.mesh().n_bytes() + self.grid.n_bytes()
    }

    /// The same hit with the triangle's file index in place of its triangle index.
    #[inline]
    pub fn with_file_index(&self, hit: Hit) -> Hit {
        if hit.is_miss() || hit.is_cap() { hit } else { Hit { triangle: self.mesh().file_index(hit.triangle), ..hit } }
    }

    /// The nearest triangle at a point of the view plane, in fractions of its edges u and v.
    ///
    /// Uses the arithmetic of frames, so that it finds the triangle that the frame shows.
    pub fn probe(&self, camera: &Camera, at: [f32; 2], clip: Option<Clip>) -> Option<ProbeHit> {
        let direction = camera.rays(FrameSize::ONE).direction_through(at[0], at[1]);
        if !direction.is_finite() {
            return None;
        }
        let plane = self.clip_plane(camera, clip);
        let ray = Ray::new(camera.eye().as_vec3(), direction);
        let hit = self.with_file_index(clip::intersect(&self.grid, plane.as_ref(), ray));
        (!hit.is_miss()).then_some(ProbeHit { triangle: (!hit.is_cap()).then_some(hit.triangle), t: hit.t })
    }

    /// The plane that cuts this scene open for this camera.
    pub fn clip_plane(&self, camera: &Camera, clip: Option<Clip>) -> Option<ClipPlane> {
        let [min, max] = self.mesh().bounds().corners();
        clip?.plane((min, max), camera)
    }
}
