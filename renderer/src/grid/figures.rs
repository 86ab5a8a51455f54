//! Sizes and counts of a grid.

use serde::Serialize;

use crate::grid::{Grid, Structure};

/// Sizes of a grid and its parts, without the mesh.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct GridStats {
    /// Name of the storage.
    pub storage: &'static str,
    /// Cells per triangle; less than in the options where memory is short.
    pub density: f64,
    /// All cells, empty or not; in a tree the number that the paper's formula gives.
    pub cells: u64,
    /// Cells that list triangles.
    pub lists: usize,
    /// Entries of all lists.
    pub references: usize,
    /// Bytes of the macrocells; in a tree those of its bricks and nodes.
    pub macrocell_bytes: usize,
    /// Row displacement's D: a bit for each cell of rows that are not empty.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub d_bytes: Option<usize>,
    /// Row displacement's O: index and offset of each row.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub o_bytes: Option<usize>,
    /// Bytes of the lists' starts: row displacement's H; in a tree, with the cubes of its leaves.
    pub list_bytes: usize,
    /// Bytes of the lists.
    pub reference_bytes: usize,
    /// Four bytes a cell, divided by D + O + H.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compression_ratio: Option<f64>,
    /// In a tree: bytes of the triangles' bounds, and of the hierarchy.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub box_bytes: Option<usize>,
}

impl GridStats {
    /// Total bytes.
    pub fn n_bytes(&self) -> usize {
        let index_bytes = self.d_bytes.unwrap_or(0) + self.o_bytes.unwrap_or(0) + self.box_bytes.unwrap_or(0);
        self.macrocell_bytes + index_bytes + self.list_bytes + self.reference_bytes
    }
}

impl Grid {
    /// Sizes and counts of the grid.
    pub fn figures(&self) -> GridStats {
        let figures = match &self.structure {
            Structure::Tree(tree) => tree.figures(),
            Structure::Plain(grid) => grid.figures(),
            Structure::RowDisplacement(grid) => {
                let (figures, [d_bytes, o_bytes]) = (grid.figures(), grid.index.n_bytes());
                let displaced_bytes = d_bytes + o_bytes + figures.list_bytes;
                let compression_ratio = Some(4.0 * figures.cells as f64 / displaced_bytes as f64);
                GridStats { d_bytes: Some(d_bytes), o_bytes: Some(o_bytes), compression_ratio, ..figures }
            }
        };
        GridStats { storage: self.storage().into(), density: self.density, ..figures }
    }
}
