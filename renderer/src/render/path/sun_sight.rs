//! Rays to the sun that are not traced, because those of the neighbourhood all find the same.
//!
//! Where every ray of a pixel and its neighbours reaches the sun, or none does, the next one is expected to do so too: its light is
//! added as if it did, and only a part of these rays is traced. One that finds otherwise takes back what was added for all that
//! it stands for: a control variate (Owen, *Monte Carlo theory, methods and examples*, 2013, section 8.9) whose difference is found
//! by Russian roulette (Arvo and Kirk, "Particle Transport and Image Synthesis", 1990). So the mean light is right whatever is
//! expected, as long as it is decided before; a wrong expectation only adds noise.

/// A pixel's sight of the sun, from the surfaces that its camera rays hit, as its rays have found it.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::render) struct SunSight {
    /// Number of rays that reached the sun.
    pub(in crate::render) n_lit: u32,
    /// Number of rays that did not.
    pub(in crate::render) n_shaded: u32,
    /// The expected finding of further rays.
    pub(in crate::render) expected: Option<Expected>,
}

/// The expected finding of a pixel's next rays to the sun.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::render) struct Expected {
    /// Whether they do not reach it.
    pub(super) is_shaded: bool,
    /// The part of them that is traced, above 0.
    pub(super) traced_part: f32,
}

/// From one estimate to the next, a pixel's rays to the sun are at least so many, so that one that finds otherwise does not
/// change its mean by more than a quarter of the sun's light.
const FEWEST_TRACED: f32 = 4.0;

/// Fewer rays are never traced: the others cost less than what finds otherwise adds in noise.
const LEAST_TRACED_PART: f32 = 0.0625;

/// Of so many rays, none or one may find otherwise. With more, it takes fewer rays to trace all of them.
const AGREEING: f64 = 256.0;

impl Expected {
    /// The expected finding of the next `n_rays` rays of a pixel, after those of its neighbourhood, of which so many reached the
    /// sun, and so many did not. `None` if they disagree.
    pub(in crate::render) fn after(n_rays: u32, [n_lit, n_shaded]: [f64; 2]) -> Option<Self> {
        let is_shaded = n_shaded > n_lit;
        let agree = n_lit.min(n_shaded) * AGREEING <= n_lit + n_shaded && n_lit + n_shaded > 0.0;
        let traced_part = (FEWEST_TRACED / n_rays as f32).clamp(LEAST_TRACED_PART, 1.0);
        agree.then_some(Self { is_shaded, traced_part })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_are_expected_to_find_what_all_of_the_neighbourhood_found() {
        let shaded = |n_rays, counts| {
            Expected::after(n_rays, counts).map(|Expected { is_shaded, traced_part }| (is_shaded, traced_part))
        };
        assert_eq!(shaded(8, [200.0, 0.0]), Some((false, 0.5)));
        assert_eq!(shaded(16, [0.0, 3.0]), Some((true, 0.25)));
        assert_eq!(shaded(256, [0.0, 3.0]), Some((true, 0.0625)));
        assert_eq!(shaded(2, [1.0, 0.0]), Some((false, 1.0)));
        assert_eq!([[0.0, 0.0], [200.0, 1.0], [5.0, 5.0]].map(|counts| shaded(8, counts)), [None; 3]);
        assert_eq!(shaded(32, [2.0, 510.0]), Some((true, 0.125)));
    }
}
