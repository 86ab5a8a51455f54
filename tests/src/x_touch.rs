//! A touch screen that tests touch: Xorg with its own driver for tests, which takes events from a socket.

use std::{
    io::{Read, Write},
    os::unix::net::UnixStream,
    path::Path,
};

use tempfile::TempDir;

use crate::{
    x_monitors::{self, Monitor},
    x_session::XSession,
};

/// Attaches the touch screen, whose socket takes the place of `SOCKET`.
const CONFIG: &str = r#"
Section "InputDevice"
    Identifier "fingers"
    Driver "inputtest"
    Option "SocketPath" "SOCKET"
    Option "DeviceType" "Touch"
    Option "TouchCount" "10"
EndSection
Section "ServerLayout"
    Identifier "desk"
    Screen "desktop"
    InputDevice "fingers"
EndSection
"#;

/// Numbers of the driver's protocol, `xf86-input-inputtest-protocol.h` of the X server.
const CLIENT_VERSION: u32 = 0;
const WAIT_FOR_SYNC: u32 = 1;
const TOUCH: u32 = 6;
/// Axes that an event has room for.
const N_VALUATORS: usize = 64;

/// The driver's number at the right and the lower edge of the desktop.
const LARGEST_VALUE: f64 = 65_535.0;

/// What a finger does, by X's numbers of events.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Finger {
    Begin = 18,
    Update = 19,
    End = 20,
}

/// The fingers on a touch screen.
pub(crate) struct Fingers {
    driver: UnixStream,
    /// Of the desktop, in pixels.
    size: [u16; 2],
    _folder: TempDir,
}

impl Fingers {
    /// Starts a desktop of one monitor that can be touched. `None` where the X server has no driver for tests.
    pub(crate) fn start(size: [u16; 2]) -> Option<(XSession, Self)> {
        if !["/usr/lib/xorg", "/usr/lib64/xorg"]
            .iter()
            .any(|at| Path::new(at).join("modules/input/inputtest_drv.so").exists())
        {
            println!("skipped: this X server has no driver inputtest");
            return None;
        }
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("fingers");
        let config = CONFIG.replace("SOCKET", &socket.to_string_lossy());
        let session = x_monitors::start_with(&[Monitor { name: "DUMMY0", at: [0, 0], size }], &config);
        let mut driver = UnixStream::connect(socket).expect("the driver listens");
        let version = [1_u16, 1].map(u16::to_ne_bytes).concat();
        send(&mut driver, CLIENT_VERSION, &version);
        let mut answer = [0; 12];
        driver.read_exact(&mut answer).expect("the driver answers");
        Some((session, Self { driver, size, _folder: folder }))
    }

    /// Has a finger do something at a pixel of the desktop, and waits until the X server has taken it.
    pub(crate) fn touch(&mut self, number: u32, finger: Finger, at: [f64; 2]) {
        let mut valuators = [0.0; 2 * N_VALUATORS];
        for axis in 0..2 {
            valuators[axis] = at[axis] * LARGEST_VALUE / f64::from(self.size[axis]);
        }
        let head = [number, finger as u32, 0].map(u32::to_ne_bytes).concat();
        // The first two axes are given; then room until the next double.
        let mask = [3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        let body = [head, mask.to_vec(), valuators.map(f64::to_ne_bytes).concat()].concat();
        send(&mut self.driver, TOUCH, &body);
        send(&mut self.driver, WAIT_FOR_SYNC, &[]);
        self.driver.read_exact(&mut [0; 8]).expect("the driver answers");
    }

    /// Moves fingers from points to others, in steps as hands do.
    pub(crate) fn drag<const N: usize>(&mut self, from: [[f64; 2]; N], to: [[f64; 2]; N]) {
        const STEPS: u32 = 8;
        let at = |finger: usize, step: u32| {
            [0, 1].map(|axis: usize| {
                let part = f64::from(step) / f64::from(STEPS);
                from[finger][axis] + (to[finger][axis] - from[finger][axis]) * part
            })
        };
        for finger in 0..N {
            self.touch(finger as u32, Finger::Begin, at(finger, 0));
        }
        for step in 1..=STEPS {
            for finger in 0..N {
                self.touch(finger as u32, Finger::Update, at(finger, step));
            }
        }
        for finger in 0..N {
            self.touch(finger as u32, Finger::End, at(finger, STEPS));
        }
    }

    pub(crate) fn tap(&mut self, at: [f64; 2]) {
        self.touch(0, Finger::Begin, at);
        self.touch(0, Finger::End, at);
    }
}

fn send(driver: &mut UnixStream, kind: u32, body: &[u8]) {
    let length = 8 + body.len() as u32;
    let message = [&length.to_ne_bytes()[..], &kind.to_ne_bytes(), body].concat();
    driver.write_all(&message).expect("the driver listens");
}
