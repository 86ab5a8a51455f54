//! Options for building a grid.

use std::ops::RangeInclusive;

pub use shared::structure::Storage;
use shared::structure::Structure;

use crate::grid::budget::MemoryBudget;

/// Options for building a grid. None changes a hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridOptions {
    /// The paper's ρ: cells per triangle; `None` to choose it for the scene.
    pub density: Option<f64>,
    /// Sizes of empty macrocells over a uniform grid that a ray may skip.
    pub macrocell_levels: u8,
    /// Storage of the cells.
    pub storage: Storage,
    /// Memory that loading the scene may take. A [`SceneStore`](crate::scene_file::store::SceneStore) builds what takes more in
    /// temporary files; without them the grid is made coarser.
    pub memory_budget: MemoryBudget,
}

impl GridOptions {
    /// Valid densities.
    pub const DENSITIES: RangeInclusive<f64> = Structure::DENSITIES;

    /// The paper's own density.
    pub const PAPER_DENSITY: f64 = 32.0;

    /// Valid numbers of macrocell levels.
    pub const MACROCELL_LEVELS: RangeInclusive<u8> = 0..=3;
}

impl Default for GridOptions {
    fn default() -> Self {
        Self {
            density: None,
            macrocell_levels: *Self::MACROCELL_LEVELS.end(),
            storage: Storage::default(),
            memory_budget: MemoryBudget::default(),
        }
    }
}
