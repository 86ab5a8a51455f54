//! The panel of the model: its views and camera path, the point clicked on, and its appearance.

use std::fmt;

use egui::{Align, Label, Layout, RichText, Ui};
use glam::DVec3;
use shared::{protocol::SceneState, structure::Structure};

use super::{OverlayModel, appearance, style};
use crate::control::input::Command;

/// The panel's width in points.
pub(super) const WIDTH: f32 = 310.0;

/// The model on the wall.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ModelSummary {
    pub name: String,
    /// Triangles that are traced.
    pub n_triangles: usize,
    /// Degenerate triangles, which cannot be traced.
    pub n_rejected: usize,
    /// Width, height and depth of the box around it, in its own unit.
    pub extent: DVec3,
}

/// A point of the model that somebody clicked on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pick {
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
        let number = style::grouped(*triangle as usize);
        write!(f, "Triangle {number} at {}, {} from the eye", coordinates(*point), length(*distance))
    }
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    let Some(summary) = &model.model else { return };
    ui.horizontal(|ui| {
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            commands.extend(ui.button("Open (Ctrl+O)").clicked().then_some(Command::ToggleFiles));
            ui.with_layout(Layout::left_to_right(Align::Center), |ui| {
                ui.add(Label::new(RichText::new(&summary.name).strong()).truncate());
            });
        });
    });
    let guessed = if model.up_is_guessed { ", as guessed (U)" } else { "" };
    let mut text = format!("{} triangles, {} up{guessed}", style::grouped(summary.n_triangles), model.up);
    if summary.n_rejected > 0 {
        text += &format!(", {} more cannot be traced", style::grouped(summary.n_rejected));
    }
    ui.label(text);
    let DVec3 { x, y, z } = summary.extent;
    if summary.extent.is_finite() && summary.extent.min_element() >= 0.0 {
        ui.label(format!("{} × {} × {} in its own unit", length(x), length(y), length(z)));
    }
    let largest = ready_scenes(model).filter(|(triangles, ..)| *triangles > 0).max_by_key(|(_, bytes, _)| *bytes);
    if let Some((triangles, bytes, _)) = largest {
        let per_triangle = bytes as f64 / triangles as f64;
        ui.label(format!("{} in memory, {per_triangle:.0} bytes a triangle", style::bytes(bytes)));
    }
    if let Some(Structure { storage, density }) = ready_scenes(model).find_map(|(_, _, grid)| grid) {
        ui.label(format!("Grid: {storage}, {density} cells a triangle"));
    }
    if let Some(pick) = &model.pick {
        ui.label(RichText::new(pick.to_string()).color(style::ACCENT));
    } else {
        ui.label(RichText::new("Click on the model for a triangle's number, position and distance.").small().weak());
    }
    ui.horizontal(|ui| {
        ui.label(if model.views.is_empty() { "No views: Ctrl+1 to 9 keeps one" } else { "Views" });
        for &number in &model.views {
            let button = ui.small_button(number.to_string());
            let accessible_label = format!("view {number}");
            button.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Button, true, &accessible_label));
            commands.extend(button.clicked().then_some(Command::GoToView(number)));
        }
    });
    ui.horizontal(|ui| {
        ui.label("Camera path");
        let recording = if model.is_recording { "End recording (C)" } else { "Record (C)" };
        let label = ui.selectable_label(model.is_recording, recording);
        commands.extend(label.clicked().then_some(Command::ToggleRecording));
        let playing = if model.is_playing { "Stop (Space)" } else { "Play (Space)" };
        let label = ui.selectable_label(model.is_playing, playing);
        commands.extend(label.clicked().then_some(Command::TogglePlaying));
    });
    appearance::show(ui, &model.appearance, commands);
}

/// Triangles, bytes of mesh and structure, and the structure on each render server that is ready.
fn ready_scenes(model: &OverlayModel) -> impl Iterator<Item = (u64, u64, Option<Structure>)> {
    model.status.nodes.iter().filter_map(|node| match node.scene {
        Some(SceneState::Ready { triangles, bytes, grid }) => Some((triangles, bytes, grid)),
        _ => None,
    })
}

fn coordinates(point: DVec3) -> String {
    format!("({}, {}, {})", length(point.x), length(point.y), length(point.z))
}

/// A length in an unknown unit, with five digits.
fn length(value: f64) -> String {
    let magnitude = value.abs();
    if magnitude != 0.0 && !(1e-3..1e6).contains(&magnitude) {
        return format!("{value:.4e}");
    }
    let n_whole = if magnitude >= 1.0 { magnitude.log10().floor() as usize + 1 } else { 1 };
    format!("{value:.*}", 5usize.saturating_sub(n_whole))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_have_five_digits_in_any_unit() {
        let lengths = [0.0, 1.0, -0.123_456, 12.345_67, 99_999.4, 123_456.0, 1.5e-7, 2e9];
        let expected = ["0.0000", "1.0000", "-0.1235", "12.346", "99999", "123456", "1.5000e-7", "2.0000e9"];
        assert_eq!(lengths.map(length), expected);
    }
}
