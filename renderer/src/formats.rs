//! Reads meshes from files.
//!
//! [`mod@file`] tells formats apart, and `foreign` files of other kinds: [`ply`], [`obj`], [`stl`] and [`gltf`] read theirs,
//! with `assembly`, `polygon`, `decimal` and `wedges` in common; [`companions`] finds the files that a model names, `tiles` those of tiled
//! textures, [`sources`] says whether any of them have changed, and [`images`] decodes its images, with `specular` for metals. [`sky`]
//! reads the image that lights a model.

mod assembly;
pub mod companions;
mod decimal;
pub mod file;
mod foreign;
pub mod gltf;
pub mod images;
pub mod obj;
pub mod ply;
mod polygon;
pub mod sky;
pub mod sources;
mod specular;
pub mod stl;
mod tiles;
mod wedges;
