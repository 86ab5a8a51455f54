//! The tree: a dense array of bricks, each a tree of nodes with 4×4×4 children and one mask bit per child.
//!
//! The paper's resolution sets the size of bricks. ARCHITECTURE.md ("The grid") has the reasons.

pub(crate) mod boxes;
pub(crate) mod divide;
mod guests;
pub(crate) mod hierarchy;
pub(crate) mod items;
pub(crate) mod overlap;
pub(crate) mod scatter;
mod stored;

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    grid::{cells::CellSpace, figures::GridStats, traced::TracedMesh},
    scene_file::section::Section,
    simd::Simd,
};
use boxes::{LeafCube, QuantizedBoxes};
use hierarchy::{Entry, Hierarchy, pieces};
use items::Items;

/// Cells of the paper's resolution along a brick.
pub(crate) const CELLS_PER_BRICK: u32 = 32;

/// Most levels of nodes in a brick. Integer coordinates count cells of the deepest level.
pub(crate) const LEVELS: u32 = 5;

/// Finest cells along a brick.
pub(crate) const BRICK_SIZE: u32 = 1 << (2 * LEVELS);

/// Bytes that stay in a processor's caches: hints cost single rays a tenth of their time there, and save up to a quarter where
/// a tree is larger.
const CACHED_BYTES: usize = 20 << 20;

/// Bricks, nodes and leaves, and the triangles of each leaf.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Tree {
    /// Bricks per axis.
    pub(crate) dims: [u32; 3],
    /// Finest cells per axis within the mesh's bounds. With few bricks, the last ones reach far beyond: packets that
    /// pass only that empty part would take a tenth of the time of a model of gears.
    pub(crate) extent: [u32; 3],
    /// For each brick, x fastest: [`Tree::EMPTY`], a leaf's index with [`Tree::LEAF`] set, or a node's index.
    #[serde(skip)]
    pub(crate) bricks: Section<u32>,
    #[serde(skip)]
    pub(crate) nodes: Section<TreeNode>,
    /// Each leaf's first item, and the number of items at the end.
    #[serde(skip)]
    pub(crate) leaf_starts: Section<u32>,
    pub(crate) items: Items,
    /// Whether single triangles have no boxes and are in no hierarchy.
    pub(crate) is_compact: bool,
    pub(crate) boxes: QuantizedBoxes,
    /// The cube of each leaf.
    #[serde(skip)]
    pub(crate) leaf_cubes: Section<LeafCube>,
    /// Boxes over the leaves, or over all triangles.
    pub(crate) hierarchy: Hierarchy,
}

/// A cube of 4×4×4 children, child (x, y, z) at bit 16·z + 4·y + x.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct TreeNode {
    /// Children with triangles in them.
    pub(crate) occupied: u64,
    /// Occupied children that are nodes; the others are leaves.
    pub(crate) divided: u64,
    /// Index of the first divided child; the others follow in the order of their bits.
    pub(crate) first_node: u32,
    /// Index of the first leaf; the others follow in the order of their bits.
    pub(crate) first_leaf: u32,
}

impl Tree {
    pub(crate) const EMPTY: u32 = u32::MAX;
    pub(crate) const LEAF: u32 = 1 << 31;

    pub(crate) fn empty() -> Self {
        Self {
            dims: [1; 3],
            extent: [BRICK_SIZE; 3],
            bricks: vec![Self::EMPTY].into(),
            nodes: Section::default(),
            leaf_starts: vec![0].into(),
            items: Items::new(Vec::new(), 0).0,
            is_compact: false,
            boxes: QuantizedBoxes::default(),
            leaf_cubes: Section::default(),
            hierarchy: Hierarchy::default(),
        }
    }

    /// The items of a leaf.
    #[inline(always)]
    pub(crate) fn items_of(&self, leaf: u32) -> Range<usize> {
        let leaf = leaf as usize;
        self.leaf_starts[leaf] as usize..self.leaf_starts[leaf + 1] as usize
    }

    /// Hints that the node or leaf of an entry of the hierarchy will be read soon.
    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, entry: Entry) {
        self.hierarchy.prefetch::<S>(entry);
        if self.hierarchy.triangle_nodes.is_empty() {
            let leaf = (entry & !hierarchy::LEAF) as usize;
            S::prefetch(&self.leaf_starts, leaf);
            S::prefetch(&self.leaf_cubes, leaf);
        }
    }

    /// Whether single rays read more of it than stays in a processor's caches.
    pub(crate) fn exceeds_caches(&self) -> bool {
        self.hierarchy.n_bytes() + self.boxes.n_bytes() > CACHED_BYTES
    }

    /// Number of items of all leaves.
    pub(crate) fn n_items(&self) -> usize {
        self.leaf_starts.last().map_or(0, |&end| end as usize)
    }

    /// The hierarchy over this tree's leaves.
    pub(crate) fn hierarchy_over_leaves(&self) -> Hierarchy {
        let bounds = |leaf: u32| self.boxes.leaf_bounds(leaf, self.leaf_cubes[leaf as usize], self.items_of(leaf));
        Hierarchy::over_leaves((0..self.leaf_cubes.len()).into_par_iter().map(|leaf| bounds(leaf as u32)))
    }

    /// The hierarchy over the mesh's triangles, for which so many bytes are left.
    pub(crate) fn hierarchy_over_triangles(space: &CellSpace, mesh: &TracedMesh, n_bytes_left: u64) -> Hierarchy {
        let to_cells = |corner: [f32; 3]| space.point_to_cells(Vec3::from_array(corner).as_dvec3());
        let corners = |triangle_idx: u32| mesh.corners(triangle_idx).map(to_cells);
        let most_pieces = Hierarchy::most_pieces(mesh.n_triangles(), n_bytes_left);
        Hierarchy::over_triangles(pieces::of_triangles(mesh.n_triangles() as u32, most_pieces, corners))
    }

    /// Sizes and counts, without storage and density.
    pub(crate) fn figures(&self) -> GridStats {
        GridStats {
            cells: self.dims.iter().map(|&n| u64::from(n * CELLS_PER_BRICK)).product(),
            lists: self.leaf_starts.len() - 1,
            references: self.n_items(),
            macrocell_bytes: size_of_val(&*self.bricks) + size_of_val(&*self.nodes),
            list_bytes: size_of_val(&*self.leaf_starts) + size_of_val(&*self.leaf_cubes),
            reference_bytes: self.items.n_bytes(),
            box_bytes: Some(self.boxes.n_bytes() + self.hierarchy.n_bytes()),
            ..GridStats::default()
        }
    }
}
