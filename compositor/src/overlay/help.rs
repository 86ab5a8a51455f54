//! Help on keys and mouse, from the tables of [`crate::control::input`].

use egui::{RichText, Ui};

use super::style;
use crate::control::input::{Command, KEYS, MOUSE};

/// Narrower panels have one column; points.
const TWO_COLUMNS: f32 = 860.0;

pub(super) fn show(ui: &mut Ui, commands: &mut Vec<Command>) {
    style::heading(ui, "Keys and mouse", "Close (F1)", Command::ToggleHelp, commands);
    ui.separator();
    // All rows fit a window as high as most.
    ui.spacing_mut().item_spacing.y = 1.0;
    let keys = KEYS.iter().map(|binding| (binding.names(), binding.help));
    let all: Vec<_> = keys.chain(MOUSE.iter().map(|&(gesture, effect)| (gesture.to_owned(), effect))).collect();
    if ui.available_width() < TWO_COLUMNS {
        return all.iter().for_each(|row| show_row(ui, row));
    }
    // Two columns: one would be higher than a window.
    let (left, right) = all.split_at(all.len().div_ceil(2));
    ui.columns_const(|[left_ui, right_ui]| {
        left.iter().for_each(|row| show_row(left_ui, row));
        right.iter().for_each(|row| show_row(right_ui, row));
    });
}

fn show_row(ui: &mut Ui, (gesture, effect): &(String, &str)) {
    ui.horizontal_top(|ui| {
        let width = (0.3 * ui.available_width()).min(GESTURE_WIDTH);
        ui.allocate_ui(egui::vec2(width, 0.0), |ui| {
            ui.set_width(width);
            ui.label(RichText::new(gesture).color(style::ACCENT));
        });
        ui.add(egui::Label::new(*effect).wrap());
    });
}

/// Width of keys and gestures in points.
const GESTURE_WIDTH: f32 = 130.0;
