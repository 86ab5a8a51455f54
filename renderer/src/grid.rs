//! The paper's multi-level grid: cells over the scene's bounds, and macrocells that skip what is empty.
//!
//! Cells are nested: a dense array of bricks, each a tree of nodes of 4×4×4 children with one bit per child.
//! A node's mask of occupied children is a macrocell's bit array, so the masks are the macrocell levels.
//! The paper's resolution sets the size of the bricks; each is divided only where it holds too much, and there as often
//! as needed, so that a detailed object in a large plain scene costs no more than one alone.
//!
//! That is the default; [`options`] says what else can be asked for, and [`budget`] within how much
//! memory. [`uniform`] is the paper's own grid, of cells of one
//! size, with [`row_displacement`] that compresses it and [`macrocells`] over it.
//!
//! In reading order: [`resolution`] says how many cells; [`overlap`] which cells a triangle touches; [`scatter`] puts
//! triangles into cells; [`build`] makes the grid; [`boxes`] bounds the triangles; [`walk`] follows single rays through it with [`filter`] before each
//! list, [`packet`] follows many rays together, whose triangles [`cull`] sorts out.

use std::time::Duration;

#[expect(clippy::needless_range_loop, reason = "an axis indexes several arrays at once")]
mod boxes;
mod budget;
mod build;
#[expect(clippy::needless_range_loop, reason = "an axis, a corner or a lane indexes several arrays at once")]
mod cull;
mod figures;
#[expect(clippy::needless_range_loop, reason = "an axis or a corner indexes several arrays at once")]
pub(crate) mod filter;
mod macrocells;
mod options;
mod overlap;
mod packet;
mod resolution;
mod row_displacement;
mod scatter;
#[cfg(test)]
mod tests;
mod uniform;
mod walk;

pub use budget::{MemoryBudget, MemoryShortage};
pub use figures::GridFigures;
pub use options::{GridOptions, MeshLayout, Storage};
pub use packet::{InstructionSet, Packet, PacketScratch};
use resolution::CellSpace;
use uniform::Uniform;
pub use walk::RayCost;

use crate::traced::TracedMesh;

/// Cells of the paper's resolution along a brick.
const CELLS_PER_BRICK: u32 = 32;

/// Levels of nodes in a brick at most. Integer coordinates count cells of the deepest level.
const LEVELS: u32 = 5;

/// Finest cells along a brick.
const BRICK_SIZE: u32 = 1 << (2 * LEVELS);

/// A mesh and a grid over its triangles.
///
/// Invariant: every point of a triangle lies in cells that list it, by a margin of [`overlap::DILATION`] around each
/// cell; [`walk`] relies on it for rays that pass exactly between cells.
#[derive(Debug)]
pub struct Grid {
    space: CellSpace,
    /// Bricks per axis.
    dims: [u32; 3],
    /// For each brick, x fastest: [`Grid::EMPTY`], or a leaf with [`Grid::LEAF`] set, or a node.
    bricks: Vec<u32>,
    nodes: Vec<Node>,
    /// Where each leaf's references begin; one more at the end.
    leaf_starts: Vec<u32>,
    /// Triangles by their place in the mesh, leaf after leaf.
    references: Vec<u32>,
    /// Small bounds of the triangle of each reference.
    boxes: boxes::Boxes,
    /// The largest empty cube that a single ray may skip whole, log₂ in finest cells.
    largest_skip: u32,
    /// The paper's uniform grid in place of the tree, which is empty then.
    uniform: Option<Uniform>,
    /// How long the places of the rows took to find, with row displacement.
    placement: Duration,
    /// Cells per triangle.
    density: f64,
    shortage: Option<MemoryShortage>,
    mesh: TracedMesh,
    instructions: InstructionSet,
}

/// A cube of 4×4×4 children, child (x, y, z) at bit 16·z + 4·y + x.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Node {
    /// Children with triangles in them.
    occupied: u64,
    /// Those of them that are nodes again; the others are leaves.
    divided: u64,
    /// The first divided child; the others follow in the order of their bits.
    first_node: u32,
    /// The first leaf; the others follow likewise.
    first_leaf: u32,
}

impl Grid {
    const EMPTY: u32 = u32::MAX;
    const LEAF: u32 = 1 << 31;

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
