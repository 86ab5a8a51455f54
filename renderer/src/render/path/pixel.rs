//! Light and findings of a pixel's paths, and how its next are traced.

use glam::Vec3;

use super::{
    rays::Contribution,
    sight::{Expected, SightOf, Sights},
};
use crate::intersect::MOST_PACKETS;

/// Pixels of a group of blocks: so many sums lie between those of a sample and of the next.
const PIXELS: usize = 64 * MOST_PACKETS;

/// Findings of a pixel's paths, and how its next are traced.
#[derive(Clone, Copy, Debug)]
pub(in crate::render) struct PixelPaths {
    /// Sum of the light that paths with the same camera ray share: the background's, and what the ray's surface gives off, or
    /// scatters from sun and lamp.
    pub(in crate::render) shared_light: Vec3,
    /// Number of paths that share each of the next camera rays.
    pub(in crate::render) n_paths: u32,
    pub(in crate::render) n_camera_rays: u32,
    /// Number of all other rays.
    pub(in crate::render) n_other_rays: u32,
}

impl Default for PixelPaths {
    fn default() -> Self {
        Self { shared_light: Vec3::ZERO, n_paths: 1, n_camera_rays: 0, n_other_rays: 0 }
    }
}

impl PixelPaths {
    /// Number of rays that each camera ray takes with what its paths share, and number that each of `n_samples` paths takes alone;
    /// so many of all rays go to the sun from surfaces that camera rays hit.
    pub(in crate::render) fn rays_of_parts(&self, n_samples: u32, n_sun_rays: u16) -> [f64; 2] {
        let of_camera = 1.0 + f64::from(n_sun_rays) / f64::from(self.n_camera_rays);
        [of_camera, (f64::from(self.n_other_rays) - f64::from(n_sun_rays)) / f64::from(n_samples)]
    }
}

/// Paths that share light: the first one's index among the sums of light, and their number. Their samples follow each other.
#[derive(Clone, Copy)]
pub(super) struct Sharing {
    pub(super) first: usize,
    pub(super) n_paths: u32,
    /// Whether they share it because they have the same camera ray.
    pub(super) is_direct: bool,
}

impl Sharing {
    /// The path with this number among them, alone.
    pub(super) fn alone(self, number: u32) -> Self {
        Self { first: self.first + PIXELS * number as usize, n_paths: 1, is_direct: false }
    }
}

/// Sums of the light that paths bring, and what they have found, by pixel.
pub(in crate::render) struct PixelSums<'a> {
    /// Of each sample: the samples follow each other, each with all pixels of a group of blocks.
    pub(in crate::render) lights: &'a mut [Vec3],
    /// Of all samples.
    pub(in crate::render) pixels: &'a mut [PixelPaths],
    /// Empty where nobody asks for them.
    pub(in crate::render) sights: &'a mut [Sights],
}

impl PixelSums<'_> {
    /// Findings of the paths of the same pixel.
    fn paths(&mut self, sharing: Sharing) -> &mut PixelPaths {
        &mut self.pixels[sharing.first % PIXELS]
    }

    /// The expected finding of a ray of these paths to a light.
    pub(super) fn expected(&self, sharing: Sharing, of: SightOf) -> Option<Expected> {
        self.sights.get(sharing.first % PIXELS)?.expected(of)
    }

    /// Adds light to each of these paths.
    pub(super) fn add(&mut self, sharing: Sharing, light: Vec3) {
        for path in 0..sharing.n_paths {
            self.lights[sharing.alone(path).first] += light;
        }
        if sharing.is_direct {
            self.paths(sharing).shared_light += light * sharing.n_paths as f32;
        }
    }

    /// Adds what a ray has found: its light, and the sight.
    pub(super) fn add_found(&mut self, contribution: Contribution, is_blocked: bool) {
        let Contribution { sharing, light, comes_with_hit, sight } = contribution;
        if comes_with_hit == is_blocked {
            self.add(sharing, light);
        }
        self.paths(sharing).n_other_rays += 1;
        if let (Some(of), Some(sights)) = (sight, self.sights.get_mut(sharing.first % PIXELS)) {
            sights.count(of, is_blocked);
        }
    }
}
