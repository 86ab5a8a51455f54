//! The materials of a scene, ready for rays: textures that are looked up where a ray hits.
//!
//! [`mip_map`] holds an image at halving sizes, each a [`level`] of [`packed_rgb`] texels; [`footprint`] is the part of a texture
//! that a sample shows; [`materials`] are those of a traced mesh.

pub(crate) mod footprint;
mod level;
mod lookup;
mod mask;
pub mod materials;
mod mip_map;
pub(crate) mod packed_rgb;
#[cfg(test)]
mod tests;
