//! A sky image as a light: its radiance by direction, and directions by their light.
//!
//! Texels are chosen in proportion to their light, rows first, as in Pharr, Jakob and Humphreys, *Physically Based Rendering*
//! (4th edition, 2023, section 12.5). Only + − × ÷ √ are used, in a fixed order: every machine computes the same bits.

use std::{f32::consts::PI, path::Path};

use glam::{DVec3, Vec3};
use shared::{
    appearance::{Appearance, Light},
    sky::SkyId,
};

use crate::{
    formats::sky::{SkyError, SkyImage},
    render::{
        path::lights::LightSample,
        sampling::{circle_point, circle_turns},
    },
};

/// A sky image with the tables that sample it.
#[derive(Clone, Debug)]
pub struct SkyMap {
    id: SkyId,
    image: SkyImage,
    /// For each row the part of the light that comes from the rows up to it.
    rows: Vec<f32>,
    /// For each texel the part of its row's light that comes from the texels up to it.
    columns: Vec<f32>,
    /// The density of samples, for each steradian, over the texel's weight and the sine of the angle from the zenith.
    density_of_weight: f32,
    /// The light that a white surface scatters which faces the image's top.
    scattered_up: Vec3,
}

/// A sky map around a model.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlacedSky<'a> {
    map: &'a SkyMap,
    /// Unit vectors to the image's middle, to the right of it, and up, in world space.
    axes: [Vec3; 3],
}

/// Angles from the zenith have at least this sine: at the poles themselves densities would be infinite.
const LEAST_SINE: f32 = 1e-5;

impl SkyMap {
    /// Reads and prepares an image.
    ///
    /// # Errors
    /// As for [`SkyImage::read`].
    pub fn read(path: &Path) -> Result<Self, SkyError> {
        Ok(Self::new(SkyImage::read(path)?))
    }

    /// Prepares an image.
    pub fn new(image: SkyImage) -> Self {
        let (mut rows, mut columns) = (Vec::new(), Vec::new());
        let mut of_rows = 0.0f64;
        for row in 0..image.height {
            let weights = (0..image.width).map(|column| f64::from(weight(&image, row, column)));
            let mut of_row = 0.0f64;
            let sums: Vec<_> = weights
                .map(|weight| {
                    of_row += weight;
                    of_row
                })
                .collect();
            columns.extend(sums.iter().map(|sum| if of_row > 0.0 { (sum / of_row) as f32 } else { 0.0 }));
            of_rows += of_row;
            rows.push(of_rows);
        }
        let rows = rows.into_iter().map(|sum| (sum / of_rows) as f32).collect();
        let n_texels = f64::from(image.width) * f64::from(image.height);
        let square = f64::from(PI) * f64::from(PI);
        let density_of_weight = (n_texels / (2.0 * square * of_rows)) as f32;
        let scattered_up = scattered_up(&image);
        Self { id: image.id(), image, rows, columns, density_of_weight, scattered_up }
    }

    /// Names its light on all machines.
    pub fn id(&self) -> SkyId {
        self.id
    }

    /// Bytes in memory.
    pub fn n_bytes(&self) -> usize {
        size_of_val(&*self.image.texels) + size_of_val(&*self.rows) + size_of_val(&*self.columns)
    }

    /// Places the image around a model whose axis `up` points up. Its middle stands where the model is seen from at first; the
    /// key light's azimuth turns it from there, as it does the key light.
    ///
    /// `None` for pictures without it.
    pub(super) fn placed(&self, appearance: &Appearance) -> Option<PlacedSky<'_>> {
        appearance.sky.filter(|&id| id == self.id)?;
        let [up, front] = [appearance.up.direction(), appearance.up.front()].map(DVec3::as_vec3);
        let turned = Light::new(appearance.light.azimuth_deg(), 0).unwrap_or_default().direction().as_vec3();
        let middle = front * turned.z + up.cross(front) * turned.x;
        Some(PlacedSky { map: self, axes: [middle, middle.cross(up), up] })
    }
}

/// The number of samples that a texel gets, relative to others: its light times its solid angle.
fn weight(image: &SkyImage, row: u32, column: u32) -> f32 {
    let [red, green, blue] = image.texels[(row * image.width + column) as usize];
    let [_, sine] = circle_point((row as f32 + 0.5) / (2.0 * image.height as f32));
    (red + green + blue) * (1.0 / 3.0) * sine
}

/// The light that a white surface scatters which faces the image's top.
fn scattered_up(image: &SkyImage) -> Vec3 {
    let angle = f64::from(PI) / f64::from(image.height);
    let of_row = |(row, texels): (usize, &[[f32; 3]])| {
        let [cosine, sine] = circle_point((row as f32 + 0.5) / (2.0 * image.height as f32)).map(f64::from);
        let light: DVec3 = texels.iter().map(|&texel| Vec3::from(texel).as_dvec3()).sum();
        light * (cosine * sine * angle * angle / f64::from(PI))
    };
    let upper = image.texels.chunks(image.width as usize).take(image.height as usize / 2);
    upper.enumerate().map(of_row).sum::<DVec3>().as_vec3()
}

impl PlacedSky<'_> {
    /// The light that a white surface scatters which faces the image's top, where nothing is in the way.
    pub(super) fn scattered_up(&self) -> Vec3 {
        self.map.scattered_up
    }

    /// Samples the sky in proportion to its light, from a point of the unit square.
    pub(super) fn sample(&self, [u, v]: [f32; 2]) -> LightSample {
        let SkyMap { image, rows, columns, .. } = self.map;
        let width = image.width as usize;
        let (row, down) = choose(rows, v);
        let (column, across) = choose(&columns[row * width..(row + 1) * width], u);
        let [cosine, sine] = circle_point((row as f32 + down) / (2.0 * image.height as f32));
        let [x, y] = circle_point((column as f32 + across) / image.width as f32);
        let [middle, right, up] = self.axes;
        let direction = (middle * x + right * y) * -sine + up * cosine;
        self.texel(row as u32, column as u32, direction, sine)
    }

    /// The light from a direction, and the density of samples there.
    pub(super) fn toward(&self, direction: Vec3) -> LightSample {
        let SkyMap { image, .. } = self.map;
        let [x, y, cosine] = self.axes.map(|axis| direction.dot(axis));
        let sine = (x * x + y * y).sqrt();
        let row = circle_turns([cosine, sine]) * 2.0 * image.height as f32;
        let column = circle_turns([-x, -y]) * image.width as f32;
        self.texel((row as u32).min(image.height - 1), (column as u32).min(image.width - 1), direction, sine)
    }

    /// The light of a texel, in a direction with this sine of the angle from the zenith.
    fn texel(&self, row: u32, column: u32, direction: Vec3, sine: f32) -> LightSample {
        let SkyMap { image, density_of_weight, .. } = self.map;
        let radiance = Vec3::from(image.texels[(row * image.width + column) as usize]);
        let density = weight(image, row, column) * density_of_weight / sine.max(LEAST_SINE);
        LightSample { direction, radiance, density }
    }
}

/// The first entry whose sum exceeds a number from 0 to 1, and where in it the number lies, from 0 to 1.
fn choose(sums: &[f32], number: f32) -> (usize, f32) {
    let index = sums.partition_point(|&sum| sum <= number).min(sums.len() - 1);
    let (before, sum) = (if index > 0 { sums[index - 1] } else { 0.0 }, sums[index]);
    (index, if sum > before { ((number - before) / (sum - before)).clamp(0.0, 1.0) } else { 0.5 })
}

#[cfg(test)]
mod tests {
    use shared::camera::UpAxis;

    use super::*;

    /// A sky with a sun of one texel, black texels and a black row.
    fn map() -> SkyMap {
        let texel = |index: u32| match index {
            130 => [5000.0, 4000.0, 3000.0],
            _ if index / 32 == 9 => [0.0; 3],
            _ => [(index % 5) as f32, (index % 3) as f32, 0.5 * (index % 2) as f32],
        };
        SkyMap::new(SkyImage::new(32, 16, (0..32 * 16).map(texel).collect()).unwrap())
    }

    fn appearance(map: &SkyMap, up: UpAxis, azimuth: i16) -> Appearance {
        let light = Light::new(azimuth, 10).unwrap();
        Appearance { sky: Some(map.id()), up, light, ..Appearance::default() }
    }

    #[test]
    fn samples_have_the_light_and_density_of_their_directions() {
        let map = map();
        for (up, azimuth) in [(UpAxis::Y, 0), (UpAxis::Z, 77), (UpAxis::MinusX, -180)] {
            let sky = map.placed(&appearance(&map, up, azimuth)).unwrap();
            let (n, mut n_others) = (64, 0);
            let mut sum = Vec3::ZERO;
            for (u, v) in (0..n * n).map(|at| ((at % n) as f32 + 0.5, (at / n) as f32 + 0.5)) {
                let sample = sky.sample([u / n as f32, v / n as f32]);
                let again = sky.toward(sample.direction);
                assert!((sample.direction.length() - 1.0).abs() < 1e-5 && sample.density > 0.0);
                // At edges of texels rounding may find the neighbour.
                let is_same = (again.density / sample.density - 1.0).abs() < 1e-3 && again.radiance == sample.radiance;
                n_others += u32::from(!is_same);
                sum += sample.radiance * (1.0 / sample.density);
            }
            assert!(n_others < 8, "{up}: {n_others}");
            // All light of the sky, by the texels' solid angles.
            let total: Vec3 = (0..32 * 16)
                .map(|at| {
                    let edges = [at / 32, at / 32 + 1].map(|row| (PI * row as f32 / 16.0).cos());
                    Vec3::from(map.image.texels[at]) * ((edges[0] - edges[1]) * std::f32::consts::TAU / 32.0)
                })
                .sum();
            assert!(((sum / (n * n) as f32 - total) / total).abs().max_element() < 0.02, "{sum} {total}");
        }
    }

    #[test]
    fn densities_of_all_directions_add_up_to_one() {
        let map = map();
        let sky = map.placed(&appearance(&map, UpAxis::Y, 30)).unwrap();
        let n = 1 << 9;
        let mut sum = 0.0;
        for (row, column) in (0..n * n).map(|at| (at / n, at % n)) {
            let z = 1.0 - 2.0 * (row as f32 + 0.5) / n as f32;
            let [x, y] = circle_point((column as f32 + 0.5) / n as f32);
            let radius = (1.0 - z * z).sqrt();
            sum += f64::from(sky.toward(Vec3::new(x * radius, z, y * radius)).density);
        }
        let integral = sum * 4.0 * std::f64::consts::PI / f64::from(n * n);
        assert!((integral - 1.0).abs() < 0.01, "{integral}");
    }

    #[test]
    fn the_middle_stands_in_front_and_turns_with_the_key_light() {
        let texel = |index: u32| if index % 64 == 32 { [1.0; 3] } else { [0.0; 3] };
        let map = SkyMap::new(SkyImage::new(64, 32, (0..64 * 32).map(texel).collect()).unwrap());
        // A key light on the right of who looks along −z comes from +x.
        for (up, azimuth, from) in [
            (UpAxis::Y, 0, Vec3::Z),
            (UpAxis::Y, 90, Vec3::X),
            (UpAxis::Y, -90, Vec3::NEG_X),
            (UpAxis::Z, 0, Vec3::NEG_Y),
            (UpAxis::Z, 90, Vec3::X),
        ] {
            let sky = map.placed(&appearance(&map, up, azimuth)).unwrap();
            let slightly_right = from.cross(up.direction().as_vec3()) * 0.02;
            assert_eq!(sky.toward((from + slightly_right).normalize()).radiance, Vec3::ONE, "{up} {azimuth}");
            assert_eq!(sky.toward(-from).radiance, Vec3::ZERO, "{up} {azimuth}");
        }
    }

    #[test]
    fn a_picture_of_another_sky_has_none_of_its_light() {
        let map = map();
        let named = appearance(&map, UpAxis::Y, 0);
        let other = SkyMap::new(SkyImage::new(2, 1, vec![[1.0; 3]; 2]).unwrap());
        assert!(map.placed(&named).is_some() && other.placed(&named).is_none());
    }
}
