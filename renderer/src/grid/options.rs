//! What a grid is built like.

use std::{fmt, ops::RangeInclusive, str::FromStr};

use super::budget::MemoryBudget;

/// What a grid is built like. None of it changes a hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridOptions {
    /// The paper's ρ: cells per triangle.
    pub density: f64,
    /// How many sizes of macrocells a single ray may skip whole when they are empty.
    pub macrocell_levels: u8,
    /// How cells are kept.
    pub storage: Storage,
    /// How triangles are kept.
    pub mesh: MeshLayout,
    /// What may be taken while the scene is made ready; the grid is made coarser to stay within it.
    pub memory_budget: MemoryBudget,
}

/// How cells are kept in memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Storage {
    /// The paper's uniform grid: an offset for each cell.
    Plain,
    /// The same with the offsets compressed, after Lagae and Dutré (2008).
    RowDisplacement,
    /// A tree of bit masks, divided where it holds much. The only one that packets follow.
    #[default]
    Masks,
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
    pub const DENSITIES: RangeInclusive<f64> = 1.0 / 64.0..=4096.0;

    /// The numbers of macrocell levels that can be asked for.
    pub const MACROCELL_LEVELS: RangeInclusive<u8> = 0..=3;
}

impl Default for GridOptions {
    fn default() -> Self {
        Self {
            density: 32.0,
            macrocell_levels: *Self::MACROCELL_LEVELS.end(),
            storage: Storage::default(),
            mesh: MeshLayout::default(),
            memory_budget: MemoryBudget::default(),
        }
    }
}

impl Storage {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Plain, Self::RowDisplacement, Self::Masks];

    /// As it is written on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::RowDisplacement => "row-displacement",
            Self::Masks => "masks",
        }
    }
}

impl fmt::Display for Storage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Storage {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|storage| storage.name() == name);
        found.ok_or_else(|| format!("\"{name}\" is no storage: it is plain, row-displacement or masks"))
    }
}
