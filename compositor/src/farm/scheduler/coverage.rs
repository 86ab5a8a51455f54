//! Which units of a frame are in their places.

use shared::division::{Share, Units};

/// A bit for each unit of a frame.
#[derive(Clone, Debug)]
pub(super) struct Coverage {
    words: Vec<u64>,
    n_missing: u32,
}

impl Coverage {
    pub(super) fn new(units: Units) -> Self {
        let n_units = units.count();
        Self { words: vec![0; n_units.div_ceil(64) as usize], n_missing: n_units }
    }

    /// Marks units `first..first + count` of a share.
    pub(super) fn cover(&mut self, share: &Share<'_>, first: u32, count: u32) {
        for unit in (first..first + count).map(|k| share.unit(k)) {
            let (word, bit) = (&mut self.words[unit as usize / 64], 1 << (unit % 64));
            self.n_missing -= u32::from(*word & bit == 0);
            *word |= bit;
        }
    }

    /// Whether no unit of a share is missing.
    pub(super) fn has_all_of(&self, share: &Share<'_>) -> bool {
        (0..share.count()).map(|k| share.unit(k)).all(|unit| self.words[unit as usize / 64] >> (unit % 64) & 1 == 1)
    }

    /// Whether no unit of the frame is missing.
    pub(super) fn is_whole(&self) -> bool {
        self.n_missing == 0
    }
}
