//! Three numbers from 0 to 1 in 32 bits, which take few instructions to read.

use bytemuck::{Pod, Zeroable};

/// The square roots of three numbers, in steps of a 1023rd: at least four steps for each of the 256 that sRGB has, so a byte is
/// the same after it was stored here. Its bytes take the place of an image's, which are not aligned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(transparent)]
pub(super) struct Texel([u8; 4]);

/// The units of [`Texel::scaled`].
pub(super) const UNITS: [f32; 3] = {
    const STEP: f32 = 1.0 / (1023.0 * 1023.0);
    const SHIFT: f32 = 1.0 / (1024.0 * 1024.0);
    [STEP, STEP * SHIFT, STEP * SHIFT * SHIFT]
};

impl Texel {
    /// The nearest texel to numbers from 0 to 1.
    pub(super) fn new(numbers: [f32; 3]) -> Self {
        let [x, y, z] = numbers.map(|number| (number.sqrt() * 1023.0 + 0.5) as u32);
        Self((x | y << 10 | z << 20).to_le_bytes())
    }

    /// One of the numbers, of channel 0, 1 or 2, in units of [`UNITS`]: its bits are squared where they lie.
    #[inline(always)]
    pub(super) fn scaled(self, channel: usize) -> f32 {
        let root = (u32::from_le_bytes(self.0) & 0x3ff << (10 * channel)) as i32 as f32;
        root * root
    }
}

#[cfg(test)]
mod tests {
    use shared::srgb;

    use super::*;

    #[test]
    fn every_byte_of_srgb_comes_back() {
        for value in 0..=255u8 {
            let light = [value, 255 - value, value / 2].map(srgb::decode);
            let texel = Texel::new(light);
            let stored = [0, 1, 2].map(|channel| texel.scaled(channel) * UNITS[channel]);
            assert_eq!(stored.map(srgb::encode), [value, 255 - value, value / 2]);
            assert!(
                light.iter().zip(stored).all(|(light, stored)| (light - stored).abs() <= 1e-3 * light.sqrt() + 1e-6)
            );
        }
    }
}
