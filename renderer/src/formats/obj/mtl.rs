//! Files of materials (MTL).

use std::collections::{BTreeSet, HashMap};

use crate::formats::{
    file::BYTE_ORDER_MARK,
    images::{Channels, ImageSource},
    obj::piece::text,
};
use crate::model::material::{Material, TextureUse, Wrap};

/// The materials of one or more files.
#[derive(Debug, Default)]
pub struct Library {
    /// In the order of the files; the first of equal names counts.
    pub materials: Vec<Material>,
    /// The images that they use.
    pub images: Vec<ImageSource>,
    /// Remarks on parts that were left out.
    pub remarks: Vec<String>,
    /// The place of each image.
    places: HashMap<ImageSource, u32>,
    /// The folder of the file that is being read, relative to the model's.
    folder: String,
    /// Words in it that name images which are not read.
    others: BTreeSet<&'static str>,
    /// Remarks on its materials, each once.
    of_materials: BTreeSet<&'static str>,
}

/// Words that name images which are not read.
const OTHER_MAPS: [&str; 9] = ["map_Ks", "map_Ns", "map_Ps", "map_Bump", "bump", "norm", "disp", "decal", "refl"];

/// Programs write it for a texture that decides where a surface is.
const CUTOFF: f32 = 0.5;

/// The maps of a material, and how much light passes through it, of which many programs write both numbers.
#[derive(Default)]
struct Maps {
    color: Option<Map>,
    emissive: Option<Map>,
    roughness: Option<Map>,
    metallic: Option<Map>,
    coverage: Option<Map>,
    ambient: Option<String>,
    has_transparency: bool,
    /// `d`, which counts more than `Tr`, its complement.
    opacity: Option<f32>,
    transparency: Option<f32>,
}

/// A texture: its file, and how coordinates lead to it.
struct Map {
    name: String,
    wrap: Wrap,
    scale: [f32; 2],
    offset: [f32; 2],
}

impl Library {
    /// Adds the materials of a file, whose images are looked for in `folder`, relative to the model's, and then in the
    /// model's. What is not understood is left out.
    pub fn read(&mut self, bytes: &[u8], folder: &str) {
        folder.clone_into(&mut self.folder);
        let mut maps = Maps::default();
        let n_before = self.materials.len();
        let bytes = bytes.strip_prefix(BYTE_ORDER_MARK).unwrap_or(bytes);
        for line in bytes.split(|&byte| matches!(byte, b'\n' | b'\r')) {
            // Some programs indent lines.
            let line = text(line.trim_ascii_start());
            let (word, rest) = line.split_once(char::is_whitespace).unwrap_or((&line, ""));
            let rest = rest.trim();
            if word == "newmtl" {
                self.finish(std::mem::take(&mut maps), n_before);
                self.materials.push(Material { name: rest.to_owned(), ..Material::default() });
                continue;
            }
            let Some(material) = self.materials[n_before..].last_mut() else { continue };
            // `d -halo` has its number last.
            let number = rest.split_whitespace().find_map(|word| word.parse::<f32>().ok());
            let number = number.map(|number| number.clamp(0.0, 1.0));
            match word.to_ascii_lowercase().as_str() {
                "kd" | "ke" if color(rest).is_none() => {
                    self.remarks.push(format!("{word} {rest} of a material is left out: its three values are numbers"));
                }
                "kd" => color(rest).into_iter().for_each(|[r, g, b]| material.base_color = [r, g, b, 1.0]),
                "ke" => color(rest).into_iter().for_each(|color| material.emissive = color),
                "pm" => number.into_iter().for_each(|number| material.metallic = number),
                "pr" => number.into_iter().for_each(|number| material.roughness = number),
                "d" => maps.opacity = number,
                "tr" => maps.transparency = number,
                "map_kd" => maps.color = Map::parse(rest),
                "map_ke" => maps.emissive = Map::parse(rest),
                "map_pr" => maps.roughness = Map::parse(rest),
                "map_pm" => maps.metallic = Map::parse(rest),
                "map_d" => maps.coverage = Map::parse(rest),
                "map_tr" => maps.has_transparency = true,
                "map_ka" => maps.ambient = Map::parse(rest).map(|map| map.name),
                other => self.others.extend(OTHER_MAPS.iter().find(|it| it.eq_ignore_ascii_case(other))),
            }
        }
        self.finish(maps, n_before);
        let others = Vec::from_iter(std::mem::take(&mut self.others)).join(", ");
        if !others.is_empty() {
            self.remarks.push(format!(
                "textures of {others} are left out: of a material, map_Kd, map_Ke, map_Pr, map_Pm and map_d are read"
            ));
        }
        self.remarks.extend(std::mem::take(&mut self.of_materials).into_iter().map(str::to_owned));
    }

    /// Gives the last material, if any since `n_before`, its textures.
    fn finish(&mut self, maps: Maps, n_before: usize) {
        if self.materials.len() == n_before {
            return;
        }
        let Maps { color, emissive, roughness, metallic, ambient, .. } = maps;
        // Most programs repeat the colour there.
        if ambient.is_some_and(|name| color.as_ref().is_none_or(|map| map.name != name)) {
            self.others.insert("map_Ka");
        }
        // Some programs repeat the coverage there.
        if maps.has_transparency && maps.coverage.is_none() {
            self.others.insert("map_Tr");
        }
        let opacity = maps.opacity.or(maps.transparency.map(|transparency| 1.0 - transparency));
        if opacity.is_some_and(|opacity| opacity < 1.0) {
            self.of_materials.insert("see-through materials are shown opaque");
        }
        let fault = match (&maps.coverage, &color) {
            (Some(_), None) => Some("a texture of coverage (map_d) without one of colour (map_Kd) is left out"),
            // They become one image, with one way to it.
            (Some(map), Some(color)) if (map.scale, map.offset) != (color.scale, color.offset) => {
                Some("a texture of coverage (map_d) with other -s or -o than that of colour (map_Kd) is left out")
            }
            _ => None,
        };
        self.of_materials.extend(fault);
        let coverage = maps.coverage.filter(|_| fault.is_none()).map(|map| map.name);
        // The same file has the coverage in its own fourth channel.
        let other_file = |map: &Map| coverage.clone().filter(|name| *name != map.name);
        let color_texture =
            color.map(|map| self.texture(&map, other_file(&map).map_or(Channels::Whole, Channels::Coverage)));
        let emissive_texture = emissive.map(|map| self.texture(&map, Channels::Whole));
        let [has_roughness, has_metallic] = [&roughness, &metallic].map(Option::is_some);
        let glossy = match (roughness, metallic) {
            // The same file has them where glTF has.
            (Some(roughness), Some(metallic)) if roughness.name == metallic.name => Some((roughness, Channels::Whole)),
            (Some(roughness), Some(metallic)) => Some((roughness, Channels::RoughnessAndMetallic(metallic.name))),
            (Some(roughness), None) => Some((roughness, Channels::Roughness)),
            (None, metallic) => metallic.map(|metallic| (metallic, Channels::Metallic)),
        };
        let glossy_texture = glossy.map(|(map, channels)| self.texture(&map, channels));
        let Some(material) = self.materials.last_mut() else { return };
        // Many programs write a black `Kd` or `Ke` beside a texture, which is not meant to darken it.
        if color_texture.is_some() && material.base_color[..3] == [0.0; 3] {
            material.base_color = [1.0; 4];
        }
        if emissive_texture.is_some() && material.emissive == [0.0; 3] {
            material.emissive = [1.0; 3];
        }
        if glossy_texture.is_some() {
            let full = |factor: f32, has_texture: bool| if has_texture && factor == 0.0 { 1.0 } else { factor };
            material.roughness = full(material.roughness, has_roughness);
            material.metallic = full(material.metallic, has_metallic);
        }
        material.metallic_roughness_texture = glossy_texture;
        material.alpha_cutoff = coverage.map(|_| CUTOFF);
        (material.base_color_texture, material.emissive_texture) = (color_texture, emissive_texture);
    }

    fn texture(&mut self, map: &Map, channels: Channels) -> TextureUse {
        let source = ImageSource { channels, folder: self.folder.clone(), ..ImageSource::file(&map.name) };
        let image = *self.places.entry(source).or_insert_with_key(|source| {
            self.images.push(source.clone());
            self.images.len() as u32 - 1
        });
        // MTL counts v from the lower edge: 1 − v′ = scale (1 − v) + offset.
        let ([su, sv], [ou, ov]) = (map.scale, map.offset);
        let transform = [[su, 0.0, ou], [0.0, sv, 1.0 - sv - ov]];
        TextureUse { image, wrap: [map.wrap; 2], transform }
    }
}

impl Map {
    /// Parses options, each with its arguments, and a name that may contain spaces.
    fn parse(text: &str) -> Option<Self> {
        let mut map = Self { name: String::new(), wrap: Wrap::Repeat, scale: [1.0; 2], offset: [0.0; 2] };
        let mut rest = text.trim();
        while let Some((option, after)) = rest.split_once(char::is_whitespace).filter(|_| rest.starts_with('-')) {
            rest = after.trim_start();
            // The most arguments, and whether they are numbers, of which there may be fewer.
            let (most, are_numbers) = match option.to_ascii_lowercase().as_str() {
                "-s" | "-o" | "-t" => (3, true),
                "-mm" => (2, true),
                "-bm" | "-boost" | "-texres" => (1, true),
                "-clamp" | "-blendu" | "-blendv" | "-cc" | "-imfchan" | "-type" | "-colorspace" => (1, false),
                _ => (0, false),
            };
            let mut arguments = Vec::new();
            while arguments.len() < most {
                let (word, after) = rest.split_once(char::is_whitespace).unwrap_or((rest, ""));
                if are_numbers && word.parse::<f32>().is_err() {
                    break;
                }
                arguments.push(word);
                rest = after.trim_start();
            }
            let numbers: Vec<f32> = arguments.iter().filter_map(|word| word.parse().ok()).collect();
            match (option, numbers.as_slice()) {
                ("-s", [u, rest @ ..]) => map.scale = [*u, rest.first().copied().unwrap_or(1.0)],
                ("-o", [u, rest @ ..]) => map.offset = [*u, rest.first().copied().unwrap_or(0.0)],
                ("-clamp", _) if arguments == ["on"] => map.wrap = Wrap::Clamp,
                _ => {}
            }
        }
        map.name = rest.trim_matches('"').to_owned();
        (!map.name.is_empty()).then_some(map)
    }
}

/// Red, green and blue, taken as linear: MTL names no colour space.
fn color(text: &str) -> Option<[f32; 3]> {
    let mut numbers = text.split_whitespace().map_while(|word| word.parse::<f32>().ok());
    let red = numbers.next()?;
    let others = [numbers.next().unwrap_or(red), numbers.next().unwrap_or(red)];
    Some([red, others[0], others[1]].map(|number| if number.is_nan() { 0.0 } else { number.clamp(0.0, 1.0) }))
}
