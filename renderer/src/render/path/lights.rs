//! The lights of path-traced pictures: a sun with a size, and a sky.

use std::f32::consts::PI;

use glam::{DVec3, Vec3};

use crate::render::{sampling::circle_point, secondary::tangent_basis, sky::PlacedSky};

/// A direction to a light, and what comes from there.
#[derive(Clone, Copy, Debug)]
pub(in crate::render) struct LightSample {
    /// Unit length, world space.
    pub(in crate::render) direction: Vec3,
    /// Linear light for each steradian.
    pub(in crate::render) radiance: Vec3,
    /// Density of the samples in this direction, for each steradian.
    pub(in crate::render) density: f32,
}

impl LightSample {
    /// The light from a direction that was chosen with this density, in which nothing is hit, weighed against the chance that rays
    /// to the light go there.
    #[inline(always)]
    pub(super) fn escaped(&self, density: f32) -> Vec3 {
        self.radiance * (density / (density + self.density))
    }
}

/// All lights of a picture but the lamp.
pub(super) struct Lights<'a> {
    pub(super) sun: Sun,
    pub(super) sky: Sky,
    /// In place of sun and sky.
    pub(super) sky_map: Option<PlacedSky<'a>>,
}

/// A disc of equal light at infinity.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sun {
    /// Unit length, world space.
    direction: Vec3,
    tangents: [Vec3; 2],
    /// 1 − the cosine of the angle from the middle to the edge: 0 for a point.
    cap: f32,
    radiance: Vec3,
}

/// Points are suns of this cap: the largest for which `f32` directions within it are all the same.
const SMALLEST_CAP: f64 = 1e-9;

impl Sun {
    /// A sun in a direction, of a diameter in degrees (0 to 90), that gives a surface that faces it the irradiance
    /// `π · white`: a white one scatters the radiance `white`.
    pub(super) fn new(direction: DVec3, diameter_degrees: f64, white: Vec3) -> Self {
        // 1 − cos x = 2 sin² (x/2), of an angle up to a quarter of a right angle.
        let sine = sine(diameter_degrees.to_radians() / 4.0);
        let cap = (2.0 * sine * sine).max(SMALLEST_CAP);
        // The disc's solid angle, weighted by the cosine, is π times the sine's square.
        let direction = direction.as_vec3();
        let radiance = white * (1.0 / (cap * (2.0 - cap))) as f32;
        Self { direction, tangents: tangent_basis(direction), cap: cap as f32, radiance }
    }

    /// Samples the disc uniformly, from a point of the unit square.
    #[inline(always)]
    pub(super) fn sample(&self, [u, v]: [f32; 2]) -> LightSample {
        let height = u * self.cap;
        let radius = (height * (2.0 - height)).sqrt();
        let [x, y] = circle_point(v);
        let [tangent, bitangent] = self.tangents;
        let direction = self.direction * (1.0 - height) + (tangent * x + bitangent * y) * radius;
        LightSample { direction, radiance: self.radiance, density: self.density() }
    }

    /// The light from a direction, and the density of samples there, for each steradian.
    #[inline(always)]
    pub(super) fn toward(&self, direction: Vec3) -> LightSample {
        // The chord is exact where the cosine is near 1.
        let chord = direction - self.direction;
        let is_in_disc = chord.length_squared() <= 2.0 * self.cap;
        let (radiance, density) = if is_in_disc { (self.radiance, self.density()) } else { (Vec3::ZERO, 0.0) };
        LightSample { direction, radiance, density }
    }

    #[inline(always)]
    fn density(&self) -> f32 {
        1.0 / (2.0 * PI * self.cap)
    }
}

/// A sky whose light changes evenly with height, from `ground` straight below to `zenith` straight above.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sky {
    /// Unit length, world space.
    pub(super) up: Vec3,
    pub(super) zenith: Vec3,
    pub(super) ground: Vec3,
}

impl Sky {
    /// Linear light from a direction of unit length, for each steradian.
    #[inline(always)]
    pub(super) fn radiance(&self, direction: Vec3) -> Vec3 {
        self.ground + (self.zenith - self.ground) * (0.5 + 0.5 * direction.dot(self.up)).clamp(0.0, 1.0)
    }

    /// The light that a white surface with this normal scatters where nothing is in the way. The mean direction of the
    /// hemisphere over it, weighed by the cosine, is two thirds of its normal.
    pub(super) fn scattered(&self, normal: Vec3) -> Vec3 {
        self.ground + (self.zenith - self.ground) * (0.5 + normal.dot(self.up) * (1.0 / 3.0))
    }
}

/// The sine of an angle in radians from 0 to π/8, by Taylor's series: `sin` differs between platforms.
fn sine(x: f64) -> f64 {
    let square = x * x;
    x * (1.0
        - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0 * (1.0 - square / 110.0)))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sun_of_any_size_gives_the_same_irradiance() {
        for degrees in [0.0, 0.1, 0.5, 4.0, 30.0, 90.0] {
            let direction = DVec3::new(0.3, -0.8, 0.5).normalize();
            let sun = Sun::new(direction, degrees, Vec3::new(1.0, 0.5, 0.25));
            assert!((f64::from(sun.cap) - (1.0 - (degrees / 2.0).to_radians().cos())).abs() < 1e-7, "{degrees}");
            let n = 64;
            let samples =
                (0..n * n).map(|k| sun.sample([(k % n) as f32 + 0.5, (k / n) as f32 + 0.5].map(|x| x / n as f32)));
            let irradiance: DVec3 = samples
                .map(|sample| {
                    assert!((sample.direction.length() - 1.0).abs() < 1e-6);
                    assert!(degrees < 0.1 || sun.toward(sample.direction).density == sample.density, "{degrees}");
                    let cosine = f64::from(sample.direction.dot(direction.as_vec3()));
                    sample.radiance.as_dvec3() * (cosine / f64::from(sample.density))
                })
                .sum::<DVec3>()
                / f64::from(n * n);
            let expected = DVec3::new(1.0, 0.5, 0.25) * std::f64::consts::PI;
            assert!((irradiance - expected).length() < 1e-4, "{degrees}: {irradiance}");
            assert_eq!(sun.toward(-sun.direction).radiance, Vec3::ZERO);
        }
    }
}
