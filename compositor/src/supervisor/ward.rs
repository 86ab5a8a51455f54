//! The wall's side of its guard.

use std::{
    io::{Read, Write},
    os::{fd::AsFd, unix::net::UnixStream},
    thread,
};

/// Set in the environment of a wall that has a guard.
pub(super) const GUARDED: &str = "RAYWALL_GUARDED";

/// Begins the line that tells of a window.
pub(super) const WINDOW: &str = "window ";
/// The line that tells of the first frame.
pub(super) const SHOWN: &str = "shown";

/// Tells the guard what the wall does.
#[derive(Debug)]
pub struct SupervisorLink {
    guard: UnixStream,
    windows: Vec<u32>,
    has_shown: bool,
}

impl SupervisorLink {
    /// To the guard that started this process, if one did.
    pub fn of_this_process() -> Option<Self> {
        std::env::var_os(GUARDED)?;
        let guard = std::io::stdin().as_fd().try_clone_to_owned().ok()?.into();
        Some(Self { guard, windows: Vec::new(), has_shown: false })
    }

    /// Calls `leave` when the guard wants the wall to end, or has ended itself.
    pub fn on_stop_request(&self, leave: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        let mut guard = self.guard.try_clone()?;
        let wait = move || {
            // It never says a word: what comes is the end.
            let _ = guard.read(&mut [0]);
            leave();
        };
        thread::Builder::new().name("guard".to_owned()).spawn(wait).map(drop)
    }

    /// Has a panic of the main thread end the process at once, as other faults do: the windows it would close on its way
    /// out are what the guard keeps on screen.
    pub fn abort_on_panic(&self) {
        let default_hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            default_hook(panic);
            if thread::current().name() == Some("main") {
                std::process::abort();
            }
        }));
    }

    /// Tells of the windows that there are, by the X server's numbers.
    pub fn report_windows(&mut self, windows: impl IntoIterator<Item = u32>) {
        for window in windows {
            if !self.windows.contains(&window) {
                self.windows.push(window);
                self.say(&format!("{WINDOW}{window}"));
            }
        }
    }

    /// Tells that a frame is on screen; the guard hears of the first.
    pub fn report_first_frame(&mut self) {
        if !std::mem::replace(&mut self.has_shown, true) {
            self.say(SHOWN);
        }
    }

    fn say(&mut self, line: &str) {
        // That the guard is gone is told by `on_stop_request`.
        let _ = writeln!(self.guard, "{line}");
    }
}
