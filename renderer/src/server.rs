//! The render server: `renderer connect`.
//!
//! [`connect`] finds the wall and finds it again, [`session`] is one conversation with it, [`stage`] loads the scene that it
//! names, [`work`] renders what it asks for; [`canned`] answers at once with stored samples, to measure the wall alone.

mod canned;
pub mod connect;
mod session;
mod stage;
pub mod work;
