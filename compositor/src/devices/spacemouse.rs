//! SpaceMouse, through spacenavd: the daemon's socket gives 32 bytes an event, in the first version of its protocol, which
//! every later daemon speaks to those who ask for no other.
//!
//! The model follows the cap. spacenavd counts x to the right, y up and z away from the hand; rotations are right-handed
//! about x, y and −z (libspnav, `spnav_posrot_moveobj`).

use std::{path::PathBuf, time::Duration};

use glam::DVec2;
use tokio::{
    io::AsyncReadExt,
    net::UnixStream,
    time::{sleep, timeout},
};

use super::{Link, Order, Source};
use crate::control::{
    drive::{Drive, speed},
    input::Command,
};

/// Bytes of an event: eight numbers.
const EVENT_BYTES: usize = 32;
/// The daemon's numbers of events.
const MOTION: i32 = 0;
const BUTTON_PRESS: i32 = 1;
/// Counts at which a cap is held out as far as it goes.
const FULLEST: f64 = 350.0;
/// The daemon has a dead zone too; this one is for hands that lie on the cap.
const DEAD_ZONE: f64 = 0.05;
/// A cap that is held out speaks many times a second; one that was pulled out says nothing any more.
const SILENCE: Duration = Duration::from_secs(2);
/// The pauses before attempts to find a daemon that is not there, or not yet.
const PAUSES_SECONDS: [u64; 7] = [1, 2, 4, 8, 16, 32, 64];

/// What the daemon says.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Event {
    Motion(Drive),
    Press(i32),
}

/// Follows the daemon, as long as there is one, until it is dropped.
pub(super) async fn listen(link: Link) {
    let path = socket();
    let mut pauses = PAUSES_SECONDS.iter();
    loop {
        match UnixStream::connect(&path).await {
            Ok(stream) => {
                tracing::info!("a SpaceMouse may steer: spacenavd answers at {}", path.display());
                pauses = PAUSES_SECONDS.iter();
                follow(stream, &link).await;
                tracing::info!("spacenavd at {} has ended", path.display());
            }
            Err(error) => tracing::debug!("no SpaceMouse: {}: {error}", path.display()),
        }
        // A wall without a SpaceMouse does nothing in the end.
        let Some(seconds) = pauses.next() else { return };
        sleep(Duration::from_secs(*seconds)).await;
    }
}

fn socket() -> PathBuf {
    std::env::var_os("SPNAV_SOCKET").map_or_else(|| "/var/run/spnav.sock".into(), PathBuf::from)
}

/// Passes on what the daemon says until it ends; then the cap is at rest.
async fn follow(mut stream: UnixStream, link: &Link) {
    let mut bytes = [0; EVENT_BYTES];
    let (mut n_bytes, mut is_held) = (0, false);
    loop {
        let reading = stream.read(&mut bytes[n_bytes..]);
        let read = if is_held { timeout(SILENCE, reading).await } else { Ok(reading.await) };
        match read {
            Err(_) => {
                link.drive(Source::SpaceMouse, Drive::default());
                is_held = false;
                continue;
            }
            Ok(Ok(0) | Err(_)) => break,
            Ok(Ok(n_more)) => n_bytes += n_more,
        }
        if n_bytes < EVENT_BYTES {
            continue;
        }
        n_bytes = 0;
        match decode(&bytes) {
            Some(Event::Motion(drive)) => {
                is_held = !drive.is_rest();
                link.drive(Source::SpaceMouse, drive);
            }
            Some(Event::Press(button)) => {
                command(button).into_iter().for_each(|command| _ = link.order(Order::Press(command)));
            }
            None => {}
        }
    }
    link.drive(Source::SpaceMouse, Drive::default());
}

/// An event; `None` for those that mean nothing here.
fn decode(bytes: &[u8; EVENT_BYTES]) -> Option<Event> {
    let number = |index: usize| {
        let (numbers, _) = bytes.as_chunks::<4>();
        i32::from_ne_bytes(numbers[index])
    };
    match number(0) {
        MOTION => {
            let speed = |index| speed(f64::from(number(index)) / FULLEST, DEAD_ZONE);
            let [x, y, z, rx, ry, rz] = [1, 2, 3, 4, 5, 6].map(speed);
            Some(Event::Motion(Drive {
                pan: DVec2::new(x, y),
                nearer: -z,
                orbit: DVec2::new(ry, -rx),
                roll: -rz,
                ..Drive::default()
            }))
        }
        BUTTON_PRESS => Some(Event::Press(number(1))),
        _ => None,
    }
}

fn command(button: i32) -> Option<Command> {
    match button {
        0 => Some(Command::ViewAll),
        1 => Some(Command::TogglePlaying),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(numbers: [i32; 8]) -> [u8; EVENT_BYTES] {
        let mut bytes = [0; EVENT_BYTES];
        bytes.as_chunks_mut::<4>().0.iter_mut().zip(numbers).for_each(|(to, number)| *to = number.to_ne_bytes());
        bytes
    }

    fn drive(motion: [i32; 6]) -> Drive {
        let [x, y, z, rx, ry, rz] = motion;
        match decode(&event([MOTION, x, y, z, rx, ry, rz, 16])) {
            Some(Event::Motion(drive)) => drive,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_model_follows_the_cap() {
        let all = 350;
        assert_eq!(drive([all, 0, 0, 0, 0, 0]).pan, DVec2::X, "to the right");
        assert_eq!(drive([0, all, 0, 0, 0, 0]).pan, DVec2::Y, "up");
        assert_eq!(drive([0, 0, all, 0, 0, 0]).nearer, -1.0, "pushed away");
        // Tilted towards the hand: the front goes down.
        assert_eq!(drive([0, 0, 0, all, 0, 0]).orbit, DVec2::NEG_Y);
        assert_eq!(
            drive([0, 0, 0, 0, all, 0]).orbit,
            DVec2::X,
            "turned to the left as seen from above: the front to the right"
        );
        assert_eq!(drive([0, 0, 0, 0, 0, all]).roll, -1.0, "tilted to the right");
        assert!(drive([10, -10, 10, -10, 10, -10]).is_rest(), "a hand that lies on it");
        let wild = drive([i32::MAX, i32::MIN, 9999, -9999, 1, 0]);
        assert_eq!((wild.pan, wild.nearer), (DVec2::new(1.0, -1.0), -1.0));
    }

    #[test]
    fn buttons_act_when_they_are_pressed_and_unknown_events_are_nothing() {
        assert_eq!(decode(&event([BUTTON_PRESS, 1, 0, 0, 0, 0, 0, 0])), Some(Event::Press(1)));
        assert_eq!([2, 3, -1, i32::MAX].map(|kind| decode(&event([kind, 0, 0, 0, 0, 0, 0, 0]))), [None; 4]);
        assert_eq!([command(0), command(-1), command(31)], [Some(Command::ViewAll), None, None]);
    }
}
