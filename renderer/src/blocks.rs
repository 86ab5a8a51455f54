//! Cuts the samples of a share into blocks of up to 64 that lie close together, whose rays are a packet, and says which
//! blocks are neighbours, so that their packets go together.

use std::ops::Range;

use shared::{
    curve,
    division::{Share, TILE_SIZE, UnitSamples},
};

use crate::grid::MOST_PACKETS;

/// Up to 64 samples that lie close together.
#[derive(Clone, Copy)]
pub struct Block<'a> {
    /// The samples (i, j). Those of a tile follow each other row by row.
    pub samples: &'a [(u32, u32)],
    /// Where they are among the samples of the units that were cut.
    pub places: Places<'a>,
}

/// The places of a block's samples.
#[derive(Clone, Copy)]
pub enum Places<'a> {
    /// One after the other from this one on.
    From(usize),
    /// Each has its own.
    Each(&'a [usize]),
}

impl Places<'_> {
    /// The place of the block's sample number `index`.
    #[inline]
    pub fn of(&self, index: usize) -> usize {
        match self {
            Self::From(first) => first + index,
            Self::Each(places) => places[index],
        }
    }
}

/// Calls `visit` with all samples of some units of a share, block by block, up to [`MOST_PACKETS`] neighbours at once: a tile
/// is a block, and 2×2 tiles are neighbours, or as many along the curve; single samples are gathered from patches of the
/// frame.
pub(crate) fn for_each_group(
    share: &Share<'_>,
    units: impl Iterator<Item = u32> + Clone,
    visit: impl FnMut(&[Block<'_>]),
) {
    if units.clone().any(|unit| share.samples(unit).count() > 1) {
        visit_groups(
            tiles(share, units),
            |cut, samples| {
                let UnitSamples { columns, rows } = share.samples(cut.unit);
                if columns.len() * rows.len() == 64 {
                    // Of a known length, all are written at once.
                    samples.extend(OF_TILE.iter().map(|(x, y)| (columns.start + x, rows.start + y)));
                } else {
                    rows.for_each(|j| samples.extend(columns.clone().map(|i| (i, j))));
                }
                Places::From(cut.at.start)
            },
            visit,
        );
    } else {
        let all = samples_of(share, units);
        let mut order: Vec<usize> = (0..all.len()).collect();
        visit_groups(
            patches(share, &all, &mut order),
            |cut, samples| {
                let places = &order[cut.at.clone()];
                samples.extend(places.iter().map(|&place| all[place]));
                Places::Each(places)
            },
            visit,
        );
    }
}

/// Gathers the blocks of neighbouring cuts, group by group: memory for all of them at once would not stay in the cache.
fn visit_groups<'a, U>(
    mut cuts: Vec<Cut<U>>,
    gather: impl Fn(&Cut<U>, &mut Vec<(u32, u32)>) -> Places<'a>,
    mut visit: impl FnMut(&[Block<'_>]),
) {
    cuts.sort_by_key(|cut| cut.square);
    let mut samples = Vec::with_capacity(64 * MOST_PACKETS);
    for of_square in cuts.chunk_by(|a, b| a.square == b.square) {
        for neighbours in of_square.chunks(MOST_PACKETS) {
            samples.clear();
            let mut places = [Places::From(0); MOST_PACKETS];
            places.iter_mut().zip(neighbours).for_each(|(places, cut)| *places = gather(cut, &mut samples));
            let mut rest = &*samples;
            let mut group = [Block { samples: &[], places: Places::From(0) }; MOST_PACKETS];
            for ((block, cut), places) in group.iter_mut().zip(neighbours).zip(places) {
                let (of_block, others) = rest.split_at(cut.at.len());
                rest = others;
                *block = Block { samples: of_block, places };
            }
            visit(&group[..neighbours.len()]);
        }
    }
}

/// Where a block's samples are among all.
struct Cut<U> {
    /// Equal for neighbours.
    square: [u32; 2],
    at: Range<usize>,
    /// The unit that the block is, or nothing where it is no whole one.
    unit: U,
}

fn tiles(share: &Share<'_>, units: impl Iterator<Item = u32>) -> Vec<Cut<u32>> {
    let mut end = 0;
    let cut = |unit| {
        let UnitSamples { columns, rows } = share.samples(unit);
        let square = if share.is_on_curve() {
            [0, share.unit(unit) / curve::TILES_TOGETHER]
        } else {
            [rows.start, columns.start].map(|along| along / (2 * TILE_SIZE))
        };
        let first = end;
        end += columns.len() * rows.len();
        Cut { square, at: first..end, unit }
    };
    units.map(cut).collect()
}

/// Puts the samples' places in the order of the patches that they lie in, too.
fn patches(share: &Share<'_>, samples: &[(u32, u32)], places: &mut [usize]) -> Vec<Cut<()>> {
    let (Some(&(_, first_row)), Some(&(_, last_row))) = (samples.first(), samples.last()) else { return Vec::new() };
    // A patch holds about 64 samples of the share and is as square as the rows at hand allow.
    let area = share.spread().saturating_mul(64);
    let height = area.isqrt().clamp(1, last_row.abs_diff(first_row) + 1);
    let width = (area / height).max(1);
    // Patches are numbered row by row from the first row at hand; samples are brought into their order by counting.
    let patches_per_row = share.units().size().xres().div_ceil(width);
    let patch = |&(i, j): &(u32, u32)| (j.abs_diff(first_row) / height * patches_per_row + i / width) as usize;
    let n_patches = samples.iter().map(patch).max().map_or(0, |last| last + 1);
    let mut ends = vec![0; n_patches + 1];
    samples.iter().for_each(|sample| ends[patch(sample) + 1] += 1);
    (0..n_patches).for_each(|patch| ends[patch + 1] += ends[patch]);
    for (place, sample) in samples.iter().enumerate() {
        let end = &mut ends[patch(sample)];
        places[*end] = place;
        *end += 1;
    }
    let mut cuts = Vec::new();
    let mut first = 0;
    for (patch, &end) in (0..).zip(&ends[..n_patches]) {
        let square = [patch / patches_per_row / 2, patch % patches_per_row / 2];
        cuts.extend((first..end).step_by(64).map(|first| Cut { square, at: first..(first + 64).min(end), unit: () }));
        first = end;
    }
    cuts
}

/// All samples of some units, in the order of [`Share::samples`].
fn samples_of(share: &Share<'_>, units: impl Iterator<Item = u32>) -> Vec<(u32, u32)> {
    let mut samples = Vec::with_capacity(units.size_hint().0);
    for unit in units {
        let UnitSamples { columns, rows } = share.samples(unit);
        for j in rows {
            samples.extend(columns.clone().map(|i| (i, j)));
        }
    }
    samples
}

/// The sample of a block that each lane of a packet follows; lanes beyond the samples repeat the last.
///
/// The lanes of a whole tile are ordered by quarters, so that lanes side by side are pixels side by side.
pub(crate) fn lane_places(block: &[(u32, u32)]) -> [usize; 64] {
    if is_tile(block) { QUARTERS } else { std::array::from_fn(|lane| lane.min(block.len() - 1)) }
}

/// Whether a block is 8×8 samples, row by row.
pub(crate) fn is_tile(block: &[(u32, u32)]) -> bool {
    block.len() == 64 && block[63].0 == block[0].0 + 7 && block[63].1 == block[0].1 + 7
}

/// The samples of a whole tile, row by row, from its first: found anew for each tile they take 1 % of a frame.
const OF_TILE: [(u32, u32); 64] = {
    let mut samples = [(0, 0); 64];
    let mut place = 0;
    while place < 64 {
        samples[place] = (place as u32 % TILE_SIZE, place as u32 / TILE_SIZE);
        place += 1;
    }
    samples
};

/// The place of each lane in a tile of 8×8 samples, row by row: quarters of 4×4 one after the other.
pub(crate) const QUARTERS: [usize; 64] = {
    let mut places = [0; 64];
    let mut lane = 0;
    while lane < 64 {
        let x = lane % 4 + 4 * (lane / 16 % 2);
        let y = lane / 4 % 4 + 4 * (lane / 32);
        places[lane] = 8 * y + x;
        lane += 1;
    }
    places
};

/// Gives the lanes of a tile the sums of what each of its columns has and what each of its rows.
pub(crate) fn in_quarters([of_columns, of_rows]: &[[f32; 8]; 2], lanes: &mut [f32; 64]) {
    for (index, lanes) in lanes.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        let (row, first_column) = (index % 4 + 4 * (index / 8), 4 * (index / 4 % 2));
        for (lane, of_column) in lanes.iter_mut().zip(&of_columns[first_column..]) {
            *lane = of_column + of_rows[row];
        }
    }
}

/// Brings what is in the lanes of a tile into the order of its rows.
pub(crate) fn in_rows<T: Copy>(in_lanes: &mut [T; 64]) {
    // Half a row is together in both orders.
    for [a, b, c, d, e, f, g, h] in in_lanes.as_chunks_mut::<4>().0.as_chunks_mut::<8>().0 {
        [*a, *b, *c, *d, *e, *f, *g, *h] = [*a, *e, *b, *f, *c, *g, *d, *h];
    }
}

#[cfg(test)]
mod tests {
    use shared::division::{Division, FrameSize};

    use super::*;

    #[test]
    fn every_sample_is_in_one_block_and_neighbours_lie_together() {
        for (xres, yres) in [(1, 1), (37, 21), (64, 48), (200, 100)] {
            let size = FrameSize::new(xres, yres).unwrap();
            for (division, machines) in Division::ALL.into_iter().flat_map(|division| [(division, 1), (division, 5)]) {
                for machine in 0..machines {
                    let work = division.work(machine, machines);
                    let share = work.share(size).unwrap();
                    let units = share.count() / 3..share.count();
                    let samples = samples_of(&share, units.clone());
                    let mut seen = vec![0; samples.len()];
                    for_each_group(&share, units, |blocks| {
                        assert!((1..=MOST_PACKETS).contains(&blocks.len()));
                        for block in blocks {
                            assert!((1..=64).contains(&block.samples.len()));
                            for (index, &sample) in block.samples.iter().enumerate() {
                                let place = block.places.of(index);
                                assert_eq!(samples[place], sample);
                                seen[place] += 1;
                            }
                        }
                        if division == Division::Tiled {
                            let squares = |&(i, j): &(u32, u32)| (i / 16, j / 16);
                            let all: Vec<_> = blocks.iter().flat_map(|block| block.samples).map(squares).collect();
                            assert!(all.iter().all(|square| *square == all[0]));
                        }
                    });
                    assert!(seen.iter().all(|&n| n == 1), "{size} {division:?}: {machine} of {machines}");
                }
            }
        }
    }

    #[test]
    fn lanes_of_a_tile_are_its_quarters() {
        let tile: Vec<_> = (0..64).map(|place| (8 + place % 8, 16 + place / 8)).collect();
        assert_eq!(lane_places(&tile)[..5], [0, 1, 2, 3, 8]);
        let mut places = QUARTERS;
        in_rows(&mut places);
        assert_eq!(places, std::array::from_fn(|place| place));
        let (columns, rows) = ([0, 1, 2, 3, 4, 5, 6, 7], [0, 8, 16, 24, 32, 40, 48, 56]);
        let mut sums = [0.0; 64];
        in_quarters(&[columns, rows].map(|places| places.map(|place| place as f32)), &mut sums);
        assert_eq!(sums.map(|place| place as usize), QUARTERS);
        assert_eq!(lane_places(&tile[..3])[..5], [0, 1, 2, 2, 2]);
    }
}
