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
    /// One of eight pixels is white.
    Eighth,
    /// One of sixteen pixels is white.
    Sixteenth,
}

/// Inks of bright and dark squares side by side. The camera sees about the same contrast between the two of each pair, so
/// that crossings keep their places and are found; black is the most frequent, because the dimmest light is the hardest to
/// measure. Dots of an eighth and a sixteenth measure the camera's curve close to black: where a lens darkens the edges of
/// the picture, black lies below all that quarters measure, and dark greys would be told by a guess.
const PAIRS: [[Ink; 2]; 12] = [
    [Ink::Grey(255), Ink::Quarter],
    [Ink::Rows, Ink::Grey(0)],
    [Ink::Without(0), Ink::Grey(64)],
    [Ink::Grey(192), Ink::Grey(0)],
    [Ink::Grey(255), Ink::Grey(96)],
    [Ink::Without(1), Ink::Grey(0)],
    [Ink::ThreeQuarters, Ink::Sixteenth],
    [Ink::Grey(160), Ink::Grey(0)],
    [Ink::Grey(255), Ink::Eighth],
    [Ink::Columns, Ink::Grey(0)],
    [Ink::Without(2), Ink::Grey(96)],
    [Ink::Grey(224), Ink::Grey(64)],
];

/// Squares in a row or a column with one pair of inks.
const BLOCK: u32 = 3;

/// The greys whose light the projector's gamma tells.
pub(super) const GREYS: [u8; 5] = [64, 96, 160, 192, 224];

impl Ink {
    /// The ink of a square, bright or dark: every part of a board has all pairs, and each pattern has them elsewhere.
    pub(in crate::calibration) fn of_square(pattern: u32, [column, row]: [u32; 2], is_bright: bool) -> Self {
        let pair = (column / BLOCK + 5 * (row / BLOCK) + 3 * pattern) as usize % PAIRS.len();
        PAIRS[pair][usize::from(!is_bright)]
    }

    /// Red, green and blue of a projector's pixel.
    pub(in crate::calibration) fn value(self, [column, row]: [u32; 2]) -> [u8; 3] {
        let is_white = match self {
            Self::Grey(value) => return [value; 3],
            Self::Without(channel) => {
                return std::array::from_fn(|it| if it == usize::from(channel) { 0 } else { 255 });
            }
            Self::Rows => row.is_multiple_of(2),
            Self::Columns => column.is_multiple_of(2),
            Self::Quarter => row.is_multiple_of(2) && column.is_multiple_of(2),
            Self::Eighth => row.is_multiple_of(4) && column.is_multiple_of(2),
            Self::Sixteenth => row.is_multiple_of(4) && column.is_multiple_of(4),
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
            Self::Eighth => Some(0.125),
            Self::Sixteenth => Some(0.0625),
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
        for ink in PAIRS.into_iter().flatten() {
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

    #[test]
    fn small_boards_have_all_inks() {
        for ink in PAIRS.into_iter().flatten() {
            let squares = (0..16 * 12).map(|n| [n % 16, n / 16]);
            let of_ink = squares.filter(|square| Ink::of_square(7, *square, (square[0] + square[1]) % 2 == 0) == ink);
            assert!(of_ink.count() >= 4, "{ink:?}");
        }
    }
}
