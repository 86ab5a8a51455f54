//! Gamepads: sticks fly and turn, buttons give commands.

use std::{collections::HashMap, thread};

use gilrs::{Axis, Button, Event, EventType, GamepadId, Gilrs};
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
    let mut gamepads = match Gilrs::new() {
        Ok(gamepads) => gamepads,
        Err(error) => return tracing::debug!("no gamepads: {error}"),
    };
    for (_, gamepad) in gamepads.gamepads() {
        tracing::info!("the gamepad {} steers", printable_line(gamepad.name()));
    }
    let mut sticks: HashMap<GamepadId, Sticks> = HashMap::new();
    while let Some(Event { id, event, .. }) = gamepads.next_event_blocking(None) {
        let name = || printable_line(gamepads.gamepad(id).name());
        let source = Source::Gamepad(id.into());
        match event {
            EventType::Connected => tracing::info!("the gamepad {} steers", name()),
            EventType::Disconnected => {
                tracing::info!("the gamepad {} is gone", name());
                sticks.remove(&id);
                link.drive(source, Drive::default());
            }
            EventType::ButtonPressed(button, _) => {
                command(button).into_iter().for_each(|command| _ = link.order(Order::Press(command)));
            }
            EventType::AxisChanged(axis, value, _) => {
                let sticks = sticks.entry(id).or_default();
                sticks.move_axis(axis, value.into());
                link.drive(source, sticks.drive());
            }
            EventType::ButtonChanged(button, value, _) => {
                let sticks = sticks.entry(id).or_default();
                sticks.pull(button, value.into());
                link.drive(source, sticks.drive());
            }
            _ => {}
        }
    }
    tracing::debug!("gamepads are no longer followed");
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
    fn every_button_that_visitors_may_press_steers() {
        let commands = [Button::South, Button::North, Button::Start].map(|button| command(button).expect("a command"));
        assert!(commands.into_iter().all(|command| command.is_steering() && command.is_for_visitors()));
        assert_eq!(command(Button::RightTrigger), Some(Command::NextScene));
        assert_eq!(command(Button::Unknown), None);
    }
}
