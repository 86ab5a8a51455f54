//! Triangle meshes, read from files or generated.
//!
//! [`mesh`] is the type, with [`normal`]s and [`material`]s; [`shape`] finds its outline and [`stray`] the
//! triangles that are far from it, [`solid`] says whether it is closed, and [`smooth`] gives it normals.
//!
//! [`mod@file`] tells formats apart, and `foreign` files of other kinds: [`ply`], [`obj`], [`stl`] and [`gltf`] read theirs,
//! with `assembly`, `decimal` and `wedges` in common; `companions` finds the files that a model names, and [`images`]
//! decodes its images, with `specular` for metals.
//! [`statue`] generates a mesh; [`scene`] loads and identifies meshes.

mod assembly;
pub mod companions;
mod decimal;
pub mod file;
mod foreign;
pub mod gltf;
pub mod images;
pub mod material;
pub mod mesh;
pub mod normal;
pub mod obj;
pub mod ply;
pub mod scene;
pub mod shape;
pub mod smooth;
pub mod solid;
mod specular;
pub mod statue;
pub mod stl;
pub mod stray;
mod wedges;
