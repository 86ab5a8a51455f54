//! Images that textures show: where their bytes are, and which become parts of others.

use std::collections::{HashMap, HashSet};

use crate::formats::{
    gltf::{
        buffers::{Buffers, data_of, file_name},
        document::Document,
    },
    images::{Channels, Glossy, ImageSource, Role},
    specular::Factors,
};
use crate::model::material::{Material, TextureUse};

/// How often an image may become part of others: as with several factors for one atlas.
const MOST_PARTS: usize = 4;

/// The images of the materials that triangles use.
pub(super) struct Images<'a> {
    document: &'a Document<'a>,
    buffers: &'a Buffers<'a>,
    sources: Vec<ImageSource>,
    /// The number of each image of the document that is used, or why it is not there.
    numbers: HashMap<usize, Result<u32, String>>,
    /// The same by its place: the document may list an image again and again.
    of_places: HashMap<Place<'a>, Result<u32, String>>,
    /// Bytes of buffers that are not in images yet.
    n_bytes_left: usize,
    /// The first of the two images that diffuse and specular images become.
    metals: HashMap<GlossyImages, u32>,
    /// How often an image has become part of others.
    n_parts: HashMap<u32, usize>,
}

/// The images of a diffuse and a specular colour, and the factors that change them.
type GlossyImages = ([Option<u32>; 2], Factors);

/// Where an image's bytes are.
#[derive(PartialEq, Eq, Hash)]
enum Place<'a> {
    /// In a URI, or in the file that it names.
    Uri(&'a str),
    /// In a buffer, from an offset on, and how many.
    Bytes { buffer: usize, start: usize, n: usize },
}

impl<'a> Images<'a> {
    pub(super) fn new(document: &'a Document<'a>, buffers: &'a Buffers<'a>) -> Self {
        Self {
            document,
            buffers,
            sources: Vec::new(),
            numbers: HashMap::new(),
            of_places: HashMap::new(),
            n_bytes_left: buffers.n_bytes,
            metals: HashMap::new(),
            n_parts: HashMap::new(),
        }
    }

    /// The number of an image of the document.
    ///
    /// # Errors
    /// A text that says why it cannot be had.
    pub(super) fn number(&mut self, index: usize) -> Result<u32, String> {
        if let Some(number) = self.numbers.get(&index) {
            return number.clone();
        }
        let number = self.find(index);
        self.numbers.insert(index, number.clone());
        number
    }

    fn find(&mut self, index: usize) -> Result<u32, String> {
        let document = self.document;
        let image = document.images.get(index).ok_or_else(|| format!("there is no image {index}"))?;
        let place = match image.uri.as_deref() {
            Some(uri) => Place::Uri(uri),
            None => {
                let view = image.buffer_view.ok_or_else(|| format!("image {index} is nowhere"))?;
                let view = document.buffer_views.get(view).ok_or_else(|| format!("there is no buffer view {view}"))?;
                Place::Bytes { buffer: view.buffer, start: view.byte_offset, n: view.byte_length }
            }
        };
        if let Some(number) = self.of_places.get(&place) {
            return number.clone();
        }
        let number = self.source(index, &place).map(|source| {
            self.sources.push(source);
            self.sources.len() as u32 - 1
        });
        self.of_places.insert(place, number.clone());
        number
    }

    fn source(&mut self, index: usize, place: &Place<'_>) -> Result<ImageSource, String> {
        let embedded = |bytes| ImageSource { bytes: Some(bytes), ..ImageSource::file(format!("image {index}")) };
        match *place {
            Place::Uri(uri) => match uri.strip_prefix("data:") {
                Some(data) => Ok(embedded(data_of(data)?)),
                None => Ok(ImageSource::file(file_name(uri))),
            },
            Place::Bytes { buffer, start, n } => {
                let bytes = self.buffers.part(buffer, start, n)?;
                // Images do not share bytes, so all of them together have no more than the file.
                let n_left = self.n_bytes_left.checked_sub(n);
                self.n_bytes_left = n_left.ok_or("images share their bytes: export the model again")?;
                Ok(embedded(bytes.to_vec()))
            }
        }
    }

    /// The textures of the base colour, and of roughness and metallic, that a diffuse and a specular texture become.
    ///
    /// An image has a part in [`MOST_PARTS`] such pairs: a few images must not become thousands. `None` if it has.
    pub(super) fn metal(&mut self, textures: [Option<TextureUse>; 2], factors: Factors) -> Option<[TextureUse; 2]> {
        let images = textures.map(|texture| texture.map(|texture| texture.image));
        let glossy = (images, factors);
        let parts = || images.into_iter().flatten();
        let first = match self.metals.get(&glossy) {
            Some(&first) => first,
            None if parts().any(|image| self.n_parts.get(&image) == Some(&MOST_PARTS)) => return None,
            None => {
                let source = |image: u32| self.sources[image as usize].clone();
                let (source, role) = match images.map(|image| image.map(source)) {
                    [Some(diffuse), Some(specular)] => (diffuse, Role::DiffuseBeside(specular)),
                    [Some(diffuse), None] => (diffuse, Role::Diffuse),
                    [None, Some(specular)] => (specular, Role::Specular),
                    [None, None] => return None,
                };
                let first = self.sources.len() as u32;
                for channels in [Channels::BaseColorOfGlossy, Channels::MetalOfGlossy] {
                    let channels = channels(Box::new(Glossy { role: role.clone(), factors }));
                    self.sources.push(ImageSource { channels, ..source.clone() });
                }
                self.metals.insert(glossy, first);
                parts().for_each(|image| *self.n_parts.entry(image).or_default() += 1);
                first
            }
        };
        let [diffuse, specular] = textures;
        let texture = diffuse.or(specular)?;
        Some([first, first + 1].map(|image| TextureUse { image, ..texture }))
    }

    /// The images that materials use, which they name by their index among these: not those that became parts of others.
    pub(super) fn finish(self, materials: &mut [Material]) -> Vec<ImageSource> {
        let mut images = self.sources;
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
        images
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::gltf::tests::{self, ACCESSORS, PRIMITIVE, glb, parse, square, with_material_and};

    #[test]
    fn an_image_that_is_listed_again_is_kept_once() {
        let textures: Vec<_> = (0..6).map(|source| format!(r#"{{"source":{source}}}"#)).collect();
        let materials: Vec<_> = (0..6)
            .map(|index| format!(r#"{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":{index}}}}}}}"#))
            .collect();
        let primitives: Vec<_> =
            (0..6).map(|material| PRIMITIVE.replacen('{', &format!(r#"{{"material":{material},"#), 1)).collect();
        let more = format!(
            r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{}]}}],"materials":[{}],"textures":[{}],"images":[
            {{"bufferView":0}},{{"bufferView":1}},{{"uri":"a.png"}},{{"uri":"a.png"}},{{"uri":"data:?"}},{{"bufferView":2}}],{}"#,
            primitives.join(","),
            materials.join(","),
            textures.join(","),
            ACCESSORS.replace(
                r#""bufferViews":["#,
                r#""bufferViews":[{"buffer":0,"byteLength":72},{"buffer":0,"byteLength":72},{"buffer":0,"byteLength":71}],"unused":["#
            )
        );
        let draft = parse(&glb(&more, &square())).unwrap();
        let materials = &draft.mesh.materials.materials;
        let images: Vec<_> = materials.iter().map(|it| it.base_color_texture.map(|texture| texture.image)).collect();
        assert_eq!(images, [Some(0), Some(0), Some(1), Some(1), None, None]);
        assert_eq!(draft.images.len(), 2);
        assert_eq!(
            draft.remarks,
            [
                "texture 4 is left out: a data URI is damaged: export the model again",
                "texture 5 is left out: images share their bytes: export the model again"
            ]
        );
    }

    #[test]
    fn diffuse_and_specular_images_become_base_colour_and_metal() {
        let texture = |index: u32| format!(r#"{{"index":{index}}}"#);
        let glossy = |more: &str| {
            format!(
                r#"{{"extensions":{{"KHR_materials_pbrSpecularGlossiness":{{"glossinessFactor":0.25,"diffuseTexture":{}{more}}}}}}}"#,
                texture(1)
            )
        };
        let images = r#","textures":[{"source":0},{"source":1}],"images":[{"uri":"s.png"},{"uri":"d.png"}]"#;
        let draft = |more: &str| with_material_and(&glossy(more), images);
        let both = draft(&format!(r#","specularGlossinessTexture":{}"#, texture(0)));
        let material = &both.mesh.materials.materials[0];
        let image = |texture: Option<TextureUse>| both.images[texture.unwrap().image as usize].clone();
        let diffuse = ImageSource::file("d.png");
        let factors = Factors::new([1.0; 3], [1.0; 3], 0.25);
        let glossy_images = || Box::new(Glossy { role: Role::DiffuseBeside(ImageSource::file("s.png")), factors });
        let channels = Channels::BaseColorOfGlossy(glossy_images());
        assert_eq!(image(material.base_color_texture), ImageSource { channels, ..diffuse.clone() });
        let channels = Channels::MetalOfGlossy(glossy_images());
        assert_eq!(image(material.metallic_roughness_texture), ImageSource { channels, ..diffuse.clone() });
        assert_eq!((material.metallic, material.roughness, both.images.len()), (1.0, 1.0, 2));
        // Materials share what their images become; an image has a part in four pairs alone.
        let six = [(1, 1.0), (1, 1.0), (2, 1.0), (1, 0.5), (1, 0.25), (1, 0.125)].map(|(diffuse, factor)| {
            let more = format!(r#","specularFactor":[1,1,{factor}],"specularGlossinessTexture":{}"#, texture(0));
            glossy(&more)
                .replace(r#""diffuseTexture":{"index":1}"#, &format!(r#""diffuseTexture":{}"#, texture(diffuse)))
        });
        let images =
            images.replace(r#""textures":["#, r#""textures":[{"source":0},{"source":1},{"source":2}],"unused":["#);
        let images = images.replace(r#"{"uri":"d.png"}"#, r#"{"uri":"d.png"},{"uri":"e.png"}"#);
        let primitives =
            [0, 1, 2, 3, 4, 5].map(|material| PRIMITIVE.replacen('{', &format!(r#"{{"material":{material},"#), 1));
        let six = tests::draft(&format!(
            r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{}]}}],"materials":[{}]{images}"#,
            primitives.join(","),
            six.join(",")
        ));
        let images = |material: &Material| {
            [material.base_color_texture, material.metallic_roughness_texture].map(|it| it.map(|texture| texture.image))
        };
        let images: Vec<_> = six.mesh.materials.materials.iter().map(images).collect();
        let pair = |first| [Some(first), Some(first + 1)];
        // The last one shows its diffuse image, the first of all.
        assert_eq!(images, [pair(1), pair(1), pair(3), pair(5), pair(7), [Some(0), None]]);
        assert_eq!(six.mesh.materials.materials[5].metallic, 0.0);
        assert_eq!(six.remarks, ["a texture of reflections that belongs to several others is left out"]);
        // A stone needs no image of metal.
        let alone = draft(r#","specularFactor":[0.04,0.04,0.04]"#);
        let material = &alone.mesh.materials.materials[0];
        assert_eq!((material.metallic, material.roughness, alone.images), (0.0, 0.75, vec![diffuse]));
    }
}
