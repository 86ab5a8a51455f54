//! Help on keys and mouse, from the tables of [`crate::control::input`].

use egui::{Align, Layout, RichText, Ui};

use super::style;
use crate::control::input::{Command, KEYS, MOUSE};

/// The panel's width in points.
pub(super) const WIDTH: f32 = 880.0;

pub(super) fn show(ui: &mut Ui, commands: &mut Vec<Command>) {
    ui.horizontal(|ui| {
        ui.label(RichText::new("Keys and mouse").heading().strong());
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            commands.extend(ui.button("Close (F1)").clicked().then_some(Command::ToggleHelp));
        });
    });
    ui.separator();
    // Two columns: one would be higher than a window.
    let (left, right) = KEYS.split_at((KEYS.len() + MOUSE.len()).div_ceil(2));
    ui.horizontal_top(|ui| {
        columns("keys").show(ui, |ui| left.iter().for_each(|binding| row(ui, &binding.names(), binding.help)));
        ui.add_space(18.0);
        columns("more keys and mouse").show(ui, |ui| {
            right.iter().for_each(|binding| row(ui, &binding.names(), binding.help));
            MOUSE.iter().for_each(|(gesture, effect)| row(ui, gesture, effect));
        });
    });
}

fn columns(name: &str) -> egui::Grid {
    egui::Grid::new(name).num_columns(2).spacing([14.0, 5.0])
}

fn row(ui: &mut Ui, what: &str, effect: &str) {
    ui.label(RichText::new(what).color(style::ACCENT));
    ui.label(effect);
    ui.end_row();
}
