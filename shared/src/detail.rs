//! How coarse a frame may show surfaces that are finer than its samples.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::{camera::Camera, division::FrameSize};

/// The widest cells whose vertices a frame may show as one, as a power of two of the model's unit.
///
/// A render server shows the coarsest stand-in that it has of the model whose cells are no wider, or the model itself. No point
/// of a surface then lies farther from its place than a cell's diagonal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Detail(Option<i16>);

impl Detail {
    /// The model itself.
    pub const FULL: Self = Self(None);

    /// Cells with a side of at most 2ⁿ units.
    pub const fn of_cells(log2_side: i16) -> Self {
        Self(Some(log2_side))
    }

    /// Whether a frame may show cells with a side of 2ⁿ units.
    pub fn allows(self, log2_side: i16) -> bool {
        self.0.is_some_and(|widest| log2_side <= widest)
    }

    /// Cells no wider than a sample, wherever in a box (min, max) a surface lies; box and camera are in the same space.
    pub fn of_samples(camera: &Camera, size: FrameSize, (min, max): (DVec3, DVec3)) -> Self {
        // A sample is as wide as on the view plane, times the surface's depth over that of the plane.
        let across = camera.u().cross(camera.v());
        let depth = |point: DVec3| (point - camera.eye()).dot(across);
        let corner =
            |index: u32| DVec3::select(glam::BVec3::new(index & 1 != 0, index & 2 != 0, index & 4 != 0), max, min);
        let nearest = (0..8).map(|index| depth(corner(index)) / depth(camera.ll())).fold(f64::INFINITY, f64::min);
        let [width, height] = [camera.u() / f64::from(size.xres()), camera.v() / f64::from(size.yres())];
        let sample = width.length().min(height.length()) * nearest;
        // Also where the eye is among the surfaces, or there are none.
        if sample.is_normal() && sample > 0.0 { Self::of_cells(sample.log2().floor() as i16) } else { Self::FULL }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_as_wide_as_a_sample_at_the_nearest_surface() {
        let size = FrameSize::new(512, 256).unwrap();
        // 2 × 1 at a depth of 4, in 512 × 256 samples: 2⁻⁸ there.
        let camera = |eye: DVec3| {
            let ll = eye + DVec3::new(-1.0, -0.5, -4.0);
            Camera::new(eye, ll, DVec3::X * 2.0, DVec3::Y).unwrap()
        };
        let cube = (DVec3::splat(-1.0), DVec3::ONE);
        for (distance, log2_side) in [(5.0, -8), (4.99, -9), (9.0, -7), (1025.0, 0), (1.001, -20)] {
            let detail = Detail::of_samples(&camera(DVec3::Z * distance), size, cube);
            assert_eq!(detail, Detail::of_cells(log2_side), "from {distance}");
            assert!(detail.allows(log2_side) && detail.allows(log2_side - 1) && !detail.allows(log2_side + 1));
        }
        // Samples that are not square count by their shorter side.
        let wide = FrameSize::new(64, 256).unwrap();
        assert_eq!(Detail::of_samples(&camera(DVec3::Z * 5.0), wide, cube), Detail::of_cells(-8));
        // Within the box, behind it, and without one.
        for eye in [DVec3::ZERO, DVec3::Z, DVec3::Z * -3.0] {
            assert_eq!(Detail::of_samples(&camera(eye), size, cube), Detail::FULL, "from {eye}");
        }
        for bounds in [(DVec3::INFINITY, DVec3::NEG_INFINITY), (DVec3::NAN, DVec3::NAN)] {
            assert_eq!(Detail::of_samples(&camera(DVec3::Z * 5.0), size, bounds), Detail::FULL);
        }
        assert!(!Detail::FULL.allows(i16::MIN));
    }
}
