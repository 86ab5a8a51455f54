//! Finds the crossings of checkerboards: points where brightness has a saddle.
//!
//! After Lucchese and Mitra, "Using Saddle Points for Subpixel Feature Detection in Camera Calibration Targets" (2002).

use glam::DVec2;
use rayon::prelude::*;

use super::{fitting::solve_symmetric, photograph::Photograph};

/// A crossing in a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Crossing {
    /// In pixels; the first pixel's centre is (0.5, 0.5).
    pub at: DVec2,
    /// The direction in which its white squares lie, and the opposite.
    pub white: DVec2,
    /// The directions of the two lines that cross, each from a white square on its left, as `white` turns.
    pub lines: [DVec2; 2],
    /// The strength of the saddle.
    pub strength: f32,
}

/// Smoothing before saddles are searched, in pixels.
const SIGMA: f64 = 1.5;
/// White squares are brighter than black ones by this at least, as a part of the brightest.
const LEAST_CONTRAST: f64 = 0.04;
/// No two crossings are nearer to each other than this, in pixels.
const RADIUS: usize = 2;
/// The most crossings of a photograph: 64 projectors have fewer.
const MOST_CROSSINGS: usize = 100_000;

/// All crossings, the strongest first.
pub(super) fn find(photograph: &Photograph) -> Vec<Crossing> {
    let smooth = photograph.smoothed(SIGMA);
    let [width, height] = smooth.size;
    if width < 16 || height < 16 {
        return Vec::new();
    }
    // For contrast C, the mixed derivative at a crossing is C / (π σ²), blurred a little more by the lens.
    let least = (LEAST_CONTRAST / (std::f64::consts::PI * (SIGMA * SIGMA + 1.0))).powi(2) as f32;
    let strength_row = |y: usize, out: &mut Vec<f32>| {
        let row = |y: usize| &smooth.values[y * width..][..width];
        let (above, here, below) = (row(y - 1), row(y), row(y + 1));
        out.clear();
        out.resize(width, 0.0);
        for x in 1..width - 1 {
            let xx = here[x - 1] - 2.0 * here[x] + here[x + 1];
            let yy = above[x] - 2.0 * here[x] + below[x];
            let xy = (above[x - 1] - above[x + 1] - below[x - 1] + below[x + 1]) / 4.0;
            out[x] = xy * xy - xx * yy;
        }
    };
    const BAND: usize = 64;
    let n_bands = height.div_ceil(BAND);
    let mut crossings: Vec<Crossing> = (0..n_bands)
        .into_par_iter()
        .flat_map_iter(|band| {
            let (from, to) = ((band * BAND).max(1 + RADIUS), ((band + 1) * BAND).min(height - 1 - RADIUS));
            let mut rows: Vec<Vec<f32>> = Vec::new();
            let mut found = Vec::new();
            if from < to {
                for y in from - RADIUS..to + RADIUS {
                    let mut row = Vec::new();
                    strength_row(y, &mut row);
                    rows.push(row);
                }
            }
            for y in from..to {
                let middle = y - (from - RADIUS);
                for x in 1 + RADIUS..width - 1 - RADIUS {
                    let strength = rows[middle][x];
                    if strength < least {
                        continue;
                    }
                    let around = rows[middle - RADIUS..=middle + RADIUS].iter().enumerate();
                    let is_peak = around.into_iter().all(|(j, row)| {
                        row[x - RADIUS..=x + RADIUS].iter().enumerate().all(|(i, &other)| {
                            // Of equal neighbours the first counts.
                            other < strength || (other == strength && (j, i) >= (RADIUS, RADIUS))
                        })
                    });
                    if is_peak {
                        found.extend(crossing(&smooth, [x, y], strength));
                    }
                }
            }
            found
        })
        .collect();
    crossings.sort_by(|a, b| b.strength.total_cmp(&a.strength));
    crossings.truncate(MOST_CROSSINGS);
    crossings
}

/// The crossing nearest to a pixel, if brightness has a saddle within it.
fn crossing(smooth: &Photograph, [x, y]: [usize; 2], strength: f32) -> Option<Crossing> {
    let value = |dx: isize, dy: isize| {
        f64::from(smooth.values[y.wrapping_add_signed(dy) * smooth.size[0] + x.wrapping_add_signed(dx)])
    };
    let gradient = DVec2::new(value(1, 0) - value(-1, 0), value(0, 1) - value(0, -1)) / 2.0;
    let xx = value(-1, 0) - 2.0 * value(0, 0) + value(1, 0);
    let yy = value(0, -1) - 2.0 * value(0, 0) + value(0, 1);
    let xy = (value(-1, -1) - value(1, -1) - value(-1, 1) + value(1, 1)) / 4.0;
    let determinant = xx * yy - xy * xy;
    let offset = -DVec2::new(yy * gradient.x - xy * gradient.y, xx * gradient.y - xy * gradient.x) / determinant;
    let (white, lines) = directions(xx, xy, yy)?;
    (offset.abs().max_element() <= 1.5).then(|| Crossing {
        at: DVec2::new(x as f64, y as f64) + 0.5 + offset,
        white,
        lines,
        strength,
    })
}

/// The direction of strongest growth, and the two in which brightness stays the same, of a saddle's second derivatives.
fn directions(xx: f64, xy: f64, yy: f64) -> Option<(DVec2, [DVec2; 2])> {
    let mean = (xx + yy) / 2.0;
    let spread = ((xx - yy) / 2.0).hypot(xy);
    let (most, least) = (mean + spread, mean - spread);
    if !(most > 0.0 && least < 0.0) {
        return None;
    }
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let white = DVec2::from_angle(angle);
    let half = (most / -least).sqrt().atan();
    Some((white, [DVec2::from_angle(angle - half), DVec2::from_angle(angle + half)]))
}

/// A crossing's place, from all pixels around it within `radius`: the saddle of the quadratic that fits them best.
pub(super) fn refined(photograph: &Photograph, at: DVec2, radius: f64) -> Option<DVec2> {
    let mut centre = at;
    let [width, height] = photograph.size;
    for _ in 0..4 {
        let reach = radius.ceil();
        let (left, top) = (centre.x - 0.5 - reach, centre.y - 0.5 - reach);
        if !(left >= 0.0 && top >= 0.0) {
            return None;
        }
        let (left, top, side) = (left as usize, top as usize, 2 * reach as usize + 2);
        if left + side > width || top + side > height {
            return None;
        }
        // Least squares of a x² + b x y + c y² + d x + e y + f.
        let mut normal = [[0.0; 6]; 6];
        let mut right = [0.0; 6];
        for y in top..top + side {
            for x in left..left + side {
                let from = DVec2::new(x as f64, y as f64) + 0.5 - centre;
                let weight = (1.0 - from.length_squared() / (radius * radius)).max(0.0);
                if weight == 0.0 {
                    continue;
                }
                let value = f64::from(photograph.values[y * width + x]);
                let terms = [from.x * from.x, from.x * from.y, from.y * from.y, from.x, from.y, 1.0];
                for (row, term) in terms.iter().enumerate() {
                    for (column, other) in terms.iter().enumerate() {
                        normal[row][column] += weight * term * other;
                    }
                    right[row] += weight * term * value;
                }
            }
        }
        let mut flat: Vec<f64> = normal.concat();
        if !solve_symmetric(&mut flat, &mut right) {
            return None;
        }
        let [a, b, c, d, e, _] = right;
        let determinant = 4.0 * a * c - b * b;
        let is_saddle = determinant < 0.0;
        if !is_saddle {
            return None;
        }
        let step = DVec2::new(b * e - 2.0 * c * d, b * d - 2.0 * a * e) / determinant;
        centre += step.clamp_length_max(1.0);
        if (centre - at).length() > radius {
            return None;
        }
        if step.length() < 1e-3 {
            break;
        }
    }
    Some(centre)
}
