//! Decodes the images of a model.

use std::io::Cursor;

use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat, ImageReader, ImageResult, Limits};
use rayon::prelude::*;

use crate::formats::{
    companions::Companions,
    file::{Draft, Reading},
    foreign,
    specular::Factors,
};
use crate::model::material::{Image, TextureUse};

/// The longest side of an image.
const LARGEST_SIDE: u32 = 32_768;
/// The most texels of an image, which take 2 GB.
const MOST_TEXELS: u64 = 1 << 29;
/// An image may take this many times its file in memory, and [`SMALL_IMAGE`] in any case: no more than PNG and JPEG do for
/// a plain colour, so a small file cannot fill the memory.
const LARGEST_RATIO: u64 = 4096;
const SMALL_IMAGE: u64 = 1 << 20;
/// A texel that changes no factor.
const WHITE: [u8; 4] = [u8::MAX; 4];
/// The longest file of an image.
const LONGEST_FILE: u64 = 1 << 31;

/// An encoded image, and the channels that other images give it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct ImageSource {
    /// The name of its file; of an image within the model's file, its name in errors.
    pub name: String,
    /// The folder of the file that names it, relative to the model's.
    pub folder: String,
    /// Its bytes, if they are in the model's file.
    pub bytes: Option<Vec<u8>>,
    /// How its channels are put together.
    pub channels: Channels,
}

/// How the channels of an image are put together from grey images, each of which is named by its file.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub enum Channels {
    /// All are in the image.
    #[default]
    Whole,
    /// Another image is its coverage.
    Coverage(String),
    /// It is grey, and becomes roughness; metallic is full.
    Roughness,
    /// It is grey, and becomes metallic; roughness is full.
    Metallic,
    /// It is grey, and becomes roughness; another image becomes metallic.
    RoughnessAndMetallic(String),
    /// Diffuse and specular colours make the base colour.
    BaseColorOfGlossy(Box<Glossy>),
    /// Diffuse and specular colours and glossiness make roughness and metallic.
    MetalOfGlossy(Box<Glossy>),
}

/// The diffuse and specular colours of a surface with an image.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Glossy {
    /// The image's.
    pub role: Role,
    /// They multiply images, or stand alone.
    pub factors: Factors,
}

/// The role of an image beside factors.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// The diffuse colour; specular colour and glossiness are in another image.
    DiffuseBeside(ImageSource),
    /// The diffuse colour; the other has none.
    Diffuse,
    /// Specular colour and glossiness; the diffuse colour has none.
    Specular,
}

impl ImageSource {
    /// An image in a file of its own.
    pub(super) fn file(name: impl Into<String>) -> Self {
        Self { name: name.into(), ..Self::default() }
    }
}

/// Decodes all images of a draft. One that cannot be used is left out, and a remark says why.
pub fn decode(draft: Draft, companions: &Companions) -> Reading {
    let Draft { mut mesh, images, mut remarks } = draft;
    let decoded: Vec<_> = images.par_iter().map(|source| decode_source(source, companions)).collect();
    let mut places = Vec::new();
    for image in decoded {
        places.push(image.as_ref().ok().map(|_| mesh.materials.images.len() as u32));
        match image {
            Ok(image) => mesh.materials.images.push(image),
            Err(fault) => remarks.push(format!("an image is left out: {fault}")),
        }
    }
    let kept = |texture: TextureUse| {
        let image = places.get(texture.image as usize).copied().flatten()?;
        Some(TextureUse { image, ..texture })
    };
    for material in &mut mesh.materials.materials {
        material.keep_textures(kept);
    }
    Reading { mesh, remarks }
}

fn decode_source(source: &ImageSource, companions: &Companions) -> Result<Image, String> {
    let image = |name: &str, bytes: &[u8]| decode_bytes(name, bytes).map_err(|fault| format!("{name} {fault}"));
    let file = |name: &str| image(name, &companions.read(&source.folder, name, LONGEST_FILE)?);
    let mut decoded = match &source.bytes {
        Some(bytes) => image(&source.name, bytes)?,
        None => file(&source.name)?,
    };
    match &source.channels {
        Channels::Whole => {}
        Channels::Coverage(name) => {
            let coverage = file(name)?;
            let has_own = coverage.texels.iter().any(|texel| texel[3] < u8::MAX);
            merge(&mut decoded, &coverage, |texel, of| texel[3] = if has_own { of[3] } else { of[0] });
        }
        Channels::Roughness => each(&mut decoded, |[grey, ..]| [0, grey, u8::MAX, u8::MAX]),
        Channels::Metallic => each(&mut decoded, |[grey, ..]| [0, u8::MAX, grey, u8::MAX]),
        Channels::RoughnessAndMetallic(name) => {
            let metallic = file(name)?;
            merge(&mut decoded, &metallic, |texel, of| *texel = [0, texel[0], of[0], u8::MAX]);
        }
        Channels::BaseColorOfGlossy(glossy) => {
            // The image of metal says what is missing.
            if convert(&mut decoded, glossy, companions, |[color, _]| color).is_err() {
                let stone = glossy.factors.of_dielectric();
                each(&mut decoded, |texel| stone.texels(texel, WHITE)[0]);
            }
        }
        Channels::MetalOfGlossy(glossy) => convert(&mut decoded, glossy, companions, |[_, metal]| metal)?,
    }
    Ok(decoded)
}

/// Keeps one of the two texels that diffuse and specular colours become. On errors, the image is as it was.
fn convert(
    image: &mut Image,
    Glossy { role, factors }: &Glossy,
    companions: &Companions,
    kept: impl Fn([[u8; 4]; 2]) -> [u8; 4] + Sync,
) -> Result<(), String> {
    match role {
        Role::DiffuseBeside(specular) => {
            let specular = decode_source(specular, companions)?;
            merge(image, &specular, |texel, of| *texel = kept(factors.texels(*texel, of)));
        }
        Role::Diffuse => each(image, |texel| kept(factors.texels(texel, WHITE))),
        Role::Specular => each(image, |texel| kept(factors.texels(WHITE, texel))),
    }
    Ok(())
}

fn each(image: &mut Image, change: impl Fn([u8; 4]) -> [u8; 4] + Sync) {
    image.texels.par_iter_mut().for_each(|texel| *texel = change(*texel));
}

/// Changes each texel by the nearest one of another image.
fn merge(image: &mut Image, other: &Image, change: impl Fn(&mut [u8; 4], [u8; 4]) + Sync) {
    let nearest = |at: usize, size: u32, of: u32| (at as u64 * u64::from(of) / u64::from(size)) as usize;
    let width = image.width as usize;
    image.texels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let row_of = nearest(y, image.height, other.height) * other.width as usize;
        for (x, texel) in row.iter_mut().enumerate() {
            change(texel, other.texels[row_of + nearest(x, image.width, other.width)]);
        }
    });
}

fn decode_bytes(name: &str, bytes: &[u8]) -> Result<Image, String> {
    if bytes.is_empty() {
        return Err("is empty: copy it again".to_owned());
    }
    let mut reader = ImageReader::new(Cursor::new(bytes));
    // TGA has no magic number, so its name must tell.
    if ImageFormat::from_path(name).is_ok_and(|format| format == ImageFormat::Tga) {
        reader.set_format(ImageFormat::Tga);
    }
    let mut reader = reader.with_guessed_format().map_err(|error| format!("cannot be read: {error}"))?;
    // They hold the light of skies, and no colours.
    if matches!(reader.format(), Some(ImageFormat::Hdr | ImageFormat::OpenExr)) {
        reader.clear_format();
    }
    let mut limits = Limits::no_limits();
    limits.max_image_width = Some(LARGEST_SIDE);
    limits.max_image_height = Some(LARGEST_SIDE);
    limits.max_alloc = Some(16 * MOST_TEXELS);
    reader.limits(limits);
    let fault = |error| match error {
        image::ImageError::Limits(_) => format!("is too large: scale it to at most {LARGEST_SIDE} texels a side"),
        image::ImageError::Unsupported(_) => foreign::kind(bytes).map_or_else(
            || "is no image that is read (PNG, JPEG, WebP, TIFF, BMP, TGA): convert it to PNG".to_owned(),
            str::to_owned,
        ),
        error => format!("is damaged: {}; copy it again", error.to_string().trim().replace('\n', " ")),
    };
    let is_jpeg = reader.format() == Some(ImageFormat::Jpeg);
    let decoder = reader.into_decoder().map_err(fault)?;
    if is_jpeg && !is_whole_jpeg(bytes) {
        return Err("is cut off: copy it again".to_owned());
    }
    let (width, height) = decoder.dimensions();
    let n_texels = u64::from(width) * u64::from(height);
    let n_bytes = decoder.total_bytes().max(4 * n_texels);
    if width.max(height) > LARGEST_SIDE || n_texels > MOST_TEXELS {
        return Err(format!("is too large ({width}x{height}): scale it to at most {MOST_TEXELS} texels"));
    }
    if n_texels == 0 || n_bytes > SMALL_IMAGE.saturating_add(LARGEST_RATIO * bytes.len() as u64) {
        return Err(format!("is damaged: {} bytes cannot hold {width}x{height} texels; copy it again", bytes.len()));
    }
    let texels = match decoder.color_type() {
        ColorType::L8 => decode_in_place(decoder, |[grey]| [grey, grey, grey, u8::MAX]),
        ColorType::La8 => decode_in_place(decoder, |[grey, coverage]| [grey, grey, grey, coverage]),
        ColorType::Rgb8 => decode_in_place(decoder, |[red, green, blue]| [red, green, blue, u8::MAX]),
        ColorType::Rgba8 => decode_in_place(decoder, |texel| texel),
        _ => DynamicImage::from_decoder(decoder).map(|image| image.into_rgba8().into_raw()),
    };
    Ok(Image { width, height, texels: bytemuck::allocation::cast_vec(texels.map_err(fault)?) })
}

/// Whether a JPEG reaches the marker of its end: the decoder fills in grey for what is cut off, without a word.
///
/// ITU-T T.81, Annex B: segments of a marker and a length; after a scan's segment its data, in which a zero or a restart
/// marker (D0 to D7) follows each FF.
pub fn is_whole_jpeg(bytes: &[u8]) -> bool {
    const END: u8 = 0xd9;
    let mut at = 2;
    // Look for the next marker; data of scans is passed over byte by byte.
    while let Some(&[first, marker]) = bytes.get(at..at + 2) {
        at += match (first, marker) {
            (0xff, END) => return true,
            (0xff, 0x01 | 0xd0..=0xd7 | 0x00) => 2,
            (0xff, 0xc0..=0xfe) => match bytes.get(at + 2..at + 4) {
                Some(&[high, low]) => 2 + usize::from(u16::from_be_bytes([high, low])),
                _ => return false,
            },
            _ => 1,
        };
    }
    false
}

/// Decodes an image of `N` bytes a texel, and widens each to four where it lies: a copy would nearly double the memory.
fn decode_in_place<const N: usize>(
    decoder: impl ImageDecoder,
    widen: impl Fn([u8; N]) -> [u8; 4],
) -> ImageResult<Vec<u8>> {
    let n_bytes = decoder.total_bytes() as usize;
    let n_texels = n_bytes / N;
    let mut bytes = vec![0; 4 * n_texels];
    let first = bytes.len() - n_bytes;
    decoder.read_image(&mut bytes[first..])?;
    // Texels are read from the end of the memory and written from its beginning, never beyond the next to be read.
    for texel in 0..n_texels {
        let narrow = std::array::from_fn(|channel| bytes[first + N * texel + channel]);
        bytes[4 * texel..4 * texel + 4].copy_from_slice(&widen(narrow));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::material::Material;

    fn png(width: u32, height: u32) -> Vec<u8> {
        let mut bytes = Vec::new();
        let image = image::GrayImage::from_fn(width, height, |x, y| image::Luma([(x * 100 + y) as u8]));
        image.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png).unwrap();
        bytes
    }

    fn embedded(bytes: Vec<u8>) -> ImageSource {
        ImageSource { bytes: Some(bytes), ..ImageSource::file("1") }
    }

    #[test]
    fn images_that_cannot_be_used_are_left_out_with_a_line() {
        let use_of = |image| Some(TextureUse { image, wrap: Default::default(), transform: [[0.0; 3]; 2] });
        let images = vec![ImageSource::file("no.png"), embedded(png(2, 1)), embedded(b"what".to_vec())];
        let mut draft = Draft { images, ..Draft::default() };
        draft.mesh.materials.materials = vec![Material {
            base_color_texture: use_of(1),
            emissive_texture: use_of(0),
            emissive: [1.0; 3],
            metallic_roughness_texture: use_of(9),
            metallic: 1.0,
            ..Material::default()
        }];
        let Reading { mesh, remarks } = decode(draft, &Companions::default());
        let material = &mesh.materials.materials[0];
        assert_eq!(material.base_color_texture.map(|texture| texture.image), Some(0));
        assert!(material.emissive_texture.is_none() && material.metallic_roughness_texture.is_none());
        // Factors say little without their textures.
        assert_eq!((material.emissive, material.metallic), ([0.0; 3], 0.0));
        assert_eq!(mesh.materials.images[0].texels, [[0, 0, 0, 255], [100, 100, 100, 255]]);
        assert_eq!(
            remarks,
            [
                "an image is left out: no.png is missing: put it beside the model",
                "an image is left out: 1 is no image that is read (PNG, JPEG, WebP, TIFF, BMP, TGA): convert it to PNG"
            ]
        );
    }

    #[test]
    fn files_that_are_no_images_are_told_apart() {
        let cut = b"\xff\xd8\xff\xe0";
        for (name, bytes, told) in [
            ("1.jpg", &b""[..], "is empty: copy it again"),
            ("1.jpg", b"<!DOCTYPE html>", "is a web page: download the file itself"),
            ("1.png", b"version https://git-lfs.github.com/spec/v1", "is a pointer of Git LFS"),
            ("1.png", b"GIF89a", "is no image that is read (PNG, JPEG, WebP, TIFF, BMP, TGA): convert it to PNG"),
            ("1.png", cut, "is damaged: "),
        ] {
            let fault = decode_bytes(name, bytes).unwrap_err();
            assert!(fault.starts_with(told) && !fault.contains('\n'), "{fault}");
        }
        assert!(decode_bytes("1.jpg", cut).unwrap_err().ends_with("; copy it again"));
        assert!(decode_bytes("1.jpg", &png(2, 1)).is_ok(), "the content tells the format");
    }

    #[test]
    fn a_jpeg_that_is_cut_has_a_line() {
        let mut bytes = Vec::new();
        let image = image::RgbImage::from_fn(64, 64, |x, y| image::Rgb([((x * 37) ^ (y * 91)) as u8; 3]));
        image.write_to(&mut Cursor::new(&mut bytes), ImageFormat::Jpeg).unwrap();
        assert!(decode_bytes("1.jpg", &bytes).is_ok());
        assert!(decode_bytes("1.jpg", &[&bytes[..], b"a film that a phone appends"].concat()).is_ok());
        // A preview in a segment has an end of its own.
        let preview = [&[0xff, 0xd8, 0xff, 0xe1, 0x00, 0x06, 0xff, 0xd8, 0xff, 0xd9], &bytes[2..]].concat();
        assert!(decode_bytes("1.jpg", &preview).is_ok());
        for kept in [preview.len() / 2, preview.len() - 2] {
            assert_eq!(decode_bytes("1.jpg", &preview[..kept]).unwrap_err(), "is cut off: copy it again", "{kept}");
        }
    }

    #[test]
    fn sizes_that_lie_are_refused_before_memory_is_taken() {
        let mut claimed = png(2, 1);
        for (side, told) in [(65_536_u32, "is too large"), (30_000, "is too large"), (16_384, "is damaged")] {
            claimed[16..20].copy_from_slice(&side.to_be_bytes());
            claimed[20..24].copy_from_slice(&side.to_be_bytes());
            let crc = crc32(&claimed[12..29]);
            claimed[29..33].copy_from_slice(&crc.to_be_bytes());
            let fault = decode_bytes("1.png", &claimed).unwrap_err();
            assert!(fault.starts_with(told), "{side}: {fault}");
        }
    }

    fn crc32(bytes: &[u8]) -> u32 {
        let step = |crc: u32, _| if crc & 1 == 1 { crc >> 1 ^ 0xedb8_8320 } else { crc >> 1 };
        !bytes.iter().fold(u32::MAX, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), step))
    }

    #[test]
    fn channels_come_from_images_of_other_sizes() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("other.png"), png(2, 1)).unwrap();
        let companions = Companions::beside(&folder.path().join("model.obj"));
        let other = || "other.png".to_owned();
        let factors = Factors::new([1.0; 3], [1.0; 3], 1.0);
        let beside = |name: &str| Box::new(Glossy { role: Role::DiffuseBeside(ImageSource::file(name)), factors });
        let gold = || {
            let factors = Factors::new([0.0; 3], [1.0, 0.5, 0.25], 0.5);
            Box::new(Glossy { role: Role::Diffuse, factors })
        };
        let dark = || {
            let factors = Factors::new([0.0; 3], [1.0; 3], 0.0);
            Box::new(Glossy { role: Role::Specular, factors })
        };
        for (channels, channel, expected) in [
            (Channels::Coverage(other()), 3, [0, 0, 100, 100, 0, 0, 100, 100]),
            (Channels::Roughness, 1, [0, 100, 200, 44, 1, 101, 201, 45]),
            (Channels::Roughness, 2, [255; 8]),
            (Channels::Metallic, 1, [255; 8]),
            (Channels::Metallic, 2, [0, 100, 200, 44, 1, 101, 201, 45]),
            (Channels::RoughnessAndMetallic(other()), 1, [0, 100, 200, 44, 1, 101, 201, 45]),
            (Channels::RoughnessAndMetallic(other()), 2, [0, 0, 100, 100, 0, 0, 100, 100]),
            (Channels::MetalOfGlossy(beside("other.png")), 2, [0, 0, 39, 214, 0, 0, 38, 213]),
            (Channels::MetalOfGlossy(beside("other.png")), 1, [0; 8]),
            (Channels::BaseColorOfGlossy(beside("other.png")), 0, [0, 102, 206, 106, 1, 103, 207, 106]),
            (Channels::BaseColorOfGlossy(beside("no.png")), 0, [0, 100, 200, 44, 1, 101, 201, 45]),
            // All light is reflected, whatever the diffuse texel is.
            (Channels::BaseColorOfGlossy(gold()), 1, [188; 8]),
            (Channels::MetalOfGlossy(gold()), 1, [127; 8]),
            (Channels::MetalOfGlossy(gold()), 2, [255; 8]),
            (Channels::MetalOfGlossy(dark()), 1, [255; 8]),
            (Channels::BaseColorOfGlossy(dark()), 3, [255; 8]),
        ] {
            let image = decode_source(&ImageSource { channels, ..embedded(png(4, 2)) }, &companions).unwrap();
            let found: Vec<u8> = image.texels.iter().map(|texel| texel[channel]).collect();
            assert_eq!(found, expected, "{channel}");
        }
    }
}
