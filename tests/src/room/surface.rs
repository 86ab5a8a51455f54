//! The shapes of walls in the virtual room, as solids in space: no code of the wall's.
//!
//! Lengths are metres: x is right, y up, z towards the audience. A point of the wall is named by its place on the wall
//! unrolled: metres to the right of the canvas's left edge, and up.

use glam::{DVec2, DVec3};

/// A wall's shape.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Surface {
    /// The plane z = 0.
    Flat,
    /// An upright cylinder around the audience; it touches the plane z = 0 where `x` is the middle.
    Cylinder { middle: f64, radius: f64 },
    /// Two planes that meet at an upright edge, each turned towards the audience from the plane z = 0.
    Fold { middle: f64, turned: f64 },
    /// A part of a sphere around the audience, which touches the plane z = 0 at its middle. Unrolled, places lie as far from
    /// the middle and in the direction in which they do there; or, `by_longitude`, right by longitude and up by latitude.
    Dome { middle: DVec2, radius: f64, by_longitude: bool },
}

impl Surface {
    /// The point in space at a place of the unrolled wall.
    pub(crate) fn in_space(&self, place: DVec2) -> DVec3 {
        match *self {
            Self::Flat => place.extend(0.0),
            Self::Cylinder { middle, radius } => {
                let (sin, cos) = ((place.x - middle) / radius).sin_cos();
                DVec3::new(middle + radius * sin, place.y, radius * (1.0 - cos))
            }
            Self::Fold { middle, turned } => {
                let (sin, cos) = turned.sin_cos();
                let along = place.x - middle;
                DVec3::new(middle + along * cos, place.y, along.abs() * sin)
            }
            Self::Dome { middle, radius, .. } => middle.extend(0.0) + radius * (DVec3::Z - self.normal(place)),
        }
    }

    /// The place where a ray meets the wall first; NaN if it never does.
    pub(crate) fn met(&self, from: DVec3, ray: DVec3) -> DVec2 {
        match *self {
            Self::Flat => (from - from.z / ray.z * ray).truncate(),
            Self::Cylinder { middle, radius } => {
                // Around the axis: x and z alone. From inside, the farther crossing is ahead.
                let (from_axis, along) = (DVec2::new(from.x - middle, from.z - radius), DVec2::new(ray.x, ray.z));
                let (a, b) = (along.length_squared(), from_axis.dot(along));
                let c = from_axis.length_squared() - radius * radius;
                let t = (-b + (b * b - a * c).sqrt()) / a;
                let at = from_axis + t * along;
                DVec2::new(middle + radius * at.x.atan2(-at.y), from.y + t * ray.y)
            }
            Self::Fold { middle, turned } => {
                let (sin, cos) = turned.sin_cos();
                let on_side = |side: f64| {
                    // The plane's normal, and its direction away from the fold.
                    let (normal, away) = (DVec2::new(-side * sin, cos), DVec2::new(side * cos, sin));
                    let from = DVec2::new(from.x - middle, from.z);
                    let t = -normal.dot(from) / normal.dot(DVec2::new(ray.x, ray.z));
                    let along = away.dot(from + t * DVec2::new(ray.x, ray.z));
                    (t > 0.0 && along >= 0.0).then_some((t, side * along))
                };
                let nearest = [on_side(-1.0), on_side(1.0)].into_iter().flatten().min_by(|a, b| a.0.total_cmp(&b.0));
                let (t, along) = nearest.unwrap_or((f64::NAN, f64::NAN));
                DVec2::new(middle + along, from.y + t * ray.y)
            }
            Self::Dome { middle, radius, by_longitude } => {
                // The farther of two crossings is ahead.
                let from_centre = from - middle.extend(radius);
                let nearest = -from_centre.dot(ray) / ray.dot(ray);
                let beside = from_centre + nearest * ray;
                let half = ((radius * radius - beside.length_squared()) / ray.length_squared()).sqrt();
                let at = (beside + half * ray) / radius;
                if by_longitude {
                    return middle + radius * DVec2::new(at.x.atan2(-at.z), at.y.atan2(at.x.hypot(at.z)));
                }
                let angle = at.x.hypot(at.y).atan2(-at.z);
                middle + radius * angle * DVec2::new(at.x, at.y).normalize_or_zero()
            }
        }
    }

    /// The direction from a place straight towards the audience.
    pub(crate) fn normal(&self, place: DVec2) -> DVec3 {
        let angle = match *self {
            Self::Flat => 0.0,
            Self::Cylinder { middle, radius } => (place.x - middle) / radius,
            Self::Fold { middle, turned } if (place.x - middle).abs() > 1e-6 => turned * (place.x - middle).signum(),
            Self::Fold { .. } => 0.0,
            Self::Dome { middle, radius, by_longitude: true } => {
                let [(east, ahead), (up, out)] = ((place - middle) / radius).to_array().map(f64::sin_cos);
                return -DVec3::new(east * out, up, -ahead * out);
            }
            Self::Dome { middle, radius, by_longitude: false } => {
                let away = place - middle;
                let (sin, cos) = (away.length() / radius).sin_cos();
                return -(away.normalize_or_zero() * sin).extend(-cos);
            }
        };
        DVec3::new(-angle.sin(), 0.0, angle.cos())
    }
}

#[test]
fn a_ray_to_a_place_meets_the_wall_there() {
    let walls = [
        Surface::Flat,
        Surface::Cylinder { middle: 1.5, radius: 1.9 },
        Surface::Fold { middle: 1.5, turned: std::f64::consts::FRAC_PI_6 },
        Surface::Dome { middle: DVec2::new(1.5, 0.4), radius: 2.1, by_longitude: false },
        Surface::Dome { middle: DVec2::new(1.5, 0.4), radius: 2.1, by_longitude: true },
    ];
    for surface in walls {
        for n in 0..60 {
            let place = DVec2::new(f64::from(n) * 0.05, f64::from(n % 7) * 0.15);
            let from = DVec3::new(1.2, 0.7, 1.6);
            let met = surface.met(from, surface.in_space(place) - from);
            assert!(met.distance(place) < 1e-9, "{surface:?}: {place} {met}");
            if matches!(surface, Surface::Dome { .. }) {
                // Off its centre by the radius, straight from the audience.
                let off = surface.in_space(place) + 2.1 * surface.normal(place) - DVec3::new(1.5, 0.4, 2.1);
                assert!(off.length() < 1e-9, "{surface:?}: {off}");
                continue;
            }
            // Neighbours on the wall are as far apart in space: it is unrolled without stretching.
            let beside = place + DVec2::new(1e-6, 0.0);
            let stretched = surface.in_space(place).distance(surface.in_space(beside)) / 1e-6;
            assert!((stretched - 1.0).abs() < 1e-5 || (place.x - 1.5).abs() < 1e-5, "{surface:?}: {stretched}");
        }
    }
}
