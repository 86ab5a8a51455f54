//! A camera in the virtual room: a pinhole in space, with a true lens and sensor.
//!
//! Lengths are metres: x is right, y up, z towards the audience. Points of the wall are places on it unrolled, as in
//! [`super::surface`]. It shares no code with the wall's.

use glam::{DVec2, DVec3};
use image::{ExtendedColorType, GrayImage, ImageFormat, RgbImage, codecs::jpeg::JpegEncoder};
use rayon::prelude::*;

use super::{projector::TrueProjector, surface::Surface};

/// The geometry of projectors and cameras.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pinhole {
    position: DVec3,
    right: DVec3,
    down: DVec3,
    forward: DVec3,
    focal_px: f64,
    centre_px: DVec2,
    /// The wall that it looks at.
    surface: Surface,
}

impl Pinhole {
    /// Looks from a place to a point of the wall, rolled clockwise by an angle.
    pub(crate) fn new(
        surface: Surface,
        position: DVec3,
        target: DVec2,
        roll: f64,
        focal_px: f64,
        centre_px: DVec2,
    ) -> Self {
        let forward = (surface.in_space(target) - position).normalize();
        let right = forward.cross(DVec3::Y).normalize();
        let down = forward.cross(right);
        let (sin, cos) = roll.sin_cos();
        let (right, down) = (right * cos + down * sin, down * cos - right * sin);
        Self { position, right, down, forward, focal_px, centre_px, surface }
    }

    /// Turned to the side and up by angles, as after a bump.
    pub(crate) fn bumped(&self, [aside, up]: [f64; 2]) -> Self {
        let forward = (self.forward + aside * self.right - up * self.down).normalize();
        let right = (self.right - self.right.dot(forward) * forward).normalize();
        Self { forward, right, down: forward.cross(right), ..*self }
    }

    /// The pixel that sees, or lights, a point of the wall.
    pub(crate) fn px(&self, point: DVec2) -> DVec2 {
        let away = self.surface.in_space(point) - self.position;
        let depth = away.dot(self.forward);
        DVec2::new(away.dot(self.right), away.dot(self.down)) / depth * self.focal_px + self.centre_px
    }

    /// The point of the wall at a pixel.
    pub(crate) fn point(&self, px: DVec2) -> DVec2 {
        let slope = (px - self.centre_px) / self.focal_px;
        let ray = self.forward + slope.x * self.right + slope.y * self.down;
        self.surface.met(self.position, ray)
    }
}

/// A camera: where it is, its lens, its sensor, and the file that it writes.
#[derive(Clone, Debug)]
pub(crate) struct Camera {
    pub(crate) pinhole: Pinhole,
    pub(crate) size: [usize; 2],
    /// Brown's radial and tangential coefficients, from the pinhole's picture to the photograph, in focal lengths.
    pub(crate) radial: [f64; 3],
    pub(crate) tangential: [f64; 2],
    /// The signal of a projector's white; 1 saturates.
    pub(crate) exposure: f64,
    /// Light in the room, as a part of a projector's white.
    pub(crate) ambient: f64,
    /// The standard deviation of the noise at saturation; it falls with the root of the light.
    pub(crate) noise: f64,
    /// The standard deviation of the lens's blur, in pixels.
    pub(crate) blur_px: f64,
    /// The quality of the JPEG; `None` writes a PNG.
    pub(crate) jpeg: Option<u8>,
    /// What its red, green and blue see of projectors' red, green and blue; `None` for a camera without colours.
    pub(crate) colours: Option<[[f64; 3]; 3]>,
}

/// The channels of cameras without colours.
const GREY: [f64; 3] = [0.25, 0.5, 0.25];

/// Pixels of a photograph for which projectors are chosen together; each is smaller than four of a projector's.
const RUN: usize = 16;

/// Something dark between camera and wall: a rectangle of the photograph, as parts of its width and height.
pub(crate) type Obstacle = [DVec2; 2];

impl Camera {
    fn distorted(&self, d: DVec2) -> DVec2 {
        let r2 = d.length_squared();
        let ([k1, k2, k3], [p1, p2]) = (self.radial, self.tangential);
        let tangential = DVec2::new(
            2.0 * p1 * d.x * d.y + p2 * (r2 + 2.0 * d.x * d.x),
            p1 * (r2 + 2.0 * d.y * d.y) + 2.0 * p2 * d.x * d.y,
        );
        d * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) + tangential
    }

    /// The point of the wall at a place of the photograph, in pixels.
    pub(crate) fn point(&self, at: DVec2) -> DVec2 {
        let Pinhole { focal_px, centre_px, .. } = self.pinhole;
        let seen = (at - centre_px) / focal_px;
        let mut d = seen;
        // The distortion is small, so this converges by a digit each time.
        for _ in 0..20 {
            let away = seen - self.distorted(d);
            d += away;
            if away.length_squared() < 1e-22 {
                break;
            }
        }
        self.pinhole.point(d * focal_px + centre_px)
    }

    /// The place of a point of the wall in the photograph.
    pub(crate) fn px(&self, point: DVec2) -> DVec2 {
        let Pinhole { focal_px, centre_px, .. } = self.pinhole;
        self.distorted((self.pinhole.px(point) - centre_px) / focal_px) * focal_px + centre_px
    }

    /// Takes a photograph, and returns the bytes of its file; equal seeds give equal noise.
    pub(crate) fn photograph(&self, projectors: &[TrueProjector], obstacle: Option<Obstacle>, seed: u64) -> Vec<u8> {
        let [width, height] = self.size;
        let size = DVec2::new(width as f64, height as f64);
        let n_channels = if self.colours.is_some() { 3 } else { 1 };
        let seen_by: Vec<[f64; 3]> = self.colours.map_or(vec![GREY], |colours| colours.to_vec());
        let mut light = vec![0_f32; n_channels * width * height];
        light.par_chunks_mut(n_channels * width).enumerate().for_each(|(y, row)| {
            // Within a pixel, the way to the wall is linear.
            let edge = |x: usize| [y, y + 1].map(|y| self.point(DVec2::new(x as f64, y as f64)));
            let mut left = edge(0);
            let mut near: Vec<&TrueProjector> = Vec::new();
            for (x, out) in row.chunks_exact_mut(n_channels).enumerate() {
                let right = edge(x + 1);
                if x % RUN == 0 {
                    near = projectors.iter().filter(|it| it.is_near(left[0], 4.0 * RUN as f64)).collect();
                }
                let mut sum = [0.0; 3];
                for (s, t) in [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)] {
                    let point = left[0].lerp(right[0], s).lerp(left[1].lerp(right[1], s), t);
                    for light in near.iter().map(|projector| projector.light_at(point)) {
                        sum = std::array::from_fn(|channel| sum[channel] + light[channel] / 4.0);
                    }
                }
                let at = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                let is_hidden =
                    obstacle.is_some_and(|[from, to]| at.cmpge(from * size).all() && at.cmple(to * size).all());
                let vignette = (1.0 + 1.2 * ((at - size / 2.0) / size.x).length_squared()).powi(-2);
                // The room is a little brighter on one side.
                let ambient = self.ambient * (1.0 + 0.3 * (at.x / size.x - 0.5));
                for (out, seen_by) in out.iter_mut().zip(&seen_by) {
                    let projected: f64 = std::iter::zip(seen_by, sum).map(|(part, light)| part * light).sum();
                    let seen = if is_hidden { 0.3 * ambient } else { projected + ambient };
                    *out = (seen * vignette * self.exposure) as f32;
                }
                left = right;
            }
        });
        let mut values = vec![0_u8; light.len()];
        for channel in 0..n_channels {
            let plane: Vec<f32> = light.iter().skip(channel).step_by(n_channels).copied().collect();
            let plane = blurred(&blurred(&plane, [width, height], self.blur_px), [height, width], self.blur_px);
            values.par_chunks_mut(n_channels * width).enumerate().for_each(|(y, row)| {
                let mut random = Random::new(seed ^ (channel as u64) << 16 ^ ((y as u64 + 1) << 32));
                for (x, out) in row.iter_mut().skip(channel).step_by(n_channels).enumerate() {
                    let light = f64::from(plane[y * width + x]);
                    let noisy = light + random.normal() * self.noise * (light.max(0.0) + 0.02).sqrt();
                    *out = (255.0 * response(noisy.clamp(0.0, 1.0))).round() as u8;
                }
            });
        }
        self.encoded(values)
    }

    fn encoded(&self, values: Vec<u8>) -> Vec<u8> {
        let [width, height] = self.size.map(|side| side as u32);
        let mut file = std::io::Cursor::new(Vec::new());
        match (self.jpeg, self.colours) {
            (Some(quality), _) => {
                let is_grey = self.colours.is_none();
                let rgb = if is_grey { values.iter().flat_map(|value| [*value; 3]).collect() } else { values };
                let mut encoder = JpegEncoder::new_with_quality(&mut file, quality);
                encoder.encode(&rgb, width, height, ExtendedColorType::Rgb8)
            }
            (None, None) => GrayImage::from_raw(width, height, values)
                .expect("a value a pixel")
                .write_to(&mut file, ImageFormat::Png),
            (None, Some(_)) => RgbImage::from_raw(width, height, values)
                .expect("three values a pixel")
                .write_to(&mut file, ImageFormat::Png),
        }
        .expect("memory takes every photograph");
        file.into_inner()
    }
}

/// The grey values of a photograph's file, from 0 to 1, and its colours.
pub(crate) fn decoded(file: &[u8]) -> (Vec<f32>, RgbImage) {
    let image = image::load_from_memory(file).expect("a photograph that was encoded here");
    let grey = image.to_luma8().into_raw().into_iter().map(|value| f32::from(value) / 255.0).collect();
    (grey, image.into_rgb8())
}

/// A camera's curve: sRGB's with more contrast in the middle.
fn response(light: f64) -> f64 {
    let encoded = if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
    encoded - 0.04 * (std::f64::consts::TAU * encoded).sin()
}

/// Blurred along rows by a Gaussian, and transposed: twice blurs both ways, and is the right way round again.
fn blurred(values: &[f32], [width, height]: [usize; 2], sigma: f64) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as usize;
    let weights: Vec<f64> = (0..=2 * radius)
        .map(|index| (-0.5 * ((index as f64 - radius as f64) / sigma.max(1e-3)).powi(2)).exp())
        .collect();
    let sum: f64 = weights.iter().sum();
    let mut out = vec![0.0; values.len()];
    out.par_chunks_mut(height).enumerate().for_each(|(x, column)| {
        let taps: Vec<(usize, f32)> = weights
            .iter()
            .enumerate()
            .map(|(index, weight)| ((x + index).saturating_sub(radius).min(width - 1), (weight / sum) as f32))
            .collect();
        for (y, out) in column.iter_mut().enumerate() {
            let row = &values[y * width..][..width];
            *out = taps.iter().map(|(x, weight)| row[*x] * weight).sum();
        }
    });
    out
}

/// Random numbers: a linear congruential generator with a mixed output.
#[derive(Clone, Debug)]
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        let mut random = Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        random.part();
        random
    }

    /// From 0 to 1.
    pub(crate) fn part(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let mixed = (self.0 ^ self.0 >> 33).wrapping_mul(0xff51_afd7_ed55_8ccd);
        ((mixed ^ mixed >> 33) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// From -`most` to `most`.
    pub(crate) fn around(&mut self, most: f64) -> f64 {
        (2.0 * self.part() - 1.0) * most
    }

    /// Normally distributed, with standard deviation 1 (Box and Muller 1958).
    fn normal(&mut self) -> f64 {
        let (radius, angle) = (self.part().max(1e-300), self.part());
        (-2.0 * radius.ln()).sqrt() * (std::f64::consts::TAU * angle).cos()
    }
}
