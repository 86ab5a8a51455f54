//! No supervisor: walls have one on Unix with X11 or Wayland only. Use the system's service manager elsewhere.

use crate::wall::OnLoss;

/// Has no values on this system.
#[derive(Debug)]
pub(crate) enum SupervisorLink {}

impl SupervisorLink {
    /// No process has a supervisor.
    pub(crate) fn of_this_process() -> Option<Self> {
        None
    }

    pub(crate) fn on_stop_request(&self, _: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        match *self {}
    }

    pub(crate) fn abort_on_panic(&self) {
        match *self {}
    }

    pub(crate) fn report_windows(&mut self, _: impl IntoIterator<Item = u32>) {
        match *self {}
    }

    pub(crate) fn report_first_frame(&mut self) {
        match *self {}
    }
}

/// Whether this system has supervisors.
pub(crate) const IS_SUPPORTED: bool = false;

pub(crate) fn run(_: OnLoss) -> anyhow::Result<()> {
    anyhow::bail!("walls have no supervisor on this system")
}
