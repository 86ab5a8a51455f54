//! Where samples lie in their pixels, and the hash that randomizes them.

/// Point at which sample number `sample` of pixel (i, j) pierces the view plane, in samples from its lower-left corner.
///
/// Sample 0 is the pixel's centre. The others follow the R₂ sequence (Roberts, "The Unreasonable Effectiveness of
/// Quasirandom Sequences", 2018), shifted differently in each pixel, so that neighbours do not share a pattern.
pub fn sample_point(i: u32, j: u32, sample: u32) -> (f32, f32) {
    if sample == 0 {
        return (i as f32 + 0.5, j as f32 + 0.5);
    }
    // The steps are 2³² over the plastic number and over its square.
    let along = |step: u32, seed: u32| {
        let offset = hash_u32(i ^ hash_u32(j ^ seed)).wrapping_add(step.wrapping_mul(sample));
        fraction(offset)
    };
    (i as f32 + along(3_242_174_889, 1), j as f32 + along(2_447_445_414, 2))
}

/// Cosine and sine of an angle in turns, from 0 to 1, to six digits: `sin_cos` differs between platforms, + − × do not.
#[inline(always)]
pub(crate) fn circle_point(turns: f32) -> [f32; 2] {
    // Taylor's series within an eighth of a turn to either side of a quarter's multiple.
    let quarters = turns * 4.0;
    let quarter = (quarters + 0.5) as u32;
    let x = (quarters - quarter as f32) * std::f32::consts::FRAC_PI_2;
    let square = x * x;
    let sin = x * (1.0 - square * (1.0 / 6.0) * (1.0 - square * (1.0 / 20.0) * (1.0 - square * (1.0 / 42.0))));
    let cos = 1.0
        - square * 0.5 * (1.0 - square * (1.0 / 12.0) * (1.0 - square * (1.0 / 30.0) * (1.0 - square * (1.0 / 56.0))));
    // Without branches, which would be guessed wrong.
    let [x, y] = if quarter & 1 == 0 { [cos, sin] } else { [sin, cos] };
    let negated_if = |x: f32, bit: u32| f32::from_bits(x.to_bits() ^ (bit & 2) << 30);
    [negated_if(x, quarter + 1), negated_if(y, quarter)]
}

/// The angle of a direction in turns, from 0 to 1, to six digits: the inverse of [`circle_point`]; of no direction 0.
pub(crate) fn circle_turns([x, y]: [f32; 2]) -> f32 {
    let (long, short) = if x.abs() < y.abs() { (y.abs(), x.abs()) } else { (x.abs(), y.abs()) };
    if long == 0.0 {
        return 0.0;
    }
    // Halve the angle twice, so that Taylor's series of the arc tangent is short.
    let halved = |tangent: f32| tangent / (1.0 + (1.0 + tangent * tangent).sqrt());
    let tangent = halved(halved(short / long));
    let square = tangent * tangent;
    let series = 1.0 - square * (1.0 / 3.0 - square * (1.0 / 5.0 - square * (1.0 / 7.0 - square * (1.0 / 9.0))));
    let octant = tangent * series * (2.0 * std::f32::consts::FRAC_1_PI);
    let quadrant = if x.abs() < y.abs() { 0.25 - octant } else { octant };
    let half = if x < 0.0 { 0.5 - quadrant } else { quadrant };
    if y < 0.0 { 1.0 - half } else { half }
}

/// A number between 0 and 1, of the high bits.
#[inline(always)]
pub(crate) fn fraction(bits: u32) -> f32 {
    // 23 bits, so that neither the half step nor the product is rounded; signed, because AVX2 converts only such numbers.
    ((bits >> 9) as i32 as f32 + 0.5) * (1.0 / 8_388_608.0)
}

/// Mixes bits: "lowbias32" of Wellons, "Prospecting for Hash Functions" (2018).
#[inline(always)]
pub(crate) fn hash_u32(mut x: u32) -> u32 {
    x = (x ^ x >> 16).wrapping_mul(0x7feb_352d);
    x = (x ^ x >> 15).wrapping_mul(0x846c_a68b);
    x ^ x >> 16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_are_those_of_the_circle() {
        for step in 0..=100_000u32 {
            let turns = step as f32 / 100_000.0;
            let (sin, cos) = (f64::from(turns) * std::f64::consts::TAU).sin_cos();
            let [x, y] = circle_point(turns);
            assert!((f64::from(x) - cos).abs() < 1e-6 && (f64::from(y) - sin).abs() < 1e-6, "{turns}: {x} {y}");
            let back = circle_turns([cos as f32 * 3.0, sin as f32 * 3.0]);
            assert!((back - turns).abs() < 1e-6 || (back - turns).abs() > 1.0 - 1e-6, "{turns}: {back}");
        }
    }

    #[test]
    fn sample_points_fill_their_pixel() {
        assert_eq!(sample_point(3, 4, 0), (3.5, 4.5));
        let mut seen = [false; 16];
        for sample in 1..=64 {
            let (x, y) = sample_point(7, 1000, sample);
            assert!((7.0..=8.0).contains(&x) && (1000.0..=1001.0).contains(&y), "{x} {y}");
            seen[((x - 7.0) * 4.0) as usize % 4 * 4 + ((y - 1000.0) * 4.0) as usize % 4] = true;
        }
        assert_eq!(seen, [true; 16], "64 samples leave no sixteenth of a pixel empty");
        assert_ne!(sample_point(7, 1, 1).0.fract(), sample_point(8, 1, 1).0.fract());
    }
}
