//! Materials and their textures.

use std::collections::{HashMap, HashSet};

use crate::formats::{
    file::Draft,
    gltf::{
        buffers::Buffers,
        document::{AlphaMode, Document, Material as Described, MetallicRoughness, SpecularGlossiness, TextureInfo},
        images::Images,
    },
    specular::Factors,
};
use crate::model::material::{Material, TextureUse, Wrap};

/// Where a blended surface is half there, it is there.
const BLEND_CUTOFF: f32 = 0.5;

/// The materials that triangles use.
pub(super) struct Look<'a> {
    document: &'a Document<'a>,
    materials: Vec<Material>,
    /// The number of each material of the document that is used.
    numbers: HashMap<usize, u16>,
    images: Images<'a>,
    remarks: Vec<String>,
    said: HashSet<String>,
}

impl<'a> Look<'a> {
    pub(super) fn new(document: &'a Document<'a>, buffers: &'a Buffers<'a>) -> Self {
        Self {
            document,
            materials: Vec::new(),
            numbers: HashMap::new(),
            images: Images::new(document, buffers),
            remarks: Vec::new(),
            said: HashSet::new(),
        }
    }

    /// Says something once.
    fn say(&mut self, remark: String) {
        if self.said.insert(remark.clone()) {
            self.remarks.push(remark);
        }
    }

    /// The texture coordinates that a material uses. A mesh keeps one set: that of the base colour, if it has a texture.
    pub(super) fn texture_set(&self, material: Option<usize>) -> u32 {
        let material = material.and_then(|index| self.document.materials.get(index));
        material.and_then(|material| first_texture(material)).map_or(0, TextureInfo::set)
    }

    /// The number of a material of the document; `None` if there is none, or there are too many.
    pub(super) fn number(&mut self, index: usize) -> Option<u16> {
        if let Some(&number) = self.numbers.get(&index) {
            return Some(number);
        }
        let described = self.document.materials.get(index)?;
        let number = u16::try_from(self.materials.len()).ok().filter(|&number| number < u16::MAX)?;
        let material = self.material(described);
        self.materials.push(material);
        self.numbers.insert(index, number);
        Some(number)
    }

    fn material(&mut self, described: &Described) -> Material {
        let name = described.name.clone();
        let set = first_texture(described).map_or(0, TextureInfo::set);
        let extensions = &described.extensions;
        let is_unlit = extensions.unlit.is_some();
        let surface = match extensions.specular_glossiness.as_deref() {
            Some(glossy) => self.glossy(glossy, set, is_unlit),
            None => self.rough(&described.pbr_metallic_roughness, set, is_unlit),
        };
        let strength = extensions.emissive_strength.as_ref().and_then(|it| it.emissive_strength).unwrap_or(1.0);
        let emissive = described.emissive_factor.filter(|_| !is_unlit).unwrap_or([0.0; 3]);
        let mut emissive = emissive.map(|part| part.max(0.0) * strength.max(0.0));
        let emissive_info = described.emissive_texture.as_deref().filter(|_| emissive != [0.0; 3]);
        let emissive_texture = emissive_info.and_then(|info| self.texture(info, set));
        // Factors beside a texture are mostly 1: alone they say little.
        if described.emissive_texture.is_some() && emissive_texture.is_none() {
            emissive = [0.0; 3];
        }
        if is_unlit {
            self.say("its unlit materials keep their colours in any light".to_owned());
        } else if described.normal_texture.is_some() {
            self.say("textures of normals are left out: light falls by the normals of vertices".to_owned());
        }
        if extensions.transmission.as_ref().is_some_and(|glass| glass.transmission_factor > 0.0) {
            self.say(format!("material `{name}` lets light through: it is shown opaque"));
        }
        let alpha_cutoff = match described.alpha_mode {
            AlphaMode::Opaque => None,
            AlphaMode::Mask => Some(described.alpha_cutoff.unwrap_or(0.5)),
            AlphaMode::Blend => {
                self.say(format!("material `{name}` is see-through: it is shown where it is half there or more"));
                Some(BLEND_CUTOFF)
            }
        };
        Material { name, emissive, emissive_texture, alpha_cutoff, is_unlit, ..surface }
    }

    /// Base colour, roughness and metallic as glTF itself describes them.
    fn rough(&mut self, rough: &MetallicRoughness, set: u32, is_unlit: bool) -> Material {
        let base_color_texture = rough.base_color_texture.as_ref().and_then(|info| self.texture(info, set));
        let info = rough.metallic_roughness_texture.as_ref().filter(|_| !is_unlit);
        let metallic_roughness_texture = info.and_then(|info| self.texture(info, set));
        // A factor says little without its texture.
        let is_lost = info.is_some() && metallic_roughness_texture.is_none();
        Material {
            base_color: rough.base_color_factor.unwrap_or([1.0; 4]).map(|part| part.clamp(0.0, 1.0)),
            base_color_texture,
            metallic: if is_unlit || is_lost { 0.0 } else { unit(rough.metallic_factor) },
            roughness: if is_unlit { 1.0 } else { unit(rough.roughness_factor) },
            metallic_roughness_texture,
            ..Material::default()
        }
    }

    /// Those that diffuse and specular colours become.
    fn glossy(&mut self, glossy: &SpecularGlossiness, set: u32, is_unlit: bool) -> Material {
        let diffuse_texture = glossy.diffuse_texture.as_ref().and_then(|info| self.texture(info, set));
        let info = glossy.specular_glossiness_texture.as_ref().filter(|_| !is_unlit);
        let specular_texture = info.and_then(|info| self.texture(info, set));
        let [red, green, blue, coverage] = glossy.diffuse_factor.unwrap_or([1.0; 4]);
        let coverage = coverage.clamp(0.0, 1.0);
        let roughness = 1.0 - unit(glossy.glossiness_factor);
        // Glossiness without a texture is the material's roughness: its images have all of that.
        let (glossiness, roughness_of_images) =
            if specular_texture.is_some() { (1.0 - roughness, 1.0) } else { (0.0, roughness) };
        let mut factors = Factors::new([red, green, blue], glossy.specular_factor.unwrap_or([1.0; 3]), glossiness);
        // A factor says little without its texture, and an unlit surface reflects nothing.
        if is_unlit || info.is_some() && specular_texture.is_none() {
            factors = factors.of_dielectric();
        }
        if specular_texture.is_some() || diffuse_texture.is_some() && !factors.is_dielectric() {
            let pair = self.images.metal([diffuse_texture, specular_texture], factors);
            if pair.is_none() {
                self.say("a texture of reflections that belongs to several others is left out".to_owned());
            }
            if let Some([color, metal]) = pair {
                return Material {
                    base_color: [1.0, 1.0, 1.0, coverage],
                    base_color_texture: Some(color),
                    metallic: 1.0,
                    roughness: roughness_of_images,
                    metallic_roughness_texture: Some(metal),
                    ..Material::default()
                };
            }
            factors = factors.of_dielectric();
        }
        let ([red, green, blue], metallic) = factors.convert();
        Material {
            base_color: [red, green, blue, coverage],
            base_color_texture: diffuse_texture,
            metallic,
            roughness,
            ..Material::default()
        }
    }

    /// A use of a texture; `None` if it has no image that is read, or other coordinates than `set`.
    fn texture(&mut self, info: &TextureInfo, set: u32) -> Option<TextureUse> {
        if info.set() != set {
            self.say("a texture with coordinates of its own is left out".to_owned());
            return None;
        }
        let Some(texture) = self.document.textures.get(info.index) else {
            self.say(format!("there is no texture {}", info.index));
            return None;
        };
        let source = texture.extensions.webp.as_ref().and_then(|webp| webp.source).or(texture.source);
        let image = source.ok_or_else(|| "it has no image that is read (PNG, JPEG, WebP)".to_owned());
        let image = match image.and_then(|source| self.images.number(source)) {
            Ok(image) => image,
            Err(fault) => {
                self.say(format!("texture {} is left out: {fault}", info.index));
                return None;
            }
        };
        let sampler = texture.sampler.and_then(|sampler| self.document.samplers.get(sampler));
        let wrap = |mode: Option<u32>| match mode {
            Some(33071) => Wrap::Clamp,
            Some(33648) => Wrap::Mirror,
            _ => Wrap::Repeat,
        };
        let wrap = sampler.map_or([Wrap::Repeat; 2], |sampler| [wrap(sampler.wrap_s), wrap(sampler.wrap_t)]);
        Some(TextureUse { image, wrap, transform: transform(info) })
    }

    /// Gives a draft the materials, and says what was left out. `of_triangles` holds 0 for no material, or its number plus 1.
    pub(super) fn finish(self, draft: &mut Draft, of_triangles: Vec<u16>) {
        let Self { mut materials, images, remarks, .. } = self;
        draft.remarks.extend(remarks);
        draft.images = images.finish(&mut materials);
        if materials.is_empty() {
            return;
        }
        let look = &mut draft.mesh.materials;
        let has_bare = of_triangles.contains(&0);
        if has_bare {
            materials.insert(0, Material::default());
        }
        if materials.len() > 1 {
            look.of_triangles = of_triangles;
            if !has_bare {
                look.of_triangles.iter_mut().for_each(|number| *number -= 1);
            }
        }
        look.materials = materials;
    }
}

/// The texture whose coordinates a mesh keeps.
fn first_texture(material: &Described) -> Option<&TextureInfo> {
    let rough = &material.pbr_metallic_roughness;
    let [first, second] = match material.extensions.specular_glossiness.as_deref() {
        Some(glossy) => [&glossy.diffuse_texture, &glossy.specular_glossiness_texture],
        None => [&rough.base_color_texture, &rough.metallic_roughness_texture],
    };
    first.as_ref().or(second.as_ref()).or(material.emissive_texture.as_deref())
}

/// A factor, which is 1 if the file has none.
fn unit(factor: Option<f32>) -> f32 {
    factor.unwrap_or(1.0).clamp(0.0, 1.0)
}

/// Scaled, then turned, then moved.
fn transform(info: &TextureInfo) -> [[f32; 3]; 2] {
    let Some(transform) = info.extensions.transform.as_deref() else { return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] };
    let ([u, v], [su, sv]) = (transform.offset, transform.scale.unwrap_or([1.0; 2]));
    let (sine, cosine) = sine_and_cosine(transform.rotation.into());
    [[cosine * su, sine * sv, u], [-sine * su, cosine * sv, v]]
}

/// By series and doubled angles: `sin_cos` differs between platforms, + − × do not.
fn sine_and_cosine(angle: f64) -> (f32, f32) {
    const DOUBLINGS: i32 = 12;
    let turns = (angle / std::f64::consts::TAU).round();
    let x = (angle - turns * std::f64::consts::TAU) * (1.0 / f64::from(1 << DOUBLINGS));
    let mut sine = x - x * x * x / 6.0 + x * x * x * x * x / 120.0;
    let mut cosine = 1.0 - x * x / 2.0 + x * x * x * x / 24.0;
    for _ in 0..DOUBLINGS {
        (sine, cosine) = (2.0 * sine * cosine, cosine * cosine - sine * sine);
    }
    (sine as f32, cosine as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sines_are_those_of_the_standard_library() {
        for k in -1000..1000 {
            let angle = f64::from(k) * 0.05;
            let (sine, cosine) = sine_and_cosine(angle);
            assert!((f64::from(sine) - angle.sin()).abs() < 1e-6 && (f64::from(cosine) - angle.cos()).abs() < 1e-6);
        }
    }
}
