//! Annotations and measurements over the picture, in the wall's own resolution.

mod draft;
mod panel;
mod placement;

pub(crate) use draft::DraftText;
pub(crate) use panel::MarkList;
pub(crate) use placement::Slot;
pub(super) use {draft::show as show_draft, panel::show as show_panel};

use egui::{Align, Color32, LayerId, Pos2, Rect, Shape, Stroke, Ui, Vec2, vec2};

use self::placement::{Room, Wanted, clipped, leader, place};
use super::{
    OverlayModel,
    canvas_text::{CanvasText, TextStyle},
    region::ProjectorRegion,
    style,
};

/// The marks that the picture shows. Points are on the canvas, (0, 0) upper left.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ShownMarks {
    /// The most important first.
    pub labels: Vec<MarkLabel>,
    /// Lines of measurements.
    pub lines: Vec<[Pos2; 2]>,
    /// Ends of these lines.
    pub points: Vec<Pos2>,
    /// Where labels were in the last picture.
    pub places: Vec<PlacedLabel>,
    /// The parts of the canvas that panels cover.
    pub covered: Vec<Rect>,
    /// The parts of the canvas that projectors or screens show.
    pub screens: Vec<Rect>,
}

/// A label beside a point.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct MarkLabel {
    /// Of the annotation or measurement.
    pub number: u32,
    pub anchor: Pos2,
    pub label: String,
    /// The text of an annotation that somebody has chosen; else empty.
    pub text: String,
    pub is_annotation: bool,
}

/// A label in its place on the canvas.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PlacedLabel {
    pub number: u32,
    pub slot: Slot,
    pub area: Rect,
    /// The height of its letters, as a fraction of the canvas's height.
    letters: f32,
}

impl ShownMarks {
    pub(super) fn is_empty(&self) -> bool {
        self.labels.is_empty() && self.lines.is_empty() && self.points.is_empty()
    }

    /// The annotation whose label is at a point of the canvas.
    pub(crate) fn annotation_at(&self, point: Pos2) -> Option<u32> {
        let numbers = self.places.iter().filter(|placed| placed.area.contains(point)).map(|placed| placed.number);
        let is_annotation =
            |number: &u32| self.labels.iter().any(|label| label.number == *number && label.is_annotation);
        numbers.into_iter().find(is_annotation)
    }
}

/// Letters, as a fraction of the canvas's height.
const LETTERS: f32 = 0.019;
/// The widest label, and the widest text, as fractions of the canvas.
const MOST_WIDTH: f32 = 0.2;
const MOST_TEXT_WIDTH: f32 = 0.3;
/// Space between labels, in letters.
const GAP: f32 = 0.5;
/// The radius of a point in points of the window.
const POINT_RADIUS: f32 = 4.0;
/// The pieces in which a line bends with a warped projector.
const N_PIECES: u8 = 16;
const MEASURED: Color32 = Color32::from_rgb(255, 214, 102);

/// Labels that were laid out, each with its place.
pub(super) struct LaidOut<'a>(Vec<(&'a MarkLabel, CanvasText, PlacedLabel)>);

/// Lays out and places the labels of the window with the panels; other windows take its places.
pub(super) fn layout<'a>(ui: &Ui, model: &'a OverlayModel, caption: Option<Rect>) -> LaidOut<'a> {
    if model.is_aligning {
        return LaidOut(Vec::new());
    }
    let marks = &model.marks;
    if model.is_lead {
        place_labels(ui, model, caption)
    } else {
        LaidOut(in_places(ui, model, &marks.places).collect())
    }
}

fn in_places<'a>(
    ui: &Ui,
    model: &'a OverlayModel,
    places: &[PlacedLabel],
) -> impl Iterator<Item = (&'a MarkLabel, CanvasText, PlacedLabel)> {
    places.iter().filter_map(|placed| {
        let label = model.marks.labels.iter().find(|label| label.number == placed.number)?;
        let text = text(ui, &model.regions, label, placed.letters)?;
        Some((label, text, *placed))
    })
}

fn place_labels<'a>(ui: &Ui, model: &'a OverlayModel, caption: Option<Rect>) -> LaidOut<'a> {
    let marks = &model.marks;
    let Some(points_per_canvas) = model.regions.first().and_then(ProjectorRegion::points_per_canvas) else {
        return LaidOut(Vec::new());
    };
    let letters = LETTERS.max(CanvasText::SMALLEST / points_per_canvas.y);
    let texts: Vec<_> =
        marks.labels.iter().filter_map(|label| Some((label, text(ui, &model.regions, label, letters)?))).collect();
    let to_points = |area: Rect| scaled(area, points_per_canvas);
    let to_point = |point: Pos2| (point.to_vec2() * points_per_canvas).to_pos2();
    let wanted: Vec<_> = texts
        .iter()
        .map(|(label, text)| Wanted {
            anchor: to_point(label.anchor),
            size: text.size() * points_per_canvas,
            slot: marks.places.iter().find(|placed| placed.number == label.number).map(|placed| placed.slot),
        })
        .collect();
    let room = Room {
        bounds: to_points(Rect::from_min_max(Pos2::ZERO, egui::pos2(1.0, 1.0))),
        covered: marks.covered.iter().copied().chain(caption).map(to_points).collect(),
        screens: marks.screens.iter().copied().map(to_points).collect(),
        points: marks.points.iter().copied().map(to_point).collect(),
        gap: GAP * letters * points_per_canvas.y,
    };
    let places = place(&wanted, &room);
    let placed = texts.into_iter().zip(places).filter_map(|((label, text), place)| {
        let (slot, area) = place?;
        let area = scaled(area, vec2(1.0, 1.0) / points_per_canvas);
        Some((label, text, PlacedLabel { number: label.number, slot, area, letters }))
    });
    LaidOut(placed.collect())
}

fn scaled(area: Rect, by: Vec2) -> Rect {
    Rect::from_min_max((area.min.to_vec2() * by).to_pos2(), (area.max.to_vec2() * by).to_pos2())
}

fn text(ui: &Ui, regions: &[ProjectorRegion], label: &MarkLabel, letters: f32) -> Option<CanvasText> {
    let color = if label.is_annotation { Color32::WHITE } else { MEASURED };
    let mut parts = vec![(label.label.as_str(), color)];
    if !label.text.is_empty() {
        parts.push((label.text.as_str(), Color32::from_gray(205)));
    }
    let most_width = if label.text.is_empty() { MOST_WIDTH } else { MOST_TEXT_WIDTH };
    CanvasText::new(ui, regions, &parts, &TextStyle { size: letters, most_width, align: Align::LEFT })
}

impl LaidOut<'_> {
    pub(super) fn places(&self) -> Vec<PlacedLabel> {
        self.0.iter().map(|(.., placed)| *placed).collect()
    }

    /// Draws lines, points and labels below all panels.
    pub(super) fn draw(&self, ui: &Ui, model: &OverlayModel) {
        if model.is_aligning {
            return;
        }
        let (marks, regions) = (&model.marks, &model.regions);
        marks.lines.iter().for_each(|&line| draw_line(ui, regions, line, MEASURED));
        marks.points.iter().for_each(|&point| draw_point(ui, regions, point, MEASURED));
        for (label, _, placed) in &self.0 {
            draw_line(ui, regions, leader(label.anchor, placed.area), Color32::WHITE);
        }
        for label in marks.labels.iter().filter(|label| label.is_annotation) {
            draw_point(ui, regions, label.anchor, Color32::WHITE);
        }
        for (_, text, placed) in &self.0 {
            text.draw(ui, regions, placed.area, 1.0);
        }
    }
}

/// Draws a line of the canvas through each projector, dark at its sides so that it is seen on any picture.
fn draw_line(ui: &Ui, regions: &[ProjectorRegion], line: [Pos2; 2], color: Color32) {
    let painter = ui.ctx().layer_painter(LayerId::background());
    for region in regions {
        let Some([from, to]) = clipped(region.canvas, line) else { continue };
        let at = |piece| region.place(from.lerp(to, f32::from(piece) / f32::from(N_PIECES)));
        let Some(points) = (0..=N_PIECES).map(at).collect::<Option<Vec<_>>>() else { continue };
        let painter = painter.with_clip_rect(region.window);
        painter.add(Shape::line(points.clone(), Stroke::new(4.0, Color32::from_black_alpha(140))));
        painter.add(Shape::line(points, Stroke::new(1.5, color)));
    }
}

fn draw_point(ui: &Ui, regions: &[ProjectorRegion], point: Pos2, color: Color32) {
    let painter = ui.ctx().layer_painter(LayerId::background());
    for at in regions.iter().filter_map(|region| region.window_position(point)) {
        painter.circle(at, POINT_RADIUS + 1.5, Color32::from_black_alpha(140), Stroke::NONE);
        painter.circle(at, POINT_RADIUS, color, Stroke::new(1.5, style::MARK_EDGE));
    }
}

#[cfg(test)]
mod tests;
