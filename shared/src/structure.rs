//! How render servers keep a scene, as far as a wall has a say in it: time and memory, never a picture.

use std::{fmt, ops::RangeInclusive, str::FromStr};

use serde::{Deserialize, Serialize};

/// How the cells of a grid are kept in memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Storage {
    /// The paper's uniform grid: an offset for each cell.
    Plain,
    /// The same with the offsets compressed, after Lagae and Dutré (2008).
    RowDisplacement,
    /// A tree of bit masks, divided where it holds much. The only one that packets follow.
    #[default]
    Tree,
}

/// A grid's storage and density.
///
/// Invariant on the wire: the density is one of [`Structure::DENSITIES`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "(Storage, f64)", into = "(Storage, f64)")]
pub struct Structure {
    /// How cells are kept.
    pub storage: Storage,
    /// The paper's ρ: cells per triangle.
    pub density: f64,
}

/// Why a density is none.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{0} cells per triangle: from {least} to {most} are possible",
    least = Structure::DENSITIES.start(), most = Structure::DENSITIES.end())]
pub struct DensityError(f64);

impl Structure {
    /// The densities that can be asked for.
    pub const DENSITIES: RangeInclusive<f64> = 1.0 / 64.0..=4096.0;
}

impl Default for Structure {
    fn default() -> Self {
        Self { storage: Storage::default(), density: 32.0 }
    }
}

impl TryFrom<(Storage, f64)> for Structure {
    type Error = DensityError;

    fn try_from((storage, density): (Storage, f64)) -> Result<Self, DensityError> {
        if Self::DENSITIES.contains(&density) { Ok(Self { storage, density }) } else { Err(DensityError(density)) }
    }
}

impl From<Structure> for (Storage, f64) {
    fn from(Structure { storage, density }: Structure) -> Self {
        (storage, density)
    }
}

impl Storage {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Plain, Self::RowDisplacement, Self::Tree];

    /// As it is written on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::RowDisplacement => "row-displacement",
            Self::Tree => "masks",
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn densities_beyond_the_range_are_refused() {
        for density in [0.0, -1.0, f64::NAN, f64::INFINITY, 4096.1] {
            assert!(Structure::try_from((Storage::Plain, density)).is_err(), "{density}");
        }
        let dense = Structure { storage: Storage::Plain, density: 4096.0 };
        assert_eq!(Structure::try_from(<(Storage, f64)>::from(dense)), Ok(dense));
    }
}
