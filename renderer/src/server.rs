//! The render server: `renderer connect`.
//!
//! [`connect`] connects to the wall and reconnects, [`session`] is one conversation with it, [`task`] renders what it asks
//! for, and [`scene_loader`] loads the scene, which [`fetch`] fetches if it is not here; [`synthetic`] answers at once with stored samples, to measure the wall alone.

pub mod connect;
mod fetch;
mod scene_loader;
mod session;
mod synthetic;
pub mod task;
