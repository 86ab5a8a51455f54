//! How coarse a frame may show surfaces that are finer than its samples.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::{camera::Camera, division::FrameSize};

/// The widest cells whose vertices a frame may show as one, by their side in units of the model; 0 allows none.
///
/// A render server shows the coarsest stand-in that it has of the model whose cells are no wider, or the model itself. No point
/// of a surface then lies farther from its place than a cell's diagonal.
///
/// Invariant, on the wire too: not negative, and finite.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "f32")]
pub struct Detail(f32);

/// A side is negative or not finite.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the side of a cell is a number from 0 on")]
pub struct DetailError;

impl TryFrom<f32> for Detail {
    type Error = DetailError;

    fn try_from(side: f32) -> Result<Self, DetailError> {
        if side.is_finite() && side >= 0.0 { Ok(Self(side)) } else { Err(DetailError) }
    }
}

impl Detail {
    /// The model itself.
    pub const FULL: Self = Self(0.0);

    /// Whether a frame may show cells with this side.
    pub fn allows(self, side: f32) -> bool {
        side <= self.0
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
        (sample as f32).try_into().unwrap_or(Self::FULL)
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
        for (distance, side) in [(5.0, 1.0 / 256.0), (9.0, 1.0 / 128.0), (1025.0, 1.0), (1.0 + 1e-6, 1e-6 / 1024.0)] {
            let detail = Detail::of_samples(&camera(DVec3::Z * distance), size, cube);
            assert!((detail.0 / side - 1.0).abs() < 1e-3, "{detail:?} from {distance}");
            assert!(detail.allows(0.99 * side) && !detail.allows(1.01 * side));
        }
        // Samples that are not square count by their shorter side.
        let wide = FrameSize::new(64, 256).unwrap();
        assert_eq!(Detail::of_samples(&camera(DVec3::Z * 5.0), wide, cube), Detail(1.0 / 256.0));
        // Within the box, behind it, and without one.
        for eye in [DVec3::ZERO, DVec3::Z, DVec3::Z * -3.0] {
            assert_eq!(Detail::of_samples(&camera(eye), size, cube), Detail::FULL, "from {eye}");
        }
        for bounds in [(DVec3::INFINITY, DVec3::NEG_INFINITY), (DVec3::NAN, DVec3::NAN)] {
            assert_eq!(Detail::of_samples(&camera(DVec3::Z * 5.0), size, bounds), Detail::FULL);
        }
        assert!(!Detail::FULL.allows(f32::MIN_POSITIVE));
        assert!([-1.0, f32::NAN, f32::INFINITY].iter().all(|&side| Detail::try_from(side).is_err()));
    }
}
