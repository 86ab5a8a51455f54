//! The dialog in which an annotation is written.

use egui::{Key, RichText, TextEdit, Ui};
use shared::marks::Annotation;

use crate::{
    control::{input::Command, marks::MarkCommand},
    overlay::style,
};

/// An annotation that is being written.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct DraftText {
    /// Another draft has another serial number.
    pub serial: u32,
    pub label: String,
    pub text: String,
    /// The annotation that it changes; `None` for a new one.
    pub number: Option<u32>,
}

/// Shows the dialog. Returns the texts if somebody has changed them.
pub(crate) fn show(ui: &mut Ui, draft: &DraftText, commands: &mut Vec<Command>) -> Option<(String, String)> {
    let title = if draft.number.is_some() { "Annotation" } else { "New annotation" };
    style::heading(ui, title, "Cancel (Esc)", Command::Mark(MarkCommand::Drop), commands);
    let (mut label, mut text) = (draft.label.clone(), draft.text.clone());
    let id = |field: &str| egui::Id::unique(("draft", draft.serial, field));
    let caption = ui.label(RichText::new("Label").small().weak());
    let edit = TextEdit::singleline(&mut label).id(id("label")).char_limit(Annotation::LONGEST_LABEL);
    let label_field = ui.add(edit.desired_width(f32::INFINITY)).labelled_by(caption.id);
    let caption = ui.label(RichText::new("Text, shown when somebody goes there").small().weak());
    let edit = TextEdit::multiline(&mut text).id(id("text")).char_limit(Annotation::LONGEST_TEXT).desired_rows(3);
    let text_field = ui.add(edit.desired_width(f32::INFINITY).return_key(None)).labelled_by(caption.id);
    // Once for each draft.
    if ui.data_mut(|data| data.get_temp::<bool>(id("focus")).is_none()) {
        ui.data_mut(|data| data.insert_temp(id("focus"), true));
        label_field.request_focus();
    }
    let is_in_field = [&label_field, &text_field].iter().any(|field| field.has_focus() || field.lost_focus());
    let is_pressed = |key| is_in_field && ui.input(|input| input.key_pressed(key));
    let (has_entered, has_escaped) = (is_pressed(Key::Enter), is_pressed(Key::Escape));
    ui.add_space(4.0);
    ui.horizontal(|ui| {
        let keeps = ui.add_enabled(!label.trim().is_empty(), egui::Button::new("Keep (Enter)")).clicked();
        if keeps || has_entered {
            commands.push(Command::Mark(MarkCommand::Keep));
        } else if has_escaped {
            commands.push(Command::Mark(MarkCommand::Drop));
        }
        if let Some(number) = draft.number
            && ui.button("Delete").clicked()
        {
            commands.push(Command::Mark(MarkCommand::Delete(number)));
        }
    });
    (label_field.changed() || text_field.changed()).then_some((label, text))
}
