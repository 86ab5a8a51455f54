//! Walls have guards under X11 and Wayland only: elsewhere the system's own means start them again.

use crate::wall::OnLoss;

/// There is none.
#[derive(Debug)]
pub enum Ward {}

impl Ward {
    /// No process has a guard.
    pub fn of_this_process() -> Option<Self> {
        None
    }

    /// Never called.
    pub fn on_leave(&self, _: impl FnOnce() + Send + 'static) -> std::io::Result<()> {
        match *self {}
    }

    /// Never called.
    pub fn die_of_panics(&self) {
        match *self {}
    }

    /// Never called.
    pub fn has_windows(&mut self, _: impl IntoIterator<Item = u32>) {
        match *self {}
    }

    /// Never called.
    pub fn shows_a_frame(&mut self) {
        match *self {}
    }
}

/// Whether walls can have one.
pub const IS_POSSIBLE: bool = false;

/// Never called.
pub fn run(_: OnLoss) -> anyhow::Result<()> {
    anyhow::bail!("no guard on this system")
}
