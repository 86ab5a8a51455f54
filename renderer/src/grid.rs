//! The paper's multi-level grid: cells over the scene's bounds, and macrocells that skip what is empty.
//!
//! [`tree`] is the default, cells within cells down to where there is little; [`uniform`] is the paper's own grid, of
//! cells of one size, with [`row_displacement`] that compresses it and [`macrocells`] over it.
//!
//! In reading order: [`options`] says what can be asked for, and [`budget`] within how much memory; [`choice`]
//! chooses what is not asked for, [`resolution`] how many cells; [`overlap`] which cells a triangle touches; [`scatter`] puts triangles into cells; [`build`] makes the
//! grid, [`divide`] the tree; [`boxes`] bounds the triangles. [`walk`] follows single rays, with [`filter`] before each
//! list; [`packet`] follows many rays together through their [`frustum`], compiled by [`kernel`] for each instruction
//! set; [`cull`] sorts out what they may hit, [`pairs`] which of them, and [`decide`] what they do.

use std::time::Duration;

pub(crate) mod budget;
pub(crate) mod build;
pub(crate) mod choice;
pub(crate) mod figures;
pub(crate) mod options;
#[cfg(test)]
mod tests;
pub mod traced;
pub(crate) mod tree;
pub(crate) mod uniform;

use crate::intersect::InstructionSet;
pub use budget::{MemoryBudget, MemoryShortage};
pub use choice::{Choice, Prediction, Reason};
pub use figures::GridStats;
pub use options::{GridOptions, MeshLayout, Storage};
use tree::Tree;
use uniform::{DenseIndex, UniformGrid, resolution::CellSpace, row_displacement::RowDisplacement};

use traced::TracedMesh;

/// A mesh and a grid over its triangles.
///
/// Invariant: every point of a triangle lies in cells that list it, by a margin of [`overlap::DILATION`] around each
/// cell; [`walk`] relies on it for rays that pass exactly between cells.
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

/// How the cells are kept.
#[derive(Debug)]
pub(crate) enum Structure {
    Tree(Tree),
    Plain(UniformGrid<DenseIndex>),
    RowDisplacement {
        grid: UniformGrid<RowDisplacement>,
        /// How long the places of the rows took to find.
        placement: Duration,
    },
}

impl Structure {
    /// The triangles of all lists.
    fn references_mut(&mut self) -> &mut [u32] {
        match self {
            Self::Tree(tree) => &mut tree.references,
            Self::Plain(grid) => &mut grid.references,
            Self::RowDisplacement { grid, .. } => &mut grid.references,
        }
    }
}

impl Grid {
    /// The same grid, followed with other instructions: for tests and measurements. They change no hit.
    ///
    /// Panics if this machine does not have them.
    #[must_use]
    pub fn with_instructions(mut self, instructions: InstructionSet) -> Self {
        assert!(InstructionSet::available().contains(&instructions), "this machine has no {instructions:?}");
        self.instructions = instructions;
        self
    }

    fn with_mesh_layout(self, layout: MeshLayout) -> Self {
        if layout == MeshLayout::Indexed { self } else { Self { mesh: self.mesh.into_flat(), ..self } }
    }

    /// The mesh, in the order of the cells.
    pub fn mesh(&self) -> &TracedMesh {
        &self.mesh
    }

    /// What the memory budget did to the grid, if it was too small for the one that was asked for.
    pub fn shortage(&self) -> Option<MemoryShortage> {
        self.shortage
    }

    /// How the scene is kept and why, and what else would have been possible.
    pub fn choice(&self) -> &Choice {
        &self.choice
    }

    /// Its storage and density; `None` where memory allowed so few cells that nobody could ask for them.
    pub fn structure(&self) -> Option<shared::structure::Structure> {
        let storage = match self.structure {
            Structure::Tree(_) => Storage::Tree,
            Structure::Plain(_) => Storage::Plain,
            Structure::RowDisplacement { .. } => Storage::RowDisplacement,
        };
        (storage, self.density).try_into().ok()
    }

    /// Bytes of the structure, the mesh not counted.
    pub fn n_bytes(&self) -> usize {
        self.figures().n_bytes()
    }
}

/// The numbers of the bits that are set, ascending.
pub(crate) fn bits(mut mask: u64) -> impl Iterator<Item = u32> {
    std::iter::from_fn(move || {
        let bit = mask.trailing_zeros();
        mask &= mask.wrapping_sub(1);
        (bit < 64).then_some(bit)
    })
}
