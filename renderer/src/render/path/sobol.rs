//! Low-discrepancy samples: pure functions of pixel and sample number.
//!
//! Pairs of dimensions of Sobol's sequence, each with an order and an Owen scrambling of its own: Burley, "Practical
//! Hash-based Owen Scrambling" (2020), padded as in Pharr, Jakob and Humphreys, *Physically Based Rendering* (4th edition,
//! 2023, section 8.7.3), with the hash of Vegdahl, "Building a Better LK Hash" (2021).
//!
//! The pixels of a tile share orders and scramblings, and differ by digital shifts: so the samples of neighbours fill the
//! square together, their errors differ, and what is left of them is fine grain. Ahmed and Wonka, "Screen-Space Blue-Noise
//! Diffusion of Monte Carlo Sampling Error via Hierarchical Ordering of Pixels" (2020) have each pixel take a part of one
//! sequence, which needs the number of samples beforehand; shifts serve any number.

use shared::division::TILE_SIZE;

use crate::render::{sampling::hash_u32, surface::N};

/// The random numbers of one sample of a pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct PixelSample {
    /// Of the tile.
    seed: u32,
    /// The pixel's place in the tile along a Z-shaped curve, with its bits reversed: the first bit says which half of the
    /// tile, the last which of two neighbours.
    place: u32,
    /// The sample's number, with its bits reversed.
    reversed: u32,
}

impl PixelSample {
    /// Sample number `sample` of pixel (i, j).
    pub(super) fn new((i, j): (u32, u32), sample: u32) -> Self {
        let (column, row) = (i / TILE_SIZE, j / TILE_SIZE);
        let seed = hash_u32(column ^ hash_u32(row ^ hash_u32(SEED)));
        let bit = |of: u32, from: u32, to: u32| (of >> from & 1) << (31 - to);
        let place = (0..3).fold(0, |place, level| place | bit(i, level, 2 * level) | bit(j, level, 2 * level + 1));
        Self { seed, place, reversed: sample.reverse_bits() }
    }

    /// Another sample of the pixel.
    pub(super) fn with_number(self, sample: u32) -> Self {
        Self { reversed: sample.reverse_bits(), ..self }
    }

    /// A point of the unit square, 1 excluded. Points of equal `dimension` fill it evenly over the samples of a pixel, and
    /// over those of neighbouring pixels of a tile; those of others are independent.
    #[inline(always)]
    pub(super) fn pair(self, dimension: u32) -> [f32; 2] {
        let seed = hash_u32(self.seed ^ hash_u32(dimension));
        // Halves of the tile, of these, and so on change places by chance, so that no pattern repeats.
        let shift = SHIFTS[(scramble_reversed(self.place, hash_u32(seed)) >> 26) as usize];
        // The bits of the shuffled index, reversed, are its first coordinate already.
        let first = scramble_reversed(self.reversed, seed);
        let coordinates = [first, pascal(first)];
        std::array::from_fn(|axis| {
            let seed = hash_u32(seed ^ SEED_OF_AXES[axis]);
            let bits = scramble_reversed((coordinates[axis] ^ shift[axis]).reverse_bits(), seed).reverse_bits();
            // 24 bits, so that no number is rounded up to 1; signed, because AVX2 converts no others.
            (bits >> 8) as i32 as f32 * (1.0 / 16_777_216.0)
        })
    }
}

/// Samples of [`N`] paths, in a form for loops that the compiler turns into vector instructions.
pub(super) struct PixelSamples {
    seeds: [u32; N],
    places: [u32; N],
    reversed: [u32; N],
}

impl PixelSamples {
    #[inline(always)]
    pub(super) fn of(sample: impl Fn(usize) -> PixelSample) -> Self {
        let mut samples = Self { seeds: [0; N], places: [0; N], reversed: [0; N] };
        for lane in 0..N {
            let PixelSample { seed, place, reversed } = sample(lane);
            (samples.seeds[lane], samples.places[lane], samples.reversed[lane]) = (seed, place, reversed);
        }
        samples
    }

    #[inline(always)]
    pub(super) fn get(&self, lane: usize) -> PixelSample {
        PixelSample { seed: self.seeds[lane], place: self.places[lane], reversed: self.reversed[lane] }
    }
}

/// Any numbers.
const SEED: u32 = 0x5eed_0001;
const SEED_OF_AXES: [u32; 2] = [0x9e37_79b9, 0x7f4a_7c15];

/// Digital shifts of a tile's halves, quarters, and so on to single pixels, from the last: with the first 2^k columns of
/// Sobol's matrices, two, four or six of them are the columns of nets, for each k. Found by a random search for nets of the
/// best quality at 4 to 128 samples: those of 2×2 pixels have t ≤ 2, of 4×4 and a tile t ≤ 3, and of one pixel t = 0.
const COLUMNS: [[u32; 2]; 6] = [
    [0xb734_0000, 0x69ac_0000],
    [0x6ce4_0000, 0xb6d8_0000],
    [0x8950_0000, 0xd260_0000],
    [0x24d4_0000, 0x80e8_0000],
    [0x6a78_0000, 0xa29c_0000],
    [0x19cc_0000, 0x6aa8_0000],
];

/// The digital shift of each place in a tile.
const SHIFTS: [[u32; 2]; 64] = {
    let mut shifts = [[0; 2]; 64];
    let mut place = 0;
    while place < 64 {
        let mut column = 0;
        while column < 6 {
            if place >> (5 - column) & 1 == 1 {
                shifts[place][0] ^= COLUMNS[column][0];
                shifts[place][1] ^= COLUMNS[column][1];
            }
            column += 1;
        }
        place += 1;
    }
    shifts
};

/// Owen's scrambling of a number with reversed bits: each bit may flip by those below it.
#[inline(always)]
fn scramble_reversed(mut x: u32, seed: u32) -> u32 {
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul(seed >> 16 | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^ x.wrapping_mul(0x53a2_2864)
}

/// The second coordinate of Sobol's sequence from the first: Pascal's matrix modulo 2, after Ahmed, "An Implementation
/// Algorithm of 2D Sobol Sequence Fast, Elegant, and Compact" (2024).
#[inline(always)]
fn pascal(mut x: u32) -> u32 {
    x ^= x << 16;
    x ^= (x & 0x00ff_00ff) << 8;
    x ^= (x & 0x0f0f_0f0f) << 4;
    x ^= (x & 0x3333_3333) << 2;
    x ^ (x & 0x5555_5555) << 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_coordinate_is_that_of_the_direction_numbers() {
        for index in (0..4096u32).chain([u32::MAX, 0xdead_beef]) {
            // Sobol's second dimension has the polynomial x + 1: each direction number is the last one xor its half.
            let (mut expected, mut direction) = (0, 1 << 31);
            for bit in 0..32 {
                expected ^= if index >> bit & 1 == 1 { direction } else { 0 };
                direction ^= direction >> 1;
            }
            assert_eq!(pascal(index.reverse_bits()), expected, "{index}");
        }
    }

    #[test]
    fn every_power_of_two_of_samples_is_a_net() {
        for (pixel, dimension) in [((0, 0), 0), ((3, 5), 1), ((1023, 7), 12), ((40000, 40001), 300)] {
            for (log, offset) in [(4, 0), (4, 16), (8, 0), (8, 512)] {
                let points: Vec<_> =
                    (0..1 << log).map(|index| PixelSample::new(pixel, offset + index).pair(dimension)).collect();
                // Each elementary interval of area 1/n holds one of n points.
                for columns_log in 0..=log {
                    let mut seen = vec![0; 1 << log];
                    for [x, y] in &points {
                        let (column, row) = (
                            (x * (1 << columns_log) as f32) as usize,
                            (y * (1 << (log - columns_log)) as f32) as usize,
                        );
                        seen[row << columns_log | column] += 1;
                    }
                    assert!(seen.iter().all(|&n| n == 1), "{pixel:?} {dimension} {log} {columns_log}");
                }
            }
        }
    }

    #[test]
    fn squares_of_pixels_fill_the_square_together() {
        // Corner and side of a square, and the base-2 logarithm of the points in the smallest intervals that hold as many each.
        for ((i, j), side, log_points) in [((2, 4), 2, 2), ((8, 12), 4, 3), ((40, 16), 8, 3)] {
            for log in 2..=7 {
                let pixels = (0..side * side).map(|at| (i + at % side, j + at / side));
                let points: Vec<_> = pixels
                    .flat_map(|pixel| (0..1 << log).map(move |index| PixelSample::new(pixel, index).pair(5)))
                    .collect();
                let n = points.len() >> log_points;
                for columns in (0..=n.ilog2()).map(|log| 1usize << log) {
                    let mut seen = vec![0; n];
                    for [x, y] in &points {
                        let (column, row) = ((x * columns as f32) as usize, (y * (n / columns) as f32) as usize);
                        seen[row * columns + column] += 1;
                    }
                    assert!(seen.iter().all(|&n| n == 1 << log_points), "{side} {log}: {columns} columns");
                }
            }
        }
    }

    #[test]
    fn tiles_and_dimensions_are_independent() {
        let correlation = |other: &dyn Fn(u32) -> f32| {
            let products =
                (0..4096).map(|index| (PixelSample::new((index, 7), 1).pair(0)[0] - 0.5) * (other(index) - 0.5));
            products.sum::<f32>() / 4096.0 * 12.0
        };
        let same = correlation(&|index| PixelSample::new((index, 7), 1).pair(0)[0]);
        assert!((same - 1.0).abs() < 0.1, "{same}");
        for other in [
            correlation(&|index| PixelSample::new((index, 7), 1).pair(0)[1]),
            correlation(&|index| PixelSample::new((index, 7), 1).pair(1)[0]),
            correlation(&|index| PixelSample::new((index, 8), 1).pair(0)[0]),
            correlation(&|index| PixelSample::new((index + 8, 7), 1).pair(0)[0]),
        ] {
            // Four standard errors of the mean of 4096 products.
            assert!(other.abs() < 4.0 / 64.0, "{other}");
        }
    }
}
