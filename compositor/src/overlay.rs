//! What an operator sees over the wall: a pure function of an [`OverlayModel`], that gives back [`Command`]s.

mod appearance;
mod figures;
mod files;
mod help;
mod history;
mod info;
mod nodes;
mod place;
mod style;
mod tint;
mod wall;

pub use figures::{DENSITIES, STORAGES};
pub use files::{FileEntry, FileList};
pub use history::{FrameTimes, History};
pub use info::{ModelSummary, Pick};
pub use place::ProjectorRegion;
pub use style::{apply_style, zoom};
pub use tint::Tint;
pub use wall::{OutputContent, OutputState, WallDrawing};

use egui::{Align2, Ui};
use shared::{
    appearance::Appearance,
    camera::UpAxis,
    division::Division,
    protocol::{LightingMode, ShadingMode},
    structure::Structure,
};

use crate::{
    control::input::Command,
    farm::stats::{DisplayStats, FarmStatus, FrameStats},
};

/// Everything that the overlay shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OverlayModel {
    /// Whether the panel of figures is shown.
    pub panel: bool,
    /// Whether keys and mouse are shown.
    pub help: bool,
    /// How the newest frame on the wall came about.
    pub frame: Option<FrameStats>,
    /// How the newest frame was shown, once that is known.
    pub display: Option<DisplayStats>,
    /// Whole frames shown per second; `None` while the wall rests.
    pub frames_per_second: Option<f64>,
    /// The farm as it is now.
    pub status: FarmStatus,
    /// The division in force.
    pub division: Division,
    /// The view in force.
    pub view: ShadingMode,
    /// The rays in force.
    pub rays: LightingMode,
    /// The look in force.
    pub appearance: Appearance,
    /// Whether the resolution follows the motion.
    pub is_refining: bool,
    /// Samples a pixel of the newest frame, and of the picture once it is refined.
    pub n_samples: [u32; 2],
    /// The axis that points up.
    pub up: UpAxis,
    /// The model on the wall.
    pub model: Option<ModelSummary>,
    /// The model that is being read, and how far: 0 to 1.
    pub loading: Option<(String, f32)>,
    /// Whether the camera's path is being recorded.
    pub is_recording: bool,
    /// Whether the camera follows a path.
    pub is_playing: bool,
    /// The numbers of the views that are kept with the model.
    pub views: Vec<u8>,
    /// What lay under the cursor when somebody asked.
    pub pick: Option<Pick>,
    /// Where that is on the canvas of the frame that is shown, (0, 0) upper left.
    pub pick_on_canvas: Option<egui::Pos2>,
    /// The files that can be opened, while they are shown.
    pub files: Option<FileList>,
    /// How render servers keep the grid, if not as they were started.
    pub structure: Option<Structure>,
    /// What the picture is tinted by.
    pub tint: Tint,
    /// Where the canvas is seen in the window, projector by projector.
    pub regions: Vec<ProjectorRegion>,
    /// The wall as it is built.
    pub wall: WallDrawing,
    /// What each of its outputs shows.
    pub outputs: Vec<OutputState>,
    /// What the last frames took.
    pub history: History,
    /// What was done, for a moment.
    pub note: Option<String>,
    /// What an operator should know, each with its cure.
    pub messages: Vec<String>,
    /// The command that makes another render server join, and what else must be known for it.
    pub join: JoinHint,
    /// No frame starts with fewer render servers ready.
    pub min_renderers: u32,
}

impl OverlayModel {
    /// Whether there is anything to see.
    pub fn is_visible(&self) -> bool {
        let has_tint = self.tint != Tint::None || self.pick_on_canvas.is_some();
        self.panel || self.help || self.files.is_some() || self.note.is_some() || has_tint
    }

    /// The same without all that is said once, in one window: what belongs to the picture in any.
    pub fn without_panels(&self) -> Self {
        Self { panel: false, help: false, files: None, note: None, ..self.clone() }
    }
}

/// How a render server joins.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JoinHint {
    /// What to type.
    pub command: String,
    /// Where, and what to do for other places.
    pub note: String,
}

/// What came of showing the overlay once.
#[derive(Clone, Debug, Default)]
pub struct OverlayOutput {
    /// What was asked for, in order.
    pub commands: Vec<Command>,
    /// The parts of the window that the overlay covers, in points.
    pub areas: Vec<egui::Rect>,
}

/// The panel's width in points.
const PANEL_WIDTH: f32 = 394.0;
/// Space around the panels in points.
const MARGIN: f32 = 16.0;

/// Shows the overlay; `ui` is the whole window.
pub fn show(ui: &Ui, model: &OverlayModel) -> OverlayOutput {
    let mut output = OverlayOutput::default();
    tint::show(ui, model);
    tint::mark_pick(ui, model);
    let height = ui.ctx().content_rect().height() - 2.0 * MARGIN;
    let anchored = |name: &'static str, align, x, y| egui::Area::new(egui::Id::unique(name)).anchor(align, [x, y]);
    let area = |name, align, x| anchored(name, align, x, MARGIN);
    let mut panel = |area: egui::Area, width: f32, add: &mut dyn FnMut(&mut Ui, &mut Vec<Command>)| {
        let response = area.show(ui.ctx(), |ui| {
            style::panel_frame().show(ui, |ui| {
                let inner_height = height - 2.0 * style::PANEL_PADDING;
                egui::ScrollArea::vertical().max_height(inner_height).min_scrolled_height(inner_height).show(
                    ui,
                    |ui| {
                        ui.set_width(width);
                        add(ui, &mut output.commands);
                    },
                );
            });
        });
        output.areas.push(response.response.rect);
    };
    if model.panel {
        panel(area("figures", Align2::LEFT_TOP, MARGIN), PANEL_WIDTH, &mut |ui, commands| {
            figures::show(ui, model, commands);
        });
    }
    if let Some(files) = &model.files {
        panel(area("files", Align2::RIGHT_TOP, -MARGIN), files::WIDTH, &mut |ui, commands| {
            files::show(ui, files, commands);
        });
    } else if model.help {
        panel(area("help", Align2::RIGHT_TOP, -MARGIN), help::WIDTH, &mut |ui, commands| help::show(ui, commands));
    }
    if model.panel && model.model.is_some() && model.files.is_none() && !model.help {
        panel(area("model", Align2::RIGHT_TOP, -MARGIN), info::WIDTH, &mut |ui, commands| {
            info::show(ui, model, commands);
        });
        if !model.outputs.is_empty() {
            let area = anchored("wall", Align2::RIGHT_BOTTOM, -MARGIN, -MARGIN);
            panel(area, wall::WIDTH, &mut |ui, _| wall::show(ui, model));
        }
    }
    if let Some(note) = &model.note {
        // Below everything, where it moves nothing.
        let area = egui::Area::new(egui::Id::unique("note")).anchor(Align2::CENTER_BOTTOM, [0.0, -MARGIN]);
        let width = (ui.ctx().content_rect().width() - 4.0 * MARGIN).max(1.0);
        area.interactable(false).default_width(width).show(ui.ctx(), |ui| {
            ui.set_max_width(width);
            style::panel_frame().show(ui, |ui| ui.label(note));
        });
    }
    output
}

#[cfg(test)]
mod tests;
