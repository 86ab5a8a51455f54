//! No supervisor: walls have one on Unix with X11 or Wayland only. Use the system's service manager elsewhere.

use crate::wall::OnLoss;

/// Has no values on this system.
#[derive(Debug)]
pub enum SupervisorLink {}

impl SupervisorLink {
    /// No process has a supervisor.
    pub fn of_this_process() -> Option<Self> {
        None
    }

    /// Never called.
    pub fn on_stop_request(&self, _: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        match *self {}
    }

    /// Never called.
    pub fn abort_on_panic(&self) {
        match *self {}
    }

    /// Never called.
    pub fn report_windows(&mut self, _: impl IntoIterator<Item = u32>) {
        match *self {}
    }

    /// Never called.
    pub fn report_first_frame(&mut self) {
        match *self {}
    }
}

/// Whether this system has supervisors.
pub const IS_SUPPORTED: bool = false;

/// Never called.
pub fn run(_: OnLoss) -> anyhow::Result<()> {
    anyhow::bail!("walls have no supervisor on this system")
}
