//! The render server: loads a model, builds the paper's grid over it, and traces its share of each frame.
//!
//! In reading order: [`mesh`] is what is traced; [`ply`] reads one, [`statue`] makes one, [`scene`] names and loads one.

pub mod cli;
pub mod connect;
mod exact;
pub mod generate;
pub mod grid;
pub mod image;
pub mod key;
pub mod mesh;
pub mod ply;
pub mod progress;
pub mod ray;
pub mod scene;
pub mod secure;
mod session;
pub mod shade;
mod simd;
mod stage;
pub mod statue;
pub mod trace;
pub mod traced;
pub mod tracer;
pub mod triangle;
pub mod wire;
mod work;
