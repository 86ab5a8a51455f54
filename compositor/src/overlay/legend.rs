//! The meaning of colours on the picture.

use egui::{Color32, Layout, RichText, Sense, Ui};
use renderer::render::shade::{CELLS_COLOR, TESTS_COLOR};
use shared::protocol::ShadingMode;

use super::{OverlayModel, style, tint};
use crate::{control::input::Tint, farm::stats::FrameStats};

/// With more render servers than this, the rest are counted.
const MOST_NAMES: usize = 12;
/// Width of the scale of times in points.
const SCALE_WIDTH: f32 = 120.0;

/// Whether colours on the picture need a legend.
pub(super) fn is_needed(model: &OverlayModel) -> bool {
    let is_covered = model.is_aligning || model.help || model.files.is_some();
    let has_tint = model.tint != Tint::None && model.frame.as_ref().is_some_and(|frame| !frame.tasks.is_empty());
    !is_covered && (has_tint || shows_costs(model))
}

/// Visitors may see the cost view, but need no explanation.
fn shows_costs(model: &OverlayModel) -> bool {
    model.panel && model.view == ShadingMode::Cost
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel) {
    ui.horizontal_wrapped(|ui| {
        if shows_costs(model) {
            let [cells, tests] = [CELLS_COLOR, TESTS_COLOR].map(|[r, g, b]| Color32::from_rgb(r, g, b));
            entry(ui, cells, "cells of the grid");
            entry(ui, tests, "triangle tests");
            ui.label(RichText::new("brighter is more").small().weak());
        }
        match (model.tint, &model.frame) {
            (Tint::Nodes, Some(frame)) => nodes(ui, frame),
            (Tint::Cost, Some(frame)) => times(ui, frame),
            _ => {}
        }
    });
}

fn entry(ui: &mut Ui, color: Color32, name: &str) {
    let width = style::SWATCH + 2.0 * ui.spacing().item_spacing.x + style::body_width(ui, name);
    let layout = Layout::left_to_right(egui::Align::Center);
    ui.allocate_ui_with_layout(egui::vec2(width.min(ui.max_rect().width()), 18.0), layout, |ui| {
        style::swatch(ui, color);
        ui.add(egui::Label::new(name).truncate());
    });
}

fn nodes(ui: &mut Ui, frame: &FrameStats) {
    for node in frame.nodes.iter().take(MOST_NAMES) {
        entry(ui, tint::node_color(node.id), &node.name);
    }
    let n_more = frame.nodes.len().saturating_sub(MOST_NAMES);
    if n_more > 0 {
        ui.label(format!("and {n_more} more"));
    }
}

fn times(ui: &mut Ui, frame: &FrameStats) {
    const STEPS: u16 = 32;
    ui.label("CPU time: 0");
    let (rect, _) = ui.allocate_exact_size(egui::vec2(SCALE_WIDTH, 12.0), Sense::hover());
    for step in 0..STEPS {
        let [from, to] = [step, step + 1].map(|step| f32::from(step) / f32::from(STEPS));
        let x_range = rect.left() + from * rect.width()..=rect.left() + to * rect.width();
        ui.painter().rect_filled(egui::Rect::from_x_y_ranges(x_range, rect.y_range()), 0.0, tint::heat(from));
    }
    let (ns, unit) = tint::usual_most_ns(frame);
    ui.label(format!("{:.1} µs a {unit}", ns / 1e3));
}
