//! The ruler in a hand: collects the points of a measurement. Pure.

use glam::DVec3;
use shared::marks::{Measurement, MeasurementKind};

/// The ruler; it is put away while it has no kind.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Ruler {
    kind: Option<MeasurementKind>,
    points: Vec<DVec3>,
    /// The sum of the surface's directions at the points.
    across: DVec3,
}

/// The consequence of a picked point.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Picked {
    /// More points are needed, or possible.
    More(String),
    /// A way along the surface is to be found, in the plane that its ends span with a direction.
    Stretch {
        ends: [DVec3; 2],
        across: DVec3,
    },
    Complete(Measurement),
}

impl Ruler {
    pub(crate) fn kind(&self) -> Option<MeasurementKind> {
        self.kind
    }

    /// The points of the measurement that has begun.
    pub(crate) fn points(&self) -> &[DVec3] {
        &self.points
    }

    /// Takes the ruler, or puts it away. Returns what to do with it.
    pub(crate) fn take(&mut self, kind: Option<MeasurementKind>) -> &'static str {
        *self = Self { kind, ..Self::default() };
        match kind {
            None => "The ruler is put away",
            Some(MeasurementKind::Distance) => "Ruler: click two points; Esc puts it away",
            Some(MeasurementKind::Surface) => {
                "Ruler: click two points, between which it is laid along the surface; Esc puts it away"
            }
            Some(MeasurementKind::Angle) => "Ruler: click three points, the corner second; Esc puts it away",
            Some(MeasurementKind::Area) => {
                "Ruler: click the corners of an area, the first again to end; Esc puts it away"
            }
        }
    }

    /// Drops the points of the measurement that has begun, or puts the ruler away. Returns whether there was something to end.
    pub(crate) fn cancel(&mut self) -> bool {
        if self.points.is_empty() {
            return self.kind.take().is_some();
        }
        (self.points, self.across) = (Vec::new(), DVec3::ZERO);
        true
    }

    /// Picks a point of the model, where the surface faces `side`; `near` is a distance at which two points are the same to a
    /// hand. `None` if the ruler is put away.
    pub(crate) fn pick(&mut self, point: DVec3, side: DVec3, near: f64) -> Option<Picked> {
        let kind = self.kind?;
        let [fewest, most] = kind.n_points();
        let has_enough = self.points.len() >= fewest;
        let closes = kind == MeasurementKind::Area
            && has_enough
            && self.points.first().is_some_and(|first| first.distance(point) <= near);
        if !closes {
            self.points.push(point);
            self.across += side;
        }
        if let (MeasurementKind::Surface, &[from, to]) = (kind, &*self.points) {
            let Self { across, .. } = std::mem::replace(self, Self { kind: self.kind, ..Self::default() });
            return Some(Picked::Stretch { ends: [from, to], across });
        }
        if closes || self.points.len() == most {
            self.across = DVec3::ZERO;
            return Measurement::new(kind, std::mem::take(&mut self.points)).ok().map(Picked::Complete);
        }
        let n_points = self.points.len();
        let more = match kind {
            MeasurementKind::Area if n_points >= fewest => {
                format!("{n_points} corners: click the first again to end, or more")
            }
            _ => format!("{n_points} of {fewest} points"),
        };
        Some(Picked::More(more))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pick(ruler: &mut Ruler, x: f64, y: f64) -> Option<f64> {
        match ruler.pick(DVec3::new(x, y, 0.0), DVec3::Z, 0.1) {
            Some(Picked::Complete(measurement)) => Some(measurement.value()),
            _ => None,
        }
    }

    #[test]
    fn each_kind_ends_with_its_last_point_and_the_next_begins() {
        let mut ruler = Ruler::default();
        assert_eq!(ruler.pick(DVec3::ZERO, DVec3::Z, 0.1), None, "the ruler is put away");
        ruler.take(Some(MeasurementKind::Distance));
        for length in [3.0, 5.0] {
            assert_eq!(ruler.pick(DVec3::ZERO, DVec3::Z, 0.1), Some(Picked::More("1 of 2 points".to_owned())));
            assert_eq!(pick(&mut ruler, length, 0.0), Some(length));
        }
        ruler.take(Some(MeasurementKind::Angle));
        assert_eq!([pick(&mut ruler, 1.0, 0.0), pick(&mut ruler, 0.0, 0.0)], [None; 2]);
        assert_eq!(pick(&mut ruler, 0.0, 1.0), Some(90.0));
    }

    #[test]
    fn two_points_along_the_surface_are_a_question() {
        let mut ruler = Ruler::default();
        ruler.take(Some(MeasurementKind::Surface));
        for x in [1.0, 2.0] {
            assert_eq!(ruler.pick(DVec3::ZERO, DVec3::Z, 0.1), Some(Picked::More("1 of 2 points".to_owned())));
            let picked = ruler.pick(DVec3::X * x, DVec3::Y, 0.1);
            let (ends, across) = ([DVec3::ZERO, DVec3::X * x], DVec3::Y + DVec3::Z);
            assert_eq!(picked, Some(Picked::Stretch { ends, across }));
            assert!(ruler.points().is_empty());
        }
    }

    #[test]
    fn an_area_ends_where_it_began() {
        let mut ruler = Ruler::default();
        ruler.take(Some(MeasurementKind::Area));
        assert_eq!([pick(&mut ruler, 0.0, 0.0), pick(&mut ruler, 2.0, 0.0), pick(&mut ruler, 2.0, 2.0)], [None; 3]);
        assert_eq!(pick(&mut ruler, 0.0, 2.0), None);
        assert_eq!(pick(&mut ruler, 0.05, 0.0), Some(4.0));
        assert!(ruler.points().is_empty());
        let most = MeasurementKind::Area.n_points()[1];
        for corner in 1..most {
            assert_eq!(pick(&mut ruler, corner as f64, 0.0), None);
        }
        assert_eq!(pick(&mut ruler, 1.0, 1.0), Some((most - 2) as f64 / 2.0), "the last corner that is possible");
    }

    #[test]
    fn the_first_cancel_drops_points_and_the_second_puts_it_away() {
        let mut ruler = Ruler::default();
        assert!(!ruler.cancel());
        ruler.take(Some(MeasurementKind::Angle));
        pick(&mut ruler, 1.0, 0.0);
        assert!(ruler.cancel() && ruler.kind().is_some() && ruler.points().is_empty());
        assert!(ruler.cancel() && ruler.kind().is_none() && !ruler.cancel());
    }
}
