//! The render server: loads a model, builds the paper's grid over it, and traces its share of each frame.
//!
//! In reading order: [`formats`] reads a [`model`], [`grid`] sorts its triangles into cells, [`texture`] prepares its
//! materials, [`intersect`] follows rays through the cells, [`render`] turns hits into light and shares of frames into
//! samples, [`server`] serves a wall, and [`cli`] is the command line. [`memory`] says what to do when it runs out.

pub mod cli;
pub mod formats;
pub mod grid;
pub mod intersect;
pub mod memory;
pub mod model;
pub mod render;
pub mod scene_file;
pub mod server;
mod simd;
pub mod texture;
