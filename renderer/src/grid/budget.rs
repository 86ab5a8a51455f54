//! The memory budget of a scene, and the message when it is too small.

use std::{fmt, ops::RangeInclusive, str::FromStr};

use serde::{Deserialize, Serialize};

/// Bytes that a process may take while it loads a scene: the mesh as loaded, the mesh as traced, and the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct MemoryBudget(u64);

impl MemoryBudget {
    /// Valid budgets.
    pub const RANGE: RangeInclusive<Self> = Self(16_000_000)..=Self(1_000_000_000_000);

    /// A budget that fits a machine: three quarters of what is free, in `shared` bytes for `n_programs` and in `own` bytes for one
    /// alone. The rest is for pictures, messages and other programs. Without either, the default.
    pub fn of_machine(shared: Option<u64>, own: Option<u64>, n_programs: u32) -> Self {
        let of_one = shared.map(|bytes| bytes / u64::from(n_programs.max(1)));
        let Some(free) = of_one.into_iter().chain(own).min() else { return Self::default() };
        let range = Self::RANGE;
        Self(rounded_down(free / 4 * 3)).clamp(*range.start(), *range.end())
    }

    /// The least budget, in two digits, in which so many bytes are.
    pub(crate) fn of_at_least(n_bytes: u64) -> Self {
        Self(n_bytes.next_multiple_of(step(n_bytes)))
    }

    /// Bytes left for a grid beside a mesh: at least a quarter of the mesh, as less would save little and be slow.
    pub(crate) fn remaining_beside(self, mesh_bytes: u64) -> u64 {
        if mesh_bytes < self.0 { self.0 - mesh_bytes } else { mesh_bytes / 4 }
    }

    /// Whether it is more than another by a quarter.
    pub(crate) fn clearly_exceeds(self, other: Self) -> bool {
        self.0 > other.0.saturating_add(other.0 / 4)
    }

    /// The budget of another scene beside one of `n_bytes`; `None` if little is left.
    pub(crate) fn beside(self, n_bytes: u64) -> Option<Self> {
        Some(Self(self.0.saturating_sub(n_bytes))).filter(|left| Self::RANGE.contains(left))
    }

    /// The number of bytes.
    pub fn n_bytes(self) -> u64 {
        self.0
    }

    pub(crate) fn is_exceeded_by(self, n_bytes: u64) -> bool {
        self.0 < n_bytes
    }
}

impl Default for MemoryBudget {
    /// The memory of each of the paper's machines.
    fn default() -> Self {
        Self(1_000_000_000)
    }
}

/// The unit of a number's second digit.
fn step(number: u64) -> u64 {
    10u64.pow(number.max(10).ilog10() - 1)
}

fn rounded_down(number: u64) -> u64 {
    number / step(number) * step(number)
}

/// Unit letters, the largest first.
const UNITS: [(char, u64); 4] = [('T', 1_000_000_000_000), ('G', 1_000_000_000), ('M', 1_000_000), ('K', 1_000)];

impl fmt::Display for MemoryBudget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match UNITS.iter().find(|&&(_, unit)| self.0.is_multiple_of(unit)) {
            Some((letter, unit)) => write!(f, "{}{letter}", self.0 / unit),
            None => write!(f, "{}", self.0),
        }
    }
}

impl FromStr for MemoryBudget {
    type Err = String;

    /// Parses integers or decimals, as in 512M or 1.5G.
    fn from_str(text: &str) -> Result<Self, String> {
        let letter = text.chars().last().unwrap_or(' ').to_ascii_uppercase();
        let unit = UNITS.iter().find(|(unit, _)| *unit == letter);
        let number = if unit.is_some() { &text[..text.len() - 1] } else { text };
        let bytes = number.parse::<f64>().map_err(|_| format!("\"{text}\" is no size: write it as 512M or 1.5G"))?;
        let budget = Self((bytes * unit.map_or(1.0, |(_, unit)| *unit as f64)).round() as u64);
        let range = Self::RANGE;
        if range.contains(&budget) {
            Ok(budget)
        } else {
            Err(format!("a size must be from {} to {}", range.start(), range.end()))
        }
    }
}

/// The effect of a memory budget on a grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MemoryShortage {
    pub(crate) budget: MemoryBudget,
    pub(crate) is_coarser: bool,
    /// A budget in which the grid would be whole, if it is known.
    pub(crate) enough: Option<MemoryBudget>,
    /// Bytes that loading the scene may take, if they exceed the budget nevertheless.
    pub(crate) needed_bytes: Option<u64>,
}

impl MemoryShortage {
    /// The part that still matters where the scene is not loaded, but mapped.
    pub(crate) fn of_mapped(self) -> Option<Self> {
        self.is_coarser.then_some(Self { needed_bytes: None, ..self })
    }
}

impl fmt::Display for MemoryShortage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let budget = self.budget;
        let coarser = if self.is_coarser { "the grid is made coarser, and " } else { "" };
        match self.needed_bytes {
            None => write!(f, "the grid is made coarser, to stay within --memory-budget {budget}")?,
            Some(bytes) => {
                let megabytes = bytes.div_ceil(1_000_000);
                write!(f, "{coarser}loading the scene may take {megabytes}M, more than --memory-budget {budget}")?;
            }
        }
        match self.enough {
            Some(enough) => write!(f, ": --memory-budget {enough} is enough, on a machine that has as much free"),
            None => write!(f, ": raise it, on a machine that has more free"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_and_written() {
        for (text, bytes, written) in [
            ("1G", 1_000_000_000, "1G"),
            ("512M", 512_000_000, "512M"),
            ("1.5g", 1_500_000_000, "1500M"),
            ("123456789", 123_456_789, "123456789"),
            ("16000k", 16_000_000, "16M"),
            ("1T", 1_000_000_000_000, "1T"),
        ] {
            let budget: MemoryBudget = text.parse().unwrap();
            assert_eq!((budget.0, budget.to_string().as_str()), (bytes, written));
            assert_eq!(written.parse(), Ok(budget));
        }
    }

    #[test]
    fn a_machine_gives_three_quarters_of_what_is_free() {
        let of = |shared, own, n_programs| MemoryBudget::of_machine(shared, own, n_programs).to_string();
        const G: u64 = 1_000_000_000;
        assert_eq!(of(Some(21 * G), None, 1), "15G");
        assert_eq!(of(Some(21 * G), None, 4), "3900M");
        assert_eq!(of(Some(21 * G), Some(2 * G), 4), "1500M", "of its own, each has less");
        assert_eq!(of(Some(4 * G), Some(2 * G), 4), "750M");
        assert_eq!(of(None, Some(4 * G), 4), "3G");
        assert_eq!(of(Some(5000 * G), None, 1), "1T");
        assert_eq!((of(Some(0), None, 1), of(Some(21 * G), None, 0)), ("16M".to_owned(), "15G".to_owned()));
        assert_eq!(of(None, None, 3), "1G", "the paper's, where nothing is known");
    }

    #[test]
    fn a_budget_that_is_enough_has_two_digits() {
        for (n_bytes, budget) in [(1_234_567_890, "1300M"), (5_000_000_000, "5G"), (5_000_000_001, "5100M")] {
            assert_eq!(MemoryBudget::of_at_least(n_bytes).to_string(), budget);
        }
        assert_eq!(MemoryBudget::of_at_least(3), MemoryBudget(3));
    }

    #[test]
    fn errors_name_the_valid_sizes() {
        for text in ["1K", "0", "-5G", "NaN", "NaNG", "2000G", "2T", "infG"] {
            let error = text.parse::<MemoryBudget>().unwrap_err();
            assert_eq!(error, "a size must be from 16M to 1T", "{text}");
        }
        for text in ["", "G", "1P", "1 GB", "1GB", "ä"] {
            assert!(text.parse::<MemoryBudget>().unwrap_err().contains("no size: write it as 512M"), "{text}");
        }
    }
}
