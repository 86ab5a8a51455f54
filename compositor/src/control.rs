//! What a wall shows, and how keys, mouse and time steer it.

pub mod alignment;
pub mod input;
pub mod kiosk;
pub mod model;
pub mod navigator;
pub mod refinement;
pub mod sidecar;
