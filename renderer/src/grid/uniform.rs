//! The paper's uniform grid: cells of one size, a list of triangles for each, and macrocells over them.

pub(crate) mod macrocells;
pub(crate) mod resolution;
pub(crate) mod row_displacement;

use crate::grid::{
    cells::CellStructure,
    figures::GridStats,
    tree::scatter::{self, Scatter},
};
use macrocells::Macrocells;
use row_displacement::{OccupiedCells, RowDisplacement};

pub(crate) trait CellIndex: Sync {
    fn n_slots(&self) -> usize;

    /// The list of a cell, or `None` if the cell is known to be empty. No two cells share one.
    fn slot(&self, cell: [u32; 3]) -> Option<usize>;
}

/// One list for every cell; most are empty.
#[derive(Debug, PartialEq)]
pub(crate) struct DenseIndex {
    dims: [u32; 3],
}

impl CellIndex for DenseIndex {
    fn n_slots(&self) -> usize {
        self.dims.iter().map(|&n| n as usize).product()
    }

    #[inline]
    fn slot(&self, [x, y, z]: [u32; 3]) -> Option<usize> {
        Some((z as usize * self.dims[1] as usize + y as usize) * self.dims[0] as usize + x as usize)
    }
}

/// Lists of triangles, found by an index of cells.
#[derive(Debug, PartialEq)]
pub(crate) struct UniformGrid<I> {
    dims: [u32; 3],
    pub(crate) index: I,
    /// Index of each list's first reference, and the number of references at the end.
    starts: Vec<u32>,
    /// Triangle indices, list after list.
    pub(crate) references: Vec<u32>,
    macrocells: Macrocells,
}

impl<I: CellIndex> CellStructure for UniformGrid<I> {
    fn dims(&self) -> [i32; 3] {
        self.dims.map(|n| n as i32)
    }

    #[inline]
    fn locate(&self, cell: [i32; 3]) -> (Option<&[u32]>, u32) {
        let cell = cell.map(|x| x as u32);
        if let Some(shift) = self.macrocells.empty_around(cell) {
            return (None, shift);
        }
        let list = self.index.slot(cell).map(|slot| {
            let [first, end] = [self.starts[slot], self.starts[slot + 1]];
            &self.references[first as usize..end as usize]
        });
        (list, 0)
    }
}

impl UniformGrid<DenseIndex> {
    /// Builds the grid, or `None` if it would take more than `most_bytes`.
    pub(crate) fn build(scatter: &Scatter<'_>, macrocell_levels: u8, most_bytes: u64) -> Option<Self> {
        let index = DenseIndex { dims: scatter.dims };
        let mut grid = Self::fill(scatter, index, most_bytes)?;
        let [x_dim, y_dim, _] = grid.dims.map(|n| n as usize);
        let occupied = grid.starts.windows(2).enumerate().filter(|(_, bounds)| bounds[0] < bounds[1]);
        let position = |cell: usize| [cell % x_dim, cell / x_dim % y_dim, cell / x_dim / y_dim].map(|x| x as u32);
        grid.macrocells = Macrocells::new(grid.dims, macrocell_levels, occupied.map(|(cell, _)| position(cell)));
        Some(grid)
    }
}

impl UniformGrid<RowDisplacement> {
    /// Builds the grid, or `None` if it would take more than `most_bytes`.
    pub(crate) fn build(scatter: &Scatter<'_>, macrocell_levels: u8, most_bytes: u64) -> Option<Self> {
        let dims = scatter.dims;
        let left = most_bytes.checked_sub(RowDisplacement::predicted_bytes(dims))?;
        let occupied = OccupiedCells::new(dims);
        scatter.for_each_pair(left / REFERENCE_BYTES, |cell, _| occupied.insert(cell))?;
        let mut grid = Self::fill(scatter, RowDisplacement::new(occupied), left)?;
        grid.macrocells = Macrocells::new(dims, macrocell_levels, grid.index.cells());
        Some(grid)
    }
}

impl<I: CellIndex> UniformGrid<I> {
    /// Fills the lists; the caller adds the macrocells.
    fn fill(scatter: &Scatter<'_>, index: I, most_bytes: u64) -> Option<Self> {
        let left = most_bytes.checked_sub(4 * index.n_slots() as u64)?.min(REFERENCE_BYTES * u64::from(u32::MAX));
        let slot = |cell| index.slot(cell).expect("no triangle lies in an empty cell");
        let counts = scatter.count(index.n_slots(), left / REFERENCE_BYTES, slot)?;
        let (starts, mut references) = scatter.fill(counts, slot);
        scatter::sort_lists(&starts, &mut references);
        Some(Self { dims: scatter.dims, index, starts, references, macrocells: Macrocells::default() })
    }

    /// Sizes and counts, without storage, density and index.
    pub(crate) fn figures(&self) -> GridStats {
        GridStats {
            cells: self.dims.iter().map(|&n| u64::from(n)).product(),
            lists: self.starts.windows(2).filter(|bounds| bounds[0] < bounds[1]).count(),
            references: self.references.len(),
            macrocell_bytes: self.macrocells.n_bytes(),
            list_bytes: size_of_val(&*self.starts),
            reference_bytes: size_of_val(&*self.references),
            ..GridStats::default()
        }
    }
}

const REFERENCE_BYTES: u64 = size_of::<u32>() as u64;
