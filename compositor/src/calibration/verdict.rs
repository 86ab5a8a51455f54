//! From photographs to corners, or meshes: what was found, what was not, and the cure.

use glam::DVec2;
use rayon::prelude::*;
use shared::printable::counted;

use super::{
    bent_verdict, crossing,
    finding::{Finding, off_remark, typical},
    fitting::median,
    identify::Codebook,
    lattice,
    light::{ColourAt, LightShot, samples},
    noise::noise_px,
    pattern::Plan,
    photograph::Photograph,
    place::{Placement, warp_px},
    solve::{Fit, Shot, Solution, solve},
};
use crate::wall::{Flip, Projector, Wall, homography::UNIT_SQUARE};

/// The part of a wall that a photograph shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// The photograph's name, for messages.
    pub name: String,
    /// The parts of patterns in it that show places.
    pub shot: Shot,
    /// The squares of patterns of light in it.
    pub light: LightShot,
    /// The cause that it shows none, with the cure.
    fault: Option<String>,
    is_over_exposed: bool,
}

/// Corners for a wall, and how sure they are.
#[derive(Clone, Debug)]
pub struct Verdict {
    /// The wall with new corners; `None` if nothing could be solved. Projectors without a solution keep theirs.
    pub wall: Option<Wall>,
    /// The findings: a line for each projector, and for each photograph that does not count although it shows a pattern.
    pub found: Vec<String>,
    /// Everything that speaks against using the corners, each with the cure.
    pub faults: Vec<String>,
    /// The findings of each projector as numbers; none where only light was measured.
    pub projectors: Vec<Finding>,
}

/// Half of a projector's points are nearer than this to where they should be, in its pixels, or it does not fit.
pub(super) const LARGEST_MEDIAN_PX: f64 = 0.3;
/// Nineteen of twenty are nearer than this.
pub(super) const LARGEST_P95_PX: f64 = 1.0;
/// The part of a projector's crossings that must be seen.
pub(super) const LEAST_COVERED: f64 = 0.6;
/// More photographs than this part of all are too many to be left out as misfits.
const MOST_MISFITS: f64 = 0.2;
/// A rectangle that reaches farther beyond its projector's pixels than this part of their height is not where the file has it,
/// or where marks have it.
const MOST_BEYOND: f64 = 0.25;
const MOST_BEYOND_MARKS: f64 = 0.1;
/// The fault if no projector is seen: one for each would bury the photographs' own.
pub(super) const NOTHING_SEEN: &str = "no photograph shows enough of the patterns: are the projectors on, are the patterns of this \
                                       wall file, and are the photographs sharp and not burnt out?";
/// White is burnt out if more than this part of a photograph's lit pixels is; a lamp in the picture covers less.
const MOST_BURNT_OUT: f64 = 0.1;
const OVER_EXPOSED: &str = "is over-exposed: expose shorter";
/// A photograph whose points lie this many times as far off as those of the others was not taken as they were.
const FARTHEST_VIEW: f64 = 5.0;

impl Reading {
    /// Reads a photograph without colours.
    pub fn new(name: String, photograph: &Photograph, codebook: &Codebook<'_>) -> Self {
        let grey_at = |x: usize, y: usize| [photograph.values[y * photograph.size[0] + x]; 3];
        Self::with_colours(name, photograph, &grey_at, codebook)
    }

    /// Reads a photograph, of which `colour_at` tells red, green and blue of each pixel.
    pub fn with_colours(
        name: String,
        photograph: &Photograph,
        colour_at: ColourAt<'_>,
        codebook: &Codebook<'_>,
    ) -> Self {
        let crossings = crossing::find(photograph);
        let lattices = lattice::find(photograph, &crossings);
        let mut sightings: Vec<_> = lattices.iter().flat_map(|lattice| codebook.identify(lattice)).collect();
        let n_brighter = |least: f32| photograph.values.par_iter().filter(|value| **value > least).count();
        let n_lit = n_brighter(0.15);
        let is_over_exposed = n_brighter(0.98) as f64 > MOST_BURNT_OUT * n_lit as f64;
        let fault = sightings.is_empty().then(|| {
            let n_squares = lattices.iter().map(|lattice| lattice.squares.len()).sum::<usize>();
            if n_lit < photograph.values.len() / 200 {
                "is too dark: expose longer"
            } else if is_over_exposed {
                OVER_EXPOSED
            } else if n_squares >= 200 {
                "shows patterns, but not those of this wall file"
            } else {
                "shows no pattern: is it sharp, does it show the wall, and was the pattern on it?"
            }
            .to_owned()
        });
        let plan = codebook.plan();
        let mut light = LightShot { size: photograph.size, ..LightShot::default() };
        sightings.iter().filter(|it| it.pattern >= plan.n_patterns()).for_each(|sighting| {
            samples(plan, sighting, &mut light, colour_at);
        });
        // Squares of many inks shift the crossings between them, so patterns of light tell no places.
        sightings.retain(|sighting| sighting.pattern < plan.n_patterns());
        Self { name, shot: Shot { size: photograph.size, sightings }, light, fault, is_over_exposed }
    }

    /// The patterns in the photograph, from 0, each once.
    pub fn patterns(&self) -> Vec<u32> {
        once(self.parts().map(|(_, pattern)| pattern).collect())
    }

    /// The projectors in the photograph, each once.
    pub fn projectors(&self) -> Vec<usize> {
        once(self.parts().map(|(projector_idx, _)| projector_idx).collect())
    }

    /// Projectors with the patterns that they show.
    fn parts(&self) -> impl Iterator<Item = (usize, u32)> {
        let places = self.shot.sightings.iter().map(|it| (it.projector_idx, it.pattern));
        places.chain(self.light.samples.iter().map(|it| (it.projector_idx, it.pattern)))
    }

    /// A line on what it shows.
    pub fn line(&self, wall: &Wall) -> String {
        let Self { name, fault, is_over_exposed, .. } = self;
        if let Some(fault) = fault {
            return format!("{name} {fault}");
        }
        let n_all = wall.projectors().len();
        let shown = self.projectors();
        let missing: Vec<&str> = (0..n_all)
            .filter(|index| !shown.contains(index))
            .map(|index| wall.projectors()[index].name.as_str())
            .collect();
        let patterns =
            self.patterns().iter().map(|pattern| (pattern + 1).to_string()).collect::<Vec<_>>().join(" and ");
        let without = match missing.len() {
            0 => String::new(),
            1..=4 => format!(", not \"{}\"", missing.join("\", \"")),
            _ => String::new(),
        };
        // Burnt out white eats the corners of black squares, first where the light is brightest.
        let remark =
            if *is_over_exposed && !missing.is_empty() { format!("; it {OVER_EXPOSED}") } else { String::new() };
        format!("{name} shows pattern {patterns} on {} of {n_all} projectors{without}{remark}", n_all - missing.len())
    }
}

/// The values, sorted, each once.
fn once<T: Ord>(mut values: Vec<T>) -> Vec<T> {
    values.sort_unstable();
    values.dedup();
    values
}

/// Solves a wall from all photographs of it. Without a placement, [`Placement::of_wall`] chooses it.
pub fn judge(wall: &Wall, plan: &Plan, readings: &[Reading], placement: Option<&Placement>) -> Verdict {
    let mut faults = Vec::new();
    let n_projectors = wall.projectors().len();
    let (mut shots, mut found) = without_reflections(wall, readings);
    if let Some(surface) = wall.surface() {
        let names: Vec<&str> = readings.iter().map(|reading| reading.name.as_str()).collect();
        let verdict = bent_verdict::judge(wall, surface, plan, (&names, shots), placement);
        found.extend(verdict.found);
        return Verdict { found, ..verdict };
    }
    let all_shots = shots.clone();
    let solution = solved_without_misfits(readings, &mut shots, &mut found, &|shots| solve(n_projectors, shots));
    faults.extend(misfits_fault(&all_shots, &shots, true));
    let placement = placement.cloned().unwrap_or_else(|| Placement::of_wall(wall));
    let plane_from_canvas = placement.plane_from_canvas(wall, &shots, &solution);
    if plane_from_canvas.is_none() && solution.px_from_plane.iter().any(Option::is_some) {
        faults.push(
            "the canvas cannot be laid onto the wall: marks or corners make no rectangle, or too few projectors were \
             found: try --place keep"
                .to_owned(),
        );
    }
    let mut warps = Vec::new();
    let mut projectors = Vec::new();
    for (index, projector) in wall.projectors().iter().enumerate() {
        let name = &projector.name;
        let n_faults = faults.len();
        let Some(map) = solution.px_from_plane[index] else {
            faults.push(missing_fault(name, index, &shots));
            projectors.push(Finding { has_fault: true, ..Finding::default() });
            continue;
        };
        let warp = plane_from_canvas.and_then(|plane_from_canvas| warp_px(projector, map, plane_from_canvas));
        let mut finding = finding(wall, plan, &solution, index);
        finding.moved_px = warp.map(|warp| farthest_move(projector, warp));
        let corners = finding.moved_px.map_or(String::new(), |moved| format!("; its corners move by up to {moved:.1}"));
        found.push(format!("{}{corners}", line(name, &finding)));
        faults.extend(doubts(name, &finding, None, true));
        match warp {
            Some(warp) => warps.push((index, warp)),
            None if plane_from_canvas.is_some() => {
                faults.push(format!("\"{name}\" cannot show its part of the canvas from where it stands"));
            }
            None => {}
        }
        projectors.push(Finding { has_fault: faults.len() > n_faults, ..finding });
    }
    if projectors.iter().all(|finding| finding.fit.is_none()) {
        faults = vec![NOTHING_SEEN.to_owned()];
    }
    found.extend(off_remark(wall, &projectors, noise_px(&shots)));
    let new_wall = with_warps(wall, &warps, &mut found, &mut faults);
    faults.extend(new_wall.as_ref().and_then(|wall| beyond_fault(wall, &placement)));
    Verdict { wall: new_wall, found, faults, projectors }
}

/// A fault if a rectangle reaches much farther than its projector lights: marks in another order turn the picture, and a layout
/// that is not the wall's asks projectors for each other's parts.
fn beyond_fault(wall: &Wall, placement: &Placement) -> Option<String> {
    let part_of = |projector: &Projector| beyond_px(projector) / projector.output.size().min_element();
    let parts = wall.projectors().iter().map(|projector| (part_of(projector), &projector.name));
    let (part, name) = parts.max_by(|a, b| a.0.total_cmp(&b.0))?;
    let (most, cure) = match placement {
        Placement::Marks { .. } => (
            MOST_BEYOND_MARKS,
            "give --marks in the order upper left, upper right, lower right, lower left, at pixels of that photograph",
        ),
        _ => (MOST_BEYOND, "do columns, rows, overlap and at_m in the file agree with where projectors stand?"),
    };
    (part > most).then(|| {
        format!(
            "the canvas asks \"{name}\" for pixels beyond those that it lights, by {:.0} % of its height: {cure}",
            100.0 * part
        )
    })
}

/// The shots of all photographs without what they show the wrong way round, and a line for each that shows some.
pub(super) fn without_reflections(wall: &Wall, readings: &[Reading]) -> (Vec<Shot>, Vec<String>) {
    let mut found = Vec::new();
    let mut shots: Vec<Shot> = readings.iter().map(|reading| reading.shot.clone()).collect();
    for (shot, reading) in shots.iter_mut().zip(readings) {
        let n_before = shot.sightings.len();
        drop_reflections(shot, wall);
        if shot.sightings.len() < n_before {
            found.push(format!("{} also shows reflections of the patterns, which do not count", reading.name));
        }
    }
    (shots, found)
}

/// Solves, and leaves out shots that do not fit the others, one after the other.
pub(super) fn solved_without_misfits(
    readings: &[Reading],
    shots: &mut [Shot],
    found: &mut Vec<String>,
    solve: &dyn Fn(&[Shot]) -> Solution,
) -> Solution {
    let mut solution = solve(shots);
    while let Some(worst) = misfit(&solution.shot_medians_px) {
        found.push(misfit_line(&readings[worst].name, solution.shot_medians_px[worst]));
        shots[worst].sightings.clear();
        solution = solve(shots);
    }
    for (index, reading) in readings.iter().enumerate() {
        if !shots[index].sightings.is_empty() && solution.plane_from_shot[index].is_none() {
            found.push(format!(
                "{} shows no projector together with others that join it to the wall, and does not count",
                reading.name
            ));
        }
    }
    solution
}

/// The finding on a projector by a solution.
pub(super) fn finding(wall: &Wall, plan: &Plan, solution: &Solution, index: usize) -> Finding {
    let fit = solution.fits[index];
    Finding {
        fit: Some(fit),
        covered: fit.n_crossings as f64 / plan.boards[index].n_crossings().max(1) as f64,
        moved_px: None,
        misses: typical(&solution.misses[index], wall.projectors()[index].output.size()),
        has_fault: false,
    }
}

/// How far the corners of a projector move, at most, in pixels.
pub(super) fn farthest_move(projector: &Projector, warp_px: [[f64; 2]; 4]) -> f64 {
    let away = |(new, old): ([f64; 2], [f64; 2])| (new[0] - old[0]).hypot(new[1] - old[1]);
    warp_px.into_iter().zip(projector.warp_px).map(away).fold(0.0, f64::max)
}

/// A line on a projector that was found.
pub(super) fn line(name: &str, Finding { fit, covered, .. }: &Finding) -> String {
    let Fit { n_points, n_shots, median_px, p95_px, .. } = fit.unwrap_or_default();
    format!(
        "\"{name}\": {} in {}, {:.0} % of its picture; half within {median_px:.2} pixels, 95 % within {p95_px:.2}",
        counted(n_points, "point"),
        counted(n_shots, "photograph"),
        100.0 * covered
    )
}

/// What speaks against a projector that was found, with the cures; the pattern that shows all of it, if no other is needed.
pub(super) fn doubts(
    name: &str,
    Finding { fit, covered, .. }: &Finding,
    whole_in: Option<u32>,
    is_flat: bool,
) -> Vec<String> {
    let Fit { median_px, p95_px, .. } = fit.unwrap_or_default();
    let mut faults = Vec::new();
    if *covered < LEAST_COVERED {
        let pattern = whole_in.map_or("every pattern".to_owned(), |pattern| format!("pattern {}", pattern + 1));
        faults.push(format!(
            "only {:.0} % of \"{name}\" was seen, and {:.0} % is needed: take a photograph of {pattern} that shows all of \
             it, and clear the way to the camera",
            100.0 * covered,
            100.0 * LEAST_COVERED
        ));
    }
    if !(median_px <= LARGEST_MEDIAN_PX && p95_px <= LARGEST_P95_PX) {
        let cures = match is_flat {
            true => "did it move between photographs, is the wall flat there, is its own keystone correction off",
            false => "has the wall the shape that [surface] says, did it move between photographs",
        };
        faults.push(format!(
            "\"{name}\" does not fit: half of its points lie within {median_px:.2} pixels and 95 % within {p95_px:.2}, \
             where {LARGEST_MEDIAN_PX} and {LARGEST_P95_PX} are allowed: {cures}, and does the camera come near enough?"
        ));
    }
    faults
}

/// The wall with new corners, if there are any and they make a wall.
fn with_warps(
    wall: &Wall,
    warps: &[(usize, [[f64; 2]; 4])],
    found: &mut Vec<String>,
    faults: &mut Vec<String>,
) -> Option<Wall> {
    let mut projectors = wall.projectors().to_vec();
    warps.iter().for_each(|(index, warp_px)| projectors[*index].warp_px = *warp_px);
    let new_wall = with_new(wall, projectors, found, faults);
    new_wall.filter(|_| !warps.is_empty())
}

/// The wall with new projectors, if they make a wall.
pub(super) fn with_new(
    wall: &Wall,
    projectors: Vec<Projector>,
    found: &mut Vec<String>,
    faults: &mut Vec<String>,
) -> Option<Wall> {
    let new_wall = wall.with_projectors(projectors).map_err(|error| {
        faults.push(format!("{error}: does the file's layout agree with the wall?"));
    });
    found.extend(new_wall.iter().flat_map(short_projectors));
    new_wall.ok()
}

/// A line on a photograph that is left out.
pub(super) fn misfit_line(name: &str, median_px: f64) -> String {
    format!(
        "{name} does not fit the others, by {median_px:.1} pixels, and does not count: the camera moved while it was taken, \
         or it has another lens or another wall"
    )
}

/// A fault if so many shots were left out that those may be right which were not.
pub(super) fn misfits_fault(all: &[Shot], left: &[Shot], is_flat: bool) -> Option<String> {
    let n_used = |shots: &[Shot]| shots.iter().filter(|shot| !shot.sightings.is_empty()).count();
    let (n_all, n_out) = (n_used(all), n_used(all) - n_used(left));
    let shape = if is_flat { "is the wall flat" } else { "has the wall the shape that [surface] says" };
    (n_out >= 2 && n_out as f64 > MOST_MISFITS * n_all as f64).then(|| {
        format!(
            "{n_out} of {n_all} photographs do not fit the others, too many to leave out: {shape}, and are all of this wall, \
             with one lens at one zoom? Take away those that are not"
        )
    })
}

/// The cause that a projector was not solved, with the cure.
pub(super) fn missing_fault(name: &str, index: usize, shots: &[Shot]) -> String {
    let is_seen = shots.iter().flat_map(|shot| &shot.sightings).any(|sighting| sighting.projector_idx == index);
    if is_seen {
        format!(
            "\"{name}\" is seen, but in no photograph together with projectors that join it to the others: take one \
             that shows it with its neighbours"
        )
    } else {
        format!(
            "\"{name}\" is in no photograph: is it on, does its output show the pattern, is it sharp, and is it in the \
             picture?"
        )
    }
}

/// How far the corners of a projector's rectangle lie beyond its pixels, at most.
fn beyond_px(projector: &Projector) -> f64 {
    let upright_px = DVec2::from(projector.upright_size().map(f64::from));
    let beyond = |(corner, warp_px): (DVec2, [f64; 2])| {
        let at = corner * upright_px + DVec2::from(warp_px);
        (-at).max(at - upright_px).max_element()
    };
    std::iter::zip(UNIT_SQUARE, projector.warp_px).map(beyond).fold(0.0, f64::max)
}

/// Projectors of which a part of the rectangle lies beyond their pixels.
fn short_projectors(wall: &Wall) -> Vec<String> {
    let short = |projector: &Projector| {
        let most = beyond_px(projector);
        (most > 0.5).then(|| {
            format!(
                "\"{}\" does not reach a part of its rectangle, by up to {most:.0} pixels: move the projector, let the \
                 file's overlap be smaller, or try --place largest, unless that was the place",
                projector.name
            )
        })
    };
    wall.projectors().iter().filter_map(short).collect()
}

/// Drops what a photograph shows the wrong way round: a mirror or a shining floor.
fn drop_reflections(shot: &mut Shot, wall: &Wall) {
    let is_flipped = |projector_idx: usize| wall.projectors()[projector_idx].flip != Flip::None;
    let n_points = |is_mirrored: bool| -> usize {
        let such = shot.sightings.iter().filter(|it| (it.is_mirrored != is_flipped(it.projector_idx)) == is_mirrored);
        such.map(|sighting| sighting.points.len()).sum()
    };
    let is_mirrored = n_points(true) > n_points(false);
    shot.sightings.retain(|it| (it.is_mirrored != is_flipped(it.projector_idx)) == is_mirrored);
}

/// The shot that fits worst, if it fits much worse than the others, by the distances of half of each one's points.
pub(super) fn misfit(shot_medians_px: &[f64]) -> Option<usize> {
    let used: Vec<usize> = (0..shot_medians_px.len()).filter(|&shot| shot_medians_px[shot].is_finite()).collect();
    let usual = median(used.iter().map(|&shot| shot_medians_px[shot]).collect());
    let worst = used.iter().copied().max_by(|&a, &b| shot_medians_px[a].total_cmp(&shot_medians_px[b]))?;
    let is_alone = used.len() < 3;
    (!is_alone && shot_medians_px[worst] > (FARTHEST_VIEW * usual).max(LARGEST_MEDIAN_PX)).then_some(worst)
}
