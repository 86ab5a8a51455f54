//! Row displacement: compresses the index of a grid's cells.
//!
//! After Lagae and Dutré, "Compact, Fast and Robust Grids for Ray Tracing" (2008). A row is a line of cells. All rows
//! overlap in one array of slots, H, each displaced by an offset, O, so that no two occupied cells share a slot. A bit
//! for each cell, D, is set if it is occupied, so slots need not name their cell. Rows without occupied cells, 23 to 40
//! % of the rows of scans, have no entry in D, the largest part, nor in O.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::grid::uniform::CellIndex;

/// Slots at the end that are tried for a row, in words of 64: all slots would take quadratic time and save a few %.
const WINDOW_WORDS: usize = 256;

const EMPTY_ROW: u32 = u32::MAX;

/// The occupied cells and their slots.
#[derive(Debug, PartialEq)]
pub(crate) struct RowDisplacement {
    layout: RowLayout,
    /// Index of each row in D and O, or [`EMPTY_ROW`].
    kept_row: Vec<u32>,
    /// D: a bit for each cell, kept row after kept row.
    occupied: Vec<u64>,
    /// O: slot of a cell minus its index in the row (modulo 2³²), for each kept row.
    offsets: Vec<u32>,
    n_slots: usize,
}

/// Rows of cells, along the shortest axis: short rows interlock better.
#[derive(Clone, Copy, Debug, PartialEq)]
struct RowLayout {
    /// The axis along rows, then the fast and the slow axis across.
    axes: [usize; 3],
    /// Cells along these axes.
    dims: [usize; 3],
}

impl RowLayout {
    fn new(dims: [u32; 3]) -> Self {
        let along = (0..3).min_by_key(|&axis| dims[axis]).unwrap_or(0);
        let axes = [along, (along + 1) % 3, (along + 2) % 3];
        Self { axes, dims: axes.map(|axis| dims[axis] as usize) }
    }

    fn n_rows(&self) -> usize {
        self.dims[1] * self.dims[2]
    }

    /// A cell's row, and its index there.
    #[inline]
    fn row(&self, cell: [u32; 3]) -> (usize, u32) {
        let [along, fast, slow] = self.axes;
        (cell[slow] as usize * self.dims[1] + cell[fast] as usize, cell[along])
    }

    fn cell(&self, row: usize, along: u32) -> [u32; 3] {
        let mut cell = [0; 3];
        let position = [along, (row % self.dims[1]) as u32, (row / self.dims[1]) as u32];
        (0..3).for_each(|axis| cell[self.axes[axis]] = position[axis]);
        cell
    }
}

/// Occupied cells, collected by many threads.
pub(crate) struct OccupiedCells {
    layout: RowLayout,
    bits: Vec<AtomicU64>,
}

impl OccupiedCells {
    pub(crate) fn new(dims: [u32; 3]) -> Self {
        let layout = RowLayout::new(dims);
        let n_cells = layout.n_rows() * layout.dims[0];
        Self { layout, bits: (0..n_cells.div_ceil(64)).map(|_| AtomicU64::new(0)).collect() }
    }

    #[inline]
    pub(crate) fn insert(&self, cell: [u32; 3]) {
        let (row, along) = self.layout.row(cell);
        let number = row * self.layout.dims[0] + along as usize;
        let (word, bit) = (&self.bits[number / 64], 1 << (number % 64));
        // Several triangles insert most cells, and reading is cheaper.
        if word.load(Relaxed) & bit == 0 {
            word.fetch_or(bit, Relaxed);
        }
    }
}

impl RowDisplacement {
    /// Upper bound of the bytes of D and O.
    pub(crate) fn predicted_bytes(dims: [u32; 3]) -> u64 {
        let [along, fast, slow] = RowLayout::new(dims).dims.map(|n| n as u64);
        (along * fast * slow).div_ceil(8) + 8 * fast * slow
    }

    /// Finds an offset for each row: the first fit among the last slots.
    ///
    /// Each row follows its neighbour, which resembles it, and they interlock; Lagae and Dutré begin with the longest rows.
    pub(crate) fn new(OccupiedCells { layout, bits }: OccupiedCells) -> Self {
        let mut occupied: Vec<_> = bits.into_iter().map(AtomicU64::into_inner).collect();
        let length = layout.dims[0];
        let mut slots = Slots::default();
        let mut cells = Vec::new();
        let mut offsets = Vec::new();
        let kept_row = (0..layout.n_rows())
            .map(|row| {
                // Collect the occupied cells of the row.
                cells.clear();
                cells.extend(set_bits(&occupied, row * length, length));
                let Some(&first) = cells.first() else { return EMPTY_ROW };

                // Keep its bits, and find its offset.
                let kept_row = offsets.len();
                copy_bits(&mut occupied, row * length, kept_row * length, length);
                cells.iter_mut().for_each(|along| *along -= first);
                offsets.push((slots.claim_first_fit(&cells) as u32).wrapping_sub(first));
                kept_row as u32
            })
            .collect();
        occupied.truncate((offsets.len() * length).div_ceil(64));
        occupied.shrink_to_fit();
        offsets.shrink_to_fit();
        Self { layout, kept_row, occupied, offsets, n_slots: slots.end }
    }

    /// Bytes of D, and of O with the rows' indices.
    pub(crate) fn n_bytes(&self) -> [usize; 2] {
        [size_of_val(&*self.occupied), size_of_val(&*self.kept_row) + size_of_val(&*self.offsets)]
    }

    pub(crate) fn cells(&self) -> impl Iterator<Item = [u32; 3]> {
        let length = self.layout.dims[0];
        let kept_row = self.kept_row.iter().enumerate().filter(|&(_, &kept_row)| kept_row != EMPTY_ROW);
        kept_row.flat_map(move |(row, &kept_row)| {
            let cells = set_bits(&self.occupied, kept_row as usize * length, length);
            cells.map(move |along| self.layout.cell(row, along))
        })
    }
}

impl CellIndex for RowDisplacement {
    fn n_slots(&self) -> usize {
        self.n_slots
    }

    #[inline]
    fn slot(&self, cell: [u32; 3]) -> Option<usize> {
        let (row, along) = self.layout.row(cell);
        let kept_row = self.kept_row[row];
        if kept_row == EMPTY_ROW {
            return None;
        }
        let kept_row = kept_row as usize;
        let bit = kept_row * self.layout.dims[0] + along as usize;
        (self.occupied[bit / 64] >> (bit % 64) & 1 == 1).then(|| self.offsets[kept_row].wrapping_add(along) as usize)
    }
}

/// 64 bits from index `first` on; bits beyond the end are 0.
#[inline]
fn word_at(words: &[u64], first: usize) -> u64 {
    let word = |index: usize| words.get(index).copied().unwrap_or(0);
    let (index, shift) = (first / 64, first % 64);
    if shift == 0 { word(index) } else { word(index) >> shift | word(index + 1) << (64 - shift) }
}

/// Indices, from `first` on, of the bits that are set among `n`.
fn set_bits(words: &[u64], first: usize, n: usize) -> impl Iterator<Item = u32> {
    (0..n).step_by(64).flat_map(move |done| {
        let mut word = word_at(words, first + done) & u64::MAX >> (64 - (n - done).min(64));
        std::iter::from_fn(move || {
            let bit = word.trailing_zeros();
            word &= word.wrapping_sub(1);
            (bit < 64).then_some(done as u32 + bit)
        })
    })
}

/// Copies `n` bits to an index that is no greater than `from`.
fn copy_bits(words: &mut [u64], from: usize, to: usize, n: usize) {
    for done in (0..n).step_by(64) {
        let mask = u64::MAX >> (64 - (n - done).min(64));
        let word = word_at(words, from + done) & mask;
        let (index, shift) = ((to + done) / 64, (to + done) % 64);
        words[index] = words[index] & !(mask << shift) | word << shift;
        if shift > 0 && mask >> (64 - shift) > 0 {
            words[index + 1] = words[index + 1] & !(mask >> (64 - shift)) | word >> (64 - shift);
        }
    }
}

#[derive(Default)]
struct Slots {
    taken: Vec<u64>,
    /// Index after the last slot in use.
    end: usize,
}

impl Slots {
    /// Takes the first slots that fit a row, given by its occupied cells, the first of which is 0.
    fn claim_first_fit(&mut self, cells: &[u32]) -> usize {
        // Try 64 offsets at a time.
        let mut first = (self.end / 64).saturating_sub(WINDOW_WORDS) * 64;
        let first_slot = loop {
            // A bit for each offset at which some cell would hit a slot in use.
            let mut conflicts = 0;
            for &x in cells {
                conflicts |= word_at(&self.taken, first + x as usize);
                if conflicts == u64::MAX {
                    break;
                }
            }
            if conflicts != u64::MAX {
                break first + conflicts.trailing_ones() as usize;
            }
            first += 64;
        };

        // Mark the slots.
        for &x in cells {
            let slot = first_slot + x as usize;
            self.end = self.end.max(slot + 1);
            if self.taken.len() <= slot / 64 {
                self.taken.resize(slot / 64 + 1, 0);
            }
            self.taken[slot / 64] |= 1 << (slot % 64);
        }
        first_slot
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_occupied_cell_has_a_slot_of_its_own() {
        let mut state = 3u64;
        let dense = [[1, 1, 1], [5, 3, 2], [64, 9, 4], [60, 40, 30], [1, 300, 7]].map(|dims| (dims, 8));
        for (dims, sparseness) in dense.into_iter().chain([([70, 150, 80], 256), ([130, 128, 200], 1024)]) {
            let cells = (0..dims[2]).flat_map(|z| (0..dims[1]).flat_map(move |y| (0..dims[0]).map(move |x| [x, y, z])));
            let occupied = OccupiedCells::new(dims);
            let mut expected = Vec::new();
            for cell in cells.clone() {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                if (state >> 33).is_multiple_of(sparseness) {
                    occupied.insert(cell);
                    expected.push(cell);
                }
            }
            let rows = RowDisplacement::new(occupied);
            let mut taken = vec![false; rows.n_slots()];
            let mut remaining = expected.iter().copied().peekable();
            for cell in cells {
                let slot = rows.slot(cell);
                assert_eq!(slot.is_some(), remaining.next_if_eq(&cell).is_some());
                if let Some(slot) = slot {
                    assert!(!std::mem::replace(&mut taken[slot], true), "{dims:?}: slot {slot} twice");
                }
            }
            let mut found: Vec<_> = rows.cells().collect();
            found.sort_unstable_by_key(|&[x, y, z]| [z, y, x]);
            assert_eq!(found, expected);
            let (n_cells, n_slots) = (expected.len(), rows.n_slots());
            assert!(n_cells * 10 >= n_slots * 6, "{dims:?}: {n_cells} cells in {n_slots} slots");
        }
    }
}
