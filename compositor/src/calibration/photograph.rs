//! A photograph in memory.

use glam::DVec2;
use rayon::prelude::*;

/// A photograph's brightness, as stored: from 0 to 1, row by row from the top left.
#[derive(Clone, Debug, PartialEq)]
pub struct Photograph {
    /// Columns and rows.
    pub size: [usize; 2],
    /// Brightness.
    pub values: Vec<f32>,
}

impl Photograph {
    /// Brightness between pixels, whose centres lie at halves; at the edges, that of the nearest.
    pub(super) fn at(&self, point: DVec2) -> f32 {
        let [width, height] = self.size;
        let place = (point - 0.5).clamp(DVec2::ZERO, DVec2::new(width as f64 - 1.0, height as f64 - 1.0));
        let (x, y) = (place.x as usize, place.y as usize);
        let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
        let [across, down] = [(place.x - x as f64) as f32, (place.y - y as f64) as f32];
        let row = |y: usize| self.values[y * width + x] * (1.0 - across) + self.values[y * width + right] * across;
        row(y) * (1.0 - down) + row(below) * down
    }

    /// Smoothed by a Gaussian of standard deviation `sigma` in pixels.
    pub(super) fn smoothed(&self, sigma: f64) -> Self {
        let radius = (3.0 * sigma).ceil() as usize;
        let weight = |offset: usize| (-0.5 * (offset as f64 / sigma).powi(2)).exp();
        let sum = weight(0) + 2.0 * (1..=radius).map(weight).sum::<f64>();
        let kernel: Vec<f32> = (0..=radius).map(|offset| (weight(offset) / sum) as f32).collect();
        let [width, height] = self.size;
        let mut across = vec![0.0; self.values.len()];
        across.par_chunks_mut(width).zip(self.values.par_chunks(width)).for_each(|(out, row)| {
            for (x, out) in out.iter_mut().enumerate() {
                let mut sum = kernel[0] * row[x];
                for (offset, weight) in kernel.iter().enumerate().skip(1) {
                    sum += weight * (row[x.saturating_sub(offset)] + row[(x + offset).min(width - 1)]);
                }
                *out = sum;
            }
        });
        let mut values = vec![0.0; self.values.len()];
        values.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            let row = |y: usize| &across[y * width..][..width];
            for (out, value) in out.iter_mut().zip(row(y)) {
                *out = kernel[0] * value;
            }
            for (offset, weight) in kernel.iter().enumerate().skip(1) {
                let (above, below) = (row(y.saturating_sub(offset)), row((y + offset).min(height - 1)));
                for ((out, above), below) in out.iter_mut().zip(above).zip(below) {
                    *out += weight * (above + below);
                }
            }
        });
        Self { size: self.size, values }
    }
}
