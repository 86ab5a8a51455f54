//! The wall as it is built, and what each of its outputs shows now.

use std::sync::Arc;

use egui::{Align, Align2, Color32, FontId, Layout, Rect, RichText, Sense, Stroke, StrokeKind, Ui, vec2};

use super::{OverlayModel, place::on_canvas, style};
use crate::wall::Wall;

/// The panel's width in points.
pub(super) const WIDTH: f32 = 310.0;
/// The drawing is at most so high, in points.
const MAX_HEIGHT: f32 = 190.0;
/// With more outputs than this, only those that show nothing have a line.
const MOST_LINES: usize = 4;
/// With more projectors than this they are outlines without names.
const MOST_NAMES: usize = 256;

/// What is drawn of a wall.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WallDrawing {
    /// The canvas's width over its height.
    aspect: f32,
    projectors: Arc<[Outline]>,
}

/// A projector, or a screen.
#[derive(Clone, Debug, PartialEq)]
struct Outline {
    name: String,
    /// Its place on the canvas, (0, 0) upper left.
    canvas: Rect,
    output_idx: usize,
}

/// An output: a monitor, or a window that spans all projectors.
#[derive(Clone, Debug, PartialEq)]
pub struct OutputState {
    /// The monitor's name; `None` for a window that may be anywhere.
    pub monitor: Option<String>,
    /// What it shows.
    pub shows: OutputContent,
}

/// What an output shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OutputContent {
    /// Nothing yet.
    #[default]
    Nothing,
    /// Nothing, for its monitor is not there.
    MonitorMissing,
    /// Nothing, for no render server is left.
    Black,
    /// The frame of this number.
    Frame(u64),
}

impl WallDrawing {
    /// That of a wall, whose outputs are in the order of [`Wall::monitors`].
    pub fn new(wall: &Wall) -> Self {
        let monitors = wall.monitors();
        let outline = |projector: &crate::wall::Projector| {
            let shows_it = |(name, _): &(&str, _)| Some(*name) == projector.monitor.as_deref();
            Outline {
                name: projector.name.clone(),
                canvas: on_canvas(projector),
                output_idx: monitors.iter().position(shows_it).unwrap_or(0),
            }
        };
        Self { aspect: wall.aspect() as f32, projectors: wall.projectors().iter().map(outline).collect() }
    }
}

impl OutputState {
    fn name(&self) -> &str {
        self.monitor.as_deref().unwrap_or("window")
    }

    fn state_text(&self) -> String {
        match self.shows {
            OutputContent::Nothing => "nothing yet".to_owned(),
            OutputContent::MonitorMissing => "monitor missing".to_owned(),
            OutputContent::Black => "black".to_owned(),
            OutputContent::Frame(number) => format!("frame {number}"),
        }
    }

    fn colour(&self) -> Color32 {
        match self.shows {
            OutputContent::Nothing | OutputContent::Black => style::BUSY,
            OutputContent::MonitorMissing => style::BAD,
            OutputContent::Frame(_) => style::GOOD,
        }
    }
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel) {
    let (drawing, outputs) = (&model.wall, &model.outputs);
    ui.horizontal(|ui| {
        ui.label(RichText::new("Wall").strong());
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            let count = |n: usize, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
            let text = format!("{}, {}", count(drawing.projectors.len(), "projector"), count(outputs.len(), "output"));
            ui.label(RichText::new(text).small().weak());
        });
    });
    draw(ui, drawing, outputs);
    let n_showing = outputs.iter().filter(|output| matches!(output.shows, OutputContent::Frame(_))).count();
    let is_long = outputs.len() > MOST_LINES;
    if is_long {
        ui.label(format!("{n_showing} of {} outputs show frames", outputs.len()));
    }
    for output in outputs.iter().filter(|output| !is_long || !matches!(output.shows, OutputContent::Frame(_))) {
        ui.horizontal(|ui| {
            ui.label(output.name());
            ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
                ui.label(RichText::new(output.state_text()).color(output.colour()));
            });
        });
    }
}

/// The projectors at their places, in the colours of their outputs' states.
fn draw(ui: &mut Ui, drawing: &WallDrawing, outputs: &[OutputState]) {
    let width = ui.available_width().min(MAX_HEIGHT * drawing.aspect).max(1.0);
    let (canvas, _) = ui.allocate_exact_size(vec2(width, (width / drawing.aspect).min(MAX_HEIGHT)), Sense::hover());
    ui.painter().rect_filled(canvas, 0.0, Color32::from_white_alpha(10));
    let has_names = drawing.projectors.len() <= MOST_NAMES;
    for (index, outline) in drawing.projectors.iter().enumerate() {
        let Some(output) = outputs.get(outline.output_idx) else { continue };
        let rect = Rect {
            min: canvas.lerp_inside(outline.canvas.min.to_vec2()),
            max: canvas.lerp_inside(outline.canvas.max.to_vec2()),
        };
        let colour = output.colour();
        ui.painter().rect(
            rect,
            0.0,
            colour.gamma_multiply(0.16),
            Stroke::new(1.0, colour.gamma_multiply(0.8)),
            StrokeKind::Inside,
        );
        if !has_names {
            continue;
        }
        // Letters are a little more than half as wide as high.
        let fitting = rect.width() / (0.58 * outline.name.chars().count().max(1) as f32);
        let size = fitting.min(rect.height() / 2.0).min(13.0);
        if size >= 6.0 {
            let text_colour = ui.visuals().widgets.noninteractive.fg_stroke.color;
            let font = FontId::proportional(size);
            ui.painter().text(rect.center(), Align2::CENTER_CENTER, &outline.name, font, text_colour);
        }
        let accessible_label = format!("{} on {}: {}", outline.name, output.name(), output.state_text());
        let response = ui.interact(rect, ui.scope_id().with(("projector", index)), Sense::hover());
        response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, &accessible_label));
        response.on_hover_text(accessible_label);
    }
}
