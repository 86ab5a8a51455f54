//! The shape of a wall that is not flat, as its owner says, and its canvas unrolled on it.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A wall's shape. In space, x is right, y up and z towards the audience, in metres; places are metres on the unrolled
/// canvas, from its lower-left corner.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(try_from = "Tables", into = "Tables")]
pub enum Surface {
    /// An upright cylinder with the audience inside.
    Cylinder {
        /// Its radius.
        radius_m: f64,
        /// The distance of its middle, which faces the audience, from the canvas's left edge.
        at_m: f64,
    },
    /// Two planes that meet at an upright edge.
    Fold {
        /// The edge's distance from the canvas's left edge.
        at_m: f64,
        /// The angle between the planes that the audience sees, in degrees; 180 is flat.
        angle: f64,
    },
    /// A part of a sphere with the audience inside.
    Dome {
        /// Its radius.
        radius_m: f64,
        /// The place of its middle, which faces the audience, from the canvas's lower-left corner.
        at_m: [f64; 2],
        /// How it is laid out as a canvas.
        unrolled: Unrolling,
    },
}

/// The greatest radius of a wall that is not flat: over its width, a canvas bends by less than a pixel there.
const MOST_RADIUS_M: f64 = 1e5;

/// How a sphere is laid out as a flat canvas: no way keeps all distances.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Unrolling {
    /// The azimuthal equidistant projection: distances from the middle, and directions there, are those on the wall.
    #[default]
    Azimuthal,
    /// Longitude to the right and latitude up, from the middle: columns are meridians, and distances along these are kept.
    Longitude,
}

/// `[surface]` in a wall file: one table for the shape.
#[derive(Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Tables {
    cylinder: Option<Cylinder>,
    fold: Option<Fold>,
    dome: Option<Dome>,
}

#[derive(Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Cylinder {
    radius_m: f64,
    at_m: f64,
}

#[derive(Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Fold {
    at_m: f64,
    angle: f64,
}

#[derive(Clone, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct Dome {
    radius_m: f64,
    at_m: [f64; 2],
    #[serde(default)]
    unrolled: Unrolling,
}

impl TryFrom<Tables> for Surface {
    type Error = &'static str;

    fn try_from(tables: Tables) -> Result<Self, Self::Error> {
        match (tables.cylinder, tables.fold, tables.dome) {
            (Some(Cylinder { radius_m, at_m }), None, None) => Ok(Self::Cylinder { radius_m, at_m }),
            (None, Some(Fold { at_m, angle }), None) => Ok(Self::Fold { at_m, angle }),
            (None, None, Some(Dome { radius_m, at_m, unrolled })) => Ok(Self::Dome { radius_m, at_m, unrolled }),
            (None, None, None) => {
                Err("[surface] says no shape: add [surface.cylinder], [surface.fold] or [surface.dome], \
                                       or leave it out for a flat wall")
            }
            _ => Err("[surface] says several shapes, and a wall has one: leave out the others"),
        }
    }
}

impl From<Surface> for Tables {
    fn from(surface: Surface) -> Self {
        let none = Self { cylinder: None, fold: None, dome: None };
        match surface {
            Surface::Cylinder { radius_m, at_m } => Self { cylinder: Some(Cylinder { radius_m, at_m }), ..none },
            Surface::Fold { at_m, angle } => Self { fold: Some(Fold { at_m, angle }), ..none },
            Surface::Dome { radius_m, at_m, unrolled } => {
                Self { dome: Some(Dome { radius_m, at_m, unrolled }), ..none }
            }
        }
    }
}

impl Surface {
    /// Refuses shapes that hold no canvas of this width and height in metres; the text names the cure.
    pub(super) fn check(&self, [width_m, height_m]: [f64; 2]) -> Result<(), String> {
        if let Self::Cylinder { radius_m, .. } | Self::Dome { radius_m, .. } = *self
            && !(radius_m > 0.0 && radius_m <= MOST_RADIUS_M)
        {
            return Err(format!(
                "radius_m = {radius_m:?}: a radius is above 0 and at most {MOST_RADIUS_M} m; leave [surface] out for a flat \
                 wall"
            ));
        }
        match *self {
            Self::Cylinder { radius_m, at_m } => {
                let farthest = at_m.max(width_m - at_m) / radius_m;
                // A little more than half a turn to either side would meet itself.
                if farthest <= 3.0 && (0.0..=width_m).contains(&at_m) {
                    return Ok(());
                }
                Err(format!(
                    "radius_m = {radius_m} and at_m = {at_m}: a canvas {width_m} m wide lies on at most a turn, and at_m \
                     is between its edges"
                ))
            }
            Self::Fold { at_m, angle } => {
                if (30.0..180.0).contains(&angle) && at_m > 0.0 && at_m < width_m {
                    return Ok(());
                }
                Err(format!(
                    "at_m = {at_m} and angle = {angle}: the edge is between the canvas's edges, and the angle that the \
                     audience sees from 30 to less than 180 degrees; leave [surface] out for a flat wall"
                ))
            }
            Self::Dome { radius_m, at_m: [x, y], unrolled } => {
                let farthest = DVec2::new(x.max(width_m - x), y.max(height_m - y)) / radius_m;
                // A little less than the opposite point of the sphere, or its poles.
                let fits = match unrolled {
                    Unrolling::Azimuthal => farthest.length() <= 3.0,
                    Unrolling::Longitude => farthest.x <= 3.0 && farthest.y <= 1.5,
                };
                if !((0.0..=width_m).contains(&x) && (0.0..=height_m).contains(&y)) {
                    return Err(format!(
                        "at_m = [{x:?}, {y:?}]: the dome's middle lies on the canvas, which is {width_m} m × {height_m} m: \
                         give its distances from the canvas's left and lower edge"
                    ));
                }
                if fits {
                    return Ok(());
                }
                Err(format!(
                    "radius_m = {radius_m} and at_m = [{x}, {y}]: a canvas of {width_m} m × {height_m} m lies within 170 \
                     degrees of the dome's middle (85 degrees up and down if unrolled by longitude): give the dome's radius"
                ))
            }
        }
    }

    /// The point in space at a place.
    pub fn in_space(&self, place: DVec2) -> DVec3 {
        match self {
            Self::Cylinder { radius_m, at_m } => {
                let angle = (place.x - at_m) / radius_m;
                DVec3::new(radius_m * angle.sin(), place.y, radius_m * (1.0 - angle.cos()))
            }
            Self::Fold { at_m, .. } => {
                let along = place.x - at_m;
                let away = self.away(along >= 0.0);
                DVec3::new(along.abs() * away.x, place.y, along.abs() * away.y)
            }
            Self::Dome { radius_m, at_m, unrolled } => {
                let angles = (place - DVec2::from(*at_m)) / radius_m;
                let ahead = match unrolled {
                    Unrolling::Azimuthal => {
                        let away = angles.length();
                        let ratio = if away < 1e-6 { 1.0 } else { away.sin() / away };
                        (angles * ratio).extend(-away.cos())
                    }
                    Unrolling::Longitude => {
                        let ((x, z), (up, out)) = (angles.x.sin_cos(), angles.y.sin_cos());
                        DVec3::new(out * x, up, -out * z)
                    }
                };
                self.middle(0.0) + *radius_m * ahead
            }
        }
    }

    /// The place where a ray meets the wall from the audience's side; `None` if it does not.
    pub fn met(&self, from: DVec3, ray: DVec3) -> Option<DVec2> {
        if let Self::Dome { radius_m, at_m, unrolled } = self {
            let origin = from - self.middle(0.0);
            let (a, half_b) = (ray.length_squared(), origin.dot(ray));
            let root = half_b * half_b - a * (origin.length_squared() - radius_m * radius_m);
            let t = (root.sqrt() - half_b) / a;
            let at = (origin + t * ray) / *radius_m;
            let angles = match unrolled {
                Unrolling::Azimuthal => {
                    let aside = at.truncate().length();
                    let ratio = if aside < 1e-9 { 1.0 } else { aside.atan2(-at.z) / aside };
                    at.truncate() * ratio
                }
                Unrolling::Longitude => DVec2::new(at.x.atan2(-at.z), at.y.clamp(-1.0, 1.0).asin()),
            };
            // NaN where the ray passes the sphere.
            return (t > 0.0).then(|| DVec2::from(*at_m) + *radius_m * angles);
        }
        let (origin, along) = (DVec2::new(from.x, from.z), DVec2::new(ray.x, ray.z));
        match self {
            Self::Cylinder { radius_m, at_m } => {
                let origin = origin - DVec2::new(0.0, *radius_m);
                let (a, half_b) = (along.length_squared(), origin.dot(along));
                let root = half_b * half_b - a * (origin.length_squared() - radius_m * radius_m);
                let t = (root.sqrt() - half_b) / a;
                let at = origin + t * along;
                // NaN where the ray passes the cylinder.
                (t > 0.0).then(|| DVec2::new(at_m + radius_m * at.x.atan2(-at.y), from.y + t * ray.y))
            }
            Self::Fold { at_m, .. } => {
                let on_plane = |is_right: bool| {
                    let away = self.away(is_right);
                    let t = away.perp_dot(origin) / along.perp_dot(away);
                    let distance = away.dot(origin + t * along);
                    let place = DVec2::new(at_m + if is_right { distance } else { -distance }, from.y + t * ray.y);
                    (t > 0.0 && distance >= 0.0).then_some((t, place))
                };
                let met = [on_plane(false), on_plane(true)].into_iter().flatten();
                met.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, place)| place)
            }
            Self::Dome { .. } => None,
        }
    }

    /// A point before the wall from which all points at a height are seen: on the axis, between the planes, or the dome's
    /// centre.
    pub(crate) fn middle(&self, height_m: f64) -> DVec3 {
        match self {
            Self::Cylinder { radius_m, .. } => DVec3::new(0.0, height_m, *radius_m),
            Self::Fold { .. } => DVec3::new(0.0, height_m, 1.0),
            Self::Dome { radius_m, at_m, .. } => DVec3::new(0.0, at_m[1], *radius_m),
        }
    }

    /// The same wall of another size, with its middle or edge at another place.
    pub(crate) fn scaled(&self, scale: f64, at_m: DVec2) -> Self {
        match *self {
            Self::Cylinder { radius_m, .. } => Self::Cylinder { radius_m: scale * radius_m, at_m: at_m.x },
            Self::Fold { angle, .. } => Self::Fold { at_m: at_m.x, angle },
            Self::Dome { radius_m, unrolled, .. } => {
                Self::Dome { radius_m: scale * radius_m, at_m: at_m.to_array(), unrolled }
            }
        }
    }

    /// The direction away from the fold, on one of its planes: x and z.
    fn away(&self, is_right: bool) -> DVec2 {
        let Self::Fold { angle, .. } = self else { return DVec2::X };
        let turned = (180.0 - angle).to_radians() / 2.0;
        DVec2::new(if is_right { turned.cos() } else { -turned.cos() }, turned.sin())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dome(unrolled: Unrolling) -> Surface {
        Surface::Dome { radius_m: 2.0, at_m: [1.5, 0.4], unrolled }
    }

    #[test]
    fn a_dome_keeps_the_distances_that_its_layout_promises() {
        let apart = |unrolled, from: [f64; 2], to: [f64; 2]| {
            let [from, to] = [from, to].map(|at| dome(unrolled).in_space(at.into()) - dome(unrolled).middle(0.0));
            // Along the sphere.
            2.0 * from.angle_between(to)
        };
        let is = |found: f64, expected: f64| assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        is(apart(Unrolling::Azimuthal, [1.5, 0.4], [2.1, 1.2]), 1.0);
        is(apart(Unrolling::Longitude, [2.5, 0.1], [2.5, 0.9]), 0.8);
        is(apart(Unrolling::Longitude, [0.9, 0.4], [2.1, 0.4]), 1.2);
        // The middle is seen straight ahead from the centre.
        for unrolled in [Unrolling::Azimuthal, Unrolling::Longitude] {
            let middle = dome(unrolled).in_space(DVec2::new(1.5, 0.4));
            assert!(middle.distance(DVec3::new(0.0, 0.4, 0.0)) < 1e-12, "{middle}");
        }
        let check = |radius_m, at_m, unrolled| Surface::Dome { radius_m, at_m, unrolled }.check([3.0, 1.0]).is_ok();
        assert!(check(2.0, [1.5, 0.5], Unrolling::Azimuthal) && check(0.52, [1.5, 0.4], Unrolling::Longitude));
        assert!(!check(0.52, [1.5, 0.5], Unrolling::Azimuthal), "beyond the opposite point");
        assert!(!check(0.52, [1.5, 0.1], Unrolling::Longitude), "beyond a pole");
        assert!(!check(-2.0, [1.5, 0.5], Unrolling::Azimuthal) && !check(2.0, [3.5, 0.5], Unrolling::Azimuthal));
        assert!(!check(f64::NAN, [1.5, 0.5], Unrolling::Azimuthal));
    }

    #[test]
    fn a_ray_to_a_point_meets_the_wall_there_and_distances_along_it_are_kept() {
        let walls = [
            Surface::Cylinder { radius_m: 2.0, at_m: 1.5 },
            Surface::Fold { at_m: 1.2, angle: 120.0 },
            Surface::Fold { at_m: 1.2, angle: 90.0 },
            dome(Unrolling::Azimuthal),
            dome(Unrolling::Longitude),
        ];
        for surface in walls {
            let is_dome = matches!(surface, Surface::Dome { .. });
            for n in 0..50 {
                let place = DVec2::new(0.06 * f64::from(n) + 0.01, 0.1 * f64::from(n % 8));
                let from = DVec3::new(0.2, 0.5, 1.9);
                let met = surface.met(from, surface.in_space(place) - from).expect("ahead");
                assert!(met.distance(place) < 1e-9, "{surface:?}: {place} {met}");
                let beside = place + DVec2::new(1e-5, 2e-5);
                let apart = surface.in_space(place).distance(surface.in_space(beside));
                // No layout of a sphere keeps all distances.
                assert!(is_dome || (apart / place.distance(beside) - 1.0).abs() < 1e-6, "{surface:?}: {place}");
            }
            assert!(is_dome || surface.met(DVec3::new(0.2, 0.5, 1.9), DVec3::Y).is_none());
        }
        // The fold's planes meet at the angle that the audience sees.
        let fold = Surface::Fold { at_m: 1.0, angle: 120.0 };
        let [left, edge, right] = [0.0, 1.0, 2.0].map(|x| fold.in_space(DVec2::new(x, 0.0)));
        assert!(((left - edge).angle_between(right - edge).to_degrees() - 120.0).abs() < 1e-9);
    }
}
