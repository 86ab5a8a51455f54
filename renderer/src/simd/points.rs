//! Points of three `f32` in eleven bytes, bit for bit.
//!
//! Few of the 255 exponents of an `f32` occur in a scan, whose coordinates lie between a nanometre and a metre, say. So a
//! coordinate has 24 bits for its significand and sign, and five for its exponent.

use serde::{Deserialize, Serialize};

/// Bytes of a point: three for each axis, a significand above a sign, then five bits for each exponent, those of x the lowest. 0
/// has exponent 0, and no other number has.
pub(crate) const POINT: usize = 11;

/// Bytes of significands and signs.
const SIGNIFICANDS: usize = 9;

pub(super) const EXPONENT_BITS: u32 = 5;
pub(super) const LARGEST_EXPONENT: u32 = (1 << EXPONENT_BITS) - 1;

/// Bytes that are loaded from a point's first.
pub(crate) const LOADED: usize = 16;

/// The power of two by which the numbers with the packed exponents are multiplied.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct PointScale(pub(super) f32);

impl PointScale {
    /// The scale for numbers, other than 0, whose exponents, biased as in an `f32`, lie in this range; `None` if five bits are
    /// too few for them.
    pub(crate) fn of_exponents(least: u32, greatest: u32) -> Option<Self> {
        // Exponent 0 is that of numbers without a leading one.
        let fit = least > 0 && least <= greatest && greatest - least < LARGEST_EXPONENT;
        let exponent = 127 + greatest - LARGEST_EXPONENT;
        (fit && exponent < 255).then(|| Self(f32::from_bits(exponent << 23)))
    }

    /// Whether all points can be unpacked.
    pub(crate) fn is_sound(self) -> bool {
        self.0.is_normal()
    }

    /// Packs a point. Nothing is rounded: its exponents are in the range of this scale.
    pub(crate) fn pack(self, point: [f32; 3], to: &mut [u8; POINT]) {
        let mut exponents = 0;
        for axis in 0..3 {
            let rotated = (point[axis] / self.0).to_bits().rotate_left(1);
            to[3 * axis..][..3].copy_from_slice(&rotated.to_le_bytes()[..3]);
            exponents |= (rotated >> 24) << (axis as u32 * EXPONENT_BITS);
        }
        to[SIGNIFICANDS..].copy_from_slice(&exponents.to_le_bytes()[..POINT - SIGNIFICANDS]);
    }

    /// Unpacks a point.
    #[inline]
    pub(crate) fn unpack(self, bytes: &[u8; POINT]) -> [f32; 3] {
        let mut point = [0.0; 3];
        let exponents = u32::from(u16::from_le_bytes([bytes[SIGNIFICANDS], bytes[SIGNIFICANDS + 1]]));
        for axis in 0..3 {
            let exponent = exponents >> (axis as u32 * EXPONENT_BITS) & LARGEST_EXPONENT;
            let significand = u32::from_le_bytes([bytes[3 * axis], bytes[3 * axis + 1], bytes[3 * axis + 2], 0]);
            point[axis] = f32::from_bits((exponent << 24 | significand).rotate_right(1)) * self.0;
        }
        point
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The biased exponent.
    fn exponent(x: f32) -> u32 {
        x.to_bits() >> 23
    }

    #[test]
    fn points_come_back_bit_for_bit() {
        for (least, greatest) in
            [(1e-6, 800.0), (1.0, 1.0), (1.0, 2f32.powi(31).next_down()), (4e9, 4e9), (1.2e-38, 1e-30)]
        {
            let scale = PointScale::of_exponents(exponent(least), exponent(greatest)).unwrap();
            assert!(scale.is_sound());
            let middle = (least * greatest).sqrt().clamp(least, greatest);
            let next = |x: f32| x.next_up().min(greatest);
            for point in [[0.0, -0.0, least], [-greatest, middle, next(least)], [next(middle), -least, -middle]] {
                let mut bytes = [0xff; POINT];
                scale.pack(point, &mut bytes);
                assert_eq!(scale.unpack(&bytes).map(f32::to_bits), point.map(f32::to_bits), "{point:?}");
            }
        }
    }

    #[test]
    fn numbers_that_lie_too_far_apart_or_from_1_are_not_packed() {
        for (least, greatest) in [(1.0, 2f32.powi(31)), (5e9, 5e9), (1e-40, 1e-35), (1e-40, f32::MAX)] {
            assert_eq!(PointScale::of_exponents(exponent(least), exponent(greatest)), None, "{least} to {greatest}");
        }
        assert_eq!(PointScale::of_exponents(u32::MAX, 0), None, "no number but 0");
    }
}
