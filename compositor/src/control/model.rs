//! The model on the wall: the wall keeps its identity and its shape, but no triangles.

use std::path::PathBuf;

use glam::DVec3;
use renderer::{
    model::{
        scene::{LoadError, ModelInfo, SceneSource},
        stand_in::LEAST_TRIANGLES,
    },
    scene_file::SceneStore,
};
use shared::{
    camera::Shape,
    scene::{SceneId, Treatment},
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
    /// Reads or generates the model, or takes its scene file, and logs what its file holds and lacks. May take minutes: not for
    /// the window's thread.
    pub(crate) fn load(
        source: SceneSource,
        treatment: Treatment,
        store: &SceneStore,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, LoadError> {
        let info = store.describe(&source, treatment, progress)?;
        info.log(&source);
        let ModelInfo { id, shape, n_triangles, is_solid, found, left_out } = info;
        Ok(Self { source, scene: id, shape, n_triangles, is_solid, found, left_out })
    }

    /// The bounds of a model that has stand-ins, in world space; `None` of others. One with textures has none, but its frames
    /// may ask for them.
    pub(crate) fn fine_bounds(&self) -> Option<(DVec3, DVec3)> {
        (self.n_triangles >= LEAST_TRIANGLES).then_some(self.shape.bounds)
    }

    /// The model's file, where all programs on this machine find it; `None` for the built-in model.
    pub(crate) fn path(&self) -> Option<PathBuf> {
        match &self.source {
            SceneSource::File(path) => Some(std::path::absolute(path).unwrap_or_else(|_| path.clone())),
            SceneSource::Statue { .. } => None,
        }
    }
}
