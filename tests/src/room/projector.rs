//! A projector that truly stands in the virtual room, with its own light.

use std::sync::Arc;

use glam::DVec2;

use super::camera::Pinhole;

/// A projector where it truly stands.
#[derive(Clone, Debug)]
pub(crate) struct TrueProjector {
    pub(crate) pinhole: Pinhole,
    pub(crate) size: [usize; 2],
    /// Whether it projects from behind: left and right are exchanged.
    pub(crate) is_mirrored: bool,
    /// Its light.
    pub(crate) light: Arc<TrueLight>,
    /// The values that it shows, red, green and blue: row by row from the top left; empty if it is off.
    pub(crate) shown: Vec<[u8; 3]>,
}

/// The light of a projector.
#[derive(Clone, Debug)]
pub(crate) struct TrueLight {
    /// The light of each value, from 0 to 1: black's is added.
    pub(crate) curve: Vec<f64>,
    /// The light of white, and that of black, at the brightest place: red, green, blue.
    pub(crate) white: [f64; 3],
    pub(crate) black: [f64; 3],
    /// The brightest place of its pixels, from (0, 0) to (1, 1), and how fast light falls off around it.
    pub(crate) brightest: DVec2,
    pub(crate) falls: f64,
}

impl TrueLight {
    /// White is 1 at the centre of the picture, black a three-hundredth, and corners have three quarters.
    pub(crate) fn usual() -> Self {
        Self::new(2.2, [1.0; 3], [0.003; 3], DVec2::splat(0.5), 0.3)
    }

    pub(crate) fn new(gamma: f64, white: [f64; 3], black: [f64; 3], brightest: DVec2, falls: f64) -> Self {
        let curve = (0..256).map(|value| (f64::from(value) / 255.0).powf(gamma)).collect();
        Self { curve, white, black, brightest, falls }
    }

    /// The part of the brightest place's light at another place: as of a lens, no polynomial.
    pub(crate) fn part(&self, raster: DVec2) -> f64 {
        (1.0 + self.falls * (raster - self.brightest).length_squared()).powi(-2)
    }
}

impl TrueProjector {
    fn unmirrored(&self, px: DVec2) -> DVec2 {
        if self.is_mirrored { DVec2::new(self.size[0] as f64 - px.x, px.y) } else { px }
    }

    /// The pixel that lights a point of the wall, as stored.
    pub(crate) fn px(&self, point: DVec2) -> DVec2 {
        self.unmirrored(self.pinhole.px(point))
    }

    /// The point of the wall that a pixel lights.
    pub(crate) fn point(&self, px: DVec2) -> DVec2 {
        self.pinhole.point(self.unmirrored(px))
    }

    /// Columns and rows.
    pub(crate) fn size_px(&self) -> DVec2 {
        DVec2::new(self.size[0] as f64, self.size[1] as f64)
    }

    /// Whether a point lies among its pixels, or less than a margin beside them.
    pub(crate) fn is_near(&self, point: DVec2, margin_px: f64) -> bool {
        let px = self.px(point);
        px.cmpge(DVec2::splat(-margin_px)).all() && px.cmple(self.size_px() + margin_px).all()
    }

    /// The pixels around a point, with their parts of its light: each gives light like a tent two pixels wide.
    pub(crate) fn taps(&self, point: DVec2) -> impl Iterator<Item = ([usize; 2], f64)> {
        let [width, height] = self.size;
        let at = self.px(point) - 0.5;
        let (from, part) = (at.floor(), at - at.floor());
        let tap = move |n: u32| {
            let [right, below] = [f64::from(n % 2), f64::from(n / 2)];
            let (x, y) = (from.x + right, from.y + below);
            let is_there = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
            let weight = (1.0 - (part.x - right).abs()) * (1.0 - (part.y - below).abs());
            is_there.then_some(([x as usize, y as usize], weight))
        };
        (0..4).filter_map(tap)
    }

    /// The red, green and blue light that it gives a point.
    pub(crate) fn light_at(&self, point: DVec2) -> [f64; 3] {
        if self.shown.is_empty() || !self.is_near(point, 0.5) {
            return [0.0; 3];
        }
        let TrueLight { curve, white, black, .. } = &*self.light;
        let mut light = [0.0; 3];
        for ([x, y], weight) in self.taps(point) {
            let value = self.shown[y * self.size[0] + x];
            for channel in 0..3 {
                light[channel] += weight * (black[channel] + white[channel] * curve[usize::from(value[channel])]);
            }
        }
        let part = self.light.part(self.px(point) / self.size_px());
        light.map(|light| light * part)
    }
}
