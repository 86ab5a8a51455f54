//! The model on the wall: the wall itself needs only its identity and its extent, and keeps no triangle.

use std::path::PathBuf;

use renderer::model::scene::{LoadError, SceneSource};
use shared::scene::SceneId;

/// What the wall knows of the model that it shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Model {
    /// Where it came from.
    pub source: SceneSource,
    /// What render servers must have.
    pub scene: SceneId,
    /// The corners of the box around it, in world space; `min > max` if there is nothing to see.
    pub bounds: (glam::DVec3, glam::DVec3),
    /// Triangles, rejected ones left out.
    pub n_triangles: usize,
    /// Triangles that cannot be traced.
    pub n_rejected: usize,
}

impl Model {
    /// Reads or makes the model; takes as long as that takes, so not on a thread that has to answer.
    pub fn load(source: SceneSource, progress: &(dyn Fn(f32) + Sync)) -> Result<Self, LoadError> {
        let renderer::model::scene::LoadedMesh { id: scene, mesh } = renderer::model::scene::load(&source, progress)?;
        let bounds = mesh.bounds();
        let corner = |point: [f32; 3]| glam::Vec3::from(point).as_dvec3();
        Ok(Self {
            source,
            scene,
            bounds: (corner(bounds.min), corner(bounds.max)),
            n_triangles: mesh.triangles.len() - mesh.n_rejected,
            n_rejected: mesh.n_rejected,
        })
    }

    /// The file, if it came from one.
    pub fn path(&self) -> Option<PathBuf> {
        match &self.source {
            SceneSource::Ply(path) => Some(path.clone()),
            SceneSource::Statue { .. } => None,
        }
    }
}
