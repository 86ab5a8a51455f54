//! What a grid is built like.

use std::{fmt, ops::RangeInclusive, str::FromStr};

pub use shared::structure::Storage;
use shared::structure::Structure;

use crate::grid::budget::MemoryBudget;

/// What a grid is built like. None of it changes a hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridOptions {
    /// The paper's ρ: cells per triangle. Without one it is chosen for the scene: see [`crate::grid::Choice`].
    pub density: Option<f64>,
    /// How many sizes of macrocells a single ray may skip whole when they are empty.
    pub macrocell_levels: u8,
    /// How cells are kept.
    pub storage: Storage,
    /// How triangles are kept.
    pub mesh: MeshLayout,
    /// What may be taken while the scene is made ready; the grid is made coarser to stay within it.
    pub memory_budget: MemoryBudget,
}

/// How the triangles of a traced mesh are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MeshLayout {
    /// Vertices once, and for each triangle the numbers of its three.
    #[default]
    Indexed,
    /// Three corners of its own for each triangle.
    Flat,
}

impl MeshLayout {
    /// As it is written on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Indexed => "indexed",
            Self::Flat => "flat",
        }
    }
}

impl fmt::Display for MeshLayout {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for MeshLayout {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = [Self::Indexed, Self::Flat].into_iter().find(|layout| layout.name() == name);
        found.ok_or_else(|| format!("\"{name}\" is no way to keep a mesh: it is indexed or flat"))
    }
}

impl GridOptions {
    /// The densities that can be asked for.
    pub const DENSITIES: RangeInclusive<f64> = Structure::DENSITIES;

    /// The paper's own density.
    pub const PAPER_DENSITY: f64 = 32.0;

    /// The numbers of macrocell levels that can be asked for.
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
