//! A camera's lens: from places in its photographs to places in those of a pinhole camera.

use glam::{DMat2, DVec2};

/// Brown, "Decentering Distortion of Lenses" (1966), applied from the photograph to the pinhole's picture, so no place is
/// found by iteration. Coordinates are relative to the photograph's centre, in halves of its diagonal.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Lens {
    /// The centre of distortion, three radial and two tangential coefficients.
    pub coefficients: [f64; Lens::N],
}

/// A pinhole place with its derivatives.
#[derive(Clone, Copy, Debug)]
pub(super) struct Undistorted {
    pub at: DVec2,
    pub by_coefficient: [DVec2; Lens::N],
}

impl Lens {
    /// The number of coefficients.
    pub const N: usize = 7;
    /// How far coefficients may be from zero, as standard deviations: centres of lenses are nearly those of photographs.
    pub(super) const SPREAD: [f64; Self::N] = [0.03, 0.03, 1.0, 1.0, 1.0, 0.01, 0.01];

    /// A place in photographs of `size` pixels, relative to the centre, in halves of the diagonal.
    pub(super) fn normalised(size: [usize; 2], at: DVec2) -> DVec2 {
        let size = DVec2::new(size[0] as f64, size[1] as f64);
        (at - size / 2.0) / (size.length() / 2.0)
    }

    /// The pinhole place of a normalised place.
    pub(super) fn undistorted(&self, at: DVec2) -> Undistorted {
        let [cx, cy, k1, k2, k3, p1, p2] = self.coefficients;
        let d = at - DVec2::new(cx, cy);
        let r2 = d.length_squared();
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let radial_by_r2 = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3);
        let (xx, xy, yy) = (d.x * d.x, d.x * d.y, d.y * d.y);
        let tangential = [DVec2::new(2.0 * xy, r2 + 2.0 * yy), DVec2::new(r2 + 2.0 * xx, 2.0 * xy)];
        let by_place = DMat2::from_cols(
            DVec2::new(
                radial + 2.0 * xx * radial_by_r2 + 2.0 * p1 * d.y + 6.0 * p2 * d.x,
                2.0 * xy * radial_by_r2 + 2.0 * p1 * d.x + 2.0 * p2 * d.y,
            ),
            DVec2::new(
                2.0 * xy * radial_by_r2 + 2.0 * p1 * d.x + 2.0 * p2 * d.y,
                radial + 2.0 * yy * radial_by_r2 + 6.0 * p1 * d.y + 2.0 * p2 * d.x,
            ),
        );
        Undistorted {
            at: d * radial + p1 * tangential[0] + p2 * tangential[1],
            by_coefficient: [
                -by_place.x_axis,
                -by_place.y_axis,
                d * r2,
                d * r2 * r2,
                d * r2 * r2 * r2,
                tangential[0],
                tangential[1],
            ],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_are_those_of_small_steps() {
        let lens = Lens { coefficients: [0.01, -0.02, -0.1, 0.05, 0.02, 0.003, -0.002] };
        let at = DVec2::new(0.6, -0.4);
        for (coefficient, slope) in lens.undistorted(at).by_coefficient.into_iter().enumerate() {
            let step = |by: f64| {
                let mut lens = lens;
                lens.coefficients[coefficient] += by;
                lens.undistorted(at).at
            };
            let measured = (step(1e-6) - step(-1e-6)) / 2e-6;
            assert!(measured.distance(slope) < 1e-8, "{coefficient}: {measured} {slope}");
        }
    }
}
