//! From rays to samples: packets of camera rays, the light at their hits, and whole frames on all threads.
//!
//! [`scene`] is a mesh with its grid. [`blocks`] cuts a share of a frame into packets, [`sampling`] places samples in
//! pixels. [`secondary`] finds the lights that reach a hit, [`shade`] its colour, with [`surface`] and [`gloss`]; [`path`]
//! finds both by paths of light, [`sky`] is an image that lights them. [`lift`] says where rays between
//! surfaces start. [`lighting`] joins all of them, and [`tracer`] renders shares and whole frames with it. [`parallel`] divides them among [`threads`], and
//! [`image`] writes them. `section` finds ways along the surface.

pub mod blocks;
mod gloss;
pub mod image;
mod lift;
pub mod lighting;
mod noise;
pub mod parallel;
pub mod path;
pub mod sampling;
pub mod scene;
pub mod secondary;
mod section;
pub mod shade;
pub mod sky;
mod surface;
pub mod threads;
pub mod tracer;
