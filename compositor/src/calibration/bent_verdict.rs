//! From photographs to meshes, on a wall that is not flat: what was found, what was not, and the cure.

use super::{
    bent::{self, BentSolution, Layout},
    finding::{Finding, off_remark, typical},
    noise::noise_px,
    pattern::Plan,
    place::Placement,
    shape,
    solve::Shot,
    unroll::{Unrolled, place_in_file},
    verdict::{NOTHING_SEEN, Verdict, doubts, line, misfit, misfit_line, misfits_fault, missing_fault},
};
use crate::wall::{Projector, Surface, Wall};

/// So much of the canvas must be lit, or a line says that it is not.
const LEAST_LIT: f64 = 0.995;

/// Solves a wall of this shape from shots with these names. Without a placement, the canvas stays where meshes have it, or
/// becomes as large as all projectors light.
pub(super) fn judge(
    wall: &Wall,
    surface: Surface,
    plan: &Plan,
    (names, mut shots): (&[&str], Vec<Shot>),
    placement: Option<&Placement>,
) -> Verdict {
    let mut faults = Vec::new();
    let all_shots = shots.clone();
    let mut found = without_other_sizes(names, &mut shots);
    let nothing = |found, faults| Verdict { wall: None, found, faults, projectors: Vec::new() };
    let has_meshes = wall.projectors().iter().any(|projector| projector.mesh.is_some());
    let is_kept = match placement {
        None => has_meshes,
        Some(Placement::Keep) => true,
        Some(Placement::Largest) => false,
        Some(Placement::Corners | Placement::Marks { .. }) => {
            faults.push(
                "the canvas of a wall that is not flat has no corners to go by: use --place keep or largest".into(),
            );
            return nothing(found, faults);
        }
    };
    let free = vec![false; wall.projectors().len()];
    let Some(mut solution) = solved(wall, surface, &shots, &free) else {
        faults.push(NOTHING_SEEN.to_owned());
        return nothing(found, faults);
    };
    while let Some(worst) = misfit(&solution.shot_medians_px) {
        found.push(misfit_line(names[worst], solution.shot_medians_px[worst]));
        shots[worst].sightings.clear();
        let Some(next) = solved(wall, surface, &shots, &free) else { break };
        solution = next;
    }
    let shape = shape::evidence(wall, surface, &solution, &all_shots);
    found.extend(shape.remarks);
    faults.extend(misfits_fault(&all_shots, &shots, false));
    let is_doubted = !shape.faults.is_empty();
    faults.extend(shape.faults);
    let kept = Unrolled::kept(wall, surface, &solution);
    let unrolled = if is_kept { kept } else { kept.largest(wall, surface, &solution) };
    let mut projectors = wall.projectors().to_vec();
    let mut findings = Vec::new();
    for (index, projector) in projectors.iter_mut().enumerate() {
        if !solution.is_solved(index) {
            faults.push(missing_fault(&projector.name, index, &shots));
            findings.push(Finding { has_fault: true, ..Finding::default() });
            continue;
        }
        let n_faults = faults.len();
        let finding = finding(&solution, plan, index);
        found.push(line(&projector.name, &finding));
        faults.extend(doubts(&projector.name, &finding, None, false));
        match unrolled.projector(wall, surface, &solution, index) {
            Some(new) => *projector = new,
            None => faults.push(format!(
                "the pixels of \"{}\" make no mesh: does it light the wall that [surface] describes?",
                projector.name
            )),
        }
        findings.push(Finding { has_fault: faults.len() > n_faults, ..finding });
    }
    found.extend(off_remark(wall, &findings, noise_px(&shots)));
    let lit = unrolled.lit(wall, &solution);
    let dark = shape::dark_fault(wall, surface, lit).filter(|_| !is_doubted);
    if lit < LEAST_LIT && dark.is_none() {
        found.push(format!(
            "{:.0} % of the canvas is lit: --place largest may make the picture fit; otherwise move projectors, or change \
             canvas_m",
            100.0 * lit
        ));
    }
    faults.extend(dark);
    let is_changed = projectors != wall.projectors();
    let new_wall = wall.with_projectors(projectors).map_err(|error| {
        faults.push(format!("{error}: does the file's layout agree with the wall?"));
    });
    Verdict { wall: new_wall.ok().filter(|_| is_changed), found, faults, projectors: findings }
}

/// Leaves out shots of another size than most, and has a line on each: all share a lens here.
pub(super) fn without_other_sizes(names: &[&str], shots: &mut [Shot]) -> Vec<String> {
    let n_points = |size: [usize; 2]| -> usize {
        let sightings = shots.iter().filter(|shot| shot.size == size).flat_map(|shot| &shot.sightings);
        sightings.map(|sighting| sighting.points.len()).sum()
    };
    let Some([columns, rows]) = shots.iter().map(|shot| shot.size).max_by_key(|size| n_points(*size)) else {
        return Vec::new();
    };
    let mut lines = Vec::new();
    for (shot, name) in shots.iter_mut().zip(names) {
        let [own_columns, own_rows] = shot.size;
        if shot.size != [columns, rows] && !shot.sightings.is_empty() {
            shot.sightings.clear();
            lines.push(format!(
                "{name} has {own_columns}×{own_rows} pixels where others have {columns}×{rows}, and does not count: on a wall \
                 that is not flat, all photographs must be of one camera at one zoom, none turned, cropped or scaled"
            ));
        }
    }
    lines
}

/// Solves a wall of which these projectors are held where the file has them.
pub(super) fn solved(wall: &Wall, surface: Surface, shots: &[Shot], is_held: &[bool]) -> Option<BentSolution> {
    bent::solve(surface, &layouts(wall, is_held), shots)
}

/// Where the file has projectors.
pub(super) fn layouts<'a>(wall: &'a Wall, is_held: &[bool]) -> Vec<Layout<'a>> {
    let layout = |(projector, is_held): (&'a Projector, &bool)| {
        let place_at = Box::new(move |px| place_in_file(wall, projector, px));
        Layout { size: projector.output.size(), place_at, is_held: *is_held }
    };
    wall.projectors().iter().zip(is_held).map(layout).collect()
}

/// The finding on a projector by a solution.
pub(super) fn finding(solution: &BentSolution, plan: &Plan, index: usize) -> Finding {
    let fit = solution.fit(index);
    let covered = fit.n_crossings as f64 / plan.boards[index].n_crossings().max(1) as f64;
    let misses = typical(&solution.misses(index), solution.size(index));
    Finding { fit: Some(fit), covered, misses, ..Finding::default() }
}
