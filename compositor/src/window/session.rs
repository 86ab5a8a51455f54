//! The graphical session around the windows.

pub mod display_environment;
pub(super) mod hotplug;
pub(super) mod legacy;
pub mod screensaver;
