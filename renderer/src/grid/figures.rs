//! What a grid is and takes, in numbers.

use serde::Serialize;

use crate::grid::{Grid, Structure};

/// Sizes of a grid and its parts, the mesh not counted.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct GridStats {
    /// The name of how cells are kept.
    pub storage: &'static str,
    /// Cells per triangle, less than was asked for where memory does not allow more.
    pub density: f64,
    /// Cells in all, empty or not; with masks those that the paper's formula gives.
    pub cells: u64,
    /// Cells that hold triangles.
    pub lists: usize,
    /// Triangles in all lists.
    pub references: usize,
    /// Bytes of the macrocells: with masks those of the whole tree.
    pub macrocell_bytes: usize,
    /// Row displacement's D: a bit for each cell of the rows that hold anything.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub d_bytes: Option<usize>,
    /// Row displacement's O: the place of each row, and its offset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub o_bytes: Option<usize>,
    /// Bytes of where lists begin: row displacement's H.
    pub list_bytes: usize,
    /// Bytes of the lists.
    pub reference_bytes: usize,
    /// Four bytes for each cell, against D + O + H.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compression_ratio: Option<f64>,
    /// With masks: bytes of the triangles' bounds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub box_bytes: Option<usize>,
    /// The time it took to displace all rows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub placement_seconds: Option<f64>,
}

impl GridStats {
    /// Bytes in all.
    pub fn n_bytes(&self) -> usize {
        let index_bytes = self.d_bytes.unwrap_or(0) + self.o_bytes.unwrap_or(0) + self.box_bytes.unwrap_or(0);
        self.macrocell_bytes + index_bytes + self.list_bytes + self.reference_bytes
    }
}

impl Grid {
    /// What the grid is and takes.
    pub fn figures(&self) -> GridStats {
        let figures = match &self.structure {
            Structure::Tree(tree) => tree.figures(),
            Structure::Plain(grid) => grid.figures(),
            Structure::RowDisplacement { grid, placement } => grid.figures(*placement),
        };
        GridStats { density: self.density, ..figures }
    }
}
