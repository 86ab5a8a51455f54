//! Materials and their textures.

use std::collections::{HashMap, HashSet};

use crate::formats::{
    file::Draft,
    gltf::{
        buffers::{Buffers, data_of, file_name},
        document::{AlphaMode, Document, Material as Described, TextureInfo},
    },
    images::{Channels, ImageSource},
};
use crate::model::material::{Material, TextureUse, Wrap};

/// Where a blended surface is half there, it is there.
const BLEND_CUTOFF: f32 = 0.5;

/// The materials that triangles use.
pub(super) struct Look<'a> {
    document: &'a Document<'a>,
    buffers: &'a Buffers<'a>,
    materials: Vec<Material>,
    /// The number of each material of the document that is used.
    numbers: HashMap<usize, u16>,
    images: Vec<ImageSource>,
    image_numbers: HashMap<usize, u32>,
    /// For a diffuse and a specular image: both, and the first of the two images that they become.
    metals: HashMap<u32, ([u32; 2], u32)>,
    remarks: Vec<String>,
    said: HashSet<String>,
}

impl<'a> Look<'a> {
    pub(super) fn new(document: &'a Document<'a>, buffers: &'a Buffers<'a>) -> Self {
        Self {
            document,
            buffers,
            materials: Vec::new(),
            numbers: HashMap::new(),
            images: Vec::new(),
            image_numbers: HashMap::new(),
            metals: HashMap::new(),
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
        let texture = |look: &mut Self, info: Option<&TextureInfo>| info.and_then(|info| look.texture(info, set));
        let unit = |value: Option<f32>| value.unwrap_or(1.0).clamp(0.0, 1.0);
        let rough = &*described.pbr_metallic_roughness;
        let extensions = &described.extensions;
        let is_unlit = extensions.unlit.is_some();
        let (base_color, mut base_color_texture, mut metallic, roughness, metallic_roughness_texture);
        if let Some(glossy) = extensions.specular_glossiness.as_deref() {
            base_color = glossy.diffuse_factor;
            base_color_texture = texture(self, glossy.diffuse_texture.as_ref());
            let specular = texture(self, glossy.specular_glossiness_texture.as_ref());
            metallic_roughness_texture = base_color_texture.as_mut().zip(specular).and_then(|both| self.metal(both));
            (metallic, roughness) = match metallic_roughness_texture {
                Some(_) => (1.0, 1.0),
                None => (0.0, 1.0 - unit(glossy.glossiness_factor)),
            };
        } else {
            base_color = rough.base_color_factor;
            base_color_texture = texture(self, rough.base_color_texture.as_ref());
            (metallic, roughness) =
                if is_unlit { (0.0, 1.0) } else { (unit(rough.metallic_factor), unit(rough.roughness_factor)) };
            metallic_roughness_texture = texture(self, rough.metallic_roughness_texture.as_ref().filter(|_| !is_unlit));
        }
        let strength = extensions.emissive_strength.as_ref().and_then(|it| it.emissive_strength).unwrap_or(1.0);
        let emissive = described.emissive_factor.filter(|_| !is_unlit).unwrap_or([0.0; 3]);
        let mut emissive = emissive.map(|part| part.max(0.0) * strength.max(0.0));
        let emissive_texture = texture(self, described.emissive_texture.as_deref().filter(|_| emissive != [0.0; 3]));
        // Factors beside a texture are mostly 1: alone they say little.
        if described.emissive_texture.is_some() && emissive_texture.is_none() {
            emissive = [0.0; 3];
        }
        if rough.metallic_roughness_texture.is_some() && metallic_roughness_texture.is_none() {
            metallic = 0.0;
        }
        if is_unlit {
            self.say("its unlit materials keep their colours in any light".to_owned());
        } else if described.normal_texture.is_some() {
            self.say("textures of normals are left out: light falls by the normals of vertices".to_owned());
        }
        let alpha_cutoff = match described.alpha_mode {
            AlphaMode::Opaque => None,
            AlphaMode::Mask => Some(described.alpha_cutoff.unwrap_or(0.5)),
            AlphaMode::Blend => {
                self.say(format!("material `{name}` is see-through: it is shown where it is half there or more"));
                Some(BLEND_CUTOFF)
            }
        };
        Material {
            name,
            base_color: base_color.unwrap_or([1.0; 4]).map(|part| part.clamp(0.0, 1.0)),
            base_color_texture,
            metallic,
            roughness,
            metallic_roughness_texture,
            emissive,
            emissive_texture,
            alpha_cutoff,
            is_unlit,
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
        let Some(image) = source.and_then(|source| self.image(source)) else {
            self.say(format!("texture {} has no image that is read (PNG, JPEG, WebP)", info.index));
            return None;
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

    /// Gives the base colour of a diffuse and a specular texture to the diffuse one; returns that of roughness and metallic.
    ///
    /// An image has a part in one pair alone: a few images must not become thousands.
    fn metal(&mut self, (diffuse, specular): (&mut TextureUse, TextureUse)) -> Option<TextureUse> {
        let pair = [diffuse.image, specular.image];
        let first = match pair.iter().find_map(|image| self.metals.get(image)) {
            Some(&(other, first)) if other == pair => first,
            Some(_) => {
                self.say("a texture of reflections that belongs to several others is left out".to_owned());
                return None;
            }
            None => {
                let [source, other] = pair.map(|image| self.images[image as usize].clone());
                let first = self.images.len() as u32;
                for channels in [Channels::BaseColorWithSpecular, Channels::MetalWithSpecular] {
                    self.images.push(ImageSource { channels: channels(Box::new(other.clone())), ..source.clone() });
                }
                self.metals.extend(pair.map(|image| (image, (pair, first))));
                first
            }
        };
        diffuse.image = first;
        Some(TextureUse { image: first + 1, ..*diffuse })
    }

    fn image(&mut self, index: usize) -> Option<u32> {
        if let Some(&number) = self.image_numbers.get(&index) {
            return Some(number);
        }
        let image = self.document.images.get(index)?;
        let source = match (image.uri.as_deref(), image.buffer_view) {
            (Some(uri), _) => match uri.strip_prefix("data:") {
                Some(data) => embedded(index, data_of(data).ok()?),
                None => ImageSource::file(file_name(uri)),
            },
            (None, Some(view)) => embedded(index, self.buffers.view(self.document, view).ok()?.0.to_vec()),
            (None, None) => return None,
        };
        let number = self.images.len() as u32;
        self.images.push(source);
        self.image_numbers.insert(index, number);
        Some(number)
    }

    /// Gives a draft the materials, and says what was left out. `of_triangles` holds 0 for no material, or its number plus 1.
    pub(super) fn finish(self, draft: &mut Draft, of_triangles: Vec<u16>) {
        let Self { mut materials, images, remarks, .. } = self;
        draft.remarks.extend(remarks);
        draft.images = images;
        if materials.is_empty() {
            return;
        }
        drop_unused(&mut materials, &mut draft.images);
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

/// Drops images that became parts of others.
fn drop_unused(materials: &mut [Material], images: &mut Vec<ImageSource>) {
    let textures = |material: &Material| {
        [material.base_color_texture, material.metallic_roughness_texture, material.emissive_texture]
    };
    let used: HashSet<u32> = materials.iter().flat_map(textures).flatten().map(|texture| texture.image).collect();
    let places: Vec<_> = (0..images.len() as u32)
        .scan(0, |n, image| {
            let place = *n;
            *n += u32::from(used.contains(&image));
            Some(place)
        })
        .collect();
    let mut number = 0..;
    images.retain(|_| number.next().is_some_and(|number| used.contains(&number)));
    for material in materials {
        let Material { base_color_texture, metallic_roughness_texture, emissive_texture, .. } = material;
        for texture in [base_color_texture, metallic_roughness_texture, emissive_texture].into_iter().flatten() {
            texture.image = places[texture.image as usize];
        }
    }
}

/// The texture whose coordinates a mesh keeps.
fn first_texture(material: &Described) -> Option<&TextureInfo> {
    let rough = &material.pbr_metallic_roughness;
    let glossy = material.extensions.specular_glossiness.as_deref().and_then(|glossy| glossy.diffuse_texture.as_ref());
    glossy
        .or(rough.base_color_texture.as_ref())
        .or(rough.metallic_roughness_texture.as_ref())
        .or(material.emissive_texture.as_deref())
}

fn embedded(index: usize, bytes: Vec<u8>) -> ImageSource {
    ImageSource { bytes: Some(bytes), ..ImageSource::file(format!("image {index}")) }
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
