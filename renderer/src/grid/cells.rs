//! Cells of any grid: the space that they fill, and how single rays look them up.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::model::mesh::Aabb;

/// The map from model space to a grid's finest cells: each is a unit cube with corners at integers.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(crate) struct CellSpace {
    /// The grid's lowest corner, in model space.
    pub(crate) origin: [f32; 3],
    /// Finest cells per world unit.
    pub(crate) cells_per_unit: f64,
}

impl CellSpace {
    /// The space of a grid over `bounds`, with finest cells of side `cell_size` in the model's units.
    pub(crate) fn new(bounds: &Aabb, cell_size: f64) -> Self {
        Self { origin: bounds.min, cells_per_unit: 1.0 / cell_size }
    }

    /// A point of model space in finest cells.
    pub(crate) fn point_to_cells(&self, point: DVec3) -> DVec3 {
        (point - DVec3::from_array(self.origin.map(f64::from))) * self.cells_per_unit
    }

    /// A length in finest cells, converted to the model's units.
    pub(crate) fn length_to_model(&self, cells: f64) -> f64 {
        cells / self.cells_per_unit
    }

    /// A vector of model space in finest cells.
    pub(crate) fn direction_to_cells(&self, vector: DVec3) -> DVec3 {
        vector * self.cells_per_unit
    }
}

pub(crate) trait CellStructure {
    /// Finest cells per axis.
    fn dims(&self) -> [i32; 3];

    /// The triangles around a finest cell, if it has a list, and the size (log₂ in finest cells) of the cube in which it holds.
    fn locate(&self, cell: [i32; 3]) -> (Option<&[u32]>, u32);
}
