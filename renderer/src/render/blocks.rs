//! Cuts the samples of a share into blocks of up to 64 that lie close together, and groups neighbouring blocks.
//!
//! The rays of a block form one packet; the packets of a group are traced together.

use shared::{
    curve,
    division::{SampleRect, Share, TILE_SIZE},
};

use crate::intersect::MOST_PACKETS;

/// Up to 64 samples that lie close together, and the index of each among all samples of the units that were cut.
#[derive(Clone)]
pub enum SampleBlock<'a> {
    /// The samples of one unit, row by row, with consecutive indices.
    Unit {
        /// The samples (i, j).
        samples: SampleRect,
        /// Index of the first sample.
        first_index: usize,
    },
    /// Samples gathered from several units.
    Selection {
        /// The samples (i, j) of all units.
        all: &'a [(u32, u32)],
        /// Indices into `all` of the block's samples.
        indices: &'a [usize],
    },
}

impl SampleBlock<'_> {
    const NONE: Self = Self::Selection { all: &[], indices: &[] };

    /// Number of samples.
    #[inline]
    pub fn n_samples(&self) -> usize {
        match self {
            Self::Unit { samples, .. } => samples.count() as usize,
            Self::Selection { indices, .. } => indices.len(),
        }
    }

    /// Number of samples in each row; without rows, of all.
    #[inline]
    pub(super) fn row_length(&self) -> usize {
        match self {
            Self::Unit { samples, .. } => samples.columns.len(),
            Self::Selection { indices, .. } => indices.len(),
        }
    }

    /// Sample `index` of the block, as (i, j).
    #[inline]
    pub fn sample(&self, index: usize) -> (u32, u32) {
        match self {
            Self::Unit { samples: SampleRect { columns, rows }, .. } => {
                let (index, width) = (index as u32, columns.len() as u32);
                (columns.start + index % width, rows.start + index / width)
            }
            Self::Selection { all, indices } => all[indices[index]],
        }
    }

    /// All samples (i, j).
    #[inline]
    pub fn samples(&self) -> impl Iterator<Item = (u32, u32)> {
        (0..self.n_samples()).map(|index| self.sample(index))
    }

    /// Index of sample `index` of the block among all samples of the units that were cut.
    #[inline]
    pub fn output_index(&self, index: usize) -> usize {
        match self {
            Self::Unit { first_index, .. } => first_index + index,
            Self::Selection { indices, .. } => indices[index],
        }
    }

    /// The first sample of a block of 8×8 samples, row by row; `None` for other blocks.
    #[inline]
    pub(crate) fn tile(&self) -> Option<(u32, u32)> {
        match self {
            Self::Unit { samples: SampleRect { columns, rows }, .. } => {
                (columns.len() == 8 && rows.len() == 8).then_some((columns.start, rows.start))
            }
            Self::Selection { .. } => None,
        }
    }

    /// The sample of each lane of a packet, a tile's by quarters; lanes beyond the samples repeat the last.
    #[inline]
    pub fn sample_of_lane(&self) -> [usize; 64] {
        let last = self.n_samples() - 1;
        if self.tile().is_some() { SAMPLE_OF_LANE } else { std::array::from_fn(|lane| lane.min(last)) }
    }
}

/// Calls `visit` with all samples of some units of a share, in groups of up to [`MOST_PACKETS`] neighbouring blocks.
///
/// A tile is one block; 2×2 tiles, or four along the curve, form a group. Single samples are gathered from patches of the
/// frame.
pub fn for_each_group(share: &Share, units: impl Iterator<Item = u32> + Clone, visit: impl FnMut(&[SampleBlock<'_>])) {
    if units.clone().any(|unit| share.samples(unit).count() > 1) {
        visit_groups(tiles(share, units), visit);
    } else {
        let all = collect_samples(share, units);
        let mut indices: Vec<usize> = (0..all.len()).collect();
        visit_groups(patches(share, &all, &mut indices), visit);
    }
}

struct KeyedBlock<'a> {
    /// Equal for neighbouring blocks.
    group_key: [u32; 2],
    block: SampleBlock<'a>,
}

fn visit_groups(mut blocks: Vec<KeyedBlock<'_>>, mut visit: impl FnMut(&[SampleBlock<'_>])) {
    blocks.sort_by_key(|keyed| keyed.group_key);
    for same_group in blocks.chunk_by(|a, b| a.group_key == b.group_key) {
        for neighbours in same_group.chunks(MOST_PACKETS) {
            let mut group = [SampleBlock::NONE; MOST_PACKETS];
            group.iter_mut().zip(neighbours).for_each(|(block, keyed)| block.clone_from(&keyed.block));
            visit(&group[..neighbours.len()]);
        }
    }
}

/// One block for each unit.
fn tiles(share: &Share, units: impl Iterator<Item = u32>) -> Vec<KeyedBlock<'static>> {
    let mut n_samples = 0;
    let keyed_block = |unit| {
        let samples = share.samples(unit);
        let group_key = if share.is_on_curve() {
            [0, share.unit(unit) / curve::TILES_PER_SQUARE]
        } else {
            [samples.rows.start, samples.columns.start].map(|along| along / (2 * TILE_SIZE))
        };
        let first_index = n_samples;
        n_samples += samples.count() as usize;
        KeyedBlock { group_key, block: SampleBlock::Unit { samples, first_index } }
    };
    units.map(keyed_block).collect()
}

/// Gathers single samples into blocks by patches of the frame; sorts `indices`, the samples' indices, by patch.
fn patches<'a>(share: &Share, all: &'a [(u32, u32)], indices: &'a mut [usize]) -> Vec<KeyedBlock<'a>> {
    let (Some(&(_, first_row)), Some(&(_, last_row))) = (all.first(), all.last()) else { return Vec::new() };
    // A patch holds about 64 samples of the share and is as square as the rows allow.
    let area = share.sample_stride().saturating_mul(64);
    let height = area.isqrt().clamp(1, last_row.abs_diff(first_row) + 1);
    let width = (area / height).max(1);
    // Patches are numbered row by row from the first row; a counting sort orders the samples by patch.
    let patches_per_row = share.units().size().xres().div_ceil(width);
    let patch = |&(i, j): &(u32, u32)| (j.abs_diff(first_row) / height * patches_per_row + i / width) as usize;
    let n_patches = all.iter().map(patch).max().map_or(0, |last| last + 1);
    let mut ends = vec![0; n_patches + 1];
    all.iter().for_each(|sample| ends[patch(sample) + 1] += 1);
    (0..n_patches).for_each(|patch| ends[patch + 1] += ends[patch]);
    for (index, sample) in all.iter().enumerate() {
        let end = &mut ends[patch(sample)];
        indices[*end] = index;
        *end += 1;
    }
    // Cut each patch into blocks; 2×2 patches form a group.
    let mut blocks = Vec::new();
    let indices = &*indices;
    let mut first = 0;
    for (patch, &end) in (0..).zip(&ends[..n_patches]) {
        let group_key = [patch / patches_per_row / 2, patch % patches_per_row / 2];
        let patch_indices = indices[first..end].chunks(64);
        blocks.extend(
            patch_indices.map(|indices| KeyedBlock { group_key, block: SampleBlock::Selection { all, indices } }),
        );
        first = end;
    }
    blocks
}

/// All samples of some units, in the order of [`Share::samples`].
fn collect_samples(share: &Share, units: impl Iterator<Item = u32>) -> Vec<(u32, u32)> {
    let mut samples = Vec::with_capacity(units.size_hint().0);
    for unit in units {
        let SampleRect { columns, rows } = share.samples(unit);
        for j in rows {
            samples.extend(columns.clone().map(|i| (i, j)));
        }
    }
    samples
}

/// The sample of each lane in a tile of 8×8 samples: quarters of 4×4 one after the other, each row by row.
const SAMPLE_OF_LANE: [usize; 64] = {
    let mut indices = [0; 64];
    let mut lane = 0;
    while lane < 64 {
        let x = lane % 4 + 4 * (lane / 16 % 2);
        let y = lane / 4 % 4 + 4 * (lane / 32);
        indices[lane] = 8 * y + x;
        lane += 1;
    }
    indices
};

/// Sets each lane of a tile to the sum of its column's term and its row's term.
pub(crate) fn sum_terms_by_lane([column_terms, row_terms]: &[[f32; 8]; 2], lanes: &mut [f32; 64]) {
    for (index, lanes) in lanes.as_chunks_mut::<4>().0.iter_mut().enumerate() {
        let (row, first_column) = (index % 4 + 4 * (index / 8), 4 * (index / 4 % 2));
        for (lane, column_term) in lanes.iter_mut().zip(&column_terms[first_column..]) {
            *lane = column_term + row_terms[row];
        }
    }
}

/// Reorders the values of a tile from lanes to samples, row by row.
pub(crate) fn lanes_to_rows<T: Copy>(lanes: &mut [T; 64]) {
    // Half a row is contiguous in both orders.
    for [a, b, c, d, e, f, g, h] in lanes.as_chunks_mut::<4>().0.as_chunks_mut::<8>().0 {
        [*a, *b, *c, *d, *e, *f, *g, *h] = [*a, *e, *b, *f, *c, *g, *d, *h];
    }
}

#[cfg(test)]
mod tests {
    use shared::division::{Division, FrameSize};
    use strum::VariantArray;

    use super::*;

    #[test]
    fn every_sample_is_in_one_block_and_neighbours_lie_together() {
        for (xres, yres) in [(1, 1), (37, 21), (64, 48), (200, 100)] {
            let size = FrameSize::new(xres, yres).unwrap();
            for (division, machines) in
                Division::VARIANTS.iter().copied().flat_map(|division| [(division, 1), (division, 5)])
            {
                for machine in 0..machines {
                    let task = division.task(machine, machines);
                    let share = task.share(size).unwrap();
                    let units = share.count() / 3..share.count();
                    let samples = collect_samples(&share, units.clone());
                    let mut seen = vec![0; samples.len()];
                    for_each_group(&share, units, |blocks| {
                        assert!((1..=MOST_PACKETS).contains(&blocks.len()));
                        for block in blocks {
                            assert!((1..=64).contains(&block.n_samples()));
                            for (index, sample) in block.samples().enumerate() {
                                let output_index = block.output_index(index);
                                assert_eq!(samples[output_index], sample);
                                seen[output_index] += 1;
                            }
                        }
                        if division == Division::Tiled {
                            let group_key = |(i, j): (u32, u32)| (i / 16, j / 16);
                            let all: Vec<_> = blocks.iter().flat_map(SampleBlock::samples).map(group_key).collect();
                            assert!(all.iter().all(|group_key| *group_key == all[0]));
                        }
                    });
                    assert!(seen.iter().all(|&n| n == 1), "{size} {division:?}: {machine} of {machines}");
                }
            }
        }
    }

    #[test]
    fn lanes_of_a_tile_are_its_quarters() {
        let unit = |columns, rows| SampleBlock::Unit { samples: SampleRect { columns, rows }, first_index: 0 };
        assert_eq!(unit(8..16, 16..24).sample_of_lane()[..5], [0, 1, 2, 3, 8]);
        assert_eq!(unit(8..11, 16..17).sample_of_lane()[..5], [0, 1, 2, 2, 2]);
        let mut indices = SAMPLE_OF_LANE;
        lanes_to_rows(&mut indices);
        assert_eq!(indices, std::array::from_fn(|index| index));
        let (columns, rows) = ([0, 1, 2, 3, 4, 5, 6, 7], [0, 8, 16, 24, 32, 40, 48, 56]);
        let mut sums = [0.0; 64];
        sum_terms_by_lane(&[columns, rows].map(|indices| indices.map(|index| index as f32)), &mut sums);
        assert_eq!(sums.map(|sum| sum as usize), SAMPLE_OF_LANE);
    }
}
