//! The render server: `renderer connect`.
//!
//! [`connect`] connects to the wall, which [`discover`] finds if it was not named, and reconnects; [`session`] is one conversation with it, [`task`] renders what it asks
//! for, and [`scene_loader`] loads the scenes of its [`load_request`]s, which [`fetch`] fetches if they are not here; [`synthetic`]
//! answers at once with stored samples, to measure the wall alone.

pub mod connect;
mod discover;
mod fetch;
mod load_request;
mod scene_loader;
mod session;
mod synthetic;
pub mod task;
