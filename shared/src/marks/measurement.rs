//! Measurements between points of a model.

use glam::DVec3;
use serde::{Deserialize, Serialize};
use strum::{Display, VariantArray};

use super::{Unit, is_point};
use crate::printable::significant;

/// The quantity that is measured; a key steps through them in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Display, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum MeasurementKind {
    /// Between two points, in a straight line.
    Distance,
    /// Between two points along the surface, in a plane across it.
    Surface,
    /// At the second of three points.
    Angle,
    /// The area of a polygon: of its projection along the direction in which that is largest.
    Area,
}

impl MeasurementKind {
    /// The fewest and the most points of a measurement.
    pub fn n_points(self) -> [usize; 2] {
        match self {
            Self::Distance => [2, 2],
            Self::Surface => [2, SurfaceWay::MOST_POINTS],
            Self::Angle => [3, 3],
            Self::Area => [3, 64],
        }
    }
}

/// A way along the surface of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SurfaceWay {
    /// In the unit of the model's coordinates.
    pub length: f64,
    /// Points of the way, its ends among them: at most [`SurfaceWay::MOST_POINTS`]. Between them it may be longer than a line.
    pub points: Vec<DVec3>,
}

impl SurfaceWay {
    /// The most points of a way: enough to draw it.
    pub const MOST_POINTS: usize = 64;
}

/// A measurement: its kind, and the points that it is of.
///
/// Invariant: it has as many points as its kind needs, and they are finite; [`Measurement::new`] and [`Measurement::along`] check
/// it.
#[derive(Clone, Debug, PartialEq)]
pub struct Measurement {
    kind: MeasurementKind,
    points: Vec<DVec3>,
    /// Along the surface; 0 of other kinds.
    length: f64,
}

/// The points are none of a measurement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum MeasurementError {
    #[error("{0}: from {min} to {max} points are possible", min = .0.n_points()[0], max = .0.n_points()[1])]
    Number(MeasurementKind),
    #[error("a component of a point is not a finite number below 1e18")]
    Point,
    #[error("a way along the surface has a length, which is at least the distance of its ends")]
    Length,
}

impl Measurement {
    /// A measurement of points in the coordinates of the model's file.
    ///
    /// # Errors
    /// The kind needs another number of points, or a number is not finite; a way along the surface needs its length.
    pub fn new(kind: MeasurementKind, points: Vec<DVec3>) -> Result<Self, MeasurementError> {
        if kind == MeasurementKind::Surface { Err(MeasurementError::Length) } else { Self::checked(kind, points, 0.0) }
    }

    /// A way along the surface, in the coordinates of the model's file.
    ///
    /// # Errors
    /// It has too few or too many points, a number is not finite, or the length is less than the distance of the ends.
    pub fn along(SurfaceWay { length, points }: SurfaceWay) -> Result<Self, MeasurementError> {
        let way = Self::checked(MeasurementKind::Surface, points, length)?;
        let [first, .., last] = *way.points else { return Err(MeasurementError::Number(MeasurementKind::Surface)) };
        // Sums are rounded.
        let is_possible = length.is_finite() && length >= first.distance(last) * (1.0 - 1e-9);
        if is_possible { Ok(way) } else { Err(MeasurementError::Length) }
    }

    fn checked(kind: MeasurementKind, points: Vec<DVec3>, length: f64) -> Result<Self, MeasurementError> {
        let [fewest, most] = kind.n_points();
        if !(fewest..=most).contains(&points.len()) {
            return Err(MeasurementError::Number(kind));
        }
        if !points.iter().copied().all(is_point) {
            return Err(MeasurementError::Point);
        }
        Ok(Self { kind, points, length })
    }

    /// The quantity that is measured.
    pub fn kind(&self) -> MeasurementKind {
        self.kind
    }

    /// The length along the surface, of a way there.
    pub fn length(&self) -> Option<f64> {
        (self.kind == MeasurementKind::Surface).then_some(self.length)
    }

    /// The points, in the order in which they were picked, or along the surface.
    pub fn points(&self) -> &[DVec3] {
        &self.points
    }

    /// The pairs of points between which lines are drawn.
    pub fn lines(&self) -> impl Iterator<Item = [DVec3; 2]> {
        let closing =
            (self.kind == MeasurementKind::Area).then(|| [self.points[self.points.len() - 1], self.points[0]]);
        self.points.array_windows().copied().chain(closing)
    }

    /// The value: in the model's unit, in degrees, or in the square of the unit.
    pub fn value(&self) -> f64 {
        let first = self.points[0];
        match self.kind {
            MeasurementKind::Distance => first.distance(self.points[1]),
            MeasurementKind::Surface => self.length,
            MeasurementKind::Angle => {
                let [a, b] = [first, self.points[2]].map(|end| end - self.points[1]);
                // Exact also near 0° and 180°, where a cosine alone is not.
                a.cross(b).length().atan2(a.dot(b)).to_degrees()
            }
            MeasurementKind::Area => {
                let corners = self.points.array_windows().map(|[a, b]| (*a - first).cross(*b - first));
                corners.sum::<DVec3>().length() * 0.5
            }
        }
    }

    /// The unit of its value, where `unit` is that of the model.
    pub fn unit_name(&self, unit: Option<Unit>) -> String {
        let length = unit.map_or_else(|| "units".to_owned(), |unit| unit.to_string());
        match self.kind {
            MeasurementKind::Distance | MeasurementKind::Surface => length,
            MeasurementKind::Angle => "°".to_owned(),
            MeasurementKind::Area => length + "²",
        }
    }

    /// The value with five digits and its unit, as on the wall.
    pub fn shown(&self, unit: Option<Unit>) -> String {
        let (value, unit) = (self.value(), self.unit_name(unit));
        match self.kind {
            MeasurementKind::Angle => format!("{value:.2}{unit}"),
            MeasurementKind::Distance | MeasurementKind::Surface | MeasurementKind::Area => {
                format!("{} {unit}", significant(value, 5))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(kind: MeasurementKind, points: &[[f64; 3]]) -> f64 {
        Measurement::new(kind, points.iter().copied().map(DVec3::from_array).collect()).unwrap().value()
    }

    #[test]
    fn values_are_those_of_geometry() {
        use MeasurementKind::*;
        let map = [512_345.0, 5_412_345.0, 64.0];
        let moved = |[x, y, z]: [f64; 3]| [map[0] + x, map[1] + y, map[2] + z];
        assert_eq!(value(Distance, &[map, moved([2.0, 3.0, 6.0])]), 7.0);
        assert_eq!(value(Angle, &[moved([1.0, 0.0, 0.0]), map, moved([0.0, 2.0, 0.0])]), 90.0);
        assert!((value(Angle, &[[1.0, 0.0, 0.0], [0.0; 3], [1.0, 1e-9, 0.0]]) - 1e-9_f64.to_degrees()).abs() < 1e-20);
        assert_eq!(value(Angle, &[[1.0, 0.0, 0.0], [0.0; 3], [-3.0, 0.0, 0.0]]), 180.0);
        let square = [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 2.0, 0.0], [0.0, 2.0, 0.0]];
        assert_eq!(value(Area, &square.map(moved)), 4.0);
        // Not convex: a square without a quarter.
        let corner = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 1.0], [1.0, 2.0], [0.0, 2.0]];
        assert_eq!(value(Area, &corner.map(|[y, z]| [7.0, y, z])), 3.0);
        assert_eq!(value(Distance, &[map, map]), 0.0);
        assert_eq!(value(Angle, &[map, map, map]), 0.0, "no direction, no angle");
    }

    #[test]
    fn a_measurement_is_shown_with_its_unit() {
        use MeasurementKind::*;
        let points = [DVec3::X, DVec3::ZERO, DVec3::Y * 12.345_678];
        let shown = |kind, n: usize, unit| Measurement::new(kind, points[..n].to_vec()).unwrap().shown(unit);
        assert_eq!(shown(Distance, 2, None), "1.0000 units");
        assert_eq!(shown(Area, 3, Some(Unit::Metre)), "6.1728 m²");
        assert_eq!(shown(Angle, 3, Some(Unit::Inch)), "90.00°");
    }

    #[test]
    fn an_area_is_closed_and_a_distance_is_not() {
        let points = vec![DVec3::ZERO, DVec3::X, DVec3::Y];
        let area = Measurement::new(MeasurementKind::Area, points.clone()).unwrap();
        assert_eq!(area.lines().count(), 3);
        let angle = Measurement::new(MeasurementKind::Angle, points).unwrap();
        assert_eq!(angle.lines().collect::<Vec<_>>(), [[DVec3::ZERO, DVec3::X], [DVec3::X, DVec3::Y]]);
        let most = MeasurementKind::Area.n_points()[1];
        assert!(Measurement::new(MeasurementKind::Area, vec![DVec3::ZERO; most + 1]).is_err());
    }
}
