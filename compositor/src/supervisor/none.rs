//! Walls have guards under X11 and Wayland only: elsewhere the system's own means start them again.

use crate::wall::OnLoss;

/// There is none.
#[derive(Debug)]
pub enum SupervisorLink {}

impl SupervisorLink {
    /// No process has a guard.
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

/// Whether walls can have one.
pub const IS_SUPPORTED: bool = false;

/// Never called.
pub fn run(_: OnLoss) -> anyhow::Result<()> {
    anyhow::bail!("no guard on this system")
}
