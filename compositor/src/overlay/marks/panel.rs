//! The part of the model's panel with its annotations, the ruler and measurements.

use egui::{ScrollArea, Ui};
use shared::marks::{MeasurementKind, Unit};
use strum::VariantArray;

use crate::{
    control::{input::Command, marks::MarkCommand},
    overlay::style,
};

/// The marks of the model, seen or not.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct MarkList {
    /// Numbers and labels.
    pub annotations: Vec<(u32, String)>,
    /// The annotation whose text is shown.
    pub chosen: Option<u32>,
    /// Numbers and values.
    pub measurements: Vec<(u32, String)>,
    pub unit: Option<Unit>,
    /// The kind that the ruler measures; `None`: it is put away.
    pub ruler: Option<MeasurementKind>,
    pub are_hidden: bool,
}

/// Longer lists scroll; points.
const MOST_HEIGHT: f32 = 132.0;

pub(crate) fn show(ui: &mut Ui, list: &MarkList, commands: &mut Vec<Command>) {
    let mut give = |command| commands.push(Command::Mark(command));
    ui.horizontal_wrapped(|ui| {
        ui.label("Annotations");
        if ui.small_button("Add (Ctrl+A)").clicked() {
            give(MarkCommand::Annotate);
        }
        if ui.selectable_label(!list.are_hidden, "Shown (Ctrl+H)").clicked() {
            give(MarkCommand::Toggle);
        }
    });
    rows(ui, "annotations", list.annotations.len(), |ui, index| {
        let (number, label) = &list.annotations[index];
        let edit = |ui: &mut Ui| {
            let button = ui.small_button("Edit");
            name(&button, &format!("edit {label}"));
            button.clicked()
        };
        let (mut edits, mut goes) = (false, false);
        style::line(
            ui,
            |ui| edits = edit(ui),
            |ui| goes = ui.selectable_label(list.chosen == Some(*number), label).clicked(),
        );
        if edits {
            give(MarkCommand::Edit(*number));
        } else if goes {
            give(MarkCommand::GoTo(*number));
        }
    });
    ui.horizontal_wrapped(|ui| {
        ui.label("Ruler (Y)");
        ui.spacing_mut().item_spacing.x = 0.0;
        let kinds = std::iter::once(None).chain(MeasurementKind::VARIANTS.iter().copied().map(Some));
        for kind in kinds {
            let text = kind.map_or_else(|| "none".to_owned(), |kind| kind.to_string());
            let button = ui.selectable_label(list.ruler == kind, text.clone());
            name(&button, &format!("ruler {text}"));
            if button.clicked() {
                give(MarkCommand::SetRuler(kind));
            }
        }
    });
    if list.ruler.is_none() && list.measurements.is_empty() {
        return;
    }
    rows(ui, "measurements", list.measurements.len(), |ui, index| {
        let (number, value) = &list.measurements[index];
        let mut deletes = false;
        let delete = |ui: &mut Ui| {
            let button = ui.small_button("Delete");
            name(&button, &format!("delete {value}"));
            deletes = button.clicked();
        };
        style::line(ui, delete, |ui| {
            ui.label(value);
        });
        if deletes {
            give(MarkCommand::Delete(*number));
        }
    });
    ui.horizontal_wrapped(|ui| {
        ui.label("Unit");
        ui.spacing_mut().item_spacing.x = 0.0;
        for unit in std::iter::once(None).chain(Unit::VARIANTS.iter().copied().map(Some)) {
            let text = unit.map_or_else(|| "none".to_owned(), |unit| unit.to_string());
            let button = ui.selectable_label(list.unit == unit, text.clone());
            name(&button, &format!("unit {text}"));
            if button.clicked() {
                give(MarkCommand::SetUnit(unit));
            }
        }
    });
    if !list.measurements.is_empty() && ui.small_button("Export as CSV").clicked() {
        give(MarkCommand::Export);
    }
}

/// Rows of a list, which scrolls if it is long.
fn rows(ui: &mut Ui, id: &str, n_rows: usize, mut row: impl FnMut(&mut Ui, usize)) {
    ScrollArea::vertical().id_salt(id).max_height(MOST_HEIGHT).show(ui, |ui| {
        (0..n_rows).for_each(|index| row(ui, index));
    });
}

/// Names a button for screen readers.
fn name(button: &egui::Response, name: &str) {
    button.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Button, true, name));
}
