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

#[expect(clippy::needless_range_loop, reason = "an axis indexes several arrays at once")]
mod boxes;
mod budget;
mod build;
mod choice;
mod cull;
#[expect(clippy::needless_range_loop, reason = "an axis, a corner or a lane indexes several arrays at once")]
mod decide;
mod divide;
mod figures;
#[expect(clippy::needless_range_loop, reason = "an axis or a corner indexes several arrays at once")]
pub mod filter;
mod frustum;
mod instructions;
mod kernel;
mod macrocells;
mod options;
mod overlap;
mod packet;
#[expect(clippy::needless_range_loop, reason = "an edge indexes several arrays at once")]
mod pairs;
#[expect(clippy::needless_range_loop, reason = "an axis or an edge indexes several arrays at once")]
mod prepared;
mod ray_set;
mod resolution;
mod row_displacement;
mod scatter;
#[cfg(test)]
mod tests;
mod tree;
mod uniform;
mod walk;

pub use budget::{MemoryBudget, MemoryShortage};
pub use choice::{Choice, Prediction, Reason};
pub use figures::GridFigures;
pub use instructions::InstructionSet;
pub use options::{GridOptions, MeshLayout, Storage};
pub use packet::{MOST_PACKETS, Packet, PacketScratch};
use resolution::CellSpace;
use row_displacement::RowDisplacement;
use tree::Tree;
use uniform::{Plain, UniformGrid};
pub use walk::RayCost;

use traced::TracedMesh;

/// A mesh and a grid over its triangles.
///
/// Invariant: every point of a triangle lies in cells that list it, by a margin of [`overlap::DILATION`] around each
/// cell; [`walk`] relies on it for rays that pass exactly between cells.
#[derive(Debug)]
pub struct Grid {
    space: CellSpace,
    structure: Structure,
    /// Cells per triangle.
    density: f64,
    shortage: Option<MemoryShortage>,
    choice: Choice,
    mesh: TracedMesh,
    instructions: InstructionSet,
}

/// How the cells are kept.
#[derive(Debug)]
enum Structure {
    Tree(Tree),
    Plain(UniformGrid<Plain>),
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
            Structure::Tree(_) => Storage::Masks,
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
fn bits(mut mask: u64) -> impl Iterator<Item = u32> {
    std::iter::from_fn(move || {
        let bit = mask.trailing_zeros();
        mask &= mask.wrapping_sub(1);
        (bit < 64).then_some(bit)
    })
}
