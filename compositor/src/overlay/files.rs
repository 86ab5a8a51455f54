//! The panel that opens a model: the folders and models of one folder, chosen by mouse or keys.

use egui::{RichText, Ui};

use super::style;
use crate::control::input::Command;

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct FileList {
    pub folder: String,
    /// A part of the names of the entries that are listed.
    pub filter: String,
    /// Folders first, then files, each by name.
    pub entries: Vec<FileEntry>,
    /// The entry that Enter opens.
    pub chosen: usize,
    /// Whether the folder is still being read.
    pub is_loading: bool,
    /// Why the folder cannot be read.
    pub problem: Option<String>,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FileEntry {
    pub name: String,
    /// Its bytes; `None` for a folder.
    pub bytes: Option<u64>,
}

pub(super) fn show(ui: &mut Ui, files: &FileList, commands: &mut Vec<Command>) {
    style::heading(ui, "Open a model", "Close (Esc)", Command::ToggleFiles, commands);
    ui.label(RichText::new(&files.folder).small().weak());
    let help = "Type a part of a name; Up and Down choose, Enter opens, Backspace is the folder above";
    ui.label(RichText::new(help).small().weak());
    if !files.filter.is_empty() {
        ui.add(egui::Label::new(RichText::new(format!("Names with {}", files.filter)).color(style::ACCENT)).truncate());
    }
    ui.separator();
    if let Some(problem) = &files.problem {
        ui.label(RichText::new(problem).color(style::BUSY));
    } else if files.is_loading {
        ui.label("Looking …");
    } else if files.entries.is_empty() && !files.filter.is_empty() {
        ui.label("No name has these letters: Backspace takes the last one away.");
    } else if files.entries.is_empty() {
        ui.label("No model is in this folder.");
    }
    for (index, entry) in files.entries.iter().enumerate() {
        let name = if entry.bytes.is_some() { entry.name.clone() } else { format!("{}/", entry.name) };
        let is_chosen = index == files.chosen;
        let size = |ui: &mut Ui| {
            if let Some(bytes) = entry.bytes {
                ui.label(RichText::new(style::bytes(bytes)).small().weak());
            }
        };
        style::line(ui, size, |ui| {
            let label = ui.selectable_label(is_chosen, name);
            commands.extend(label.clicked().then_some(Command::OpenEntry(index)));
            if is_chosen {
                label.scroll_to_me(None);
            }
        });
    }
}
