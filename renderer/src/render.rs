//! From rays to samples: packets of camera rays, what lights their hits, and whole frames on all threads.
//!
//! [`blocks`] cuts a share of a frame into packets, [`tracer`] traces and shades them with [`lighting`], which asks
//! [`secondary`] for the lights that reach a hit and [`shade`] for its colour. [`frame`] traces whole frames, [`parallel`]
//! divides them among [`threads`], and [`image`] writes them.

pub mod blocks;
pub mod frame;
pub mod image;
pub mod lighting;
pub mod parallel;
pub mod secondary;
pub mod shade;
pub mod threads;
pub mod tracer;
