//! The tree of masks: a dense array of bricks, each a tree of nodes of 4×4×4 children with one bit per child.
//!
//! A node's mask of occupied children is a macrocell's bit array, so the masks are the macrocell levels.
//! The paper's resolution sets the size of the bricks; each is divided only where it holds too much, and there as often
//! as needed, so that a detailed object in a large plain scene costs no more than one alone.

#[expect(clippy::needless_range_loop, reason = "an axis indexes several arrays at once")]
pub(crate) mod boxes;
pub(crate) mod divide;
pub(crate) mod overlap;
pub(crate) mod scatter;

use std::ops::Range;

use crate::{
    grid::{Storage, figures::GridStats},
    intersect::walk::{CellStructure, TriangleList},
};
use boxes::QuantizedBoxes;

/// Cells of the paper's resolution along a brick.
pub(crate) const CELLS_PER_BRICK: u32 = 32;

/// Levels of nodes in a brick at most. Integer coordinates count cells of the deepest level.
pub(crate) const LEVELS: u32 = 5;

/// Finest cells along a brick.
pub(crate) const BRICK_SIZE: u32 = 1 << (2 * LEVELS);

/// Bricks, nodes and leaves, and the triangles of each leaf.
#[derive(Debug, PartialEq)]
pub(crate) struct Tree {
    /// Bricks per axis.
    pub(crate) dims: [u32; 3],
    /// Finest cells per axis up to the last that the mesh's bounds reach. The last bricks of a model of few end far beyond:
    /// packets that pass through nothing else would take a tenth of the time of the gears.
    pub(crate) extent: [u32; 3],
    /// For each brick, x fastest: [`Tree::EMPTY`], or a leaf with [`Tree::LEAF`] set, or a node.
    pub(crate) bricks: Vec<u32>,
    pub(crate) nodes: Vec<TreeNode>,
    /// Where each leaf's references begin; one more at the end.
    pub(crate) leaf_starts: Vec<u32>,
    /// Triangles by their place in the mesh, leaf after leaf.
    pub(crate) references: Vec<u32>,
    /// Small bounds of the triangle of each reference.
    pub(crate) boxes: QuantizedBoxes,
    /// The largest empty cube that a single ray may skip whole, log₂ in finest cells.
    pub(crate) largest_skip: u32,
}

/// A cube of 4×4×4 children, child (x, y, z) at bit 16·z + 4·y + x.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct TreeNode {
    /// Children with triangles in them.
    pub(crate) occupied: u64,
    /// Those of them that are nodes again; the others are leaves.
    pub(crate) divided: u64,
    /// The first divided child; the others follow in the order of their bits.
    pub(crate) first_node: u32,
    /// The first leaf; the others follow likewise.
    pub(crate) first_leaf: u32,
}

impl Tree {
    pub(crate) const EMPTY: u32 = u32::MAX;
    pub(crate) const LEAF: u32 = 1 << 31;

    /// A tree without triangles.
    pub(crate) fn empty() -> Self {
        Self {
            dims: [1; 3],
            extent: [BRICK_SIZE; 3],
            bricks: vec![Self::EMPTY],
            nodes: Vec::new(),
            leaf_starts: vec![0],
            references: Vec::new(),
            boxes: QuantizedBoxes::default(),
            largest_skip: largest_skip(0),
        }
    }

    #[inline(always)]
    fn leaf(&self, leaf: u32) -> TriangleList<'_> {
        let references = self.references_of(leaf);
        TriangleList { triangles: &self.references[references.clone()], boxes: self.boxes.leaf_bytes(references) }
    }

    /// Which references are those of a leaf.
    #[inline(always)]
    pub(crate) fn references_of(&self, leaf: u32) -> Range<usize> {
        let leaf = leaf as usize;
        self.leaf_starts[leaf] as usize..self.leaf_starts[leaf + 1] as usize
    }

    /// What it is and takes, without mesh and density.
    pub(crate) fn figures(&self) -> GridStats {
        GridStats {
            storage: Storage::Tree.name(),
            cells: self.dims.iter().map(|&n| u64::from(n * CELLS_PER_BRICK)).product(),
            lists: self.leaf_starts.len() - 1,
            references: self.references.len(),
            macrocell_bytes: size_of_val(&*self.bricks) + size_of_val(&*self.nodes),
            list_bytes: size_of_val(&*self.leaf_starts),
            reference_bytes: size_of_val(&*self.references),
            box_bytes: Some(self.boxes.n_bytes()),
            ..GridStats::default()
        }
    }
}

impl CellStructure for Tree {
    fn dims(&self) -> [i32; 3] {
        self.extent.map(|n| n as i32)
    }

    #[inline]
    fn locate(&self, cell: [i32; 3]) -> (Option<TriangleList<'_>>, u32) {
        let cell = cell.map(|x| x as u32);
        let mut shift = 2 * LEVELS;
        let [x, y, z] = cell.map(|x| (x >> shift) as usize);
        let brick = self.bricks[(z * self.dims[1] as usize + y) * self.dims[0] as usize + x];
        if brick == Self::EMPTY {
            return (None, shift.min(self.largest_skip));
        }
        if brick & Self::LEAF != 0 {
            return (Some(self.leaf(brick & !Self::LEAF)), shift);
        }
        let mut node = &self.nodes[brick as usize];
        loop {
            shift -= 2;
            let child = overlap::child_index(cell.map(|x| x >> shift & 3));
            if node.occupied >> child & 1 == 0 {
                return (None, shift.min(self.largest_skip));
            }
            let before = (1 << child) - 1;
            if node.divided >> child & 1 == 0 {
                let leaf = node.first_leaf + (node.occupied & !node.divided & before).count_ones();
                return (Some(self.leaf(leaf)), shift);
            }
            node = &self.nodes[(node.first_node + (node.divided & before).count_ones()) as usize];
        }
    }
}

/// The largest empty cube that may be skipped whole, log₂ in finest cells: half a cell of the paper's without
/// macrocells, and four times as much for each level of them.
pub(crate) fn largest_skip(macrocell_levels: u8) -> u32 {
    2 * (LEVELS - 3) + 2 * u32::from(macrocell_levels)
}
