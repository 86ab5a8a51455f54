//! Aligns a wall that is not flat again after a bump: its file has a mesh for each projector, and few have moved since.
//!
//! Meshes and the wall's shape say where pixels lie in space, so projectors that have not moved locate the camera, as in
//! `again`; one that has moved is a matrix again, and gets a new mesh where the canvas lies as before.

use super::{
    again::{Outcome, judged, limit, moved_without_strangers, strangers_fault},
    bent::BentSolution,
    bent_verdict::{finding, layouts, solved, without_other_sizes},
    finding::Finding,
    noise::noise_px,
    pattern::Plan,
    solve::{Fit, Shot},
    unroll::Unrolled,
    verdict::{Reading, Verdict, misfit, misfit_line, without_reflections},
};
use crate::wall::{Surface, Wall};

/// Points of a sighting by which projectors that have moved are found.
const FEW: usize = 150;

/// Finds the projectors that have moved since the wall's file was written, and their new meshes.
pub(super) fn judge(wall: &Wall, surface: Surface, plan: &Plan, readings: &[Reading]) -> Verdict {
    let n_projectors = wall.projectors().len();
    let (mut shots, mut found) = without_reflections(wall, readings);
    let names: Vec<&str> = readings.iter().map(|reading| reading.name.as_str()).collect();
    found.extend(without_other_sizes(&names, &mut shots));
    let solve = |has_moved: &[bool], shots: &[Shot]| {
        let is_held: Vec<bool> = has_moved.iter().map(|has_moved| !has_moved).collect();
        solved(wall, surface, shots, &is_held)
    };
    let in_file = layouts(wall, &vec![true; n_projectors]);
    let fits = |solution: Option<&BentSolution>| -> Vec<Fit> {
        (0..n_projectors).map(|index| solution.map_or(Fit::default(), |it| it.fit(index))).collect()
    };
    // A part of the points tells which have moved.
    let few: Vec<Shot> = shots.iter().map(|shot| shot.thinned(FEW)).collect();
    let limit = limit(noise_px(&shots));
    let tried = |has_moved: &[bool], shots: &[Shot]| {
        let solution = solve(has_moved, shots);
        let away =
            |index: usize| solution.as_ref().map_or([f64::INFINITY; 2], |it| it.distances(index, &in_file[index]));
        let both = fits(solution.as_ref()).into_iter().enumerate();
        both.map(|(index, fit)| (fit, away(index))).collect::<Vec<_>>()
    };
    let (has_moved, strangers) = moved_without_strangers(n_projectors, limit, true, &few, &tried);
    let faults = strangers_fault(readings, &mut shots, &strangers).into_iter().collect();
    let mut solution = solve(&has_moved, &shots);
    // Photographs that do not fit are told from projectors that have moved only now.
    while let Some(worst) = solution.as_ref().and_then(|it| misfit(&it.shot_medians_px)) {
        let by_px = solution.as_ref().map_or(f64::INFINITY, |it| it.shot_medians_px[worst]);
        found.push(misfit_line(names[worst], by_px));
        shots[worst].sightings.clear();
        solution = solve(&has_moved, &shots);
    }
    let outcome = |index: usize| {
        let Some(solution) = &solution else { return Outcome { finding: Finding::default(), mended: None } };
        let mended = Unrolled::as_solved().projector(wall, surface, solution, index);
        let by_px = solution.distances(index, &in_file[index])[1];
        Outcome {
            finding: finding(solution, plan, index),
            mended: mended.map(|mended| (mended, by_px, "its pixels move by up to")),
        }
    };
    judged(wall, plan, &shots, &has_moved, (found, faults), &outcome)
}
