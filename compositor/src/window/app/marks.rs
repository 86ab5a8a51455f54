//! Marks on the wall: which of them the picture shows, and the hands that set them.

use std::{sync::Arc, time::Instant};

use egui::{Pos2, Rect};
use glam::{DVec2, DVec3};
use shared::{
    camera::{Camera, View},
    marks::{Annotation, Measurement, MeasurementKind},
    protocol::FrameSpec,
};
use strum::VariantArray;

use super::{App, picture::next, probing::Purpose};
use crate::{
    control::{
        marks::{FileToWrite, KeptMarks, MarkCommand, Picked, Ruler},
        navigator::Navigator,
        sidecar,
    },
    farm::{
        Look, Stretch,
        stats::{FoundWay, Seen},
    },
    overlay::{self, DraftText, MarkLabel, MarkList, Pick, ShownMarks},
    remote::state::{AnnotationLabel, ShownAnnotation},
    window::effect::Effect,
};

/// Points of the picture that are as near as this, as a part of its height, are the same to a hand.
const NEAR: f64 = 0.015;

/// Marks of the model on the wall, beyond what its file keeps.
#[derive(Debug, Default)]
pub(super) struct MarkControl {
    pub(super) are_hidden: bool,
    /// The annotation whose text is shown.
    pub(super) chosen: Option<u32>,
    ruler: Ruler,
    draft: Option<Draft>,
    /// The texts of the annotation that a remote makes, until its point is known.
    texts: Option<(String, String)>,
    last_serial: u32,
    sight: Sight,
    /// The last question about a way along the surface.
    stretch_number: u32,
    /// Whether it is not answered yet.
    awaits_way: bool,
}

/// An annotation that is being written.
#[derive(Debug)]
struct Draft {
    text: DraftText,
    at: DVec3,
    direction: Option<DVec3>,
    view: Option<View>,
}

/// The points that render servers were asked about, and their answer.
#[derive(Debug, Default)]
struct Sight {
    /// The last question.
    asked: Option<Look>,
    /// The first question about these points.
    first_number: u32,
    seen: Arc<[bool]>,
}

impl Sight {
    /// The question for a picture, unless it was asked already.
    fn ask(&mut self, spec: &FrameSpec, points: Vec<DVec3>) -> Option<Look> {
        let (view, clip) = (Some((spec.scene, spec.camera)), spec.appearance.clip);
        let before = self.asked.as_ref();
        let has_same_points = before.is_some_and(|before| *before.points == *points);
        if has_same_points && before.is_some_and(|before| (before.view, before.clip) == (view, clip)) {
            return None;
        }
        let number = before.map_or(0, |before| before.number).wrapping_add(1);
        if !has_same_points {
            // An answer about other points is none about these.
            (self.first_number, self.seen) = (number, [].into());
        }
        let look = Look { number, view, clip, points: points.into() };
        self.asked = Some(look.clone());
        Some(look)
    }

    /// Takes an answer, if it is one about these points.
    fn answer(&mut self, answer: &Seen) {
        let last_number = self.asked.as_ref().map_or(0, |asked| asked.number);
        if (self.first_number..=last_number).contains(&answer.number) {
            self.seen = Arc::clone(&answer.seen);
        }
    }
}

/// The points of marks, in the order in which render servers are asked about them.
fn points(marks: &KeptMarks) -> impl Iterator<Item = DVec3> {
    let of_annotations = marks.annotations().map(|(_, annotation)| annotation.at());
    of_annotations.chain(marks.measurements().flat_map(|(_, measurement)| measurement.points().iter().copied()))
}

/// The marks that a picture shows: those with a point that is seen.
fn shown(marks: Option<&KeptMarks>, control: &MarkControl, camera: &Camera) -> ShownMarks {
    let mut shown = ShownMarks::default();
    let on_canvas = |point| camera.project(point).map(|[x, y]| egui::pos2(x as f32, (1.0 - y) as f32));
    let is_on_canvas = |point: &Pos2| (0.0..=1.0).contains(&point.x) && (0.0..=1.0).contains(&point.y);
    if let Some(marks) = marks.filter(|_| !control.are_hidden) {
        let mut seen = control.sight.seen.iter().copied();
        let mut is_seen = || seen.next().unwrap_or(false);
        for (number, annotation) in marks.annotations() {
            let is_seen = is_seen();
            let Some(anchor) = on_canvas(annotation.at()).filter(|anchor| is_seen && is_on_canvas(anchor)) else {
                continue;
            };
            let is_chosen = control.chosen == Some(number);
            let text = if is_chosen { annotation.text().to_owned() } else { String::new() };
            let index = if is_chosen { 0 } else { shown.labels.len() };
            let label = annotation.label().to_owned();
            shown.labels.insert(index, MarkLabel { number, anchor, label, text, is_annotation: true });
        }
        for (number, measurement) in marks.measurements() {
            let seen: Vec<_> = measurement.points().iter().filter(|_| is_seen()).copied().collect();
            if seen.is_empty() {
                continue;
            }
            let is_way = measurement.kind() == MeasurementKind::Surface;
            // A way goes behind the model where the surface does.
            let lies_in_front = |[from, to]: &[DVec3; 2]| !is_way || seen.contains(from) && seen.contains(to);
            let lines = measurement.lines().filter(lies_in_front);
            shown.lines.extend(lines.filter_map(|[from, to]| Some([on_canvas(from)?, on_canvas(to)?])));
            let ends = [0, measurement.points().len() - 1].map(|index| measurement.points()[index]);
            let marked = seen.into_iter().filter(|point| !is_way || ends.contains(point));
            shown.points.extend(marked.filter_map(on_canvas));
            let anchor = on_canvas(middle(measurement)).filter(is_on_canvas);
            let label = measurement.shown(marks.unit());
            let label = |anchor| MarkLabel { number, anchor, label, ..MarkLabel::default() };
            shown.labels.extend(anchor.map(label));
        }
    }
    // Points that were just picked are seen.
    let begun: Vec<_> = control.ruler.points().iter().filter_map(|&point| on_canvas(point)).collect();
    shown.lines.extend(begun.array_windows());
    shown.points.extend(begun);
    shown.points.extend(control.draft.as_ref().and_then(|draft| on_canvas(draft.at)));
    shown
}

/// The point of a measurement at which its value is shown.
fn middle(measurement: &Measurement) -> DVec3 {
    let points = measurement.points();
    match measurement.kind() {
        MeasurementKind::Angle => points[1],
        MeasurementKind::Surface => points[points.len() / 2],
        MeasurementKind::Distance | MeasurementKind::Area => points.iter().sum::<DVec3>() / points.len() as f64,
    }
}

impl App<'_> {
    fn kept_marks(&self) -> Option<&KeptMarks> {
        self.camera.sidecars.as_ref()?.marks()
    }

    /// Another model is on the wall.
    pub(super) fn forget_marks(&mut self) {
        let MarkControl { are_hidden, last_serial, stretch_number, .. } = self.marks;
        self.marks = MarkControl { are_hidden, last_serial, stretch_number, ..MarkControl::default() };
    }

    /// Updates what the overlay shows of marks.
    pub(super) fn update_marks(&mut self) {
        if let Some(seen) = self.overlay.status.seen.take() {
            self.marks.sight.answer(&seen);
        }
        if let Some(found) = self.overlay.status.way.take() {
            self.keep_way(found);
        }
        self.look_at_marks();
        let spec = self.spec_of_marks();
        let shown = spec.map(|spec| shown(self.kept_marks(), &self.marks, &spec.camera)).unwrap_or_default();
        let covered = if shown.labels.is_empty() { Vec::new() } else { self.covered_canvas() };
        let places = std::mem::take(&mut self.overlay.marks.places);
        self.overlay.marks = ShownMarks { places, covered, screens: self.screens(), ..shown };
        let list = self.mark_list();
        self.remote.has_news |= list != self.overlay.mark_list;
        self.overlay.mark_list = list;
        self.overlay.draft = self.marks.draft.as_ref().map(|draft| draft.text.clone());
        self.overlay.is_lead = true;
    }

    fn mark_list(&self) -> MarkList {
        let MarkControl { are_hidden, chosen, ref ruler, .. } = self.marks;
        let mut list = MarkList { are_hidden, chosen, ruler: ruler.kind(), ..MarkList::default() };
        if let Some(marks) = self.kept_marks() {
            list.unit = marks.unit();
            list.annotations = marks.annotations().map(|(number, it)| (number, it.label().to_owned())).collect();
            list.measurements = marks.measurements().map(|(number, it)| (number, it.shown(marks.unit()))).collect();
        }
        list
    }

    /// The parts of the canvas that panels covered in the last picture.
    pub(super) fn covered_canvas(&self) -> Vec<Rect> {
        let on_canvas = |point| {
            let point = self.wall.wall.canvas_at(self.outputs.overlay_on_wall(point));
            egui::pos2(point.x as f32, (1.0 - point.y) as f32)
        };
        let corners = |area: &Rect| [area.left_top(), area.right_top(), area.left_bottom(), area.right_bottom()];
        self.covered.iter().map(|area| Rect::from_points(&corners(area).map(on_canvas))).collect()
    }

    fn screens(&self) -> Vec<Rect> {
        self.wall.wall.projectors().iter().map(|projector| overlay::to_rect(&projector.canvas)).collect()
    }

    /// The picture on the wall, unless it still shows another model.
    fn spec_of_marks(&self) -> Option<FrameSpec> {
        let (frame, model) = (self.presentation.frame.as_ref()?, self.model.as_ref()?);
        (frame.spec.scene == model.scene).then_some(frame.spec)
    }

    /// Asks which marks the picture on the wall shows, unless that was asked.
    fn look_at_marks(&mut self) {
        let (Some(spec), Some(marks)) = (self.spec_of_marks(), self.kept_marks()) else { return };
        let points: Vec<_> = points(marks).collect();
        if points.is_empty() || self.marks.are_hidden {
            return;
        }
        if let Some(look) = self.marks.sight.ask(&spec, points) {
            self.farm.look(look);
        }
    }

    pub(super) fn mark(&mut self, command: MarkCommand) -> Effect {
        match command {
            MarkCommand::Annotate => {
                self.marks.texts = None;
                self.probe(Purpose::Annotate)
            }
            MarkCommand::GoTo(number) => self.go_to_annotation(number),
            MarkCommand::Edit(number) => {
                self.edit_annotation(number);
                Effect::default()
            }
            MarkCommand::Keep => self.keep_draft(),
            MarkCommand::Drop => {
                self.marks.draft = None;
                Effect::default()
            }
            MarkCommand::Delete(number) => {
                self.marks.draft.take_if(|draft| draft.text.number == Some(number));
                self.marks.chosen.take_if(|chosen| *chosen == number);
                self.change_marks(|marks| Ok(marks.delete(number)))
            }
            MarkCommand::NextRuler => {
                let kinds: Vec<_> =
                    std::iter::once(None).chain(MeasurementKind::VARIANTS.iter().copied().map(Some)).collect();
                Effect::note(self.marks.ruler.take(next(&kinds, self.marks.ruler.kind())))
            }
            MarkCommand::SetRuler(kind) => Effect::note(self.marks.ruler.take(kind)),
            MarkCommand::SetUnit(unit) => self.change_marks(|marks| Ok(Some(marks.set_unit(unit)))),
            MarkCommand::Export => self.export_measurements(),
            MarkCommand::Toggle => {
                self.marks.are_hidden ^= true;
                let are = if self.marks.are_hidden { "hidden" } else { "shown" };
                Effect::note(format!("Annotations and measurements are {are}"))
            }
        }
    }

    /// Carries out a command of a hand on the picture, and shows its effect.
    pub(super) fn perform_mark(&mut self, command: MarkCommand) {
        if command.is_steering() && self.touch_show() {
            return self.redraw();
        }
        let effect = self.mark(command);
        self.apply(effect);
        self.redraw();
    }

    /// Ends everything of an operator's that is under way with marks.
    pub(super) fn lay_marks_down(&mut self) {
        (self.marks.draft, self.marks.texts, self.marks.ruler) = (None, None, Ruler::default());
    }

    /// Ends what is under way with marks: the draft, a measurement, the ruler, a text. Returns whether there was anything.
    pub(super) fn cancel_marks(&mut self) -> bool {
        self.marks.draft.take().is_some() || self.marks.ruler.cancel() || self.marks.chosen.take().is_some()
    }

    /// Changes the marks, and has their file written.
    fn change_marks(&mut self, change: impl FnOnce(&mut KeptMarks) -> Result<Option<FileToWrite>, String>) -> Effect {
        let Some(sidecars) = &mut self.camera.sidecars else { return Effect::default() };
        match sidecars.marks_mut().and_then(change) {
            Ok(Some(file)) => Effect::job(move || write(&file)),
            Ok(None) => Effect::default(),
            Err(problem) => Effect::problem(problem),
        }
    }

    fn go_to_annotation(&mut self, number: u32) -> Effect {
        let Some(annotation) = self.kept_marks().and_then(|marks| marks.annotation(number)).cloned() else {
            return Effect::note("This annotation is no longer there");
        };
        self.marks.chosen = Some(number);
        let view = annotation.view();
        view.and_then(|view| view.look).into_iter().for_each(|look| self.picture.set_look(look));
        let parts = self.free_parts();
        self.camera.steer(Instant::now(), |navigator| match view {
            Some(View { camera, up, .. }) => navigator.go_to_view_of(annotation.at(), camera, up, &parts),
            None => navigator.go_before(annotation.at(), annotation.direction()),
        })
    }

    fn edit_annotation(&mut self, number: u32) {
        let Some(annotation) = self.kept_marks().and_then(|marks| marks.annotation(number)).cloned() else { return };
        self.write_draft(Draft {
            text: DraftText {
                label: annotation.label().to_owned(),
                text: annotation.text().to_owned(),
                number: Some(number),
                ..DraftText::default()
            },
            at: annotation.at(),
            direction: annotation.direction(),
            view: annotation.view(),
        });
    }

    fn write_draft(&mut self, mut draft: Draft) {
        self.marks.last_serial += 1;
        draft.text.serial = self.marks.last_serial;
        self.overlay.help = false;
        self.marks.draft = Some(draft);
    }

    /// Somebody has changed the texts of the annotation that is being written.
    pub(super) fn type_draft(&mut self, (label, text): (String, String)) {
        if let Some(draft) = &mut self.marks.draft {
            (draft.text.label, draft.text.text) = (label, text);
            self.redraw();
        }
    }

    fn keep_draft(&mut self) -> Effect {
        let Some(draft) = self.marks.draft.take() else { return Effect::default() };
        let Draft { text: DraftText { label, text, number, .. }, at, direction, view } = &draft;
        match Annotation::new(label, text, *at, *direction, *view) {
            Ok(annotation) => {
                let number = *number;
                self.keep_annotation(number, annotation)
            }
            Err(problem) => {
                self.marks.draft = Some(draft);
                Effect::note(problem.to_string())
            }
        }
    }

    fn keep_annotation(&mut self, number: Option<u32>, annotation: Annotation) -> Effect {
        let note = format!("“{}” is kept", annotation.label());
        let effect = self.change_marks(|marks| Ok(Some(marks.keep_annotation(number, annotation)?.1)));
        if effect.problem.is_some() { effect } else { effect.with_note(note) }
    }

    /// Annotates what is at a point of the canvas, (0, 0) lower left, with these texts.
    pub(super) fn annotate_at(&mut self, point: DVec2, texts: (String, String)) {
        // Another annotation may wait for its own point.
        if self.probe_at(Purpose::Annotate, point) {
            self.marks.texts = Some(texts);
        }
    }

    /// Annotates a point of the model: with the texts of a remote, or with those that are written now.
    pub(super) fn annotate(&mut self, pick: Pick) -> Effect {
        let look = self.picture.look();
        let view = self.camera.present_view().map(|(camera, up)| View { camera, up: Some(up), look: Some(look) });
        let direction = Some(pick.normal);
        if let Some((label, text)) = self.marks.texts.take() {
            return match Annotation::new(&label, &text, pick.point, direction, view) {
                Ok(annotation) => self.keep_annotation(None, annotation),
                Err(problem) => Effect::note(problem.to_string()),
            };
        }
        self.write_draft(Draft { text: DraftText::default(), at: pick.point, direction, view });
        Effect::default()
    }

    /// Gives a point of the model to the ruler; `None` if the ruler is put away.
    pub(super) fn measure(&mut self, pick: Pick) -> Effect {
        let camera = self.camera.navigator.as_ref().map(Navigator::camera);
        let height = camera.map_or(0.0, |camera| {
            let distance = (camera.target() - camera.eye()).length();
            camera.v().length() * pick.distance / distance
        });
        match self.marks.ruler.pick(pick.point, pick.normal, NEAR * height) {
            None => Effect::default(),
            Some(Picked::More(more)) => Effect::note(more),
            Some(Picked::Stretch { ends, across }) => {
                // Where the surface's directions say nothing, the plane goes through the eye.
                let says_nothing = across.cross(ends[1] - ends[0]).length() < 1e-3 * ends[0].distance(ends[1]);
                let to_eye = camera.map_or(DVec3::Z, |camera| camera.eye() - ends[0]);
                self.find_way(ends, if says_nothing { to_eye } else { across })
            }
            Some(Picked::Complete(measurement)) => self.keep_measurement(measurement),
        }
    }

    fn keep_measurement(&mut self, measurement: Measurement) -> Effect {
        let shown = measurement.shown(self.kept_marks().and_then(KeptMarks::unit));
        let note = format!("{}: {shown}", measurement.kind());
        let effect = self.change_marks(|marks| marks.keep_measurement(measurement).map(Some));
        if effect.problem.is_some() { effect } else { effect.with_note(note) }
    }

    /// Asks a render server for the way between two points along the surface.
    fn find_way(&mut self, ends: [DVec3; 2], across: DVec3) -> Effect {
        self.marks.stretch_number = self.marks.stretch_number.wrapping_add(1);
        self.marks.awaits_way = true;
        let scene = self.model.as_ref().map(|model| model.scene);
        self.farm.measure(Stretch { number: self.marks.stretch_number, scene, ends, across });
        Effect::note("Laying the ruler along the surface")
    }

    /// Keeps the way that a render server has found, if somebody waits for it.
    fn keep_way(&mut self, FoundWay { number, way }: FoundWay) {
        if number != self.marks.stretch_number || !std::mem::take(&mut self.marks.awaits_way) {
            return;
        }
        let effect = match way.map(Measurement::along) {
            Some(Ok(measurement)) => self.keep_measurement(measurement),
            _ => Effect::note("No way leads along the surface in the plane across it: measure in parts, or a distance"),
        };
        self.apply(effect);
    }

    /// Whether clicks on the model pick points for the ruler.
    pub(super) fn has_ruler(&self) -> bool {
        self.marks.ruler.kind().is_some()
    }

    /// The annotation whose label is at a point of the canvas, (0, 0) lower left.
    pub(super) fn label_at(&self, point: DVec2) -> Option<u32> {
        self.overlay.marks.annotation_at(egui::pos2(point.x as f32, 1.0 - point.y as f32))
    }

    /// The annotations, for remotes.
    pub(super) fn annotation_labels(&self) -> Vec<AnnotationLabel> {
        let labels = self.overlay.mark_list.annotations.iter();
        labels.map(|(number, label)| AnnotationLabel { number: *number, label: label.clone() }).collect()
    }

    /// The annotation whose text is shown, for remotes.
    pub(super) fn shown_annotation(&self) -> Option<ShownAnnotation> {
        let number = self.marks.chosen?;
        let annotation = self.kept_marks()?.annotation(number)?;
        let [label, text] = [annotation.label(), annotation.text()].map(str::to_owned);
        Some(ShownAnnotation { number, label, text })
    }

    fn export_measurements(&self) -> Effect {
        let Some((file, csv)) = self.kept_marks().map(KeptMarks::csv) else { return Effect::default() };
        Effect::job(move || {
            sidecar::write_table(&file, &csv)?;
            Ok(Effect::note(format!("Measurements are in {}", file.display())))
        })
    }
}

fn write(FileToWrite { file, before, text }: &FileToWrite) -> Result<Effect, String> {
    let copy = sidecar::write_beside(file, before.as_deref(), text)
        .map_err(|error| format!("marks are kept until the wall ends, but {error}"))?;
    Ok(copy.map_or_else(Effect::default, |copy| {
        let (file, copy) = (file.display(), copy.display());
        Effect::problem(format!("somebody else has changed {file}: that version is kept as {copy}"))
    }))
}
