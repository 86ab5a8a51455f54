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
    /// Whether the triangles bound a solid, which cuts fill.
    pub is_solid: bool,
    /// Other contents of its file, beside triangles; a line each.
    pub found: Vec<String>,
    /// Parts of its file that are left out, or shown otherwise than it says; a line each.
    pub left_out: Vec<String>,
}

impl Model {
    /// Reads or generates the model, and logs what its file holds and lacks. May take minutes: not for the window's thread.
    pub(crate) fn load(
        source: SceneSource,
        crease: Crease,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, LoadError> {
        let loaded = scene::load(&source, crease, progress)?;
        loaded.log(&source);
        let found = loaded.found();
        let LoadedMesh { id, mesh, left_out } = loaded;
        Ok(Self {
            source,
            scene: id,
            shape: mesh.shape(),
            n_triangles: mesh.triangles.len() - mesh.n_rejected,
            is_solid: mesh.facing().is_some(),
            found,
            left_out,
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
