//! The operator's panels over the wall: a pure function of an [`OverlayModel`] that returns [`Command`]s.

mod appearance;
mod canvas_text;
mod caption;
mod code;
mod figures;
mod files;
mod help;
mod history;
mod info;
mod layout;
mod legend;
mod marks;
mod nodes;
mod region;
mod style;
mod tint;
mod wall;

pub(crate) use caption::Caption;
pub(crate) use figures::{DENSITIES, RAYS, STORAGES};
pub(crate) use files::{FileEntry, FileList};
pub(crate) use history::{FrameTimes, History};
pub(crate) use info::{ModelSummary, Pick};
pub(crate) use marks::{DraftText, MarkLabel, MarkList, PlacedLabel, ShownMarks};
pub(crate) use region::{ProjectorRegion, to_rect};
pub(crate) use style::{apply_style, zoom};
pub(crate) use wall::{OutputContent, OutputState, WallDrawing};

use egui::{Align2, Order, Rect, Ui};
use shared::{
    appearance::Appearance,
    camera::UpAxis,
    division::Division,
    printable::printable_line,
    protocol::{LightingMode, SceneState, ShadingMode},
    structure::Structure,
};

use self::layout::{Layout, Panel, Part};
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
    /// Whether pixels with little noise got fewer samples.
    pub has_noise_limit: bool,
    pub up: UpAxis,
    pub up_is_guessed: bool,
    pub model: Option<ModelSummary>,
    /// The model that is being read, and the progress: 0 to 1.
    pub loading: Option<(String, f32)>,
    pub is_recording: bool,
    pub is_playing: bool,
    /// The numbers of the model's views.
    pub views: Vec<u8>,
    /// The number of the show's scene on the wall, from 1, and of all its scenes.
    pub scene: Option<(usize, usize)>,
    /// The point of the model that somebody clicked on.
    pub pick: Option<Pick>,
    /// That point on the canvas in the frame on the wall, (0, 0) upper left.
    pub pick_on_canvas: Option<egui::Pos2>,
    /// The panel of files that can be opened, while it is shown.
    pub files: Option<FileList>,
    /// The link in the code that opens the remote, while it is shown.
    pub remote_link: Option<String>,
    /// The grid's structure, if it differs from the one with which render servers were started.
    pub structure: Option<Structure>,
    pub tint: Tint,
    /// Whether a test pattern is on the wall, which panels must not cover.
    pub is_aligning: bool,
    /// The regions of the window in which projectors show the canvas.
    pub regions: Vec<ProjectorRegion>,
    pub wall: WallDrawing,
    pub outputs: Vec<OutputState>,
    pub history: History,
    /// The caption of the scene of a show.
    pub caption: Option<Caption>,
    /// The marks of the model, for the panel.
    pub mark_list: MarkList,
    /// Those on the picture.
    pub marks: ShownMarks,
    /// Whether this is the window with the panels, which places labels for all windows.
    pub is_lead: bool,
    /// The annotation that is being written.
    pub draft: Option<DraftText>,
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
        let has_tint = self.tint != Tint::None || self.pick_on_canvas.is_some() || self.caption.is_some();
        let has_tint = has_tint || !self.marks.is_empty();
        let has_text = self.note.is_some() || !self.messages.is_empty() || legend::is_needed(self);
        let has_dialog = self.help || self.files.is_some() || self.draft.is_some();
        self.panel || has_dialog || self.remote_link.is_some() || has_text || has_tint
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
            names.chain([&mut files.folder, &mut files.filter]).chain(&mut files.problem)
        });
        let texts = nodes
            .flatten()
            .chain(files)
            .chain(model.frame.iter_mut().flat_map(|frame| frame.nodes.iter_mut().map(|node| &mut node.name)))
            .chain(
                model
                    .model
                    .iter_mut()
                    .flat_map(|model| [&mut model.name].into_iter().chain(&mut model.found).chain(&mut model.left_out)),
            )
            .chain(model.loading.iter_mut().map(|(name, _)| name))
            .chain(model.outputs.iter_mut().filter_map(|output| output.monitor.as_mut()))
            .chain([&mut model.join.command, &mut model.join.note])
            .chain(model.caption.iter_mut().map(|caption| &mut caption.text))
            .chain(&mut model.note)
            .chain(&mut model.messages);
        for text in texts {
            *text = printable_line(text);
        }
        model
    }

    /// The model without panels, which only one window shows; every window shows the rest.
    pub(crate) fn without_panels(&self) -> Self {
        Self {
            panel: false,
            help: false,
            files: None,
            remote_link: None,
            draft: None,
            is_lead: false,
            note: None,
            messages: Vec::new(),
            ..self.clone()
        }
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
    pub areas: Vec<Rect>,
    /// Those of panels.
    pub panels: Vec<Rect>,
    /// Whether the panels are a dialog, which covers the model for a moment.
    pub has_dialog: bool,
    /// All that labels on the picture must leave free, in points.
    pub covered: Vec<Rect>,
    /// Where labels are.
    pub places: Vec<PlacedLabel>,
    /// The texts of the annotation that is being written, if somebody has changed them.
    pub draft: Option<(String, String)>,
}

/// Shows the overlay; `ui` is the whole window.
pub(crate) fn show(ui: &Ui, model: &OverlayModel) -> OverlayOutput {
    let model = &model.printable();
    let mut output = OverlayOutput::default();
    if !model.is_aligning {
        tint::show(ui, model);
        tint::mark_pick(ui, model);
    }
    let texts_id = egui::Id::unique("height of texts");
    let legend = legend::is_needed(model).then(|| ui.data(|data| data.get_temp(texts_id)).unwrap_or_default());
    let layout = layout_of(ui.ctx().content_rect(), model, legend);
    for panel in &layout.panels {
        let area = show_panel(ui, &layout, panel, model, &mut output);
        output.areas.push(area);
    }
    output.panels.clone_from(&output.areas);
    output.has_dialog = model.help || model.files.is_some() || model.draft.is_some();
    let texts = show_texts(ui, layout.free, model, &mut output.commands);
    ui.data_mut(|data| data.insert_temp(texts_id, texts.map_or(0.0, |texts: Rect| texts.height())));
    let code = model.remote_link.as_ref().filter(|_| !model.is_aligning).and_then(|link| code::show(ui, link));
    output.areas.extend(code);
    output.covered = output.areas.iter().copied().chain(texts).collect();
    settle(ui, output.covered.clone());
    // The last to be laid out: letters that are new change the texture of all.
    let caption = caption::layout(ui, model);
    let marks = marks::layout(ui, model, caption.as_ref().map(|(_, area)| *area));
    output.places = marks.places();
    marks.draw(ui, model);
    caption::draw(ui, model, caption.as_ref());
    // Notes and the legend take no clicks.
    output.areas.extend(texts.filter(|_| !model.messages.is_empty()));
    output
}

/// Shows everything once more if a size has changed: egui places an area by its last size.
fn settle(ui: &Ui, areas: Vec<Rect>) {
    let id = egui::Id::unique("areas");
    if ui.data(|data| data.get_temp(id)).as_ref() != Some(&areas) {
        ui.data_mut(|data| data.insert_temp(id, areas));
        ui.ctx().request_discard("a panel has another size");
    }
}

/// `legend`: the height of the texts, as they were shown last, if a legend is among them.
fn layout_of(window: Rect, model: &OverlayModel, legend: Option<f32>) -> Layout {
    let dialog = match model {
        OverlayModel { draft: Some(_), .. } => Some(Part::Draft),
        OverlayModel { files: Some(_), .. } => Some(Part::Files),
        OverlayModel { help: true, .. } => Some(Part::Help),
        _ => None,
    };
    let sides: &[Part] = match model {
        OverlayModel { panel: false, .. } | OverlayModel { is_aligning: true, .. } => &[],
        OverlayModel { model: None, .. } => &[Part::Figures],
        _ => &[Part::Figures, Part::Model],
    };
    Layout::new(window, dialog, sides, legend)
}

/// Shows a panel, and returns its area.
fn show_panel(ui: &Ui, layout: &Layout, panel: &Panel, model: &OverlayModel, output: &mut OverlayOutput) -> Rect {
    let height = (layout.room.height() - 2.0 * style::PANEL_PADDING).max(1.0);
    let area = egui::Area::new(egui::Id::unique(("panel", panel.parts[0] as u8))).anchor(panel.align, [0.0, 0.0]);
    let shown = area.constrain_to(layout.room).show(ui.ctx(), |ui| {
        let mut frame = style::panel_frame();
        // The scroll bar is beside the content, not over it.
        frame.inner_margin.right -= style::SCROLL_BAR as i8;
        frame.show(ui, |ui| {
            ui.set_width(panel.width + style::SCROLL_BAR);
            let scroll = egui::ScrollArea::vertical().max_height(height).min_scrolled_height(height);
            scroll.auto_shrink([false, true]).show(ui, |ui| {
                ui.set_width(panel.width);
                for (index, part) in panel.parts.iter().enumerate() {
                    if index > 0 {
                        ui.separator();
                    }
                    show_part(ui, *part, model, output);
                }
            });
        });
    });
    shown.response.rect
}

fn show_part(ui: &mut Ui, part: Part, model: &OverlayModel, output: &mut OverlayOutput) {
    let commands = &mut output.commands;
    match part {
        Part::Figures => figures::show(ui, model, commands),
        Part::Model => {
            info::show(ui, model, commands);
            if !model.outputs.is_empty() {
                ui.separator();
                wall::show(ui, model);
            }
        }
        Part::Help => help::show(ui, commands),
        Part::Files => {
            model.files.iter().for_each(|files| files::show(ui, files, commands));
        }
        Part::Draft => {
            output.draft = model.draft.as_ref().and_then(|draft| marks::show_draft(ui, draft, commands));
        }
    }
}

/// Shows messages, the note and the legend above all panels. Returns their area.
fn show_texts(ui: &Ui, free: Rect, model: &OverlayModel, commands: &mut Vec<Command>) -> Option<Rect> {
    let has_legend = legend::is_needed(model);
    if model.messages.is_empty() && model.note.is_none() && !has_legend {
        return None;
    }
    // At the bottom, where they move nothing.
    let area = egui::Area::new(egui::Id::unique("texts")).anchor(Align2::CENTER_BOTTOM, [0.0, 0.0]);
    let width = (free.width() - 2.0 * style::PANEL_PADDING).clamp(1.0, MOST_TEXT_WIDTH);
    let area =
        area.order(Order::Foreground).constrain_to(free).interactable(!model.messages.is_empty()).default_width(width);
    let shown = area.show(ui.ctx(), |ui| {
        ui.set_max_width(width);
        for message in &model.messages {
            style::panel_frame().stroke(egui::Stroke::new(1.0, style::BUSY)).show(ui, |ui| {
                ui.label(message);
                commands.extend(ui.small_button("Dismiss").clicked().then_some(Command::DismissMessage));
            });
        }
        if let Some(note) = &model.note {
            style::panel_frame().show(ui, |ui| ui.label(note));
        }
        if has_legend {
            style::panel_frame().show(ui, |ui| legend::show(ui, model));
        }
    });
    Some(shown.response.rect)
}

/// Longer lines of messages are hard to read; points.
const MOST_TEXT_WIDTH: f32 = 640.0;

#[cfg(test)]
mod tests;
