//! How surfaces look: materials and their textures, as glTF 2.0 defines them.

use serde::{Deserialize, Serialize};
use shared::printable::counted;

/// The look of a mesh: its materials, and the images that they use.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Materials {
    /// Without any, surfaces have the vertices' colours, or are clay.
    pub materials: Vec<Material>,
    /// Images of [`TextureUse::image`].
    pub images: Vec<Image>,
    /// The material of each triangle, in file order; empty if all have the first.
    pub of_triangles: Vec<u16>,
}

impl Materials {
    /// Bytes in memory.
    pub fn n_bytes(&self) -> usize {
        let images: usize = self.images.iter().map(|image| size_of_val(&*image.texels)).sum();
        images + size_of_val(&*self.materials) + size_of_val(&*self.of_triangles)
    }

    /// The numbers of materials and images, for the log; `None` without any.
    pub(crate) fn summary(&self) -> Option<String> {
        let materials = counted(self.materials.len(), "material");
        let largest = self.images.iter().max_by_key(|image| u64::from(image.width) * u64::from(image.height));
        (!self.materials.is_empty()).then(|| match largest {
            Some(Image { width, height, .. }) => {
                format!("{materials}, {} of up to {width}x{height} texels", counted(self.images.len(), "image"))
            }
            None => materials,
        })
    }
}

/// A surface of glTF's metallic-roughness model. Factors multiply textures and vertex colours.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// As in the file.
    pub name: String,
    /// Linear red, green, blue, and coverage; each from 0 to 1.
    pub base_color: [f32; 4],
    /// Multiplies [`Material::base_color`]; sRGB.
    pub base_color_texture: Option<TextureUse>,
    /// From 0 to 1.
    pub metallic: f32,
    /// From 0 to 1.
    pub roughness: f32,
    /// Roughness in green and metallic in blue, linear.
    pub metallic_roughness_texture: Option<TextureUse>,
    /// Linear light that the surface gives off.
    pub emissive: [f32; 3],
    /// Multiplies [`Material::emissive`]; sRGB.
    pub emissive_texture: Option<TextureUse>,
    /// Where coverage is below this, the surface is not there; `None` if it is everywhere.
    pub alpha_cutoff: Option<f32>,
    /// Whether the base colour is the light that is seen, whatever falls on the surface: scans whose photographs hold the light.
    pub is_unlit: bool,
}

impl Default for Material {
    /// White, rough, opaque and no metal.
    fn default() -> Self {
        Self {
            name: String::new(),
            base_color: [1.0; 4],
            base_color_texture: None,
            metallic: 0.0,
            roughness: 1.0,
            metallic_roughness_texture: None,
            emissive: [0.0; 3],
            emissive_texture: None,
            alpha_cutoff: None,
            is_unlit: false,
        }
    }
}

impl Material {
    /// Keeps the textures that `kept` returns. A surface whose texture is lost gives off no light and is no metal, because
    /// factors beside a texture are mostly 1.
    pub(crate) fn keep_textures(&mut self, mut kept: impl FnMut(TextureUse) -> Option<TextureUse>) {
        let Self { base_color_texture, metallic_roughness_texture, emissive_texture, .. } = self;
        for (texture, lost) in [
            (base_color_texture, None),
            (metallic_roughness_texture, Some(std::slice::from_mut(&mut self.metallic))),
            (emissive_texture, Some(&mut self.emissive[..])),
        ] {
            let had_one = texture.is_some();
            *texture = texture.and_then(&mut kept);
            if let Some(factors) = lost.filter(|_| had_one && texture.is_none()) {
                factors.fill(0.0);
            }
        }
    }
}

/// How a material uses an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TextureUse {
    /// Index into [`Materials::images`].
    pub image: u32,
    /// How coordinates beyond 0 to 1 are mapped, for u and v.
    pub wrap: [Wrap; 2],
    /// Rows of the matrix that maps the mesh's (u, v, 1) to this texture's coordinates.
    pub transform: [[f32; 3]; 2],
}

/// How a texture continues beyond its edges.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Wrap {
    /// Over and over.
    #[default]
    Repeat,
    /// Mirrored every other time.
    Mirror,
    /// With the texels of its edge.
    Clamp,
}

/// An image in memory: eight bits a channel, rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Texels a row; at least 1.
    pub width: u32,
    /// Rows; at least 1.
    pub height: u32,
    /// Red, green, blue and coverage; `width * height` of them.
    pub texels: Vec<[u8; 4]>,
}
