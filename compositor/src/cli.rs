//! The command line: starts a wall with or without a window, checks wall files, and reports measurements.

pub mod args;
pub mod check;
pub mod headless;
pub mod local;
pub mod remote_args;
pub mod report;
pub(crate) mod restart;
pub mod run;
