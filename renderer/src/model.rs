//! Triangle meshes, and what is known of them beyond their triangles.
//!
//! [`mesh`] is the type, with [`normal`]s and [`material`]s; [`shape`] finds its outline and [`stray`] the
//! triangles that are far from it, [`solid`] says whether it is closed, [`smooth`] gives it normals, and [`lattice`]
//! keeps its positions in few bits.
//! [`stand_in`] makes coarser meshes in its place, of [`clusters`] of its vertices.
//! [`statue`] generates a mesh; [`scene`] loads and identifies meshes.

pub mod clusters;
pub mod lattice;
pub mod material;
pub mod mesh;
pub mod normal;
pub mod scene;
pub mod shape;
pub mod smooth;
pub mod solid;
pub mod stand_in;
pub mod statue;
pub mod stray;
