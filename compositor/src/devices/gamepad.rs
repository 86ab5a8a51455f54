//! Gamepads: sticks fly and turn, buttons give commands.

use std::{collections::HashMap, thread};

use gilrs::{Axis, Button, Event, EventType, GilrsBuilder};
use glam::{DVec2, DVec3};
use shared::printable::printable_line;

use super::{Link, Order, Source};
use crate::control::{
    drive::{Drive, speed},
    input::Command,
};

/// Worn sticks come to rest this far from their middle.
const DEAD_ZONE: f64 = 0.15;

/// Where a gamepad's sticks and triggers are: right and up are positive, and a trigger that is pulled is 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Sticks {
    left: DVec2,
    right: DVec2,
    left_trigger: f64,
    right_trigger: f64,
}

/// Starts a thread that waits for gamepads and follows them to the end of the process.
///
/// # Errors
/// The system starts no thread.
pub(super) fn start(link: Link) -> std::io::Result<()> {
    thread::Builder::new().name("gamepads".to_owned()).spawn(move || follow(&link)).map(drop)
}

fn follow(link: &Link) {
    // Force feedback has a thread that wakes twenty times a second.
    let mut gamepads = match GilrsBuilder::new().with_force_feedback(false).build() {
        Ok(gamepads) => gamepads,
        Err(error) => return tracing::debug!("no gamepads: {error}"),
    };
    for (_, gamepad) in gamepads.gamepads() {
        tracing::info!("the gamepad {} steers", printable_line(gamepad.name()));
    }
    let mut pads = Pads::default();
    while let Some(Event { id, event, .. }) = gamepads.next_event_blocking(None) {
        let name = || printable_line(gamepads.gamepad(id).name());
        let said = match event {
            EventType::Connected => {
                tracing::info!("the gamepad {} steers", name());
                continue;
            }
            EventType::Disconnected => {
                tracing::info!("the gamepad {} is gone", name());
                Said::Gone
            }
            EventType::ButtonPressed(button, _) => Said::Pressed(button),
            EventType::ButtonChanged(button, value, _) => Said::Pulled(button, value.into()),
            EventType::AxisChanged(axis, value, _) => Said::Moved(axis, value.into()),
            _ => continue,
        };
        let id = usize::from(id);
        if let Some(drive) = pads.take(id, said) {
            link.drive(Source::Gamepad(id), drive);
        }
        if let Said::Pressed(button) = said {
            command(button).into_iter().for_each(|command| _ = link.order(Order::Press(command)));
        }
    }
    tracing::debug!("gamepads are no longer followed");
}

/// What a gamepad says.
#[derive(Clone, Copy, Debug)]
enum Said {
    Pressed(Button),
    /// A button that can be pulled more or less, from 0 to 1.
    Pulled(Button, f64),
    /// A stick's axis, from −1 to 1.
    Moved(Axis, f64),
    Gone,
}

/// All gamepads, by number.
#[derive(Debug, Default)]
struct Pads(HashMap<usize, Sticks>);

impl Pads {
    /// Takes what a gamepad says; returns how it drives from then on, if that may have changed.
    fn take(&mut self, id: usize, said: Said) -> Option<Drive> {
        match said {
            Said::Pressed(_) => return None,
            Said::Pulled(button, value) => self.0.entry(id).or_default().pull(button, value),
            Said::Moved(axis, value) => self.0.entry(id).or_default().move_axis(axis, value),
            Said::Gone => _ = self.0.remove(&id),
        }
        Some(self.0.get(&id).map(Sticks::drive).unwrap_or_default())
    }
}

impl Sticks {
    fn move_axis(&mut self, axis: Axis, value: f64) {
        match axis {
            Axis::LeftStickX => self.left.x = value,
            Axis::LeftStickY => self.left.y = value,
            Axis::RightStickX => self.right.x = value,
            Axis::RightStickY => self.right.y = value,
            _ => {}
        }
    }

    fn pull(&mut self, button: Button, value: f64) {
        match button {
            Button::LeftTrigger2 => self.left_trigger = value,
            Button::RightTrigger2 => self.right_trigger = value,
            _ => {}
        }
    }

    fn drive(&self) -> Drive {
        let stick = |stick: DVec2| DVec2::new(speed(stick.x, DEAD_ZONE), speed(stick.y, DEAD_ZONE));
        let up = speed(self.right_trigger, DEAD_ZONE) - speed(self.left_trigger, DEAD_ZONE);
        let left = stick(self.left);
        Drive { fly: DVec3::new(left.x, up, left.y), orbit: stick(self.right), ..Drive::default() }
    }
}

fn command(button: Button) -> Option<Command> {
    match button {
        Button::South => Some(Command::GoToMiddle),
        Button::North => Some(Command::ViewAll),
        Button::Start => Some(Command::TogglePlaying),
        Button::LeftTrigger => Some(Command::PreviousScene),
        Button::RightTrigger => Some(Command::NextScene),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_left_stick_flies_and_the_right_one_turns_the_model() {
        let mut sticks = Sticks::default();
        assert!(sticks.drive().is_rest());
        sticks.move_axis(Axis::LeftStickY, 1.0);
        sticks.move_axis(Axis::RightStickX, -1.0);
        sticks.pull(Button::RightTrigger2, 1.0);
        let drive = sticks.drive();
        assert_eq!((drive.fly, drive.orbit), (DVec3::new(0.0, 1.0, 1.0), DVec2::NEG_X));
        for (axis, value) in [(Axis::LeftStickY, 0.1), (Axis::RightStickX, -0.14), (Axis::DPadX, 1.0)] {
            sticks.move_axis(axis, value);
        }
        sticks.pull(Button::LeftTrigger2, 1.0);
        sticks.pull(Button::South, 1.0);
        assert!(sticks.drive().is_rest(), "worn sticks come to rest, and both triggers are none");
    }

    #[test]
    fn a_gamepad_that_is_pulled_out_stops_its_motion_and_no_other() {
        let mut pads = Pads::default();
        let left = Said::Moved(Axis::LeftStickX, 1.0);
        let flying = Drive { fly: DVec3::X, ..Drive::default() };
        assert_eq!([pads.take(0, left), pads.take(1, left)], [Some(flying); 2]);
        assert_eq!(pads.take(0, Said::Gone), Some(Drive::default()));
        assert_eq!(pads.take(1, Said::Pressed(Button::South)), None);
        let both = pads.take(1, Said::Pulled(Button::RightTrigger2, 1.0)).expect("it is there");
        assert_eq!(both.fly, DVec3::new(1.0, 1.0, 0.0));
        // Plugged in again, it is at rest.
        assert_eq!(pads.take(0, Said::Moved(Axis::LeftStickX, 0.0)), Some(Drive::default()));
    }

    #[test]
    fn every_button_that_visitors_may_press_steers() {
        let commands = [Button::South, Button::North, Button::Start].map(|button| command(button).expect("a command"));
        assert!(commands.into_iter().all(|command| command.is_steering() && command.is_for_visitors()));
        assert_eq!(command(Button::RightTrigger), Some(Command::NextScene));
        assert_eq!(command(Button::Unknown), None);
    }
}
