//! A test's own screen: Xvfb with the window manager openbox, driven by xdotool.
//!
//! Without a window manager, fullscreen is ignored and keys are lost.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use x11rb::{
    connection::Connection,
    protocol::{
        screensaver::{ConnectionExt as _, State},
        xproto::{Blanking, ConnectionExt as _, Exposures},
    },
    wrapper::ConnectionExt as _,
};

use crate::process::{GENEROUS, Program, wait_until};

/// Logged for each frame on screen.
pub(crate) const SHOWN: &str = "is on screen";

/// A running X server and its window manager; dropping it ends both.
pub(crate) struct XSession {
    display: String,
    size: [usize; 2],
    _window_manager: Ending,
    _server: Ending,
}

/// The screen's content: R, G, B of each pixel, row by row from the top left.
#[derive(Clone, PartialEq, Eq)]
pub(crate) struct Screenshot {
    pub(crate) size: [usize; 2],
    pub(crate) rgb: Vec<u8>,
}

impl XSession {
    /// A screen of `size` pixels on a free display.
    pub(crate) fn start(size: [usize; 2]) -> Self {
        let mut server = Command::new("Xvfb");
        server.args(["-screen", "0", &format!("{}x{}x24", size[0], size[1])]);
        Self::start_on(server, size, &|_| {})
    }

    /// Like `start`, on another X server; `prepare` gets its display before the window manager starts.
    pub(crate) fn start_on(mut server: Command, size: [usize; 2], prepare: &dyn Fn(&str)) -> Self {
        let name = server.get_program().to_string_lossy().into_owned();
        // Without -noreset the server resets and closes all connections whenever its last client leaves.
        let mut server = server
            .args(["-displayfd", "1", "-nolisten", "tcp", "-noreset"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|error| missing(&name, &error));
        let mut number = String::new();
        let stdout = server.stdout.take().expect("piped above");
        let server = Ending(server);
        BufReader::new(stdout).read_line(&mut number).expect("the server says its display's number");
        let display = format!(":{}", number.trim());
        prepare(&display);
        let window_manager = Command::new("openbox")
            .env("DISPLAY", &display)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|error| missing("openbox", &error));
        let session = Self { display, size, _window_manager: Ending(window_manager), _server: server };
        // Only a window manager answers this.
        wait_until("the window manager runs", || session.try_xdotool(&["get_desktop"]).is_some());
        session
    }

    /// The command for a wall on this screen, which logs each frame that it shows.
    pub(crate) fn wall(&self, arguments: &[&str]) -> Command {
        let mut command = Program::command("compositor");
        // Pictures at rest are compared: ambient occlusion would keep a busy machine waiting.
        command.args(["--listen", "127.0.0.1:0", "--rays", "primary"]).args(arguments);
        command.env("DISPLAY", &self.display).env_remove("WAYLAND_DISPLAY").env("RUST_LOG", "info,compositor=debug");
        command
    }

    /// The value of `DISPLAY` for programs on this screen.
    pub(crate) fn display(&self) -> &str {
        &self.display
    }

    /// Runs xdotool; returns its output.
    pub(crate) fn xdotool(&self, arguments: &[&str]) -> String {
        self.try_xdotool(arguments).unwrap_or_else(|| panic!("xdotool {arguments:?} failed"))
    }

    /// Waits for a window with this in its title, gives it the keyboard, and returns its number.
    pub(crate) fn wait_for_window(&self, title: &str) -> String {
        let mut window = String::new();
        wait_until(&format!("a window \"{title}\" opens"), || {
            let found = self.try_xdotool(&["search", "--onlyvisible", "--name", title]).unwrap_or_default();
            window = found.lines().last().unwrap_or_default().to_owned();
            !window.is_empty()
        });
        self.xdotool(&["windowactivate", "--sync", &window]);
        window
    }

    /// Presses and releases keys, by xdotool's names.
    pub(crate) fn key(&self, key: &str) {
        self.xdotool(&["key", key]);
    }

    /// Drags from a point of the screen by some pixels, in steps as a hand does.
    pub(crate) fn drag(&self, from: [i32; 2], by: [i32; 2]) {
        const STEPS: i32 = 10;
        let at = |step: i32| [0, 1].map(|axis: usize| (from[axis] + by[axis] * step / STEPS).to_string());
        let [x, y] = at(0);
        self.xdotool(&["mousemove", &x, &y, "mousedown", "1"]);
        for step in 1..=STEPS {
            let [x, y] = at(step);
            self.xdotool(&["mousemove", &x, &y]);
        }
        self.xdotool(&["mouseup", "1"]);
    }

    /// Left, top, width and height of a window on the screen.
    pub(crate) fn geometry(&self, window: &str) -> [i32; 4] {
        let shell = self.xdotool(&["getwindowgeometry", "--shell", window]);
        let value = |name: &str| {
            let line = shell.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix('='));
            line.and_then(|value| value.parse().ok()).unwrap_or_else(|| panic!("no {name} in {shell}"))
        };
        ["X", "Y", "WIDTH", "HEIGHT"].map(value)
    }

    /// The screen's content now.
    pub(crate) fn screenshot(&self) -> Screenshot {
        let output = Command::new("import")
            .args(["-display", &self.display, "-window", "root", "-depth", "8", "rgb:-"])
            .output()
            .unwrap_or_else(|error| missing("import", &error));
        let expected = 3 * self.size[0] * self.size[1];
        assert_eq!(output.stdout.len(), expected, "import: {}", String::from_utf8_lossy(&output.stderr));
        Screenshot { size: self.size, rgb: output.stdout }
    }

    /// The screen's content once it stays the same for 900 ms, because a busy machine may delay a frame.
    pub(crate) fn steady_screenshot(&self) -> Screenshot {
        let start = Instant::now();
        let mut before = self.screenshot();
        let mut n_same = 0;
        while n_same < 3 {
            thread::sleep(Duration::from_millis(300));
            let now = self.screenshot();
            n_same = if now == before { n_same + 1 } else { 0 };
            assert!(start.elapsed() < GENEROUS, "the screen never comes to rest");
            before = now;
        }
        before
    }

    /// Makes the screensaver start after a second without keys and mouse.
    pub(crate) fn make_screensaver_impatient(&self) {
        let (connection, _) = x11rb::connect(Some(&self.display)).expect("the X server runs");
        connection.set_screen_saver(1, 0, Blanking::PREFERRED, Exposures::ALLOWED).expect("sent");
        connection.sync().expect("the X server runs");
    }

    /// Whether the screensaver has started.
    pub(crate) fn screensaver_is_on(&self) -> bool {
        let (connection, screen) = x11rb::connect(Some(&self.display)).expect("the X server runs");
        let root = connection.setup().roots[screen].root;
        let info = connection.screensaver_query_info(root).expect("sent").reply().expect("Xvfb has a screensaver");
        State::from(info.state) == State::ON
    }

    fn try_xdotool(&self, arguments: &[&str]) -> Option<String> {
        let output = Command::new("xdotool")
            .env("DISPLAY", &self.display)
            .args(arguments)
            .output()
            .unwrap_or_else(|error| missing("xdotool", &error));
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

impl Screenshot {
    /// The part of `size` columns and rows from column `left` and row `top`.
    pub(crate) fn part(&self, [left, top]: [usize; 2], size: [usize; 2]) -> Self {
        let rows = self.rgb.chunks_exact(3 * self.size[0]).skip(top).take(size[1]);
        Self { size, rgb: rows.flat_map(|row| &row[3 * left..3 * (left + size[0])]).copied().collect() }
    }

    /// The fraction of pixels with a channel that differs by more than `tolerance`.
    pub(crate) fn difference(&self, other: &Self, tolerance: u8) -> f64 {
        assert_eq!(self.size, other.size);
        let (a, b) = (self.rgb.as_chunks::<3>().0, other.rgb.as_chunks::<3>().0);
        let differs = |(a, b): &(&[u8; 3], &[u8; 3])| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > tolerance);
        a.iter().zip(b).filter(differs).count() as f64 / a.len() as f64
    }

    /// The fraction of pixels whose channels are all brighter than `least`: those of a lit model.
    pub(crate) fn brighter_than(&self, least: u8) -> f64 {
        let pixels = self.rgb.as_chunks::<3>().0;
        pixels.iter().filter(|pixel| pixel.iter().all(|&channel| channel > least)).count() as f64 / pixels.len() as f64
    }
}

/// A child process; dropping it kills it.
struct Ending(Child);

impl Drop for Ending {
    fn drop(&mut self) {
        // Fails if it has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn missing(program: &str, error: &std::io::Error) -> ! {
    panic!("{program} does not start ({error}); `make test` installs it: apt install xvfb openbox xdotool imagemagick")
}
