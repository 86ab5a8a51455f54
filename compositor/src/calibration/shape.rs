//! Whether photographs agree with the shape of the wall that its file says, when it is not flat.
//!
//! Photographs tell no size: a cylinder or a dome of twice the radius, with all cameras and projectors twice as far away,
//! looks the same. So a wrong radius leaves no residual, and the layout in the file is the evidence: projectors light about
//! as much of the wall as their rectangles take of it. The angle of a fold they do tell, if taken from several places, by
//! what is left over at each angle.

use glam::{DVec2, DVec3};

use super::{
    bent::BentSolution, bent_verdict::solved, fitting::median, noise::noise_px, solve::Shot, unroll::place_in_file,
};
use crate::wall::{Surface, Wall};

/// Projectors may light this many times as much of the wall, by length, as the file's layout says, or as little.
const LARGEST_SIZE: f64 = 1.12;
/// A fold's edge may lie so far from where the layout has it, as a part of the canvas's width.
const FARTHEST_EDGE: f64 = 1.0 / 12.0;
/// An angle that is nearer than this to the best one, in degrees, is right.
const NEAR_ANGLE: f64 = 1.5;
/// A better angle leaves less than this part of what the file's leaves over.
const BETTER: f64 = 0.8;
/// Photographs tell the angle if one that is off by [`FAR_ANGLE`] leaves this many times as much.
const TELLING: f64 = 1.3;
/// See [`TELLING`]; in degrees.
const FAR_ANGLE: f64 = 10.0;
/// Angles of folds that are tried, in degrees.
const ANGLES: [f64; 2] = [60.0, 175.0];
/// What is left over is noise up to so many times that of crossings.
const NOISE: f64 = 2.0;
/// Points by which angles are tried, if many sightings have these few, or few so many.
const FEW: usize = 3000;
/// See [`FEW`].
const FEW_OF_SIGHTING: [usize; 2] = [12, 50];
/// The part of the canvas that must be lit, of what the file's layout lights.
const LEAST_LIT: f64 = 0.9;
/// Points of the canvas each way at which the layout is tried.
const N_LAID: u32 = 40;

/// Cameras must stand so many degrees apart, as seen from the wall: from one place, a lens or another shape explains all that
/// is left over.
const LEAST_PARALLAX_DEG: f64 = 6.0;

/// What photographs tell of the shape.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Evidence {
    /// What speaks against the shape in the file, with the cure.
    pub faults: Vec<String>,
    /// What they do not tell.
    pub remarks: Vec<String>,
}

/// The evidence of a solution by the shape in the file, and of all shots, misfits among them.
pub(super) fn evidence(wall: &Wall, surface: Surface, solution: &BentSolution, shots: &[Shot]) -> Evidence {
    let parallax = solution.parallax_deg();
    if parallax < LEAST_PARALLAX_DEG {
        return Evidence { faults: vec![parallax_fault(parallax)], remarks: Vec::new() };
    }
    match surface {
        Surface::Cylinder { radius_m, .. } | Surface::Dome { radius_m, .. } => {
            let size = size(wall, surface, solution);
            let faults: Vec<String> = size_fault(radius_m, size).into_iter().collect();
            let is_believed = faults.is_empty() && size.is_finite();
            Evidence { faults, remarks: is_believed.then(|| size_remark(radius_m, size)).into_iter().collect() }
        }
        Surface::Fold { at_m, angle } => {
            let n_sightings = shots.iter().map(|shot| shot.sightings.len()).sum::<usize>();
            let n_each = (FEW / n_sightings.max(1)).clamp(FEW_OF_SIGHTING[0], FEW_OF_SIGHTING[1]);
            let few: Vec<Shot> = shots.iter().map(|shot| shot.thinned(n_each)).collect();
            let left_over = |angle: f64| {
                let free = vec![false; wall.projectors().len()];
                let solution = solved(wall, Surface::Fold { at_m, angle }, &few, &free);
                solution.map_or(f64::INFINITY, |it| it.left_over_px(&few))
            };
            let mut evidence = angle_evidence(angle, noise_px(shots), &left_over);
            evidence.faults.extend(edge_fault(at_m, wall.canvas_m()[0], edge(wall, at_m, solution)));
            evidence
        }
    }
}

/// A fault if much less of the canvas is lit than the layout says.
pub(super) fn dark_fault(wall: &Wall, surface: Surface, lit: f64) -> Option<String> {
    let side = |n: u32| (f64::from(n) + 0.5) / f64::from(N_LAID);
    let points = (0..N_LAID * N_LAID).map(|n| DVec2::new(side(n % N_LAID), side(n / N_LAID)));
    let is_laid = |at: &DVec2| {
        wall.projectors().iter().any(|it| {
            let rect_point = it.canvas.rect_from_canvas(*at);
            rect_point.cmpge(DVec2::ZERO).all() && rect_point.cmple(DVec2::ONE).all()
        })
    };
    let laid = points.filter(is_laid).count() as f64 / f64::from(N_LAID * N_LAID);
    let keys = match surface {
        Surface::Cylinder { .. } | Surface::Dome { .. } => "radius_m, at_m and canvas_m",
        Surface::Fold { .. } => "angle, at_m and canvas_m",
    };
    (lit < LEAST_LIT * laid).then(|| {
        format!(
            "only {:.0} % of the canvas is lit, and by the file's layout it is {:.0} %: are {keys} right? --place largest may \
             make the picture fit",
            100.0 * lit,
            100.0 * laid
        )
    })
}

/// How many times as much of the wall projectors light as the file's layout says, by length.
fn size(wall: &Wall, surface: Surface, solution: &BentSolution) -> f64 {
    let pairs = pairs(wall, solution);
    let spread = |side: usize| {
        if let Surface::Dome { .. } = surface {
            let centre = surface.middle(0.0);
            let ray = |pair: &[DVec2; 2]| (surface.in_space(pair[side]) - centre).normalize();
            let middle = pairs.iter().map(ray).sum::<DVec3>().normalize_or_zero();
            return median(pairs.iter().map(|pair| ray(pair).angle_between(middle)).collect());
        }
        let middle = pairs.iter().map(|pair| pair[side]).sum::<DVec2>() / pairs.len().max(1) as f64;
        median(pairs.iter().map(|pair| pair[side].distance(middle)).collect())
    };
    spread(1) / spread(0)
}

fn parallax_fault(parallax_deg: f64) -> String {
    format!(
        "photographs are from one place, or from places within {parallax_deg:.0} degrees as seen from the wall, and tell the \
         shape of a wall that is not flat only from {LEAST_PARALLAX_DEG} degrees on: walk about, and take some from two more \
         places, to the left and to the right"
    )
}

fn size_fault(radius_m: f64, size: f64) -> Option<String> {
    let is_near = (1.0 / LARGEST_SIZE..=LARGEST_SIZE).contains(&size);
    (!is_near && size.is_finite()).then(|| {
        format!(
            "projectors light {size:.2} times as much of the wall, by length, as the file's layout says, where {:.2} to \
             {LARGEST_SIZE} is allowed: is radius_m = {radius_m} right? By the layout it is about {:.2}; if it is right, mend \
             canvas_m or the layout; and walk about between photographs: from one place they tell little",
            1.0 / LARGEST_SIZE,
            radius_m / size
        )
    })
}

fn size_remark(radius_m: f64, size: f64) -> String {
    format!(
        "photographs tell no sizes, so radius_m = {radius_m} is believed; by the file's layout it is about {:.2}: measure it, since \
         a radius that is wrong by a tenth makes the picture too high or too low by a tenth",
        radius_m / size
    )
}

/// The angle that leaves least over against that in the file: the best of many, since far from it there are other valleys,
/// from which ever smaller steps lead downhill. An angle by which noise is left over is in the right valley.
fn angle_evidence(angle: f64, noise_px: f64, left_over: &dyn Fn(f64) -> f64) -> Evidence {
    let here = left_over(angle);
    let lowest = |angles: &mut dyn Iterator<Item = f64>| {
        let tries = angles.filter(|it| (ANGLES[0]..=ANGLES[1]).contains(it)).map(|it| (it, left_over(it)));
        tries.min_by(|a, b| a.1.total_cmp(&b.1))
    };
    let n_away = ((ANGLES[1] - ANGLES[0]) / FAR_ANGLE) as i32;
    let far = (-n_away..=n_away).filter(|n| *n != 0).map(|n| angle + FAR_ANGLE * f64::from(n));
    let (mut best, mut least) = if here < NOISE * noise_px {
        (angle, here)
    } else {
        lowest(&mut { far }).filter(|it| it.1 < here).unwrap_or((angle, here))
    };
    let mut step = FAR_ANGLE / 2.0;
    while step > NEAR_ANGLE / 4.0 {
        let next = lowest(&mut [best - step, best + step].into_iter());
        match next {
            Some((next, over)) if over < least => (best, least) = (next, over),
            _ => step /= 2.0,
        }
    }
    let around = [best - FAR_ANGLE, best + FAR_ANGLE].map(left_over);
    if around.iter().any(|over| *over < TELLING * least) {
        let remark = format!(
            "these photographs do not tell the angle between the planes, and {angle} degrees is believed: walk about between \
             photographs, or measure it well"
        );
        return Evidence { faults: Vec::new(), remarks: vec![remark] };
    }
    let is_right = (best - angle).abs() <= NEAR_ANGLE || least >= BETTER * here;
    let fault = (!is_right).then(|| {
        format!(
            "angle = {angle} does not fit: points are off by {here:.2} pixels on average, and by {least:.2} if the planes \
             meet at {best:.0} degrees: measure the angle, and set angle = {best:.0} if it is that"
        )
    });
    Evidence { faults: fault.into_iter().collect(), remarks: Vec::new() }
}

/// Where a fold's edge is by what projectors light to either side: the layout moved and scaled to fit.
fn edge(wall: &Wall, at_m: f64, solution: &BentSolution) -> f64 {
    let pairs = pairs(wall, solution);
    let [in_file, solved] = [0, 1].map(|side| {
        let middle = median(pairs.iter().map(|pair| pair[side].x).collect());
        (middle, median(pairs.iter().map(|pair| (pair[side].x - middle).abs()).collect()))
    });
    in_file.0 - (solved.0 - at_m) * in_file.1 / solved.1
}

fn edge_fault(at_m: f64, width_m: f64, edge_m: f64) -> Option<String> {
    ((edge_m - at_m).abs() > FARTHEST_EDGE * width_m).then(|| {
        format!(
            "at_m = {at_m} does not fit the file's layout: by what projectors light to either side, the edge is at about \
             {edge_m:.2} m: measure it, or mend the layout"
        )
    })
}

/// The places of all crossings by the file's layout, and by the solution.
fn pairs(wall: &Wall, solution: &BentSolution) -> Vec<[DVec2; 2]> {
    let of_projector = |(index, projector)| {
        solution.crossings(index).map(move |[px, place]| [place_in_file(wall, projector, px), place])
    };
    wall.projectors().iter().enumerate().flat_map(of_projector).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_place_is_told_with_the_cure() {
        assert!(parallax_fault(0.4).contains("within 0 degrees") && parallax_fault(0.4).contains("two more places"));
    }

    #[test]
    fn a_radius_is_believed_if_projectors_light_what_the_layout_says() {
        assert_eq!(size_fault(2.0, 1.05), None);
        assert_eq!(size_fault(2.0, 0.95), None);
        let fault = size_fault(4.0, 0.8).expect("too small");
        assert!(
            fault.contains("0.80 times") && fault.contains("radius_m = 4") && fault.contains("about 5.00"),
            "{fault}"
        );
        assert!(size_fault(6.0, 1.2).is_some_and(|fault| fault.contains("about 5.00")));
    }

    #[test]
    fn the_angle_that_leaves_least_over_is_named_if_photographs_tell_it() {
        let bowl = |at: f64| move |angle: f64| 0.03 + 0.02 * (angle - at).abs();
        let of = |angle: f64, at: f64| angle_evidence(angle, 0.03, &bowl(at));
        assert_eq!(of(120.0, 120.4), Evidence::default());
        for angle in [100.0, 135.0, 165.0] {
            let Evidence { faults, remarks } = of(angle, 120.0);
            assert!(remarks.is_empty() && faults.len() == 1 && faults[0].contains("set angle = 120"), "{faults:?}");
        }
        // Any angle fits.
        let Evidence { faults, remarks } = angle_evidence(100.0, 0.03, &|angle| 0.03 + 1e-4 * (angle - 120.0).abs());
        assert!(faults.is_empty() && remarks[0].contains("do not tell the angle"), "{faults:?}");
        // Nothing fits.
        let Evidence { faults, .. } = angle_evidence(100.0, 0.03, &|_| f64::INFINITY);
        assert!(faults.is_empty());
    }

    #[test]
    fn an_edge_beside_its_place_is_told() {
        assert_eq!(edge_fault(1.5, 3.0, 1.6), None);
        assert_eq!(edge_fault(1.5, 3.0, f64::NAN), None);
        let fault = edge_fault(1.0, 3.0, 1.5).expect("lopsided");
        assert!(fault.contains("at_m = 1") && fault.contains("1.50 m"), "{fault}");
    }
}
