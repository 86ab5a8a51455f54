//! An image to draw test patterns on.

use egui::epaint::{
    Color32, FontId,
    text::{FontDefinitions, Fonts, TextOptions},
};
use glam::DVec2;

use crate::wall::PixelRect;

/// An image of a part of the spanning output, black at first. Places are pixels of that output.
pub(super) struct Sheet {
    part: PixelRect,
    /// Rows from the bottom up, as in frames.
    pub pixels: Vec<[u8; 4]>,
    /// Drawing is restricted to these pixels of the part.
    pub clip: PixelRect,
    fonts: Fonts,
}

impl Sheet {
    pub(super) fn new(part: PixelRect) -> Self {
        let fonts = Fonts::new(TextOptions::default(), FontDefinitions::default());
        let n_pixels = part.width as usize * part.height as usize;
        Self { part, pixels: vec![[0, 0, 0, 255]; n_pixels], clip: part, fonts }
    }

    /// The pixel at a column and a row from the top.
    fn pixel(&mut self, x: u32, y: u32) -> &mut [u8; 4] {
        let PixelRect { x: left, y: top, width, height } = self.part;
        &mut self.pixels[(height - 1 - (y - top)) as usize * width as usize + (x - left) as usize]
    }

    /// Sets each pixel of a rectangle to the colour at its column and row.
    pub(super) fn each_pixel(&mut self, rect: PixelRect, color: impl Fn(u32, u32) -> [u8; 3]) {
        let end =
            |from: u32, extent: u32, clip_from: u32, clip_extent: u32| (from + extent).min(clip_from + clip_extent);
        let (left, top) = (rect.x.max(self.clip.x), rect.y.max(self.clip.y));
        let right = end(rect.x, rect.width, self.clip.x, self.clip.width);
        let bottom = end(rect.y, rect.height, self.clip.y, self.clip.height);
        for y in top..bottom {
            for x in left..right {
                let [r, g, b] = color(x, y);
                *self.pixel(x, y) = [r, g, b, 255];
            }
        }
    }

    pub(super) fn fill(&mut self, rect: PixelRect, color: [u8; 3]) {
        self.each_pixel(rect, |_, _| color);
    }

    /// Draws the border of a rectangle, inside it.
    pub(super) fn frame(&mut self, rect: PixelRect, thickness: u32, color: [u8; 3]) {
        let PixelRect { x, y, width, height } = rect;
        let thickness = thickness.min(width).min(height);
        self.fill(PixelRect { height: thickness, ..rect }, color);
        self.fill(PixelRect { y: y + height - thickness, height: thickness, ..rect }, color);
        self.fill(PixelRect { width: thickness, ..rect }, color);
        self.fill(PixelRect { x: x + width - thickness, width: thickness, ..rect }, color);
    }

    pub(super) fn square(&mut self, centre: DVec2, side: f64, color: [u8; 3]) {
        let half = DVec2::splat(side / 2.0);
        let (from, to) = ((centre - half).round().max(DVec2::ZERO), (centre + half).round().max(DVec2::ZERO));
        // Casts saturate, and `fill` clips.
        let [x, y, right, bottom] = [from.x as u32, from.y as u32, to.x as u32, to.y as u32];
        self.fill(PixelRect { x, y, width: right - x, height: bottom - y }, color);
    }

    pub(super) fn line(&mut self, from: DVec2, to: DVec2, thickness: f64, color: [u8; 3]) {
        let along = to - from;
        let is_steep = along.y.abs() > along.x.abs();
        // Column by column, or row by row if it is steep: the pixels on both sides of the middle.
        let (main, cross) = if is_steep { (1, 0) } else { (0, 1) };
        let (from, to) = if along[main] < 0.0 { (to, from) } else { (from, to) };
        let extent = to[main] - from[main];
        if extent <= 0.0 {
            return;
        }
        let slope = (to[cross] - from[cross]) / extent;
        let half = thickness / 2.0 * (1.0 + slope * slope).sqrt();
        let clip = self.clip;
        let limits = [[clip.x, clip.x + clip.width], [clip.y, clip.y + clip.height]].map(|it| it.map(f64::from));
        let first = from[main].max(limits[main][0]).floor();
        let last = to[main].min(limits[main][1]).ceil();
        let mut position = first;
        while position < last {
            let middle = from[cross] + slope * (position + 0.5 - from[main]);
            let mut other = (middle - half - 0.5).floor().max(limits[cross][0]);
            while other < (middle + half + 0.5).min(limits[cross][1]) {
                let coverage = (half + 0.5 - (other + 0.5 - middle).abs()).clamp(0.0, 1.0);
                let [x, y] = if is_steep { [other, position] } else { [position, other] };
                self.blend(x, y, color, coverage);
                other += 1.0;
            }
            position += 1.0;
        }
    }

    /// Draws a line of text centred on a point; `size` is the line height in pixels.
    pub(super) fn text(&mut self, centre: DVec2, size: f64, color: [u8; 3], text: &str) {
        let font = FontId::proportional(size as f32);
        let galley = self.fonts.with_pixels_per_point(1.0).layout_no_wrap(text.to_owned(), font, Color32::WHITE);
        let atlas = self.fonts.texture_atlas().image();
        let origin = centre - DVec2::new(f64::from(galley.size().x), f64::from(galley.size().y)) / 2.0;
        let glyphs = galley.rows.iter().flat_map(|placed| placed.row.glyphs.iter().map(|glyph| (placed.pos, glyph)));
        let coverage: Vec<(DVec2, f64)> = glyphs
            .flat_map(|(row_at, glyph)| {
                let at = row_at + glyph.pos.to_vec2() + glyph.uv_rect.offset;
                let at = (origin + DVec2::new(f64::from(at.x), f64::from(at.y))).round();
                let ([left, top], [right, bottom]) = (glyph.uv_rect.min, glyph.uv_rect.max);
                let texels = (top..bottom).flat_map(move |y| (left..right).map(move |x| (x, y)));
                texels.map(move |(x, y)| {
                    let coverage = f64::from(atlas[(usize::from(x), usize::from(y))].a()) / 255.0;
                    (at + DVec2::new(f64::from(x - left), f64::from(y - top)), coverage)
                })
            })
            .collect();
        for (at, coverage) in coverage {
            self.blend(at.x, at.y, color, coverage);
        }
    }

    /// Blends a colour over a pixel inside the clip rectangle, by the part of it that is covered.
    fn blend(&mut self, x: f64, y: f64, color: [u8; 3], coverage: f64) {
        let clip = self.clip;
        let is_inside = (f64::from(clip.x)..f64::from(clip.x + clip.width)).contains(&x)
            && (f64::from(clip.y)..f64::from(clip.y + clip.height)).contains(&y);
        if is_inside {
            let pixel = self.pixel(x as u32, y as u32);
            for (channel, value) in pixel.iter_mut().zip(color) {
                *channel = (f64::from(*channel) * (1.0 - coverage) + f64::from(value) * coverage).round() as u8;
            }
        }
    }
}
