//! The camera's response: the light behind the values that a photograph stores.
//!
//! As in Mitsunaga and Nayar, "Radiometric Self Calibration" (1999), light is a smooth function of the value, linear in its
//! unknown coefficients, and known ratios of light determine it. There the ratios are those of exposure times; here they
//! are those of black, a sixteenth, an eighth, a quarter, a half, three quarters and white within each photograph, which are
//! known better.

use glam::DVec2;

use super::arrow::{Arrow, robust_weights, robust_weights_above};

/// Light by value: a cubic spline on even knots.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Response {
    coefficients: [f64; N],
    /// The values between which it was measured.
    pub range: [f64; 2],
    /// The typical error of a square's light, as a part of white.
    pub error: f64,
}

/// A square of which the part of white is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Known {
    /// The photograph and the projector, as one number.
    pub group: usize,
    /// Its place in the projector's pixels, from (-1, -1) to (1, 1).
    pub place: DVec2,
    /// The part of white.
    pub part: f64,
    /// The value's mean and variance.
    pub value: f64,
    /// See `value`.
    pub variance: f64,
    /// The light of other projectors' black there, in the unit of the response: 0 until it is known.
    pub foreign: f64,
}

/// Intervals of the spline, from 0 to 1: a curve as smooth as cameras' has no finer features.
const N_INTERVALS: usize = 12;
const N: usize = N_INTERVALS + 3;
/// Terms of the light within one field: white, and what is there without it.
const N_WHITE: usize = 6;
const N_BLACK: usize = 6;
/// The weight that keeps the spline smooth where nothing is measured.
const SMOOTHNESS: f64 = 2e-4;
/// The weight of no light where nothing is measured; that of a square is about 1.
const WEAK: f64 = 1e-7;
/// Fewer squares, dark or bright ones, tell nothing of a field.
const LEAST_SQUARES: usize = 5;
/// Means of 8-bit values are no better than this, so smaller departures are the spline's.
const LEAST_ERROR: f64 = 1e-3;
/// A value counts if at least this part of all lies within such a distance beside it.
const LEAST_PART: f64 = 0.01;
/// See [`LEAST_PART`].
const BESIDE: f64 = 0.02;
/// Steps of the range at which the curve is examined, and those that may be lost at each end.
const N_STEPS: i32 = 100;
/// See [`N_STEPS`].
const MOST_BENT: i32 = 10;
/// Rounds of weighing anew.
const N_ROUNDS: usize = 6;

impl Response {
    /// Finds the response from squares of several fields. `None` if they do not determine it.
    pub(super) fn solve(n_groups: usize, known: &[Known]) -> Option<Self> {
        let mut n_of = vec![[0; 2]; n_groups];
        known.iter().for_each(|it| n_of[it.group][usize::from(it.part >= 0.5)] += 1);
        let is_told = |it: &&Known| n_of[it.group].iter().all(|n| *n >= LEAST_SQUARES);
        let mut known: Vec<Known> = known.iter().filter(is_told).copied().collect();
        // A curve through single squares far from all others may bend as it likes: someone stands before them.
        let range = dense(known.iter().map(|it| it.value).collect());
        known.retain(|it| (range[0]..=range[1]).contains(&it.value));
        let white_range = range[1] - range[0];
        if known.is_empty() || white_range < 0.1 {
            return None;
        }
        // sRGB's curve is a start for weights: errors of values are even, those of light are not.
        let mut response = Self { coefficients: std::array::from_fn(start), range, error: 0.0 };
        let mut weights = vec![1.0; known.len()];
        for _ in 0..N_ROUNDS {
            let mut arrow = Arrow::new(n_groups, N_WHITE + N_BLACK, N);
            let slopes: Vec<f64> = known.iter().map(|it| response.slope(it.value).max(0.1)).collect();
            for ((it, slope), weight) in known.iter().zip(&slopes).zip(&weights) {
                let (local, shared) = (field_row(it.place, it.part), value_row(it.value, it.variance));
                arrow.add(it.group, &local, &shared, it.foreign, weight / (slope * slope));
            }
            for block in 0..n_groups {
                (0..N_WHITE + N_BLACK).for_each(|term| arrow.add(block, &[(term, 1.0)], &[], 0.0, WEAK));
            }
            for first in 0..N - 3 {
                let third = [(first, -1.0), (first + 1, 3.0), (first + 2, -3.0), (first + 3, 1.0)];
                arrow.add_shared(&third, 0.0, SMOOTHNESS * known.len() as f64);
            }
            // Light's unit and its zero are free: black is part of what is there without the projector's light.
            let strong = 1e6 * known.len() as f64;
            arrow.add_shared(&value_row(range[0], 0.0), 0.0, strong);
            arrow.add_shared(&value_row(range[1], 0.0), 1.0, strong);
            let solved = arrow.solve()?;
            response.coefficients = solved.shared.try_into().ok()?;
            let away = |it: &Known| {
                let light = response.light(it.value, it.variance);
                let terms = field_row(it.place, it.part);
                let expected: f64 = terms.iter().map(|(term, factor)| -factor * solved.local[it.group][*term]).sum();
                light - it.foreign - expected
            };
            let errors: Vec<f64> = known.iter().map(away).collect();
            let in_values: Vec<f64> = errors.iter().zip(&slopes).map(|(away, slope)| away / slope).collect();
            weights = robust_weights_above(&in_values, LEAST_ERROR).0;
            let white: Vec<f64> = known.iter().map(|it| white_at(&solved.local[it.group], it.place)).collect();
            let parts: Vec<f64> = errors.iter().zip(&white).map(|(away, white)| away / white.max(1e-6)).collect();
            response.error = robust_weights(&parts).1;
        }
        // Values of squares that do not fit tell nothing.
        let fit_well = known.iter().zip(&weights).filter(|(_, weight)| **weight > 0.5);
        response.range = dense(fit_well.map(|(it, _)| it.value).collect());
        // At its ends, a few squares that do not fit may bend it down.
        let [least, most] = response.range;
        let at = |step: i32| least + (most - least) * f64::from(step) / f64::from(N_STEPS);
        let grows = |step: &i32| response.slope(at(*step)) > 0.0;
        let middle = N_STEPS / 2;
        let first = (0..=middle).rev().take_while(grows).last()?;
        let last = (middle..=N_STEPS).take_while(grows).last()?;
        response.range = [at(first), at(last)];
        let is_whole = first <= MOST_BENT && last >= N_STEPS - MOST_BENT;
        (is_whole && response.coefficients.iter().all(|it| it.is_finite())).then_some(response)
    }

    /// The mean light behind values of this mean and variance.
    pub(super) fn light(&self, value: f64, variance: f64) -> f64 {
        value_row(value, variance).iter().map(|(index, factor)| factor * self.coefficients[*index]).sum()
    }

    /// The growth of light with the value.
    pub(super) fn slope(&self, value: f64) -> f64 {
        let (first, part) = interval(value);
        let weights = [
            -(1.0 - part).powi(2) / 2.0,
            (3.0 * part * part - 4.0 * part) / 2.0,
            (-3.0 * part * part + 2.0 * part + 1.0) / 2.0,
            part * part / 2.0,
        ];
        (0..4).map(|n| weights[n] * self.coefficients[first + n]).sum::<f64>() * N_INTERVALS as f64
    }
}

/// The least and the greatest value that have enough others beside them, on their side of the middle.
fn dense(mut values: Vec<f64>) -> [f64; 2] {
    values.sort_unstable_by(f64::total_cmp);
    let n_needed = (values.len() as f64 * LEAST_PART).ceil() as usize;
    let n_between =
        |from: f64, to: f64| values.partition_point(|it| *it <= to) - values.partition_point(|it| *it < from);
    let least = values.iter().find(|value| n_between(**value, **value + BESIDE) >= n_needed);
    let most = values.iter().rfind(|value| n_between(**value - BESIDE, **value) >= n_needed);
    [least.copied().unwrap_or(0.0), most.copied().unwrap_or(0.0)]
}

/// The coefficients of sRGB's curve, nearly.
fn start(index: usize) -> f64 {
    let value = (index as f64 - 1.0) / N_INTERVALS as f64;
    value.max(0.0).powf(2.2) + value.min(0.0) * 0.05
}

/// The interval of a value, and the part of the way through it.
fn interval(value: f64) -> (usize, f64) {
    let at = value.clamp(0.0, 1.0) * N_INTERVALS as f64;
    let first = (at as usize).min(N_INTERVALS - 1);
    (first, at - first as f64)
}

/// The factors of coefficients in the mean light behind values: that at their mean, and half of the curvature there for each
/// unit of their variance.
fn value_row(value: f64, variance: f64) -> [(usize, f64); 4] {
    let (first, t) = interval(value);
    let weights = [
        (1.0 - t).powi(3) / 6.0,
        (3.0 * t.powi(3) - 6.0 * t * t + 4.0) / 6.0,
        (-3.0 * t.powi(3) + 3.0 * t * t + 3.0 * t + 1.0) / 6.0,
        t.powi(3) / 6.0,
    ];
    let curvatures = [1.0 - t, 3.0 * t - 2.0, 1.0 - 3.0 * t, t];
    let factor = 0.5 * variance * (N_INTERVALS * N_INTERVALS) as f64;
    std::array::from_fn(|n| (first + n, weights[n] + factor * curvatures[n]))
}

/// The terms of white that vary within a field.
pub(super) fn white_terms(place: DVec2) -> [f64; N_WHITE] {
    let DVec2 { x, y } = place;
    [1.0, x, y, x * x, x * y, y * y]
}

/// The terms of a field, with which its light is taken off: light there without the projector's, and its part of white.
fn field_row(place: DVec2, part: f64) -> [(usize, f64); N_WHITE + N_BLACK] {
    let white = white_terms(place);
    std::array::from_fn(|term| match term.checked_sub(N_WHITE) {
        None => (term, -part * white[term]),
        Some(black) => (term, -white[black]),
    })
}

fn white_at(local: &[f64], place: DVec2) -> f64 {
    white_terms(place).iter().zip(local).map(|(term, factor)| term * factor).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Squares of fields with fall-off, in photographs of several exposures, through a camera's curve.
    fn squares(curve: impl Fn(f64) -> f64, n_groups: usize) -> Vec<Known> {
        let square = |n: usize| {
            let group = n % n_groups;
            let place = DVec2::new((n * 7 % 41) as f64, (n * 11 % 37) as f64) / DVec2::new(20.0, 18.0) - 1.0;
            let part = [0.0, 0.25, 0.5, 0.75, 1.0][n / n_groups % 5];
            let white = (0.9 - 0.35 * place.length_squared() / 2.0) / (1.0 + group as f64);
            let light = 0.05 + 0.01 * place.x + part * white;
            Known { group, place, part, value: curve(light), variance: 0.0, foreign: 0.0 }
        };
        (0..600 * n_groups).map(square).collect()
    }

    #[test]
    fn curves_of_cameras_are_found() {
        let check = |curve: &dyn Fn(f64) -> f64| {
            let response = Response::solve(3, &squares(curve, 3)).expect("determined");
            // Up to its unit and its zero.
            let [dark, bright] = [0.1, 0.9].map(|light| response.light(curve(light), 0.0));
            for light in [0.07, 0.2, 0.3, 0.5, 0.7, 0.85] {
                let found = 0.1 + 0.8 * (response.light(curve(light), 0.0) - dark) / (bright - dark);
                assert!((found - light).abs() < 0.003, "{found} instead of {light}");
            }
            assert!(response.error < 0.003, "{}", response.error);
        };
        check(&|light| light.powf(1.0 / 2.2));
        check(&|light| 0.9 * light);
        check(&|light| {
            let value = 1.055 * light.powf(1.0 / 2.4) - 0.055;
            value - 0.04 * (std::f64::consts::TAU * value).sin()
        });
    }

    #[test]
    fn strays_do_no_harm_and_nothing_is_no_response() {
        let mut known = squares(|light| light.powf(1.0 / 2.2), 3);
        known.iter_mut().step_by(20).for_each(|it| it.value = 0.5);
        let response = Response::solve(3, &known).expect("determined");
        let [low, middle, high] = [0.1_f64, 0.5, 0.9].map(|light| response.light(light.powf(1.0 / 2.2), 0.0));
        assert!(((middle - low) / (high - low) - 0.5).abs() < 0.005);
        assert_eq!(Response::solve(0, &[]), None);
        known.iter_mut().for_each(|it| it.value = 0.4);
        assert_eq!(Response::solve(3, &known), None);
    }

    #[test]
    fn the_mean_light_of_a_mixture_is_not_that_of_its_mean_value() {
        let response = Response::solve(3, &squares(|light| light.powf(1.0 / 2.2), 3)).expect("determined");
        let both = [0.45, 0.55].map(|value| response.light(value, 0.0));
        let mean = (both[0] + both[1]) / 2.0;
        assert!((response.light(0.5, 0.0025) - mean).abs() < 2e-5);
        assert!((response.light(0.5, 0.0) - mean).abs() > 5e-4);
        let slope = (response.light(0.501, 0.0) - response.light(0.499, 0.0)) / 0.002;
        assert!((response.slope(0.5) - slope).abs() < 1e-4);
    }
}
