//! Unit normals of vertices in four bytes.
//!
//! A unit vector is projected onto an octahedron that is unfolded into a square, after Cigolla et al., "A Survey of
//! Efficient Representations for Independent Unit Vectors" (2014). Only + − × ÷ √ are used: every machine computes the same
//! bits.

use bytemuck::{Pod, Zeroable};
use glam::Vec3;

/// A unit normal within 0.004 degrees, or [`Normal::OF_TRIANGLE`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Pod, Zeroable)]
#[repr(C)]
pub struct Normal([i16; 2]);

/// The coordinate of the square's edge.
const EDGE: f32 = i16::MAX as f32;

impl Normal {
    /// No normal of its own: the vertex takes that of the triangle that is hit.
    pub const OF_TRIANGLE: Self = Self([i16::MIN; 2]);

    /// The nearest normal to a vector of any length; [`Normal::OF_TRIANGLE`] if it is zero or not finite.
    #[must_use]
    pub fn new(vector: Vec3) -> Self {
        let largest = vector.abs().max_element();
        if largest == 0.0 || !vector.is_finite() {
            return Self::OF_TRIANGLE;
        }
        // Scale first, so that sums neither overflow nor underflow.
        let vector = vector / largest;
        let on_octahedron = vector * (1.0 / (vector.x.abs() + vector.y.abs() + vector.z.abs()));
        let square = if on_octahedron.z < 0.0 { fold(on_octahedron) } else { on_octahedron };
        Self([square.x, square.y].map(|x| (x * EDGE + 0.5).floor() as i16))
    }

    /// The bits of [`Normal::OF_TRIANGLE`], as [`Normal::of_bits`] takes them.
    pub(crate) const OF_TRIANGLE_BITS: u32 = 0x8000_8000;

    /// The normal of these bits, as [`Simd::gather_bits`](crate::simd::Simd::gather_bits) finds them.
    #[inline(always)]
    pub(crate) fn of_bits(bits: u32) -> Self {
        bytemuck::cast(bits)
    }

    /// The unit vector; `None` for [`Normal::OF_TRIANGLE`].
    #[must_use]
    pub fn vector(self) -> Option<Vec3> {
        let point = self.on_octahedron();
        (self != Self::OF_TRIANGLE).then(|| point * (1.0 / point.length()))
    }

    /// The same direction, up to 1.2 % longer or shorter, at a fraction of the cost: for interpolation, whose result is not
    /// of unit length in any case. Undefined, but finite, for [`Normal::OF_TRIANGLE`].
    #[inline(always)]
    #[must_use]
    pub fn direction(self) -> Vec3 {
        let point = self.on_octahedron();
        // The inverse square root, for the squares of lengths on an octahedron: from 1/3 to 1.
        let square = point.length_squared();
        let scale = 2.479_146_2 - square * (2.724_498_4 - square * 1.257_667_6);
        point * scale
    }

    #[inline(always)]
    fn on_octahedron(self) -> Vec3 {
        let [x, y] = self.0.map(|x| f32::from(x) * (1.0 / EDGE));
        let z = 1.0 - x.abs() - y.abs();
        // The lower half is mirrored back across the square's inner edges.
        let beyond = (-z).max(0.0);
        Vec3::new(x - beyond.copysign(x), y - beyond.copysign(y), z)
    }
}

/// Mirrors the lower half of the octahedron across the square's inner edges; keeps z.
fn fold(point: Vec3) -> Vec3 {
    let sign = |x: f32| 1.0f32.copysign(x);
    Vec3::new((1.0 - point.y.abs()) * sign(point.x), (1.0 - point.x.abs()) * sign(point.y), point.z)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_normal_comes_back_within_four_thousandths_of_a_degree(
            direction in prop::array::uniform3(-1.0f32..1.0), exponent in -30..30,
        ) {
            let direction = Vec3::from_array(direction);
            prop_assume!(direction.length() > 1e-3);
            let back = Normal::new(direction * 2f32.powi(exponent)).vector().unwrap();
            let sine = back.as_dvec3().cross(direction.as_dvec3().normalize()).length();
            prop_assert!((back.length() - 1.0).abs() < 1e-6 && back.dot(direction) > 0.0 && sine < 0.004f64.to_radians());
            let rough = Normal::new(direction).direction();
            prop_assert!((rough.length() - 1.0).abs() < 0.0124 && (rough.normalize() - back).length() < 1e-6);
        }
    }

    #[test]
    fn axes_and_corners_are_exact_and_the_rest_is_no_normal() {
        for axis in [Vec3::X, Vec3::Y, Vec3::Z].into_iter().flat_map(|axis| [axis, -axis]) {
            assert_eq!(Normal::new(axis * 7.0).vector(), Some(axis));
        }
        for none in [Vec3::ZERO, Vec3::NAN, Vec3::INFINITY, Vec3::new(0.0, f32::NAN, 1.0)] {
            assert_eq!(Normal::new(none), Normal::OF_TRIANGLE);
        }
        assert_eq!(Normal::OF_TRIANGLE.vector(), None);
        assert_eq!(Normal::of_bits(Normal::OF_TRIANGLE_BITS), Normal::OF_TRIANGLE);
        assert!(Normal::OF_TRIANGLE.direction().is_finite());
    }
}
