//! Pictures in memory, and as PNG files.

use std::fs::File;
use std::io::{self, BufReader, Write};
use std::path::{Path, PathBuf};

use renderer::render::image::write_atomically;

/// A picture in sRGB-encoded R, G, B bytes, row by row from the top left.
#[derive(Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Columns and rows.
    pub size: [u32; 2],
    /// Three bytes a pixel.
    pub rgb: Vec<u8>,
}

/// Why there is no picture in a file.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// It cannot be written.
    #[error("cannot write the picture {path}: {source}")]
    Unwritable {
        /// Where to.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// It cannot be read.
    #[error("cannot read {path} as a PNG of 8-bit RGB: {source}")]
    Unreadable {
        /// Where from.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
}

impl RgbImage {
    /// The pixel in a column from the left and a row from the top.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let first = 3 * (y as usize * self.size[0] as usize + x as usize);
        [self.rgb[first], self.rgb[first + 1], self.rgb[first + 2]]
    }

    /// Writes a PNG; `path` holds a whole picture or what it held before.
    pub fn write_png(&self, path: &Path) -> Result<(), PictureError> {
        write_atomically(path, |out| self.encode(out))
            .map_err(|source| PictureError::Unwritable { path: path.to_owned(), source })
    }

    /// Reads a PNG as [`RgbImage::write_png`] writes them.
    pub fn read_png(path: &Path) -> Result<Self, PictureError> {
        File::open(path)
            .and_then(|file| Self::decode(BufReader::new(file)))
            .map_err(|source| PictureError::Unreadable { path: path.to_owned(), source })
    }

    fn encode(&self, out: &mut dyn Write) -> io::Result<()> {
        let [width, height] = self.size;
        let mut encoder = png::Encoder::new(out, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        // A wall has millions of pixels, and a screenshot must not hold it up.
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.rgb)?;
        Ok(writer.finish()?)
    }

    fn decode(file: BufReader<File>) -> io::Result<Self> {
        let mut reader = png::Decoder::new(file).read_info()?;
        if reader.output_color_type() != (png::ColorType::Rgb, png::BitDepth::Eight) {
            return Err(io::Error::other("it has another kind of pixels"));
        }
        let n_bytes = reader.output_buffer_size().ok_or_else(|| io::Error::other("it is too large"))?;
        let mut rgb = vec![0; n_bytes];
        let info = reader.next_frame(&mut rgb)?;
        Ok(Self { size: [info.width, info.height], rgb })
    }
}

impl std::fmt::Debug for RgbImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Picture of {}×{} pixels", self.size[0], self.size[1])
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_picture_survives_its_file() {
        let folder = std::env::temp_dir().join(format!("picture-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.png");
        let picture = RgbImage { size: [3, 2], rgb: (0..18).map(|byte| byte * 14).collect() };
        picture.write_png(&path).unwrap();
        picture.write_png(&path).unwrap();
        assert_eq!(RgbImage::read_png(&path).unwrap(), picture);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "no partial files are left");
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let picture = RgbImage { size: [1, 1], rgb: vec![0; 3] };
        let error = picture.write_png(Path::new("no/such/folder/a.png")).unwrap_err().to_string();
        assert!(error.contains("no/such/folder/a.png"), "{error}");
    }

    #[test]
    fn what_is_no_picture_is_refused() {
        let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        let error = RgbImage::read_png(&manifest).unwrap_err().to_string();
        assert!(error.contains("Cargo.toml as a PNG of 8-bit RGB"), "{error}");
    }
}
