//! The graphical session: requirements, monitors, X11 windows, screensaver.

pub(crate) mod display_environment;
pub(super) mod hotplug;
pub(super) mod legacy;
pub(crate) mod screensaver;
