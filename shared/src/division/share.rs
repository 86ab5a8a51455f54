//! Shares of a frame: what one machine is given, and parts of that.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{Division, FrameSize, SampleRect, UnitKind, Units};

/// A share of a frame: some of its units, in a fixed order.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Task {
    /// Which units before the part is taken.
    pub selection: Selection,
    /// Which of those.
    pub part: Part,
}

/// Units of a frame, before a part of them is taken.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Selection {
    /// The samples i with i mod machines = machine, ascending: the paper's equation 4.
    Interleaved {
        /// Which machine, from 0.
        machine_idx: u32,
        /// How many machines.
        n_machines: u32,
    },
    /// The tiles t with t mod machines = machine, ascending: the paper's equation 5.
    Tiled {
        /// Which machine, from 0.
        machine_idx: u32,
        /// How many machines.
        n_machines: u32,
    },
    /// Runs of tiles, in the order given.
    TileRuns(Vec<TileRun>),
    /// The tiles that are number t along the [`curve`](crate::curve), t mod machines = machine, ascending.
    Curve {
        /// Which machine, from 0.
        machine_idx: u32,
        /// How many machines.
        n_machines: u32,
    },
    /// A run of tiles along the [`curve`](crate::curve); it may be empty.
    CurveRun(TileRun),
}

/// Tiles `first`, `first + 1`, …
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileRun {
    /// The first tile.
    pub first: u32,
    /// How many.
    pub count: u32,
}

/// Every `n_parts`-th unit from the `index`-th on: how the share of a lost machine is divided again among the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Which part, from 0.
    pub index: u32,
    /// How many parts.
    pub n_parts: u32,
}

impl Part {
    /// Everything.
    pub const WHOLE: Self = Self { index: 0, n_parts: 1 };

    /// Part `index` of `n_parts` of this part.
    ///
    /// Unit k of the inner part is unit `index + k·n_parts` of this one, so parts of parts are parts again.
    /// `None` when the product no longer fits.
    pub fn of(self, index: u32, n_parts: u32) -> Option<Self> {
        let offset = index.checked_mul(self.n_parts)?;
        Some(Self { index: self.index.checked_add(offset)?, n_parts: self.n_parts.checked_mul(n_parts)? })
    }
}

/// Why a work does not fit a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TaskError {
    /// Machine or part is not below its count, or a count is 0.
    #[error("machine or part {index} of {count} does not exist")]
    NoSuchPart {
        /// From 0.
        index: u32,
        /// How many there are.
        count: u32,
    },
    /// A run of tiles leaves the frame, or is one of several and empty.
    #[error("tile run {first}+{count} does not lie in a frame of {n_tiles} tiles")]
    RunOutside {
        /// The run's first tile.
        first: u32,
        /// The run's length.
        count: u32,
        /// The frame's tiles.
        n_tiles: u32,
    },
    /// Runs hold more tiles than the frame has, so some tile would be rendered twice.
    #[error("the runs hold more tiles than the frame")]
    TooManyTiles,
}

impl Task {
    /// The same work, as part `index` of `n_parts` of it; see [`Part::of`].
    pub fn part(&self, index: u32, n_parts: u32) -> Option<Self> {
        Some(Self { selection: self.selection.clone(), part: self.part.of(index, n_parts)? })
    }

    /// Checks this work against a frame and makes its units addressable.
    pub fn share(&self, size: FrameSize) -> Result<Share<'_>, TaskError> {
        let check = |index: u32, count: u32| {
            if index < count { Ok(()) } else { Err(TaskError::NoSuchPart { index, count }) }
        };
        check(self.part.index, self.part.n_parts)?;
        let strided = |machine_idx: u32, n_machines: u32, units: Units| {
            check(machine_idx, n_machines)?;
            Ok((
                units,
                UnitSource::Strided { first: machine_idx, step: n_machines },
                units.count().saturating_sub(machine_idx).div_ceil(n_machines),
            ))
        };
        let (units, source, n_selected) = match &self.selection {
            Selection::Interleaved { machine_idx, n_machines } => {
                strided(*machine_idx, *n_machines, Division::Interleaved.units(size))?
            }
            Selection::Tiled { machine_idx, n_machines } => {
                strided(*machine_idx, *n_machines, Division::Tiled.units(size))?
            }
            Selection::TileRuns(runs) => {
                let units = Division::Tiled.units(size);
                let (ends, n_selected) = run_ends(runs, units.count())?;
                (units, UnitSource::Runs { runs, ends }, n_selected)
            }
            Selection::Curve { machine_idx, n_machines } => {
                strided(*machine_idx, *n_machines, Division::Dynamic.units(size))?
            }
            Selection::CurveRun(TileRun { first, count }) => {
                let units = Division::Dynamic.units(size);
                let (first, count, n_tiles) = (*first, *count, units.count());
                if first.checked_add(count).is_none_or(|end| end > n_tiles) {
                    return Err(TaskError::RunOutside { first, count, n_tiles });
                }
                (units, UnitSource::Strided { first, step: 1 }, count)
            }
        };
        let count = n_selected.saturating_sub(self.part.index).div_ceil(self.part.n_parts);
        Ok(Share { units, source, part: self.part, count })
    }
}

/// The number of tiles up to the end of each run, and in all.
fn run_ends(runs: &[TileRun], n_tiles: u32) -> Result<(Vec<u32>, u32), TaskError> {
    let mut total = 0;
    let mut ends = Vec::with_capacity(runs.len());
    for &TileRun { first, count } in runs {
        let inside = count > 0 && first.checked_add(count).is_some_and(|end| end <= n_tiles);
        if !inside {
            return Err(TaskError::RunOutside { first, count, n_tiles });
        }
        total += count;
        if total > n_tiles {
            return Err(TaskError::TooManyTiles);
        }
        ends.push(total);
    }
    Ok((ends, total))
}

/// A work checked against a frame: its units by their place in the work.
#[derive(Clone, Debug)]
pub struct Share<'a> {
    units: Units,
    source: UnitSource<'a>,
    part: Part,
    count: u32,
}

#[derive(Clone, Debug)]
enum UnitSource<'a> {
    Strided { first: u32, step: u32 },
    Runs { runs: &'a [TileRun], ends: Vec<u32> },
}

impl Share<'_> {
    /// How many units the share has.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// The frame's units, of which this share holds some.
    pub fn units(&self) -> Units {
        self.units
    }

    /// How many of the frame's samples there are to each of this share's, where it has any: 1 within tiles.
    pub fn sample_stride(&self) -> u32 {
        match (&self.source, self.units.kind) {
            (UnitSource::Strided { step, .. }, UnitKind::Sample) => step.saturating_mul(self.part.n_parts),
            _ => 1,
        }
    }

    /// Whether the units are tiles numbered along the curve: those of which render servers report what they cost.
    pub fn is_on_curve(&self) -> bool {
        self.units.kind == UnitKind::CurveTile
    }

    /// Whether each unit's number is that of the one before and 1.
    pub fn is_contiguous(&self) -> bool {
        self.part.n_parts == 1 && matches!(self.source, UnitSource::Strided { step: 1, .. })
    }

    /// The frame's number of the share's `k`-th unit; `k` must be below [`Share::count`].
    #[inline]
    pub fn unit(&self, k: u32) -> u32 {
        debug_assert!(k < self.count, "unit {k} of {}", self.count);
        let selection = self.part.index + k * self.part.n_parts;
        match &self.source {
            UnitSource::Strided { first, step } => first + selection * step,
            UnitSource::Runs { runs, ends } => {
                let run = ends.partition_point(|&end| end <= selection);
                runs[run].first + (selection - (ends[run] - runs[run].count))
            }
        }
    }

    /// The numbers of samples, row by row from the bottom left, that units are; `None` if units are blocks of samples.
    #[inline]
    pub fn single_samples(&self, units: Range<u32>) -> Option<impl ExactSizeIterator<Item = u32>> {
        if self.units.kind != UnitKind::Sample {
            return None;
        }
        // They are one step apart: what picks them is not asked for each.
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
