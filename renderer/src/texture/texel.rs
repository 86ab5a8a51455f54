//! Three numbers from 0 to 1 in 32 bits, which take few instructions to read.

use glam::Vec3A;

/// The square roots of three numbers, in steps of a 1023rd: at least four steps for each of the 256 that sRGB has, so a byte is
/// the same after it was stored here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Texel(u32);

/// What [`Texel::scaled`] numbers are to be multiplied with.
pub(super) const UNIT: Vec3A = {
    const STEP: f32 = 1.0 / (1023.0 * 1023.0);
    const SHIFT: f32 = 1.0 / (1024.0 * 1024.0);
    Vec3A::new(STEP, STEP * SHIFT, STEP * SHIFT * SHIFT)
};

impl Texel {
    /// The nearest texel to numbers from 0 to 1.
    pub(super) fn new(numbers: Vec3A) -> Self {
        let [x, y, z] = numbers.to_array().map(|number| (number.sqrt() * 1023.0 + 0.5) as u32);
        Self(x | y << 10 | z << 20)
    }

    /// The numbers, in other units for each: their bits are squared where they lie.
    #[inline(always)]
    pub(super) fn scaled(self) -> Vec3A {
        let bits = |mask: u32| (self.0 & mask) as i32 as f32;
        let roots = Vec3A::new(bits(0x3ff), bits(0x3ff << 10), bits(0x3ff << 20));
        roots * roots
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
            let stored = (Texel::new(Vec3A::from_array(light)).scaled() * UNIT).to_array();
            assert_eq!(stored.map(srgb::encode), [value, 255 - value, value / 2]);
            assert!(
                light.iter().zip(stored).all(|(light, stored)| (light - stored).abs() <= 1e-3 * light.sqrt() + 1e-6)
            );
        }
    }
}
