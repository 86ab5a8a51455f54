//! What a photograph shows of the squares of patterns of light.

use std::collections::HashMap;

use glam::{DMat2, DVec2, IVec2};

use super::{
    super::{identify::Sighting, lens::Lens, pattern::Plan},
    ink::Ink,
};

/// All squares of patterns of light in one photograph.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LightShot {
    /// Columns and rows of the photograph.
    pub size: [usize; 2],
    /// The squares.
    pub samples: Vec<Sample>,
    /// The number of squares that were too small to measure.
    pub n_too_small: usize,
}

/// A square without a dot.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// The projector that shows it.
    pub projector_idx: usize,
    /// The pattern, counted on from those that show places.
    pub pattern: u32,
    /// Whether the photograph shows it mirrored.
    pub is_mirrored: bool,
    pub(in crate::calibration) ink: Ink,
    /// Its centre in the projector's pixels as stored, from (0, 0) to (1, 1).
    pub raster: DVec2,
    /// Its centre in the photograph, relative to that one's centre, in halves of the diagonal.
    pub at: DVec2,
    /// Means and variances of red, green and blue as stored in the photograph, from 0 to 1, around its centre.
    pub mean: [f64; 3],
    /// See `mean`.
    pub variance: [f64; 3],
}

/// The red, green and blue of a photograph's pixel in a column and a row, as stored, from 0 to 1.
pub type ColourAt<'a> = &'a dyn Fn(usize, usize) -> [f32; 3];

/// Squares are measured within this distance of their centres, in sides, with weights that fade outwards: there is next to
/// no light of their neighbours, even behind a lens that blurs by a pixel.
const REACH: f64 = 0.28;
/// Smaller squares, in pixels of the photograph, have no such place.
const LEAST_SIDE: f64 = 8.0;
/// Crossings around one that was not found, by which its place is told.
const LEAST_AROUND: usize = 6;
/// The most points a side that are measured; two for each of the photograph's pixels, unless these are many.
const MOST_POINTS: f64 = 24.0;

/// Measures the squares of a part of a pattern of light.
pub(in crate::calibration) fn samples(plan: &Plan, sighting: &Sighting, shot: &mut LightShot, colour_at: ColourAt<'_>) {
    let Sighting { projector_idx, pattern, is_mirrored, .. } = *sighting;
    let board = &plan.boards[projector_idx];
    let found: HashMap<IVec2, DVec2> =
        sighting.points.iter().map(|[px, at]| (board.corner_at(*px).round().as_ivec2(), *at)).collect();
    let size_px = board.size_px();
    let [columns, rows] = board.squares;
    for square in (0..rows).flat_map(|row| (0..columns).map(move |column| [column, row])) {
        let Some(ink) = plan.ink(pattern, projector_idx, square) else { continue };
        let first = IVec2::new(square[0] as i32, square[1] as i32);
        let around = [IVec2::ZERO, IVec2::X, IVec2::ONE, IVec2::Y];
        let corners = around.map(|step| corner(&found, first + step));
        let [Some(a), Some(b), Some(c), Some(d)] = corners else { continue };
        let side = [a - b, b - c, c - d, d - a].iter().map(|edge| edge.length()).fold(f64::INFINITY, f64::min);
        if side < LEAST_SIDE {
            shot.n_too_small += 1;
            continue;
        }
        let Some((mean, variance)) = measured([a, b, c, d], side, shot.size, colour_at) else { continue };
        let centre = board.corner_px(square.map(|it| f64::from(it) + 0.5));
        shot.samples.push(Sample {
            projector_idx,
            pattern,
            is_mirrored,
            ink,
            raster: centre / size_px,
            at: Lens::normalised(shot.size, (a + b + c + d) / 4.0),
            mean,
            variance,
        });
    }
}

/// The place of a crossing; that of one that was not found, as at the board's edge, follows from those around it. `None` if
/// these are too few.
fn corner(found: &HashMap<IVec2, DVec2>, place: IVec2) -> Option<DVec2> {
    if let Some(at) = found.get(&place) {
        return Some(*at);
    }
    let steps = (-2..=2).flat_map(|y| (-2..=2).map(move |x| IVec2::new(x, y)));
    let near: Vec<(DVec2, DVec2)> =
        steps.filter_map(|step| Some((step.as_dvec2(), *found.get(&(place + step))?))).collect();
    if near.len() < LEAST_AROUND {
        return None;
    }
    // An affine map by least squares, from the middle of those around.
    let n = near.len() as f64;
    let middle = near.iter().map(|(step, _)| *step).sum::<DVec2>() / n;
    let middle_at = near.iter().map(|(_, at)| *at).sum::<DVec2>() / n;
    let (mut spread, mut moved) = (DMat2::ZERO, DMat2::ZERO);
    for (step, at) in &near {
        let (step, at) = (*step - middle, *at - middle_at);
        spread += DMat2::from_cols(step * step.x, step * step.y);
        moved += DMat2::from_cols(at * step.x, at * step.y);
    }
    // Crossings on one line say nothing beside it.
    (spread.determinant() > 0.5 * n).then(|| middle_at - moved * spread.inverse() * middle)
}

/// Mean and variance around the centre of a square; `None` if a part of that lies outside of the photograph.
fn measured(
    [a, b, c, d]: [DVec2; 4],
    side: f64,
    [width, height]: [usize; 2],
    colour_at: ColourAt<'_>,
) -> Option<([f64; 3], [f64; 3])> {
    let n = (4.0 * REACH * side).round().clamp(6.0, MOST_POINTS) as usize;
    // Hann's window: a photograph may show stripes, of which a box would cut off a part at its edges.
    let points: Vec<[f64; 2]> = (0..n)
        .map(|index| {
            let away = (2 * index + 1) as f64 / n as f64 - 1.0;
            [0.5 + REACH * away, 1.0 + (std::f64::consts::PI * away).cos()]
        })
        .collect();
    let (mut weights, mut sum, mut squares) = (0.0, [0.0; 3], [0.0; 3]);
    for ([s, s_weight], [t, t_weight]) in points.iter().flat_map(|t| points.iter().map(move |s| (*s, *t))) {
        let point = (a * (1.0 - s) + b * s) * (1.0 - t) + (d * (1.0 - s) + c * s) * t;
        let is_inside = point.cmpge(DVec2::ZERO).all() && point.x < width as f64 && point.y < height as f64;
        if !is_inside {
            return None;
        }
        let (weight, colour) = (s_weight * t_weight, colour_at(point.x as usize, point.y as usize));
        weights += weight;
        for channel in 0..3 {
            let value = f64::from(colour[channel]);
            sum[channel] += weight * value;
            squares[channel] += weight * value * value;
        }
    }
    let mean = sum.map(|sum| sum / weights);
    Some((mean, std::array::from_fn(|it| (squares[it] / weights - mean[it] * mean[it]).max(0.0))))
}
