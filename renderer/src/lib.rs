//! The render server: loads a model, builds the paper's grid over it, and traces its share of each frame.
//!
//! In reading order: [`mesh`] is what is traced; [`ply`] reads one, [`statue`] makes one, [`scene`] names and loads one.
//! [`grid`] finds the triangles along [`ray`]s, [`triangle`] decides whether they are hit, [`tracer`] does it for shares
//! of frames, [`clip`] leaves out what is cut away, [`secondary`] finds the lights that reach a hit, [`shade`] makes
//! light of hits, [`lighting`] all of it for a block of samples; [`frame`] traces and shades whole frames, and [`parallel`]
//! divides them among threads. [`connect`], [`trace`], [`generate`] and [`key`] are the commands of [`cli`], with
//! [`scene_args`] and [`look_args`]; [`wire`] and [`secure`] are how a render server talks.

pub mod blocks;
mod canned;
pub mod cli;
pub mod clip;
pub mod connect;
mod exact;
pub mod frame;
pub mod generate;
pub mod grid;
pub mod image;
pub mod key;
pub mod lighting;
pub mod look_args;
pub mod mesh;
pub mod parallel;
pub mod path_bytes;
pub mod ply;
pub mod progress;
pub mod ray;
pub mod scene;
pub mod scene_args;
pub mod secondary;
pub mod secure;
mod session;
pub mod shade;
mod simd;
mod stage;
pub mod statue;
pub mod threads;
pub mod trace;
pub mod traced;
pub mod tracer;
pub mod triangle;
pub mod wire;
pub mod work;
