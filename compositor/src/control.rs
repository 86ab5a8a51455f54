//! The state of a wall, and how keys, mouse and time change it.

pub(crate) mod alignment;
pub(crate) mod drive;
pub(crate) mod free_parts;
pub mod input;
pub(crate) mod kiosk;
pub(crate) mod marks;
pub(crate) mod model;
pub(crate) mod navigator;
pub(crate) mod refinement;
pub(crate) mod show;
pub(crate) mod sidecar;
pub(crate) mod touch;
