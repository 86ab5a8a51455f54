//! The state of a wall, and how keys, mouse and time change it.

pub mod alignment;
pub mod input;
pub mod kiosk;
pub mod model;
pub mod navigator;
pub(crate) mod numbered_file;
pub mod refinement;
pub mod sidecar;
