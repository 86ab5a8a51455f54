//! Three numbers from 0 to 1 in 32 bits, which take few instructions to read.

use bytemuck::{Pod, Zeroable};

/// The square roots of three numbers, in steps of a 1023rd: at least four steps for each of the 256 that sRGB has, so a byte is
/// the same after it was stored here. Its bytes take the place of an image's, which are not aligned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub(crate) struct PackedRgb([u8; 4]);

/// The units of [`PackedRgb::scaled`].
pub(crate) const UNITS: [f32; 3] = {
    const STEP: f32 = 1.0 / (1023.0 * 1023.0);
    const SHIFT: f32 = 1.0 / (1024.0 * 1024.0);
    [STEP, STEP * SHIFT, STEP * SHIFT * SHIFT]
};

impl PackedRgb {
    /// The nearest to numbers from 0 to 1, at most an eighth of a step of sRGB away.
    pub(crate) fn nearest(numbers: [f32; 3]) -> Self {
        Self::above(numbers, 0.5)
    }

    /// One of the two next to a texel's numbers, chosen by the texel's column and row, so that the mean over any even surface
    /// has no error: with the nearest, a whole surface would be too light or too dark by up to a hundredth.
    pub(super) fn of_texel(numbers: [f32; 3], at: [u32; 2]) -> Self {
        Self::above(numbers, threshold(at))
    }

    /// The next higher steps where numbers are farther than this part of a step above the next lower, else these.
    fn above(numbers: [f32; 3], threshold: f32) -> Self {
        let [x, y, z] = numbers.map(|number| {
            let below = (number.sqrt() * 1023.0) as u32;
            let [from, to] = [below, below + 1].map(|root| (root * root) as f32);
            below + u32::from(number * (1023.0 * 1023.0) - from > threshold * (to - from))
        });
        Self((x | y << 10 | z << 20).to_le_bytes())
    }

    /// The numbers of these bits, as [`Simd::gather_bits`](crate::simd::Simd::gather_bits) finds them.
    #[inline(always)]
    pub(crate) fn of_bits(bits: u32) -> Self {
        Self(bits.to_ne_bytes())
    }

    /// One of the numbers, of channel 0, 1 or 2, in units of [`UNITS`]: its bits are squared where they lie.
    #[inline(always)]
    pub(crate) fn scaled(self, channel: usize) -> f32 {
        let root = (u32::from_le_bytes(self.0) & 0x3ff << (10 * channel)) as i32 as f32;
        root * root
    }
}

/// Between 0 and 1, and evenly spread over any square of 2ⁿ×2ⁿ texels: Bayer, "An Optimum Method for Two-Level Rendition of
/// Continuous-Tone Pictures" (1973), with n up to 4.
fn threshold([column, row]: [u32; 2]) -> f32 {
    let bits = |n: u32| [(column ^ row) >> n & 1, row >> n & 1];
    let number = (0..4).fold(0, |number, n| number << 2 | bits(n)[0] << 1 | bits(n)[1]);
    (number as f32 + 0.5) / 256.0
}

#[cfg(test)]
mod tests {
    use shared::srgb;

    use super::*;

    fn unpacked(packed: PackedRgb) -> [f32; 3] {
        [0, 1, 2].map(|channel| packed.scaled(channel) * UNITS[channel])
    }

    fn stored(numbers: [f32; 3], at: [u32; 2]) -> [f32; 3] {
        unpacked(PackedRgb::of_texel(numbers, at))
    }

    #[test]
    fn every_byte_of_srgb_comes_back() {
        for (value, at) in (0..=255u8).flat_map(|value| (0..256).map(move |at| (value, [at % 16, at / 16]))) {
            let light = [value, 255 - value, value / 2].map(srgb::decode);
            let stored = stored(light, at);
            assert_eq!(stored.map(srgb::encode), [value, 255 - value, value / 2]);
            assert!(
                light.iter().zip(stored).all(|(light, stored)| (light - stored).abs() <= 2e-3 * light.sqrt() + 1e-6)
            );
        }
    }

    #[test]
    fn the_nearest_is_at_most_half_a_step_away() {
        for number in (0..=10_000).map(|n| n as f32 / 10_000.0) {
            let [expected, stored] =
                [number, unpacked(PackedRgb::nearest([0.5, number, 0.0]))[1]].map(|x| f64::from(x).sqrt() * 1023.0);
            // Half way between the squares of 0 and 1 is 0.21 above half way between them.
            assert!((stored - expected).abs() <= 0.71, "{number}: {stored}, not {expected}");
            assert!((stored - expected).abs() <= 0.51 || expected < 20.0, "{number}: {stored}, not {expected}");
        }
        for value in 0..=255u8 {
            let light = [value, 255 - value, value / 2];
            let stored = unpacked(PackedRgb::nearest(light.map(srgb::decode)));
            assert_eq!(stored.map(srgb::encode), light);
        }
        assert_eq!(unpacked(PackedRgb::nearest([1.0, 0.0, 1.0])), [1.0, 0.0, 1.0]);
    }

    #[test]
    fn even_surfaces_keep_their_light() {
        for light in (0..=1000).map(|n| n as f32 / 1000.0) {
            let of_square = |side: u32| {
                let texels = (0..side * side).map(|at| stored([light; 3], [at % side + 20, at / side + 7]));
                texels.map(|texel| f64::from(texel[0])).sum::<f64>() / f64::from(side * side)
            };
            let step = (2.0 * f64::from(light).sqrt() + 1e-3) / 1023.0;
            for side in [2, 4, 8, 16] {
                let error = of_square(side) - f64::from(light);
                assert!(error.abs() <= step / f64::from(side * side) + 1e-7, "{light} {side}: {error}");
            }
        }
    }
}
