//! The inks of patterns of light: black, white, greys, and stripes and dots whose light is known.

/// What a square without a dot shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::calibration) enum Ink {
    /// This value everywhere.
    Grey(u8),
    /// White without red, green or blue, by index.
    Without(u8),
    /// Every second row is white.
    Rows,
    /// Every second column is white.
    Columns,
    /// One of four pixels is white.
    Quarter,
    /// Three of four pixels are white.
    ThreeQuarters,
}

/// Inks of squares that are dark in other patterns; black is the most frequent, because the dimmest light is the hardest to
/// measure. All are much darker than [`BRIGHT`], so that crossings are found.
const DARK: [Ink; 5] = [Ink::Grey(0), Ink::Grey(0), Ink::Quarter, Ink::Grey(64), Ink::Grey(96)];
/// Inks of squares that are white in other patterns.
const BRIGHT: [Ink; 12] = [
    Ink::Grey(255),
    Ink::Grey(255),
    Ink::Grey(255),
    Ink::ThreeQuarters,
    Ink::Rows,
    Ink::Columns,
    Ink::Grey(160),
    Ink::Grey(192),
    Ink::Grey(224),
    Ink::Without(0),
    Ink::Without(1),
    Ink::Without(2),
];

/// The greys whose light the projector's gamma tells.
pub(super) const GREYS: [u8; 5] = [64, 96, 160, 192, 224];

impl Ink {
    /// The ink of a bright or a dark square, by any number.
    pub(in crate::calibration) fn any(is_bright: bool, number: u64) -> Self {
        let inks: &[Self] = if is_bright { &BRIGHT } else { &DARK };
        inks[(number % inks.len() as u64) as usize]
    }

    /// Red, green and blue of a projector's pixel.
    pub(in crate::calibration) fn value(self, [column, row]: [u32; 2]) -> [u8; 3] {
        let is_white = match self {
            Self::Grey(value) => return [value; 3],
            Self::Without(channel) => return std::array::from_fn(|it| if it == usize::from(channel) { 0 } else { 255 }),
            Self::Rows => row.is_multiple_of(2),
            Self::Columns => column.is_multiple_of(2),
            Self::Quarter => row.is_multiple_of(2) && column.is_multiple_of(2),
            Self::ThreeQuarters => !(row.is_multiple_of(2) && column.is_multiple_of(2)),
        };
        [if is_white { 255 } else { 0 }; 3]
    }

    /// Its light between black, 0, and white, 1, if that does not depend on the projector's gamma.
    pub(super) fn part(self) -> Option<f64> {
        match self {
            Self::Grey(0) => Some(0.0),
            Self::Grey(255) => Some(1.0),
            Self::Rows | Self::Columns => Some(0.5),
            Self::Quarter => Some(0.25),
            Self::ThreeQuarters => Some(0.75),
            Self::Grey(_) | Self::Without(_) => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stripes_and_dots_are_white_in_the_part_that_they_say() {
        for ink in DARK.into_iter().chain(BRIGHT) {
            let values: Vec<[u8; 3]> = (0..64).map(|n| ink.value([n % 8, n / 8])).collect();
            let mean = values.iter().flatten().map(|value| f64::from(*value)).sum::<f64>() / 192.0 / 255.0;
            match (ink, ink.part()) {
                (_, Some(part)) => assert_eq!(mean, part, "{ink:?}"),
                (Ink::Without(_), _) => assert!((mean - 2.0 / 3.0).abs() < 1e-12),
                (Ink::Grey(value), _) => assert!(GREYS.contains(&value)),
                _ => panic!("{ink:?} has no part"),
            }
        }
    }
}
