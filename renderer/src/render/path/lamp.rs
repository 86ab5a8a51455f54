//! A lamp at the eye, for rooms and the insides of models: little of sun and sky comes in there.

use std::f32::consts::PI;

use glam::{DVec3, Vec3};
use shared::appearance::ClipPlane;

use super::sobol::PixelSample;
use crate::{
    grid::Grid,
    intersect::{
        clip,
        ray::{Hit, Ray},
    },
    render::sampling::circle_point,
};

/// A lamp at the eye: the more of the sky surfaces hide, the brighter.
///
/// Its light falls off as that of a disc as large as the room, which faces the surface: at the room's distance to half of
/// that close by, and far away with the square. So nothing close to the eye is dazzling.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lamp {
    /// In model space.
    point: DVec3,
    /// The square of the room's distance: the mean over the directions in which there is a surface.
    square_distance: f64,
    /// `π` times the light that a white surface at the room's distance scatters.
    light: Vec3,
}

/// Directions in which an eye looks for surfaces.
const N_LOOKS: u32 = 256;

/// The lamp is off where at least this part of the directions finds the sky: from outside of a convex model, that is half.
const OPEN: f32 = 0.5;

/// The part of the sun's light that the lamp has in a closed room: light bounces there, and walls that scatter 0.6 of it
/// gather 1 + 0.6 + 0.6² + … = 2.5 times the light.
const PART_OF_SUN: f32 = 0.4;

impl Lamp {
    /// The lamp at an eye, where a white surface that faces the sun scatters the light `sun`; `None` where enough of the sky
    /// is open.
    pub(super) fn at(grid: &Grid, clip: Option<&ClipPlane>, eye: DVec3, sun: Vec3) -> Option<Self> {
        let rays: [_; N_LOOKS as usize] = std::array::from_fn(|look| {
            // Equal steps of height are equal areas of a sphere.
            let [height, around] = PixelSample::new((0, 0), look as u32).pair(0);
            let (z, [x, y]) = (1.0 - 2.0 * height, circle_point(around));
            let radius = (1.0 - z * z).sqrt();
            Ray::new(eye.as_vec3(), Vec3::new(x * radius, y * radius, z))
        });
        let mut hits = [Hit::MISS; N_LOOKS as usize];
        clip::intersect_rays(grid, clip, &rays, &mut hits);
        let squares = hits.iter().filter(|hit| !hit.is_miss()).map(|hit| f64::from(hit.t) * f64::from(hit.t));
        let (n_closed, sum) = squares.fold((0, 0.0), |(n, sum), square| (n + 1, sum + square));
        let open = 1.0 - n_closed as f32 / N_LOOKS as f32;
        let light = sun * (PI * PART_OF_SUN * (1.0 - open / OPEN));
        (open < OPEN).then(|| Self { point: eye, square_distance: sum / f64::from(n_closed), light })
    }

    /// The way to the lamp, and `π` times the light that a white surface scatters which faces the lamp.
    pub(super) fn toward(&self, point: DVec3) -> (DVec3, Vec3) {
        let way = self.point - point;
        (way, self.light * (2.0 * self.square_distance / (self.square_distance + way.length_squared())) as f32)
    }
}
