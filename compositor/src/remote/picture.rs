//! The small live picture: samples of a frame, thinned on the wall's thread and encoded on another.

use std::io;

use image::{ExtendedColorType, codecs::jpeg::JpegEncoder};
use shared::division::FrameSize;

/// The picture's longest side.
const LONGEST_SIDE: u32 = 640;
/// JPEG quality: higher looks the same on a phone.
const QUALITY: u8 = 72;

/// A small picture: R, G, B of each pixel, the top row first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Thumbnail {
    size: [u32; 2],
    rgb: Vec<u8>,
}

impl Thumbnail {
    /// Takes every n-th sample of a frame, whose bottom row comes first: about a millisecond for any size.
    pub(crate) fn new(frame: FrameSize, rgba: &[u32]) -> Self {
        let [columns, rows] = [frame.xres(), frame.yres()];
        let step = columns.max(rows).div_ceil(LONGEST_SIDE).max(1);
        let size = [columns, rows].map(|side| (side / step).max(1));
        let mut rgb = Vec::with_capacity(3 * size[0] as usize * size[1] as usize);
        for row in (0..size[1]).rev() {
            let start = (row * step + step / 2).min(rows - 1) as usize * columns as usize;
            for column in 0..size[0] {
                let at = start + (column * step + step / 2).min(columns - 1) as usize;
                let [r, g, b, _] = rgba.get(at).copied().unwrap_or_default().to_ne_bytes();
                rgb.extend([r, g, b]);
            }
        }
        Self { size, rgb }
    }

    /// The picture as JPEG.
    ///
    /// # Errors
    /// The encoder fails.
    pub(crate) fn to_jpeg(&self) -> io::Result<Vec<u8>> {
        let mut jpeg = Vec::with_capacity(32 << 10);
        let encoder = &mut JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
        encoder.encode(&self.rgb, self.size[0], self.size[1], ExtendedColorType::Rgb8).map_err(io::Error::other)?;
        Ok(jpeg)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_upright_and_small_whatever_the_frame() {
        for [columns, rows] in [[1, 1], [3, 700], [1024, 512], [4096, 2304]] {
            let frame = FrameSize::new(columns, rows).unwrap();
            // Red to the right, green upwards.
            let rgba: Vec<u32> = (0..columns * rows)
                .map(|at| {
                    let [x, y] = [at % columns * 255 / columns, at / columns * 255 / rows];
                    u32::from_ne_bytes([x as u8, y as u8, 9, 255])
                })
                .collect();
            let jpeg = Thumbnail::new(frame, &rgba).to_jpeg().unwrap();
            let read = image::load_from_memory(&jpeg).unwrap().to_rgb8();
            assert!(read.width().max(read.height()) <= LONGEST_SIDE, "{columns}×{rows}");
            let ratio = f64::from(read.width()) * f64::from(rows) / (f64::from(read.height()) * f64::from(columns));
            assert!(columns < 9 || (0.98..1.02).contains(&ratio), "{columns}×{rows}: {ratio}");
            if columns > 9 {
                let [top_left, bottom_right] =
                    [read.get_pixel(2, 2), read.get_pixel(read.width() - 3, read.height() - 3)];
                assert!(top_left[0] < 20 && top_left[1] > 235 && bottom_right[0] > 235 && bottom_right[1] < 20);
            }
        }
    }
}
