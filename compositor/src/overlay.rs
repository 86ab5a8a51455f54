//! The operator's panels over the wall: a pure function of an [`OverlayModel`] that returns [`Command`]s.

mod appearance;
mod figures;
mod files;
mod help;
mod history;
mod info;
mod nodes;
mod region;
mod style;
mod tint;
mod wall;

pub(crate) use figures::{DENSITIES, RAYS, STORAGES};
pub(crate) use files::{FileEntry, FileList};
pub(crate) use history::{FrameTimes, History};
pub(crate) use info::{ModelSummary, Pick};
pub(crate) use region::ProjectorRegion;
pub(crate) use style::{apply_style, zoom};
pub(crate) use wall::{OutputContent, OutputState, WallDrawing};

use egui::{Align2, Ui};
use shared::{
    appearance::Appearance,
    camera::UpAxis,
    division::Division,
    printable::printable_line,
    protocol::{LightingMode, SceneState, ShadingMode},
    structure::Structure,
};

use crate::{
    control::input::{Command, Tint},
    farm::stats::{DisplayStats, FarmStatus, FrameStats},
};

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct OverlayModel {
    /// Whether the panel of measurements is shown.
    pub panel: bool,
    pub help: bool,
    /// Measurements of the farm's work on the newest frame.
    pub frame: Option<FrameStats>,
    /// Measurements of the newest frame's display, once there are any.
    pub display: Option<DisplayStats>,
    /// Frames shown per second; `None` at rest.
    pub frames_per_second: Option<f64>,
    pub status: FarmStatus,
    pub division: Division,
    pub view: ShadingMode,
    /// The rays that were chosen, if any.
    pub rays: Option<LightingMode>,
    pub appearance: Appearance,
    /// Whether the resolution follows the motion.
    pub is_refining: bool,
    /// Samples a pixel: of the newest frame, and after refinement.
    pub n_samples: [u32; 2],
    pub up: UpAxis,
    pub up_is_guessed: bool,
    pub model: Option<ModelSummary>,
    /// The model that is being read, and the progress: 0 to 1.
    pub loading: Option<(String, f32)>,
    pub is_recording: bool,
    pub is_playing: bool,
    /// The numbers of the model's views.
    pub views: Vec<u8>,
    /// The point of the model that somebody clicked on.
    pub pick: Option<Pick>,
    /// That point on the canvas in the frame on the wall, (0, 0) upper left.
    pub pick_on_canvas: Option<egui::Pos2>,
    /// The panel of files that can be opened, while it is shown.
    pub files: Option<FileList>,
    /// The grid's structure, if it differs from the one with which render servers were started.
    pub structure: Option<Structure>,
    pub tint: Tint,
    /// The regions of the window in which projectors show the canvas.
    pub regions: Vec<ProjectorRegion>,
    pub wall: WallDrawing,
    pub outputs: Vec<OutputState>,
    pub history: History,
    /// The effect of the last command, shown for a moment.
    pub note: Option<String>,
    /// Warnings, each with its cure.
    pub messages: Vec<String>,
    /// The command with which a render server joins, and a note on it.
    pub join: JoinHint,
    /// Frames wait until this many render servers are ready.
    pub min_renderers: u32,
}

impl OverlayModel {
    pub(crate) fn is_visible(&self) -> bool {
        let has_tint = self.tint != Tint::None || self.pick_on_canvas.is_some();
        self.panel || self.help || self.files.is_some() || self.note.is_some() || has_tint
    }

    /// The model with all texts fit for the screen: peers, files and the wall's file name much of what it shows.
    fn printable(&self) -> Self {
        let mut model = self.clone();
        let nodes = model.status.nodes.iter_mut().flat_map(|node| {
            let reason = match &mut node.scene {
                Some(SceneState::Missing { reason }) => Some(reason),
                _ => None,
            };
            [Some(&mut node.name), reason]
        });
        let files = model.files.iter_mut().flat_map(|files| {
            let names = files.entries.iter_mut().map(|entry| &mut entry.name);
            names.chain([&mut files.folder]).chain(&mut files.problem)
        });
        let texts = nodes
            .flatten()
            .chain(files)
            .chain(model.frame.iter_mut().flat_map(|frame| frame.nodes.iter_mut().map(|node| &mut node.name)))
            .chain(model.model.iter_mut().map(|model| &mut model.name))
            .chain(model.loading.iter_mut().map(|(name, _)| name))
            .chain(model.outputs.iter_mut().filter_map(|output| output.monitor.as_mut()))
            .chain([&mut model.join.command, &mut model.join.note])
            .chain(&mut model.note)
            .chain(&mut model.messages);
        for text in texts {
            *text = printable_line(text);
        }
        model
    }

    /// The model without panels, which only one window shows; every window shows the rest.
    pub(crate) fn without_panels(&self) -> Self {
        Self { panel: false, help: false, files: None, note: None, ..self.clone() }
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct JoinHint {
    pub command: String,
    /// Where to type it, and how to join from other machines.
    pub note: String,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct OverlayOutput {
    pub commands: Vec<Command>,
    /// The parts of the window that the overlay covers, in points.
    pub areas: Vec<egui::Rect>,
}

/// The panel's width in points.
const PANEL_WIDTH: f32 = 394.0;
/// Space around the panels in points.
const MARGIN: f32 = 16.0;

/// Shows the overlay; `ui` is the whole window.
pub(crate) fn show(ui: &Ui, model: &OverlayModel) -> OverlayOutput {
    let model = &model.printable();
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
        // At the bottom, where it moves nothing.
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
