//! Cuts the samples of a share into blocks of up to 64 that lie close together, whose rays are a packet, and says which
//! blocks are neighbours, so that their packets go together.

use shared::{
    curve,
    division::{Share, TILE_SIZE, UnitSamples},
};

use crate::intersect::MOST_PACKETS;

/// Up to 64 samples that lie close together, in an order of their own, and their places among the samples of the units that
/// were cut.
#[derive(Clone)]
pub enum Block<'a> {
    /// Those of a unit, row by row, at places that follow each other.
    Unit {
        /// The samples (i, j).
        samples: UnitSamples,
        /// The place of the first.
        first_place: usize,
    },
    /// Some of many.
    Picked {
        /// The samples (i, j) of all units.
        all: &'a [(u32, u32)],
        /// The places of the block's.
        places: &'a [usize],
    },
}

impl Block<'_> {
    const NONE: Self = Self::Picked { all: &[], places: &[] };

    /// How many samples.
    #[inline]
    pub fn n_samples(&self) -> usize {
        match self {
            Self::Unit { samples, .. } => samples.count() as usize,
            Self::Picked { places, .. } => places.len(),
        }
    }

    /// Sample number `index`, (i, j).
    #[inline]
    pub fn sample(&self, index: usize) -> (u32, u32) {
        match self {
            Self::Unit { samples: UnitSamples { columns, rows }, .. } => {
                let (index, width) = (index as u32, columns.len() as u32);
                (columns.start + index % width, rows.start + index / width)
            }
            Self::Picked { all, places } => all[places[index]],
        }
    }

    /// All samples (i, j).
    #[inline]
    pub fn samples(&self) -> impl Iterator<Item = (u32, u32)> {
        (0..self.n_samples()).map(|index| self.sample(index))
    }

    /// The place of sample number `index`.
    #[inline]
    pub fn place(&self, index: usize) -> usize {
        match self {
            Self::Unit { first_place, .. } => first_place + index,
            Self::Picked { places, .. } => places[index],
        }
    }

    /// The first sample of 8×8, row by row, if that is what the block is.
    #[inline]
    pub(crate) fn tile(&self) -> Option<(u32, u32)> {
        match self {
            Self::Unit { samples: UnitSamples { columns, rows }, .. } => {
                (columns.len() == 8 && rows.len() == 8).then_some((columns.start, rows.start))
            }
            Self::Picked { .. } => None,
        }
    }

    /// The sample that each lane of a packet follows; lanes beyond the samples repeat the last.
    ///
    /// The lanes of a whole tile are ordered by quarters, so that lanes side by side are pixels side by side.
    #[inline]
    pub fn in_lanes(&self) -> [usize; 64] {
        let last = self.n_samples() - 1;
        if self.tile().is_some() { QUARTERS } else { std::array::from_fn(|lane| lane.min(last)) }
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
        visit_groups(tiles(share, units), visit);
    } else {
        let all = samples_of(share, units);
        let mut places: Vec<usize> = (0..all.len()).collect();
        visit_groups(patches(share, &all, &mut places), visit);
    }
}

/// A block, and where it is.
struct Placed<'a> {
    /// Equal for neighbours.
    square: [u32; 2],
    block: Block<'a>,
}

fn visit_groups(mut blocks: Vec<Placed<'_>>, mut visit: impl FnMut(&[Block<'_>])) {
    blocks.sort_by_key(|placed| placed.square);
    for of_square in blocks.chunk_by(|a, b| a.square == b.square) {
        for neighbours in of_square.chunks(MOST_PACKETS) {
            let mut group = [Block::NONE; MOST_PACKETS];
            group.iter_mut().zip(neighbours).for_each(|(block, placed)| block.clone_from(&placed.block));
            visit(&group[..neighbours.len()]);
        }
    }
}

/// The blocks of units, each one of its own.
fn tiles(share: &Share<'_>, units: impl Iterator<Item = u32>) -> Vec<Placed<'static>> {
    let mut n_samples = 0;
    let place = |unit| {
        let samples = share.samples(unit);
        let square = if share.is_on_curve() {
            [0, share.unit(unit) / curve::TILES_TOGETHER]
        } else {
            [samples.rows.start, samples.columns.start].map(|along| along / (2 * TILE_SIZE))
        };
        let first_place = n_samples;
        n_samples += samples.count() as usize;
        Placed { square, block: Block::Unit { samples, first_place } }
    };
    units.map(place).collect()
}

/// Puts the samples' places in the order of the patches that they lie in, too.
fn patches<'a>(share: &Share<'_>, all: &'a [(u32, u32)], places: &'a mut [usize]) -> Vec<Placed<'a>> {
    let (Some(&(_, first_row)), Some(&(_, last_row))) = (all.first(), all.last()) else { return Vec::new() };
    // A patch holds about 64 samples of the share and is as square as the rows at hand allow.
    let area = share.spread().saturating_mul(64);
    let height = area.isqrt().clamp(1, last_row.abs_diff(first_row) + 1);
    let width = (area / height).max(1);
    // Patches are numbered row by row from the first row at hand; samples are brought into their order by counting.
    let patches_per_row = share.units().size().xres().div_ceil(width);
    let patch = |&(i, j): &(u32, u32)| (j.abs_diff(first_row) / height * patches_per_row + i / width) as usize;
    let n_patches = all.iter().map(patch).max().map_or(0, |last| last + 1);
    let mut ends = vec![0; n_patches + 1];
    all.iter().for_each(|sample| ends[patch(sample) + 1] += 1);
    (0..n_patches).for_each(|patch| ends[patch + 1] += ends[patch]);
    for (place, sample) in all.iter().enumerate() {
        let end = &mut ends[patch(sample)];
        places[*end] = place;
        *end += 1;
    }
    let mut blocks = Vec::new();
    let places = &*places;
    let mut first = 0;
    for (patch, &end) in (0..).zip(&ends[..n_patches]) {
        let square = [patch / patches_per_row / 2, patch % patches_per_row / 2];
        let of_patch = places[first..end].chunks(64);
        blocks.extend(of_patch.map(|places| Placed { square, block: Block::Picked { all, places } }));
        first = end;
    }
    blocks
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

/// The place of each lane in a tile of 8×8 samples, row by row: quarters of 4×4 one after the other.
const QUARTERS: [usize; 64] = {
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
                            assert!((1..=64).contains(&block.n_samples()));
                            for (index, sample) in block.samples().enumerate() {
                                let place = block.place(index);
                                assert_eq!(samples[place], sample);
                                seen[place] += 1;
                            }
                        }
                        if division == Division::Tiled {
                            let square = |(i, j): (u32, u32)| (i / 16, j / 16);
                            let all: Vec<_> = blocks.iter().flat_map(Block::samples).map(square).collect();
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
        let unit = |columns, rows| Block::Unit { samples: UnitSamples { columns, rows }, first_place: 0 };
        assert_eq!(unit(8..16, 16..24).in_lanes()[..5], [0, 1, 2, 3, 8]);
        assert_eq!(unit(8..11, 16..17).in_lanes()[..5], [0, 1, 2, 2, 2]);
        let mut places = QUARTERS;
        in_rows(&mut places);
        assert_eq!(places, std::array::from_fn(|place| place));
        let (columns, rows) = ([0, 1, 2, 3, 4, 5, 6, 7], [0, 8, 16, 24, 32, 40, 48, 56]);
        let mut sums = [0.0; 64];
        in_quarters(&[columns, rows].map(|places| places.map(|place| place as f32)), &mut sums);
        assert_eq!(sums.map(|place| place as usize), QUARTERS);
    }
}
