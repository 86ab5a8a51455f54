//! The paper's multi-level grid: cells over the scene's bounds, and macrocells that skip empty space.
//!
//! [`tree`] is the default: cells are divided until they hold few triangles. [`uniform`] is the paper's own grid, with
//! cells of one size: [`uniform::row_displacement`] compresses it, [`uniform::macrocells`] skips its empty cells.
//!
//! In reading order: [`options`] for a grid, and its memory [`budget`]; [`choice`] of the density; [`build`] makes the
//! grid and orders the mesh by it; [`traced`] is that mesh; [`cells`] is how rays look cells up; [`figures`] are
//! sizes and counts.

pub(crate) mod budget;
pub(crate) mod build;
pub(crate) mod cells;
pub(crate) mod choice;
pub(crate) mod figures;
pub(crate) mod options;
mod stored;
#[cfg(test)]
mod tests;
pub mod traced;
pub(crate) mod tree;
pub(crate) mod uniform;

use serde::{Deserialize, Serialize};

use crate::simd::InstructionSet;
use cells::CellSpace;
use traced::TracedMesh;
use tree::Tree;
use uniform::{DenseIndex, UniformGrid, row_displacement::RowDisplacement};

pub use budget::{MemoryBudget, MemoryShortage};
pub use figures::GridStats;
pub use options::{GridOptions, Storage};

/// A mesh and a grid over its triangles.
///
/// Invariant: every cell lists all triangles within a margin of [`tree::overlap::DILATION`] around it, so that rays may
/// pass exactly between cells.
#[derive(Debug, Serialize, Deserialize)]
pub struct Grid {
    pub(crate) space: CellSpace,
    pub(crate) structure: Structure,
    /// Cells per triangle.
    density: f64,
    shortage: Option<MemoryShortage>,
    /// Whether more memory would have given another grid.
    is_limited: bool,
    pub(crate) mesh: TracedMesh,
    #[serde(skip, default = "InstructionSet::best")]
    pub(crate) instructions: InstructionSet,
}

#[derive(Debug, Serialize, Deserialize)]
#[expect(clippy::large_enum_variant, reason = "a scene has few, and nearly all are trees")]
pub(crate) enum Structure {
    Tree(Tree),
    #[serde(skip)]
    Plain(UniformGrid<DenseIndex>),
    #[serde(skip)]
    RowDisplacement(UniformGrid<RowDisplacement>),
}

impl Structure {
    /// Triangles of the cells, in the mesh as loaded until it is ordered; a tree has none.
    fn references_mut(&mut self) -> &mut [u32] {
        match self {
            Self::Tree(_) => &mut [],
            Self::Plain(grid) => &mut grid.references,
            Self::RowDisplacement(grid) => &mut grid.references,
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

    /// The mesh, ordered by the cells.
    pub fn mesh(&self) -> &TracedMesh {
        &self.mesh
    }

    /// The effect of the memory budget on the grid, if it was too small.
    pub fn shortage(&self) -> Option<MemoryShortage> {
        self.shortage
    }

    /// Storage and density; `None` where little memory led to a density below the options' range.
    pub fn structure(&self) -> Option<shared::structure::Structure> {
        (self.storage(), self.density).try_into().ok()
    }

    fn storage(&self) -> Storage {
        match self.structure {
            Structure::Tree(Tree { is_compact: true, .. }) => Storage::Compact,
            Structure::Tree(_) => Storage::Tree,
            Structure::Plain(_) => Storage::Plain,
            Structure::RowDisplacement(_) => Storage::RowDisplacement,
        }
    }

    /// Bytes in memory, without the mesh.
    pub fn n_bytes(&self) -> usize {
        self.figures().n_bytes()
    }
}
