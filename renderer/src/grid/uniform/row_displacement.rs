//! Row displacement: the offsets of a grid's cells, compressed to those that are needed.
//!
//! After Lagae and Dutré, "Compact, Fast and Robust Grids for Ray Tracing" (2008). A row is a line of cells.
//! All rows lie on top of each other in one array of slots, H, each displaced by an offset O so that no two occupied
//! cells share a slot; a bit for each cell, D, says whether it is occupied, so that slots need no names.
//! Rows without any are left out of D, the largest part, and of O: 23 to 40 % of the rows of scans.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use crate::grid::uniform::CellIndex;

/// Slots at the end that are tried for a row, in words of 64 bits. Trying all would take time quadratic in the number
/// of rows, for a few per cent of slots.
const WINDOW_WORDS: usize = 256;

/// In place of a row without occupied cells.
const EMPTY_ROW: u32 = u32::MAX;

/// Which cells are occupied, and the slot of each of those.
#[derive(Debug, PartialEq)]
pub(crate) struct RowDisplacement {
    layout: RowLayout,
    /// The place of each row in D and O, or [`EMPTY_ROW`].
    kept_row: Vec<u32>,
    /// D: a bit for each cell, kept row after kept row.
    occupied: Vec<u64>,
    /// O: for each kept row, what added to a cell's place in it (modulo 2³²) gives the slot.
    offsets: Vec<u32>,
    n_slots: usize,
}

/// How cells lie in rows: along the shortest axis, as short rows fit closer.
#[derive(Clone, Copy, Debug, PartialEq)]
struct RowLayout {
    /// The rows' own axis, and the two across, of which the first comes faster.
    axes: [usize; 3],
    /// Cells along these.
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

    /// The row of a cell, and its place there.
    #[inline]
    fn row(&self, cell: [u32; 3]) -> (usize, u32) {
        let [along, fast, slow] = self.axes;
        (cell[slow] as usize * self.dims[1] + cell[fast] as usize, cell[along])
    }

    /// The number of a cell, row after row.
    #[inline]
    fn cell_index(&self, cell: [u32; 3]) -> usize {
        let (row, along) = self.row(cell);
        row * self.dims[0] + along as usize
    }

    fn cell(&self, row: usize, along: u32) -> [u32; 3] {
        let mut cell = [0; 3];
        let position = [along, (row % self.dims[1]) as u32, (row / self.dims[1]) as u32];
        (0..3).for_each(|axis| cell[self.axes[axis]] = position[axis]);
        cell
    }
}

/// Occupied cells, as they are found by many threads.
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
        let number = self.layout.cell_index(cell);
        let (word, bit) = (&self.bits[number / 64], 1 << (number % 64));
        // Most cells are met by several triangles, and to read is cheaper.
        if word.load(Relaxed) & bit == 0 {
            word.fetch_or(bit, Relaxed);
        }
    }
}

impl RowDisplacement {
    /// What D and O will take at most.
    pub(crate) fn predicted_bytes(dims: [u32; 3]) -> u64 {
        let [along, fast, slow] = RowLayout::new(dims).dims.map(|n| n as u64);
        (along * fast * slow).div_ceil(8) + 8 * fast * slow
    }

    /// Finds the first place for each row among the last slots.
    ///
    /// Lagae and Dutré begin with the longest rows; here each row follows its neighbour, which resembles it, so that
    /// they interlock: that fills 90 % of the slots where the other order fills 60 %.
    pub(crate) fn new(OccupiedCells { layout, bits }: OccupiedCells) -> Self {
        let mut occupied: Vec<_> = bits.into_iter().map(AtomicU64::into_inner).collect();
        let length = layout.dims[0];
        let mut slots = Slots::default();
        let mut cells = Vec::new();
        let mut offsets = Vec::new();
        let kept_row = (0..layout.n_rows())
            .map(|row| {
                cells.clear();
                cells.extend(set_bits(&occupied, row * length, length));
                let Some(&first) = cells.first() else { return EMPTY_ROW };
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

    /// Bytes of D and of O, the rows' places in them counted with O.
    pub(crate) fn n_bytes(&self) -> [usize; 2] {
        [size_of_val(&*self.occupied), size_of_val(&*self.kept_row) + size_of_val(&*self.offsets)]
    }

    /// The occupied cells.
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

/// 64 bits from any place on; those beyond the end are 0.
#[inline]
fn word_at(words: &[u64], first: usize) -> u64 {
    let word = |index: usize| words.get(index).copied().unwrap_or(0);
    let (index, shift) = (first / 64, first % 64);
    if shift == 0 { word(index) } else { word(index) >> shift | word(index + 1) << (64 - shift) }
}

/// Which of `n` bits from `first` on are 1.
fn set_bits(words: &[u64], first: usize, n: usize) -> impl Iterator<Item = u32> {
    (0..n).step_by(64).flat_map(move |done| {
        let word = word_at(words, first + done) & u64::MAX >> (64 - (n - done).min(64));
        crate::grid::bits(word).map(move |bit| done as u32 + bit)
    })
}

/// Copies bits over others that begin no later.
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

/// The slots that are taken.
#[derive(Default)]
struct Slots {
    taken: Vec<u64>,
    /// Behind the last one taken.
    end: usize,
}

impl Slots {
    /// Takes the first place that is free for a row, given by its occupied cells, the first of which is 0.
    fn claim_first_fit(&mut self, cells: &[u32]) -> usize {
        let mut first = (self.end / 64).saturating_sub(WINDOW_WORDS) * 64;
        let first_slot = loop {
            // A bit for each of 64 places where some cell would meet a slot that is taken.
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
