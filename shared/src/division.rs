//! Sort-first division: which node renders which samples of a frame.
//!
//! A frame is cut into *units*, numbered from 0: single samples (interleaved) or 8×8 tiles (tiled, and dynamic, which
//! numbers them along a [`curve`]).
//! [`Task`] selects units of a frame in a fixed order, and [`Units::samples`] lists the samples of a unit in a fixed
//! order: together they define the order of the bytes in an answer.

mod frame_size;
mod share;

use std::ops::Range;

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

pub use self::{
    frame_size::{FrameSize, FrameSizeError},
    share::{Part, Selection, Share, Task, TaskError, TileRun},
};
use crate::{curve, names::unknown_name};

/// The side of a tile in samples, as in the paper: one tile is one packet of 64 rays.
pub const TILE_SIZE: u32 = 8;

/// How a frame is divided among machines: by one of the paper's two heuristics, or by the cost of its tiles.
///
/// A key steps through the variants in this order.
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
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum Division {
    /// Sample i goes to machine i mod M.
    Interleaved,
    /// Tile t of 8×8 samples goes to machine t mod M.
    #[default]
    Tiled,
    /// Runs of tiles along a [`curve`]; the last frame's costs and the machines' speeds set their lengths.
    Dynamic,
}

impl Division {
    /// The units that this division cuts a frame into.
    pub fn units(self, size: FrameSize) -> Units {
        let kind = match self {
            Self::Interleaved => UnitKind::Sample,
            Self::Tiled => UnitKind::Tile,
            Self::Dynamic => UnitKind::CurveTile,
        };
        Units { kind, size }
    }

    /// The task of machine `machine_idx` among `n_machines` of unknown speed.
    ///
    /// [`Division::Dynamic`] gives each machine every `n_machines`-th tile of the curve, so that each samples the whole
    /// picture.
    pub fn task(self, machine_idx: u32, n_machines: u32) -> Task {
        Task { selection: Selection::Strided { division: self, machine_idx, n_machines }, part: Part::WHOLE }
    }
}

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

    /// Number of units of the frame.
    pub fn count(self) -> u32 {
        match self.kind {
            UnitKind::Sample => self.size.n_samples(),
            UnitKind::Tile | UnitKind::CurveTile => self.size.n_tiles(),
        }
    }

    /// Number of samples of a unit that the frame's edge does not cut.
    pub fn samples_per_full_unit(self) -> u32 {
        match self.kind {
            UnitKind::Sample => 1,
            UnitKind::Tile | UnitKind::CurveTile => TILE_SIZE * TILE_SIZE,
        }
    }

    /// The samples of a unit: columns and rows of the frame, row j = 0 at the bottom.
    ///
    /// Within a unit, samples are ordered row by row from the bottom left. The frame cuts off tiles at its right and upper
    /// edges.
    #[inline]
    pub fn samples(self, unit: u32) -> SampleRect {
        let (xres, yres) = self.size.into();
        let x_tiles = self.size.x_tiles();
        let (side, (column, row)) = match self.kind {
            UnitKind::Sample => (1, (unit % xres, unit / xres)),
            UnitKind::Tile => (TILE_SIZE, (unit % x_tiles, unit / x_tiles)),
            UnitKind::CurveTile => (TILE_SIZE, curve::tile_at(unit, x_tiles, self.size.y_tiles())),
        };
        let (i, j) = (column * side, row * side);
        SampleRect { columns: i..(i + side).min(xres), rows: j..(j + side).min(yres) }
    }
}

/// The samples of one unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SampleRect {
    /// Columns, from the left.
    pub columns: Range<u32>,
    /// Rows, from the bottom.
    pub rows: Range<u32>,
}

impl SampleRect {
    /// Number of samples.
    #[inline]
    pub fn count(&self) -> u32 {
        self.columns.len() as u32 * self.rows.len() as u32
    }

    /// Every sample (i, j), in the order of an answer's bytes.
    pub fn iter(&self) -> impl Iterator<Item = (u32, u32)> + use<> {
        let columns = self.columns.clone();
        self.rows.clone().flat_map(move |j| columns.clone().map(move |i| (i, j)))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The number of given tasks that hold each sample of a frame.
    fn coverage(tasks: &[Task], size: FrameSize) -> Vec<u32> {
        let mut times = vec![0; size.n_samples() as usize];
        for task in tasks {
            let share = task.share(size).unwrap();
            for (i, j) in (0..share.count()).flat_map(|k| share.samples(k).iter()) {
                times[(j * size.xres() + i) as usize] += 1;
            }
        }
        times
    }

    #[test]
    fn the_papers_example_holds() {
        let size = FrameSize::PAPER;
        let interleaved = Division::Interleaved.task(1, 12);
        assert_eq!(interleaved.share(size).unwrap().unit(1), 13);
        let tiled = Division::Tiled.task(0, 12);
        let share = tiled.share(size).unwrap();
        assert_eq!(share.unit(1), 12);
        assert_eq!(share.samples(1), SampleRect { columns: 96..104, rows: 0..8 });
        assert_eq!(share.samples(1).iter().nth(9), Some((97, 1)));
    }

    #[test]
    fn tasks_that_do_not_fit_are_refused() {
        let size = FrameSize::new(16, 16).unwrap();
        assert!(Division::Tiled.task(3, 3).share(size).is_err());
        assert!(Division::Interleaved.task(0, 0).share(size).is_err());
        let no_such_part = Task { part: Part { index: 1, n_parts: 1 }, ..Division::Tiled.task(0, 1) };
        assert!(no_such_part.share(size).is_err());
        let run = |first, count| Task { selection: Selection::CurveRun(TileRun { first, count }), part: Part::WHOLE };
        assert_eq!(run(4, 0).share(size).unwrap().count(), 0);
        assert!(run(3, 2).share(size).is_err());
        assert!(run(u32::MAX, 2).share(size).is_err());
    }

    #[test]
    fn machines_beyond_the_units_have_nothing_to_do() {
        let size = FrameSize::new(3, 1).unwrap();
        assert_eq!(Division::Interleaved.task(3, 9).share(size).unwrap().count(), 0);
        assert_eq!(Division::Tiled.task(8, 9).share(size).unwrap().count(), 0);
    }

    proptest! {
        #[test]
        fn every_division_covers_every_sample_once(
            xres in 1..70u32, yres in 1..50u32, n_machines in 1..20u32, division in 0..3usize,
            lost in 0..20u32, n_parts in 1..6u32,
        ) {
            let size = FrameSize::new(xres, yres).unwrap();
            let division = Division::VARIANTS[division];
            let mut tasks: Vec<_> = (0..n_machines).map(|machine_idx| division.task(machine_idx, n_machines)).collect();
            prop_assert!(coverage(&tasks, size).iter().all(|&times| times == 1));
            // A lost machine's share is divided again, and so is a part of that.
            let lost = tasks.swap_remove((lost % n_machines) as usize);
            tasks.extend((0..n_parts).map(|index| lost.part(index, n_parts).unwrap()));
            let lost_again = tasks.pop().unwrap();
            tasks.extend((0..3).map(|index| lost_again.part(index, 3).unwrap()));
            prop_assert!(coverage(&tasks, size).iter().all(|&times| times == 1));
        }

        #[test]
        fn runs_of_the_curve_cover_every_sample_once(
            xres in 1..200u32, yres in 1..200u32, cuts in proptest::collection::vec(0..1000u32, 0..6), n_parts in 1..4u32,
        ) {
            let size = FrameSize::new(xres, yres).unwrap();
            let n_tiles = Division::Dynamic.units(size).count();
            let mut cuts: Vec<_> = cuts.iter().map(|cut| cut * n_tiles / 1000).chain([0, n_tiles]).collect();
            cuts.sort_unstable();
            let runs = cuts.windows(2).map(|ends| TileRun { first: ends[0], count: ends[1] - ends[0] });
            let tasks: Vec<_> = runs
                .flat_map(|run| (0..n_parts).map(move |index| (run, Part { index, n_parts })))
                .map(|(run, part)| Task { selection: Selection::CurveRun(run), part })
                .collect();
            prop_assert!(coverage(&tasks, size).iter().all(|&times| times == 1));
        }
    }
}
