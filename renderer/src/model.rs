//! What is traced: triangle meshes, read from files or made.
//!
//! [`mesh`] is one in memory; [`ply`] reads one, [`statue`] makes one, [`scene`] names and loads one.

pub mod mesh;
pub mod ply;
pub mod scene;
pub mod statue;
