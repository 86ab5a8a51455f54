//! The command line: starts a wall, shows it without a window, checks wall files, and reports.

pub mod args;
pub mod check;
pub mod headless;
pub mod local;
pub mod report;
pub mod run;
