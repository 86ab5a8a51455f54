//! An image at halving sizes, each texel the mean light of those below it: Williams, "Pyramidal Parametrics" (1983).

use serde::{Deserialize, Serialize};
use shared::srgb;

use crate::{
    model::material::Image,
    scene_file::section::Section,
    texture::{
        level::{Level, halved, is_indexable},
        packed_rgb::{PackedRgb, UNITS},
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
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct MipMap {
    /// From the image itself to a single texel.
    pub(super) levels: Vec<Level>,
    /// Those of all levels.
    #[serde(skip)]
    pub(super) texels: Section<PackedRgb>,
}

impl MipMap {
    /// Bytes of the mip map of an image.
    pub(super) fn n_bytes_of(image: &Image) -> u64 {
        let n_texels: u64 = levels([image.width, image.height]).map(|level| u64::from(level.n_texels())).sum();
        n_texels * size_of::<PackedRgb>() as u64
    }

    /// Makes all levels, on the current rayon pool. The first takes the place of the image, which may be most of the memory.
    pub(super) fn new(image: Image, encoding: Encoding) -> Self {
        let decode = |value: u8| match encoding {
            Encoding::Srgb => srgb::decode(value),
            Encoding::Linear => f32::from(value) / 255.0,
        };
        let levels: Vec<Level> = levels([image.width, image.height]).collect();
        let n_texels: usize = levels.iter().map(|level| level.n_texels() as usize).sum();
        let mut texels: Vec<PackedRgb> = bytemuck::allocation::cast_vec(image.texels);
        texels.reserve_exact(n_texels - texels.len());
        texels.resize(n_texels, PackedRgb::default());
        let (of_image, _) = texels.split_at_mut(levels[0].n_texels() as usize);
        levels[0].arrange(of_image, |texel, at| {
            let [red, green, blue, _] = bytemuck::cast(texel);
            PackedRgb::of_texel([red, green, blue].map(decode), at)
        });
        for pair in levels.windows(2) {
            let [finer, level] = pair else { continue };
            let (before, rest) = texels.split_at_mut(level.first as usize);
            level.fill(&mut rest[..level.n_texels() as usize], |x, y| mean(before, finer, x, y));
        }
        Self { levels, texels: texels.into() }
    }

    /// Bytes in memory.
    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.texels)
    }

    /// Whether lookups find all texels that they look for.
    pub(super) fn is_whole(&self) -> bool {
        let size = self.levels.first().map_or([0; 2], |level| level.size);
        let n_texels = || self.levels.iter().map(|level| level.n_texels() as usize).sum::<usize>();
        size.iter().all(|&side| side > 0)
            && is_indexable(size)
            && self.levels.iter().copied().eq(levels(size))
            && self.texels.len() == n_texels()
    }
}

/// The levels of an image.
fn levels(of_image: [u32; 2]) -> impl Iterator<Item = Level> {
    let size = move |level| of_image.map(|n| halved(n, level));
    let next = move |&(number, finer): &(u32, Level)| {
        let next = number + 1;
        (finer.size != [1, 1]).then(|| (next, Level::new(size(next), finer.first + finer.n_texels())))
    };
    std::iter::successors(Some((0, Level::new(size(0), 0))), next).map(|(_, level)| level)
}

/// A texel of the next level: the mean of the area that it covers in the finer one.
fn mean(texels: &[PackedRgb], finer: &Level, x: u32, y: u32) -> PackedRgb {
    let [columns, rows] = [taps(x, finer.size[0]), taps(y, finer.size[1])];
    let mut mean = [0.0; 3];
    for (finer_y, weight_y) in rows {
        for (finer_x, weight_x) in columns {
            let texel = texels[finer.index(finer_x, finer_y)];
            for (channel, sum) in mean.iter_mut().enumerate() {
                *sum += texel.scaled(channel) * (weight_x * weight_y);
            }
        }
    }
    PackedRgb::of_texel([0, 1, 2].map(|channel| mean[channel] * UNITS[channel]), [x, y])
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

#[cfg(test)]
mod tests {
    use glam::{Vec2, Vec3A};

    use super::*;
    use crate::{
        model::material::Wrap,
        simd::InstructionSet,
        texture::{footprint::Footprint, lookup::MultiplyByMeans},
    };

    fn noise(width: u32, height: u32) -> Image {
        let texel =
            |index: u32| index.wrapping_mul(0x9e37_79b9).rotate_left(11).wrapping_mul(0x85eb_ca6b).to_le_bytes();
        Image { width, height, texels: (0..width * height).map(texel).collect() }
    }

    /// The mean of an image over a rectangle of texels, in linear light and `f64`.
    fn integral(image: &Image, [left, right]: [f64; 2], [top, bottom]: [f64; 2]) -> [f64; 3] {
        let (mut sum, mut area) = ([0.0; 3], 0.0);
        for (x, y) in (0..image.width).flat_map(|x| (0..image.height).map(move |y| (x, y))) {
            let along = |at: u32, from: f64, to: f64| (to.min(f64::from(at) + 1.0) - from.max(f64::from(at))).max(0.0);
            let weight = along(x, left, right) * along(y, top, bottom);
            let texel = image.texels[(y * image.width + x) as usize];
            (0..3).for_each(|channel| sum[channel] += weight * f64::from(srgb::decode(texel[channel])));
            area += weight;
        }
        sum.map(|sum| sum / area)
    }

    #[test]
    fn texels_of_all_levels_are_means_of_the_image() {
        for (width, height) in [(64, 64), (37, 21), (1, 9), (5, 1), (1, 1)] {
            let image = noise(width, height);
            let map = MipMap::new(image.clone(), Encoding::Srgb);
            assert_eq!(map.levels.last().map(|level| level.size), Some([1, 1]));
            assert_eq!(map.n_bytes() as u64, MipMap::n_bytes_of(&image));
            for level in &map.levels {
                for (x, y) in (0..level.size[0]).flat_map(|x| (0..level.size[1]).map(move |y| (x, y))) {
                    let texel = map.texels[level.index(x, y)];
                    let along = |at: u32, n: u32, all: u32| {
                        [at, at + 1].map(|end| f64::from(end) * f64::from(all) / f64::from(n))
                    };
                    let columns = along(x, level.size[0], width);
                    let expected = integral(&image, columns, along(y, level.size[1], height));
                    for channel in 0..3 {
                        let found = f64::from(texel.scaled(channel) * UNITS[channel]);
                        let error = (found - expected[channel]).abs();
                        // Parts of texels that are means themselves are not exact.
                        let is_exact = width == 64 || 2 * level.size[0] + 1 >= width;
                        let most = if is_exact { 2e-3 } else { 0.05 };
                        assert!(error < most, "{width}x{height} {:?} {x} {y}: {error}", level.size);
                    }
                }
            }
        }
    }

    fn means(map: &MipMap, wrap: [Wrap; 2], footprints: &[Footprint], instructions: InstructionSet) -> Vec<Vec3A> {
        const IDENTITY: [[f32; 3]; 2] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let of_block = |block: &[Footprint]| {
            let footprints = &block.iter().copied().collect();
            let mut means = [[1.0; 64]; 3];
            let (transform, factor, numbers) = (&IDENTITY, [1.0; 3], &mut means);
            // SAFETY: the callers ask for available instructions alone.
            unsafe { instructions.call(MultiplyByMeans { map, wrap, transform, footprints, factor, numbers }) };
            (0..block.len())
                .map(|index| Vec3A::new(means[0][index], means[1][index], means[2][index]))
                .collect::<Vec<_>>()
        };
        footprints.chunks(64).flat_map(of_block).collect()
    }

    #[test]
    fn lookups_are_means_of_their_footprint() {
        let image = noise(128, 64);
        let map = MipMap::new(image.clone(), Encoding::Srgb);
        let (mut errors, mut n) = (0.0, 0.0);
        for index in 0..60u8 {
            let width = 5.0 + 0.2 * f64::from(index);
            let centre = [30.0 + f64::from(index), 20.0 + 0.4 * f64::from(index)];
            let sides = [Vec2::new(width as f32 / 128.0, 0.0), Vec2::new(0.0, width as f32 / 64.0)];
            let footprint = Footprint { centre: Vec2::new(centre[0] as f32 / 128.0, centre[1] as f32 / 64.0), sides };
            let found = means(&map, [Wrap::Clamp; 2], &[footprint], InstructionSet::Portable)[0].to_array();
            let along = |axis: usize| [centre[axis] - 0.5 * width, centre[axis] + 0.5 * width];
            let expected = integral(&image, along(0), along(1));
            for channel in 0..3 {
                errors += (f64::from(found[channel]) - expected[channel]).powi(2);
                n += 1.0;
            }
        }
        // A texel deviates by 0.3.
        assert!((errors / n).sqrt() < 0.03, "{}", (errors / n).sqrt());
    }

    #[test]
    fn small_footprints_show_the_same_alone_and_among_others() {
        let map = MipMap::new(noise(64, 32), Encoding::Srgb);
        let footprint = |index: usize, width: f32| {
            let (x, y) = (index as f32 * 0.07 - 1.3, 0.9 - index as f32 * 0.013);
            let (right, up) = (width * [1.0, 1.35, 0.2][index % 3], width * [1.0, 0.45, 1.35][index % 3]);
            Footprint { centre: Vec2::new(x, y), sides: [Vec2::new(right / 64.0, 0.0), Vec2::new(0.0, up / 32.0)] }
        };
        let small: Vec<_> = (0..63).map(|index| footprint(index, 1.11 - 0.01 * index as f32)).collect();
        assert!(small.iter().all(|footprint| footprint.is_small(Vec2::new(64.0, 32.0))));
        let among_others: Vec<_> = small.iter().copied().chain([footprint(63, 9.0)]).collect();
        for wrap in [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp] {
            for instructions in InstructionSet::available() {
                let [alone, together] =
                    [&small, &among_others].map(|footprints| means(&map, [wrap; 2], footprints, instructions));
                assert_eq!(alone, together[..63], "{wrap:?}, {instructions:?}");
            }
        }
    }

    #[test]
    fn lookups_anywhere_are_finite_and_equal_with_all_instructions() {
        let odd = [0.3, -7.9, 1e9, f32::NAN, f32::INFINITY, -f32::MAX, 1e-40];
        let mut footprints = Vec::new();
        for (x, y) in odd.into_iter().flat_map(|x| odd.map(|y| (x, y))) {
            footprints
                .push(Footprint { centre: Vec2::new(x, 0.3), sides: [Vec2::new(y, 0.0), Vec2::new(0.001, 0.02)] });
            footprints.push(Footprint { centre: Vec2::new(0.1, y), sides: [Vec2::new(0.0, x), Vec2::new(x, y)] });
        }
        for (width, height) in [(1, 1), (64, 16), (3, 300)] {
            let map = MipMap::new(noise(width, height), Encoding::Linear);
            for wrap in [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp] {
                let all: Vec<_> = InstructionSet::available()
                    .into_iter()
                    .map(|instructions| means(&map, [wrap, Wrap::Repeat], &footprints, instructions))
                    .collect();
                assert!(all.iter().all(|means| means == &all[0]), "{wrap:?}");
                assert!(all[0].iter().all(|mean| mean.is_finite() && mean.max_element() < 1.001), "{wrap:?}");
            }
        }
    }
}
