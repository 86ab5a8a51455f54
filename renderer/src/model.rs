//! Triangle meshes, read from files or generated.
//!
//! [`mesh`] is the type, with [`normal`]s and [`material`]s; [`shape`] finds its outline, and [`solid`] says whether it is
//! closed; [`smooth`] gives it normals. [`ply`] reads and writes meshes, [`statue`] generates one, [`scene`] loads and identifies them.

pub mod material;
pub mod mesh;
pub mod normal;
pub mod ply;
pub mod scene;
pub mod shape;
pub mod smooth;
pub mod solid;
pub mod statue;
