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
pub struct ModelSummary {
    /// Its name.
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
        let number = style::grouped(*triangle as usize);
        write!(f, "Triangle {number} at {}, {} from the eye", coordinates(*point), length(*distance))
    }
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    let Some(summary) = &model.model else { return };
    ui.horizontal(|ui| {
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            if ui.button("Open (Ctrl+O)").clicked() {
                commands.push(Command::ToggleFiles);
            }
            ui.with_layout(Layout::left_to_right(Align::Center), |ui| {
                ui.add(Label::new(RichText::new(&summary.name).strong()).truncate());
            });
        });
    });
    let mut text = format!("{} triangles, {} up", style::grouped(summary.n_triangles), model.up);
    if summary.n_rejected > 0 {
        text += &format!(", {} more cannot be traced", style::grouped(summary.n_rejected));
    }
    ui.label(text);
    let DVec3 { x, y, z } = summary.extent;
    if summary.extent.is_finite() && summary.extent.min_element() >= 0.0 {
        ui.label(format!("{} × {} × {} in its own unit", length(x), length(y), length(z)));
    }
    if let Some(bytes) = most_bytes(model) {
        ui.label(format!("{} in memory, {:.0} bytes a triangle", style::bytes(bytes.0), bytes.1));
    }
    if let Some(Structure { storage, density }) = grid(model) {
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
            if button.clicked() {
                commands.push(Command::GoToView(number));
            }
        }
    });
    ui.horizontal(|ui| {
        ui.label("Camera path");
        let recording = if model.is_recording { "End recording (C)" } else { "Record (C)" };
        if ui.selectable_label(model.is_recording, recording).clicked() {
            commands.push(Command::ToggleRecording);
        }
        let playing = if model.is_playing { "Stop (Space)" } else { "Play (Space)" };
        if ui.selectable_label(model.is_playing, playing).clicked() {
            commands.push(Command::TogglePlaying);
        }
    });
    appearance::show(ui, &model.appearance, commands);
}

/// The most bytes of mesh and structure in a render server's memory, and bytes a triangle.
fn most_bytes(model: &OverlayModel) -> Option<(u64, f64)> {
    let sizes = model.status.nodes.iter().filter_map(|node| match node.scene {
        Some(SceneState::Ready { triangles, bytes, .. }) if triangles > 0 => {
            Some((bytes, bytes as f64 / triangles as f64))
        }
        _ => None,
    });
    sizes.max_by_key(|&(bytes, _)| bytes)
}

/// The structure on the first render server that is ready.
fn grid(model: &OverlayModel) -> Option<Structure> {
    model.status.nodes.iter().find_map(|node| match node.scene {
        Some(SceneState::Ready { grid, .. }) => grid,
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
