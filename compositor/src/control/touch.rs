//! Fingers on the wall's screens: one orbits, two pan, pinch and twist, as on the remote's page; a tap clicks. Pure: no
//! window, no clock.

use std::time::{Duration, Instant};

use glam::DVec2;

use super::navigator::{Drag, Nudge};

/// The number of a finger, and of the window on which it lies.
pub(crate) type FingerId = (usize, u64);

/// A finger that moves less than this part of the canvas's height, and lifts before [`TAP`], taps.
const TAP_DISTANCE: f64 = 0.015;
const TAP: Duration = Duration::from_millis(350);
/// The longest time between the taps of a double tap, and their largest distance as a part of the canvas's height: fingers
/// hit less exactly than a mouse.
const DOUBLE_TAP: (Duration, f64) = (Duration::from_millis(500), 0.05);
/// Two fingers roll the picture from this angle on, so that a pinch alone keeps it upright.
const TWIST: f64 = 8.0 * std::f64::consts::PI / 180.0;
/// Fingers nearer to each other than this part of the canvas's height neither pinch nor twist.
const NEAREST: f64 = 1e-3;
/// The largest change of distance by one event, and one over the smallest.
const LARGEST_FACTOR: f64 = 20.0;
/// Fingers that are followed; two hands have ten.
const MOST_FINGERS: usize = 16;

/// A finger touched the wall and lifted again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tap {
    /// Where, as a fraction of the canvas, (0, 0) lower left.
    pub(crate) at: DVec2,
    /// Whether it is the second of a double tap.
    pub(crate) is_double: bool,
}

/// The fingers that lie on the wall.
///
/// Points are fractions of the canvas's width and height, (0, 0) lower left.
#[derive(Clone, Debug)]
pub(crate) struct Touches {
    /// Width over height of the canvas.
    aspect: f64,
    fingers: Vec<(FingerId, DVec2)>,
    /// When and where the only finger came down, until it moves away or another comes.
    pressed: Option<(Instant, DVec2)>,
    /// How far two fingers have turned, to the left in radians.
    twist: f64,
    is_twisting: bool,
    /// The last single tap.
    tapped: Option<(Instant, DVec2)>,
}

impl Touches {
    pub(crate) fn new(aspect: f64) -> Self {
        Self { aspect, fingers: Vec::new(), pressed: None, twist: 0.0, is_twisting: false, tapped: None }
    }

    pub(crate) fn has(&self, finger: FingerId) -> bool {
        self.fingers.iter().any(|(id, _)| *id == finger)
    }

    /// A finger comes down.
    pub(crate) fn down(&mut self, finger: FingerId, at: DVec2, now: Instant) {
        self.lift(finger);
        if self.fingers.len() == MOST_FINGERS || !at.is_finite() {
            return;
        }
        self.fingers.push((finger, at));
        self.pressed = (self.fingers.len() == 1).then_some((now, at));
    }

    /// A finger moves; returns what that does to the camera, in order.
    pub(crate) fn move_to(&mut self, finger: FingerId, at: DVec2) -> Vec<Nudge> {
        let Some(index) = self.fingers.iter().position(|(id, _)| *id == finger).filter(|_| at.is_finite()) else {
            return Vec::new();
        };
        // A finger that trembles still taps, and where it leaves for good the whole way counts.
        if self.pressed.is_some_and(|(_, from)| self.distance(from, at) <= TAP_DISTANCE) {
            return Vec::new();
        }
        self.pressed = None;
        let from = std::mem::replace(&mut self.fingers[index].1, at);
        let drag = |drag, by: DVec2| (by != DVec2::ZERO).then_some(Nudge::Drag(drag, by));
        match self.fingers[..] {
            [_] => drag(Drag::Orbit, at - from).into_iter().collect(),
            [(_, first), (_, second)] => {
                let other = if index == 0 { second } else { first };
                let mut nudges = self.pinch(from, at, other);
                nudges.extend(drag(Drag::Pan, (at - from) / 2.0));
                nudges
            }
            _ => Vec::new(),
        }
    }

    /// A finger lifts; returns its tap, if it is one.
    pub(crate) fn up(&mut self, finger: FingerId, now: Instant) -> Option<Tap> {
        let (pressed_at, at) = self.pressed.filter(|_| self.has(finger)).unzip();
        self.lift(finger);
        let at = at.filter(|_| pressed_at.is_some_and(|pressed_at| now.duration_since(pressed_at) < TAP))?;
        let is_double = self.tapped.is_some_and(|(tapped_at, place)| {
            now.duration_since(tapped_at) <= DOUBLE_TAP.0 && self.distance(at, place) <= DOUBLE_TAP.1
        });
        self.tapped = (!is_double).then_some((now, at));
        Some(Tap { at, is_double })
    }

    /// A finger is gone, and did nothing more.
    pub(crate) fn lift(&mut self, finger: FingerId) {
        self.fingers.retain(|(id, _)| *id != finger);
        (self.pressed, self.twist, self.is_twisting) = (None, 0.0, false);
    }

    /// All fingers are gone, as when the window loses the focus.
    pub(crate) fn lift_all(&mut self) {
        self.fingers.clear();
        self.pressed = None;
    }

    /// Two fingers: their distance comes nearer, their angle rolls.
    fn pinch(&mut self, from: DVec2, to: DVec2, other: DVec2) -> Vec<Nudge> {
        let [before, after] = [from, to].map(|at| (at - other) * DVec2::new(self.aspect, 1.0));
        if before.length() < NEAREST || after.length() < NEAREST {
            return Vec::new();
        }
        let factor = (before.length() / after.length()).clamp(1.0 / LARGEST_FACTOR, LARGEST_FACTOR);
        let at = ((to + other) / 2.0).clamp(DVec2::ZERO, DVec2::ONE);
        let angle = before.angle_to(after);
        self.twist += angle;
        self.is_twisting |= self.twist.abs() > TWIST;
        let dolly = (factor != 1.0).then_some(Nudge::Dolly { factor, at });
        let roll = (self.is_twisting && angle != 0.0).then_some(Nudge::Roll(angle));
        dolly.into_iter().chain(roll).collect()
    }

    /// In heights of the canvas.
    fn distance(&self, a: DVec2, b: DVec2) -> f64 {
        ((a - b) * DVec2::new(self.aspect, 1.0)).length()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ASPECT: f64 = 2.0;
    const A: FingerId = (0, 7);
    const B: FingerId = (0, 8);

    fn at(x: f64, y: f64) -> DVec2 {
        DVec2::new(x, y)
    }

    fn later(start: Instant, milliseconds: u64) -> Instant {
        start + Duration::from_millis(milliseconds)
    }

    #[test]
    fn one_finger_orbits_by_its_whole_way() {
        let (mut touches, now) = (Touches::new(ASPECT), Instant::now());
        touches.down(A, at(0.5, 0.5), now);
        assert_eq!(touches.move_to(A, at(0.505, 0.5)), [], "it may still tap");
        assert_eq!(touches.move_to(A, at(0.55, 0.5)), [Nudge::Drag(Drag::Orbit, at(0.55, 0.5) - at(0.5, 0.5))]);
        assert_eq!(touches.move_to(A, at(0.55, 0.5)), [], "it rests");
        assert_eq!(touches.move_to(B, at(0.9, 0.9)), [], "it never came down");
        assert_eq!(touches.up(A, later(now, 100)), None, "a drag is no tap");
        assert_eq!(touches.move_to(A, at(0.1, 0.1)), []);
    }

    #[test]
    fn two_fingers_pan_and_what_lies_under_them_stays_there() {
        let (mut touches, now) = (Touches::new(ASPECT), Instant::now());
        touches.down(A, at(0.4, 0.5), now);
        touches.down(B, at(0.6, 0.5), now);
        // To the right by 0.1, one after the other.
        let first = touches.move_to(B, at(0.7, 0.5));
        let second = touches.move_to(A, at(0.5, 0.5));
        let all = [first, second].concat();
        let pan = |nudge: &Nudge| if let Nudge::Drag(Drag::Pan, by) = nudge { *by } else { DVec2::ZERO };
        let panned: DVec2 = all.iter().map(pan).sum();
        assert!((panned - at(0.1, 0.0)).length() < 1e-12, "{all:?}");
        let factor = |nudge: &Nudge| if let Nudge::Dolly { factor, .. } = nudge { *factor } else { 1.0 };
        let nearer: f64 = all.iter().map(factor).product();
        assert!((nearer - 1.0).abs() < 1e-12, "as far as before: {all:?}");
        assert!(!all.iter().any(|nudge| matches!(nudge, Nudge::Roll(_))), "{all:?}");
        assert_eq!(touches.up(A, later(now, 50)), None, "two fingers do not tap");
        // The finger that stays orbits.
        assert_eq!(touches.move_to(B, at(0.7, 0.6)), [Nudge::Drag(Drag::Orbit, at(0.7, 0.6) - at(0.7, 0.5))]);
    }

    #[test]
    fn fingers_that_part_come_nearer_to_what_is_between_them() {
        let (mut touches, now) = (Touches::new(ASPECT), Instant::now());
        touches.down(A, at(0.4, 0.5), now);
        touches.down(B, at(0.5, 0.5), now);
        let nudges = touches.move_to(B, at(0.6, 0.5));
        assert_eq!(nudges.len(), 2, "{nudges:?}");
        let Nudge::Dolly { factor, at: middle } = nudges[0] else { panic!("{nudges:?}") };
        assert!((factor - 0.5).abs() < 1e-12 && (middle - at(0.5, 0.5)).length() < 1e-12);
        // All at once, and onto each other: bounded.
        let nudges = touches.move_to(B, at(0.4 + 1e-9, 0.5));
        assert!(matches!(nudges[..], [Nudge::Drag(Drag::Pan, _)]), "{nudges:?}");
        assert_eq!(touches.move_to(B, DVec2::NAN), []);
    }

    #[test]
    fn a_twist_rolls_to_the_left_once_it_is_meant() {
        let (mut touches, now) = (Touches::new(ASPECT), Instant::now());
        let around = |degrees: f64| {
            let (sin, cos) = degrees.to_radians().sin_cos();
            at(0.5 + 0.2 * cos / ASPECT, 0.5 + 0.2 * sin)
        };
        touches.down(A, at(0.5, 0.5), now);
        touches.down(B, around(0.0), now);
        let mut rolled = 0.0;
        for degrees in 1..=45 {
            for nudge in touches.move_to(B, around(degrees.into())) {
                if let Nudge::Roll(radians) = nudge {
                    assert!(degrees > 8, "at {degrees} degrees already");
                    rolled += radians.to_degrees();
                }
            }
        }
        assert!((36.0..=38.0).contains(&rolled), "{rolled}");
    }

    #[test]
    fn two_taps_soon_after_each_other_are_a_double_tap() {
        let (mut touches, start) = (Touches::new(ASPECT), Instant::now());
        let mut tap = |x: f64, down_ms, up_ms| {
            touches.down(A, at(x, 0.5), later(start, down_ms));
            touches.move_to(A, at(x + 0.002, 0.5));
            touches.up(A, later(start, up_ms)).map(|tap| (tap.at.x, tap.is_double))
        };
        assert_eq!([tap(0.5, 0, 90), tap(0.51, 200, 290)], [Some((0.5, false)), Some((0.51, true))]);
        assert_eq!(tap(0.51, 400, 490), Some((0.51, false)), "a third begins anew");
        assert_eq!(tap(0.8, 600, 690), Some((0.8, false)), "somewhere else");
        assert_eq!(tap(0.8, 2000, 2400), None, "too long");
        assert_eq!(tap(0.8, 3000, 3090), Some((0.8, false)));
    }

    #[test]
    fn fingers_that_are_taken_away_leave_nothing() {
        let (mut touches, now) = (Touches::new(ASPECT), Instant::now());
        for finger in 0..1000 {
            touches.down((0, finger), at(0.5, 0.5), now);
        }
        assert_eq!(touches.fingers.len(), MOST_FINGERS);
        assert_eq!(touches.move_to((0, 0), at(0.9, 0.9)), [], "a whole hand means nothing");
        touches.lift_all();
        touches.down(A, at(0.5, 0.5), now);
        touches.lift(A);
        assert_eq!(touches.up(A, now), None, "the system took it");
        touches.down(A, at(0.5, 0.5), now);
        assert!(matches!(touches.move_to(A, at(0.6, 0.5))[..], [Nudge::Drag(Drag::Orbit, _)]));
    }
}
