//! As many samples as a pixel needs: the noise of path-traced pixels is estimated, and those with little get no more.
//!
//! The estimate is a pure function of the samples of a pixel's tile, so every render server stops at the same one. It compares
//! the mean of the first half of the samples with that of the second, as a display would show them: both are low-discrepancy
//! samples where their number is a power of two. Encoded values tell what the eye sees, above all in the dark; linear light, which
//! counts less, how much light is wrong. A pixel whose few samples happen to agree must not stop too early, so the estimates of
//! neighbours in its tile, and its earlier ones, count as well.
//!
//! Rays to sun and sky are left out where those of the neighbours in the tile all found the same: see [`Sights`]. Paths share
//! camera rays where these bring little of the noise: see [`splitting`].
//!
//! Samples that are proportional to the standard deviation of a pixel's light give a picture the least error for their number;
//! pixels of equal noise, as many as their variance asks for, are no better in that than equal numbers everywhere. And a sample that
//! takes more rays must be worth them. So a pixel that needs many rays may keep more noise: see [`allowed`].

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
        sight::{N_LIGHTS, Sights},
        splitting::{self, MOST_PATHS},
    },
    tracer::Sampler,
};

/// Samples of each pixel before the first estimate: a power of two, so that its halves are low-discrepancy samples. Those of
/// 64 pixels complement each other, and also find small bright features.
const FEWEST_SAMPLES: u32 = 8;

/// A pixel that needs so many rays, as the first samples take among other surfaces, may keep just the noise of the limit.
const RAYS_AT_LIMIT: f64 = 32.0;

/// Between one estimate and the next, a pixel may stop after each of so many parts of the samples.
const N_STEPS: u32 = 4;

/// The noise of a pixel is estimated from those of its tile that are at most so far away along each side.
const REACH: usize = 2;

/// The same for what its rays to sun and sky are expected to find, for how many they are, and for how many paths share a camera
/// ray. Edges are sharp, and wrong numbers only add noise, so nine pixels say enough.
const NEAR_REACH: usize = 1;

/// From so many samples on, a pixel has three estimates, and nine pixels say enough of the noise too.
const ENOUGH_FOR_NEAR: u32 = 32;

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

/// Estimates and findings from the samples of a pixel.
#[derive(Clone, Copy)]
struct Findings {
    /// The estimated square of its noise in levels.
    squared_noise: f64,
    /// Rays of a sample, of the second half.
    rays_of_sample: f64,
    /// Numbers of open and of blocked rays to each light.
    sights: [[u16; 2]; N_LIGHTS],
    /// The estimated variances of camera rays and of paths, up to a factor.
    variances: [f64; 2],
    /// The rays that both take.
    rays_of_parts: [f64; 2],
}

impl Findings {
    const NONE: Self = Self {
        squared_noise: 0.0,
        rays_of_sample: 0.0,
        sights: [[0; 2]; N_LIGHTS],
        variances: [0.0; 2],
        rays_of_parts: [0.0; 2],
    };

    /// Adds those of the rest of a pixel's samples, after the first half of them.
    fn update(&mut self, lighting: &Lighting<'_>, [sums, half]: [&LightSums; 2], rest: &LightSums, place: usize) {
        let (n_samples, at) = (sums.n_samples, (place / 64, place % 64));
        let squared_noise = squared_noise(lighting, [half, rest], at);
        let is_first = n_samples == FEWEST_SAMPLES;
        let sights = &sums.sights[place];
        // Those of sums, which double with the samples: earlier estimates count as much.
        let variances = variances_of_parts([half, rest], place);
        *self = Self {
            squared_noise: if is_first { squared_noise } else { 0.5 * (self.squared_noise + squared_noise) },
            rays_of_sample: f64::from(sums.n_rays(at) - half.n_rays(at)) / f64::from(rest.n_samples),
            sights: sights.found,
            variances: std::array::from_fn(|part| 2.0 * self.variances[part] + variances[part]),
            rays_of_parts: sums.pixels[place].rays_of_parts(n_samples, sights.n_sun_rays()),
        };
    }
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
    let mut findings = vec![[Findings::NONE; 64]; tiles.len()];
    let mut sums = sampler.lighting.no_light();
    sums.sights = vec![Sights::default(); pixels.len()];
    add(sampler, tiles, &pixels, FEWEST_SAMPLES / 2, &mut sums);
    let mut half = sums.light();
    add(sampler, tiles, &pixels, FEWEST_SAMPLES, &mut sums);
    while !sampler.is_unwanted() {
        let n_samples = sums.n_samples;
        let rest = sums.light_without(&half);
        // A square falls at least as fast as the number of samples rises; pixels that have enough also count as if they had more.
        findings.as_flattened_mut().iter_mut().for_each(|found| found.squared_noise *= 0.5);
        for (place, pixel) in pixels.iter().enumerate() {
            findings[pixel.tile][pixel.index].update(&sampler.lighting, [&sums, &half], &rest, place);
        }
        // Before the numbers of paths change: the next half's variances are compared with these.
        half = sums.light();
        let found = sums.pixels.iter_mut().zip(&mut sums.sights);
        for (Pixel { tile, index, end }, (paths, sights)) in pixels.iter_mut().zip(found) {
            let block = &tiles[*tile];
            let around = Neighbours {
                findings: &findings[*tile][..block.n_samples()],
                row_length: block.row_length(),
                index: *index,
            };
            let reach = if n_samples < ENOUGH_FOR_NEAR { REACH } else { NEAR_REACH };
            let [squared_noise] = around.mean(reach, |it| [it.squared_noise]);
            let [rays_of_sample] = around.mean(NEAR_REACH, |it| [it.rays_of_sample]);
            let steps = n_steps(squared_noise, (n_samples, rays_of_sample), limit);
            *end = steps.map_or(most, |steps| most.min(n_samples + steps * (n_samples / N_STEPS)));
            let variances = around.mean(NEAR_REACH, |it| it.variances);
            let n_rays = around.mean(NEAR_REACH, |it| it.rays_of_parts);
            paths.n_paths = splitting::best_n_paths(variances, n_rays, MOST_PATHS.min(n_samples / N_STEPS));
            sights.expect([n_samples / paths.n_paths, n_samples], around.sights(NEAR_REACH));
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
                sums.keep(&more);
                half.keep(&more);
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
/// error of the mean, which is half of the halves' difference; three parts of it from encoded values, and one from linear light.
fn squared_noise(lighting: &Lighting<'_>, halves: [&LightSums; 2], at: (usize, usize)) -> f64 {
    let [a, b] = halves.map(|sums| lighting.shown(sums, at));
    let squares = (0..3).map(|channel| {
        let (a, b) = (a[channel], b[channel]);
        let encoded = f32::from(srgb::encode(a)) - f32::from(srgb::encode(b));
        let linear = 255.0 * (a.min(1.0) - b.min(1.0));
        f64::from(0.75 * encoded * encoded + 0.25 * linear * linear)
    });
    squares.sum::<f64>() / (3.0 * 4.0)
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

/// The pixels of a tile around one of them.
struct Neighbours<'a> {
    /// Of all pixels of the tile, row by row.
    findings: &'a [Findings],
    row_length: usize,
    /// The number of the pixel in the middle.
    index: usize,
}

impl Neighbours<'_> {
    /// The pixels that are at most `reach` away along each side, the one in the middle among them.
    fn around(&self, reach: usize) -> impl Iterator<Item = &Findings> {
        let &Self { findings, row_length, index } = self;
        let around = |at: usize, n: usize| at.saturating_sub(reach)..(at + reach + 1).min(n);
        let columns = around(index % row_length, row_length);
        let rows = around(index / row_length, findings.len() / row_length);
        rows.flat_map(move |row| &findings[row * row_length..][columns.clone()])
    }

    /// The means of some numbers over these pixels.
    fn mean<const N: usize>(&self, reach: usize, numbers: impl Fn(&Findings) -> [f64; N]) -> [f64; N] {
        let (mut sums, mut n) = ([0.0; N], 0);
        for found in self.around(reach) {
            sums.iter_mut().zip(numbers(found)).for_each(|(sum, number)| *sum += number);
            n += 1;
        }
        sums.map(|sum| sum / f64::from(n))
    }

    /// The numbers of open and of blocked rays of all these pixels to each light, and the number of pixels.
    fn sights(&self, reach: usize) -> ([[u32; 2]; N_LIGHTS], u32) {
        let (mut sums, mut n_pixels) = ([[0; 2]; N_LIGHTS], 0);
        for found in self.around(reach) {
            let counts = sums.as_flattened_mut().iter_mut().zip(found.sights.as_flattened());
            counts.for_each(|(sum, n)| *sum += u32::from(*n));
            n_pixels += 1;
        }
        (sums, n_pixels)
    }
}

/// After how many steps of a quarter of its `n_samples` samples, each with so many rays, a pixel has enough: 0 if it has already;
/// `None` if another estimate comes first.
fn n_steps(squared_noise: f64, (n_samples, rays_of_sample): (u32, f64), limit: NoiseLimit) -> Option<u32> {
    (0..N_STEPS).find(|steps| {
        // The square of the error falls at least as fast as the number of samples rises.
        let growth = 1.0 + f64::from(*steps) / f64::from(N_STEPS);
        squared_noise <= growth * allowed(f64::from(n_samples) * rays_of_sample * growth, limit)
    })
}

/// The square of the noise that a pixel of so many rays may keep.
///
/// It grows as their number. With variances v of samples of c rays and squares of the noise v/n, the numbers n of samples are then
/// proportional to (v/c)^½: of all numbers that take as many rays, these give a picture the least error.
fn allowed(n_rays: f64, limit: NoiseLimit) -> f64 {
    let levels = f64::from(limit.centilevels()) / 100.0;
    levels * levels * n_rays / RAYS_AT_LIMIT
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_stops_where_its_error_is_expected_to_reach_the_limit() {
        let limit = "2".parse().unwrap();
        let steps = |noise: f64, n_samples| n_steps(noise * noise, (n_samples, 4.0), limit);
        // The error falls, and the limit rises, with the root of the number of samples.
        let expected = [Some(0), Some(0), Some(1), Some(2), Some(3), None];
        assert_eq!([0.0, 2.0, 2.1, 2.6, 3.1, 3.6].map(|noise| steps(noise, 8)), expected);
        // Four times as many samples: the limit is twice as large.
        assert_eq!([3.9, 4.1].map(|noise| steps(noise, 32)), [Some(0), Some(1)]);
        assert_eq!(n_steps(0.1, (8, 4.0), "0.1".parse().unwrap()), None);
        // Samples of four times as many rays: the limit is twice as large.
        assert_eq!([3.9, 4.1].map(|noise: f64| n_steps(noise * noise, (8, 16.0), limit)), [Some(0), Some(1)]);
    }

    #[test]
    fn the_noise_is_that_of_the_neighbours_in_the_tile() {
        for (row_length, n_rows) in [(8, 8), (8, 1), (1, 8), (3, 5), (1, 1)] {
            let number = |at: usize| (at * at) as f64;
            let of_pixel = |at| Findings { squared_noise: number(at), rays_of_sample: 1.0, ..Findings::NONE };
            let findings: Vec<_> = (0..row_length * n_rows).map(of_pixel).collect();
            for index in 0..findings.len() {
                let is_near = |at: usize| {
                    (at / row_length).abs_diff(index / row_length) <= 2
                        && (at % row_length).abs_diff(index % row_length) <= 2
                };
                let near: Vec<_> = (0..findings.len()).filter(|&at| is_near(at)).map(number).collect();
                let expected = [near.iter().sum::<f64>() / near.len() as f64, 1.0];
                let found = Neighbours { findings: &findings, row_length, index }
                    .mean(2, |it| [it.squared_noise, it.rays_of_sample]);
                assert_eq!(found, expected, "{row_length}x{n_rows}: {index}");
            }
        }
    }
}
