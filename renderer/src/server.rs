//! The render server: `renderer connect`.
//!
//! [`connect`] finds the wall and finds it again, [`session`] is one conversation with it, [`scene_loader`] loads the scene that it
//! names, [`task`] renders what it asks for; [`synthetic`] answers at once with stored samples, to measure the wall alone.

pub mod connect;
mod scene_loader;
mod session;
mod synthetic;
pub mod task;
