//! From photographs of patterns of light to the light settings of a wall: what was found, what was not, and the cure.

use shared::printable::counted;

use super::{
    sample::LightShot,
    solve::{Light, LightSolution, solve},
};
use crate::{
    calibration::{fitting::median, verdict::Reading},
    wall::{FallOff, Flip, Gamma, Projector, Wall},
};

/// Light settings for a wall, and how sure they are.
#[derive(Clone, Debug)]
pub struct LightVerdict {
    /// The wall with new gammas, black levels, gains and fall-offs; `None` if nothing could be solved. Projectors without a
    /// solution keep theirs.
    pub wall: Option<Wall>,
    /// The findings: a line for each projector, and for what does not count.
    pub found: Vec<String>,
    /// Everything that speaks against using the settings, each with the cure.
    pub faults: Vec<String>,
}

/// A square's light is typically nearer than this to what it should be, as a part of white, or its projector does not fit.
const LARGEST_ERROR: f64 = 0.02;
/// A photograph whose squares are so many times as far off as those of the others was not taken as they were.
const FARTHEST_SHOT: f64 = 4.0;
/// Greys are nearer than this to a projector's light curve, as a part of white.
const LARGEST_GAMMA_ERROR: f64 = 0.015;
/// White has at most so much more light than red, green and blue together.
const LARGEST_EXCESS: f64 = 0.06;
/// The part of a projector's field in which squares must be seen.
const LEAST_COVERED: f64 = 0.9;
/// Blacks of this size or less cannot be told from none.
const LEAST_BLACK: f64 = 1e-5;

/// Solves a wall's light from all photographs; the wall has their geometry.
pub fn judge_light(wall: &Wall, readings: &[Reading]) -> LightVerdict {
    let (mut found, mut faults) = (Vec::new(), Vec::new());
    let mut shots: Vec<(&str, LightShot)> = readings
        .iter()
        .filter(|reading| !reading.light.samples.is_empty())
        .map(|reading| (reading.name.as_str(), without_reflections(&reading.light, wall)))
        .collect();
    for Reading { name, light, .. } in readings {
        if light.n_too_small > light.samples.len() {
            found.push(format!(
                "{name}: most squares of the patterns of light are too small to measure: photograph them from nearer"
            ));
        }
    }
    if shots.is_empty() {
        faults.push(
            "no photograph shows a pattern of light: photograph those after the black and white ones, too".to_owned(),
        );
        return LightVerdict { wall: None, found, faults };
    }
    let mut solution = solve(wall, &of(&shots));
    while let Some(worst) = misfit(&solution.shot_errors) {
        found.push(format!(
            "{} does not fit the others, by {:.0} % of white, and does not count: somebody stood before the wall, or its \
             exposure changed while it was taken",
            shots[worst].0,
            100.0 * solution.shot_errors[worst]
        ));
        shots.remove(worst);
        solution = solve(wall, &of(&shots));
    }
    for ((name, _), has_no_response) in shots.iter().zip(&solution.has_no_response) {
        if *has_no_response {
            found.push(format!(
                "{name}: the camera's curve cannot be found, so it tells no light: is it over- or under-exposed?"
            ));
        }
    }
    for (index, (projector, light)) in wall.projectors().iter().zip(&solution.projectors).enumerate() {
        match light {
            Some(light) => report(&projector.name, light, &mut found, &mut faults),
            None => faults.push(missing_fault(&projector.name, index, &shots, &solution)),
        }
    }
    let blacks = solution.projectors.iter().flatten().map(|light| light.black);
    if blacks.clone().any(|black| black.is_none()) {
        found.push(
            "black levels that no overlap tells stay as the file has them: a longer exposure may show them".to_owned(),
        );
    }
    if !solution.has_vignetting && solution.projectors.iter().any(Option::is_some) {
        found.push(
            "photographs from one place do not tell the camera's vignetting from the projectors' fall-off: no seam shows, \
             but the wall's edges may be a little brighter than its middle; photograph the patterns of light from a second \
             place, with the wall elsewhere in the picture, to mend that"
                .to_owned(),
        );
    }
    let new_wall = lit(wall, &solution, &mut faults);
    LightVerdict { wall: new_wall, found, faults }
}

fn of<'a>(shots: &'a [(&str, LightShot)]) -> Vec<&'a LightShot> {
    shots.iter().map(|(_, shot)| shot).collect()
}

/// The shot without what a mirror or a shining floor shows.
fn without_reflections(shot: &LightShot, wall: &Wall) -> LightShot {
    let is_reflected =
        |projector_idx: usize, is_mirrored: bool| is_mirrored != (wall.projectors()[projector_idx].flip != Flip::None);
    let n_reflected = shot.samples.iter().filter(|it| is_reflected(it.projector_idx, it.is_mirrored)).count();
    // A wall that is seen in a mirror is all reflected.
    let are_most = 2 * n_reflected > shot.samples.len();
    let mut shot = shot.clone();
    shot.samples.retain(|it| is_reflected(it.projector_idx, it.is_mirrored) == are_most);
    shot
}

/// The shot that fits worst, if it fits badly, and much worse than the others.
fn misfit(errors: &[f64]) -> Option<usize> {
    let used: Vec<usize> = (0..errors.len()).filter(|shot| errors[*shot].is_finite()).collect();
    let usual = median(used.iter().map(|shot| errors[*shot]).collect());
    let worst = used.iter().copied().max_by(|a, b| errors[*a].total_cmp(&errors[*b]))?;
    (used.len() >= 3 && errors[worst] > (FARTHEST_SHOT * usual).max(LARGEST_ERROR)).then_some(worst)
}

/// A line on a projector, and what speaks against it.
fn report(name: &str, light: &Light, found: &mut Vec<String>, faults: &mut Vec<String>) {
    let percent = |part: f64| 100.0 * part;
    let gamma = match light.gamma {
        Gamma::Srgb => "gamma of sRGB".to_owned(),
        Gamma::Power(exponent) => format!("gamma {exponent:.2}"),
    };
    let [least, most] = extent(&light.white);
    let black = light.black.map_or("not told".to_owned(), |black| format!("{:.2} %", percent(black)));
    found.push(format!(
        "\"{name}\": {} of light in {:.0} % of its field; {gamma}, black {black} of its white, its darkest place {:.0} % of \
         its brightest; typically within {:.1} %",
        counted(light.n_squares, "square"),
        percent(light.covered),
        percent(least / most),
        percent(light.error)
    ));
    if light.covered < LEAST_COVERED {
        faults.push(format!(
            "the light of only {:.0} % of \"{name}\" was measured, and {:.0} % is needed: photograph every pattern of light \
             with all of it in the picture, its white not burnt out, and clear the way to the camera",
            percent(light.covered),
            percent(LEAST_COVERED)
        ));
    }
    if light.error.is_nan() || light.error > LARGEST_ERROR {
        faults.push(format!(
            "the light of \"{name}\" does not fit: squares are off by {:.1} % of white, where {:.0} % is allowed: switch off \
             the camera's HDR and picture styles, and its own light control; expose for a thirtieth of a second or longer",
            percent(light.error),
            percent(LARGEST_ERROR)
        ));
    }
    if light.gamma_error.is_nan() || light.gamma_error > LARGEST_GAMMA_ERROR {
        faults.push(format!(
            "greys of \"{name}\" follow no gamma: the nearest is off by {:.1} % of white, where {:.1} % is allowed: choose a \
             plain picture mode on it, and switch off its sharpness, scaling and dynamic contrast",
            percent(light.gamma_error),
            percent(LARGEST_GAMMA_ERROR)
        ));
    }
    if light.excess.is_nan() || light.excess.abs() > LARGEST_EXCESS {
        faults.push(format!(
            "white of \"{name}\" has {:.0} % other light than its red, green and blue together: switch off its colour \
             boost, or \"brilliant colour\"",
            percent(light.excess)
        ));
    }
}

/// The cause that a projector's light was not solved, with the cure.
fn missing_fault(name: &str, index: usize, shots: &[(&str, LightShot)], solution: &LightSolution) -> String {
    let is_seen = shots.iter().flat_map(|(_, shot)| &shot.samples).any(|sample| sample.projector_idx == index);
    if !is_seen {
        format!(
            "\"{name}\" is in no photograph of a pattern of light: is it on, is it sharp, is it in the picture, and does nobody \
             stand before it?"
        )
    } else if solution.over_exposed[index] > 0.5 {
        format!("white of \"{name}\" is burnt out in all photographs: expose shorter")
    } else {
        format!(
            "too few squares of \"{name}\" tell its light: photograph every pattern of light with all of it in the picture, \
             neither burnt out nor too dark, and clear the way to the camera"
        )
    }
}

fn extent(white: &[f64]) -> [f64; 2] {
    white.iter().fold([f64::INFINITY, 0.0], |[least, most], it| [least.min(*it), most.max(*it)])
}

/// The wall with the light that was found: all projectors are dimmed to the light that the dimmest gives at its darkest
/// place, in red, green and blue each.
fn lit(wall: &Wall, solution: &LightSolution, faults: &mut Vec<String>) -> Option<Wall> {
    let darkest = |light: &Light| extent(&light.white)[0];
    // The light of each colour at the darkest place of the projector.
    let strongest = |light: &Light| light.strength.map(|strength| strength * darkest(light));
    let solved =
        || wall.projectors().iter().zip(&solution.projectors).filter_map(|(it, light)| Some((it, light.as_ref()?)));
    let mut blacks: Vec<f64> = solved().map(|(projector, _)| projector.black_level).collect();
    let mut white = [0.0; 3];
    // White includes black, whose part of white it tells: one after the other they settle.
    for _ in 0..8 {
        white = [f64::INFINITY; 3];
        for ((_, light), black) in solved().zip(&blacks) {
            white = std::array::from_fn(|n| f64::min(white[n], strongest(light)[n] / (1.0 - black)));
        }
        let grey = white.iter().sum::<f64>() / 3.0;
        for ((_, light), black) in solved().zip(&mut blacks) {
            let own = strongest(light).iter().sum::<f64>() / 3.0;
            *black = light.black.map_or(*black, |of_white| of_white * own / grey);
        }
    }
    let mut projectors = wall.projectors().to_vec();
    let mut left = blacks.into_iter();
    for (projector, light) in projectors.iter_mut().zip(&solution.projectors) {
        let (Some(light), Some(black)) = (light, light.as_ref().and_then(|_| left.next())) else { continue };
        let rounded = |value: f64, digits: f64| (value * digits).round() / digits;
        let gain = std::array::from_fn(|n| rounded((1.0 - black) * white[n] / strongest(light)[n], 1e4).min(1.0));
        let black = if black < LEAST_BLACK { 0.0 } else { rounded(black, 1e5) };
        let brightest = extent(&light.white)[1];
        let side = FallOff::SIDE;
        let parts = std::array::from_fn(|row| {
            std::array::from_fn(|column| rounded(light.white[row * side + column] / brightest, 1e4))
        });
        let fall_off = match FallOff::new(parts) {
            Ok(fall_off) => Some(fall_off),
            Err(problem) => {
                faults.push(format!("\"{}\": {problem}: does something shade it?", projector.name));
                continue;
            }
        };
        let is_plausible = black <= 0.25 && gain.iter().all(|it| (0.05..=1.0).contains(it));
        if !is_plausible {
            faults.push(format!(
                "\"{}\" would be dimmed to {:.0} %, with a black of {:.0} % of the wall's white: is its lamp, its colour mode \
                 or that of another projector amiss?",
                projector.name,
                100.0 * gain.iter().copied().fold(1.0, f64::min),
                100.0 * black
            ));
            continue;
        }
        *projector = Projector { gamma: light.gamma, black_level: black, gain, fall_off, ..projector.clone() };
    }
    let is_changed = projectors != wall.projectors();
    let new_wall = wall.with_projectors(projectors).map_err(|error| faults.push(error.to_string()));
    new_wall.ok().filter(|_| is_changed)
}
