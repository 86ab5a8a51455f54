//! Tasks and shares: the units of a frame that one node renders, and parts of them.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{Division, FrameSize, SampleRect, UnitKind, Units};

/// Some units of a frame, in a fixed order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Task {
    /// The units of which a part is taken.
    pub selection: Selection,
    /// The part that is taken.
    pub part: Part,
}

/// Units of a frame, before a part of them is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Selection {
    /// Every `n_machines`-th unit from unit `machine_idx` on: the paper's equations 4 and 5 for samples and tiles.
    Strided {
        /// Whose units these are.
        division: Division,
        /// Index of the machine, from 0.
        machine_idx: u32,
        /// Number of machines.
        n_machines: u32,
    },
    /// A run of tiles along the [`curve`](crate::curve); it may be empty.
    CurveRun(TileRun),
}

/// Tiles `first`, `first + 1`, … along the curve.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileRun {
    /// The first tile.
    pub first: u32,
    /// Number of tiles.
    pub count: u32,
}

/// Every `n_parts`-th unit from the `index`-th on: the task of a lost node is divided among the others in this way.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Index of the part, from 0.
    pub index: u32,
    /// Number of parts.
    pub n_parts: u32,
}

impl Part {
    /// Everything.
    pub const WHOLE: Self = Self { index: 0, n_parts: 1 };

    /// Part `index` of `n_parts` of this part; `None` if the product overflows.
    ///
    /// Unit k of the inner part is unit `index + k·n_parts` of this one, so a part of a part is a part again.
    pub fn of(self, index: u32, n_parts: u32) -> Option<Self> {
        let offset = index.checked_mul(self.n_parts)?;
        Some(Self { index: self.index.checked_add(offset)?, n_parts: self.n_parts.checked_mul(n_parts)? })
    }
}

/// The task does not fit the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum TaskError {
    #[error("machine or part {index} of {count} does not exist")]
    NoSuchPart { index: u32, count: u32 },
    #[error("tile run {first}+{count} does not lie in a frame of {n_tiles} tiles")]
    RunOutside { first: u32, count: u32, n_tiles: u32 },
}

impl Task {
    /// Part `index` of `n_parts` of this task; see [`Part::of`].
    pub fn part(self, index: u32, n_parts: u32) -> Option<Self> {
        Some(Self { part: self.part.of(index, n_parts)?, ..self })
    }

    /// Checks this task against a frame and makes its units addressable.
    pub fn share(&self, size: FrameSize) -> Result<Share, TaskError> {
        let check = |index: u32, count: u32| {
            if index < count { Ok(()) } else { Err(TaskError::NoSuchPart { index, count }) }
        };
        check(self.part.index, self.part.n_parts)?;
        let (units, first, step, n_selected) = match self.selection {
            Selection::Strided { division, machine_idx, n_machines } => {
                check(machine_idx, n_machines)?;
                let units = division.units(size);
                let n_selected = units.count().saturating_sub(machine_idx).div_ceil(n_machines);
                (units, machine_idx, n_machines, n_selected)
            }
            Selection::CurveRun(TileRun { first, count }) => {
                let units = Division::Dynamic.units(size);
                let n_tiles = units.count();
                if first.checked_add(count).is_none_or(|end| end > n_tiles) {
                    return Err(TaskError::RunOutside { first, count, n_tiles });
                }
                (units, first, 1, count)
            }
        };
        let count = n_selected.saturating_sub(self.part.index).div_ceil(self.part.n_parts);
        Ok(Share { units, first, step, part: self.part, count })
    }
}

/// A task checked against a frame: its units by index.
#[derive(Clone, Copy, Debug)]
pub struct Share {
    units: Units,
    first: u32,
    step: u32,
    part: Part,
    count: u32,
}

impl Share {
    /// Number of units of the share.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// All units of the frame.
    pub fn units(&self) -> Units {
        self.units
    }

    /// The frame's samples for each sample of the share if units are single samples; 1 for tiles.
    pub fn sample_stride(&self) -> u32 {
        match self.units.kind {
            UnitKind::Sample => self.step.saturating_mul(self.part.n_parts),
            UnitKind::Tile | UnitKind::CurveTile => 1,
        }
    }

    /// Whether the units are tiles numbered along the curve: their costs divide the next frame.
    pub fn is_on_curve(&self) -> bool {
        self.units.kind == UnitKind::CurveTile
    }

    /// Whether the units follow each other in the frame's numbering.
    pub fn is_contiguous(&self) -> bool {
        self.part.n_parts == 1 && self.step == 1
    }

    /// The frame's number of the share's `k`-th unit; `k` must be below [`Share::count`].
    #[inline]
    pub fn unit(&self, k: u32) -> u32 {
        debug_assert!(k < self.count, "unit {k} of {}", self.count);
        self.first + (self.part.index + k * self.part.n_parts) * self.step
    }

    /// The sample numbers of single-sample units, row by row from the bottom left; `None` if units are tiles.
    #[inline]
    pub fn single_samples(&self, units: Range<u32>) -> Option<impl ExactSizeIterator<Item = u32> + use<>> {
        if self.units.kind != UnitKind::Sample {
            return None;
        }
        // The numbers are one step apart, so only the first two are looked up.
        let first = if units.is_empty() { 0 } else { self.unit(units.start) };
        let step = if units.len() < 2 { 0 } else { self.unit(units.start + 1) - first };
        Some((0..units.len() as u32).map(move |k| first + k * step))
    }

    /// The samples of the share's `k`-th unit.
    #[inline]
    pub fn samples(&self, k: u32) -> SampleRect {
        self.units.samples(self.unit(k))
    }
}
