//! Options for building a grid.

use std::ops::RangeInclusive;

pub use shared::structure::Storage;
use shared::{names::unknown_name, structure::Structure};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use crate::grid::budget::MemoryBudget;

/// Options for building a grid. None changes a hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridOptions {
    /// The paper's ρ: cells per triangle; `None` to choose it for the scene, see [`crate::grid::Choice`].
    pub density: Option<f64>,
    /// Sizes of empty macrocells that a single ray may skip.
    pub macrocell_levels: u8,
    /// Storage of the cells.
    pub storage: Storage,
    /// Storage of the triangles.
    pub mesh: MeshLayout,
    /// Memory that loading the scene may take; the grid is made coarser to stay within it.
    pub memory_budget: MemoryBudget,
}

/// Storage of a traced mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Display, EnumString, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum MeshLayout {
    /// Each vertex once, and three vertex indices for each triangle.
    #[default]
    Indexed,
    /// Three vertices of its own for each triangle.
    Flat,
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
            mesh: MeshLayout::default(),
            memory_budget: MemoryBudget::default(),
        }
    }
}
