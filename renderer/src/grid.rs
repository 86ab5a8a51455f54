//! The paper's multi-level grid: cells over the scene's bounds, and macrocells that skip empty space.
//!
//! [`tree`] is the default: cells are divided until they hold few triangles. [`uniform`] is the paper's own grid, with
//! cells of one size: [`uniform::row_displacement`] compresses it, [`uniform::macrocells`] skips its empty cells.
//!
//! In reading order: [`options`] for a grid, and its memory [`budget`]; [`choice`] of the density; [`build`] makes the
//! grid and orders the mesh by it; [`traced`] is that mesh; [`cells`] is how rays look cells up; [`figures`] are sizes
//! and counts.

use std::time::Duration;

pub(crate) mod budget;
pub(crate) mod build;
pub(crate) mod cells;
pub(crate) mod choice;
pub(crate) mod figures;
pub(crate) mod options;
#[cfg(test)]
mod tests;
pub mod traced;
pub(crate) mod tree;
pub(crate) mod uniform;

use crate::simd::InstructionSet;
use cells::CellSpace;
use traced::TracedMesh;
use tree::Tree;
use uniform::{DenseIndex, UniformGrid, row_displacement::RowDisplacement};

pub use budget::{MemoryBudget, MemoryShortage};
pub use choice::{Choice, Prediction, Reason};
pub use figures::GridStats;
pub use options::{GridOptions, MeshLayout, Storage};

/// A mesh and a grid over its triangles.
///
/// Invariant: every cell lists all triangles within a margin of [`tree::overlap::DILATION`] around it, so that rays may
/// pass exactly between cells.
#[derive(Debug)]
pub struct Grid {
    pub(crate) space: CellSpace,
    pub(crate) structure: Structure,
    /// Cells per triangle.
    density: f64,
    shortage: Option<MemoryShortage>,
    choice: Choice,
    pub(crate) mesh: TracedMesh,
    pub(crate) instructions: InstructionSet,
}

/// Storage of the cells.
#[derive(Debug)]
pub(crate) enum Structure {
    Tree(Tree),
    Plain(UniformGrid<DenseIndex>),
    RowDisplacement {
        grid: UniformGrid<RowDisplacement>,
        /// Time to find the rows' offsets.
        placement: Duration,
    },
}

impl Structure {
    /// Triangle indices of all lists.
    fn references_mut(&mut self) -> &mut [u32] {
        match self {
            Self::Tree(tree) => &mut tree.references,
            Self::Plain(grid) => &mut grid.references,
            Self::RowDisplacement { grid, .. } => &mut grid.references,
        }
    }
}

impl Grid {
    /// The same grid, traced with other instructions, for tests and measurements. No hit changes.
    ///
    /// # Panics
    ///
    /// If this machine lacks the instructions.
    #[must_use]
    pub fn with_instructions(mut self, instructions: InstructionSet) -> Self {
        assert!(InstructionSet::available().contains(&instructions), "this machine lacks {instructions:?}");
        self.instructions = instructions;
        self
    }

    fn with_mesh_layout(self, layout: MeshLayout) -> Self {
        if layout == MeshLayout::Indexed { self } else { Self { mesh: self.mesh.into_flat(), ..self } }
    }

    /// The mesh, ordered by the cells.
    pub fn mesh(&self) -> &TracedMesh {
        &self.mesh
    }

    /// The effect of the memory budget on the grid, if it was too small.
    pub fn shortage(&self) -> Option<MemoryShortage> {
        self.shortage
    }

    /// The chosen storage and density, the reason, and predictions for others.
    pub fn choice(&self) -> &Choice {
        &self.choice
    }

    /// Storage and density; `None` where little memory led to a density below the options' range.
    pub fn structure(&self) -> Option<shared::structure::Structure> {
        let storage = match self.structure {
            Structure::Tree(_) => Storage::Tree,
            Structure::Plain(_) => Storage::Plain,
            Structure::RowDisplacement { .. } => Storage::RowDisplacement,
        };
        (storage, self.density).try_into().ok()
    }

    /// Bytes in memory, without the mesh.
    pub fn n_bytes(&self) -> usize {
        self.figures().n_bytes()
    }
}

/// Indices of the bits that are set, ascending.
pub(crate) fn bits(mut mask: u64) -> impl Iterator<Item = u32> {
    std::iter::from_fn(move || {
        let bit = mask.trailing_zeros();
        mask &= mask.wrapping_sub(1);
        (bit < 64).then_some(bit)
    })
}
