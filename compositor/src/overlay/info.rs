//! The panel of the model: its views and camera path, the point clicked on, and its appearance.

use std::fmt;

use egui::{RichText, Ui};
use glam::DVec3;
use renderer::model::solid::UNFILLED;
use shared::{
    printable::{counted, n_whole, significant},
    protocol::SceneState,
    structure::Structure,
};

use super::{OverlayModel, appearance, marks, style};
use crate::control::input::Command;

/// The model on the wall.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct ModelSummary {
    pub name: String,
    /// Triangles that are traced.
    pub n_triangles: usize,
    /// Whether the triangles bound a solid, which cuts fill.
    pub is_solid: bool,
    /// Width, height and depth of the box around it, in its own unit.
    pub extent: DVec3,
    /// Other contents of its file, beside triangles; a line each.
    pub found: Vec<String>,
    /// Parts of its file that are left out, or shown otherwise than it says; a line each.
    pub left_out: Vec<String>,
}

/// Lines on parts that are left out; the log has the rest.
const MOST_LEFT_OUT: usize = 4;

/// A point of the model that somebody clicked on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pick {
    /// The triangle's number in the file, from 0; `None` on the cap of a cut.
    pub triangle: Option<u32>,
    /// The point, in the coordinates of the model's file.
    pub point: DVec3,
    /// The side to which the surface faces there, of length 1.
    pub normal: DVec3,
    /// From the eye to the point, in the model's own unit.
    pub distance: f64,
}

impl fmt::Display for Pick {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { triangle, point, distance, .. } = self;
        let name = triangle.map_or("Cut".to_owned(), |number| format!("Triangle {}", style::grouped(number as usize)));
        write!(f, "{name} at {}, {} from the eye", coordinates(*point, *distance), length(*distance))
    }
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    let Some(summary) = &model.model else { return };
    let open = |ui: &mut Ui| {
        commands.extend(ui.button("Open (Ctrl+O)").clicked().then_some(Command::ToggleFiles));
    };
    style::line(ui, open, |ui| {
        ui.label(RichText::new(&summary.name).strong());
    });
    let guessed = if model.up_is_guessed { ", as guessed (U)" } else { "" };
    let n_triangles = counted(style::grouped(summary.n_triangles), "triangle");
    ui.label(format!("{n_triangles}, {} up{guessed}", model.up));
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
    found(ui, summary);
    if let Some(pick) = &model.pick {
        ui.label(RichText::new(pick.to_string()).color(style::ACCENT));
    } else {
        ui.label(RichText::new("Click on the model for a triangle's number, position and distance.").small().weak());
    }
    ui.horizontal_wrapped(|ui| {
        ui.label(if model.views.is_empty() { "No views: Ctrl+1 to 9 keeps one" } else { "Views" });
        for &number in &model.views {
            let button = ui.small_button(number.to_string());
            let accessible_label = format!("view {number}");
            button.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Button, true, &accessible_label));
            commands.extend(button.clicked().then_some(Command::GoToView(number)));
        }
    });
    if let Some((scene, n_scenes)) = model.scene {
        ui.horizontal_wrapped(|ui| {
            ui.label(format!("Scene {scene} of {n_scenes}"));
            for (text, command) in [
                ("Earlier", Command::MoveScene { is_later: false }),
                ("Later", Command::MoveScene { is_later: true }),
                ("Delete", Command::DeleteScene),
            ] {
                let button = ui.small_button(text);
                let accessible_label = format!("scene: {text}");
                button.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Button, true, &accessible_label));
                commands.extend(button.clicked().then_some(command));
            }
        });
    }
    ui.horizontal_wrapped(|ui| {
        ui.label("Camera path");
        let recording = if model.is_recording { "End recording (C)" } else { "Record (C)" };
        let label = ui.selectable_label(model.is_recording, recording);
        commands.extend(label.clicked().then_some(Command::ToggleRecording));
        let playing = if model.is_playing { "Stop (Space)" } else { "Play (Space)" };
        let label = ui.selectable_label(model.is_playing, playing);
        commands.extend(label.clicked().then_some(Command::TogglePlaying));
    });
    appearance::show(ui, &model.appearance, model.rays, commands);
    if model.appearance.clip.is_some() && !summary.is_solid {
        ui.label(RichText::new(UNFILLED).small().weak());
    }
    marks::show_panel(ui, &model.mark_list, commands);
}

/// Lists the contents of the model's file, and the parts that are not on the wall.
fn found(ui: &mut Ui, summary: &ModelSummary) {
    for line in &summary.found {
        ui.label(RichText::new(line).small().weak());
    }
    for line in summary.left_out.iter().take(MOST_LEFT_OUT) {
        ui.label(RichText::new(line).small().color(style::BUSY));
    }
    let n_more = summary.left_out.len().saturating_sub(MOST_LEFT_OUT);
    if n_more > 0 {
        let text = format!("{} in the log", counted(n_more, "more line"));
        ui.label(RichText::new(text).small().color(style::BUSY));
    }
}

/// Triangles, bytes of mesh and structure, and the structure on each render server that is ready.
fn ready_scenes(model: &OverlayModel) -> impl Iterator<Item = (u64, u64, Option<Structure>)> {
    model.status.nodes.iter().filter_map(|node| match node.scene {
        Some(SceneState::Ready { triangles, bytes, grid }) => Some((triangles, bytes, grid)),
        _ => None,
    })
}

/// A point as precise as its distance from the eye: on a map grid, coordinates have more digits than distances.
fn coordinates(point: DVec3, distance: f64) -> String {
    let coordinate = |value: f64| {
        // More digits than `f64` has say nothing.
        let n_more = (n_whole(value).saturating_sub(n_whole(distance))).min(15 - N_DIGITS);
        significant(value, N_DIGITS + n_more)
    };
    format!("({}, {}, {})", coordinate(point.x), coordinate(point.y), coordinate(point.z))
}

/// Digits of a length.
const N_DIGITS: usize = 5;

/// A length in an unknown unit.
fn length(value: f64) -> String {
    significant(value, N_DIGITS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_are_as_precise_as_the_distance_from_the_eye() {
        let on_a_map = DVec3::new(512_345.123_4, 5_412_345.678_9, -70.25);
        assert_eq!(coordinates(on_a_map, 98.1), "(512345.123, 5412345.679, -70.250)");
        assert_eq!(coordinates(on_a_map, 0.1), "(512345.1234, 5412345.6789, -70.2500)");
        assert_eq!(coordinates(on_a_map, 5e6), "(512345, 5.4123e6, -70.250)");
        assert_eq!(coordinates(DVec3::splat(f64::INFINITY), f64::NAN), "(inf, inf, inf)");
        assert_eq!(
            coordinates(DVec3::splat(1e300), 1e-300),
            "(1.00000000000000e300, 1.00000000000000e300, 1.00000000000000e300)"
        );
    }
}
