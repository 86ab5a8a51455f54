//! What an operator sees over the wall: a pure function of an [`OverlayModel`], that gives back [`Command`]s.

mod help;
mod nodes;
mod style;

pub use style::{apply_style, zoom};

use std::fmt;

use egui::{Align, Align2, Layout, RichText, Ui};
use glam::DVec3;
use shared::{
    camera::UpAxis,
    division::Division,
    protocol::{RayTree, View},
};

use crate::{
    input::Command,
    stats::{DisplayStats, FarmStatus, FrameStats},
};
use style::{Tone, box_of, metrics, section};

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
    pub view: View,
    /// The rays in force.
    pub rays: RayTree,
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
        self.panel || self.help || self.note.is_some()
    }
}

/// A point of the model that somebody asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pick {
    /// The triangle's number in the file, from 0.
    pub triangle: u32,
    /// The point, in the model's own coordinates.
    pub point: DVec3,
    /// From the eye to the point, in the model's own unit.
    pub distance: f64,
}

impl fmt::Display for Pick {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { triangle, point, distance } = self;
        write!(f, "Triangle {triangle} at ({:.6}, {:.6}, {:.6}), {distance:.6} from the eye", point.x, point.y, point.z)
    }
}

/// The model on the wall, in words.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ModelSummary {
    /// What people call it.
    pub name: String,
    /// Triangles that can be seen.
    pub n_triangles: usize,
    /// Triangles that cannot be traced.
    pub n_rejected: usize,
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
const PANEL_WIDTH: f32 = 380.0;
/// Space around the panels in points.
const MARGIN: f32 = 16.0;

/// Shows the overlay; `ui` is the whole window.
pub fn show(ui: &Ui, model: &OverlayModel) -> OverlayOutput {
    let mut output = OverlayOutput::default();
    let height = ui.ctx().content_rect().height() - 2.0 * MARGIN;
    let area = |name: &'static str, align, x| egui::Area::new(egui::Id::unique(name)).anchor(align, [x, MARGIN]);
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
        panel(area("figures", Align2::LEFT_TOP, MARGIN), PANEL_WIDTH, &mut |ui, commands| figures(ui, model, commands));
    }
    if model.help {
        panel(area("help", Align2::RIGHT_TOP, -MARGIN), help::WIDTH, &mut |ui, commands| help::show(ui, commands));
    }
    if let Some(note) = &model.note {
        // Below everything, where it moves nothing.
        let area = egui::Area::new(egui::Id::unique("note")).anchor(Align2::CENTER_BOTTOM, [0.0, -MARGIN]);
        area.interactable(false).show(ui.ctx(), |ui| style::panel_frame().show(ui, |ui| ui.label(note)));
    }
    output
}

fn figures(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    headline(ui, model, commands);
    for message in &model.messages {
        box_of(ui, Tone::Warning, |ui| {
            ui.label(message);
            if ui.small_button("Dismiss").clicked() {
                commands.push(Command::DismissMessage);
            }
        });
    }
    waiting(ui, model);
    timings(ui, model);
    switches(ui, model, commands);
    nodes::show(ui, model);
    model_summary(ui, model);
}

fn headline(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    ui.horizontal(|ui| {
        let rate = match model.frames_per_second {
            Some(rate) => format!("{rate:.1} frames/s"),
            None => "at rest".to_owned(),
        };
        ui.label(RichText::new(rate).heading().strong());
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            if ui.button("Keys (F1)").clicked() {
                commands.push(Command::ToggleHelp);
            }
        });
    });
    let latency = model.display.map(|display| display.latency_ms);
    let latency = latency.map_or_else(|| "no frame yet".to_owned(), |ms| format!("{ms:.0} ms from camera to picture"));
    ui.label(latency);
}

/// Why there is nothing to see, or nothing new, and what to do.
fn waiting(ui: &mut Ui, model: &OverlayModel) {
    if let Some((name, progress)) = &model.loading {
        box_of(ui, Tone::Note, |ui| {
            ui.label(format!("Reading {name}: {:.0} %", progress * 100.0));
            ui.add(egui::ProgressBar::new(*progress).desired_height(6.0));
        });
    }
    let n_ready = nodes::n_ready(&model.status);
    if model.status.nodes.is_empty() {
        box_of(ui, Tone::Warning, |ui| {
            ui.label(RichText::new("No render server is connected.").strong());
            ui.label("Start one with:");
            ui.label(RichText::new(&model.join.command).monospace().color(style::ACCENT));
            ui.label(RichText::new(&model.join.note).small());
        });
    } else if n_ready < model.min_renderers as usize {
        box_of(ui, Tone::Note, |ui| {
            ui.label(format!("Waiting for render servers: {n_ready} of {} are ready.", model.min_renderers));
        });
    }
}

fn timings(ui: &mut Ui, model: &OverlayModel) {
    section(ui, "Frame", "ms");
    let (frame, display) = (model.frame.as_ref(), model.display);
    let ms = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), style::ms);
    let text = |value: Option<String>| value.unwrap_or_else(|| "–".to_owned());
    metrics(
        ui,
        &[
            ("render", ms(frame.map(|frame| frame.render_ms))),
            ("place", ms(frame.map(|frame| frame.place_ms))),
            ("upload", ms(display.map(|display| display.upload_ms))),
            ("draw", ms(display.map(|display| display.draw_ms))),
            ("present", ms(display.map(|display| display.present_ms))),
            ("imbalance", text(frame.map(|frame| format!("×{:.2}", frame.imbalance)))),
        ],
    );
    metrics(
        ui,
        &[
            ("nodes", text(frame.map(|frame| frame.nodes.len().to_string()))),
            ("resolution", text(frame.map(|frame| frame.size.to_string()))),
            ("received", text(frame.map(|frame| style::bytes(frame.bytes_in)))),
            ("sent", text(frame.map(|frame| style::bytes(frame.bytes_out)))),
            ("attempts", text(frame.map(|frame| frame.attempts.to_string()))),
        ],
    );
}

fn switches(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    ui.add_space(6.0);
    egui::Grid::new("switches").num_columns(2).show(ui, |ui| {
        ui.horizontal(|ui| ui.label("division (H)"));
        ui.horizontal(|ui| {
            for division in Division::ALL {
                if ui.selectable_label(division == model.division, division.name()).clicked() {
                    commands.push(Command::SetDivision(division));
                }
            }
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("view (V)"));
        ui.horizontal(|ui| {
            for view in View::ALL {
                if ui.selectable_label(view == model.view, view.name()).clicked() {
                    commands.push(Command::SetView(view));
                }
            }
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("rays (R)"));
        ui.horizontal(|ui| {
            for rays in RayTree::ALL {
                if ui.selectable_label(rays == model.rays, rays.name()).clicked() {
                    commands.push(Command::SetRays(rays));
                }
            }
        });
        ui.end_row();
    });
}

fn model_summary(ui: &mut Ui, model: &OverlayModel) {
    let Some(summary) = &model.model else { return };
    section(ui, "Model", "");
    ui.label(RichText::new(&summary.name).strong());
    let mut text = format!("{} triangles, {} up", style::grouped(summary.n_triangles), model.up.name());
    if summary.n_rejected > 0 {
        text += &format!(", {} more cannot be traced", style::grouped(summary.n_rejected));
    }
    ui.label(text);
}

#[cfg(test)]
mod tests;
