//! Shares of a frame: what one machine is given, and parts of that.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{Division, FrameSize, UnitKind, UnitSamples, Units};

/// A share of a frame: some of its units, in a fixed order.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Work {
    /// Which units before the part is taken.
    pub picked: Picked,
    /// Which of those.
    pub part: Part,
}

/// Units of a frame, before a part of them is taken.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Picked {
    /// The samples i with i mod machines = machine, ascending: the paper's equation 4.
    Interleaved {
        /// Which machine, from 0.
        machine: u32,
        /// How many machines.
        machines: u32,
    },
    /// The tiles t with t mod machines = machine, ascending: the paper's equation 5.
    Tiled {
        /// Which machine, from 0.
        machine: u32,
        /// How many machines.
        machines: u32,
    },
    /// Runs of tiles, in the order given.
    TileRuns(Vec<TileRun>),
    /// The tiles that are number t along the [`curve`](crate::curve), t mod machines = machine, ascending.
    Curve {
        /// Which machine, from 0.
        machine: u32,
        /// How many machines.
        machines: u32,
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

/// Every `parts`-th unit from the `index`-th on: how the share of a lost machine is divided again among the others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Part {
    /// Which part, from 0.
    pub index: u32,
    /// How many parts.
    pub parts: u32,
}

impl Part {
    /// Everything.
    pub const WHOLE: Self = Self { index: 0, parts: 1 };

    /// Part `index` of `parts` of this part.
    ///
    /// Unit k of the inner part is unit `index + k·parts` of this one, so parts of parts are parts again.
    /// `None` when the product no longer fits.
    pub fn of(self, index: u32, parts: u32) -> Option<Self> {
        let offset = index.checked_mul(self.parts)?;
        Some(Self { index: self.index.checked_add(offset)?, parts: self.parts.checked_mul(parts)? })
    }
}

/// Why a work does not fit a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WorkError {
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

impl Work {
    /// The same work, as part `index` of `parts` of it; see [`Part::of`].
    pub fn part(&self, index: u32, parts: u32) -> Option<Self> {
        Some(Self { picked: self.picked.clone(), part: self.part.of(index, parts)? })
    }

    /// Checks this work against a frame and makes its units addressable.
    pub fn share(&self, size: FrameSize) -> Result<Share<'_>, WorkError> {
        let check = |index: u32, count: u32| {
            if index < count { Ok(()) } else { Err(WorkError::NoSuchPart { index, count }) }
        };
        check(self.part.index, self.part.parts)?;
        let strided = |machine: u32, machines: u32, units: Units| {
            check(machine, machines)?;
            Ok((
                units,
                Source::Strided { first: machine, step: machines },
                units.count().saturating_sub(machine).div_ceil(machines),
            ))
        };
        let (units, source, n_picked) = match &self.picked {
            Picked::Interleaved { machine, machines } => {
                strided(*machine, *machines, Division::Interleaved.units(size))?
            }
            Picked::Tiled { machine, machines } => strided(*machine, *machines, Division::Tiled.units(size))?,
            Picked::TileRuns(runs) => {
                let units = Division::Tiled.units(size);
                let (ends, n_picked) = run_ends(runs, units.count())?;
                (units, Source::Runs { runs, ends }, n_picked)
            }
            Picked::Curve { machine, machines } => strided(*machine, *machines, Division::Dynamic.units(size))?,
            Picked::CurveRun(TileRun { first, count }) => {
                let units = Division::Dynamic.units(size);
                let (first, count, n_tiles) = (*first, *count, units.count());
                if first.checked_add(count).is_none_or(|end| end > n_tiles) {
                    return Err(WorkError::RunOutside { first, count, n_tiles });
                }
                (units, Source::Strided { first, step: 1 }, count)
            }
        };
        let count = n_picked.saturating_sub(self.part.index).div_ceil(self.part.parts);
        Ok(Share { units, source, part: self.part, count })
    }
}

/// The number of tiles up to the end of each run, and in all.
fn run_ends(runs: &[TileRun], n_tiles: u32) -> Result<(Vec<u32>, u32), WorkError> {
    let mut total = 0;
    let mut ends = Vec::with_capacity(runs.len());
    for &TileRun { first, count } in runs {
        let inside = count > 0 && first.checked_add(count).is_some_and(|end| end <= n_tiles);
        if !inside {
            return Err(WorkError::RunOutside { first, count, n_tiles });
        }
        total += count;
        if total > n_tiles {
            return Err(WorkError::TooManyTiles);
        }
        ends.push(total);
    }
    Ok((ends, total))
}

/// A work checked against a frame: its units by their place in the work.
#[derive(Clone, Debug)]
pub struct Share<'a> {
    units: Units,
    source: Source<'a>,
    part: Part,
    count: u32,
}

#[derive(Clone, Debug)]
enum Source<'a> {
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
    pub fn spread(&self) -> u32 {
        match (&self.source, self.units.kind) {
            (Source::Strided { step, .. }, UnitKind::Sample) => step.saturating_mul(self.part.parts),
            _ => 1,
        }
    }

    /// Whether the units are tiles numbered along the curve: those of which render servers report what they cost.
    pub fn is_on_curve(&self) -> bool {
        self.units.kind == UnitKind::CurveTile
    }

    /// Whether each unit's number is that of the one before and 1.
    pub fn is_run(&self) -> bool {
        self.part.parts == 1 && matches!(self.source, Source::Strided { step: 1, .. })
    }

    /// The frame's number of the share's `k`-th unit; `k` must be below [`Share::count`].
    #[inline]
    pub fn unit(&self, k: u32) -> u32 {
        debug_assert!(k < self.count, "unit {k} of {}", self.count);
        let picked = self.part.index + k * self.part.parts;
        match &self.source {
            Source::Strided { first, step } => first + picked * step,
            Source::Runs { runs, ends } => {
                let run = ends.partition_point(|&end| end <= picked);
                runs[run].first + (picked - (ends[run] - runs[run].count))
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
    pub fn samples(&self, k: u32) -> UnitSamples {
        self.units.samples(self.unit(k))
    }
}
