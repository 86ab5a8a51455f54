//! Motions of devices that are held out: they last until the device is let go. Pure: no device, no clock.

use glam::{DVec2, DVec3};

use super::navigator::{Drag, Nudge};

/// At its fullest, the model is dragged by this part of the canvas's height in a second, to turn it or to move it…
const DRAG_PER_SECOND: f64 = 0.6;
/// …comes nearer by this factor…
const NEARER_PER_SECOND: f64 = 3.0;
/// …and rolls by this angle.
const ROLL_PER_SECOND: f64 = std::f64::consts::FRAC_PI_2;

/// Speeds as parts of the fullest, from −1 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Drive {
    /// Flies to the right, up and forward.
    pub(crate) fly: DVec3,
    /// Moves the model to the right and up.
    pub(crate) pan: DVec2,
    /// Turns the model's front to the right and up.
    pub(crate) orbit: DVec2,
    /// Brings the model nearer.
    pub(crate) nearer: f64,
    /// Turns the picture to the left.
    pub(crate) roll: f64,
}

impl Drive {
    /// Whether nothing is held out.
    pub(crate) fn is_rest(&self) -> bool {
        *self == Self::default()
    }

    /// Both at once, no faster than the fullest. Speeds that are no numbers are none.
    pub(crate) fn with(self, other: Self) -> Self {
        let sum = |a: f64, b: f64| if (a + b).is_finite() { (a + b).clamp(-1.0, 1.0) } else { 0.0 };
        let sum2 = |a: DVec2, b: DVec2| DVec2::new(sum(a.x, b.x), sum(a.y, b.y));
        Self {
            fly: DVec3::new(sum(self.fly.x, other.fly.x), sum(self.fly.y, other.fly.y), sum(self.fly.z, other.fly.z)),
            pan: sum2(self.pan, other.pan),
            orbit: sum2(self.orbit, other.orbit),
            nearer: sum(self.nearer, other.nearer),
            roll: sum(self.roll, other.roll),
        }
    }

    /// What it does in some seconds on a canvas with this aspect (width over height), beside flying.
    pub(crate) fn nudges(self, seconds: f64, aspect: f64) -> impl Iterator<Item = Nudge> {
        let heights = DVec2::new(1.0 / aspect, 1.0) * (DRAG_PER_SECOND * seconds);
        let nearer = (self.nearer != 0.0)
            .then(|| Nudge::Dolly { factor: NEARER_PER_SECOND.powf(-self.nearer * seconds), at: DVec2::splat(0.5) });
        let roll = (self.roll != 0.0).then_some(Nudge::Roll(self.roll * ROLL_PER_SECOND * seconds));
        let drag = |drag, by: DVec2| (by != DVec2::ZERO).then_some(Nudge::Drag(drag, by));
        let drags = [drag(Drag::Orbit, self.orbit * heights), drag(Drag::Pan, self.pan * heights)];
        drags.into_iter().flatten().chain(nearer).chain(roll)
    }
}

/// The speed of a stick or cap that is held out by `deflection`, from −1 to 1: none within the dead zone, in which devices
/// come to rest, then slowly at first. What is no number is rest.
pub(crate) fn speed(deflection: f64, dead_zone: f64) -> f64 {
    // Unlike `min`, `clamp` keeps what is no number.
    let beyond = ((deflection.abs().clamp(0.0, 1.0) - dead_zone) / (1.0 - dead_zone)).max(0.0);
    (beyond * beyond).copysign(deflection)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speeds_grow_from_the_dead_zone_to_the_fullest() {
        assert_eq!([0.0, 0.1, -0.1].map(|deflection| speed(deflection, 0.1).abs()), [0.0; 3]);
        assert_eq!([1.0, -1.0, 7.0].map(|deflection| speed(deflection, 0.1)), [1.0, -1.0, 1.0]);
        let speeds: Vec<_> = (0..=100).map(|percent| speed(f64::from(percent) / 100.0, 0.1)).collect();
        assert!(speeds.is_sorted() && speeds[50] < 0.5, "{speeds:?}");
        assert_eq!(speed(f64::NAN, 0.1).abs(), 0.0);
    }

    #[test]
    fn two_devices_are_no_faster_than_one_and_nonsense_is_at_rest() {
        let one = Drive { orbit: DVec2::new(0.7, f64::NAN), fly: DVec3::X, ..Drive::default() };
        let both = one.with(one);
        assert_eq!((both.orbit, both.fly), (DVec2::X, DVec3::X));
        assert!(Drive { roll: f64::INFINITY, ..Drive::default() }.with(Drive::default()).is_rest());
    }
}
