//! Works out projectors' light from what photographs show of their patterns.

use glam::DVec2;

use super::{
    black::{self, Overlaps},
    colour::{Lacking, Shares, strengths},
    field::{Bright, Fields},
    ink::Ink,
    levels::{Curve, Field, Lit, place},
    response::{Known, Response},
    sample::LightShot,
};
use crate::wall::{FallOff, Gamma, Projector, Wall};

/// The light of one projector, as far as photographs tell it.
#[derive(Clone, Debug)]
pub struct Light {
    /// Its light curve, and the largest departure of a grey from it, as a part of white.
    pub gamma: Gamma,
    /// See `gamma`.
    pub gamma_error: f64,
    /// White at the control points of its fall-off, row by row from the top as seen on the wall; in a unit that all
    /// projectors share.
    pub white: [f64; FallOff::SIDE * FallOff::SIDE],
    /// The strength of its red, green and blue, in proportion to the mean of all projectors with the same `white`.
    pub strength: [f64; 3],
    /// The light of its black as a part of its white's; `None` if nothing tells it.
    pub black: Option<f64>,
    /// How much more light its white has than its red, green and blue together, as a part of it.
    pub excess: f64,
    /// The number of squares that were measured.
    pub n_squares: usize,
    /// The part of its field where some were.
    pub covered: f64,
    /// The typical error of one, as a part of white.
    pub error: f64,
}

/// All projectors' light.
#[derive(Clone, Debug, Default)]
pub struct LightSolution {
    /// `None` for projectors of which too little was measured.
    pub projectors: Vec<Option<Light>>,
    /// For each shot: the typical error of a square, as a part of white; infinite if it shows nothing.
    pub shot_errors: Vec<f64>,
    /// Shots whose camera's response could not be found.
    pub has_no_response: Vec<bool>,
    /// For each projector: the part of its bright squares that are over-exposed in all shots.
    pub over_exposed: Vec<f64>,
    /// Whether photographs told the camera's vignetting from the projectors' fall-off.
    pub has_vignetting: bool,
}

/// Darker and brighter values than these tell no light: the camera cuts them off.
const VALUES: [f64; 2] = [0.004, 0.99];
/// Greys dimmer than this part of white tell little of it.
const LEAST_PART: f64 = 0.3;
/// Cells a side by which the covered part of a field is counted.
const CELLS: usize = 5;
/// Rounds of measuring anew without the light of others' black, which is a hundredth of a square's at most.
const N_ROUNDS: usize = 3;
/// Fewer squares tell no projector's light.
const LEAST_SQUARES: usize = 30;

/// Solves for the light of a wall's projectors from shots, whose geometry the wall has.
pub fn solve(wall: &Wall, shots: &[&LightShot]) -> LightSolution {
    let n_projectors = wall.projectors().len();
    let mut sizes: Vec<[usize; 2]> = shots.iter().map(|shot| shot.size).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let camera_of: Vec<usize> = shots.iter().map(|shot| sizes.binary_search(&shot.size).unwrap_or_default()).collect();
    let over_exposed: Vec<f64> = (0..n_projectors).map(|index| over_exposed(index, shots)).collect();
    let overlaps = Overlaps::new(wall);
    let mut foreign: Vec<[f64; 3]> = Vec::new();
    let mut round = Round::new(wall, shots, &camera_of, &foreign);
    // Others' black, which begins at their edges, is known once their light is: then all is measured without it.
    let mut blacks = Vec::new();
    for _ in 0..N_ROUNDS {
        let Some(product) = &round.product else { break };
        blacks = black::solve(&overlaps, &round.lits, product, &camera_of, &round.is_solved);
        foreign = black::foreign(&overlaps, &round.lits, product, &camera_of, &blacks);
        round = Round::new(wall, shots, &camera_of, &foreign);
    }
    let Round { has_no_response, bright, curves, shares, is_solved, product, .. } = round;
    let Some(product) = product.filter(|_| blacks.len() == n_projectors) else {
        return LightSolution {
            projectors: vec![None; n_projectors],
            shot_errors: vec![f64::INFINITY; shots.len()],
            has_no_response,
            over_exposed,
            has_vignetting: false,
        };
    };
    let solved: Vec<usize> = (0..n_projectors).filter(|index| is_solved[*index]).collect();
    let of_solved: Vec<(Shares, [f64; 3])> =
        solved.iter().filter_map(|&index| Some((shares[index]?, product.colour(index)))).collect();
    let strengths = strengths(&of_solved);
    let mut projectors = vec![None; n_projectors];
    for ((index, strength), (shares, _)) in solved.iter().copied().zip(strengths).zip(of_solved) {
        let Some(Curve { gamma, error: gamma_error }) = curves[index] else { continue };
        projectors[index] = Some(Light {
            gamma,
            gamma_error,
            white: product.points(index),
            strength,
            black: blacks[index],
            excess: shares.excess(),
            n_squares: n_squares_of(index, &bright),
            covered: covered(index, &bright),
            error: product.errors[index],
        });
    }
    let is_seen = |shot: usize| bright.iter().any(|it| it.shot == shot);
    let shot_errors =
        (0..shots.len()).map(|shot| if is_seen(shot) { product.shot_errors[shot] } else { f64::INFINITY }).collect();
    let has_vignetting = product.has_vignetting.iter().all(|has| *has);
    LightSolution { projectors, shot_errors, has_no_response, over_exposed, has_vignetting }
}

/// The solution of all squares, if the light of others' black in each is known.
struct Round {
    has_no_response: Vec<bool>,
    /// In the order of shots and their samples.
    lits: Vec<Lit>,
    curves: Vec<Option<Curve>>,
    shares: Vec<Option<Shares>>,
    /// Bright squares of projectors that are solved.
    bright: Vec<Bright>,
    is_solved: Vec<bool>,
    product: Option<Fields>,
}

impl Round {
    /// `foreign` is the light of others' black in each square; empty if nothing is known of it.
    fn new(wall: &Wall, shots: &[&LightShot], camera_of: &[usize], foreign: &[[f64; 3]]) -> Self {
        let n_projectors = wall.projectors().len();
        let n_cameras = camera_of.iter().max().map_or(0, |last| last + 1);
        // The samples of each shot begin here.
        let firsts: Vec<usize> =
            shots.iter().scan(0, |next, shot| Some(std::mem::replace(next, *next + shot.samples.len()))).collect();
        let foreign_of = |shot: usize, sample: usize| foreign.get(firsts[shot] + sample).copied().unwrap_or_default();
        let responses: Vec<[Option<Response>; 3]> = (0..n_cameras)
            .map(|camera| {
                [0, 1, 2].map(|channel| response((camera, channel), shots, camera_of, n_projectors, &foreign_of))
            })
            .collect();
        let has_no_response: Vec<bool> =
            camera_of.iter().map(|camera| responses[*camera].iter().any(Option::is_none)).collect();
        let lits: Vec<Lit> = (0..shots.len())
            .flat_map(|shot| lits(shot, shots[shot], &responses[camera_of[shot]], &|sample| foreign_of(shot, sample)))
            .collect();
        let fields = Groups::new(&lits, n_projectors);
        let curves: Vec<Option<Curve>> = (0..n_projectors).map(|index| curve(index, &fields)).collect();
        let shares: Vec<Option<Shares>> = (0..n_projectors).map(|index| shares(index, &fields)).collect();
        let mut bright = brights(wall, &fields, &curves, camera_of);
        let is_solved: Vec<bool> = (0..n_projectors)
            .map(|index| {
                n_squares_of(index, &bright) >= LEAST_SQUARES && curves[index].is_some() && shares[index].is_some()
            })
            .collect();
        bright.retain(|it| is_solved[it.projector]);
        drop(fields);
        let product = Fields::solve(n_projectors, shots.len(), n_cameras, &bright).filter(|_| !bright.is_empty());
        Self { has_no_response, lits, curves, shares, bright, is_solved, product }
    }
}

/// Whether a value with noise of this variance is not cut off.
fn is_usable(mean: f64, variance: f64) -> bool {
    mean >= VALUES[0] && mean + 1.5 * variance.sqrt() <= VALUES[1]
}

fn response(
    (camera, channel): (usize, usize),
    shots: &[&LightShot],
    camera_of: &[usize],
    n_projectors: usize,
    foreign_of: &dyn Fn(usize, usize) -> [f64; 3],
) -> Option<Response> {
    let mut known = Vec::new();
    let own: Vec<usize> = (0..shots.len()).filter(|shot| camera_of[*shot] == camera).collect();
    for (n, &shot) in own.iter().enumerate() {
        for (sample_idx, sample) in shots[shot].samples.iter().enumerate() {
            let (value, variance) = (sample.mean[channel], sample.variance[channel]);
            if let Some(part) = sample.ink.part()
                && is_usable(value, variance)
            {
                let group = n * n_projectors + sample.projector_idx;
                let foreign = foreign_of(shot, sample_idx)[channel];
                known.push(Known { group, place: place(sample.raster), part, value, variance, foreign });
            }
        }
    }
    Response::solve(own.len() * n_projectors, &known)
}

fn lits(
    shot: usize,
    it: &LightShot,
    responses: &[Option<Response>; 3],
    foreign_of: &dyn Fn(usize) -> [f64; 3],
) -> Vec<Lit> {
    let lit = |(sample_idx, sample): (usize, &super::Sample)| {
        let light = |channel: usize| {
            let (mean, variance) = (sample.mean[channel], sample.variance[channel]);
            let response = responses[channel].as_ref().filter(|_| is_usable(mean, variance))?;
            let [least, most] = response.range;
            // Beyond what was measured, the curve is a guess.
            let is_measured = (least - 0.01..=most + 0.01).contains(&mean);
            is_measured.then(|| [response.light(mean, variance), response.slope(mean).max(0.05)])
        };
        Lit {
            shot,
            projector: sample.projector_idx,
            ink: sample.ink,
            raster: sample.raster,
            at: sample.at,
            light: [0, 1, 2].map(light),
            foreign: foreign_of(sample_idx),
        }
    };
    it.samples.iter().enumerate().map(lit).collect()
}

/// Squares by photograph and projector, with the fields of the camera's channels there.
struct Groups<'a> {
    all: Vec<(Vec<&'a Lit>, [Option<Field>; 3])>,
}

impl<'a> Groups<'a> {
    fn new(lits: &'a [Lit], n_projectors: usize) -> Self {
        let n_shots = lits.iter().map(|it| it.shot + 1).max().unwrap_or(0);
        let mut all: Vec<Vec<&Lit>> = vec![Vec::new(); n_shots * n_projectors];
        lits.iter().for_each(|it| all[it.shot * n_projectors + it.projector].push(it));
        let with_fields = |squares: Vec<&'a Lit>| {
            let fields = [0, 1, 2].map(|channel| Field::fit(&squares, channel));
            (squares, fields)
        };
        Self { all: all.into_iter().filter(|it| !it.is_empty()).map(with_fields).collect() }
    }

    /// Squares with their part of white and its error, in each channel where it is known.
    fn parts(&self, projector: Option<usize>) -> impl Iterator<Item = (&'a Lit, usize, [f64; 2])> {
        let own =
            self.all.iter().filter(move |(squares, _)| projector.is_none_or(|index| squares[0].projector == index));
        own.flat_map(|(squares, fields)| {
            squares.iter().flat_map(move |it| {
                (0..3).filter_map(move |channel| Some((*it, channel, fields[channel].as_ref()?.part(it, channel)?)))
            })
        })
    }
}

fn curve(projector: usize, groups: &Groups<'_>) -> Option<Curve> {
    let grey = |(it, _, part): (&Lit, usize, [f64; 2])| match it.ink {
        Ink::Grey(value) if it.ink.part().is_none() => Some((value, part)),
        _ => None,
    };
    Curve::fit(&groups.parts(Some(projector)).filter_map(grey).collect::<Vec<_>>())
}

fn shares(projector: usize, groups: &Groups<'_>) -> Option<Shares> {
    let mut lacking = Lacking::default();
    for (it, channel, part) in groups.parts(Some(projector)) {
        if let Ink::Without(shown) = it.ink {
            lacking[channel][usize::from(shown)].push(part);
        }
    }
    Shares::fit(&lacking)
}

fn brights(wall: &Wall, groups: &Groups<'_>, curves: &[Option<Curve>], camera_of: &[usize]) -> Vec<Bright> {
    let upright_from_raster: Vec<_> =
        wall.projectors().iter().map(|it: &Projector| it.raster_from_upright().inverse()).collect();
    let mut all = Vec::new();
    for (squares, fields) in &groups.all {
        for it in squares {
            let part = match it.ink {
                Ink::Grey(value) if it.ink.part().is_none() => curves[it.projector].map(|curve| curve.light(value)),
                ink => ink.part(),
            };
            let Some(part) = part.filter(|part| *part >= LEAST_PART) else { continue };
            for (channel, field) in fields.iter().enumerate() {
                let (Some(field), Some([light, slope])) = (field, it.own(channel)) else { continue };
                let white = (light - field.black(place(it.raster))) / part;
                if white > 1e-6 {
                    all.push(Bright {
                        shot: it.shot,
                        camera: camera_of[it.shot],
                        projector: it.projector,
                        channel,
                        upright: upright_from_raster[it.projector].transform_point2(it.raster),
                        at: it.at,
                        log_white: white.ln(),
                        error: slope / part / white,
                    });
                }
            }
        }
    }
    all
}

fn n_squares_of(projector: usize, bright: &[Bright]) -> usize {
    bright.iter().filter(|it| it.projector == projector).count() / 3
}

/// The part of a field's cells that have a square.
fn covered(projector: usize, bright: &[Bright]) -> f64 {
    let mut has_square = [false; CELLS * CELLS];
    for it in bright.iter().filter(|it| it.projector == projector) {
        let DVec2 { x, y } = (it.upright * CELLS as f64).clamp(DVec2::ZERO, DVec2::splat(CELLS as f64 - 1.0));
        has_square[y as usize * CELLS + x as usize] = true;
    }
    has_square.iter().filter(|has| **has).count() as f64 / (CELLS * CELLS) as f64
}

/// The part of a projector's white squares that a channel of the camera shows burnt out.
fn over_exposed(projector: usize, shots: &[&LightShot]) -> f64 {
    let samples = || shots.iter().flat_map(|shot| &shot.samples);
    let white = || samples().filter(|it| it.projector_idx == projector && it.ink == Ink::Grey(255));
    let is_burnt =
        |channel: usize, it: &super::Sample| it.mean[channel] + 1.5 * it.variance[channel].sqrt() > VALUES[1];
    white().filter(|it| (0..3).any(|channel| is_burnt(channel, it))).count() as f64 / white().count().max(1) as f64
}
