//! A model's marks while it is on the wall: they are numbered, and every change is written. Pure.

mod ruler;

pub(crate) use ruler::{Picked, Ruler};

use std::{collections::BTreeMap, path::PathBuf, sync::Arc};

use shared::marks::{Annotation, Marks, Measurement, MeasurementKind, Unit};

/// A command that concerns marks; annotations and measurements have numbers of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum MarkCommand {
    /// Annotate the point under the cursor.
    Annotate,
    /// Fly to an annotation, and show its text.
    GoTo(u32),
    /// Change the texts of an annotation.
    Edit(u32),
    /// Keep the annotation that is being written.
    Keep,
    /// Drop the annotation that is being written.
    Drop,
    /// Delete an annotation or a measurement.
    Delete(u32),
    NextRuler,
    /// Take the ruler for this kind, or put it away.
    SetRuler(Option<MeasurementKind>),
    SetUnit(Option<Unit>),
    /// Write the measurements as a table beside the model.
    Export,
    /// Show or hide all marks.
    Toggle,
}

impl MarkCommand {
    /// Whether it moves the camera.
    pub(crate) fn is_steering(self) -> bool {
        matches!(self, Self::GoTo(_))
    }
}

/// A model's marks, each with a number that stays the same while the model is on the wall, and is never given twice.
#[derive(Clone, Debug)]
pub(crate) struct KeptMarks {
    file: PathBuf,
    /// The file's text, as it was read, or as the last change writes it; `None` without a file.
    text: Option<Arc<str>>,
    unit: Option<Unit>,
    annotations: BTreeMap<u32, Annotation>,
    measurements: BTreeMap<u32, Measurement>,
    last_number: u32,
}

/// A file to write, on a thread that may wait for a disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FileToWrite {
    pub file: PathBuf,
    /// Its text when it was read or written last.
    pub before: Option<Arc<str>>,
    pub text: Arc<str>,
}

impl KeptMarks {
    pub(crate) fn new(file: PathBuf, text: Option<String>, marks: Marks) -> Self {
        let Marks { unit, annotations, measurements } = marks;
        let n_annotations = annotations.len() as u32;
        let last_number = n_annotations + measurements.len() as u32;
        Self {
            file,
            text: text.map(Arc::from),
            unit,
            annotations: (1..).zip(annotations).collect(),
            measurements: (n_annotations + 1..).zip(measurements).collect(),
            last_number,
        }
    }

    pub(crate) fn unit(&self) -> Option<Unit> {
        self.unit
    }

    /// The annotations with their numbers, in the order of the file.
    pub(crate) fn annotations(&self) -> impl Iterator<Item = (u32, &Annotation)> {
        self.annotations.iter().map(|(&number, annotation)| (number, annotation))
    }

    pub(crate) fn annotation(&self, number: u32) -> Option<&Annotation> {
        self.annotations.get(&number)
    }

    /// The measurements with their numbers, in the order of the file.
    pub(crate) fn measurements(&self) -> impl Iterator<Item = (u32, &Measurement)> {
        self.measurements.iter().map(|(&number, measurement)| (number, measurement))
    }

    /// Keeps an annotation: in place of the one with this number, or as a new one. Returns its number.
    ///
    /// # Errors
    /// There are too many.
    pub(crate) fn keep_annotation(
        &mut self,
        number: Option<u32>,
        annotation: Annotation,
    ) -> Result<(u32, FileToWrite), String> {
        let number = match number.filter(|number| self.annotations.contains_key(number)) {
            Some(number) => number,
            None => self.new_number(self.annotations.len(), "annotations")?,
        };
        self.annotations.insert(number, annotation);
        Ok((number, self.changed()))
    }

    /// Keeps a measurement.
    ///
    /// # Errors
    /// There are too many.
    pub(crate) fn keep_measurement(&mut self, measurement: Measurement) -> Result<FileToWrite, String> {
        let number = self.new_number(self.measurements.len(), "measurements")?;
        self.measurements.insert(number, measurement);
        Ok(self.changed())
    }

    /// Deletes the annotation or measurement with this number, if there is one.
    pub(crate) fn delete(&mut self, number: u32) -> Option<FileToWrite> {
        let is_deleted = self.annotations.remove(&number).is_some() || self.measurements.remove(&number).is_some();
        is_deleted.then(|| self.changed())
    }

    pub(crate) fn set_unit(&mut self, unit: Option<Unit>) -> FileToWrite {
        self.unit = unit;
        self.changed()
    }

    /// The measurements as a table, and its file.
    pub(crate) fn csv(&self) -> (PathBuf, String) {
        // `dragon.ply.marks.toml` becomes `dragon.ply.measurements.csv`.
        let file = self.file.with_extension("").with_extension("measurements.csv");
        (file, self.marks().to_csv(self.unit))
    }

    fn new_number(&mut self, n_kept: usize, noun: &str) -> Result<u32, String> {
        if n_kept >= Marks::MOST {
            return Err(format!("a model has at most {} {noun}: delete one first", Marks::MOST));
        }
        self.last_number += 1;
        Ok(self.last_number)
    }

    fn marks(&self) -> Marks {
        let (annotations, measurements) = (self.annotations.values(), self.measurements.values());
        Marks {
            unit: self.unit,
            annotations: annotations.cloned().collect(),
            measurements: measurements.cloned().collect(),
        }
    }

    fn changed(&mut self) -> FileToWrite {
        let text: Arc<str> = self.marks().to_toml().into();
        let before = self.text.replace(Arc::clone(&text));
        FileToWrite { file: self.file.clone(), before, text }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::marks::MeasurementKind;

    use super::*;

    fn kept() -> KeptMarks {
        KeptMarks::new("a.ply.marks.toml".into(), None, Marks::default())
    }

    fn annotation(label: &str) -> Annotation {
        Annotation::new(label, "", DVec3::ZERO, None, None).unwrap()
    }

    fn distance(x: f64) -> Measurement {
        Measurement::new(MeasurementKind::Distance, vec![DVec3::ZERO, DVec3::X * x]).unwrap()
    }

    fn labels(marks: &KeptMarks) -> Vec<(u32, &str)> {
        marks.annotations().map(|(number, annotation)| (number, annotation.label())).collect()
    }

    #[test]
    fn numbers_stay_and_are_never_given_twice() {
        let mut marks = kept();
        for label in ["a", "b", "c"] {
            marks.keep_annotation(None, annotation(label)).unwrap();
        }
        assert!(marks.delete(2).is_some() && marks.delete(2).is_none());
        assert_eq!(marks.keep_annotation(None, annotation("d")).unwrap().0, 4);
        assert_eq!(marks.keep_annotation(Some(3), annotation("C")).unwrap().0, 3);
        assert_eq!(marks.keep_annotation(Some(2), annotation("e")).unwrap().0, 5, "somebody has deleted it meanwhile");
        assert_eq!(labels(&marks), [(1, "a"), (3, "C"), (4, "d"), (5, "e")]);
        marks.keep_measurement(distance(2.0)).unwrap();
        assert_eq!(marks.measurements().map(|(number, _)| number).collect::<Vec<_>>(), [6]);
    }

    #[test]
    fn every_change_is_a_file_that_holds_all_marks() {
        let mut marks = kept();
        let (_, first) = marks.keep_annotation(None, annotation("a")).unwrap();
        assert_eq!((first.file.to_str(), &first.before), (Some("a.ply.marks.toml"), &None));
        let second = marks.set_unit(Some(Unit::Inch));
        assert_eq!(second.before, Some(first.text));
        marks.keep_measurement(distance(2.0)).unwrap();
        let last = marks.keep_measurement(distance(3.0)).unwrap();
        let read = KeptMarks::new("a.ply.marks.toml".into(), None, Marks::from_toml(&last.text).unwrap());
        assert_eq!((read.marks(), read.unit()), (marks.marks(), Some(Unit::Inch)));
        let (file, csv) = marks.csv();
        assert_eq!(file.to_str(), Some("a.ply.measurements.csv"));
        assert!(csv.contains("2,distance,3.0,in,"), "{csv}");
    }

    #[test]
    fn too_many_are_refused() {
        let mut marks = kept();
        (0..Marks::MOST).for_each(|_| drop(marks.keep_measurement(distance(1.0)).unwrap()));
        assert!(marks.keep_measurement(distance(1.0)).unwrap_err().contains("at most 200 measurements"));
        assert_eq!(marks.measurements().count(), Marks::MOST);
    }
}
