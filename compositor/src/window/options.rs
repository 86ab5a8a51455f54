//! The options of a window.

use std::{ops::ControlFlow, path::PathBuf, time::Duration};

use renderer::model::scene::SceneSource;
use shared::{
    appearance::Appearance,
    camera::{Camera, CameraPath, UpAxis},
    protocol::{LightingMode, ShadingMode},
};

use crate::{
    control::refinement::RefinementOptions,
    farm::{Frame, stats::DisplayStats},
    wall::Wall,
};

/// The initial state of the windows.
#[derive(Clone, Debug)]
pub struct WindowOptions {
    /// The wall; each part of it is scaled to fit its window.
    pub wall: Wall,
    /// The wall's file, where moved corners are saved; `None` for the default wall.
    pub wall_file: Option<PathBuf>,
    /// The wall's key file; render servers join with a copy of it.
    pub key_file: Option<PathBuf>,
    /// The first model.
    pub source: SceneSource,
    /// The first camera; `None` shows the whole model.
    pub camera: Option<Camera>,
    /// The axis that points up; `None` takes the axis in the model's sidecar file, or y.
    pub up: Option<UpAxis>,
    /// A camera path that plays from the start, repeatedly.
    pub path: Option<CameraPath>,
    /// In a kiosk visitors can only steer. After this time without input the wall returns to its path, or to the whole
    /// model.
    pub kiosk: Option<Duration>,
    /// Shading of the samples at first.
    pub shading: ShadingMode,
    /// How they are lit at first.
    pub lighting: LightingMode,
    /// The first key light, background and clip plane.
    pub appearance: Appearance,
    /// The limits of resolution and samples.
    pub refinement: RefinementOptions,
    /// Whether the window starts in full screen; windows of named outputs always do.
    pub fullscreen: bool,
    /// Whether the overlay is visible at first.
    pub overlay: bool,
    /// The folder for screenshots.
    pub screenshot_folder: PathBuf,
    /// A file for a last screenshot, written when the window closes.
    pub screenshot_at_end: Option<PathBuf>,
}

/// Called for every new frame once it is on screen; breaks to close the window.
pub type OnShown = Box<dyn FnMut(&Frame, &DisplayStats) -> ControlFlow<()>>;
