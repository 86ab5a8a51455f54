//! The sRGB transfer curve, with the same bits on every machine.
//!
//! Samples must not depend on the machine, and `powf` differs between platforms.
//! So the curve uses + − × ÷ alone: x^2.4 = x²·(x²)^(1/5), with the fifth root by Newton's iteration.

/// Linear light, 0 to 1, of each encoded value.
static DECODED: [f32; 256] = {
    let mut decoded = [0.0; 256];
    let mut value = 0;
    while value < 256 {
        decoded[value] = decode_exact(value as f64 / 255.0) as f32;
        value += 1;
    }
    decoded
};

/// The linear light halfway (in encoded values) between a value and the next, where rounding changes; infinity for the
/// last value.
static THRESHOLDS: [f32; 256] = {
    let mut thresholds = [f32::INFINITY; 256];
    let mut value = 0;
    while value < 255 {
        thresholds[value] = decode_exact((value as f64 + 0.5) / 255.0) as f32;
        value += 1;
    }
    thresholds
};

/// The lowest encoded value in each of [`N_BUCKETS`] equal steps of linear light, and that of 1.
static FIRST_VALUE: [u8; N_BUCKETS + 1] = {
    let mut first_value = [0; N_BUCKETS + 1];
    let mut value = 0;
    let mut bucket = 0;
    while bucket <= N_BUCKETS {
        while THRESHOLDS[value] <= bucket as f32 / N_BUCKETS as f32 {
            value += 1;
        }
        first_value[bucket] = value as u8;
        bucket += 1;
    }
    first_value
};

/// A power of two, so that a bucket's index is exact. A bucket is narrower than 1 / (12.92 × 255), the least distance between
/// two thresholds, so it has at most one.
const N_BUCKETS: usize = 4096;

/// Linear light, 0 to 1, of an encoded value.
#[inline]
pub fn decode(value: u8) -> f32 {
    DECODED[usize::from(value)]
}

/// The encoded value nearest to a linear light, which is clamped to 0..1; NaN gives 0.
#[inline]
pub fn encode(linear: f32) -> u8 {
    // Neighbours differ, so a branch would often be predicted wrongly. NaN is not above 0.
    let clamped = if linear > 0.0 { linear } else { 0.0 }.min(1.0);
    let value = FIRST_VALUE[(clamped * N_BUCKETS as f32) as usize];
    value + u8::from(THRESHOLDS[usize::from(value)] <= clamped)
}

/// Encoded to linear after IEC 61966-2-1, both 0 to 1.
const fn decode_exact(encoded: f64) -> f64 {
    if encoded <= 0.04045 {
        return encoded / 12.92;
    }
    let x = (encoded + 0.055) / 1.055;
    let square = x * x;
    let mut root = 1.0;
    // From 1, twelve steps reach the last bit for arguments above 0.008; more change nothing.
    let mut step = 0;
    while step < 16 {
        root -= (root * root * root * root * root - square) / (5.0 * root * root * root * root);
        step += 1;
    }
    square * root
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_is_the_standard_one() {
        for value in 0..=255u8 {
            let encoded = f64::from(value) / 255.0;
            let expected =
                if encoded <= 0.04045 { encoded * (1.0 / 12.92) } else { ((encoded + 0.055) / 1.055).powf(2.4) };
            assert!((f64::from(decode(value)) - expected).abs() <= 1e-7, "{value}");
        }
    }

    #[test]
    fn every_light_gets_the_nearest_value() {
        for step in 0..=200_000u32 {
            let linear = step as f32 / 200_000.0;
            let x = f64::from(linear);
            let encoded = if x <= 0.003_130_8 { x * 12.92 } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
            let error = (f64::from(encode(linear)) - encoded * 255.0).abs();
            assert!(error <= 0.5 + 1e-3, "{linear}: {} instead of {}", encode(linear), encoded * 255.0);
        }
    }

    #[test]
    fn a_value_begins_at_its_threshold() {
        for (value, &threshold) in (0..255u8).zip(&THRESHOLDS) {
            assert_eq!([threshold.next_down(), threshold].map(encode), [value, value + 1]);
        }
    }

    #[test]
    fn encoding_undoes_decoding() {
        assert!((0..=255).all(|value| encode(decode(value)) == value));
    }

    #[test]
    fn light_outside_the_range_is_clamped() {
        let cases = [(f32::NAN, 0), (-1.0, 0), (f32::NEG_INFINITY, 0), (1.0, 255), (7.0, 255), (f32::INFINITY, 255)];
        for (linear, value) in cases {
            assert_eq!(encode(linear), value);
        }
    }
}
