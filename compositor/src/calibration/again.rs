//! Aligns a wall again after a bump: its file has the solution, and few projectors have moved since.
//!
//! The corners in the file say where every projector's pixels were on the canvas. Those that have not moved show the camera
//! where it stands and how its lens bends, so one photograph tells the others' new places; nothing else is kept from the
//! first run, and any camera will do. Which projectors have moved is not assumed: all are, at first, where the file has
//! them, and the one that fits worst is let go until the rest agree; then those are held again that do agree with these, as
//! the first to go may have been pulled by others (least trimmed squares in spirit: Rousseeuw 1984). Fewer than half of the
//! projectors may have moved, since they would outvote the others.

use glam::{DMat3, DVec2, DVec3};
use shared::printable::counted;

use super::{
    finding::Finding,
    fitting::{median, quantile, with_unit_depth},
    lens::Lens,
    pattern::Plan,
    place::warp_px,
    solve::{Shot, Solution, solve_from},
    verdict::{
        LARGEST_MEDIAN_PX, LARGEST_P95_PX, Reading, Verdict, doubts, farthest_move, finding, line, missing_fault,
        solved_without_misfits, with_warps, without_reflections,
    },
};
use crate::wall::{Projector, Wall, homography::apply};

/// Projectors that are nearer than this to where the file has them, in their pixels, have not moved, and those within three
/// times the distance that photographs leave anyway. Beyond [`LARGEST_MEDIAN_PX`], all have.
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
/// It is not flat, was not aligned before, or has too few projectors.
pub fn check_again(wall: &Wall) -> Result<(), String> {
    let has_mesh = wall.projectors().iter().any(|projector| projector.mesh.is_some());
    if wall.surface().is_some() || has_mesh {
        return Err("--again aligns flat walls: align one of another shape anew, without it".to_owned());
    }
    if !wall.projectors().iter().any(Projector::is_warped) {
        return Err("the file has no corners yet, and --again needs those of the first time: leave it out".to_owned());
    }
    if wall.projectors().len() < LEAST_PROJECTORS {
        return Err(format!(
            "of fewer than {LEAST_PROJECTORS} projectors nothing tells which one has moved: leave --again out"
        ));
    }
    Ok(())
}

/// Finds the projectors that have moved since the wall's file was written, and their new corners. All others keep theirs.
pub fn judge_again(wall: &Wall, plan: &Plan, readings: &[Reading]) -> Verdict {
    let n_projectors = wall.projectors().len();
    let (mut shots, mut found) = without_reflections(wall, readings);
    let all: Option<Vec<DMat3>> = wall.projectors().iter().map(px_from_plane).collect();
    let Some(all) = all else {
        let faults = vec!["corners in the file make no picture: leave --again out".to_owned()];
        return Verdict { wall: None, found, faults, projectors: Vec::new() };
    };
    let mut has_moved = vec![false; n_projectors];
    let solve = |has_moved: &[bool], shots: &[Shot]| {
        let known: Vec<Option<DMat3>> =
            all.iter().zip(has_moved).map(|(map, has_moved)| (!has_moved).then_some(*map)).collect();
        solve_from(&known, shots)
    };
    let limit = limit(n_projectors, &shots);
    let mut solution = solve(&has_moved, &shots);
    while let Some(farthest) = farthest(&solution, &has_moved, limit) {
        has_moved[farthest] = true;
        solution = solve(&has_moved, &shots);
    }
    // Each time, the one that agrees best.
    while let Some(nearest) = nearest(&all, &shots, &solution, &has_moved, limit) {
        has_moved[nearest] = false;
        solution = solve(&has_moved, &shots);
    }
    // Photographs that do not fit are told from projectors that have moved only now.
    let solution = solved_without_misfits(readings, &mut shots, &mut found, &|shots| solve(&has_moved, shots));
    judged(wall, plan, &shots, &solution, &has_moved, found)
}

fn judged(
    wall: &Wall,
    plan: &Plan,
    shots: &[Shot],
    solution: &Solution,
    has_moved: &[bool],
    mut found: Vec<String>,
) -> Verdict {
    let (mut faults, mut warps, mut projectors) = (Vec::new(), Vec::new(), Vec::new());
    let names = |indices: &[usize]| {
        let names: Vec<&str> = indices.iter().map(|index| wall.projectors()[*index].name.as_str()).collect();
        format!("\"{}\"", names.join("\", \""))
    };
    let moved: Vec<usize> = (0..has_moved.len()).filter(|index| has_moved[*index]).collect();
    if 2 * moved.len() >= has_moved.len() {
        faults.push(format!(
            "{} of {} projectors do not lie where the file has them, and fewer than half may have moved: align the wall \
             anew, without --again",
            moved.len(),
            has_moved.len()
        ));
    }
    let mut unseen = Vec::new();
    for (index, projector) in wall.projectors().iter().enumerate() {
        let name = &projector.name;
        let finding = finding(wall, plan, solution, index);
        let n_points = finding.fit.map_or(0, |fit| fit.n_points);
        if has_moved[index] {
            let Some(map) = solution.px_from_plane[index] else {
                faults.push(missing_fault(name, index, shots));
                projectors.push(Finding { has_fault: true, ..Finding::default() });
                continue;
            };
            let of_projector = doubts(name, &finding, Some(plan.whole_in(index)));
            let mut finding = Finding { has_fault: !of_projector.is_empty(), ..finding };
            faults.extend(of_projector);
            match warp_px(projector, map, plane_from_canvas()) {
                Some(warp) => {
                    warps.push((index, warp));
                    finding.moved_px = Some(farthest_move(projector, warp));
                }
                None => faults.push(format!("\"{name}\" cannot show its part of the canvas from where it stands")),
            }
            let moved =
                finding.moved_px.map_or(String::new(), |moved| format!("; its corners move by up to {moved:.1}"));
            found.push(format!("{}{moved}", line(name, &finding)));
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
        faults.push(format!(
            "{} of {} is seen too little to tell whether it moved: photograph the whole wall",
            counted(unseen.len(), "projector"),
            names(&unseen)
        ));
    }
    let new_wall = if moved.is_empty() {
        if faults.is_empty() {
            found.push("no projector has moved: all corners stay".to_owned());
        }
        None
    } else {
        with_warps(wall, &warps, &mut found, &mut faults)
    };
    Verdict { wall: new_wall, found, faults, projectors }
}

/// The distance beyond which a projector has moved, by how well photographs fit projectors that may stand anywhere.
fn limit(n_projectors: usize, shots: &[Shot]) -> f64 {
    let free = solve_from(&vec![None; n_projectors], shots);
    let fits = free.fits.iter().filter(|fit| fit.n_points > 0);
    (USUAL_MOVE * median(fits.map(|fit| fit.median_px).collect())).clamp(LEAST_MOVE_PX, LARGEST_MEDIAN_PX)
}

/// Whether points at these distances, half and nineteen of twenty, lie where they should.
fn agrees([median_px, p95_px]: [f64; 2], limit: f64) -> bool {
    median_px <= limit && p95_px <= LARGEST_P95_PX
}

/// The projector, of those that count as unmoved, that lies farthest from where the file has it, if that is too far.
fn farthest(solution: &Solution, has_moved: &[bool], limit: f64) -> Option<usize> {
    let away = |index: usize| [solution.fits[index].median_px, solution.fits[index].p95_px];
    let still = (0..has_moved.len()).filter(|index| !has_moved[*index] && solution.fits[*index].n_points > 0);
    still.filter(|index| !agrees(away(*index), limit)).max_by(|a, b| away(*a)[0].total_cmp(&away(*b)[0]))
}

/// The projector, of those that count as moved, that lies nearest to where the file has it, if that is near enough.
fn nearest(all: &[DMat3], shots: &[Shot], solution: &Solution, has_moved: &[bool], limit: f64) -> Option<usize> {
    let moved = (0..has_moved.len()).filter(|index| has_moved[*index]);
    let away = moved.map(|index| (index, distances(index, all[index], shots, solution)));
    let near = away.filter(|(_, away)| agrees(*away, limit)).min_by(|(_, a), (_, b)| a[0].total_cmp(&b[0]));
    near.map(|(index, _)| index)
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
