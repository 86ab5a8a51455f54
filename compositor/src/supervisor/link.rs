//! The child's connection to its supervisor.

use std::{
    io::{Read, Write},
    os::{fd::AsFd, unix::net::UnixStream},
    thread,
};

/// Set in the environment of a child.
pub(super) const SUPERVISED: &str = "RAYWALL_GUARDED";

/// Begins the line that reports a window.
pub(super) const WINDOW: &str = "window ";
/// The line that reports the first frame.
pub(super) const SHOWN: &str = "shown";

#[derive(Debug)]
pub(crate) struct SupervisorLink {
    supervisor: UnixStream,
    windows: Vec<u32>,
    has_shown: bool,
}

impl SupervisorLink {
    /// The link to the supervisor that started this process, if one did.
    pub(crate) fn of_this_process() -> Option<Self> {
        std::env::var_os(SUPERVISED)?;
        let supervisor = std::io::stdin().as_fd().try_clone_to_owned().ok()?.into();
        Some(Self { supervisor, windows: Vec::new(), has_shown: false })
    }

    /// Calls `leave` when the supervisor asks the child to stop, or has ended itself.
    pub(crate) fn on_stop_request(&self, leave: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        let mut supervisor = self.supervisor.try_clone()?;
        let wait = move || {
            // The supervisor writes nothing: this returns when it closes the socket.
            let _ = supervisor.read(&mut [0]);
            leave();
        };
        thread::Builder::new().name("guard".to_owned()).spawn(wait).map(drop)
    }

    /// Makes a panic of the main thread abort the process: unwinding would close the windows that the supervisor copies
    /// to cover the desktop.
    pub(crate) fn abort_on_panic(&self) {
        let default_hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            default_hook(panic);
            if thread::current().name() == Some("main") {
                std::process::abort();
            }
        }));
    }

    /// Reports windows by their X11 identifiers, each once.
    pub(crate) fn report_windows(&mut self, windows: impl IntoIterator<Item = u32>) {
        for window in windows {
            if !self.windows.contains(&window) {
                self.windows.push(window);
                self.report(&format!("{WINDOW}{window}"));
            }
        }
    }

    pub(crate) fn report_first_frame(&mut self) {
        if !std::mem::replace(&mut self.has_shown, true) {
            self.report(SHOWN);
        }
    }

    fn report(&mut self, line: &str) {
        // If the supervisor is gone, `on_stop_request` ends the child.
        let _ = writeln!(self.supervisor, "{line}");
    }
}
