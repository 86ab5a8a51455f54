//! Profile 3d: views from one eye, laid onto the wall.
//!
//! The standard turns the eye to the right, then up, then clockwise. Writers differ: the library of its authors warns that
//! the axes are different for each user, and its example turns the other way and in the other order. So all readings are
//! tried against the file's own overlaps: where the alpha maps of projectors add up to even light, they light the same place.

use glam::{DQuat, DVec2, DVec3};

use super::{
    canvas::{Places, Rough},
    document::{Frustum, Region},
};
use crate::wall::Surface;

/// A way to read a frustum's angles.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// 1 or -1 for yaw, pitch and roll: to the right, up and clockwise, or the other way.
    signs: [f64; 3],
    /// Rolled first, then turned up, then to the right, always about the axes of the room.
    is_reversed: bool,
}

/// The eye before a wall of unit size, at its axis or centre, or one unit before its edge or plane.
const EYE: DVec3 = DVec3::Z;
/// Rays that leave a flat wall at less than this sine meet it too far away.
const LEAST_SINE: f64 = 0.05;
/// The part of white by which alpha maps may fail to add up, on average where they fade.
const LARGEST_ERROR: f64 = 0.15;
/// Readings that are worse than the best one by less than this are as good, and the standard's comes first.
const NO_DIFFERENCE: f64 = 0.02;

impl Reading {
    /// As the standard says (section 2.2.1).
    const STANDARD: Self = Self { signs: [1.0; 3], is_reversed: false };

    /// All of them, the standard's first.
    fn all() -> impl Iterator<Item = Self> {
        (0..16).map(|n| Self {
            signs: [1, 2, 4].map(|bit| if n & bit == 0 { 1.0 } else { -1.0 }),
            is_reversed: n & 8 != 0,
        })
    }

    /// The ray at a point of a view, from (0, 0) upper left to (1, 1): x is right, y up, and z towards the audience.
    fn ray(&self, frustum: &Frustum, at: DVec2) -> DVec3 {
        let [left, right, up, down] = frustum.edges.map(|degrees| degrees.to_radians().tan());
        let ahead = DVec3::new(left + at.x * (right - left), up + at.y * (down - up), -1.0);
        let angle = |n: usize| self.signs[n] * frustum.turned[n].to_radians();
        let (yaw, pitch, roll) =
            (DQuat::from_rotation_y(-angle(0)), DQuat::from_rotation_x(angle(1)), DQuat::from_rotation_z(-angle(2)));
        if self.is_reversed { roll * pitch * yaw * ahead } else { yaw * pitch * roll * ahead }
    }

    /// Whether two readings are the same for these frusta.
    fn is_like(&self, other: &Self, frusta: &[Frustum]) -> bool {
        let corners = [DVec2::ZERO, DVec2::X, DVec2::Y];
        let is_near = |frustum: &Frustum, at: DVec2| self.ray(frustum, at).distance(other.ray(frustum, at)) < 1e-9;
        frusta.iter().all(|frustum| corners.iter().all(|at| is_near(frustum, *at)))
    }

    fn words(&self) -> String {
        let word = |n: usize, words: [&str; 2]| words[usize::from(self.signs[n] < 0.0)].to_owned();
        let turns = [word(0, ["right", "left"]), word(1, ["up", "down"]), word(2, ["clockwise", "anticlockwise"])];
        let order = if self.is_reversed { "roll, pitch, yaw" } else { "yaw, pitch, roll" };
        format!("{order} turn {}", turns.join(", ").replacen(", ", " / ", 2))
    }
}

/// Where the warps of all regions lie on a wall of this shape and unit size, flat if there is none, by the reading of angles
/// that fits best; and a line on that reading.
///
/// # Errors
/// A view looks past the wall, or no reading fits; the text names the cure.
pub fn places(surface: Option<Surface>, rough: &Rough<'_>) -> Result<(Places, String), String> {
    let frusta: Vec<Frustum> = rough.regions.iter().filter_map(|region| region.frustum).collect();
    let mut readings: Vec<Reading> = Vec::new();
    for reading in Reading::all() {
        if !readings.iter().any(|other| other.is_like(&reading, &frusta)) {
            readings.push(reading);
        }
    }
    let places_by = |reading: Reading| -> Places {
        Box::new(move |region: &Region, value: DVec3| {
            let ray = reading.ray(&region.frustum?, value.truncate());
            match surface {
                Some(surface) => surface.met(EYE, ray),
                None => (ray.z < -LEAST_SINE * ray.length()).then(|| ray.truncate() / -ray.z),
            }
        })
    };
    let tried = readings.into_iter().map(|reading| (reading, rough.unevenness(&places_by(reading))));
    let possible: Vec<(Reading, f64)> = tried.filter_map(|(reading, error)| Some((reading, error?))).collect();
    let least = possible.iter().map(|(_, error)| *error).fold(f64::INFINITY, f64::min);
    let Some((reading, error)) = possible.into_iter().find(|(_, error)| *error <= least + NO_DIFFERENCE) else {
        return Err("its views look past a wall of this shape: give --shape, as the wall is".to_owned());
    };
    if error > LARGEST_ERROR {
        return Err(format!(
            "by no reading of yaw, pitch and roll do its projectors overlap as their alpha maps fade (the best is off by \
             {:.0} % of white): give --shape, as the wall is, or export profile 2d from the tool that wrote it",
            100.0 * error
        ));
    }
    let line = match (rough.has_maps() && rough.regions.len() > 1, reading == Reading::STANDARD) {
        (true, true) => "angles are the standard's, as the overlaps confirm".to_owned(),
        (true, false) => format!("angles are not the standard's: by the overlaps, {}", reading.words()),
        (false, _) => format!("no alpha maps confirm the angles: {}", reading.words()),
    };
    Ok((places_by(reading), line))
}

/// The view of places in space from an eye, upright and as narrow as possible: how the eye is turned, and the points of the
/// view. `None` if they do not fit into one.
pub fn view_of(eye: DVec3, points: &[DVec3]) -> Option<(Frustum, Vec<DVec2>)> {
    let rays: Vec<DVec3> = points.iter().map(|point| (*point - eye).normalize_or_zero()).collect();
    let ahead = rays.iter().sum::<DVec3>().normalize_or_zero();
    let (yaw, pitch) = (ahead.x.atan2(-ahead.z), ahead.y.clamp(-1.0, 1.0).asin());
    let turned = DQuat::from_rotation_y(-yaw) * DQuat::from_rotation_x(pitch);
    let slopes: Vec<DVec2> = rays
        .iter()
        .map(|ray| {
            let seen = turned.inverse() * *ray;
            (seen.z < -LEAST_SINE).then(|| seen.truncate() / -seen.z)
        })
        .collect::<Option<_>>()?;
    let least = slopes.iter().copied().reduce(DVec2::min)?;
    let greatest = slopes.iter().copied().reduce(DVec2::max)?;
    let degrees = |slope: f64| slope.atan().to_degrees();
    let edges = [least.x, greatest.x, greatest.y, least.y].map(degrees);
    let in_view = |slope: &DVec2| DVec2::new(slope.x - least.x, greatest.y - slope.y) / (greatest - least);
    let frustum = Frustum { turned: [yaw.to_degrees(), pitch.to_degrees(), 0.0], edges };
    Some((frustum, slopes.iter().map(in_view).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_standard_s_angles_turn_right_then_up_then_clockwise() {
        let ray = |turned: [f64; 3], at: [f64; 2]| {
            let frustum = Frustum { turned, edges: [-45.0, 45.0, 45.0, -45.0] };
            Reading::STANDARD.ray(&frustum, at.into()).normalize()
        };
        let is = |ray: DVec3, x: f64, y: f64, z: f64| ray.distance(DVec3::new(x, y, z).normalize()) < 1e-9;
        assert!(is(ray([90.0, 0.0, 0.0], [0.5, 0.5]), 1.0, 0.0, 0.0), "to the right");
        assert!(is(ray([0.0, 90.0, 0.0], [0.5, 0.5]), 0.0, 1.0, 0.0), "up");
        // A head that leans to the right has its top there, and so has the picture.
        assert!(is(ray([0.0, 0.0, 90.0], [0.5, 0.0]), 1.0, 0.0, -1.0), "clockwise");
        // Up is seen from where the eye has turned to.
        assert!(is(ray([90.0, 45.0, 0.0], [0.5, 0.5]), 1.0, 1.0, 0.0), "first to the right");
        assert_eq!(Reading::all().next(), Some(Reading::STANDARD));
        assert_eq!(Reading::all().count(), 16);
    }

    #[test]
    fn a_view_of_points_looks_at_them() {
        let eye = DVec3::new(0.2, 0.4, 2.0);
        let points: Vec<DVec3> =
            (0..30).map(|n| DVec3::new(f64::from(n % 6) * 0.3 + 0.5, f64::from(n / 6) * 0.2, 0.1)).collect();
        let (frustum, at) = view_of(eye, &points).expect("a view");
        for (point, at) in points.iter().zip(at) {
            let ray = Reading::STANDARD.ray(&frustum, at).normalize();
            assert!(ray.distance((*point - eye).normalize()) < 1e-9, "{point}");
        }
        assert_eq!(view_of(eye, &[eye + DVec3::X, eye - DVec3::X]), None);
    }
}
