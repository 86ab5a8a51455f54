//! Fall-off within projectors' fields, the exposures of photographs, and the camera's vignetting, from squares whose part of
//! white is known: the light of each is a product of the three.
//!
//! Where two projectors light one place, a photograph shows both through the same part of the lens, so their ratio is free
//! of vignetting. Whether the whole wall grows darker towards its edges or the photograph does, only photographs from
//! another place or of another aim can tell: the wall then lies elsewhere in the picture (as in Goldman, "Vignette and
//! Exposure Calibration and Compensation", 2010). Without these, the camera counts as even.

use glam::{DVec2, DVec4};

use super::{
    super::fitting::solve_symmetric,
    arrow::{Arrow, Solved, robust_weights},
};
use crate::wall::{FallOff, mesh::keys};

/// A square's light at its part of white, in a channel of the camera.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bright {
    pub shot: usize,
    pub camera: usize,
    pub projector: usize,
    pub channel: usize,
    /// In the projector's pixels as seen on the wall, from (0, 0) to (1, 1).
    pub upright: DVec2,
    /// In the photograph, from its centre, in halves of the diagonal.
    pub at: DVec2,
    /// White's light there; logarithm and its error for an error of one in the photograph's value.
    pub log_white: f64,
    /// See `log_white`.
    pub error: f64,
}

/// The product's factors.
#[derive(Clone, Debug)]
pub(super) struct Fields {
    /// For each projector, the logarithms of white at the control points of its fall-off, row by row from the top as seen
    /// on the wall, then those of the camera's red, green and blue in proportion to these.
    local: Vec<Vec<f64>>,
    shared: Vec<f64>,
    n_shots: usize,
    /// Whether photographs told the vignetting of each camera.
    pub has_vignetting: Vec<bool>,
    /// For each projector, the typical error of a square, as a part of its light.
    pub errors: Vec<f64>,
    /// For each shot, the same.
    pub shot_errors: Vec<f64>,
}

/// Control points of a fall-off.
pub(super) const N_POINTS: usize = FallOff::SIDE * FallOff::SIDE;
const N_LOCAL: usize = N_POINTS + 3;
/// Even powers of the distance from the photograph's centre.
const N_RADIAL: usize = 3;
/// The deviation to which vignetting at the wall's edge must be told, as a part of the light, or the camera counts as even.
const LARGEST_DEVIATION: f64 = 0.01;
/// Errors of photographs' values, before they are known.
const USUAL_SIGMA: f64 = 0.004;
/// Deviations of third differences of the logarithm of light between control points, and of its twist.
const USUAL_THIRD: f64 = 0.01;
const USUAL_TWIST: f64 = 0.03;
/// The weight of no light where nothing is measured; that of a square is 1 or so.
const UNMEASURED: f64 = 1e-6;
/// Half of the projectors must lie this far apart in two photographs, in halves of the diagonal, or vignetting is not told.
const LEAST_MOVED: f64 = 0.06;
/// Rounds of weighing anew.
const N_ROUNDS: usize = 5;

impl Fields {
    /// `None` if squares do not determine them.
    pub(super) fn solve(n_projectors: usize, n_shots: usize, n_cameras: usize, bright: &[Bright]) -> Option<Self> {
        let basis = Basis::new();
        let mut is_even: Vec<bool> =
            (0..n_cameras).map(|camera| moved(camera, n_projectors, bright) < LEAST_MOVED).collect();
        loop {
            let (fields, solved, sigma) = Self::fit((n_projectors, n_shots), &is_even, bright, &basis)?;
            // Of a vignetting that is told badly where it is strongest, nothing is believed.
            let corner = |camera: usize| {
                let own = bright.iter().filter(|it| it.camera == camera);
                radial_row(n_shots, camera, own.map(|it| it.at.length()).fold(0.0, f64::max) * DVec2::X)
            };
            let is_untold =
                |camera: &usize| !is_even[*camera] && sigma * solved.deviation(&corner(*camera)) > LARGEST_DEVIATION;
            let untold: Vec<usize> = (0..n_cameras).filter(is_untold).collect();
            if untold.is_empty() {
                return Some(fields);
            }
            untold.into_iter().for_each(|camera| is_even[camera] = true);
        }
    }

    fn fit(
        (n_projectors, n_shots): (usize, usize),
        is_even: &[bool],
        bright: &[Bright],
        basis: &Basis,
    ) -> Option<(Self, Solved, f64)> {
        let mut weights = vec![1.0; bright.len()];
        let mut sigma = USUAL_SIGMA;
        let smooth = smooth_rows();
        let mut last = None;
        for _ in 0..N_ROUNDS {
            let mut arrow = Arrow::new(n_projectors, N_LOCAL, 3 * n_shots + N_RADIAL * is_even.len());
            for (it, weight) in bright.iter().zip(&weights) {
                let (local, shared) = rows(it, n_shots, basis);
                arrow.add(it.projector, &local, &shared, it.log_white, weight / (it.error * it.error));
            }
            // Lenses light smoothly; colours and exposures are known up to factors.
            let weak = 1e-4 * bright.len() as f64;
            for block in 0..n_projectors {
                for (row, deviation) in &smooth {
                    arrow.add(block, row, &[], 0.0, (sigma / deviation).powi(2));
                }
                // A projector that nothing measures is somewhere, too.
                (0..N_POINTS).for_each(|point| arrow.add(block, &[(point, 1.0)], &[], 0.0, UNMEASURED));
                let colours = [0, 1, 2].map(|channel| (N_POINTS + channel, 1.0));
                arrow.add(block, &colours, &[], 0.0, 1e4 * weak);
                colours.iter().for_each(|colour| arrow.add(block, &[*colour], &[], 0.0, 1e-9 * weak));
            }
            for channel in 0..3 {
                let all: Vec<(usize, f64)> = (0..n_shots).map(|shot| (3 * shot + channel, 1.0)).collect();
                arrow.add_shared(&all, 0.0, weak);
                all.iter().for_each(|one| arrow.add_shared(&[*one], 0.0, 1e-9 * weak));
            }
            for (term, camera) in (0..N_RADIAL).flat_map(|term| (0..is_even.len()).map(move |it| (term, it))) {
                let weight = if is_even[camera] { 1e9 * weak } else { 1e-9 * weak };
                arrow.add_shared(&[(3 * n_shots + N_RADIAL * camera + term, 1.0)], 0.0, weight);
            }
            let solved = arrow.solve()?;
            let errors: Vec<f64> = bright
                .iter()
                .map(|it| {
                    let (local, shared) = rows(it, n_shots, basis);
                    it.log_white - dot(&local, &solved.local[it.projector]) - dot(&shared, &solved.shared)
                })
                .collect();
            let in_values: Vec<f64> = errors.iter().zip(bright).map(|(away, it)| away / it.error).collect();
            (weights, sigma) = robust_weights(&in_values);
            let typical = |is_of: &dyn Fn(&Bright) -> bool| {
                let own: Vec<f64> =
                    errors.iter().zip(bright).filter(|(_, it)| is_of(it)).map(|(away, _)| *away).collect();
                robust_weights(&own).1
            };
            let fields = Self {
                local: solved.local.clone(),
                shared: solved.shared.clone(),
                n_shots,
                has_vignetting: is_even.iter().map(|it| !it).collect(),
                errors: (0..n_projectors).map(|index| typical(&|it| it.projector == index)).collect(),
                shot_errors: (0..n_shots).map(|index| typical(&|it| it.shot == index)).collect(),
            };
            last = Some((fields, solved, sigma));
        }
        last
    }

    /// White's light of a projector at its control points, row by row from the top: as [`FallOff`] interpolates light, not
    /// its logarithm, nearest everywhere between them.
    pub(super) fn points(&self, projector: usize) -> [f64; N_POINTS] {
        const SIDE: usize = 4 * FallOff::SIDE;
        let basis = Basis::new();
        let (mut normal, mut right) = (vec![0.0; N_POINTS * N_POINTS], vec![0.0; N_POINTS]);
        for n in 0..SIDE * SIDE {
            let row = basis.row((DVec2::new((n % SIDE) as f64, (n / SIDE) as f64) + 0.5) / SIDE as f64);
            let light = dot(&row, &self.local[projector]).exp();
            for (a, factor) in row {
                row.iter().for_each(|(b, other)| normal[a * N_POINTS + b] += factor * other / (light * light));
                right[a] += factor / light;
            }
        }
        let is_solved = solve_symmetric(&mut normal, &mut right);
        std::array::from_fn(|n| if is_solved { right[n] } else { self.local[projector][n].exp() })
    }

    /// The camera's red, green and blue of a projector's white, in proportion to its light.
    pub(super) fn colour(&self, projector: usize) -> [f64; 3] {
        std::array::from_fn(|channel| self.local[projector][N_POINTS + channel].exp())
    }

    /// The factor from light to what a camera sees of it in a shot, a channel, and a place of the photograph.
    pub(super) fn seen(&self, shot: usize, camera: usize, channel: usize, at: DVec2) -> f64 {
        (self.shared[3 * shot + channel] + dot(&radial_row(self.n_shots, camera, at), &self.shared)).exp()
    }

    /// The light of a projector's white at a place of its pixels as seen on the wall.
    pub(super) fn white(&self, projector: usize, channel: usize, upright: DVec2, basis: &Basis) -> f64 {
        let local = &self.local[projector];
        (dot(&basis.row(upright), local) + local[N_POINTS + channel]).exp()
    }
}

/// The distance, in halves of the diagonal, between the places in a camera's photographs at which half of the projectors
/// are seen: at most, of any two photographs.
fn moved(camera: usize, n_projectors: usize, bright: &[Bright]) -> f64 {
    let n_shots = bright.iter().map(|it| it.shot + 1).max().unwrap_or(0);
    let mut sums = vec![(DVec2::ZERO, 0.0); n_projectors * n_shots];
    for it in bright.iter().filter(|it| it.camera == camera) {
        // Squares near the middle: photographs show more or fewer of those at the edges.
        if (it.upright - 0.5).abs().max_element() < 0.3 {
            let (sum, n) = &mut sums[it.projector * n_shots + it.shot];
            (*sum, *n) = (*sum + it.at, *n + 1.0);
        }
    }
    let extent = |of_projector: &[(DVec2, f64)]| {
        let places: Vec<DVec2> = of_projector.iter().filter(|(_, n)| *n > 0.0).map(|(sum, n)| *sum / *n).collect();
        let least = places.iter().copied().fold(DVec2::INFINITY, DVec2::min);
        let most = places.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
        if places.is_empty() { 0.0 } else { (most - least).length() }
    };
    let all: Vec<f64> = sums.chunks(n_shots.max(1)).map(extent).collect();
    super::super::fitting::median(all)
}

fn dot(row: &[(usize, f64)], unknowns: &[f64]) -> f64 {
    row.iter().map(|(index, factor)| factor * unknowns[*index]).sum()
}

/// Functions of control points that are nearly zero where light falls off smoothly, with their usual deviations.
fn smooth_rows() -> Vec<(Vec<(usize, f64)>, f64)> {
    const SIDE: usize = FallOff::SIDE;
    let at = |column: usize, row: usize| row * SIDE + column;
    let mut rows = Vec::new();
    for (line, first) in (0..SIDE).flat_map(|line| (0..SIDE - 3).map(move |first| (line, first))) {
        // Third differences: quadratic functions have none.
        let third = |point: &dyn Fn(usize) -> usize| -> Vec<(usize, f64)> {
            [-1.0, 3.0, -3.0, 1.0].iter().enumerate().map(|(n, factor)| (point(first + n), *factor)).collect()
        };
        rows.push((third(&|n| at(n, line)), USUAL_THIRD));
        rows.push((third(&|n| at(line, n)), USUAL_THIRD));
    }
    for (column, row) in (0..SIDE - 1).flat_map(|row| (0..SIDE - 1).map(move |column| (column, row))) {
        let around = [at(column, row), at(column + 1, row), at(column, row + 1), at(column + 1, row + 1)];
        rows.push((std::iter::zip(around, [1.0, -1.0, -1.0, 1.0]).collect(), USUAL_TWIST));
    }
    rows
}

/// Factors of `N` unknowns.
type Factors<const N: usize> = [(usize, f64); N];

fn rows(it: &Bright, n_shots: usize, basis: &Basis) -> (Factors<{ N_POINTS + 1 }>, Factors<{ N_RADIAL + 1 }>) {
    let control = basis.row(it.upright);
    let local = std::array::from_fn(|n| control.get(n).copied().unwrap_or((N_POINTS + it.channel, 1.0)));
    let radial = radial_row(n_shots, it.camera, it.at);
    let shared = std::array::from_fn(|n| radial.get(n).copied().unwrap_or((3 * it.shot + it.channel, 1.0)));
    (local, shared)
}

fn radial_row(n_shots: usize, camera: usize, at: DVec2) -> Factors<N_RADIAL> {
    std::array::from_fn(|term| (3 * n_shots + N_RADIAL * camera + term, at.length_squared().powi(term as i32 + 1)))
}

/// How much each control point counts at a place of a field: [`FallOff`]'s interpolation, which is linear in them.
pub(super) struct Basis {
    /// For each control point, the lattice in its border if that point is 1 and the others are 0.
    padded: Vec<Vec<f64>>,
}

impl Basis {
    pub(super) fn new() -> Self {
        let unit = |point: usize| -> Vec<f64> { (0..N_POINTS).map(|n| f64::from(u8::from(n == point))).collect() };
        Self { padded: (0..N_POINTS).map(|point| keys::padded([FallOff::SIDE; 2], &unit(point))).collect() }
    }

    /// The factors of all control points.
    pub(super) fn row(&self, upright: DVec2) -> Factors<N_POINTS> {
        let n_cells = (FallOff::SIDE - 1) as f64;
        let at = upright.clamp(DVec2::ZERO, DVec2::ONE) * n_cells;
        let cell = at.floor().min(DVec2::splat(n_cells - 1.0));
        let part = at - cell;
        let ([across, _], [down, _]) = (keys::weights(part.x), keys::weights(part.y));
        let stride = FallOff::SIDE + 2;
        let first = cell.y as usize * stride + cell.x as usize;
        std::array::from_fn(|point| {
            let line = |row: usize| DVec4::from_slice(&self.padded[point][first + row * stride..]).dot(across);
            (point, DVec4::new(line(0), line(1), line(2), line(3)).dot(down))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three projectors side by side in photographs that show them at several places of the picture.
    fn squares(shifts: &[f64], vignette: f64) -> Vec<Bright> {
        let mut all = Vec::new();
        for (shot, shift) in shifts.iter().enumerate() {
            for n in 0..600 {
                let (projector, channel) = (n % 3, n / 3 % 3);
                let upright = DVec2::new((n * 7 % 29) as f64 / 28.0, (n * 11 % 23) as f64 / 22.0);
                let at = DVec2::new(-0.6 + 0.4 * (projector as f64 + upright.x) + shift, 0.4 * (upright.y - 0.5));
                let white = white(projector, upright) * [1.0, 1.2, 0.7 + 0.1 * projector as f64][channel];
                let log_white = (white * 0.5_f64.powi(shot as i32)).ln() - vignette * at.length_squared();
                all.push(Bright { shot, camera: 0, projector, channel, upright, at, log_white, error: 1.0 });
            }
        }
        all
    }

    fn white(projector: usize, upright: DVec2) -> f64 {
        (1.0 - 0.2 * projector as f64) * (-0.6 * (upright - DVec2::new(0.5, 0.6)).length_squared()).exp()
    }

    fn check(fields: &Fields, expected: impl Fn(usize, DVec2) -> f64) {
        let basis = Basis::new();
        // White is known up to a factor.
        let ratio = |projector: usize, at: DVec2| {
            let colour: f64 = [0, 1, 2].map(|it| fields.white(projector, it, at, &basis)).iter().sum();
            let factor: f64 = [1.0, 1.2, 0.7 + 0.1 * projector as f64].iter().sum();
            colour / factor / expected(projector, at)
        };
        let unit = ratio(0, DVec2::splat(0.5));
        for (projector, at) in
            (0..3).flat_map(|it| [[0.1, 0.1], [0.5, 0.3], [1.0, 0.9]].map(|at| (it, DVec2::from(at))))
        {
            let ratio = ratio(projector, at) / unit;
            assert!((ratio - 1.0).abs() < 0.01, "{projector} {at}: {ratio}");
        }
    }

    #[test]
    fn vignetting_and_fall_off_are_told_apart_by_photographs_of_several_aims() {
        let fields = Fields::solve(3, 3, 1, &squares(&[-0.2, 0.0, 0.25], 0.8)).expect("determined");
        assert_eq!(fields.has_vignetting, [true]);
        check(&fields, white);
        assert!(fields.errors.iter().all(|error| *error < 0.01), "{:?}", fields.errors);
    }

    #[test]
    fn without_them_the_camera_counts_as_even() {
        let fields = Fields::solve(3, 2, 1, &squares(&[0.0, 0.0], 0.8)).expect("determined");
        assert_eq!(fields.has_vignetting, [false]);
        check(&fields, |projector, at| {
            let place = DVec2::new(-0.6 + 0.4 * (projector as f64 + at.x), 0.4 * (at.y - 0.5));
            white(projector, at) * (-0.8 * place.length_squared()).exp()
        });
    }

    #[test]
    fn control_points_count_as_in_a_fall_off() {
        let parts: [[f64; 5]; 5] =
            std::array::from_fn(|row| std::array::from_fn(|column| 1.0 - 0.03 * (row * column) as f64 * 0.9));
        let fall_off = FallOff::new(parts).expect("parts");
        let basis = Basis::new();
        for n in 0..100 {
            let at = DVec2::new(f64::from(n % 10), f64::from(n / 10)) / 9.0;
            let light: f64 = basis.row(at).iter().map(|(index, factor)| factor * parts.as_flattened()[*index]).sum();
            assert!((light / parts[4][4] - fall_off.excess(at)).abs() < 1e-9, "{at}");
        }
    }
}
