//! An image at halving sizes, each texel the mean light of those below it: Williams, "Pyramidal Parametrics" (1983).

use glam::Vec3A;
use shared::srgb;

use crate::{
    model::material::{Image, Wrap},
    texture::{
        level::Level,
        texel::{Texel, UNIT},
    },
};

/// How the bytes of an image stand for numbers from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    /// Colours.
    Srgb,
    /// Other quantities.
    Linear,
}

/// A texture that can be looked up at any size.
#[derive(Debug)]
pub(crate) struct MipMap {
    /// From the image itself to a single texel.
    levels: Vec<Level<Texel>>,
}

impl MipMap {
    /// Bytes of the mip map of an image.
    pub(crate) fn n_bytes_of(image: &Image) -> u64 {
        sizes([image.width, image.height]).map(Level::<Texel>::n_bytes_of_size).sum()
    }

    /// Makes all levels, on the current rayon pool.
    pub(crate) fn new(image: &Image, encoding: Encoding) -> Self {
        let decode = |value: u8| match encoding {
            Encoding::Srgb => srgb::decode(value),
            Encoding::Linear => f32::from(value) / 255.0,
        };
        let mut levels = Vec::new();
        for size in sizes([image.width, image.height]) {
            let level = match levels.last() {
                None => Level::of_image(image, |[x, y, z, _]| Texel::new(Vec3A::from_array([x, y, z].map(decode)))),
                Some(finer) => halved(finer, size),
            };
            levels.push(level);
        }
        Self { levels }
    }

    /// Texels of the image in a row and in a column.
    #[inline]
    pub(crate) fn size(&self) -> [f32; 2] {
        self.levels[0].size().map(|n| n as f32)
    }

    /// Bytes in memory.
    pub(crate) fn n_bytes(&self) -> usize {
        self.levels.iter().map(Level::n_bytes).sum()
    }

    /// The mean of a square of this width, in texels of the image, around a point.
    ///
    /// Blends the two levels whose texels are the next smaller and larger ones.
    #[inline(always)]
    pub(crate) fn mean(&self, at: [f32; 2], width: f32, wrap: [Wrap; 2]) -> Vec3A {
        let (level, fraction) = level_of(width);
        let last = self.levels.len() - 1;
        let fine = self.levels[level.min(last)].bilinear(at, wrap, Texel::scaled);
        if level >= last || fraction == 0.0 {
            return fine * UNIT;
        }
        let coarse = self.levels[level + 1].bilinear(at, wrap, Texel::scaled);
        (fine + (coarse - fine) * fraction) * UNIT
    }
}

/// The sizes of an image's levels.
fn sizes(size: [u32; 2]) -> impl Iterator<Item = [u32; 2]> {
    std::iter::successors(Some(size), |&size| (size != [1, 1]).then(|| size.map(|n| (n / 2).max(1))))
}

/// The next level, of `size`: each texel is the mean of the area that it covers in the finer one.
fn halved(finer: &Level<Texel>, size: [u32; 2]) -> Level<Texel> {
    let [finer_width, finer_height] = finer.size();
    Level::fill(size, |x, y| {
        let (columns, rows) = (taps(x, finer_width), taps(y, finer_height));
        let mut mean = Vec3A::ZERO;
        for (y, weight_y) in rows {
            for (x, weight_x) in columns {
                mean += finer.texel(x, y).scaled() * (weight_x * weight_y);
            }
        }
        Texel::new(mean * UNIT)
    })
}

/// The texels that texel `index` of the next level covers in a row of `n`, and the weight of each.
///
/// An odd row has no pairs: its texels are a little wider than two, and share some.
fn taps(index: u32, n: u32) -> [(u32, f32); 3] {
    let first = 2 * index;
    let half = n / 2;
    if n == 1 {
        [(0, 1.0), (0, 0.0), (0, 0.0)]
    } else if n.is_multiple_of(2) {
        [(first, 0.5), (first + 1, 0.5), (first, 0.0)]
    } else {
        let weights = [half - index, half, index + 1].map(|weight| weight as f32 / n as f32);
        std::array::from_fn(|tap| (first + tap as u32, weights[tap]))
    }
}

/// The level whose texels are the next smaller than `width`, in texels of the image, and the part of the next level.
///
/// A number's exponent and mantissa are its logarithm, linear between powers of two.
#[inline(always)]
fn level_of(width: f32) -> (usize, f32) {
    const MANTISSA: u32 = 0x007f_ffff;
    if width <= 1.0 {
        return (0, 0.0);
    }
    let bits = width.to_bits();
    let level = (bits >> 23 & 0xff) - 127;
    (level as usize, f32::from_bits(bits & MANTISSA | 1.0f32.to_bits()) - 1.0)
}
