//! Positions on a lattice: whole numbers of few bits in place of coordinates.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use shared::scene::Precision;

use crate::model::mesh::{Aabb, Mesh};

/// A step has at least this part of the largest coordinate: four times what `f32` tells apart there. So a lattice point's
/// numbers follow from its position, however it was rounded.
const LEAST_STEP: f32 = 1.0 / (1 << 21) as f32;

/// Points at equal distances along each axis, from the lowest corner of a mesh's bounds on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Lattice {
    /// Point 0, in model space.
    min: [f32; 3],
    /// From a point to the next, in model space.
    step: f32,
    precision: Precision,
}

impl Lattice {
    /// A lattice over these bounds, in model space; `None` if positions are exact, or where there are no bounds, or such large
    /// ones that points could not be traced.
    pub(crate) fn over(bounds: &Aabb, precision: Precision) -> Option<Self> {
        let Aabb { min, max } = *bounds;
        let most = (1u32 << precision.bits()?) - 1;
        let largest = min.iter().chain(&max).fold(0.0, |largest: f32, x| largest.max(x.abs()));
        let extent = (0..3).map(|axis| max[axis] - min[axis]).fold(0.0, f32::max);
        let step = (extent / most as f32).max(LEAST_STEP * largest).max(f32::MIN_POSITIVE);
        (largest < Mesh::LARGEST_COORDINATE / 2.0).then_some(Self { min, step, precision })
    }

    /// Bits of a coordinate.
    pub(crate) fn n_bits(&self) -> u32 {
        self.precision.bits().expect("a lattice has a number of bits")
    }

    /// Whether positions follow from its points.
    pub(crate) fn is_sound(&self) -> bool {
        self.precision != Precision::EXACT && self.min.iter().all(|x| x.is_finite()) && self.step.is_normal()
    }

    /// Point 0, in model space.
    pub(crate) fn min(&self) -> [f32; 3] {
        self.min
    }

    /// From a point to the next, in model space.
    pub(crate) fn step(&self) -> f32 {
        self.step
    }

    /// The numbers of the point that is nearest to a position in the lattice's bounds.
    pub(crate) fn nearest(&self, position: [f32; 3]) -> [u32; 3] {
        let most = (1u32 << self.n_bits()) - 1;
        let steps = |axis: usize| (f64::from(position[axis]) - f64::from(self.min[axis])) / f64::from(self.step);
        [0, 1, 2].map(|axis| (steps(axis).round() as u32).min(most))
    }

    /// Where a point lies, in model space. All kernels round as this does.
    #[inline]
    pub(crate) fn position(&self, numbers: [u32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|axis| numbers[axis] as f32 * self.step + self.min[axis])
    }

    /// The farthest that a position in the bounds may be from the nearest point, with what `f32` rounds: in the model's units.
    pub fn largest_error(&self) -> f64 {
        let most = f64::from((1u32 << self.n_bits()) - 1);
        let far = |min: &f32| f64::from(min.abs()).max((f64::from(*min) + most * f64::from(self.step)).abs());
        let rounding = f64::from(f32::EPSILON) * self.min.iter().map(far).fold(0.0, f64::max);
        (f64::from(self.step) / 2.0 + rounding) * 3f64.sqrt()
    }
}

impl Mesh {
    /// The mesh with positions on a lattice over its bounds, which is as fine as `precision` says; the same mesh if that is
    /// exact.
    ///
    /// A vertex has one place, so surfaces stay closed. Normals stay, and triangles may lose their area.
    #[must_use]
    pub fn snapped(self, precision: Precision) -> Self {
        let lattice = self.lattice_of(precision);
        self.snapped_to(lattice)
    }

    /// The lattice that [`Mesh::snapped`] uses; `None` if positions stay exact.
    pub(crate) fn lattice_of(&self, precision: Precision) -> Option<Lattice> {
        precision.bits().and_then(|_| Lattice::over(&self.bounds(), precision))
    }

    /// The same on this lattice, which spans the mesh's bounds.
    #[must_use]
    pub(crate) fn snapped_to(mut self, lattice: Option<Lattice>) -> Self {
        if let Some(lattice) = &lattice {
            // Vertices of no triangle may be anything.
            let usable = self.vertices.par_iter_mut().filter(|vertex| Self::is_usable(**vertex));
            usable.for_each(|vertex| *vertex = lattice.position(lattice.nearest(*vertex)));
        }
        Self { lattice, ..self }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;
    use crate::model::statue;

    proptest! {
        /// Near and far from zero, large, small and flat: a point's numbers follow from its position, and no position in the
        /// bounds is farther from its point than is said.
        #[test]
        fn points_keep_their_numbers_and_positions_are_near_their_points(
            bits in 8u8..=21,
            corner in prop::array::uniform3(-1e6..1e6f32),
            extent in prop::array::uniform3(prop_oneof![Just(0.0), -8.0..8.0f32]),
            parts in prop::collection::vec(prop::array::uniform3(0.0..=1.0f32), 1..50),
            nearness in prop_oneof![Just(0.0), Just(1.0)],
        ) {
            let min = corner.map(|x| x * nearness);
            let max = [0, 1, 2].map(|axis| {
                let length = if extent[axis] == 0.0 { 0.0 } else { 10f32.powf(extent[axis]) };
                min[axis] + length
            });
            let bounds = Aabb { min, max };
            let lattice = Lattice::over(&bounds, bits.try_into().unwrap()).unwrap();
            prop_assert!(lattice.is_sound());
            for part in parts {
                let position = [0, 1, 2].map(|axis| (min[axis] + part[axis] * (max[axis] - min[axis])).min(max[axis]));
                let numbers = lattice.nearest(position);
                let point = lattice.position(numbers);
                prop_assert_eq!(lattice.nearest(point), numbers);
                let apart = DVec3::from(point.map(f64::from)).distance(DVec3::from(position.map(f64::from)));
                prop_assert!(apart <= lattice.largest_error(), "{} > {}", apart, lattice.largest_error());
            }
        }
    }

    #[test]
    fn a_mesh_is_snapped_within_a_part_of_its_size() {
        let exact = statue::generate(20_000, &|_| ());
        let [min, max] = exact.bounds().corners();
        let size = (max - min).max_element();
        for bits in [8, 16, 21] {
            let snapped = exact.clone().snapped(Precision::try_from(bits).unwrap());
            let lattice = snapped.lattice.unwrap();
            let most = size * 0.5f64.powi(bits.into());
            assert!(lattice.largest_error() < 0.9 * most + 1e-6 * size, "{} > {most}", lattice.largest_error());
            let apart =
                |(a, b): (&[f32; 3], &[f32; 3])| DVec3::from(a.map(f64::from)).distance(DVec3::from(b.map(f64::from)));
            let farthest = exact.vertices.iter().zip(&snapped.vertices).map(apart).fold(0.0, f64::max);
            assert!(farthest <= lattice.largest_error() && farthest > 0.3 * lattice.largest_error(), "{farthest}");
            assert_eq!(snapped.triangles, exact.triangles);
            assert_eq!(snapped.clone().snapped_to(Some(lattice)), snapped);
        }
        assert_eq!(exact.clone().snapped(Precision::EXACT), exact);
        assert_eq!(Mesh::default().snapped(Precision::try_from(16).unwrap()), Mesh::default());
    }
}
