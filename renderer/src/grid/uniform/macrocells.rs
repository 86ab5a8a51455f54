//! The paper's macrocells: bit arrays over blocks of cells, to skip empty space.

/// Cells, or smaller macrocells, along a macrocell, log₂.
const LOG2_RATIO: u32 = 2;

/// Bit arrays over blocks of 4³, 16³ and 64³ cells, one a level.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Macrocells {
    /// The largest blocks first.
    levels: Vec<Level>,
}

/// A bit for each block of one size, set if the block is occupied, x fastest.
#[derive(Debug, PartialEq)]
struct Level {
    /// Size of a block, log₂ in cells.
    shift: u32,
    /// Blocks along x, and in a layer of x and y.
    strides: [usize; 2],
    occupied: Vec<u64>,
}

impl Macrocells {
    /// Takes the occupied cells, in any order.
    pub(super) fn new(dims: [u32; 3], n_levels: u8, occupied: impl Iterator<Item = [u32; 3]>) -> Self {
        let mut levels: Vec<_> =
            (1..=u32::from(n_levels)).rev().map(|level| Level::new(dims, level * LOG2_RATIO)).collect();
        occupied.for_each(|cell| levels.iter_mut().for_each(|level| level.set(cell)));
        Self { levels }
    }

    /// Size (log₂ in cells) of the largest empty macrocell around a cell, if there is one.
    #[inline]
    pub(super) fn empty_around(&self, cell: [u32; 3]) -> Option<u32> {
        self.levels.iter().find(|level| !level.is_occupied(cell)).map(|level| level.shift)
    }

    pub(super) fn n_bytes(&self) -> usize {
        self.levels.iter().map(|level| size_of_val(&*level.occupied)).sum()
    }
}

impl Level {
    fn new(dims: [u32; 3], shift: u32) -> Self {
        let [x, y, z] = dims.map(|n| n.div_ceil(1 << shift) as usize);
        Self { shift, strides: [x, x * y], occupied: vec![0; (x * y * z).div_ceil(64)] }
    }

    #[inline]
    fn index(&self, cell: [u32; 3]) -> usize {
        let [x, y, z] = cell.map(|x| (x >> self.shift) as usize);
        z * self.strides[1] + y * self.strides[0] + x
    }

    #[inline]
    fn is_occupied(&self, cell: [u32; 3]) -> bool {
        let index = self.index(cell);
        self.occupied[index / 64] >> (index % 64) & 1 == 1
    }

    fn set(&mut self, cell: [u32; 3]) {
        let index = self.index(cell);
        self.occupied[index / 64] |= 1 << (index % 64);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_empty_unless_a_cell_in_them_is_not() {
        let macrocells = Macrocells::new([200, 70, 3], 3, [[0, 0, 0], [199, 69, 2]].into_iter());
        for (cell, expected) in [
            ([3, 3, 2], None),
            ([4, 0, 0], Some(2)),
            ([0, 12, 1], Some(2)),
            ([16, 0, 0], Some(4)),
            ([64, 0, 0], Some(6)),
            ([0, 64, 0], Some(6)),
            ([192, 64, 0], Some(2)),
            ([196, 68, 0], None),
        ] {
            assert_eq!(macrocells.empty_around(cell), expected, "{cell:?}");
        }
        assert_eq!(Macrocells::new([200, 70, 3], 0, std::iter::empty()).empty_around([0; 3]), None);
    }
}
