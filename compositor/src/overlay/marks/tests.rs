//! Labels on the picture, the dialog and the panel.

use std::cell::RefCell;

use egui::{accesskit::Role, pos2, vec2};
use egui_kittest::{Harness, kittest::Queryable};
use shared::marks::{MeasurementKind, Unit};

use super::*;
use crate::{
    control::{input::Command, marks::MarkCommand},
    overlay::{OverlayOutput, apply_style, show, tests::running},
    wall::Wall,
};

const WINDOW: [f32; 2] = [1600.0, 900.0];

/// A wall in a window, with annotations at points of the canvas.
fn annotated(points: &[[f32; 2]]) -> OverlayModel {
    let window = Rect::from_min_size(Pos2::ZERO, WINDOW.into());
    let in_window = |area: Rect| scaled(area, window.size());
    let wall = Wall::paper();
    let projectors = wall.projectors().iter();
    let regions = projectors.filter_map(|it| ProjectorRegion::new(it, in_window(crate::overlay::to_rect(&it.canvas))));
    let label = |(number, &[x, y]): (u32, &[f32; 2])| MarkLabel {
        number,
        anchor: pos2(x, y),
        label: format!("Annotation {number}"),
        is_annotation: true,
        ..MarkLabel::default()
    };
    OverlayModel {
        regions: regions.collect(),
        marks: ShownMarks { labels: (1..).zip(points).map(label).collect(), ..ShownMarks::default() },
        is_lead: true,
        ..OverlayModel::default()
    }
}

fn output_of(model: &OverlayModel) -> OverlayOutput {
    let output = RefCell::new(OverlayOutput::default());
    let mut harness = Harness::builder()
        .with_size(WINDOW)
        .with_context_setup(apply_style)
        .build_ui(|ui| *output.borrow_mut() = show(ui, model));
    harness.run();
    drop(harness);
    output.into_inner()
}

#[test]
fn every_label_has_its_place_which_a_hand_and_other_windows_find() {
    let model = annotated(&[[0.5, 0.5], [0.505, 0.5], [0.1, 0.9]]);
    let places = output_of(&model).places;
    assert_eq!(places.iter().map(|placed| placed.number).collect::<Vec<_>>(), [1, 2, 3]);
    assert!(!places[0].area.intersects(places[1].area), "{places:?}");
    let marks = ShownMarks { places: places.clone(), ..model.marks.clone() };
    assert_eq!(marks.annotation_at(places[1].area.center()), Some(2));
    assert_eq!(marks.annotation_at(pos2(0.99, 0.01)), None);
    let other_window = OverlayModel { marks, ..model }.without_panels();
    assert_eq!(output_of(&other_window).places, places);
}

#[test]
fn panels_are_left_free_and_a_text_has_its_own_box() {
    let mut model = annotated(&[[0.5, 0.5], [0.1, 0.2]]);
    model.marks.covered = vec![Rect::from_min_size(Pos2::ZERO, vec2(0.3, 1.0))];
    let places = output_of(&model).places;
    assert_eq!(places.iter().map(|placed| placed.number).collect::<Vec<_>>(), [1], "2 is under the panel");
    model.marks.labels[0].text = "A long text that is told to whoever goes there. ".repeat(12);
    let chosen = output_of(&model).places[0].area;
    assert!(chosen.height() > 3.0 * places[0].area.height() && chosen.width() < MOST_TEXT_WIDTH * 1.01, "{chosen:?}");
    assert!(OverlayModel { is_aligning: true, ..model }.is_visible());
}

#[test]
fn a_pattern_shows_no_labels() {
    let model = OverlayModel { is_aligning: true, ..annotated(&[[0.5, 0.5]]) };
    assert_eq!(output_of(&model).places, []);
}

/// The output that comes of showing `model` and of `act`: commands, and the last texts of the draft.
fn hear(model: &OverlayModel, act: impl FnOnce(&mut Harness<'_>)) -> (Vec<Command>, Option<(String, String)>) {
    let heard = RefCell::new((Vec::new(), None));
    let mut harness = Harness::builder().with_size(WINDOW).with_context_setup(apply_style).build_ui(|ui| {
        let output = show(ui, model);
        let mut heard = heard.borrow_mut();
        heard.0.extend(output.commands);
        heard.1 = output.draft.or(heard.1.take());
    });
    harness.run();
    act(&mut harness);
    harness.run();
    drop(harness);
    heard.into_inner()
}

#[test]
fn an_annotation_is_typed_and_kept() {
    let draft = DraftText { serial: 1, ..DraftText::default() };
    let model = OverlayModel { draft: Some(draft.clone()), ..running() };
    let (commands, typed) = hear(&model, |harness| {
        // The label has the focus.
        harness.event(egui::Event::Text("Crack".to_owned()));
    });
    assert_eq!((commands, typed), (Vec::new(), Some(("Crack".to_owned(), String::new()))));
    let written = DraftText { label: "Crack".to_owned(), number: Some(7), ..draft };
    let model = OverlayModel { draft: Some(written), ..running() };
    let (commands, _) = hear(&model, |harness| harness.key_press(egui::Key::Enter));
    assert_eq!(commands, [Command::Mark(MarkCommand::Keep)]);
    let (commands, _) = hear(&model, |harness| harness.key_press(egui::Key::Escape));
    assert_eq!(commands, [Command::Mark(MarkCommand::Drop)]);
    let (commands, _) = hear(&model, |harness| harness.get_by_label("Delete").click());
    assert_eq!(commands, [Command::Mark(MarkCommand::Delete(7))]);
    hear(&model, |harness| {
        assert_eq!(
            harness.get_all_by_role(Role::TextInput).count()
                + harness.query_all_by_role(Role::MultilineTextInput).count(),
            2
        );
    });
}

#[test]
fn the_panel_lists_marks_and_has_the_ruler() {
    let mut model = running();
    model.mark_list = MarkList {
        annotations: vec![(3, "Crack".to_owned()), (4, "Seal".to_owned())],
        measurements: vec![(9, "1.0000 mm".to_owned())],
        unit: Some(Unit::Millimetre),
        ruler: Some(MeasurementKind::Distance),
        ..MarkList::default()
    };
    for (label, command) in [
        ("Seal", MarkCommand::GoTo(4)),
        ("edit Crack", MarkCommand::Edit(3)),
        ("Add (Ctrl+A)", MarkCommand::Annotate),
        ("Shown (Ctrl+H)", MarkCommand::Toggle),
        ("ruler angle", MarkCommand::SetRuler(Some(MeasurementKind::Angle))),
        ("ruler none", MarkCommand::SetRuler(None)),
        ("delete 1.0000 mm", MarkCommand::Delete(9)),
        ("unit ft", MarkCommand::SetUnit(Some(Unit::Foot))),
        ("Export as CSV", MarkCommand::Export),
    ] {
        let (commands, _) = hear(&model, |harness| harness.get_by_label(label).click());
        assert_eq!(commands, [Command::Mark(command)], "{label}");
    }
}
