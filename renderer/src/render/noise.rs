//! As many samples as a pixel needs: the noise of path-traced pixels is estimated, and those with little get no more.
//!
//! The estimate is a pure function of the samples of a pixel's tile, so every render server stops at the same one. It compares
//! the mean of the first half of the samples with that of the second, as a display would show them: both are low-discrepancy
//! samples where their number is a power of two. Encoded values tell what the eye sees, above all in the dark; linear light, which
//! counts as much, what is bright. A pixel whose few samples happen to agree must not stop too early, so the estimates of
//! neighbours in its tile, and its earlier ones, count as well.
//!
//! Rays to sun and sky are left out where those of the neighbours in the tile all found the same: see [`Expected`]. Paths share camera
//! rays where these bring little of the noise: see [`splitting`].
//!
//! Samples that are proportional to the standard deviation of a pixel's light give a picture the least error; pixels of equal
//! noise, as many as their variance asks for, are no better in that than equal numbers everywhere. So a pixel that needs many
//! samples may keep more noise: see [`allowed`].

use std::{collections::BTreeMap, ops::Range};

use shared::{
    division::{SampleRect, Share, TILE_SIZE},
    noise::NoiseLimit,
    protocol::{FrameSpec, LightingMode, ShadingMode},
    srgb,
};

use crate::render::{
    blocks::{SampleBlock, for_each_group},
    lighting::{LightSums, Lighting},
    path::{
        sight::Expected,
        splitting::{self, MOST_PATHS},
    },
    tracer::Sampler,
};

/// Samples of each pixel before the first estimate: a power of two, so that its halves are low-discrepancy samples. Those of
/// 64 pixels complement each other, and also find small bright features. A pixel that needs no more may keep just the noise of
/// the limit.
const FEWEST_SAMPLES: u32 = 8;

/// Between one estimate and the next, a pixel may stop after each of so many parts of the samples.
const N_STEPS: u32 = 4;

/// The noise of a pixel is estimated from those of its tile that are at most so far away along each side.
const REACH: usize = 2;

/// The same for what its rays to sun and sky are expected to find, and for how many paths share a camera ray. Edges are sharp, and wrong
/// numbers only add noise, so nine pixels say enough.
const NEAR_REACH: usize = 1;

/// The limit of a frame whose pixels may stop early.
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

/// A pixel that gets more samples.
struct Pixel {
    tile: usize,
    /// Its number in the tile, row by row.
    index: usize,
    /// The number of samples after which it has enough, as far as is known.
    end: u32,
}

/// Sums the light of neighbouring tiles, of each pixel until its noise is below the limit.
fn sum_group(
    sampler: &mut Sampler<'_>,
    tiles: &[SampleBlock<'_>],
    (most, limit): (u32, NoiseLimit),
    mut visit: impl FnMut(&Lighting<'_>, &LightSums, (usize, usize), usize),
) {
    // Neighbours lie together in packets, as they do in those of whole tiles.
    let of_tile = |(tile, block): (usize, &SampleBlock<'_>)| {
        let lanes = block.sample_of_lane().into_iter().take(block.n_samples());
        lanes.map(move |index| Pixel { tile, index, end: most }).collect::<Vec<_>>()
    };
    let mut pixels: Vec<_> = tiles.iter().enumerate().flat_map(of_tile).collect();
    let mut squared_noises = vec![[0.0; 64]; tiles.len()];
    let mut sun_rays = vec![[[0.0; 64]; 2]; tiles.len()];
    let mut sky_rays = sun_rays.clone();
    let mut variances = sun_rays.clone();
    let mut n_rays = sun_rays.clone();
    let mut sums = sampler.lighting.no_light();
    add(sampler, tiles, &pixels, FEWEST_SAMPLES / 2, &mut sums);
    let mut half = sums.clone();
    add(sampler, tiles, &pixels, FEWEST_SAMPLES, &mut sums);
    while !sampler.is_unwanted() {
        let n_samples = sums.n_samples;
        let halves = [&half, &sums.without(&half)];
        // A square falls at least as fast as the number of samples rises; pixels that have enough also count as if they had more.
        squared_noises.as_flattened_mut().iter_mut().for_each(|squared| *squared *= 0.5);
        for (place, pixel) in pixels.iter().enumerate() {
            let squared = squared_noise(&sampler.lighting, halves, place);
            let known = &mut squared_noises[pixel.tile][pixel.index];
            *known = if n_samples == FEWEST_SAMPLES { squared } else { 0.5 * (*known + squared) };
            let paths = &sums.pixels[place];
            let keep = |of_tiles: &mut [[[f64; 64]; 2]], values: [f64; 2]| {
                let of_tile = &mut of_tiles[pixel.tile];
                of_tile.iter_mut().zip(values).for_each(|(of_tile, value)| of_tile[pixel.index] = value);
            };
            keep(&mut sun_rays, [paths.sun.n_open, paths.sun.n_blocked].map(f64::from));
            keep(&mut sky_rays, [paths.sky.n_open, paths.sky.n_blocked].map(f64::from));
            keep(&mut variances, variances_of_parts(halves, place));
            keep(&mut n_rays, paths.rays_of_parts(n_samples));
        }
        // Before the numbers of paths change: the next half's variances are compared with these.
        half = sums.clone();
        for (Pixel { tile, index, end }, paths) in pixels.iter_mut().zip(&mut sums.pixels) {
            let block = &tiles[*tile];
            let around = |of_tile: &[f64; 64], reach| {
                mean_around(&of_tile[..block.n_samples()], block.row_length(), *index, reach)
            };
            let near =
                |of_tiles: &[[[f64; 64]; 2]]| of_tiles[*tile].each_ref().map(|of_tile| around(of_tile, NEAR_REACH));
            let steps = n_steps(around(&squared_noises[*tile], REACH), n_samples, limit);
            *end = steps.map_or(most, |steps| most.min(n_samples + steps * (n_samples / N_STEPS)));
            paths.n_paths =
                splitting::best_n_paths(near(&variances), near(&n_rays), MOST_PATHS.min(n_samples / N_STEPS));
            paths.sun.expected = Expected::of_sun(n_samples / paths.n_paths, near(&sun_rays));
            paths.sky.expected = Expected::of_sky(n_samples, near(&sky_rays));
        }
        // Add samples in steps, and put aside the pixels that have enough.
        for step in 0..=N_STEPS {
            let end = (n_samples + step * (n_samples / N_STEPS)).min(most);
            add(sampler, tiles, &pixels, end, &mut sums);
            let (done, more): (Vec<_>, Vec<_>) = (0..pixels.len()).partition(|&place| pixels[place].end <= end);
            for place in done {
                let Pixel { tile, index, .. } = pixels[place];
                visit(&sampler.lighting, &sums, (place / 64, place % 64), tiles[tile].output_index(index));
            }
            if more.is_empty() {
                return;
            }
            if more.len() < pixels.len() {
                (sums, half) = (sums.of_pixels(&more), half.of_pixels(&more));
                pixels.retain(|pixel| pixel.end > end);
            }
        }
    }
}

/// Adds samples of pixels of neighbouring tiles up to this number; the sums are in the order of the pixels.
fn add(sampler: &mut Sampler<'_>, tiles: &[SampleBlock<'_>], pixels: &[Pixel], end: u32, sums: &mut LightSums) {
    let all: Vec<_> = pixels.iter().map(|pixel| tiles[pixel.tile].sample(pixel.index)).collect();
    let places: Vec<_> = (0..all.len()).collect();
    let blocks: Vec<_> = places.chunks(64).map(|indices| SampleBlock::Selection { all: &all, indices }).collect();
    sampler.add(&blocks, sums.n_samples..end, sums);
}

/// The estimated square of a pixel's noise in levels, from two halves of its samples: the mean square, over the channels, of the
/// error of the mean, which is half of the halves' difference. It is that of encoded values and of linear light, each to one half.
fn squared_noise(lighting: &Lighting<'_>, halves: [&LightSums; 2], place: usize) -> f64 {
    let [a, b] = halves.map(|sums| lighting.shown(sums, (place / 64, place % 64)));
    let channels = (0..3).map(|channel| [a[channel], b[channel]]);
    let differences = channels.flat_map(|[a, b]| {
        let encoded = f32::from(srgb::encode(a)) - f32::from(srgb::encode(b));
        [encoded, 255.0 * (a.min(1.0) - b.min(1.0))]
    });
    differences.map(|difference| f64::from(difference * difference)).sum::<f64>() / 24.0
}

/// The estimated variances of a pixel's samples, up to a factor, from two halves of them: of the light that comes with camera
/// rays, and of that which comes with their paths.
fn variances_of_parts(halves: [&LightSums; 2], place: usize) -> [f64; 2] {
    let [[light_a, shared_a], [light_b, shared_b]] = halves.map(|half| half.light_of_parts(place));
    let (shared, all) = (shared_b - shared_a, light_b - light_a);
    // Fewer camera rays bring more of their noise.
    let n_paths = halves.map(|half| half.pixels[place].n_paths as f32);
    [shared.length_squared() / (n_paths[0] + n_paths[1]), (all - shared).length_squared() / 2.0].map(f64::from)
}

/// The mean of the numbers of a tile's pixels, row by row, that are at most `reach` away from one of them along each side.
fn mean_around(numbers: &[f64], row_length: usize, index: usize, reach: usize) -> f64 {
    let around = |at: usize, n: usize| at.saturating_sub(reach)..(at + reach + 1).min(n);
    let (rows, columns) =
        (around(index / row_length, numbers.len() / row_length), around(index % row_length, row_length));
    let n = rows.len() * columns.len();
    rows.flat_map(|row| &numbers[row * row_length..][columns.clone()]).sum::<f64>() / n as f64
}

/// After how many steps of a quarter of its `n_samples` samples a pixel has enough: 0 if it has already; `None` if another
/// estimate comes first.
fn n_steps(squared_noise: f64, n_samples: u32, limit: NoiseLimit) -> Option<u32> {
    (0..N_STEPS).find(|steps| {
        // The square of the error falls at least as fast as the number of samples rises.
        let growth = 1.0 + f64::from(*steps) / f64::from(N_STEPS);
        squared_noise <= growth * allowed(f64::from(n_samples) * growth, limit)
    })
}

/// The square of the noise that a pixel of so many samples may keep.
///
/// It grows as their number. With variances v and squares of the noise v/n, the numbers are then proportional to v^½.
fn allowed(n_samples: f64, limit: NoiseLimit) -> f64 {
    let levels = f64::from(limit.centilevels()) / 100.0;
    levels * levels * n_samples / f64::from(FEWEST_SAMPLES)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_stops_where_its_error_is_expected_to_reach_the_limit() {
        let limit = "2".parse().unwrap();
        let steps = |noise: f64, n_samples| n_steps(noise * noise, n_samples, limit);
        // The error falls, and the limit rises, with the root of the number of samples.
        let expected = [Some(0), Some(0), Some(1), Some(2), Some(3), None];
        assert_eq!([0.0, 2.0, 2.1, 2.6, 3.1, 3.6].map(|noise| steps(noise, 8)), expected);
        // Four times as many samples: the limit is twice as large.
        assert_eq!([3.9, 4.1].map(|noise| steps(noise, 32)), [Some(0), Some(1)]);
        assert_eq!(n_steps(0.1, 8, "0.1".parse().unwrap()), None);
    }

    #[test]
    fn the_noise_is_that_of_the_neighbours_in_the_tile() {
        for (row_length, n_rows) in [(8, 8), (8, 1), (1, 8), (3, 5), (1, 1)] {
            let numbers: Vec<_> = (0..row_length * n_rows).map(|at| (at * at) as f64).collect();
            for index in 0..numbers.len() {
                let is_near = |at: usize| {
                    (at / row_length).abs_diff(index / row_length) <= 2
                        && (at % row_length).abs_diff(index % row_length) <= 2
                };
                let near: Vec<_> = (0..numbers.len()).filter(|&at| is_near(at)).map(|at| numbers[at]).collect();
                let expected = near.iter().sum::<f64>() / near.len() as f64;
                assert_eq!(mean_around(&numbers, row_length, index, 2), expected, "{row_length}x{n_rows}: {index}");
            }
        }
    }
}
