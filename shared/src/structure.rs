//! The grid options that a wall can choose for its render servers. They change time and memory, never a picture.

use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use crate::names::unknown_name;

/// How the cells of a grid are kept in memory.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    Hash,
    Serialize,
    Deserialize,
    Display,
    EnumString,
    IntoStaticStr,
    VariantArray,
)]
#[strum(serialize_all = "kebab-case", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum Storage {
    /// The paper's uniform grid: an offset for each cell.
    Plain,
    /// The uniform grid with compressed offsets, after Lagae and Dutré (2008).
    RowDisplacement,
    /// A tree of bit masks, subdivided where there are many triangles.
    #[default]
    #[strum(serialize = "masks")]
    Tree,
    /// The same with only what packets need, in larger leaves: the least memory. Rays that go alone take three times as long.
    Compact,
}

impl Storage {
    /// Whether it is a tree, which packets can traverse and scene files hold.
    #[must_use]
    pub fn is_tree(self) -> bool {
        matches!(self, Self::Tree | Self::Compact)
    }
}

/// A grid's storage and density.
///
/// Invariant on the wire: the density is one of [`Structure::DENSITIES`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "(Storage, f64)")]
pub struct Structure {
    /// How the cells are kept.
    pub storage: Storage,
    /// The paper's ρ: cells per triangle.
    pub density: f64,
}

/// The density is out of range.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn densities_beyond_the_range_are_refused() {
        for density in [0.0, -1.0, f64::NAN, f64::INFINITY, 4096.1] {
            assert!(Structure::try_from((Storage::Plain, density)).is_err(), "{density}");
        }
        let dense = Structure { storage: Storage::Plain, density: 4096.0 };
        assert_eq!(Structure::try_from((Storage::Plain, 4096.0)), Ok(dense));
    }
}
