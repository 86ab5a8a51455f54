//! Writes images as PNG files.

use std::{
    io::{self, Write},
    path::Path,
};

use channel::files;
use shared::division::FrameSize;

/// BLAKE3 of a frame's RGB samples, row by row from the bottom, in hexadecimal. Equal hashes mean equal images.
pub fn hash_samples(rgb: &[u8]) -> String {
    blake3::hash(rgb).to_hex().to_string()
}

/// Writes an sRGB-encoded RGB8 image, given bottom row first; after an error, an old file is as it was.
pub fn write_png(path: &Path, size: FrameSize, rgb: &[u8]) -> io::Result<()> {
    let rows: Vec<u8> = rgb.rchunks_exact(3 * size.xres() as usize).flatten().copied().collect();
    files::write(path, |out| encode_png(out, size.into(), &rows))
}

/// Encodes an sRGB-encoded RGB8 image of some columns and rows, given top row first.
pub fn encode_png(out: &mut dyn Write, (width, height): (u32, u32), rgb: &[u8]) -> io::Result<()> {
    let mut encoder = png::Encoder::new(out, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    // A wall has millions of pixels, and a screenshot must not delay it.
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(rgb)?;
    Ok(writer.finish()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bottom_row_is_the_last_in_the_file() {
        let path = std::env::temp_dir().join(format!("rows-{}.png", std::process::id()));
        let size = FrameSize::new(2, 2).unwrap();
        let bottom_first = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
        write_png(&path, size, &bottom_first).unwrap();
        let mut reader =
            png::Decoder::new(io::BufReader::new(std::fs::File::open(&path).unwrap())).read_info().unwrap();
        let mut pixels = [0; 12];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, [7, 8, 9, 10, 11, 12, 1, 2, 3, 4, 5, 6]);
        std::fs::remove_file(path).unwrap();
    }
}
