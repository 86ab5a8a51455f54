//! The materials of a traced mesh.

mod stored;

use glam::{Vec2, Vec3};
use serde::{Deserialize, Serialize};

use crate::{
    model::material::{Image, Material, Materials, TextureUse, Wrap},
    scene_file::section::Section,
    simd::InstructionSet,
    texture::{
        footprint::{self, Footprints},
        level,
        lookup::MultiplyByMeans,
        mask::Mask,
        mip_map::{Encoding, MipMap},
    },
};

/// The materials of a mesh's triangles, with their textures.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct TracedMaterials {
    materials: Vec<TracedMaterial>,
    /// The material of each triangle; empty if all have the first.
    #[serde(skip)]
    of_triangles: Section<u16>,
    maps: Vec<MipMap>,
    /// Coverage, for materials that are not everywhere.
    masks: Vec<Mask>,
    /// Whether some surfaces are not everywhere.
    has_masks: bool,
}

#[derive(Debug, Serialize, Deserialize)]
struct TracedMaterial {
    /// Linear, without the texture and the vertices' colours.
    base_color: Vec3,
    /// Without textures.
    plain: PointMaterial,
    base_color_texture: Option<Texture>,
    /// Of roughness and metallic.
    gloss_texture: Option<Texture>,
    emissive_texture: Option<Texture>,
    gaps: Option<Gaps>,
}

/// A use of one of [`TracedMaterials::maps`] or [`TracedMaterials::masks`].
#[derive(Debug, Serialize, Deserialize)]
struct Texture {
    index: usize,
    wrap: [Wrap; 2],
    transform: [[f32; 3]; 2],
}

#[derive(Debug, Serialize, Deserialize)]
struct Gaps {
    /// Without one, coverage is 1 everywhere.
    texture: Option<Texture>,
    /// Where the texture is below this, the surface is not there.
    cutoff: f32,
}

/// A material at one point of a surface, without its colour.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PointMaterial {
    /// The surface's answer to light.
    pub finish: Finish,
    /// Linear light that the surface gives off.
    pub emissive: Vec3,
}

/// The answer of a surface to light.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Finish {
    /// Scatters it.
    Matte,
    /// Scatters and reflects it; both numbers are from 0 to 1.
    Glossy {
        /// 0 for a mirror.
        roughness: f32,
        /// 1 for a metal.
        metallic: f32,
    },
    /// Ignores it, and shows its base colour.
    Unlit,
}

/// The materials at up to 64 hits on triangles.
pub(crate) struct PointMaterials {
    /// A bit for each hit whose surface does more than to scatter light. Only it is cleared for the next hits.
    has_one: u64,
    materials: [PointMaterial; 64],
}

impl PointMaterials {
    pub(crate) const NONE: Self =
        Self { has_one: 0, materials: [PointMaterial { finish: Finish::Matte, emissive: Vec3::ZERO }; 64] };

    /// The material at a hit; `None` if the surface only scatters light.
    #[inline(always)]
    pub(crate) fn get(&self, hit: usize) -> Option<&PointMaterial> {
        self.materials.get(hit).filter(|_| self.has_one >> hit & 1 == 1)
    }

    fn clear(&mut self) {
        self.has_one = 0;
    }

    fn set(&mut self, hit: usize, material: PointMaterial) {
        self.materials[hit] = material;
        self.has_one |= 1 << hit;
    }
}

/// The numbers of hits, in their order.
const NUMBERS: [usize; 64] = {
    let mut numbers = [0; 64];
    let mut number = 0;
    while number < 64 {
        numbers[number] = number;
        number += 1;
    }
    numbers
};

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
        // Beyond the image, whose place the last of its mip maps takes.
        let of_image = |(image, number): (&Image, u32)| {
            let of_image = parts.iter().filter(|part| part.0 == number);
            let has_map = of_image.clone().any(|(_, part)| *part != Part::Coverage);
            let replaced = if has_map { size_of_val(&*image.texels) as u64 } else { 0 };
            of_image.map(|&part| n_bytes_of_part(materials, part)).sum::<u64>() - replaced
        };
        let largest = materials.images.iter().zip(0..).map(of_image).max().unwrap_or(0);
        (materials.n_bytes() as u64).max(Self::n_bytes_of(materials)) + largest
    }

    /// Prepares materials for triangles that have these numbers in the file, on the current rayon pool.
    pub(crate) fn new(materials: Materials, file_indices: &[u32]) -> Self {
        let parts = parts(&materials);
        let Materials { materials, images, of_triangles } = materials;
        let (mut maps, mut masks) = (Vec::new(), Vec::new());
        for (image, number) in images.into_iter().zip(0..) {
            let has = |part| parts.binary_search(&(number, part)).is_ok();
            if has(Part::Coverage) {
                masks.push(Mask::new(&image));
            }
            match (has(Part::Colors), has(Part::Numbers)) {
                (true, true) => {
                    maps.push(MipMap::new(image.clone(), Encoding::Srgb));
                    maps.push(MipMap::new(image, Encoding::Linear));
                }
                (true, false) => maps.push(MipMap::new(image, Encoding::Srgb)),
                (false, true) => maps.push(MipMap::new(image, Encoding::Linear)),
                (false, false) => {}
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
            let gloss_texture = texture(material.metallic_roughness_texture, Part::Numbers);
            let &Material { roughness, metallic, is_unlit, .. } = material;
            let finish = if is_unlit {
                Finish::Unlit
            } else if roughness < 1.0 || metallic > 0.0 || gloss_texture.is_some() {
                Finish::Glossy { roughness, metallic }
            } else {
                Finish::Matte
            };
            TracedMaterial {
                base_color: Vec3::new(red, green, blue),
                plain: PointMaterial { finish, emissive: Vec3::from_array(material.emissive) },
                base_color_texture: texture(material.base_color_texture, Part::Colors),
                gloss_texture,
                emissive_texture: texture(material.emissive_texture, Part::Colors),
                gaps: material.alpha_cutoff.map(|cutoff| Gaps {
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
            + self.masks.iter().map(Mask::n_bytes).sum::<usize>()
            + size_of_val(&*self.materials)
            + size_of_val(&*self.of_triangles)
    }

    /// Whether a triangle's surface ignores light, and shows its colour.
    pub(crate) fn is_unlit(&self, triangle_idx: u32) -> bool {
        let material = self.materials.get(self.index_of_triangle(triangle_idx));
        material.is_some_and(|material| matches!(material.plain.finish, Finish::Unlit))
    }

    /// Whether surfaces have materials.
    pub(crate) fn has_materials(&self) -> bool {
        !self.materials.is_empty()
    }

    /// Whether there are textures, so that triangles need texture coordinates.
    pub(crate) fn has_textures(&self) -> bool {
        !self.maps.is_empty()
    }

    /// Whether some surfaces are not everywhere.
    pub(crate) fn has_masks(&self) -> bool {
        self.has_masks
    }

    /// Finds the materials at up to 64 hits on `triangles`, and multiplies `colors`, by channel, by the linear base colours there.
    /// There are footprints if triangles have texture coordinates.
    pub(crate) fn find(
        &self,
        instructions: InstructionSet,
        triangles: &[u32],
        footprints: &Footprints,
        colors: &mut [[f32; 64]; 3],
        points: &mut PointMaterials,
    ) {
        points.clear();
        let mut indices = [0; 64];
        let of_triangles = if self.of_triangles.is_empty() { &[] } else { triangles };
        for (index, &triangle) in indices.iter_mut().zip(of_triangles) {
            *index = self.index_of_triangle(triangle);
        }
        let (indices, first) = (&indices[..triangles.len()], indices[0]);
        if indices.iter().take(of_triangles.len()).all(|&index| index == first) {
            self.set(instructions, first, (&NUMBERS[..indices.len()], footprints), colors, points);
            return;
        }

        // Look up the textures of one material after the other.
        let mut rest = u64::MAX >> (64 - indices.len());
        while rest != 0 {
            let index = indices[rest.trailing_zeros() as usize];
            let (mut hits, mut n) = ([0; 64], 0);
            for (hit, &other) in indices.iter().enumerate() {
                hits[n] = hit;
                n += usize::from(other == index);
                rest &= !(u64::from(other == index) << hit);
            }
            let hits = &hits[..n];
            let footprints = if footprints.is_empty() { Footprints::NONE } else { footprints.pick(hits) };
            let mut tints = [[1.0; 64]; 3];
            self.set(instructions, index, (hits, &footprints), &mut tints, points);
            for (colors, tints) in colors.iter_mut().zip(&tints) {
                hits.iter().zip(tints).for_each(|(&hit, tint)| colors[hit] *= tint);
            }
        }
    }

    /// Sets the material at some hits, multiplied by its textures if there are footprints. Multiplies colours, by channel, in the
    /// order of these hits, by the base colours there.
    fn set(
        &self,
        instructions: InstructionSet,
        index: usize,
        (hits, footprints): (&[usize], &Footprints),
        colors: &mut [[f32; 64]; 3],
        points: &mut PointMaterials,
    ) {
        let Some(TracedMaterial { base_color, plain, base_color_texture, gloss_texture, emissive_texture, .. }) =
            self.materials.get(index)
        else {
            return;
        };
        let base_color = base_color.to_array();
        if !self.look_up(instructions, base_color_texture.as_ref(), footprints, base_color, colors) {
            for (colors, base_color) in colors.iter_mut().zip(base_color) {
                colors.iter_mut().for_each(|color| *color *= base_color);
            }
        }
        if plain.only_scatters() {
            return;
        }
        hits.iter().for_each(|&hit| points.set(hit, *plain));
        let mut means = [[1.0; 64]; 3];
        if self.look_up(instructions, gloss_texture.as_ref(), footprints, [1.0; 3], &mut means) {
            let [_, roughnesses, metallics] = &means;
            for (&hit, (of_roughness, of_metallic)) in hits.iter().zip(roughnesses.iter().zip(metallics)) {
                if let Finish::Glossy { roughness, metallic } = &mut points.materials[hit].finish {
                    *roughness *= of_roughness;
                    *metallic *= of_metallic;
                }
            }
        }
        let mut means = [[1.0; 64]; 3];
        if self.look_up(instructions, emissive_texture.as_ref(), footprints, [1.0; 3], &mut means) {
            for (index, &hit) in hits.iter().enumerate().take(64) {
                points.materials[hit].emissive *= Vec3::new(means[0][index], means[1][index], means[2][index]);
            }
        }
    }

    /// Multiplies numbers, by channel, by a factor and by the means of a texture over footprints; does nothing, and says so, if
    /// there are none.
    fn look_up(
        &self,
        instructions: InstructionSet,
        texture: Option<&Texture>,
        footprints: &Footprints,
        factor: [f32; 3],
        numbers: &mut [[f32; 64]; 3],
    ) -> bool {
        let Some(Texture { index, wrap, transform }) = texture.filter(|_| !footprints.is_empty()) else { return false };
        let map = &self.maps[*index];
        // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
        unsafe { instructions.call(MultiplyByMeans { map, wrap: *wrap, transform, footprints, factor, numbers }) };
        true
    }

    /// Whether a triangle's surface is missing at a point; `coordinates` is called if its material has a mask with a texture.
    #[inline]
    pub(crate) fn is_cut(&self, triangle_idx: u32, coordinates: impl FnOnce() -> Option<Vec2>) -> bool {
        let Some(Gaps { texture, cutoff }) =
            self.materials.get(self.index_of_triangle(triangle_idx)).and_then(|material| material.gaps.as_ref())
        else {
            return false;
        };
        let coverage = texture.as_ref().and_then(|texture| {
            let at = footprint::transformed(coordinates()?, &texture.transform).to_array();
            Some(self.masks[texture.index].at(at, texture.wrap))
        });
        coverage.unwrap_or(1.0) < *cutoff
    }

    #[inline]
    fn index_of_triangle(&self, triangle_idx: u32) -> usize {
        self.of_triangles.get(triangle_idx as usize).map_or(0, |&index| usize::from(index))
    }
}

impl PointMaterial {
    fn only_scatters(&self) -> bool {
        self.finish == Finish::Matte && self.emissive == Vec3::ZERO
    }
}

impl TracedMaterial {
    fn textures(&self) -> [Option<&Texture>; 3] {
        [self.base_color_texture.as_ref(), self.gloss_texture.as_ref(), self.emissive_texture.as_ref()]
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
    let exists = |(image, _): &(u32, Part)| {
        images.get(*image as usize).is_some_and(|image| level::is_indexable([image.width, image.height]))
    };
    let mut parts: Vec<_> = used.filter(exists).collect();
    parts.sort_unstable();
    parts.dedup();
    parts
}

fn n_bytes_of_part(materials: &Materials, (image, part): (u32, Part)) -> u64 {
    let image = &materials.images[image as usize];
    match part {
        Part::Colors | Part::Numbers => MipMap::n_bytes_of(image),
        Part::Coverage => Mask::n_bytes_of(image),
    }
}
