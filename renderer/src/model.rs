//! Triangle meshes, read from files or generated.
//!
//! [`mesh`] is the type; [`ply`] reads and writes meshes, [`statue`] generates one, [`scene`] loads and identifies them.

pub mod mesh;
pub mod ply;
pub mod scene;
pub mod statue;
