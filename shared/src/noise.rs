//! The noise that a picture may keep.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

/// A pixel of a path-traced picture whose noise is estimated to be this or less after eight samples of four rays gets no more:
/// root of the mean square, over channels and neighbours, of the error of the mean, three parts of it from encoded values, and one
/// from linear light. It may be more after more rays, in proportion to the root of their number.
///
/// Invariant, on the wire too: at most 100 levels of the 255 that a channel has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "u16")]
pub struct NoiseLimit {
    centilevels: u16,
}

/// The limit is out of range, or no number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("noise is from 0 to 100 levels of 255, with at most two decimals; with 0, all pixels get all samples")]
pub struct NoiseLimitError;

impl NoiseLimit {
    /// No noise is little enough: every pixel gets all samples.
    pub const NONE: Self = Self { centilevels: 0 };

    /// Hundredths of a level, 0 to 10,000.
    pub fn centilevels(self) -> u16 {
        self.centilevels
    }
}

impl Default for NoiseLimit {
    /// Noise that is hardly seen.
    fn default() -> Self {
        Self { centilevels: 150 }
    }
}

impl TryFrom<u16> for NoiseLimit {
    type Error = NoiseLimitError;

    fn try_from(centilevels: u16) -> Result<Self, NoiseLimitError> {
        if centilevels <= 10_000 { Ok(Self { centilevels }) } else { Err(NoiseLimitError) }
    }
}

impl FromStr for NoiseLimit {
    type Err = NoiseLimitError;

    fn from_str(text: &str) -> Result<Self, NoiseLimitError> {
        let hundredths = text.trim().parse::<f64>().map_err(|_| NoiseLimitError)? * 100.0;
        let is_exact = (hundredths - hundredths.round()).abs() < 1e-6 && (0.0..=10_000.0).contains(&hundredths);
        if is_exact { (hundredths.round() as u16).try_into() } else { Err(NoiseLimitError) }
    }
}

impl fmt::Display for NoiseLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (f64::from(self.centilevels) / 100.0).fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_hundredths_of_levels() {
        for (text, centilevels) in [
            ("0", Some(0)),
            ("0.5", Some(50)),
            ("1.07", Some(107)),
            ("100", Some(10_000)),
            ("100.01", None),
            ("0.001", None),
            ("-1", None),
            ("NaN", None),
            ("", None),
        ] {
            assert_eq!(text.parse().ok().map(NoiseLimit::centilevels), centilevels, "{text}");
        }
        assert_eq!(NoiseLimit::default().to_string().parse(), Ok(NoiseLimit::default()));
    }
}
