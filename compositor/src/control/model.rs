//! The model on the wall: the wall keeps its identity and its shape, but no triangles.

use std::path::PathBuf;

use renderer::model::scene::{self, LoadError, LoadedMesh, SceneSource};
use shared::{
    camera::Shape,
    scene::{Crease, SceneId},
};

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Model {
    /// Its file, or the parameters of the built-in model.
    pub source: SceneSource,
    /// The identity by which render servers find it.
    pub scene: SceneId,
    /// Its bounds, outline and likely up axis.
    pub shape: Shape,
    /// Triangles, without rejected ones.
    pub n_triangles: usize,
    /// Triangles that cannot be traced.
    pub n_rejected: usize,
    /// Whether the triangles bound a solid, which cuts fill.
    pub is_solid: bool,
}

impl Model {
    /// Reads or generates the model. May take minutes: not for the window's thread.
    pub(crate) fn load(
        source: SceneSource,
        crease: Crease,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, LoadError> {
        let LoadedMesh { id, mesh } = scene::load(&source, crease, progress)?;
        Ok(Self {
            source,
            scene: id,
            shape: mesh.shape(),
            n_triangles: mesh.triangles.len() - mesh.n_rejected,
            n_rejected: mesh.n_rejected,
            is_solid: mesh.facing().is_some(),
        })
    }

    /// The model's file, where all programs on this machine find it; `None` for the built-in model.
    pub(crate) fn path(&self) -> Option<PathBuf> {
        match &self.source {
            SceneSource::File(path) => Some(std::path::absolute(path).unwrap_or_else(|_| path.clone())),
            SceneSource::Statue { .. } => None,
        }
    }
}
