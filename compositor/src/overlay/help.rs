//! Keys and mouse, as [`crate::input`] has them.

use egui::{Align, Layout, RichText, Ui};

use super::style;
use crate::input::{Command, KEYS, MOUSE};

/// The panel's width in points.
pub(super) const WIDTH: f32 = 420.0;

pub(super) fn show(ui: &mut Ui, commands: &mut Vec<Command>) {
    ui.horizontal(|ui| {
        ui.label(RichText::new("Keys and mouse").heading().strong());
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            if ui.button("Close (F1)").clicked() {
                commands.push(Command::ToggleHelp);
            }
        });
    });
    ui.separator();
    egui::Grid::new("keys").num_columns(2).spacing([18.0, 5.0]).show(ui, |ui| {
        for binding in KEYS {
            row(ui, &binding.names(), binding.help);
        }
        for (gesture, effect) in MOUSE {
            row(ui, gesture, effect);
        }
    });
}

fn row(ui: &mut Ui, what: &str, effect: &str) {
    ui.label(RichText::new(what).color(style::ACCENT));
    ui.label(effect);
    ui.end_row();
}
