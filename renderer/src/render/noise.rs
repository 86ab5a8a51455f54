//! As many samples as a tile needs: the noise of path-traced tiles is estimated, and those with little get no more.
//!
//! The estimate is a pure function of a tile's samples, so every render server stops at the same one. It compares the mean of
//! the first half of the samples with that of the second, as a display would show them: both are low-discrepancy samples
//! where their number is a power of two, and the many values of a tile make the estimate a good one. Tiles rather than pixels
//! decide, because a pixel whose few samples happen to agree would stop too early. Means of squares of 2×2 pixels are
//! compared: the samples of neighbours complement each other, so single pixels keep a grain that is finer than what is seen.
//!
//! Samples that are proportional to the standard deviation of a tile's light give a picture the least error; tiles of equal
//! noise, as many as their variance asks for, are no better in that than equal numbers everywhere. Between the two, a tile
//! that needs many samples may keep somewhat more noise: see [`allowed`].

use std::{collections::BTreeMap, ops::Range};

use shared::{
    division::{SampleRect, Share, TILE_SIZE},
    noise::NoiseLimit,
    protocol::{FrameSpec, LightingMode, ShadingMode},
};

use crate::render::{
    blocks::{SampleBlock, for_each_group},
    lighting::{LightSums, Lighting},
    tracer::Sampler,
};

/// Samples of each pixel before the first estimate: a power of two, so that its halves are low-discrepancy samples. Those of
/// 64 pixels complement each other, and also find small bright features.
const FEWEST_SAMPLES: u32 = 8;

/// A tile that needs this many samples may keep just the noise of the limit.
const USUAL_SAMPLES: u32 = 64;

/// Between one estimate and the next, a tile may stop after each of so many parts of the samples.
const N_STEPS: u32 = 4;

/// The limit of a frame whose tiles may stop early.
pub(super) fn of_frame(spec: &FrameSpec) -> Option<NoiseLimit> {
    let may_stop = spec.view == ShadingMode::Shaded
        && spec.rays == LightingMode::Path
        && spec.samples.noise != NoiseLimit::NONE
        && spec.samples.count > FEWEST_SAMPLES;
    may_stop.then_some(spec.samples.noise)
}

/// Sums the light of at most `most` samples of each pixel of `units` of a share; calls `visit` as
/// [`sum_lights`](crate::render::scene::Scene::sum_lights) does.
pub(super) fn sum_lights(
    sampler: &mut Sampler<'_>,
    (share, units): (&Share, Range<u32>),
    (most, limit): (u32, NoiseLimit),
    mut visit: impl FnMut(&Lighting<'_>, &LightSums, (usize, usize), usize),
) {
    if units.clone().any(|unit| share.samples(unit).count() > 1) {
        for_each_group(share, units, |blocks| sum_group(sampler, blocks, (most, limit), &mut visit));
        return;
    }
    // Where pixels are divided one by one, their whole tiles are needed to decide.
    let mut tiles = BTreeMap::<_, Vec<_>>::new();
    for (output_index, unit) in units.enumerate() {
        let SampleRect { columns, rows } = share.samples(unit);
        let tile = (rows.start / TILE_SIZE, columns.start / TILE_SIZE);
        tiles.entry(tile).or_default().push(((columns.start, rows.start), output_index));
    }
    let (xres, yres) = share.units().size().into();
    for ((row, column), pixels) in tiles {
        let along = |tile: u32, end: u32| tile * TILE_SIZE..((tile + 1) * TILE_SIZE).min(end);
        let samples = SampleRect { columns: along(column, xres), rows: along(row, yres) };
        let tile = SampleBlock::Unit { samples, first_index: 0 };
        sum_group(sampler, std::slice::from_ref(&tile), (most, limit), |lighting, sums, at, index| {
            let of_pixel = pixels.iter().find(|(pixel, _)| *pixel == tile.sample(index));
            of_pixel.into_iter().for_each(|&(_, output_index)| visit(lighting, sums, at, output_index));
        });
    }
}

/// Sums the light of neighbouring tiles, each until its noise is below the limit.
fn sum_group(
    sampler: &mut Sampler<'_>,
    blocks: &[SampleBlock<'_>],
    (most, limit): (u32, NoiseLimit),
    mut visit: impl FnMut(&Lighting<'_>, &LightSums, (usize, usize), usize),
) {
    let mut blocks = blocks.to_vec();
    let mut sums = sampler.lighting.no_light();
    sampler.add(&blocks, 0..FEWEST_SAMPLES / 2, &mut sums);
    let mut half = sums.clone();
    sampler.add(&blocks, FEWEST_SAMPLES / 2..FEWEST_SAMPLES, &mut sums);
    while !sampler.is_unwanted() {
        let n_samples = sums.n_samples;
        let halves = [&half, &sums.without(&half)];
        let estimate = |(index, block): (usize, &SampleBlock<'_>)| {
            let noise = squared_noise(&sampler.lighting, halves, index, block);
            n_steps(noise, n_samples, limit).map_or(most, |steps| most.min(n_samples + steps * (n_samples / N_STEPS)))
        };
        let mut ends: Vec<_> = blocks.iter().enumerate().map(estimate).collect();
        half = sums.clone();
        // Add samples in steps, and put aside the tiles that have enough.
        for step in 0..=N_STEPS {
            let end = (n_samples + step * (n_samples / N_STEPS)).min(most);
            sampler.add(&blocks, sums.n_samples..end, &mut sums);
            for index in (0..blocks.len()).rev() {
                if ends[index] > end {
                    continue;
                }
                for pixel in 0..blocks[index].n_samples() {
                    visit(&sampler.lighting, &sums, (index, pixel), blocks[index].output_index(pixel));
                }
                ends.swap_remove(index);
                blocks.swap_remove(index);
                sums.replace(index, blocks.len());
                half.replace(index, blocks.len());
            }
            if blocks.is_empty() {
                return;
            }
        }
    }
}

/// The estimated square of a tile's noise in levels, from two halves of its samples: the mean square, over all squares of 2×2
/// pixels and channels, of the error of the mean of encoded values, which is half of the halves' difference.
fn squared_noise(lighting: &Lighting<'_>, halves: [&LightSums; 2], block: usize, of: &SampleBlock<'_>) -> f64 {
    let mut differences = [[0; 3]; 64];
    for (pixel, difference) in differences.iter_mut().enumerate().take(of.n_samples()) {
        let [a, b] = halves.map(|sums| lighting.encode(sums, (block, pixel)));
        *difference = std::array::from_fn(|channel| i32::from(a[channel]) - i32::from(b[channel]));
    }
    of_differences(&differences[..of.n_samples()], of.row_length())
}

/// The same from the differences between halves of a tile's pixels, row by row.
fn of_differences(differences: &[[i32; 3]], row_length: usize) -> f64 {
    let n_rows = differences.len() / row_length;
    // Parts of tiles at a frame's edge may be narrower than a square.
    let [width, height] = [row_length, n_rows].map(|along| along.min(2));
    let (mut sum, mut n) = (0, 0);
    for (row, column) in (0..=n_rows - height).flat_map(|row| (0..=row_length - width).map(move |at| (row, at))) {
        let mut of_square = [0; 3];
        for k in 0..width * height {
            let difference = differences[(row + k / width) * row_length + column + k % width];
            of_square.iter_mut().zip(difference).for_each(|(sum, difference)| *sum += difference);
        }
        sum += of_square.map(|of_channel| i64::from(of_channel * of_channel)).iter().sum::<i64>();
        n += 3;
    }
    let n_pixels = (width * height) as f64;
    sum as f64 / (4.0 * n_pixels * n_pixels * f64::from(n))
}

/// After how many steps of a quarter of its `n_samples` samples a tile has enough: 0 if it has already; `None` if another
/// estimate comes first.
fn n_steps(squared_noise: f64, n_samples: u32, limit: NoiseLimit) -> Option<u32> {
    (0..N_STEPS).find(|steps| {
        // The square of the error falls at least as fast as the number of samples rises.
        let growth = 1.0 + f64::from(*steps) / f64::from(N_STEPS);
        squared_noise <= growth * allowed(f64::from(n_samples) * growth, limit)
    })
}

/// The square of the noise that a tile of so many samples may keep.
///
/// It grows with the root of their number. With variances v and squares of the noise v/n, the numbers are then proportional to
/// v^⅔, between those of the least error, v^½, and those of equal noise, v. Where the logarithms of variances are normal, nine
/// tenths of what the former saves are saved.
fn allowed(n_samples: f64, limit: NoiseLimit) -> f64 {
    let levels = f64::from(limit.centilevels()) / 100.0;
    levels * levels * (n_samples / f64::from(USUAL_SAMPLES)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_stops_where_its_error_is_expected_to_reach_the_limit() {
        let limit = "2".parse().unwrap();
        let steps = |noise: f64, n_samples| n_steps(noise * noise, n_samples, limit);
        let expected = [Some(0), Some(0), Some(1), Some(2), Some(3), None];
        assert_eq!([0.0, 2.0, 2.1, 2.7, 3.0, 3.1].map(|noise| steps(noise, 64)), expected);
        // A quarter of the samples: the square of the limit is half as large.
        assert_eq!([1.41, 1.42].map(|noise| steps(noise, 16)), [Some(0), Some(1)]);
        assert_eq!(n_steps(0.03, 64, "0.1".parse().unwrap()), None);
    }

    #[test]
    fn the_noise_is_that_of_means_of_squares() {
        // Halves that differ by d levels everywhere: the error is d / 2.
        for (row_length, n_rows) in [(8, 8), (8, 1), (1, 8), (3, 5), (1, 1)] {
            let squared = of_differences(&vec![[6; 3]; row_length * n_rows], row_length);
            assert_eq!(squared, 9.0, "{row_length} {n_rows}");
        }
        // A grain of single pixels is not seen, one of larger squares is.
        let pattern = |side: usize| -> Vec<_> {
            let sign = |at: usize| if (at % 8 / side + at / 8 / side).is_multiple_of(2) { 6 } else { -6 };
            (0..64).map(|at| [sign(at); 3]).collect()
        };
        assert_eq!(of_differences(&pattern(1), 8), 0.0);
        let coarse = of_differences(&pattern(4), 8);
        assert!((6.0..9.0).contains(&coarse), "{coarse}");
    }
}
