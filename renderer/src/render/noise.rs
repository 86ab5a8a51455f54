//! As many samples as a tile needs: the noise of path-traced tiles is estimated, and those with little get no more.
//!
//! The estimate is a pure function of a tile's samples, so every render server stops at the same one. It compares the mean of
//! the first half of the samples with that of the second, as a display would show them: both are low-discrepancy samples
//! where their number is a power of two, and the 192 values of a tile make the estimate a good one. Tiles rather than pixels
//! decide, because a pixel whose few samples happen to agree would stop too early.

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

/// Samples of each pixel before the first estimate: a power of two, so that its halves are low-discrepancy samples. Eight
/// and eight of 64 pixels also find small bright features.
const FEWEST_SAMPLES: u32 = 16;

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
            let squares = squared_difference(&sampler.lighting, halves, index, block.n_samples());
            let steps = n_steps(squares, block.n_samples(), limit);
            steps.map_or(most, |steps| most.min(n_samples + steps * (n_samples / N_STEPS)))
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

/// Sum of the squared differences of a tile's encoded values between two halves of its samples.
fn squared_difference(lighting: &Lighting<'_>, halves: [&LightSums; 2], block: usize, n_pixels: usize) -> u64 {
    let of_pixel = |pixel: usize| {
        let [a, b] = halves.map(|sums| lighting.encode(sums, (block, pixel)));
        a.into_iter().zip(b).map(|(a, b)| u64::from(a.abs_diff(b)).pow(2)).sum::<u64>()
    };
    (0..n_pixels).map(of_pixel).sum()
}

/// After how many steps of a quarter of its samples a tile has enough: 0 if it has already; `None` if another estimate comes
/// first.
fn n_steps(squared_difference: u64, n_pixels: usize, limit: NoiseLimit) -> Option<u32> {
    // The error of the mean of two halves is half of their difference.
    let hundredths = 10_000 * squared_difference;
    let allowed = 4 * 3 * n_pixels as u64 * u64::from(limit.centilevels()).pow(2);
    // The square of the error falls at least as fast as the number of samples rises.
    let steps = (u64::from(N_STEPS) * hundredths.saturating_sub(allowed)).div_ceil(allowed);
    (steps < u64::from(N_STEPS)).then_some(steps as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_stops_where_its_error_is_expected_to_reach_the_limit() {
        let limit = "2".parse().unwrap();
        // Halves that differ by d levels everywhere: the error is d / 2.
        let steps =
            |difference: u64, n_pixels: usize| n_steps(3 * n_pixels as u64 * difference * difference, n_pixels, limit);
        assert_eq!([0, 4, 5, 6].map(|difference| steps(difference, 64)), [Some(0), Some(0), Some(3), None]);
        assert_eq!([4, 5].map(|difference| steps(difference, 1)), [Some(0), Some(3)]);
        let none_is_enough = n_steps(u64::from(u16::MAX) * 64 * 3, 64, "0.01".parse().unwrap());
        assert_eq!(none_is_enough, None);
    }
}
