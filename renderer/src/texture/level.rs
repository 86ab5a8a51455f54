//! One level of a texture: texels in blocks, so that those of a small area lie in few cache lines.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::model::material::Wrap;

/// The place of a level among the texels of all levels: blocks row by row, and in each its texels row by row.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Level {
    /// Texels in a row and in a column.
    pub(super) size: [u32; 2],
    pub(super) blocks_per_row: u32,
    /// Index of its first texel.
    pub(super) first: u32,
}

/// Texels along a block's side: sixteen of four bytes fill a cache line.
const BLOCK_SIZE: u32 = 4;

const TEXELS_PER_BLOCK: u32 = BLOCK_SIZE * BLOCK_SIZE;

/// Most texels along a side of an image: beyond them, `f32` does not tell neighbours apart.
const LONGEST_SIDE: u32 = 1 << 22;

/// Whether the texels of all levels of an image have indices: up to 32768×32768 they do.
pub(super) fn is_indexable([width, height]: [u32; 2]) -> bool {
    width.max(height) <= LONGEST_SIDE
        && u64::from(width.div_ceil(BLOCK_SIZE)) * u64::from(height.div_ceil(BLOCK_SIZE)) <= 1 << 26
}

impl Level {
    /// A level of this size, whose texels follow `first` others.
    pub(super) fn new(size: [u32; 2], first: u32) -> Self {
        Self { size, blocks_per_row: blocks_per_row(size[0]), first }
    }

    /// The number of texels, with those that fill up blocks.
    pub(super) fn n_texels(&self) -> u32 {
        self.blocks_per_row * self.size[1].div_ceil(BLOCK_SIZE) * TEXELS_PER_BLOCK
    }

    /// The index of the texel of a column and row.
    pub(super) fn index(&self, x: u32, y: u32) -> usize {
        (self.first + column_offset(x) + row_offset(y, self.blocks_per_row)) as usize
    }

    /// Arranges the texels of an image, which lie row by row at the beginning of `texels`, in blocks, and changes each, whose
    /// column and row are the second argument. In parallel.
    pub(super) fn arrange<T: Copy + Default + Send>(&self, texels: &mut [T], change: impl Fn(T, [u32; 2]) -> T + Sync) {
        let [width, height] = self.size.map(|side| side as usize);
        let block_row = (self.blocks_per_row * TEXELS_PER_BLOCK) as usize;
        // The last first, so that none covers one that is still to be moved.
        for row in (0..height).rev() {
            let (block_rows, rows) = (row / BLOCK_SIZE as usize, row % BLOCK_SIZE as usize);
            let (from, to) = (row * width, block_rows * block_row + rows * width);
            if from != to {
                texels.copy_within(from..from + width, to);
            }
        }
        texels.par_chunks_mut(block_row).enumerate().for_each_init(Vec::new, |rows, (block_row, blocks)| {
            let n_rows = (height - block_row * BLOCK_SIZE as usize).min(BLOCK_SIZE as usize);
            rows.clear();
            rows.extend_from_slice(&blocks[..n_rows * width]);
            blocks.fill(T::default());
            let first_row = block_row as u32 * BLOCK_SIZE;
            for (y, row) in (0..).zip(rows.chunks_exact(width)) {
                for (x, &texel) in (0..).zip(row) {
                    blocks[(column_offset(x) + row_offset(y, 0)) as usize] = change(texel, [x, first_row + y]);
                }
            }
        });
    }

    /// Fills a level's texels, in parallel; `texel` gives that of a column and row.
    pub(super) fn fill<T: Send>(&self, texels: &mut [T], texel: impl Fn(u32, u32) -> T + Sync) {
        let [width, height] = self.size;
        let block_rows = texels.par_chunks_mut((self.blocks_per_row * TEXELS_PER_BLOCK) as usize);
        block_rows.enumerate().for_each(|(block_row, blocks)| {
            let first_row = block_row as u32 * BLOCK_SIZE;
            for y in first_row..height.min(first_row + BLOCK_SIZE) {
                for x in 0..width {
                    blocks[(column_offset(x) + row_offset(y - first_row, 0)) as usize] = texel(x, y);
                }
            }
        });
    }
}

/// The columns or rows of a level, of those of the image: each level has half as many as the finer one, and at least one.
#[inline(always)]
pub(super) fn halved(n: u32, level: u32) -> u32 {
    n.wrapping_shr(level).max(1)
}

/// The number of blocks in a row of `width` texels.
#[inline(always)]
pub(super) fn blocks_per_row(width: u32) -> u32 {
    width.div_ceil(BLOCK_SIZE)
}

/// A column's part of the index of a texel.
#[inline(always)]
pub(super) fn column_offset(x: u32) -> u32 {
    x / BLOCK_SIZE * TEXELS_PER_BLOCK + x % BLOCK_SIZE
}

/// A row's part of the index of a texel.
#[inline(always)]
pub(super) fn row_offset(y: u32, blocks_per_row: u32) -> u32 {
    y / BLOCK_SIZE * blocks_per_row * TEXELS_PER_BLOCK + y % BLOCK_SIZE * BLOCK_SIZE
}

/// The two texels of a row (or column) of `n` whose centres enclose a coordinate, and the fraction of the way between them.
///
/// Coordinates are those of glTF, and may be anything. Nothing branches, so that loops over arrays become vector instructions.
#[inline(always)]
pub(super) fn neighbours(coordinate: f32, n: u32, wrap: Wrap) -> ([u32; 2], f32) {
    let n = n as i32;
    let x = wrapped(coordinate, wrap) * n as f32 - 0.5;
    let (left, fraction) = floor(x);
    let (before_first, after_last) = if wrap == Wrap::Repeat { (n - 1, 0) } else { (0, n - 1) };
    let right = if left + 1 < n { left + 1 } else { after_last };
    ([if left < 0 { before_first } else { left } as u32, right as u32], fraction)
}

/// The coordinate from 0 to 1 where a texture shows the same.
#[inline(always)]
fn wrapped(coordinate: f32, wrap: Wrap) -> f32 {
    match wrap {
        Wrap::Repeat => fraction(coordinate),
        Wrap::Mirror => 1.0 - (fraction(coordinate * 0.5) * 2.0 - 1.0).abs(),
        // NaN becomes 0.
        Wrap::Clamp => {
            if coordinate > 0.0 {
                coordinate.min(1.0)
            } else {
                0.0
            }
        }
    }
}

/// The distance from the next lower integer, from 0 to 1; 0 for NaN and infinity.
#[inline(always)]
fn fraction(x: f32) -> f32 {
    let fraction = x - x.floor();
    if fraction < 1.0 { fraction } else { 0.0 }
}

/// The next lower integer, and the distance from it; `x` is at most [`LONGEST_SIDE`] from 0.
#[inline(always)]
fn floor(x: f32) -> (i32, f32) {
    let lower = x.floor();
    (round(lower).1, x - lower)
}

/// The nearest integer, as both kinds of number; `x` is at most [`LONGEST_SIDE`] from 0.
///
/// A sum with a large number is an integer, whose bits can be read. A cast saturates, for which the compiler has no vector
/// instructions.
#[inline(always)]
pub(super) fn round(x: f32) -> (f32, i32) {
    const LARGE: f32 = 12_582_912.0;
    let sum = x + LARGE;
    (sum - LARGE, sum.to_bits() as i32 - LARGE.to_bits() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const WRAPS: [Wrap; 3] = [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp];

    #[test]
    fn texels_are_found_where_they_were_put() {
        for size in [[1, 1], [7, 9], [8, 8], [17, 3], [1, 40], [16, 12], [16, 13], [13, 16]] {
            let level = Level::new(size, 0);
            let mut arranged: Vec<_> = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| [x, y])).collect();
            arranged.resize(level.n_texels() as usize, [0; 2]);
            level.arrange(&mut arranged, |texel, [x, y]| {
                assert_eq!(texel, [x, y]);
                [x + 1, y + 2]
            });
            let is_there = |x, y| arranged[level.index(x, y)] == [x + 1, y + 2];
            assert!((0..size[0]).all(|x| (0..size[1]).all(|y| is_there(x, y))), "{size:?}");
            let mut texels = vec![[u32::MAX; 2]; level.n_texels() as usize];
            level.fill(&mut texels, |x, y| [x, y]);
            assert!((0..size[0]).all(|x| (0..size[1]).all(|y| texels[level.index(x, y)] == [x, y])), "{size:?}");
        }
    }

    /// The texel of an endless row at `index`, by the definitions of glTF.
    fn texel_of_row(index: i64, n: i64, wrap: Wrap) -> i64 {
        let around = index.rem_euclid(2 * n);
        match wrap {
            Wrap::Repeat => index.rem_euclid(n),
            Wrap::Mirror => around.min(2 * n - 1 - around),
            Wrap::Clamp => index.clamp(0, n - 1),
        }
    }

    #[test]
    fn every_wrap_continues_the_texture_as_gltf_says() {
        for (wrap, n) in WRAPS.into_iter().flat_map(|wrap| [1u32, 2, 5, 64].map(|n| (wrap, n))) {
            for coordinate in (-200..200).map(|step| step as f32 / 37.0) {
                let x = f64::from(coordinate) * f64::from(n) - 0.5;
                let [left, right] = [0, 1].map(|right| texel_of_row(x.floor() as i64 + right, i64::from(n), wrap));
                let blend = |left: f64, right: f64, part: f64| left * left + (right * right - left * left) * part;
                let expected = blend(left as f64, right as f64, x - x.floor());
                let ([left, right], part) = neighbours(coordinate, n, wrap);
                let found = blend(left.into(), right.into(), part.into());
                assert!((found - expected).abs() < 0.02, "{wrap:?} {n} {coordinate}: {found}, not {expected}");
            }
        }
    }

    #[test]
    fn no_coordinate_leaves_the_texture() {
        let odd = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -f32::MAX, -1e-30, 8_388_607.5, -8_388_607.5];
        for (wrap, coordinate) in WRAPS.into_iter().flat_map(|wrap| odd.map(|odd| (wrap, odd))) {
            for n in [1, 3, 16384] {
                let ([left, right], fraction) = neighbours(coordinate, n, wrap);
                assert!(left < n && right < n && (0.0..=1.0).contains(&fraction), "{wrap:?} {coordinate} {n}");
            }
        }
    }
}
