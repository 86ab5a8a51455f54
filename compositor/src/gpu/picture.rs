//! Pictures in memory, and as PNG files.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// A picture in sRGB-encoded R, G, B bytes, row by row from the top left.
#[derive(Clone, PartialEq, Eq)]
pub struct Picture {
    /// Columns and rows.
    pub size: [u32; 2],
    /// Three bytes a pixel.
    pub rgb: Vec<u8>,
}

/// Why a picture could not be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write the picture {path}: {source}")]
pub struct PictureError {
    path: PathBuf,
    source: png::EncodingError,
}

impl Picture {
    /// The pixel in a column from the left and a row from the top.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let first = 3 * (y as usize * self.size[0] as usize + x as usize);
        [self.rgb[first], self.rgb[first + 1], self.rgb[first + 2]]
    }

    /// Writes a PNG, so that `path` holds a whole picture or what it held before.
    pub fn write_png(&self, path: &Path) -> Result<(), PictureError> {
        let mut partial = path.as_os_str().to_owned();
        partial.push(format!(".{}.part", std::process::id()));
        let partial = PathBuf::from(partial);
        let written = self.encode_to(&partial).and_then(|()| Ok(fs::rename(&partial, path)?));
        written.map_err(|source| {
            // What is left of it is worth nothing, and the first failure is the one to tell.
            let _ = fs::remove_file(&partial);
            PictureError { path: path.to_owned(), source }
        })
    }

    fn encode_to(&self, path: &Path) -> Result<(), png::EncodingError> {
        let mut file = BufWriter::new(File::create(path)?);
        let [width, height] = self.size;
        let mut encoder = png::Encoder::new(&mut file, width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        // A wall has millions of pixels, and a screenshot must not hold it up.
        encoder.set_compression(png::Compression::Fast);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.rgb)?;
        writer.finish()?;
        Ok(file.flush()?)
    }
}

impl std::fmt::Debug for Picture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Picture of {}×{} pixels", self.size[0], self.size[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_survives_its_file() {
        let folder = std::env::temp_dir().join(format!("picture-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.png");
        let picture = Picture { size: [3, 2], rgb: (0..18).map(|byte| byte * 14).collect() };
        picture.write_png(&path).unwrap();
        picture.write_png(&path).unwrap();

        let mut reader = png::Decoder::new(std::io::BufReader::new(File::open(&path).unwrap())).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut rgb).unwrap();
        assert_eq!(([info.width, info.height], rgb), (picture.size, picture.rgb));
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "no partial files are left");
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let picture = Picture { size: [1, 1], rgb: vec![0; 3] };
        let error = picture.write_png(Path::new("no/such/folder/a.png")).unwrap_err().to_string();
        assert!(error.contains("no/such/folder/a.png"), "{error}");
    }
}
