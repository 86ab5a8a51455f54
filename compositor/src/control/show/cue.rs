//! A scene of a show whose model and sidecar files were read: it can be shown at once.

use std::sync::Arc;

use renderer::{model::scene::SceneSource, scene_file::SceneStore};
use shared::{
    camera::{Camera, CameraPath, Look, UpAxis, View},
    scene::Treatment,
};

use super::file::{Place, ShowScene};
use crate::control::{
    model::Model,
    sidecar::{self, SidecarFiles},
};

#[derive(Clone, Debug)]
pub(crate) struct Cue {
    pub scene: ShowScene,
    pub model: Model,
    pub sidecars: SidecarFiles,
    /// The camera; `None` shows the whole model.
    pub camera: Option<Camera>,
    /// The path that it takes.
    pub path: Option<Arc<CameraPath>>,
    pub up: UpAxis,
    /// The look of its kept view, if it shows one.
    view_look: Option<Look>,
}

impl Cue {
    /// Reads a scene of `default`, the wall's own model, or of one of its own. May take minutes: not for the window's thread.
    ///
    /// # Errors
    /// A file is missing or malformed; the line has the cure.
    pub(crate) fn read(
        scene: &ShowScene,
        default: &SceneSource,
        treatment: Treatment,
        store: &SceneStore,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Self, String> {
        let source = scene.model.clone().map_or_else(|| default.clone(), SceneSource::File);
        let sidecars = SidecarFiles::read(&source);
        let model = Model::load(source, treatment, store, progress).map_err(|error| error.to_string())?;
        let views = sidecars.views();
        let view = match scene.place {
            Place::View(number) => {
                let problem = || sidecars.problem().map(str::to_owned);
                let missing = || format!("{} has no view {number}: Ctrl+{number} on the wall keeps one", model.source);
                Some(views.and_then(|views| views.get(number)).ok_or_else(|| problem().unwrap_or_else(missing))?)
            }
            Place::Camera(camera) => Some(View { camera, up: None, look: None }),
            Place::Whole | Place::Path(_) => None,
        };
        let path = match &scene.place {
            Place::Path(file) => Some(Arc::new(sidecar::read_path(file)?)),
            _ => None,
        };
        let known_up = scene.up.or(view.and_then(|view| view.up)).or(views.and_then(|views| views.up));
        Ok(Self {
            scene: scene.clone(),
            camera: view.map(|view| view.camera).or_else(|| path.as_ref().map(|path| path.at(0.0))),
            up: known_up.unwrap_or(model.shape.up),
            path,
            view_look: view.and_then(|view| view.look),
            model,
            sidecars,
        })
    }

    /// Whether its path begins again at its end, because the scene goes on.
    pub(crate) fn repeats_path(&self) -> bool {
        self.scene.ending.after.is_some() || self.scene.ending.waits
    }

    /// Its look: as the scene says, else as its view was kept, else the `usual` one.
    pub(crate) fn look(&self, usual: Look) -> Look {
        let ShowScene { light, clip, rays, path_light, .. } = self.scene;
        let look = self.view_look.unwrap_or(usual);
        Look {
            light: light.unwrap_or(look.light),
            clip: clip.or(look.clip),
            rays: rays.or(look.rays),
            path: path_light.or(look.path),
        }
    }
}
