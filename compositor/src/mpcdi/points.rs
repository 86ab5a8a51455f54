//! Profiles a3 and sl: points in space, laid onto a wall whose shape its owner says.
//!
//! The standard stores points in a right-handed system, and prefers X to the left, Y up and Z ahead; other writers have X to
//! the right and Z towards the audience, or Z up. The axes are those by which projectors show their pictures upright and not
//! mirrored on a wall of the shape.

use glam::{DAffine3, DMat3, DMat4, DVec2, DVec3};

use super::{
    canvas::{Places, Rough},
    convert::{self, Source},
    document::Region,
};
use crate::wall::{Flip, Rotation, Surface, Unrolling};

/// The shape of a wall, without sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// A plane.
    Flat,
    /// An upright cylinder with the audience inside.
    Cylinder,
    /// Two planes that meet at an upright edge.
    Fold,
    /// A part of a sphere, unrolled around its middle.
    Dome,
}

/// To the right, up, and towards the audience, in the axes of a file.
const AXES: [[DVec3; 3]; 4] = [
    [DVec3::NEG_X, DVec3::Y, DVec3::NEG_Z],
    [DVec3::X, DVec3::Y, DVec3::Z],
    [DVec3::X, DVec3::Z, DVec3::NEG_Y],
    [DVec3::NEG_Y, DVec3::Z, DVec3::NEG_X],
];
/// Points, nineteen of twenty, lie nearer to the wall than this part of its size, or it has another shape.
const FARTHEST: f64 = 0.003;
/// A wall whose normal is nearer to the vertical than this sine has no upper edge.
const STEEPEST: f64 = 0.95;

/// A wall as points show it.
#[derive(Clone, Copy, Debug)]
pub struct Fitted {
    /// To the surface's own coordinates, whose canvas has its middle or edge at zero.
    surface_from_file: DAffine3,
    /// Its shape; `None` is flat.
    pub surface: Option<Surface>,
}

/// The wall of this shape through all points of the regions' warps, in metres if the file's unit is known, and where they lie
/// on it.
///
/// # Errors
/// There is no such wall; the text names the cure.
pub fn places(shape: Shape, rough: &Rough<'_>) -> Result<(Places, Fitted), String> {
    let unit = rough.regions.iter().find_map(|region| region.unit_m).unwrap_or(1.0);
    let points: Vec<DVec3> = rough
        .regions
        .iter()
        .zip(rough.warps)
        .flat_map(|(region, warp)| {
            let source = Source { region, warp, canvas_from: &|_| None };
            let raster = |n: u32| DVec2::new(f64::from(n % 33) / 32.0, f64::from(n / 33) / 24.0);
            (0..33 * 25).map(move |n| source.value_at(raster(n))).collect::<Vec<_>>()
        })
        .filter(|point| point.is_finite())
        .collect();
    let mut best: Option<(usize, Fitted)> = None;
    let mut least_off = f64::INFINITY;
    for axes in AXES {
        let room_from_file = DMat3::from_cols(axes[0], axes[1], axes[2]).transpose() * unit;
        let in_room: Vec<DVec3> = points.iter().map(|point| room_from_file * *point).collect();
        let Some((surface_from_room, surface)) = shape.through(&in_room) else { continue };
        let fitted = Fitted { surface_from_file: surface_from_room * DAffine3::from_mat3(room_from_file), surface };
        let off = fitted.off(&points);
        least_off = least_off.min(off);
        let n_upright = n_upright(rough, &fitted);
        if off <= FARTHEST && best.as_ref().is_none_or(|(most, _)| n_upright > *most) {
            best = Some((n_upright, fitted));
        }
    }
    let Some((_, fitted)) = best else {
        let how = match least_off.is_finite() {
            true => format!("they lie up to {:.1} % of the wall's size beside it", 100.0 * least_off),
            false => "they make none that stands upright".to_owned(),
        };
        return Err(format!("its points are not those of a wall of this shape, {how}: give --shape, as the wall is"));
    };
    Ok((Box::new(move |_: &Region, value: DVec3| fitted.place(value)), fitted))
}

/// Twice the projectors that show their pictures unmirrored, and those that also show them upright.
fn n_upright(rough: &Rough<'_>, fitted: &Fitted) -> usize {
    let of = |(region, warp)| {
        let hung = convert::hung(Source { region, warp, canvas_from: &|value| fitted.place(value) }, [0; 2]);
        2 * usize::from(hung.flip == Flip::None) + usize::from(hung.rotation == Rotation::None)
    };
    rough.regions.iter().zip(rough.warps).map(of).sum()
}

impl Fitted {
    /// The place on the wall at a point of the file.
    fn place(&self, value: DVec3) -> Option<DVec2> {
        let point = self.surface_from_file.transform_point3(value);
        let Some(surface) = self.surface else { return Some(point.truncate()) };
        let eye = surface.middle(point.y);
        surface.met(eye, point - eye)
    }

    /// How far nineteen of twenty points lie from the wall at most, as a part of their extent.
    fn off(&self, points: &[DVec3]) -> f64 {
        let local = points.iter().map(|point| self.surface_from_file.transform_point3(*point));
        let least = local.clone().reduce(DVec3::min).unwrap_or_default();
        let greatest = local.clone().reduce(DVec3::max).unwrap_or_default();
        let away = local.zip(points).map(|(local, point)| {
            let place = self.place(*point)?;
            let on_wall = self.surface.map_or(place.extend(0.0), |surface| surface.in_space(place));
            Some(on_wall.distance(local))
        });
        let mut away: Vec<f64> = away.map(|away| away.unwrap_or(f64::INFINITY)).collect();
        away.sort_by(f64::total_cmp);
        away.get(away.len() * 19 / 20).copied().unwrap_or(f64::INFINITY) / (greatest - least).length()
    }
}

impl Shape {
    /// The surface through points of the room, whose place zero is its middle or edge, and the way to its coordinates.
    fn through(self, points: &[DVec3]) -> Option<(DAffine3, Option<Surface>)> {
        if points.len() < 16 {
            return None;
        }
        let centre = points.iter().sum::<DVec3>() / points.len() as f64;
        let fitted = match self {
            Self::Flat => {
                let normal = thinnest(points.iter().map(|point| *point - centre))?;
                let towards = if normal.z < 0.0 { -normal } else { normal };
                (surface_from_room(centre, towards)?, None)
            }
            Self::Cylinder => {
                let flat = points.iter().map(|point| DVec2::new(point.x, point.z));
                let (axis, radius_m) = circle(flat)?;
                let towards = DVec3::new(axis.x - centre.x, 0.0, axis.y - centre.z).normalize_or_zero();
                let origin = DVec3::new(axis.x, 0.0, axis.y) - radius_m * towards;
                (surface_from_room(origin, towards)?, Some(Surface::Cylinder { radius_m, at_m: 0.0 }))
            }
            Self::Fold => {
                let flat: Vec<DVec2> = points.iter().map(|point| DVec2::new(point.x, point.z)).collect();
                let (edge, towards, angle) = corner(&flat)?;
                let towards = DVec3::new(towards.x, 0.0, towards.y);
                let origin = DVec3::new(edge.x, 0.0, edge.y);
                (surface_from_room(origin, towards)?, Some(Surface::Fold { at_m: 0.0, angle }))
            }
            Self::Dome => {
                let (middle, radius_m) = sphere(points, centre)?;
                let towards = (middle - centre).normalize_or_zero();
                let surface = Surface::Dome { radius_m, at_m: [0.0; 2], unrolled: Unrolling::Azimuthal };
                (surface_from_room(middle - radius_m * towards, towards)?, Some(surface))
            }
        };
        Some(fitted).filter(|(map, _)| map.is_finite())
    }
}

/// The way to coordinates with this origin and this direction towards the audience, up as far as possible.
fn surface_from_room(origin: DVec3, towards: DVec3) -> Option<DAffine3> {
    let up = DVec3::Y - DVec3::Y.dot(towards) * towards;
    if towards.y.abs() > STEEPEST || towards.length() < 0.5 {
        return None;
    }
    let up = up.normalize();
    let room_from_surface = DAffine3::from_mat3_translation(DMat3::from_cols(up.cross(towards), up, towards), origin);
    Some(room_from_surface.inverse())
}

/// The direction in which points about zero spread least, by inverse iteration on their moments.
fn thinnest(points: impl Iterator<Item = DVec3>) -> Option<DVec3> {
    let outer = |it: DVec3| DMat3::from_cols(it * it.x, it * it.y, it * it.z);
    let moments = points.fold(DMat3::ZERO, |sum, it| sum + outer(it));
    let spread = moments.x_axis.x + moments.y_axis.y + moments.z_axis.z;
    let inverse = (moments + DMat3::from_diagonal(DVec3::splat(1e-9 * spread))).inverse();
    let mut normal = DVec3::new(0.3, 0.5, 0.8);
    for _ in 0..50 {
        normal = (inverse * normal).normalize_or_zero();
    }
    (normal.is_finite() && normal.length() > 0.5).then_some(normal)
}

/// Centre and radius of the circle through points, by linear equations (Kåsa 1976).
fn circle(points: impl Iterator<Item = DVec2> + Clone) -> Option<(DVec2, f64)> {
    let n = points.clone().count() as f64;
    let mean = points.clone().sum::<DVec2>() / n;
    let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for point in points.map(|point| point - mean) {
        let row = point.extend(1.0);
        matrix += DMat3::from_cols(row * row.x, row * row.y, row * row.z);
        right += row * point.length_squared();
    }
    let solved = matrix.inverse() * right;
    let centre = solved.truncate() / 2.0;
    let radius = (solved.z + centre.length_squared()).sqrt();
    (radius.is_finite() && radius > 0.0).then_some((mean + centre, radius))
}

/// Centre and radius of the sphere through points around a place, in the same way.
fn sphere(points: &[DVec3], around: DVec3) -> Option<(DVec3, f64)> {
    let (mut matrix, mut right) = (DMat4::ZERO, glam::DVec4::ZERO);
    for point in points.iter().map(|point| *point - around) {
        let row = point.extend(1.0);
        matrix += DMat4::from_cols(row * row.x, row * row.y, row * row.z, row * row.w);
        right += row * point.length_squared();
    }
    let solved = matrix.inverse() * right;
    let centre = solved.truncate() / 2.0;
    let radius = (solved.w + centre.length_squared()).sqrt();
    (radius.is_finite() && radius > 0.0).then_some((around + centre, radius))
}

/// Two lines through points: where they meet, the direction between them, and their angle in degrees.
fn corner(points: &[DVec2]) -> Option<(DVec2, DVec2, f64)> {
    let (_, along) = line(points)?;
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.dot(along).total_cmp(&b.dot(along)));
    let sides = |split: usize| Some([line(&sorted[..split])?, line(&sorted[split..])?]);
    let away = |point: DVec2, (at, along): (DVec2, DVec2)| (point - at).perp_dot(along).abs();
    let cost = |sides: &[(DVec2, DVec2); 2]| -> f64 {
        points.iter().map(|point| away(*point, sides[0]).min(away(*point, sides[1]))).sum()
    };
    let tries = (1..20).filter_map(|part| sides(sorted.len() * part / 20));
    let mut both = tries.min_by(|a, b| cost(a).total_cmp(&cost(b)))?;
    for _ in 0..8 {
        let (first, second): (Vec<DVec2>, Vec<DVec2>) =
            points.iter().partition(|point| away(**point, both[0]) < away(**point, both[1]));
        both = [line(&first)?, line(&second)?];
    }
    let [(a, a_along), (b, b_along)] = both;
    let edge = a + a_along * ((b - a).perp_dot(b_along) / a_along.perp_dot(b_along));
    let [a, b] = [(a - edge).normalize_or_zero(), (b - edge).normalize_or_zero()];
    let towards = (a + b).normalize_or_zero();
    let is_one = edge.is_finite() && towards.length() > 0.5;
    is_one.then(|| (edge, towards, a.angle_to(b).abs().to_degrees()))
}

/// The middle and the direction of the line through points.
fn line(points: &[DVec2]) -> Option<(DVec2, DVec2)> {
    if points.len() < 4 {
        return None;
    }
    let mean = points.iter().sum::<DVec2>() / points.len() as f64;
    let [xx, xy, yy] = points.iter().fold([0.0; 3], |[xx, xy, yy], point| {
        let d = *point - mean;
        [xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y]
    });
    Some((mean, DVec2::from_angle((2.0 * xy).atan2(xx - yy) / 2.0)))
}
