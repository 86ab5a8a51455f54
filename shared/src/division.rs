//! Sort-first division: who renders which samples of a frame.
//!
//! A frame is cut into *units*, numbered from 0: single samples (interleaved) or 8×8 tiles (tiled, and dynamic, where they
//! are numbered along a [`curve`]).
//! [`Work`] picks some of a frame's units in a fixed order, and [`Units::samples`] lists the samples of a unit in a fixed
//! order: together they are the one statement of where the bytes of an answer belong.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::curve;

/// The side of a tile in samples: the paper's, and one tile is one packet of 64 rays.
pub const TILE_SIZE: u32 = 8;

/// The resolution of a frame in samples.
///
/// Invariant: at least 1×1 and at most [`FrameSize::LARGEST`] on either side, so that a sample's index fits in `u32`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(u32, u32)", into = "(u32, u32)")]
pub struct FrameSize {
    xres: u32,
    yres: u32,
}

/// Why two numbers make no frame size.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a frame of {0}×{1} samples: each side must be from 1 to {max}", max = FrameSize::LARGEST)]
pub struct FrameSizeError(u32, u32);

impl TryFrom<(u32, u32)> for FrameSize {
    type Error = FrameSizeError;

    fn try_from((xres, yres): (u32, u32)) -> Result<Self, FrameSizeError> {
        Self::new(xres, yres)
    }
}

impl From<FrameSize> for (u32, u32) {
    fn from(size: FrameSize) -> Self {
        (size.xres, size.yres)
    }
}

impl FrameSize {
    /// The largest side: what GPUs take as a texture, and the bound on what a message can make a peer allocate.
    pub const LARGEST: u32 = 16384;

    /// The paper's frame.
    pub const PAPER: Self = Self { xres: 1024, yres: 512 };

    /// A frame of `xres` × `yres` samples.
    pub fn new(xres: u32, yres: u32) -> Result<Self, FrameSizeError> {
        let valid = 1..=Self::LARGEST;
        if valid.contains(&xres) && valid.contains(&yres) {
            Ok(Self { xres, yres })
        } else {
            Err(FrameSizeError(xres, yres))
        }
    }

    /// Samples in a row.
    pub fn xres(self) -> u32 {
        self.xres
    }

    /// Rows.
    pub fn yres(self) -> u32 {
        self.yres
    }

    /// Samples in all.
    pub fn n_samples(self) -> u32 {
        self.xres * self.yres
    }

    fn x_tiles(self) -> u32 {
        self.xres.div_ceil(TILE_SIZE)
    }

    fn y_tiles(self) -> u32 {
        self.yres.div_ceil(TILE_SIZE)
    }

    fn n_tiles(self) -> u32 {
        self.x_tiles() * self.y_tiles()
    }
}

impl std::str::FromStr for FrameSize {
    type Err = String;

    /// Reads `1024x512`.
    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once(['x', '×']).and_then(|(x, y)| Some((x.parse().ok()?, y.parse().ok()?)));
        let (xres, yres) = sides.ok_or_else(|| format!("\"{text}\" is no size: write it as 1024x512"))?;
        Self::new(xres, yres).map_err(|error| error.to_string())
    }
}

impl std::fmt::Display for FrameSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.xres, self.yres)
    }
}

/// How a frame is divided among machines: by one of the paper's two heuristics, or by what its tiles cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Division {
    /// Sample i goes to machine i mod M.
    Interleaved,
    /// Tile t of 8×8 samples goes to machine t mod M.
    #[default]
    Tiled,
    /// Runs of tiles along a [`curve`], as long as the last frame's costs and the machines' speeds suggest.
    Dynamic,
}

impl Division {
    /// Every division, in the order in which a key steps through them.
    pub const ALL: [Self; 3] = [Self::Interleaved, Self::Tiled, Self::Dynamic];

    /// The name on command lines and on screen.
    pub fn name(self) -> &'static str {
        match self {
            Self::Interleaved => "interleaved",
            Self::Tiled => "tiled",
            Self::Dynamic => "dynamic",
        }
    }

    /// The units that this division cuts a frame into.
    pub fn units(self, size: FrameSize) -> Units {
        let kind = match self {
            Self::Interleaved => UnitKind::Sample,
            Self::Tiled => UnitKind::Tile,
            Self::Dynamic => UnitKind::CurveTile,
        };
        Units { kind, size }
    }

    /// The work of one machine among several of which nothing is known; for [`Division::Dynamic`] every so-many-th tile of
    /// the curve, so that each sees all of the picture.
    pub fn work(self, machine: u32, machines: u32) -> Work {
        let picked = match self {
            Self::Interleaved => Picked::Interleaved { machine, machines },
            Self::Tiled => Picked::Tiled { machine, machines },
            Self::Dynamic => Picked::Curve { machine, machines },
        };
        Work { picked, part: Part::WHOLE }
    }
}

impl std::str::FromStr for Division {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|division| division.name() == text)
            .ok_or_else(|| format!("\"{text}\" is no division: it is interleaved, tiled or dynamic"))
    }
}

/// What a unit is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum UnitKind {
    Sample,
    Tile,
    CurveTile,
}

/// The units of one frame, numbered row by row from the bottom left, or along the curve from there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Units {
    kind: UnitKind,
    size: FrameSize,
}

impl Units {
    /// The frame's size.
    pub fn size(self) -> FrameSize {
        self.size
    }

    /// How many units the frame has.
    pub fn count(self) -> u32 {
        match self.kind {
            UnitKind::Sample => self.size.n_samples(),
            UnitKind::Tile | UnitKind::CurveTile => self.size.n_tiles(),
        }
    }

    /// How many samples a unit has that the frame does not cut off.
    pub fn whole_unit_samples(self) -> u32 {
        match self.kind {
            UnitKind::Sample => 1,
            UnitKind::Tile | UnitKind::CurveTile => TILE_SIZE * TILE_SIZE,
        }
    }

    /// The samples of a unit: columns and rows of the frame, row j = 0 at the bottom.
    ///
    /// Within a unit samples are ordered row by row from the bottom left; tiles at the right and upper edge are cut off
    /// by the frame.
    pub fn samples(self, unit: u32) -> UnitSamples {
        let FrameSize { xres, yres } = self.size;
        let x_tiles = self.size.x_tiles();
        let (side, (column, row)) = match self.kind {
            UnitKind::Sample => (1, (unit % xres, unit / xres)),
            UnitKind::Tile => (TILE_SIZE, (unit % x_tiles, unit / x_tiles)),
            UnitKind::CurveTile => (TILE_SIZE, curve::tile_at(unit, x_tiles, self.size.y_tiles())),
        };
        let (i, j) = (column * side, row * side);
        UnitSamples { columns: i..(i + side).min(xres), rows: j..(j + side).min(yres) }
    }
}

/// The block of samples that makes up one unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnitSamples {
    /// Columns, from the left.
    pub columns: Range<u32>,
    /// Rows, from the bottom.
    pub rows: Range<u32>,
}

impl UnitSamples {
    /// How many samples.
    pub fn count(&self) -> u32 {
        self.columns.len() as u32 * self.rows.len() as u32
    }

    /// Every sample (i, j), in the order of an answer's bytes.
    pub fn iter(&self) -> impl Iterator<Item = (u32, u32)> + use<> {
        let columns = self.columns.clone();
        self.rows.clone().flat_map(move |j| columns.clone().map(move |i| (i, j)))
    }
}

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
    /// The tiles that are number t along the [`curve`], t mod machines = machine, ascending.
    Curve {
        /// Which machine, from 0.
        machine: u32,
        /// How many machines.
        machines: u32,
    },
    /// A run of tiles along the [`curve`]; it may be empty.
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

    /// The samples of the share's `k`-th unit.
    #[inline]
    pub fn samples(&self, k: u32) -> UnitSamples {
        self.units.samples(self.unit(k))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// How often each sample of a frame is in the given works.
    fn coverage(works: &[Work], size: FrameSize) -> Vec<u32> {
        let mut times = vec![0; size.n_samples() as usize];
        for work in works {
            let share = work.share(size).unwrap();
            for (i, j) in (0..share.count()).flat_map(|k| share.samples(k).iter()) {
                times[(j * size.xres() + i) as usize] += 1;
            }
        }
        times
    }

    #[test]
    fn the_papers_example_holds() {
        let size = FrameSize::PAPER;
        let interleaved = Division::Interleaved.work(1, 12);
        assert_eq!(interleaved.share(size).unwrap().unit(1), 13);
        let tiled = Division::Tiled.work(0, 12);
        let share = tiled.share(size).unwrap();
        assert_eq!(share.unit(1), 12);
        assert_eq!(share.samples(1), UnitSamples { columns: 96..104, rows: 0..8 });
        assert_eq!(share.samples(1).iter().nth(9), Some((97, 1)));
    }

    #[test]
    fn works_that_do_not_fit_are_refused() {
        let size = FrameSize::new(16, 16).unwrap();
        assert!(Division::Tiled.work(3, 3).share(size).is_err());
        assert!(Division::Interleaved.work(0, 0).share(size).is_err());
        assert!(
            Work { picked: Picked::Tiled { machine: 0, machines: 1 }, part: Part { index: 1, parts: 1 } }
                .share(size)
                .is_err()
        );
        let runs = |runs: &[(u32, u32)]| Work {
            picked: Picked::TileRuns(runs.iter().map(|&(first, count)| TileRun { first, count }).collect()),
            part: Part::WHOLE,
        };
        assert_eq!(runs(&[(3, 1), (0, 2)]).share(size).unwrap().count(), 3);
        assert!(runs(&[(3, 2)]).share(size).is_err());
        assert!(runs(&[(u32::MAX, 2)]).share(size).is_err());
        assert!(runs(&[(0, 0)]).share(size).is_err());
        assert_eq!(runs(&[(0, 4), (1, 1)]).share(size).unwrap_err(), WorkError::TooManyTiles);
        let run = |first, count| Work { picked: Picked::CurveRun(TileRun { first, count }), part: Part::WHOLE };
        assert_eq!(run(4, 0).share(size).unwrap().count(), 0);
        assert!(run(3, 2).share(size).is_err());
        assert!(run(u32::MAX, 2).share(size).is_err());
    }

    #[test]
    fn machines_beyond_the_units_have_nothing_to_do() {
        let size = FrameSize::new(3, 1).unwrap();
        assert_eq!(Division::Interleaved.work(3, 9).share(size).unwrap().count(), 0);
        assert_eq!(Division::Tiled.work(8, 9).share(size).unwrap().count(), 0);
    }

    proptest! {
        #[test]
        fn every_division_covers_every_sample_once(
            xres in 1..70u32, yres in 1..50u32, machines in 1..20u32, division in 0..3usize,
            lost in 0..20u32, parts in 1..6u32,
        ) {
            let size = FrameSize::new(xres, yres).unwrap();
            let division = Division::ALL[division];
            let mut works: Vec<_> = (0..machines).map(|machine| division.work(machine, machines)).collect();
            prop_assert!(coverage(&works, size).iter().all(|&times| times == 1));
            // A lost machine's share is divided again, and so is a part of that.
            let lost = works.swap_remove((lost % machines) as usize);
            works.extend((0..parts).map(|index| lost.part(index, parts).unwrap()));
            let lost_again = works.pop().unwrap();
            works.extend((0..3).map(|index| lost_again.part(index, 3).unwrap()));
            prop_assert!(coverage(&works, size).iter().all(|&times| times == 1));
        }

        #[test]
        fn tile_runs_cover_what_they_name(xres in 1..70u32, yres in 1..50u32, cut in 0..100u32, parts in 1..4u32) {
            let size = FrameSize::new(xres, yres).unwrap();
            let n_tiles = Division::Tiled.units(size).count();
            let cut = cut % n_tiles;
            let runs = [TileRun { first: cut, count: n_tiles - cut }, TileRun { first: 0, count: cut }];
            let picked = Picked::TileRuns(runs.into_iter().filter(|run| run.count > 0).collect());
            let works: Vec<_> = (0..parts)
                .map(|index| Work { picked: picked.clone(), part: Part { index, parts } })
                .collect();
            prop_assert!(coverage(&works, size).iter().all(|&times| times == 1));
        }

        #[test]
        fn runs_of_the_curve_cover_every_sample_once(
            xres in 1..200u32, yres in 1..200u32, cuts in proptest::collection::vec(0..1000u32, 0..6), parts in 1..4u32,
        ) {
            let size = FrameSize::new(xres, yres).unwrap();
            let n_tiles = Division::Dynamic.units(size).count();
            let mut cuts: Vec<_> = cuts.iter().map(|cut| cut * n_tiles / 1000).chain([0, n_tiles]).collect();
            cuts.sort_unstable();
            let runs = cuts.windows(2).map(|ends| TileRun { first: ends[0], count: ends[1] - ends[0] });
            let works: Vec<_> = runs
                .flat_map(|run| (0..parts).map(move |index| (run, Part { index, parts })))
                .map(|(run, part)| Work { picked: Picked::CurveRun(run), part })
                .collect();
            prop_assert!(coverage(&works, size).iter().all(|&times| times == 1));
        }
    }
}
