//! Pseudorandom numbers, the same in every run.

use glam::Vec3;

/// A congruential generator: Steele and Vigna, "Computationally easy, spectrally good multipliers for congruential
/// pseudorandom number generators" (2022).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        // Sequences of neighbouring seeds begin alike: skip the first numbers.
        let mut random = Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ seed.rotate_left(31));
        (0..4).for_each(|_| {
            random.bits();
        });
        random
    }

    pub(crate) fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_mul(0xd134_2543_de82_ef95).wrapping_add(1);
        (self.0 >> 32) as u32
    }

    /// A whole number from `low` to `high`, both included.
    pub(crate) fn whole(&mut self, low: i32, high: i32) -> i32 {
        let n = i64::from(high) - i64::from(low) + 1;
        (i64::from(low) + ((i64::from(self.bits()) * n) >> 32)) as i32
    }

    pub(crate) fn unit(&mut self) -> f32 {
        (self.bits() >> 8) as f32 * (1.0 / 16_777_216.0)
    }

    /// A point within half a unit of the origin, along each axis.
    pub(crate) fn point(&mut self) -> Vec3 {
        Vec3::new(self.unit() - 0.5, self.unit() - 0.5, self.unit() - 0.5)
    }

    pub(crate) fn choose<'a, T>(&mut self, items: &'a [T]) -> &'a T {
        &items[self.whole(0, items.len() as i32 - 1) as usize]
    }
}
