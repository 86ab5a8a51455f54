//! Rays to sun and sky that are not traced, because those of the neighbourhood all find the same.
//!
//! Where every ray of a pixel and its neighbours reaches the sun, or none does, the next one is expected to do so too: its light is
//! added as if it did, and only a part of these rays is traced. One that finds otherwise takes back what was added for all that
//! it stands for: a control variate (Owen, *Monte Carlo theory, methods and examples*, 2013, section 8.9) whose difference is found
//! by Russian roulette (Arvo and Kirk, "Particle Transport and Image Synthesis", 1990). So the mean light is right whatever is
//! expected, as long as it is decided before; a wrong expectation only adds noise.
//!
//! The same holds for paths that leave the surface for a part of the sky. Those that meet another surface go on, and light from
//! there stands for all that were not traced.

use glam::Vec3;

/// Which light a ray is sent to, from the surface that a camera ray hits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum SightOf {
    Sun,
    /// The [part](sky_part) of the sky toward which the path goes on.
    Sky {
        part: u8,
    },
}

/// Number of parts of the sky. More of them would see what stands before the sky more sharply, but fewer rays each.
const N_SKY_PARTS: usize = 24;

/// The part of the sky that lies in a direction in world space: its octant, and the axis that it is nearest to. What stands beside
/// a surface hides the same parts from its neighbours, wherever these face.
pub(super) fn sky_part(direction: Vec3) -> u8 {
    (direction.abs().max_position() * 8) as u8 + direction.is_negative_bitmask() as u8
}

/// Number of lights that rays are sent to: the sun, and the parts of the sky.
pub(in crate::render) const N_LIGHTS: usize = 1 + N_SKY_PARTS;

impl SightOf {
    /// Its number among the lights.
    fn index(self) -> usize {
        match self {
            Self::Sun => 0,
            Self::Sky { part } => 1 + usize::from(part),
        }
    }
}

/// A pixel's sight of the lights, from the surfaces that its camera rays hit, as its rays have found it.
#[derive(Clone, Debug, Default)]
pub(in crate::render) struct Sights {
    /// Numbers of open and of blocked rays to each light, at most one a sample.
    pub(in crate::render) found: [[u16; 2]; N_LIGHTS],
    /// The expected finding of further rays to each light.
    pub(super) expected: [Option<Expected>; N_LIGHTS],
}

impl Sights {
    /// The expected finding of a ray to a light.
    pub(super) fn expected(&self, of: SightOf) -> Option<Expected> {
        self.expected[of.index()]
    }

    /// Number of rays to the sun.
    pub(in crate::render) fn n_sun_rays(&self) -> u16 {
        self.found[SightOf::Sun.index()].iter().sum()
    }

    /// Counts a ray's finding.
    pub(super) fn count(&mut self, of: SightOf, is_blocked: bool) {
        self.found[of.index()][usize::from(is_blocked)] += 1;
    }

    /// Decides what the pixel's next rays to the sun and its next paths, in these numbers, are expected to find, after those of
    /// the `n_pixels` pixels of its neighbourhood, of which so many to each light were open, and so many blocked.
    pub(in crate::render) fn expect(
        &mut self,
        [n_sun_rays, n_paths]: [u32; 2],
        ([of_sun, of_sky @ ..], n_pixels): ([[u32; 2]; N_LIGHTS], u32),
    ) {
        let [expected_of_sun, expected_of_sky @ ..] = &mut self.expected;
        *expected_of_sun = Expected::of_sun(n_sun_rays, of_sun);
        for (expected, found) in expected_of_sky.iter_mut().zip(of_sky) {
            *expected = Expected::of_sky(n_paths, found, n_pixels);
        }
    }
}

/// The expected finding of a pixel's next rays to a light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Expected {
    /// Whether something blocks them.
    pub(super) is_blocked: bool,
    /// The part of them that is traced, above 0.
    pub(super) traced_part: f32,
}

/// From one estimate to the next, at least so many of a pixel's rays are traced, so that one that finds otherwise does not change
/// its mean by more than a quarter of the light.
const FEWEST_TRACED: f32 = 2.0;

/// Fewer rays to the sun are never traced: the others cost less than what finds otherwise adds in noise.
const LEAST_PART_OF_SUN: f32 = 0.0625;

/// The same of paths that are expected to leave for the sky. Those that do not bring light of many kinds, and more noise.
const LEAST_PART_OF_SKY: f32 = 0.25;

/// The least number of a pixel's rays toward a part of the sky, in the mean of its neighbourhood, that tells what stands before
/// it.
const FEWEST_FOUND: u32 = 2;

/// Of so many rays, none or one may find otherwise. With more, it takes fewer rays to trace all of them.
const AGREEING: u32 = 256;

impl Expected {
    /// The expected finding of the next `n_rays` rays of a pixel to the sun, after those of its neighbourhood, of which so many
    /// were open, and so many blocked. `None` if they disagree.
    fn of_sun(n_rays: u32, found: [u32; 2]) -> Option<Self> {
        Self::after(n_rays, found, LEAST_PART_OF_SUN)
    }

    /// The same of a pixel's next `n_paths` paths that go on toward a part of the sky, after those of `n_pixels` pixels. `None`
    /// also if they meet other surfaces, as only these know the light from there, and if they are few.
    fn of_sky(n_paths: u32, found: [u32; 2], n_pixels: u32) -> Option<Self> {
        let is_known = found.iter().sum::<u32>() >= FEWEST_FOUND * n_pixels;
        Self::after(n_paths, found, LEAST_PART_OF_SKY).filter(|expected| is_known && !expected.is_blocked)
    }

    fn after(n_rays: u32, [n_open, n_blocked]: [u32; 2], least_part: f32) -> Option<Self> {
        let is_blocked = n_blocked > n_open;
        let agree = n_open.min(n_blocked) * AGREEING <= n_open + n_blocked && n_open + n_blocked > 0;
        let traced_part = (FEWEST_TRACED / n_rays as f32).clamp(least_part, 1.0);
        agree.then_some(Self { is_blocked, traced_part })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_part_of_the_sky_is_a_third_of_an_octant() {
        let middle = [0, 1, 2].map(|axis| Vec3::splat(0.5) + 0.5 * Vec3::AXES[axis]);
        let signs = |octant: usize| [0, 1, 2].map(|axis| if octant >> axis & 1 == 0 { 1.0 } else { -1.0 });
        let directions = middle.iter().flat_map(|&middle| (0..8).map(move |octant| middle * Vec3::from(signs(octant))));
        let parts: Vec<_> = directions.map(sky_part).collect();
        assert_eq!(parts, (0..N_SKY_PARTS as u8).collect::<Vec<_>>());
    }

    #[test]
    fn rays_are_expected_to_find_what_all_of_the_neighbourhood_found() {
        let pair = |Expected { is_blocked, traced_part }| (is_blocked, traced_part);
        let of_sun = |n_rays, found| Expected::of_sun(n_rays, found).map(pair);
        assert_eq!(of_sun(8, [200, 0]), Some((false, 0.25)));
        assert_eq!(of_sun(16, [0, 3]), Some((true, 0.125)));
        assert_eq!(of_sun(256, [0, 3]), Some((true, 0.0625)));
        assert_eq!(of_sun(2, [1, 0]), Some((false, 1.0)));
        assert_eq!([[0, 0], [200, 1], [5, 5]].map(|found| of_sun(8, found)), [None; 3]);
        assert_eq!(of_sun(16, [2, 510]), Some((true, 0.125)));

        let of_sky = |n_paths, found| Expected::of_sky(n_paths, found, 9).map(pair);
        assert_eq!([4, 8, 256].map(|n| of_sky(n, [70, 0])), [0.5, 0.25, 0.25].map(|part| Some((false, part))));
        assert_eq!([[0, 70], [70, 1], [17, 0]].map(|found| of_sky(8, found)), [None; 3]);
    }

    #[test]
    fn each_light_has_its_own_expected_finding() {
        let mut sights = Sights::default();
        let parts = [2, 7].map(|part| SightOf::Sky { part });
        let mut found = [[0; 2]; N_LIGHTS];
        for (of, is_blocked) in [(SightOf::Sun, true), (parts[0], false), (parts[1], true)] {
            sights.count(of, is_blocked);
            found[of.index()] = sights.found[of.index()].map(|n| 20 * u32::from(n));
        }
        assert_eq!(sights.found.iter().flatten().map(|n| u32::from(*n)).sum::<u32>(), 3);
        sights.expect([8, 4], (found, 9));
        assert_eq!(sights.expected(SightOf::Sun), Some(Expected { is_blocked: true, traced_part: 0.25 }));
        assert_eq!(sights.expected(parts[0]), Some(Expected { is_blocked: false, traced_part: 0.5 }));
        assert_eq!(sights.expected.iter().flatten().count(), 2);
    }
}
