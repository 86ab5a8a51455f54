//! Which units of a frame are in their places.

use std::ops::Range;

use shared::division::{Part, Work};

use crate::farm::unit_set::UnitSet;

/// A frame as the works that it was first divided into; what was given out later are parts of those.
#[derive(Clone, Debug, Default)]
pub(super) struct Coverage {
    shares: Vec<UnitSet>,
    n_missing: u32,
}

/// A part of one of the works that the frame was first divided into.
#[derive(Clone, Debug)]
pub(super) struct Piece {
    /// Which one, in the order in which they were added.
    share: usize,
    pub(super) work: Work,
    n_units: u32,
}

impl Piece {
    /// Part `index` of `parts` of this one.
    pub(super) fn part(&self, index: u32, parts: u32) -> Option<Self> {
        let n_units = self.n_units.saturating_sub(index).div_ceil(parts);
        Some(Self { share: self.share, work: self.work.part(index, parts)?, n_units })
    }
}

impl Coverage {
    /// Adds a work of so many units: together those that are added hold each unit of the frame once.
    pub(super) fn add(&mut self, work: Work, n_units: u32) -> Piece {
        debug_assert_eq!(work.part, Part::WHOLE, "a frame is divided into whole works");
        self.shares.push(UnitSet::new(n_units));
        self.n_missing += n_units;
        Piece { share: self.shares.len() - 1, work, n_units }
    }

    /// How many works the frame was first divided into.
    pub(super) fn n_shares(&self) -> usize {
        self.shares.len()
    }

    /// Marks units of a piece, by their places in it.
    pub(super) fn cover(&mut self, piece: &Piece, units: Range<u32>) {
        let share = &mut self.shares[piece.share];
        let n_new: u32 = runs(piece.work.part, units).map(|run| share.insert(run)).sum();
        self.n_missing -= n_new;
    }

    /// Whether none of a piece's units is missing.
    pub(super) fn has_all_of(&self, piece: &Piece) -> bool {
        let share = &self.shares[piece.share];
        share.n_missing() == 0 || runs(piece.work.part, 0..piece.n_units).all(|run| share.contains(run))
    }

    /// Whether no unit of the frame is missing.
    pub(super) fn is_whole(&self) -> bool {
        self.n_missing == 0
    }
}

/// Where the units of a part lie in the whole: at once, or one by one.
fn runs(Part { index, parts }: Part, units: Range<u32>) -> impl Iterator<Item = Range<u32>> {
    let (n_runs, n_per_run) = if parts == 1 { (1, units.len() as u32) } else { (units.len() as u32, 1) };
    (0..n_runs).map(move |run| {
        let first = index + (units.start + run) * parts;
        first..first + n_per_run
    })
}
