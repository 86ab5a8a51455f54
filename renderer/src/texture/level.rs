//! One level of a texture: texels in blocks, so that those of a small area lie in few cache lines.

use std::ops::{Add, Mul, Sub};

use rayon::prelude::*;

use crate::model::material::{Image, Wrap};

/// Texels of one kind.
#[derive(Debug)]
pub(super) struct Level<T> {
    size: [u32; 2],
    blocks_per_row: usize,
    /// Blocks row by row, and in each its texels row by row.
    texels: Vec<T>,
}

/// Texels along a block's side: sixteen of four bytes fill a cache line.
const BLOCK_SIZE: u32 = 4;

const TEXELS_PER_BLOCK: usize = (BLOCK_SIZE * BLOCK_SIZE) as usize;

impl<T: Copy + Default + Send + Sync> Level<T> {
    /// Bytes of a level of this size.
    pub(super) fn n_bytes_of_size(size: [u32; 2]) -> u64 {
        size.map(|n| u64::from(n.div_ceil(BLOCK_SIZE))).iter().product::<u64>()
            * (TEXELS_PER_BLOCK * size_of::<T>()) as u64
    }

    /// Fills a level, in parallel; `texel` gives the texel of a column and row.
    pub(super) fn fill(size: [u32; 2], texel: impl Fn(u32, u32) -> T + Sync) -> Self {
        let [width, height] = size;
        let blocks_per_row = width.div_ceil(BLOCK_SIZE) as usize;
        let n_blocks = blocks_per_row * height.div_ceil(BLOCK_SIZE) as usize;
        let mut texels = vec![T::default(); n_blocks * TEXELS_PER_BLOCK];
        texels.par_chunks_mut(blocks_per_row * TEXELS_PER_BLOCK).enumerate().for_each(|(block_row, blocks)| {
            let first_row = block_row as u32 * BLOCK_SIZE;
            for y in first_row..height.min(first_row + BLOCK_SIZE) {
                for x in 0..width {
                    blocks[column_offset(x) + row_offset(y - first_row, 0)] = texel(x, y);
                }
            }
        });
        Self { size, blocks_per_row, texels }
    }

    /// The texels of an image.
    pub(super) fn of_image(image: &Image, texel: impl Fn([u8; 4]) -> T + Sync) -> Self {
        let width = image.width as usize;
        Self::fill([image.width, image.height], |x, y| texel(image.texels[y as usize * width + x as usize]))
    }

    /// Texels in a row and in a column.
    pub(super) fn size(&self) -> [u32; 2] {
        self.size
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.texels)
    }

    pub(super) fn texel(&self, x: u32, y: u32) -> T {
        self.texels[column_offset(x) + row_offset(y, self.blocks_per_row)]
    }

    /// The texture at a point, blended from the four texels around it, which `decode` reads. Coordinates are those of glTF, and
    /// may be anything.
    #[inline(always)]
    pub(super) fn bilinear<L>(&self, [u, v]: [f32; 2], [wrap_u, wrap_v]: [Wrap; 2], decode: impl Fn(T) -> L) -> L
    where
        L: Copy + Add<Output = L> + Sub<Output = L> + Mul<f32, Output = L>,
    {
        let ([left, right], x) = neighbours(u, self.size[0], wrap_u);
        let ([upper, lower], y) = neighbours(v, self.size[1], wrap_v);
        let (left, right) = (column_offset(left), column_offset(right));
        let (upper, lower) = (row_offset(upper, self.blocks_per_row), row_offset(lower, self.blocks_per_row));
        let (a, b) = (decode(self.texels[upper + left]), decode(self.texels[upper + right]));
        let (c, d) = (decode(self.texels[lower + left]), decode(self.texels[lower + right]));
        let (above, below) = (a + (b - a) * x, c + (d - c) * x);
        above + (below - above) * y
    }
}

/// A column's part of the index of a texel.
#[inline]
fn column_offset(x: u32) -> usize {
    (x / BLOCK_SIZE) as usize * TEXELS_PER_BLOCK + (x % BLOCK_SIZE) as usize
}

/// A row's part of the index of a texel.
#[inline]
fn row_offset(y: u32, blocks_per_row: usize) -> usize {
    (y / BLOCK_SIZE) as usize * blocks_per_row * TEXELS_PER_BLOCK + (y % BLOCK_SIZE * BLOCK_SIZE) as usize
}

/// The two texels of a row (or column) of `n` whose centres enclose a coordinate, and the fraction of the way between them.
#[inline(always)]
fn neighbours(coordinate: f32, n: u32, wrap: Wrap) -> ([u32; 2], f32) {
    let x = wrapped(coordinate, wrap) * n as i32 as f32 - 0.5;
    let last = n - 1;
    let (before_first, after_last) = if wrap == Wrap::Repeat { (last, 0) } else { (0, last) };
    if x < 0.0 {
        return ([before_first, 0], x + 1.0);
    }
    let left = (x as i32 as u32).min(last);
    ([left, if left == last { after_last } else { left + 1 }], x - left as i32 as f32)
}

/// The coordinate from 0 to 1 where a texture shows the same.
#[inline(always)]
fn wrapped(coordinate: f32, wrap: Wrap) -> f32 {
    match wrap {
        Wrap::Repeat => fraction(coordinate),
        Wrap::Mirror => 1.0 - (fraction(coordinate * 0.5) * 2.0 - 1.0).abs(),
        // This order of `max` and `min` turns NaN into 0.
        Wrap::Clamp => coordinate.max(0.0).min(1.0),
    }
}

/// The distance from the next lower integer, from 0 to 1; 0 for numbers so large that all are integers, and for NaN.
#[inline(always)]
fn fraction(x: f32) -> f32 {
    const ALL_ARE_INTEGERS: f32 = 8_388_608.0;
    if !(x.abs() < ALL_ARE_INTEGERS) {
        return 0.0;
    }
    let beyond = x - x as i32 as f32;
    if beyond < 0.0 { beyond + 1.0 } else { beyond }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WRAPS: [Wrap; 3] = [Wrap::Repeat, Wrap::Mirror, Wrap::Clamp];

    #[test]
    fn texels_are_found_where_they_were_put() {
        for size in [[1, 1], [7, 9], [8, 8], [17, 3], [1, 40]] {
            let level = Level::fill(size, |x, y| [x, y]);
            assert!((0..size[0]).all(|x| (0..size[1]).all(|y| level.texel(x, y) == [x, y])), "{size:?}");
            assert_eq!(level.n_bytes() as u64, Level::<[u32; 2]>::n_bytes_of_size(size));
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
            let row = Level::fill([n, 1], |x, _| (x * x) as f32);
            for coordinate in (-200..200).map(|step| step as f32 / 37.0) {
                let x = f64::from(coordinate) * f64::from(n) - 0.5;
                let [left, right] = [0, 1].map(|right| texel_of_row(x.floor() as i64 + right, i64::from(n), wrap));
                let [left, right] = [left, right].map(|index| (index * index) as f64);
                let expected = left + (right - left) * (x - x.floor());
                let found = row.bilinear([coordinate, 0.3], [wrap, Wrap::Repeat], |texel| texel);
                assert!(
                    (f64::from(found) - expected).abs() < 0.02,
                    "{wrap:?} {n} {coordinate}: {found}, not {expected}"
                );
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
