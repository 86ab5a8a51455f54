//! An image at halving sizes, each texel the mean light of those below it: Williams, "Pyramidal Parametrics" (1983).

use shared::srgb;

use crate::{
    model::material::Image,
    texture::{
        level::Level,
        texel::{Texel, UNITS},
    },
};

/// How the bytes of an image stand for numbers from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    /// Colours.
    Srgb,
    /// Other quantities.
    Linear,
}

/// A texture that can be looked up at any size.
#[derive(Debug)]
pub(super) struct MipMap {
    /// From the image itself to a single texel.
    pub(super) levels: Vec<Level>,
    /// Those of all levels.
    pub(super) texels: Vec<Texel>,
}

impl MipMap {
    /// Bytes of the mip map of an image.
    pub(super) fn n_bytes_of(image: &Image) -> u64 {
        let n_texels: u64 = levels(image).map(|level| u64::from(level.n_texels())).sum();
        n_texels * size_of::<Texel>() as u64
    }

    /// Makes all levels, on the current rayon pool.
    pub(super) fn new(image: &Image, encoding: Encoding) -> Self {
        let decode = |value: u8| match encoding {
            Encoding::Srgb => srgb::decode(value),
            Encoding::Linear => f32::from(value) / 255.0,
        };
        let of_image = |x: u32, y: u32| {
            let [red, green, blue, _] = image.texels[y as usize * image.width as usize + x as usize];
            Texel::new([red, green, blue].map(decode))
        };
        let levels: Vec<Level> = levels(image).collect();
        let n_texels = levels.iter().map(|level| level.n_texels() as usize).sum();
        let mut texels = vec![Texel::default(); n_texels];
        let mut finer = None;
        for level in &levels {
            let (before, rest) = texels.split_at_mut(level.first as usize);
            let of_level = &mut rest[..level.n_texels() as usize];
            match finer {
                None => level.fill(of_level, of_image),
                Some(finer) => level.fill(of_level, |x, y| mean(before, finer, x, y)),
            }
            finer = Some(level);
        }
        Self { levels, texels }
    }

    /// Bytes in memory.
    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.texels)
    }
}

/// The levels of an image.
fn levels(image: &Image) -> impl Iterator<Item = Level> {
    let whole = Level::new([image.width, image.height], 0);
    let next = |level: &Level| {
        let size = level.size.map(|n| (n / 2).max(1));
        (level.size != [1, 1]).then(|| Level::new(size, level.first + level.n_texels()))
    };
    std::iter::successors(Some(whole), next)
}

/// A texel of the next level: the mean of the area that it covers in the finer one.
fn mean(texels: &[Texel], finer: &Level, x: u32, y: u32) -> Texel {
    let [columns, rows] = [taps(x, finer.size[0]), taps(y, finer.size[1])];
    let mut mean = [0.0; 3];
    for (y, weight_y) in rows {
        for (x, weight_x) in columns {
            let texel = texels[finer.index(x, y)];
            for (channel, sum) in mean.iter_mut().enumerate() {
                *sum += texel.scaled(channel) * (weight_x * weight_y);
            }
        }
    }
    Texel::new([0, 1, 2].map(|channel| mean[channel] * UNITS[channel]))
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
