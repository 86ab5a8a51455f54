//! The light of each projector in each photograph, and of its greys.

use glam::DVec2;

use super::{
    arrow::{Arrow, robust_weights},
    ink::{GREYS, Ink},
    response::white_terms,
};
use crate::wall::Gamma;

/// A square with the light behind its values.
#[derive(Clone, Debug)]
pub(super) struct Lit {
    pub shot: usize,
    pub projector: usize,
    pub ink: Ink,
    /// In the projector's pixels as stored, from (0, 0) to (1, 1).
    pub raster: DVec2,
    /// In the photograph, from its centre, in halves of the diagonal.
    pub at: DVec2,
    /// For red, green and blue: the light, and its error for an error of one in the value; `None` where the photograph is
    /// over-exposed.
    pub light: [Option<[f64; 2]>; 3],
    /// The light that other projectors' black adds.
    pub foreign: [f64; 3],
}

/// The light of one projector in one photograph, in one channel of the camera: `black + part × white`.
#[derive(Clone, Debug)]
pub(super) struct Field {
    black: [f64; 6],
    white: [f64; 6],
}

/// A projector's light curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Curve {
    pub gamma: Gamma,
    /// The largest departure of a grey from it, as a part of white.
    pub error: f64,
}

/// Squares that are typically off by more than this part of white are no field.
const LARGEST_ERROR: f64 = 0.1;
/// Fewer squares of either kind, dark and bright, determine no field.
const LEAST_SQUARES: usize = 5;
/// The weight of even light, where that of a square is 1 or more.
const WEAK: f64 = 0.01;
/// Rounds of weighing anew.
const N_ROUNDS: usize = 5;

/// A place in a field, from (-1, -1) to (1, 1).
pub(super) fn place(raster: DVec2) -> DVec2 {
    2.0 * raster - 1.0
}

impl Lit {
    /// The light of its own projector and of the room, and its error; see `light`.
    pub(super) fn own(&self, channel: usize) -> Option<[f64; 2]> {
        self.light[channel].map(|[light, slope]| [light - self.foreign[channel], slope])
    }
}

impl Field {
    /// The field of squares of one photograph and projector. `None` if they are too few, or fit badly.
    pub(super) fn fit(squares: &[&Lit], channel: usize) -> Option<Self> {
        let known: Vec<(DVec2, f64, [f64; 2])> =
            squares.iter().filter_map(|it| Some((place(it.raster), it.ink.part()?, it.own(channel)?))).collect();
        let n_bright = known.iter().filter(|(_, part, _)| *part >= 0.5).count();
        if n_bright.min(known.len() - n_bright) < LEAST_SQUARES {
            return None;
        }
        let mut weights = vec![1.0; known.len()];
        let mut field = None;
        for _ in 0..N_ROUNDS {
            let mut arrow = Arrow::new(1, 12, 0);
            for ((place, part, [light, slope]), weight) in known.iter().zip(&weights) {
                let terms = white_terms(*place);
                let row: [_; 12] = std::array::from_fn(|n| (n, if n < 6 { part * terms[n] } else { terms[n - 6] }));
                arrow.add(0, &row, &[], *light, weight / (slope * slope));
            }
            // Few squares tell no curvature.
            [3, 4, 5, 7, 8, 9, 10, 11].iter().for_each(|&term| arrow.add(0, &[(term, 1.0)], &[], 0.0, WEAK));
            let local = arrow.solve()?.local.remove(0);
            let new = Self { white: std::array::from_fn(|n| local[n]), black: std::array::from_fn(|n| local[6 + n]) };
            let away = |(place, part, [light, _]): &(DVec2, f64, [f64; 2])| {
                light - new.black(*place) - part * new.white(*place)
            };
            let in_values: Vec<f64> = known.iter().map(|it| away(it) / it.2[1]).collect();
            weights = robust_weights(&in_values).0;
            let parts: Vec<f64> = known.iter().map(|it| away(it) / new.white(it.0).max(1e-9)).collect();
            field = Some((new, robust_weights(&parts).1));
        }
        let (field, error) = field?;
        let is_told = error <= LARGEST_ERROR && known.iter().all(|(place, ..)| field.white(*place) > 0.0);
        is_told.then_some(field)
    }

    /// The light of a projector's white at a place of its field.
    pub(super) fn white(&self, place: DVec2) -> f64 {
        self.white.iter().zip(white_terms(place)).map(|(factor, term)| factor * term).sum()
    }

    /// The light there without it: of the room, and of its own black.
    pub(super) fn black(&self, place: DVec2) -> f64 {
        self.black.iter().zip(white_terms(place)).map(|(factor, term)| factor * term).sum()
    }

    /// The part of white that a square shows, and its error for an error of one in the value.
    pub(super) fn part(&self, it: &Lit, channel: usize) -> Option<[f64; 2]> {
        let [light, slope] = it.own(channel)?;
        let white = self.white(place(it.raster));
        (white > 1e-6).then(|| [(light - self.black(place(it.raster))) / white, slope / white])
    }
}

impl Curve {
    /// The curve of a projector, from parts of white with their errors that its greys show. `None` if there are none of
    /// most greys.
    pub(super) fn fit(greys: &[(u8, [f64; 2])]) -> Option<Self> {
        let mut levels: Vec<(f64, f64)> = Vec::new();
        for grey in GREYS {
            let of: Vec<[f64; 2]> = greys.iter().filter(|(value, _)| *value == grey).map(|(_, part)| *part).collect();
            levels.extend(mean(&of).map(|part| (f64::from(grey) / 255.0, part)));
        }
        if levels.len() + 1 < GREYS.len() {
            return None;
        }
        let error = |gamma: Gamma, fold: fn(f64, f64) -> f64| {
            levels.iter().map(|(value, part)| (light_of(gamma, *value) - part).abs()).fold(0.0, fold)
        };
        let sum_of_squares = |exponent: f64| error(Gamma::Power(exponent), |sum, away| sum + away * away);
        // The sum has one minimum: trisect.
        let [mut least, mut most] = [1.0, 4.0];
        for _ in 0..60 {
            let [a, b] = [(2.0 * least + most) / 3.0, (least + 2.0 * most) / 3.0];
            if sum_of_squares(a) < sum_of_squares(b) { most = b } else { least = a }
        }
        let power = Gamma::Power(((least + most) * 500.0).round() / 1000.0);
        let gamma = if error(Gamma::Srgb, f64::max) < error(power, f64::max) { Gamma::Srgb } else { power };
        Some(Self { gamma, error: error(gamma, f64::max) })
    }

    /// The light of a grey, as a part of white.
    pub(super) fn light(&self, grey: u8) -> f64 {
        light_of(self.gamma, f64::from(grey) / 255.0)
    }
}

fn light_of(gamma: Gamma, value: f64) -> f64 {
    match gamma {
        Gamma::Power(exponent) => value.powf(exponent),
        Gamma::Srgb if value <= 0.04045 => value / 12.92,
        Gamma::Srgb => ((value + 0.055) / 1.055).powf(2.4),
    }
}

/// The mean of values with errors, without strays. `None` for none.
pub(super) fn mean(values: &[[f64; 2]]) -> Option<f64> {
    let mut centre = super::super::fitting::median(values.iter().map(|[value, _]| *value).collect());
    for _ in 0..N_ROUNDS {
        let away: Vec<f64> = values.iter().map(|[value, error]| (value - centre) / error).collect();
        let (weights, _) = robust_weights(&away);
        let weighted = || weights.iter().zip(values).map(|(weight, [value, error])| (weight / (error * error), value));
        centre = weighted().map(|(weight, value)| weight * value).sum::<f64>()
            / weighted().map(|(weight, _)| weight).sum::<f64>();
    }
    centre.is_finite().then_some(centre)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_and_srgb_are_told_apart() {
        let check = |gamma: Gamma| {
            let part = |grey: u8, stray: f64| (grey, [light_of(gamma, f64::from(grey) / 255.0) + stray, 0.01]);
            let stray = |n: usize| if n < 55 { 0.002 * [1.0, -1.0][n % 2] } else { 0.3 };
            let greys: Vec<_> = (0..60).map(|n| part(GREYS[n % 5], stray(n))).collect();
            let curve = Curve::fit(&greys).expect("all greys");
            match (gamma, curve.gamma) {
                (Gamma::Power(expected), Gamma::Power(found)) => assert!((found - expected).abs() < 0.02, "{found}"),
                (expected, found) => assert_eq!(found, expected),
            }
            assert!(curve.error < 0.004, "{}", curve.error);
        };
        check(Gamma::Power(1.8));
        check(Gamma::Power(2.6));
        check(Gamma::Srgb);
        assert_eq!(Curve::fit(&[(64, [0.1, 0.01])]), None);
    }

    #[test]
    fn a_field_has_its_white_apart_from_the_room_s_light() {
        let square = |n: usize| {
            let raster = DVec2::new((n * 7 % 41) as f64 / 40.0, (n * 11 % 37) as f64 / 36.0);
            let ink = [Ink::Grey(0), Ink::Grey(255), Ink::Quarter, Ink::Rows][n % 4];
            let white = 0.8 - 0.3 * place(raster).length_squared() / 2.0;
            // Someone stood before a few.
            let seen = if n % 25 == 3 { 0.0 } else { 1.0 };
            let light = seen * (0.1 + 0.02 * place(raster).y + ink.part().expect("known") * white);
            Lit {
                shot: 0,
                projector: 0,
                ink,
                raster,
                at: raster,
                light: [Some([light, 1.0]), None, None],
                foreign: [0.0; 3],
            }
        };
        let squares: Vec<Lit> = (0..200).map(square).collect();
        let field = Field::fit(&squares.iter().collect::<Vec<_>>(), 0).expect("enough squares");
        for at in [DVec2::ZERO, DVec2::new(0.8, -0.5), DVec2::new(-0.9, 0.9)] {
            assert!((field.white(at) - (0.8 - 0.3 * at.length_squared() / 2.0)).abs() < 0.01, "{at}");
            assert!((field.black(at) - (0.1 + 0.02 * at.y)).abs() < 0.01, "{at}");
        }
        assert!(Field::fit(&squares.iter().collect::<Vec<_>>(), 1).is_none());
    }
}
