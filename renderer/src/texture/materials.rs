//! The materials of a traced mesh.

use glam::{Vec2, Vec3A};

use crate::{
    model::material::{Material, Materials, TextureUse, Wrap},
    texture::{
        footprint::{self, Footprint},
        level::Level,
        mip_map::{Encoding, MipMap},
    },
};

/// The materials of a mesh's triangles, with their textures.
#[derive(Debug, Default)]
pub(crate) struct TracedMaterials {
    materials: Vec<TracedMaterial>,
    /// The material of each triangle; empty if all have the first.
    of_triangles: Vec<u16>,
    maps: Vec<MipMap>,
    /// Coverage, for materials that are not everywhere.
    masks: Vec<Level<u8>>,
    /// Whether some surfaces are not everywhere.
    has_masks: bool,
}

#[derive(Debug)]
struct TracedMaterial {
    base_color: Vec3A,
    base_color_texture: Option<Texture>,
    /// Of roughness and metallic.
    gloss: [f32; 2],
    gloss_texture: Option<Texture>,
    emissive: Vec3A,
    emissive_texture: Option<Texture>,
    mask: Option<Mask>,
}

/// A use of one of [`TracedMaterials::maps`] or [`TracedMaterials::masks`].
#[derive(Debug)]
struct Texture {
    index: usize,
    wrap: [Wrap; 2],
    transform: [[f32; 3]; 2],
}

#[derive(Debug)]
struct Mask {
    /// Without one, coverage is 1 everywhere.
    texture: Option<Texture>,
    /// Where the texture is below this, the surface is not there.
    cutoff: f32,
}

/// A material at one point of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PointMaterial {
    /// Linear, without the vertices' colours.
    pub(crate) base_color: Vec3A,
    /// Roughness and metallic, each from 0 to 1; `None` for a surface that only scatters light.
    pub(crate) gloss: Option<[f32; 2]>,
    /// Linear light that the surface gives off.
    pub(crate) emissive: Vec3A,
}

/// The part of an image that a material needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Part {
    Colors,
    Numbers,
    Coverage,
}

impl TracedMaterials {
    /// Bytes of the materials of a mesh in memory.
    pub(crate) fn n_bytes_of(materials: &Materials) -> u64 {
        let parts: u64 = parts(materials).into_iter().map(|part| n_bytes_of_part(materials, part)).sum();
        parts + (size_of_val(&*materials.of_triangles) + materials.materials.len() * size_of::<TracedMaterial>()) as u64
    }

    /// Most bytes of the images of a mesh and their parts while [`TracedMaterials::new`] drops the ones and makes the others.
    pub(crate) fn peak_bytes(materials: &Materials) -> u64 {
        let parts = parts(materials);
        let of_image = |image| {
            let of_image = parts.iter().filter(|part| part.0 == image);
            of_image.map(|&part| n_bytes_of_part(materials, part)).sum::<u64>()
        };
        let largest = (0..materials.images.len() as u32).map(of_image).max().unwrap_or(0);
        (materials.n_bytes() as u64).max(Self::n_bytes_of(materials)) + largest
    }

    /// Prepares materials for triangles that have these numbers in the file, on the current rayon pool.
    pub(crate) fn new(materials: Materials, file_indices: &[u32]) -> Self {
        let parts = parts(&materials);
        let Materials { materials, images, of_triangles } = materials;
        let (mut maps, mut masks) = (Vec::new(), Vec::new());
        for (image, number) in images.into_iter().zip(0..) {
            for &(_, part) in parts.iter().filter(|part| part.0 == number) {
                match part {
                    Part::Colors => maps.push(MipMap::new(&image, Encoding::Srgb)),
                    Part::Numbers => maps.push(MipMap::new(&image, Encoding::Linear)),
                    Part::Coverage => masks.push(Level::of_image(&image, |[.., coverage]| coverage)),
                }
            }
        }
        let texture = |texture: Option<TextureUse>, part: Part| {
            let TextureUse { image, wrap, transform } = texture?;
            let mut same_kind =
                parts.iter().filter(|(_, other)| (*other == Part::Coverage) == (part == Part::Coverage));
            Some(Texture { index: same_kind.position(|other| *other == (image, part))?, wrap, transform })
        };
        let traced = |material: &Material| {
            let [red, green, blue, coverage] = material.base_color;
            TracedMaterial {
                base_color: Vec3A::new(red, green, blue),
                base_color_texture: texture(material.base_color_texture, Part::Colors),
                gloss: [material.roughness, material.metallic],
                gloss_texture: texture(material.metallic_roughness_texture, Part::Numbers),
                emissive: Vec3A::from_array(material.emissive),
                emissive_texture: texture(material.emissive_texture, Part::Colors),
                mask: material.alpha_cutoff.map(|cutoff| Mask {
                    texture: texture(material.base_color_texture, Part::Coverage),
                    cutoff: cutoff / coverage,
                }),
            }
        };
        let in_order = file_indices.iter().filter_map(|&file_index| of_triangles.get(file_index as usize).copied());
        let of_triangles = in_order.collect();
        let has_masks = materials.iter().any(|material| material.alpha_cutoff.is_some());
        Self { materials: materials.iter().map(traced).collect(), of_triangles, maps, masks, has_masks }
    }

    /// Bytes in memory.
    pub(crate) fn n_bytes(&self) -> usize {
        self.maps.iter().map(MipMap::n_bytes).sum::<usize>()
            + self.masks.iter().map(Level::n_bytes).sum::<usize>()
            + size_of_val(&*self.materials)
            + size_of_val(&*self.of_triangles)
    }

    /// Whether there are textures, so that triangles need texture coordinates.
    pub(crate) fn has_textures(&self) -> bool {
        !self.maps.is_empty()
    }

    /// Whether some surfaces are not everywhere.
    pub(crate) fn has_masks(&self) -> bool {
        self.has_masks
    }

    /// The material of a triangle where a sample shows it; `None` without materials. `footprint` is called if it has textures.
    #[inline]
    pub(crate) fn at(&self, triangle_idx: u32, footprint: impl FnOnce() -> Option<Footprint>) -> Option<PointMaterial> {
        let material = self.of_triangle(triangle_idx)?;
        let textures = [&material.base_color_texture, &material.gloss_texture, &material.emissive_texture];
        let footprint = if textures.iter().any(|texture| texture.is_some()) { footprint() } else { None };
        let [base_color, gloss, emissive] = textures.map(|texture| match (texture, &footprint) {
            (Some(texture), Some(footprint)) => {
                footprint.transformed(&texture.transform).mean(&self.maps[texture.index], texture.wrap)
            }
            _ => Vec3A::ONE,
        });
        let [roughness, metallic] = material.gloss;
        let is_glossy = roughness < 1.0 || metallic > 0.0 || material.gloss_texture.is_some();
        Some(PointMaterial {
            base_color: material.base_color * base_color,
            gloss: is_glossy.then_some([roughness * gloss.y, metallic * gloss.z]),
            emissive: material.emissive * emissive,
        })
    }

    /// Whether a triangle's surface is missing at a point; `coordinates` is called if its material has a mask with a texture.
    #[inline]
    pub(crate) fn is_cut(&self, triangle_idx: u32, coordinates: impl FnOnce() -> Option<Vec2>) -> bool {
        let Some(Mask { texture, cutoff }) = self.of_triangle(triangle_idx).and_then(|material| material.mask.as_ref())
        else {
            return false;
        };
        let coverage = texture.as_ref().and_then(|texture| {
            let at = footprint::transformed(coordinates()?, &texture.transform).to_array();
            Some(self.masks[texture.index].bilinear(at, texture.wrap, |coverage| f32::from(coverage) / 255.0))
        });
        coverage.unwrap_or(1.0) < *cutoff
    }

    #[inline]
    fn of_triangle(&self, triangle_idx: u32) -> Option<&TracedMaterial> {
        let index = self.of_triangles.get(triangle_idx as usize).copied().unwrap_or(0);
        self.materials.get(usize::from(index))
    }
}

/// The parts of the images that materials use, in the order of images.
fn parts(Materials { materials, images, .. }: &Materials) -> Vec<(u32, Part)> {
    let of_material = |material: &Material| {
        [
            (material.base_color_texture, Part::Colors),
            (material.emissive_texture, Part::Colors),
            (material.metallic_roughness_texture, Part::Numbers),
            (material.base_color_texture.filter(|_| material.alpha_cutoff.is_some()), Part::Coverage),
        ]
    };
    let used = materials.iter().flat_map(of_material).filter_map(|(texture, part)| Some((texture?.image, part)));
    let mut parts: Vec<_> = used.filter(|(image, _)| (*image as usize) < images.len()).collect();
    parts.sort_unstable();
    parts.dedup();
    parts
}

fn n_bytes_of_part(materials: &Materials, (image, part): (u32, Part)) -> u64 {
    let image = &materials.images[image as usize];
    match part {
        Part::Colors | Part::Numbers => MipMap::n_bytes_of(image),
        Part::Coverage => Level::<u8>::n_bytes_of_size([image.width, image.height]),
    }
}
