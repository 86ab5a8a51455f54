//! Reads sky images: all directions in one picture (equirectangular), in Radiance HDR or OpenEXR.

mod radiance;

use std::{
    io::{BufRead, BufReader, Seek},
    path::{Path, PathBuf},
};

use channel::files;
use image::{ColorType, ImageDecoder, ImageError, codecs::openexr::OpenExrDecoder};
use shared::sky::SkyId;

/// The widest image: 0.5 GB while it is decoded. Wider ones show no more light than this.
const MOST_COLUMNS: u32 = 8192;

/// Wider images are halved: a texel of this many is a third of the sun's diameter.
const MOST_KEPT_COLUMNS: u32 = 2048;

/// The most light of a texel, which replaces infinite light: OpenEXR's largest number of 16 bits, which the sun exceeds.
const MOST_LIGHT: f32 = 65_504.0;

/// The light of all directions.
///
/// Invariant: twice as wide as high, all numbers are finite and none is negative, and not all are zero.
#[derive(Clone, Debug, PartialEq)]
pub struct SkyImage {
    /// Texels from left to right.
    pub width: u32,
    /// Texels from the zenith down.
    pub height: u32,
    /// Linear light for each steradian, row by row from the top; the middle column lies straight ahead.
    pub texels: Vec<[f32; 3]>,
}

/// A sky image cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct SkyError {
    path: PathBuf,
    /// Cause and cure.
    reason: String,
}

impl SkyImage {
    /// Reads an image, as [`SkyImage::new`] makes it.
    ///
    /// # Errors
    /// One line with cause and cure. Nothing larger than its dimensions allow is decoded.
    pub fn read(path: &Path) -> Result<Self, SkyError> {
        let file = files::open(path).map_err(|error| error.to_string());
        let image = file.and_then(|file| Self::read_from(BufReader::new(file)));
        image.map_err(|reason| SkyError { path: path.to_owned(), reason })
    }

    /// Reads the bytes of an image.
    ///
    /// # Errors
    /// As for [`SkyImage::read`], without the file's name.
    pub fn read_from(mut file: impl BufRead + Seek) -> Result<Self, String> {
        let start = file.fill_buf().map_err(|error| format!("cannot be read: {error}"))?;
        let (width, height, texels) = if start.starts_with(b"#?") {
            radiance::decode(file)
        } else if start.starts_with(b"\x76\x2f\x31\x01") {
            decode_openexr(file)
        } else if start.is_empty() {
            Err("is empty: copy it again".to_owned())
        } else {
            Err("is no sky image that is read: convert it to Radiance HDR (.hdr) or OpenEXR (.exr), which hold the light of \
                the sun"
                .to_owned())
        }?;
        Self::new(width, height, texels)
    }

    /// An image of these texels: those that are no number, negative or infinite become light, and very large images smaller.
    ///
    /// # Errors
    /// Another shape, or no light at all.
    pub fn new(width: u32, height: u32, mut texels: Vec<[f32; 3]>) -> Result<Self, String> {
        check_size(width, height)?;
        for light in texels.as_flattened_mut() {
            *light = if light.is_nan() { 0.0 } else { light.clamp(0.0, MOST_LIGHT) };
        }
        let mut image = Self { width, height, texels };
        while image.width > MOST_KEPT_COLUMNS {
            image = image.halved();
        }
        let has_light = image.texels.as_flattened().iter().any(|&light| light > 0.0);
        if has_light { Ok(image) } else { Err("is black: nothing would be lit; choose another sky".to_owned()) }
    }

    /// The mean of each four texels; those at the end of an odd size are left out.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 4 * 2, self.width / 4);
        let texel = |index: u32| {
            let (x, y) = (2 * (index % width), 2 * (index / width));
            let at = |x: u32, y: u32| self.texels[(y * self.width + x) as usize];
            let four = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
            std::array::from_fn(|channel| four.iter().map(|texel| texel[channel]).sum::<f32>() * 0.25)
        };
        Self { width, height, texels: (0..width * height).map(texel).collect() }
    }

    /// Names its light on all machines.
    pub fn id(&self) -> SkyId {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.width.to_le_bytes());
        hasher.update(&self.height.to_le_bytes());
        hasher.update(bytemuck::cast_slice(&self.texels));
        SkyId(*hasher.finalize().as_bytes())
    }
}

fn check_size(width: u32, height: u32) -> Result<(), String> {
    if width == 0 || width != height.saturating_mul(2) {
        Err(format!("is {width}x{height}: a sky is twice as wide as high, with all directions (equirectangular)"))
    } else if width > MOST_COLUMNS {
        Err(format!("is {width}x{height}: scale it to at most {MOST_COLUMNS}x{}", MOST_COLUMNS / 2))
    } else {
        Ok(())
    }
}

/// Width, height, and linear light row by row from the top.
fn decode_openexr(file: impl BufRead + Seek) -> Result<(u32, u32, Vec<[f32; 3]>), String> {
    let decoder = OpenExrDecoder::new(file).map_err(|error| damaged(&error))?;
    let (width, height) = decoder.dimensions();
    check_size(width, height)?;
    let n_channels = if decoder.color_type() == ColorType::Rgba32F { 4 } else { 3 };
    let mut numbers = vec![0.0f32; n_channels * width as usize * height as usize];
    decoder.read_image(bytemuck::cast_slice_mut(&mut numbers)).map_err(|error| damaged(&error))?;
    let texels = match n_channels {
        4 => numbers.as_chunks().0.iter().map(|&[red, green, blue, _]| [red, green, blue]).collect(),
        _ => bytemuck::allocation::cast_vec(numbers),
    };
    Ok((width, height, texels))
}

fn damaged(error: &ImageError) -> String {
    let cause = error.to_string().replace('\n', " ");
    format!("is damaged, cut short, or of a kind that is not read ({}): copy it again, or convert it", cause.trim())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use image::{Rgb32FImage, codecs::hdr::HdrEncoder};

    use super::*;

    fn gradient(width: u32, height: u32) -> Vec<[f32; 3]> {
        (0..width * height).map(|index| [0.25 * (index % 7) as f32, 1.0, 2.0 * (index % 3) as f32]).collect()
    }

    /// The same texels in both formats.
    fn files(folder: &Path, width: u32, height: u32) -> [PathBuf; 2] {
        let [hdr, exr] = ["a.hdr", "a.exr"].map(|name| folder.join(name));
        let texels = gradient(width, height);
        let pixels: Vec<_> = texels.iter().map(|&texel| image::Rgb(texel)).collect();
        HdrEncoder::new(fs::File::create(&hdr).unwrap()).encode(&pixels, width as usize, height as usize).unwrap();
        Rgb32FImage::from_raw(width, height, texels.into_flattened()).unwrap().save(&exr).unwrap();
        [hdr, exr]
    }

    #[test]
    fn both_formats_give_the_same_light() {
        let folder = tempfile::tempdir().unwrap();
        let images = files(folder.path(), 64, 32).map(|path| SkyImage::read(&path).unwrap());
        assert_eq!(images[0], SkyImage { width: 64, height: 32, texels: gradient(64, 32) });
        assert_eq!(images[0].id(), images[1].id());
    }

    #[test]
    fn numbers_that_are_no_light_do_no_harm() {
        let texels = vec![[f32::NAN, -1.0, f32::INFINITY], [f32::NEG_INFINITY, 1e30, 0.5]];
        assert_eq!(SkyImage::new(2, 1, texels).unwrap().texels, [[0.0, 0.0, MOST_LIGHT], [0.0, MOST_LIGHT, 0.5]]);
    }

    #[test]
    fn wide_images_are_halved_and_keep_their_light() {
        let image = SkyImage::new(4096, 2048, vec![[0.5, 0.25, 1.0]; 4096 * 2048]).unwrap();
        assert_eq!((image.width, image.height), (2048, 1024));
        assert!(image.texels.iter().all(|&texel| texel == [0.5, 0.25, 1.0]));
    }

    #[test]
    fn files_that_are_no_sky_are_refused_in_a_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sky");
        let reason = |bytes: &[u8]| {
            fs::write(&path, bytes).unwrap();
            let reason = SkyImage::read(&path).unwrap_err().to_string();
            assert!(!reason.contains('\n'), "{reason}");
            reason
        };
        assert!(reason(b"").contains("is empty"));
        assert!(reason(b"\x89PNG\r\n\x1a\n....").contains("convert it"));
        assert!(reason(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n\x80\x80\x80\x80").contains("is 1x1"));
        assert!(reason(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 2\n\0\0\0\0\0\0\0\0").contains("is black"));
        let huge = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1000000 +X 2000000\n";
        assert!(reason(huge).contains("at most 8192x4096"));
        for whole in files(folder.path(), 64, 32).map(|path| fs::read(path).unwrap()) {
            for length in [12, whole.len() / 4, whole.len() / 2, whole.len() - 1] {
                assert!(reason(&whole[..length]).contains("copy it again"), "{length}");
            }
            // Bytes that have changed make other light or a line, and no panic.
            for at in (0..whole.len()).step_by(97) {
                let mut changed = whole.clone();
                changed[at] ^= 0x55;
                fs::write(&path, changed).unwrap();
                let _ = SkyImage::read(&path);
            }
        }
    }
}
