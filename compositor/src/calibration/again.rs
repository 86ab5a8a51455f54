//! Aligns a wall again after a bump: its file has the solution, and few projectors have moved since.
//!
//! The corners in the file say where every projector's pixels were on the canvas. Those that have not moved show the camera
//! where it stands and how its lens bends, so one photograph tells the others' new places; nothing else is kept from the
//! first run, and any camera will do. On a wall that is not flat, meshes say that, and the wall's shape (`bent_again`). Which
//! projectors have moved is not assumed: all are, at first, where the file has
//! them, and the one that fits worst is let go until the rest agree; then those are held again that do agree with these, as
//! the first to go may have been pulled by others (least trimmed squares in spirit: Rousseeuw 1984). Fewer than half of the
//! projectors may have moved, since they would outvote the others.

use std::collections::HashSet;

use glam::{DMat3, DVec2, DVec3};

use super::{
    bent_again,
    finding::{Finding, off_throughout},
    fitting::{quantile, with_unit_depth},
    lens::Lens,
    noise::noise_px,
    pattern::Plan,
    place::warp_px,
    solve::{Fit, Shot, Solution, solve_from},
    verdict::{
        LARGEST_MEDIAN_PX, LARGEST_P95_PX, Reading, Verdict, doubts, farthest_move, finding, line, missing_fault,
        solved_without_misfits, with_new, without_reflections,
    },
};
use crate::wall::{Projector, Wall, homography::apply};

/// Projectors that are nearer than this to where the file has them, in their pixels, have not moved, and those within three
/// times the noise of crossings. Beyond [`LARGEST_MEDIAN_PX`], all have.
const LEAST_MOVE_PX: f64 = 0.1;
/// See [`LEAST_MOVE_PX`].
const USUAL_MOVE: f64 = 3.0;
/// The part of the crossings of a projector that must be seen to tell that it has not moved.
const LEAST_SEEN: f64 = 0.15;
/// Fewer projectors outvote none.
const LEAST_PROJECTORS: usize = 3;

/// Whether a wall can be aligned again; the text names the cure.
///
/// # Errors
/// It was not aligned before, does not say its shape, or has too few projectors.
pub fn check_again(wall: &Wall) -> Result<(), String> {
    let has_mesh = |projector: &Projector| projector.mesh.is_some();
    if wall.surface().is_some() {
        if !wall.projectors().iter().all(has_mesh) {
            return Err(
                "not all projectors in the file have meshes, and --again needs those of the first time: leave it out"
                    .to_owned(),
            );
        }
    } else if wall.projectors().iter().any(has_mesh) {
        return Err("the file has meshes and does not say the wall's shape: add [surface]".to_owned());
    } else if !wall.projectors().iter().any(Projector::is_warped) {
        return Err("the file has no corners yet, and --again needs those of the first time: leave it out".to_owned());
    }
    if wall.projectors().len() < LEAST_PROJECTORS {
        return Err(format!(
            "of fewer than {LEAST_PROJECTORS} projectors nothing tells which one has moved: leave --again out"
        ));
    }
    Ok(())
}

/// Finds the projectors that have moved since the wall's file was written, and their new corners or meshes. All others keep
/// theirs.
pub fn judge_again(wall: &Wall, plan: &Plan, readings: &[Reading]) -> Verdict {
    if let Some(surface) = wall.surface() {
        return bent_again::judge(wall, surface, plan, readings);
    }
    let n_projectors = wall.projectors().len();
    let (mut shots, mut found) = without_reflections(wall, readings);
    let all: Option<Vec<DMat3>> = wall.projectors().iter().map(px_from_plane).collect();
    let Some(all) = all else {
        let faults = vec!["corners in the file make no picture: leave --again out".to_owned()];
        return Verdict { wall: None, found, faults, projectors: Vec::new() };
    };
    let solve = |has_moved: &[bool], shots: &[Shot]| {
        let known: Vec<Option<DMat3>> =
            all.iter().zip(has_moved).map(|(map, has_moved)| (!has_moved).then_some(*map)).collect();
        solve_from(&known, shots)
    };
    let limit = limit(noise_px(&shots));
    let tried = |has_moved: &[bool], shots: &[Shot]| {
        let solution = solve(has_moved, shots);
        let of = |index: usize| match has_moved[index] {
            true => (solution.fits[index], distances(index, all[index], shots, &solution)),
            false => (solution.fits[index], [solution.fits[index].median_px, solution.fits[index].p95_px]),
        };
        (0..n_projectors).map(of).collect::<Vec<_>>()
    };
    let (has_moved, strangers) = moved_without_strangers(n_projectors, limit, false, &shots, &tried);
    let faults = strangers_fault(readings, &mut shots, &strangers).into_iter().collect();
    // Photographs that do not fit are told from projectors that have moved only now.
    let solution = solved_without_misfits(readings, &mut shots, &mut found, &|shots| solve(&has_moved, shots));
    let outcome = |index: usize| {
        let projector = &wall.projectors()[index];
        let new = solution.px_from_plane[index].and_then(|map| warp_px(projector, map, plane_from_canvas()));
        let mended = new.map(|warp_px| {
            (Projector { warp_px, ..projector.clone() }, farthest_move(projector, warp_px), "its corners move by up to")
        });
        Outcome { finding: finding(wall, plan, &solution, index), mended }
    };
    judged(wall, plan, &shots, &has_moved, (found, faults), &outcome)
}

/// A projector as a solution shows it.
pub(super) struct Outcome {
    pub finding: Finding,
    /// The projector where it stands now, and how far it moved, with words for that; `None` if it cannot show its part.
    pub mended: Option<(Projector, f64, &'static str)>,
}

/// How well a projector fits, and how far half and nineteen of twenty of its points lie from where the file has them.
pub(super) type Tried = (Fit, [f64; 2]);

/// All projectors as these shots show them, while some count as moved.
pub(super) type TriedBy<'a> = &'a dyn Fn(&[bool], &[Shot]) -> Vec<Tried>;

/// Which projectors have moved, if `tried` tells all of them by some shots while some count as moved; and the shots that do
/// not belong.
///
/// Where too many seem to have moved, each shot is judged by itself: those in which most projectors lie where the file has
/// them tell which have moved, and all others in which the rest lie elsewhere are strangers.
pub(super) fn moved_without_strangers(
    n_projectors: usize,
    limit: f64,
    tries_each: bool,
    shots: &[Shot],
    tried: TriedBy<'_>,
) -> (Vec<bool>, Vec<usize>) {
    let moved_in = |shots: &[Shot]| moved(n_projectors, limit, tries_each, &|has_moved| tried(has_moved, shots));
    let shows_wall = |has_moved: &[bool], shots: &[Shot]| {
        let seen: HashSet<usize> = shots.iter().flat_map(|it| &it.sightings).map(|it| it.projector_idx).collect();
        let n_moved = has_moved.iter().filter(|has_moved| **has_moved).count();
        seen.len() >= LEAST_PROJECTORS && 2 * n_moved < seen.len()
    };
    let has_moved = moved_in(shots);
    if shows_wall(&has_moved, shots) {
        return (has_moved, Vec::new());
    }
    let belongs: Vec<bool> = shots.chunks(1).map(|shot| shows_wall(&moved_in(shot), shot)).collect();
    let of = |belongs: &[bool]| -> Vec<Shot> {
        std::iter::zip(shots, belongs).filter(|(_, belongs)| **belongs).map(|(shot, _)| shot.clone()).collect()
    };
    if !belongs.contains(&true) {
        return (has_moved, Vec::new());
    }
    let has_moved = moved_in(&of(&belongs));
    let is_strange = |shot: &[Shot]| {
        let away = tried(&has_moved, shot);
        let is_off =
            |((fit, away), has_moved): (&Tried, &bool)| !has_moved && fit.n_points > 0 && !agrees(*away, limit);
        std::iter::zip(&away, &has_moved).any(is_off)
    };
    let is_kept: Vec<bool> =
        std::iter::zip(shots.chunks(1), belongs).map(|(shot, belongs)| belongs || !is_strange(shot)).collect();
    (moved_in(&of(&is_kept)), (0..shots.len()).filter(|index| !is_kept[*index]).collect())
}

/// Leaves out shots that do not belong, and a fault that names them.
pub(super) fn strangers_fault(readings: &[Reading], shots: &mut [Shot], strangers: &[usize]) -> Option<String> {
    strangers.iter().for_each(|index| shots[*index].sightings.clear());
    let names: Vec<&str> = strangers.iter().map(|index| readings[*index].name.as_str()).collect();
    (!names.is_empty()).then(|| {
        format!(
            "{} of {} photographs, by themselves, do not show the wall as the file has it, while others do: they are of another \
             wall or another time, or were turned, cropped or stretched: take them out of the folder: {}",
            names.len(),
            readings.len(),
            names.join(", ")
        )
    })
}

/// Which projectors have moved, if `tried` tells all of them while some count as moved.
///
/// Those that count as unmoved pull at the camera; where few projectors make a wall, one that has moved may pull so hard that
/// others seem to have moved. If `tries_each`, each is let go in turn, and that counts without which the others agree best.
fn moved(n_projectors: usize, limit: f64, tries_each: bool, tried: &dyn Fn(&[bool]) -> Vec<Tried>) -> Vec<bool> {
    let mut has_moved = vec![false; n_projectors];
    let mut away = tried(&has_moved);
    let by_median = |a: &usize, b: &usize, away: &[Tried]| away[*a].1[0].total_cmp(&away[*b].1[0]);
    let still = |has_moved: &[bool], away: &[Tried]| -> Vec<usize> {
        (0..n_projectors).filter(|index| !has_moved[*index] && away[*index].0.n_points > 0).collect()
    };
    loop {
        let mut far = still(&has_moved, &away);
        far.retain(|index| !agrees(away[*index].1, limit));
        let Some(farthest) = far.iter().copied().max_by(|a, b| by_median(a, b, &away)) else { break };
        if !tries_each || far.len() == 1 {
            has_moved[farthest] = true;
            away = tried(&has_moved);
            continue;
        }
        let without = far.into_iter().map(|index| {
            let mut has_moved = has_moved.clone();
            has_moved[index] = true;
            let away = tried(&has_moved);
            let left = still(&has_moved, &away);
            let n_off = left.iter().filter(|index| !agrees(away[**index].1, limit)).count();
            let sum: f64 = left.iter().map(|index| away[*index].1[0]).sum();
            (n_off, sum, has_moved, away)
        });
        let best = without.min_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let Some((_, _, best, best_away)) = best else { break };
        (has_moved, away) = (best, best_away);
    }
    loop {
        // Each time, the one that agrees best.
        let gone = (0..n_projectors).filter(|index| has_moved[*index] && agrees(away[*index].1, limit));
        let Some(nearest) = gone.min_by(|a, b| by_median(a, b, &away)) else { break };
        has_moved[nearest] = false;
        away = tried(&has_moved);
    }
    has_moved
}

/// The verdict on projectors of which some have moved.
pub(super) fn judged(
    wall: &Wall,
    plan: &Plan,
    shots: &[Shot],
    has_moved: &[bool],
    (mut found, mut faults): (Vec<String>, Vec<String>),
    outcome: &dyn Fn(usize) -> Outcome,
) -> Verdict {
    let mut projectors = Vec::new();
    let mut new_projectors = wall.projectors().to_vec();
    let names = |indices: &[usize]| {
        let names: Vec<&str> = indices.iter().map(|index| wall.projectors()[*index].name.as_str()).collect();
        format!("\"{}\"", names.join("\", \""))
    };
    let outcomes: Vec<Outcome> = (0..has_moved.len()).map(outcome).collect();
    let n_moved = has_moved.iter().filter(|has_moved| **has_moved).count();
    // Of two that are seen, nothing tells which one has moved.
    let n_seen = outcomes.iter().filter(|it| it.finding.fit.is_some_and(|fit| fit.n_points > 0)).count();
    if n_moved > 0 && n_seen == 0 {
        faults.push("no projector is seen as the file has it: photograph this wall, the right way round".to_owned());
    } else if n_moved > 0 && 2 * n_moved >= n_seen {
        faults.push(format!(
            "{n_moved} of {n_seen} projectors that are seen do not lie where the file has them, and fewer than half may have \
             moved: photograph the whole of this wall, and leave photographs as the camera made them, or align it anew, \
             without --again"
        ));
    }
    let all_names: Vec<&str> = wall.projectors().iter().map(|projector| projector.name.as_str()).collect();
    let findings: Vec<&Finding> = outcomes.iter().map(|it| &it.finding).collect();
    faults.extend(other_wall(&all_names, &findings, noise_px(shots), wall.surface().is_none()));
    let mut unseen = Vec::new();
    for ((index, projector), Outcome { finding, mended }) in wall.projectors().iter().enumerate().zip(outcomes) {
        let name = &projector.name;
        let n_points = finding.fit.map_or(0, |fit| fit.n_points);
        if has_moved[index] {
            if n_points == 0 {
                faults.push(missing_fault(name, index, shots));
                projectors.push(Finding { has_fault: true, ..Finding::default() });
                continue;
            }
            let of_projector = doubts(name, &finding, Some(plan.whole_in(index)), wall.surface().is_none());
            let mut finding = Finding { has_fault: !of_projector.is_empty(), ..finding };
            faults.extend(of_projector);
            let mut how_far = String::new();
            match mended {
                Some((mended, by, words)) => {
                    new_projectors[index] = mended;
                    finding.moved_px = Some(by);
                    how_far = format!("; {words} {by:.1}");
                }
                None => faults.push(format!("\"{name}\" cannot show its part of the canvas from where it stands")),
            }
            found.push(format!("{}{how_far}", line(name, &finding)));
            projectors.push(finding);
        } else if n_points == 0 || finding.covered < LEAST_SEEN {
            unseen.push(index);
            let fit = finding.fit.filter(|fit| fit.n_points > 0);
            projectors.push(Finding { fit, has_fault: true, ..finding });
        } else {
            found.push(format!("{}; it has not moved", line(name, &finding)));
            projectors.push(Finding { moved_px: Some(0.0), ..finding });
        }
    }
    if !unseen.is_empty() {
        faults.push(format!("too little is seen of {} to tell a move: photograph the whole wall", names(&unseen)));
    }
    let new_wall = if n_moved == 0 {
        if faults.is_empty() {
            found.push("no projector has moved: all stay as they are".to_owned());
        }
        None
    } else {
        with_new(wall, new_projectors, &mut found, &mut faults)
    };
    Verdict { wall: new_wall, found, faults, projectors }
}

/// The distance beyond which a projector has moved, by the noise of crossings: how well photographs fit projectors that may
/// stand anywhere would tell nothing if they showed a wall of another shape.
pub(super) fn limit(noise_px: f64) -> f64 {
    (USUAL_MOVE * noise_px).clamp(LEAST_MOVE_PX, LARGEST_MEDIAN_PX)
}

/// A fault if projectors, moved or not, are off by more than noise.
fn other_wall(names: &[&str], findings: &[&Finding], noise_px: f64, is_flat: bool) -> Option<String> {
    let (n_far, worst, worst_px) = off_throughout(names, findings, LEAST_MOVE_PX)?;
    let shape = if is_flat { "" } else { " or its shape is not the one that [surface] says," };
    Some(format!(
        "{} off throughout, \"{worst}\" by {worst_px:.2} pixels, where {LEAST_MOVE_PX} is allowed and the noise of \
         crossings is {noise_px:.2}: the photographs show another wall than the file's,{shape} or the lens bends too much: \
         photograph this wall, or align it anew, without --again",
        if n_far == 1 { "1 projector is".to_owned() } else { format!("{n_far} projectors are") }
    ))
}

/// Whether points at these distances, half and nineteen of twenty, lie where they should.
fn agrees([median_px, p95_px]: [f64; 2], limit: f64) -> bool {
    median_px <= limit && p95_px <= LARGEST_P95_PX
}

/// How far a projector's points are from where a map has them, in its pixels: half and nineteen of twenty are nearer.
fn distances(index: usize, px_from_plane: DMat3, shots: &[Shot], solution: &Solution) -> [f64; 2] {
    let mut all = Vec::new();
    for (shot_idx, shot) in shots.iter().enumerate() {
        let Some(plane_from_shot) = solution.plane_from_shot[shot_idx] else { continue };
        for [px, at] in shot.sightings.iter().filter(|it| it.projector_idx == index).flat_map(|it| &it.points) {
            let seen = Lens::normalised(shot.size, *at);
            let plane = apply(plane_from_shot, solution.lenses[shot_idx].undistorted(seen).at);
            let there = plane.and_then(|plane| apply(px_from_plane, plane));
            all.push(there.map_or(f64::INFINITY, |there| there.distance(*px)));
        }
    }
    [quantile(&mut all, 0.5), quantile(&mut all, 0.95)]
}

/// The plane of the solution is the canvas, from its middle.
fn plane_from_canvas() -> DMat3 {
    DMat3::from_translation(DVec2::splat(-0.5))
}

/// From the plane to a projector's pixels, by the corners in the file; `None` if these make no picture.
fn px_from_plane(projector: &Projector) -> Option<DMat3> {
    let rect = projector.canvas;
    let canvas_from_rect = DMat3::from_cols(
        DVec3::new(rect.width, 0.0, 0.0),
        DVec3::new(0.0, -rect.height, 0.0),
        DVec3::new(rect.left, rect.bottom + rect.height, 1.0),
    );
    let px_from_raster = DMat3::from_scale(projector.output.size());
    let map =
        px_from_raster * projector.raster_from_image()? * canvas_from_rect.inverse() * plane_from_canvas().inverse();
    Some(with_unit_depth(map)).filter(DMat3::is_finite)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_says_where_a_projector_s_pixels_were() {
        let text = "canvas_m = [2.0, 1.0]\n[grid]\ncolumns = 3\nrows = 1\npixels = [400, 300]\noverlap = [0.2, 0.0]\n\
                    [[projector]]\nname = \"row 1 column 2\"\nrotation = 180\n\
                    warp_px = [[3.0, 5.0], [-4.0, 2.0], [-7.0, -3.0], [6.0, -1.0]]\n";
        let wall = Wall::from_toml("ours", text).expect("a wall");
        assert_eq!(check_again(&wall), Ok(()));
        for projector in wall.projectors() {
            let map = px_from_plane(projector).expect("convex");
            let found = warp_px(projector, map, plane_from_canvas()).expect("before the horizon");
            assert_eq!(found, projector.warp_px, "{}", projector.name);
            let px = DVec2::new(100.0, 120.0);
            let plane = apply(map.inverse(), px).expect("there");
            assert!((plane + 0.5 - wall.canvas_at(projector.output.origin() + px)).length() < 1e-9);
        }
        let plain = Wall::from_toml("ours", &text[..text.find("[[").expect("a table")]).expect("a wall");
        assert!(check_again(&plain).is_err_and(|fault| fault.contains("no corners yet")));
    }
}
