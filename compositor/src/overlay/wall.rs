//! The panel of the wall: its projectors, and the content of its outputs.

use std::sync::Arc;

use egui::{Align2, Color32, FontId, Rect, RichText, Sense, Stroke, StrokeKind, Ui, vec2};
use glam::DVec2;
use shared::printable::printable_line;

use super::{OverlayModel, region::to_rect, style};
use crate::wall::{
    Wall,
    outline::{Outline, font_size},
};

/// The drawing's greatest height in points.
const MAX_HEIGHT: f32 = 190.0;
/// With more outputs than this, only those that show nothing have a line.
const MOST_LINES: usize = 4;
/// With more projectors than this, outlines have no names.
const MOST_NAMES: usize = 256;

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct WallDrawing {
    /// The canvas's width over its height.
    aspect: f32,
    projectors: Arc<[Outline]>,
}

/// An output: a monitor, or a window that spans all projectors.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct OutputState {
    /// The monitor's name; `None` for a window that may be anywhere.
    pub monitor: Option<String>,
    pub shows: OutputContent,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum OutputContent {
    #[default]
    Nothing,
    /// Nothing: its monitor is not connected.
    MonitorMissing,
    /// Nothing: no render server is left.
    Black,
    Frame(u64),
}

impl WallDrawing {
    /// The drawing of a wall, whose outputs are in the order of [`Wall::monitors`].
    pub(crate) fn new(wall: &Wall) -> Self {
        let printable = Outline::all(wall).map(|outline| Outline { name: printable_line(&outline.name), ..outline });
        Self { aspect: wall.aspect() as f32, projectors: printable.collect() }
    }
}

impl OutputState {
    fn name(&self) -> &str {
        self.monitor.as_deref().unwrap_or("window")
    }

    fn state(&self) -> (String, Color32) {
        match self.shows {
            OutputContent::Nothing => ("nothing yet".to_owned(), style::BUSY),
            OutputContent::MonitorMissing => ("monitor missing".to_owned(), style::BAD),
            OutputContent::Black => ("black".to_owned(), style::BUSY),
            OutputContent::Frame(number) => (format!("frame {number}"), style::GOOD),
        }
    }
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel) {
    let (drawing, outputs) = (&model.wall, &model.outputs);
    let count = |n: usize, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
    let text = format!("{}, {}", count(drawing.projectors.len(), "projector"), count(outputs.len(), "output"));
    let counts = |ui: &mut Ui| {
        ui.label(RichText::new(text).small().weak());
    };
    style::line(ui, counts, |ui| {
        ui.label(RichText::new("Wall").strong());
    });
    draw(ui, drawing, outputs);
    let n_showing = outputs.iter().filter(|output| matches!(output.shows, OutputContent::Frame(_))).count();
    let is_long = outputs.len() > MOST_LINES;
    if is_long {
        ui.label(format!("{n_showing} of {} outputs show frames", outputs.len()));
    }
    for output in outputs.iter().filter(|output| !is_long || !matches!(output.shows, OutputContent::Frame(_))) {
        let (state, color) = output.state();
        let state = |ui: &mut Ui| {
            ui.label(RichText::new(state).color(color));
        };
        style::line(ui, state, |ui| {
            ui.label(output.name());
        });
    }
}

/// The projectors where they are on the canvas, in the colours of their outputs' states.
fn draw(ui: &mut Ui, drawing: &WallDrawing, outputs: &[OutputState]) {
    let width = ui.available_width().min(MAX_HEIGHT * drawing.aspect).max(1.0);
    let (canvas, _) = ui.allocate_exact_size(vec2(width, (width / drawing.aspect).min(MAX_HEIGHT)), Sense::hover());
    ui.painter().rect_filled(canvas, 0.0, Color32::from_white_alpha(10));
    let has_names = drawing.projectors.len() <= MOST_NAMES;
    for (index, outline) in drawing.projectors.iter().enumerate() {
        let Some(output) = outputs.get(outline.output_idx) else { continue };
        let on_canvas = to_rect(&outline.canvas);
        let rect =
            Rect { min: canvas.lerp_inside(on_canvas.min.to_vec2()), max: canvas.lerp_inside(on_canvas.max.to_vec2()) };
        let (state, color) = output.state();
        ui.painter().rect(
            rect,
            0.0,
            color.gamma_multiply(0.16),
            Stroke::new(1.0, color.gamma_multiply(0.8)),
            StrokeKind::Inside,
        );
        if !has_names {
            continue;
        }
        let label_box = DVec2::new(rect.width().into(), (rect.height() / 2.0).into());
        let size = font_size(&outline.name, label_box).min(13.0) as f32;
        if size >= 6.0 {
            let text_color = ui.visuals().widgets.noninteractive.fg_stroke.color;
            let font = FontId::proportional(size);
            ui.painter().text(rect.center(), Align2::CENTER_CENTER, &outline.name, font, text_color);
        }
        let accessible_label = format!("{} on {}: {}", outline.name, output.name(), state);
        let response = ui.interact(rect, ui.scope_id().with(("projector", index)), Sense::hover());
        response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, &accessible_label));
        response.on_hover_text(accessible_label);
    }
}
