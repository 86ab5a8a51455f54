//! Images in memory, and as PNG files.

use std::{
    io::{self, Write},
    path::Path,
};

use channel::files;
use renderer::render::image::encode_png;

use crate::wall::PixelRect;

/// An image in sRGB-encoded R, G, B bytes, row by row from the top left.
#[derive(Clone, PartialEq, Eq)]
pub struct RgbImage {
    /// Columns and rows.
    pub size: [u32; 2],
    /// Three bytes a pixel.
    pub rgb: Vec<u8>,
}

impl RgbImage {
    /// A black image.
    pub(super) fn black(size: [u32; 2]) -> Self {
        Self { size, rgb: vec![0; 3 * size[0] as usize * size[1] as usize] }
    }

    /// The pixel in a column from the left and a row from the top.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let first = 3 * (y as usize * self.size[0] as usize + x as usize);
        [self.rgb[first], self.rgb[first + 1], self.rgb[first + 2]]
    }

    /// A part of the image, which lies in it.
    pub(crate) fn part(&self, part: PixelRect) -> Self {
        let row = |y: u32| {
            let first = 3 * (y as usize * self.size[0] as usize + part.x as usize);
            &self.rgb[first..][..3 * part.width as usize]
        };
        let rgb = (part.y..part.y + part.height).flat_map(row).copied().collect();
        Self { size: [part.width, part.height], rgb }
    }

    /// Writes a PNG; on an error, the file at `path` stays as it was.
    pub fn write_png(&self, path: &Path) -> io::Result<()> {
        files::write(path, |out| self.encode(out)).map_err(|error| {
            io::Error::new(error.kind(), format!("cannot write the picture {}: {error}", path.display()))
        })
    }

    /// Writes the bytes of a PNG.
    pub(crate) fn encode(&self, out: &mut dyn Write) -> io::Result<()> {
        encode_png(out, self.size.into(), &self.rgb)
    }
}

impl std::fmt::Debug for RgbImage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "RgbImage of {}×{} pixels", self.size[0], self.size[1])
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
        let mut reader = png::Decoder::new(io::BufReader::new(fs::File::open(&path).unwrap())).read_info().unwrap();
        let mut rgb = vec![0; 18];
        assert_eq!(reader.next_frame(&mut rgb).map(|info| [info.width, info.height]).unwrap(), picture.size);
        assert_eq!(rgb, picture.rgb);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1, "no partial files are left");
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_folder_that_is_not_there_is_named() {
        let picture = RgbImage { size: [1, 1], rgb: vec![0; 3] };
        let error = picture.write_png(Path::new("no/such/folder/a.png")).unwrap_err().to_string();
        assert!(error.contains("no/such/folder/a.png"), "{error}");
    }
}
