//! Decimal numbers of text files: digits that `f32` cannot hold are noticed.

/// A decimal number, rounded once.
#[derive(Clone, Copy, Debug)]
pub(super) struct Decimal {
    pub(super) value: f64,
    /// Whether `f32` holds the number to the last digit that is written.
    ///
    /// Scans on map grids are written with more digits than the `float` of their header holds; other programs write `f32`
    /// with fewer digits or more, and their numbers are those of the same model in a binary file.
    pub(super) fits_single: bool,
}

/// Powers of ten that `f64` holds.
const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

impl Decimal {
    /// Parses a number as programs write it; `None` if it is none.
    pub(super) fn parse(token: &[u8]) -> Option<Self> {
        let (is_negative, digits) = match token {
            [b'-', digits @ ..] => (true, digits),
            [b'+', digits @ ..] => (false, digits),
            digits => (false, digits),
        };
        let (mut mantissa, mut n_digits, mut n_decimals, mut has_point) = (0_u64, 0, 0, false);
        for &byte in digits {
            match byte {
                b'0'..=b'9' => {
                    mantissa = mantissa.wrapping_mul(10).wrapping_add(u64::from(byte - b'0'));
                    n_digits += 1;
                    n_decimals += usize::from(has_point);
                }
                b'.' if !has_point => has_point = true,
                _ => return Self::parse_slowly(token),
            }
        }
        if n_digits == 0 || n_digits > 15 {
            return Self::parse_slowly(token);
        }
        // Both numbers are exact, so their quotient is rounded once.
        let magnitude = mantissa as f64 / POWERS[n_decimals];
        let value = if is_negative { -magnitude } else { magnitude };
        Some(Self { value, fits_single: fits_single(value, 1.0 / POWERS[n_decimals]) })
    }

    #[cold]
    fn parse_slowly(token: &[u8]) -> Option<Self> {
        let text = str::from_utf8(token).ok()?;
        let Ok(value) = text.parse::<f64>() else {
            // NaN and infinities by C's printf on some systems: `nan(ind)`, `-nan(0x7)`, `1.#QNAN`, `-1.#INF`.
            let is_nan = text.contains("nan(") || text.contains(".#");
            return is_nan.then_some(Self { value: f64::NAN, fits_single: true });
        };
        let (mantissa, exponent) = text.split_once(['e', 'E']).unwrap_or((text, "0"));
        let n_decimals = mantissa.split_once('.').map_or(0, |(_, decimals)| decimals.len());
        let last_digit = 10f64.powi(exponent.parse::<i32>().unwrap_or(0).saturating_sub(n_decimals as i32));
        Some(Self { value, fits_single: fits_single(value, last_digit) })
    }
}

fn fits_single(value: f64, last_digit: f64) -> bool {
    let single = value as f32;
    let is_off = (f64::from(single) - value).abs() > 0.500_001 * last_digit;
    !(is_off && single.is_finite())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn numbers_are_those_of_the_standard_library(value: f32, wide: f64, decimals in 0..25_usize) {
            for text in [format!("{value}"), format!("{value:e}"), format!("{wide}"), format!("{value:+.decimals$}")] {
                let parsed = Decimal::parse(text.as_bytes()).unwrap();
                prop_assert_eq!(parsed.value.to_bits(), text.parse::<f64>().unwrap().to_bits(), "{}", text);
            }
            let shortest = format!("{value:e}");
            let shortest = Decimal::parse(shortest.as_bytes()).unwrap();
            prop_assert!(shortest.fits_single && (shortest.value as f32).to_bits() == value.to_bits());
        }
    }

    #[test]
    fn digits_beyond_single_precision_are_noticed() {
        for (text, fits) in [("512345.15", false), ("512345.125", true), ("0.1", true), ("0.10000000149", true)] {
            assert_eq!(Decimal::parse(text.as_bytes()).unwrap().fits_single, fits, "{text}");
        }
        for none in ["", "-", ".", "1.2.3", "O", "1e", "0x7"] {
            assert!(Decimal::parse(none.as_bytes()).is_none(), "{none}");
        }
        assert!(Decimal::parse(b"-1.#IND").unwrap().value.is_nan());
    }
}
