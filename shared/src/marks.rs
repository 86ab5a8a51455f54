//! Marks on a model: annotations and measurements, and the file that keeps them.

mod measurement;
mod unit;

pub use measurement::{Measurement, MeasurementError, MeasurementKind, SurfaceWay};
pub use unit::Unit;

use std::fmt::Write;

use glam::DVec3;
use serde::Deserialize;
use toml::Spanned;

use crate::{
    camera::{CameraFileError, LARGEST_COMPONENT, View, ViewTable},
    printable::printable_line,
};

/// The marks of a model, in the coordinates of its file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Marks {
    /// The unit of the model's coordinates, if somebody has set it.
    pub unit: Option<Unit>,
    /// At most [`Marks::MOST`].
    pub annotations: Vec<Annotation>,
    /// At most [`Marks::MOST`].
    pub measurements: Vec<Measurement>,
}

/// A point of a model with a label and a text.
///
/// Invariant: the label is not empty, both texts are printable and within their limits, and all numbers are finite;
/// [`Annotation::new`] checks it.
#[derive(Clone, Debug, PartialEq)]
pub struct Annotation {
    label: String,
    text: String,
    at: DVec3,
    direction: Option<DVec3>,
    view: Option<View>,
}

/// A text or number of an annotation is beyond its limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum AnnotationError {
    #[error("an annotation needs a label of 1 to {max} characters", max = Annotation::LONGEST_LABEL)]
    Label,
    #[error("the text of an annotation has at most {max} characters", max = Annotation::LONGEST_TEXT)]
    Text,
    #[error("a component of at is not a finite number below 1e18")]
    Point,
    #[error("direction is a vector that is not zero")]
    Direction,
}

impl Annotation {
    /// The longest label in characters: one or two lines on the wall.
    pub const LONGEST_LABEL: usize = 60;
    /// The longest text in characters: a paragraph on the wall.
    pub const LONGEST_TEXT: usize = 600;

    /// An annotation at a point; `direction` is the side to which the surface faces there, and `view` shows the point.
    ///
    /// # Errors
    /// The label is empty, a text is too long, or a number is not finite.
    pub fn new(
        label: &str,
        text: &str,
        at: DVec3,
        direction: Option<DVec3>,
        view: Option<View>,
    ) -> Result<Self, AnnotationError> {
        let [label, text] = [label, text].map(|text| printable_line(text).trim().to_owned());
        if !(1..=Self::LONGEST_LABEL).contains(&label.chars().count()) {
            return Err(AnnotationError::Label);
        }
        if text.chars().count() > Self::LONGEST_TEXT {
            return Err(AnnotationError::Text);
        }
        if !is_point(at) {
            return Err(AnnotationError::Point);
        }
        let unit = |direction: DVec3| match direction.is_normalized() {
            // Once more would change its last bits.
            true => Ok(direction),
            false => direction.try_normalize().ok_or(AnnotationError::Direction),
        };
        Ok(Self { label, text, at, direction: direction.map(unit).transpose()?, view })
    }

    /// The short text beside the point.
    pub fn label(&self) -> &str {
        &self.label
    }

    /// The long text; may be empty.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The point.
    pub fn at(&self) -> DVec3 {
        self.at
    }

    /// The side to which the surface faces there, of length 1, if it is known.
    pub fn direction(&self) -> Option<DVec3> {
        self.direction
    }

    /// The view from which it was made.
    pub fn view(&self) -> Option<View> {
        self.view
    }
}

/// Whether rays can be traced to a point.
fn is_point(point: DVec3) -> bool {
    point.is_finite() && point.abs().max_element() < LARGEST_COMPONENT
}

const FORMAT: &str = "a file of marks has perhaps unit = \"mm\" or another, tables [[annotation]] with label and at = [x, y, z], \
    perhaps text, direction and a table view, and tables [[measurement]] with kind and points, and along the \
    surface a length";

impl Marks {
    /// The most annotations of a model, and the most measurements.
    pub const MOST: usize = 200;

    /// Reads the text of a file of marks; see [`Marks::to_toml`].
    ///
    /// # Errors
    /// The line, the fault and the format.
    pub fn from_toml(text: &str) -> Result<Self, CameraFileError> {
        let at = |offset, problem: &str| CameraFileError::at(text, offset, problem, FORMAT);
        let file: MarksFile =
            toml::from_str(text).map_err(|error| at(error.span().map_or(0, |span| span.start), error.message()))?;
        if file.annotation.len().max(file.measurement.len()) > Self::MOST {
            return Err(at(0, &format!("a model has at most {} annotations, and as many measurements", Self::MOST)));
        }
        let mut marks = Self { unit: file.unit, ..Self::default() };
        for table in file.annotation {
            let start = table.span().start;
            let AnnotationTable { label, text, at: point, direction, view } = table.into_inner();
            let view = view.map(ViewTable::view).transpose().map_err(|error| at(start, &error.to_string()))?;
            let annotation = Annotation::new(&label, &text, point, direction, view);
            marks.annotations.push(annotation.map_err(|error| at(start, &error.to_string()))?);
        }
        for table in file.measurement {
            let start = table.span().start;
            let MeasurementTable { kind, points, length } = table.into_inner();
            let measurement = match (kind, length) {
                (MeasurementKind::Surface, Some(length)) => Measurement::along(SurfaceWay { length, points }),
                (_, None) => Measurement::new(kind, points),
                (_, Some(_)) => return Err(at(start, &format!("a measurement of kind {kind} has no length"))),
            };
            marks.measurements.push(measurement.map_err(|error| at(start, &error.to_string()))?);
        }
        Ok(marks)
    }

    /// Writes a file of marks: `unit`, a table `annotation` for each with `label`, `text`, `at`, `direction` and a table `view`,
    /// as files of views have, and a table `measurement` for each with `kind` and `points`, and along the surface its `length`. Numbers are exact to the last bit.
    pub fn to_toml(&self) -> String {
        let mut text = "# Marks of a model: annotations, and measurements of the ruler.\n".to_owned();
        let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
        let vector = |DVec3 { x, y, z }: DVec3| format!("[{x:?}, {y:?}, {z:?}]");
        // Writing to a string cannot fail.
        if let Some(unit) = self.unit {
            let _ = writeln!(text, "unit = \"{unit}\"");
        }
        for Annotation { label, text: long, at, direction, view } in &self.annotations {
            let _ = writeln!(text, "\n[[annotation]]\nlabel = {}", quoted(label));
            if !long.is_empty() {
                let _ = writeln!(text, "text = {}", quoted(long));
            }
            let _ = writeln!(text, "at = {}", vector(*at));
            if let Some(direction) = direction {
                let _ = writeln!(text, "direction = {}", vector(*direction));
            }
            if let Some(view) = view {
                let _ = write!(text, "[annotation.view]\n{}", view.to_toml());
            }
        }
        for measurement in &self.measurements {
            let points: Vec<_> = measurement.points().iter().copied().map(vector).collect();
            let kind = measurement.kind();
            let _ = writeln!(text, "\n[[measurement]]\nkind = \"{kind}\"\npoints = [{}]", points.join(", "));
            if let Some(length) = measurement.length() {
                let _ = writeln!(text, "length = {length:?}");
            }
        }
        text
    }

    /// The measurements as comma-separated values: a row for each with its kind, value, unit and points, along the surface the
    /// ends alone. Numbers are exact to the last bit.
    pub fn to_csv(&self, unit: Option<Unit>) -> String {
        let picked = |it: &Measurement| match (it.kind(), it.points()) {
            (MeasurementKind::Surface, &[first, .., last]) => vec![first, last],
            (_, points) => points.to_vec(),
        };
        let n_points = self.measurements.iter().map(|it| picked(it).len()).max().unwrap_or(0);
        let mut text = "number,kind,value,unit".to_owned();
        (1..=n_points).for_each(|number| _ = write!(text, ",x{number},y{number},z{number}"));
        for (measurement, number) in self.measurements.iter().zip(1..) {
            let (kind, value, unit) = (measurement.kind(), measurement.value(), measurement.unit_name(unit));
            let _ = write!(text, "\r\n{number},{kind},{value:?},{unit}");
            let points = picked(measurement);
            for DVec3 { x, y, z } in &points {
                let _ = write!(text, ",{x:?},{y:?},{z:?}");
            }
            text.push_str(&",,,".repeat(n_points - points.len()));
        }
        text + "\r\n"
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MarksFile {
    unit: Option<Unit>,
    #[serde(default)]
    annotation: Vec<Spanned<AnnotationTable>>,
    #[serde(default)]
    measurement: Vec<Spanned<MeasurementTable>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AnnotationTable {
    label: String,
    #[serde(default)]
    text: String,
    at: DVec3,
    direction: Option<DVec3>,
    view: Option<ViewTable>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MeasurementTable {
    kind: MeasurementKind,
    points: Vec<DVec3>,
    length: Option<f64>,
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use strum::VariantArray;

    use super::*;
    use crate::camera::{Camera, Look, UpAxis};

    fn annotation(label: &str, at: DVec3) -> Annotation {
        Annotation::new(label, "", at, None, None).unwrap()
    }

    #[test]
    fn a_wrong_file_says_where_and_what_would_be_right() {
        for (text, line, fault) in [
            ("unit = \"miles\"", 1, "miles"),
            ("\n[[annotation]]\nlabel = \"a\"\nat = [0, 0]", 4, ""),
            ("[[annotation]]\nat = [0, 0, 0]", 1, "label"),
            ("[[annotation]]\nlabel = \" \\u202e\"\nat = [0, 0, 0]", 1, "1 to 60 characters"),
            ("[[annotation]]\nlabel = \"a\"\nat = [0, 0, inf]", 1, "finite"),
            ("[[annotation]]\nlabel = \"a\"\nat = [0, 0, 0]\ndirection = [0, 0, 0]", 1, "not zero"),
            ("[[annotation]]\nlabel = \"a\"\nat = [0, 0, 0]\ncolor = 3", 4, "unknown field"),
            ("[[measurement]]\nkind = \"angle\"\npoints = [[0, 0, 0], [1, 0, 0]]", 1, "3 points"),
            ("[[measurement]]\nkind = \"weight\"\npoints = []", 2, "weight"),
        ] {
            let told = Marks::from_toml(text).unwrap_err().to_string();
            assert!(told.starts_with(&format!("line {line}: ")) && told.contains(fault), "{text}: {told}");
            assert!(told.contains("tables [[annotation]]") && !told.contains('\n'), "{told}");
        }
        let long = format!("[[annotation]]\nlabel = \"a\"\ntext = \"{}\"\nat = [0, 0, 0]", "é".repeat(601));
        assert!(Marks::from_toml(&long).unwrap_err().to_string().contains("at most 600 characters"));
        let many = "[[annotation]]\nlabel = \"a\"\nat = [0, 0, 0]\n".repeat(Marks::MOST + 1);
        assert!(Marks::from_toml(&many).unwrap_err().to_string().contains("at most 200 annotations"));
    }

    #[test]
    fn texts_are_printable_lines() {
        let marks =
            Marks::from_toml("[[annotation]]\nlabel = \"a\\u001b[31m\\nb\"\ntext = '<b>'\nat = [1, 2, 3]").unwrap();
        assert_eq!((marks.annotations[0].label(), marks.annotations[0].text()), ("a[31m b", "<b>"));
    }

    #[test]
    fn measurements_are_rows_of_a_table() {
        let points = [DVec3::ZERO, DVec3::X * 3.0, DVec3::new(3.0, 4.0, 0.5)];
        let measurements = vec![
            Measurement::new(MeasurementKind::Distance, points[..2].to_vec()).unwrap(),
            Measurement::new(MeasurementKind::Area, points.to_vec()).unwrap(),
        ];
        let marks = Marks { measurements, ..Marks::default() };
        let csv = marks.to_csv(Some(Unit::Millimetre));
        let rows: Vec<Vec<_>> = csv.lines().map(|row| row.split(',').collect()).collect();
        assert!(rows.iter().all(|row| row.len() == 4 + 3 * 3), "{csv}");
        assert_eq!(rows[1][..8], ["1", "distance", "3.0", "mm", "0.0", "0.0", "0.0", "3.0"]);
        assert_eq!((rows[2][1], rows[2][3], rows[2][12]), ("area", "mm²", "0.5"));
    }

    proptest! {
        #[test]
        fn a_file_keeps_every_bit(
            labels in proptest::collection::vec("[ -~é研\"'\\\\]{0,20}", 0..4),
            at in [-1e9..1e9f64, -1e-9..1e-9, -1.0..1.0],
            points in proptest::collection::vec([-1e9..1e9f64, -1e-9..1e-9, -1.0..1.0], 2..9),
            unit in proptest::option::of(0..Unit::VARIANTS.len()),
        ) {
            let camera = Camera::look_at(DVec3::splat(3.0), DVec3::ZERO, DVec3::Z, 0.7, 1.5).unwrap();
            let view = View { camera, up: Some(UpAxis::Z), look: Some(Look::default()) };
            let mut marks = Marks { unit: unit.map(|unit| Unit::VARIANTS[unit]), ..Marks::default() };
            for label in &labels {
                let at = DVec3::from_array(at);
                marks.annotations.extend(Annotation::new(&format!("a{label}"), label, at, Some(at), Some(view)));
                marks.annotations.push(annotation("plain", -at));
            }
            let points: Vec<_> = points.into_iter().map(DVec3::from_array).collect();
            marks.measurements.extend(Measurement::new(MeasurementKind::Distance, points[..2].to_vec()));
            marks.measurements.extend(Measurement::new(MeasurementKind::Area, points));
            prop_assert_eq!(Marks::from_toml(&marks.to_toml()).unwrap(), marks);
        }
    }
}
