//! The rays that go on from surfaces, and the light that they bring.

use glam::{DVec3, Vec3};

use super::{
    Path,
    pixel::{PixelSums, Sharing},
    sight::{Expected, SightOf},
};
use crate::intersect::ray::Ray;

/// The light that a ray brings to a pixel.
#[derive(Clone, Copy)]
pub(super) struct Contribution {
    /// The paths that it comes to.
    pub(super) sharing: Sharing,
    pub(super) light: Vec3,
    /// Whether it comes where the ray hits something, as the light that the ground loses there, rather than where it hits nothing.
    pub(super) comes_with_hit: bool,
    /// The light that the ray is sent to, if it starts on the surface that the camera sees.
    pub(super) sight: Option<SightOf>,
}

impl Contribution {
    /// Adds what the ray is expected to bring, if it is known. Returns what it brings besides, which is the difference if it finds
    /// otherwise, and the part of such rays that is traced; `None` where `random`, from 0 to 1, is not below that part.
    pub(super) fn beyond(self, random: impl FnOnce() -> f32, sums: &mut PixelSums<'_>) -> Option<(Self, f32)> {
        let expected = self.sight.and_then(|of| sums.expected(self.sharing, of));
        let Some(Expected { is_blocked, traced_part }) = expected else { return Some((self, 1.0)) };
        let is_expected_to_come = self.comes_with_hit == is_blocked;
        if is_expected_to_come {
            sums.add(self.sharing, self.light);
        }
        let sign = if is_expected_to_come { -1.0 } else { 1.0 };
        let light = self.light * (sign / traced_part);
        (random() < traced_part).then_some((Self { light, comes_with_hit: !is_blocked, ..self }, traced_part))
    }
}

/// The rays that go on from the surfaces of many paths.
pub(super) struct NextRays {
    /// Those that only ask whether they hit anything.
    pub(super) shadow_rays: Vec<Ray>,
    pub(super) contributions_of_shadow_rays: Vec<Contribution>,
    pub(super) paths: Vec<Path>,
    /// Of each path's ray.
    pub(super) contributions_of_paths: Vec<Contribution>,
}

impl NextRays {
    /// None yet, with room for those of so many paths: to make room later took a hundredth of a picture's time.
    pub(super) fn of(n_paths: usize) -> Self {
        Self {
            shadow_rays: Vec::with_capacity(n_paths),
            contributions_of_shadow_rays: Vec::with_capacity(n_paths),
            paths: Vec::with_capacity(n_paths),
            contributions_of_paths: Vec::with_capacity(n_paths),
        }
    }

    /// Adds a shadow ray of this length.
    pub(super) fn push_shadow_ray(
        &mut self,
        (origin, direction, length): (DVec3, Vec3, f32),
        contribution: Contribution,
    ) {
        if contribution.light != Vec3::ZERO {
            self.shadow_rays.push(Ray { t_max: length, ..Ray::new(origin.as_vec3(), direction) });
            self.contributions_of_shadow_rays.push(contribution);
        }
    }
}
