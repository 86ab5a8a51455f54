//! Which units of a work have come.

use std::ops::Range;

/// A bit for each unit of a work, by its place in the work.
#[derive(Clone, Debug)]
pub(super) struct UnitSet {
    words: Vec<u64>,
    n_missing: u32,
}

impl UnitSet {
    /// None of so many units.
    pub(super) fn new(n_units: u32) -> Self {
        Self { words: vec![0; n_units.div_ceil(64) as usize], n_missing: n_units }
    }

    /// Adds units, and says how many of them are new.
    ///
    /// Invariant: they are units of the work.
    pub(super) fn insert(&mut self, units: Range<u32>) -> u32 {
        let mut n_new = 0;
        for (word, mask) in words_of(units) {
            let word = &mut self.words[word];
            n_new += (mask & !*word).count_ones();
            *word |= mask;
        }
        self.n_missing -= n_new;
        n_new
    }

    /// Whether all of these units are in.
    pub(super) fn contains(&self, units: Range<u32>) -> bool {
        words_of(units).all(|(word, mask)| self.words[word] & mask == mask)
    }

    /// How many units are not in.
    pub(super) fn n_missing(&self) -> u32 {
        self.n_missing
    }
}

/// The words that hold these units, and which of their bits do.
fn words_of(units: Range<u32>) -> impl Iterator<Item = (usize, u64)> {
    let words = if units.is_empty() { 0..0 } else { units.start / 64..units.end.div_ceil(64) };
    words.map(move |word| {
        let first = units.start.saturating_sub(word * 64);
        let n_after = ((word + 1) * 64).saturating_sub(units.end);
        (word as usize, u64::MAX << first & u64::MAX >> n_after)
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn it_is_a_set(n_units in 0..300u32, runs in proptest::collection::vec((0..300u32, 0..300u32), 0..20)) {
            let mut truth = std::collections::BTreeSet::new();
            let mut set = UnitSet::new(n_units);
            for (first, count) in runs {
                let units = first.min(n_units)..first.saturating_add(count).min(n_units).max(first.min(n_units));
                prop_assert_eq!(set.contains(units.clone()), units.clone().all(|unit| truth.contains(&unit)));
                let n_before = truth.len();
                truth.extend(units.clone());
                prop_assert_eq!(set.insert(units) as usize, truth.len() - n_before);
                prop_assert_eq!(set.n_missing() as usize, n_units as usize - truth.len());
            }
        }
    }
}
