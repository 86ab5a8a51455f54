//! Solves a wall of a known shape that is not flat: finds cameras and projectors, and from these where pixels lie.

use std::collections::HashSet;

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3, DVec4};

use super::{
    bundle::{Bundle, Held, Pose, Projection, Seen, projected},
    fitting::{quantile, solve_symmetric},
    lens::Lens,
    solve::{Fit, Shot},
};
use crate::wall::Surface;

/// The layout of a projector as the wall file has it: where it may light the wall.
pub(super) struct Layout<'a> {
    /// Columns and rows.
    pub size: DVec2,
    /// The place on the unrolled wall, in metres, at a pixel.
    pub place_at: Box<dyn Fn(DVec2) -> DVec2 + 'a>,
    /// Whether its pixels lie exactly there.
    pub is_held: bool,
}

/// Where projectors' pixels lie.
pub(super) struct BentSolution {
    bundle: Bundle,
    surface: Surface,
    sizes: Vec<DVec2>,
    /// For each projector: crossings as in [`Seen::px`], with their places.
    crossings: Vec<Vec<[DVec2; 2]>>,
    /// For each projector: how well it fits.
    fits: Vec<Fit>,
    /// For each projector: its crossings as in [`Seen::px`], and how far from there they were seen, in pixels.
    misses: Vec<Vec<[DVec2; 2]>>,
    /// For each shot: half of its points are.
    pub shot_medians_px: Vec<f64>,
}

/// A shot or a projector needs so many crossings.
const LEAST_CROSSINGS: usize = 24;
/// Crossings by which a camera's first place is found.
const FEW: usize = 150;

/// Solves for all projectors and shots; what has too few crossings is left out. `None` if nothing fits at all.
///
/// Projectors that are held show the cameras where they stand, and stay as they are.
pub(super) fn solve(surface: Surface, layouts: &[Layout<'_>], shots: &[Shot]) -> Option<BentSolution> {
    let seen = seen(layouts, shots);
    let is_any_held = layouts.iter().any(|layout| layout.is_held);
    let tells = |it: &Seen| it.held.is_some() || !is_any_held;
    let n_of = |is_of: &dyn Fn(&Seen) -> bool| seen.iter().filter(|it| is_of(it)).count();
    let place = |it: &Seen| {
        let layout = &layouts[it.projector];
        (layout.place_at)(it.px * it.px_per_unit + layout.size / 2.0)
    };
    let rough = |shot: usize| -> Vec<(DVec2, DVec2)> {
        let own: Vec<&Seen> = seen.iter().filter(|it| it.shot == shot && tells(it)).collect();
        own.iter().step_by(own.len().div_ceil(FEW).max(1)).map(|it| (it.at, place(it))).collect()
    };
    let used: Vec<bool> =
        (0..shots.len()).map(|shot| n_of(&|it| it.shot == shot && tells(it)) >= LEAST_CROSSINGS).collect();
    // The shot that shows most tells the focal length; the others share it.
    let most =
        (0..shots.len()).filter(|shot| used[*shot]).max_by_key(|shot| n_of(&|it| it.shot == *shot && tells(it)))?;
    let focal = start(&surface, &rough(most), None)?.0;
    let poses: Vec<Option<Pose>> =
        (0..shots.len()).map(|shot| used[shot].then(|| Some(start(&surface, &rough(shot), Some(focal))?.1))?).collect();
    let mut bundle = Bundle { lens: Lens::default(), focal, poses, projections: vec![None; layouts.len()] };
    let seen: Vec<Seen> = seen.into_iter().filter(|it| bundle.poses[it.shot].is_some()).collect();
    if is_any_held {
        bundle = bundle.adjusted(&surface, &seen.iter().filter(|it| it.held.is_some()).copied().collect::<Vec<_>>());
    }
    for projector in (0..layouts.len()).filter(|projector| !layouts[*projector].is_held) {
        let pairs: Vec<(DVec3, DVec2)> = seen
            .iter()
            .filter(|it| it.projector == projector)
            .filter_map(|it| Some((surface.in_space(bundle.place(&surface, &bundle.poses[it.shot]?, it.at)?), it.px)))
            .collect();
        bundle.projections[projector] = (pairs.len() >= LEAST_CROSSINGS).then(|| fitted(&pairs)).flatten();
    }
    let is_known = |it: &Seen| it.held.is_some() || bundle.projections[it.projector].is_some();
    let seen: Vec<Seen> = seen.into_iter().filter(is_known).collect();
    let bundle = bundle.adjusted(&surface, &seen);
    Some(BentSolution::new(bundle, surface, layouts, shots.len(), &seen))
}

fn seen(layouts: &[Layout<'_>], shots: &[Shot]) -> Vec<Seen> {
    let mut all = Vec::new();
    for (shot, it) in shots.iter().enumerate() {
        for sighting in &it.sightings {
            let layout = &layouts[sighting.projector_idx];
            let size = layout.size;
            let px_per_unit = size.max_element() / 2.0;
            all.extend(sighting.points.iter().map(|[px, at]| Seen {
                shot,
                projector: sighting.projector_idx,
                at: Lens::normalised(it.size, *at),
                px: (*px - size / 2.0) / px_per_unit,
                px_per_unit,
                held: layout.is_held.then(|| layout.held(*px, px_per_unit)),
            }));
        }
    }
    all
}

impl Layout<'_> {
    /// Where a pixel is held.
    fn held(&self, px: DVec2, px_per_unit: f64) -> Held {
        // A pixel to either side: meshes are smooth there, except across a fold.
        let by = |axis: DVec2| ((self.place_at)(px + axis) - (self.place_at)(px - axis)) / 2.0;
        let px_by_place = DMat2::from_cols(by(DVec2::X), by(DVec2::Y)).inverse() * (1.0 / px_per_unit);
        Held { place: (self.place_at)(px), px_by_place }
    }
}

/// A camera's focal length, unless it is given, and its place, from what it sees of places that are known roughly.
fn start(surface: &Surface, rough: &[(DVec2, DVec2)], focal: Option<f64>) -> Option<(f64, Pose)> {
    let n = rough.len() as f64;
    let points: Vec<(DVec2, DVec3)> = rough.iter().map(|(at, place)| (*at, surface.in_space(*place))).collect();
    let centre = points.iter().map(|(_, point)| *point).sum::<DVec3>() / n;
    let seen_centre = points.iter().map(|(at, _)| *at).sum::<DVec2>() / n;
    let spread = points.iter().map(|(_, point)| point.distance(centre)).sum::<f64>() / n;
    let seen_spread = points.iter().map(|(at, _)| at.distance(seen_centre)).sum::<f64>() / n;
    let focals: Vec<f64> = focal.map_or(vec![1.0, 1.6, 2.4], |focal| vec![focal]);
    let mut best: Option<(f64, f64, Pose)> = None;
    for &focal_guess in &focals {
        for (aside, quarter) in
            [-0.5, 0.0, 0.5].into_iter().flat_map(|aside| (0..4).map(move |quarter| (aside, quarter)))
        {
            let away_m = focal_guess * spread / seen_spread.max(1e-6);
            let position = centre + DVec3::new(aside, 0.0, 1.0).normalize() * away_m;
            let ahead = (centre - position).normalize();
            let right = ahead.cross(DVec3::Y).normalize();
            let rotation = DQuat::from_mat3(&DMat3::from_cols(right, ahead.cross(right), ahead))
                * DQuat::from_rotation_z(f64::from(quarter) * std::f64::consts::FRAC_PI_2);
            let first = (focal_guess, Pose { position, rotation });
            let (cost, focal_found, pose) = resected(&points, first, focal.is_none());
            if best.as_ref().is_none_or(|(least, ..)| cost < *least) {
                best = Some((cost, focal_found, pose));
            }
        }
    }
    best.map(|(_, focal, pose)| (focal, pose))
}

/// The camera that sees points where it does, by Levenberg and Marquardt's method with slopes of small steps; its cost,
/// focal length and pose.
fn resected(points: &[(DVec2, DVec3)], (mut focal, mut pose): (f64, Pose), moves_focal: bool) -> (f64, f64, Pose) {
    let n = if moves_focal { 7 } else { 6 };
    let moved = |focal: f64, pose: &Pose, by: &[f64]| {
        let pose = Pose {
            position: pose.position + DVec3::new(by[0], by[1], by[2]),
            rotation: (pose.rotation * DQuat::from_scaled_axis(DVec3::new(by[3], by[4], by[5]))).normalize(),
        };
        (focal * by.get(6).map_or(1.0, |by| by.clamp(-0.5, 0.5).exp()), pose)
    };
    let away = |(focal, pose): &(f64, Pose), (at, point): &(DVec2, DVec3)| {
        let local = pose.rotation.inverse() * (*point - pose.position);
        // Points behind the camera are far off.
        if local.z > 1e-6 { *at - *focal * local.truncate() / local.z } else { DVec2::splat(3.0) }
    };
    let cost = |camera: &(f64, Pose)| points.iter().map(|it| away(camera, it).length_squared().min(1.0)).sum::<f64>();
    let (mut now, mut damping) = (cost(&(focal, pose)), 1e-2);
    for _ in 0..40 {
        let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
        for it in points {
            let here = away(&(focal, pose), it);
            let slopes: Vec<DVec2> = (0..n)
                .map(|axis| {
                    let mut by = vec![0.0; n];
                    by[axis] = 1e-6;
                    (here - away(&moved(focal, &pose, &by), it)) / 1e-6
                })
                .collect();
            for a in 0..n {
                for b in 0..n {
                    matrix[a * n + b] += slopes[a].dot(slopes[b]);
                }
                right[a] += slopes[a].dot(here);
            }
        }
        let before = now;
        while damping < 1e8 {
            let (mut matrix, mut step) = (matrix.clone(), right.clone());
            (0..n).for_each(|axis| matrix[axis * n + axis] = matrix[axis * n + axis] * (1.0 + damping) + 1e-12);
            let next = solve_symmetric(&mut matrix, &mut step).then(|| moved(focal, &pose, &step));
            if let Some(next) = next.filter(|next| cost(next) < now) {
                now = cost(&next);
                (focal, pose) = next;
                damping *= 0.2;
                break;
            }
            damping *= 10.0;
        }
        if before - now < 1e-9 * before {
            break;
        }
    }
    (now, focal, pose)
}

/// The projection that takes points in space to pixels, by linear equations (Abdel-Aziz and Karara 1971). Points of a
/// plane leave a part of it free, which becomes small.
fn fitted(pairs: &[(DVec3, DVec2)]) -> Option<Projection> {
    let centre = pairs.iter().map(|(point, _)| *point).sum::<DVec3>() / pairs.len() as f64;
    let mut normal = vec![0.0; 121];
    let mut right = [0.0; 11];
    for (point, px) in pairs {
        let p = *point - centre;
        let rows = [
            ([p.x, p.y, p.z, 1.0, 0.0, 0.0, 0.0, 0.0, -px.x * p.x, -px.x * p.y, -px.x * p.z], px.x),
            ([0.0, 0.0, 0.0, 0.0, p.x, p.y, p.z, 1.0, -px.y * p.x, -px.y * p.y, -px.y * p.z], px.y),
        ];
        for (row, value) in rows {
            for (a, by) in row.iter().enumerate() {
                for (b, other) in row.iter().enumerate() {
                    normal[11 * a + b] += by * other;
                }
                right[a] += by * value;
            }
        }
    }
    (0..11).for_each(|n| normal[12 * n] += 1e-7 * pairs.len() as f64);
    if !solve_symmetric(&mut normal, &mut right) {
        return None;
    }
    let row = |a: f64, b: f64, c: f64, d: f64| DVec4::new(a, b, c, d - DVec3::new(a, b, c).dot(centre));
    let [a, b, c, d, e, f, g, h, i, j, k] = right;
    Some([row(a, b, c, d), row(e, f, g, h), row(i, j, k, 1.0)])
}

impl BentSolution {
    fn new(bundle: Bundle, surface: Surface, layouts: &[Layout<'_>], n_shots: usize, seen: &[Seen]) -> Self {
        let misses: Vec<(Seen, DVec2)> = seen.iter().map(|it| (*it, bundle.miss_px(&surface, it))).collect();
        let crossings_of = |projector: usize| -> Vec<[DVec2; 2]> {
            let own = seen.iter().filter(|it| it.projector == projector);
            own.filter_map(|it| {
                let place = bundle.place(&surface, bundle.poses[it.shot].as_ref()?, it.at)?;
                Some([it.px, place])
            })
            .collect()
        };
        let quantiles = |is_of: &dyn Fn(&Seen) -> bool| {
            let mut own: Vec<f64> = misses.iter().filter(|(it, _)| is_of(it)).map(|(_, by)| by.length()).collect();
            [quantile(&mut own, 0.5), quantile(&mut own, 0.95)]
        };
        let crossings: Vec<Vec<[DVec2; 2]>> = (0..layouts.len()).map(crossings_of).collect();
        let fit_of = |projector: usize| {
            let [median_px, p95_px] = quantiles(&|it| it.projector == projector);
            let shots: HashSet<usize> = seen.iter().filter(|it| it.projector == projector).map(|it| it.shot).collect();
            let bits = |[px, _]: &[DVec2; 2]| px.to_array().map(f64::to_bits);
            let n_crossings = crossings[projector].iter().map(bits).collect::<HashSet<_>>().len();
            Fit { n_points: crossings[projector].len(), n_shots: shots.len(), n_crossings, median_px, p95_px }
        };
        let misses_of = |projector: usize| {
            let own = misses.iter().filter(|(it, _)| it.projector == projector);
            own.map(|(it, by)| [it.px, *by]).collect()
        };
        Self {
            fits: (0..layouts.len()).map(fit_of).collect(),
            misses: (0..layouts.len()).map(misses_of).collect(),
            crossings,
            shot_medians_px: (0..n_shots).map(|shot| quantiles(&|it| it.shot == shot)[0]).collect(),
            sizes: layouts.iter().map(|layout| layout.size).collect(),
            bundle,
            surface,
        }
    }

    /// The largest angle between the directions in which two cameras stand, as seen from the middle of the wall, in degrees.
    pub(super) fn parallax_deg(&self) -> f64 {
        let points = || self.crossings.iter().flatten().map(|[_, place]| self.surface.in_space(*place));
        let middle = points().sum::<DVec3>() / points().count().max(1) as f64;
        let places = self.bundle.poses.iter().flatten().map(|pose| (pose.position - middle).normalize_or_zero());
        let places: Vec<DVec3> = places.collect();
        let angles = places.iter().flat_map(|a| places.iter().map(|b| a.angle_between(*b).to_degrees()));
        angles.fold(0.0, f64::max)
    }

    /// How far a projector's points are from where a layout has them, in its pixels: half and nineteen of twenty are nearer.
    pub(super) fn distances(&self, projector: usize, layout: &Layout<'_>) -> [f64; 2] {
        let size = self.sizes[projector];
        let px_per_unit = size.max_element() / 2.0;
        let away = |[px, place]: [DVec2; 2]| {
            let Held { place: there, px_by_place } = layout.held(px, px_per_unit);
            (px_by_place * (there - place)).length() * px_per_unit
        };
        let mut all: Vec<f64> = self.crossings(projector).map(away).collect();
        [quantile(&mut all, 0.5), quantile(&mut all, 0.95)]
    }

    /// Whether a projector was solved.
    pub(super) fn is_solved(&self, projector: usize) -> bool {
        self.bundle.projections[projector].is_some()
    }

    /// How far crossings of these shots are off on average, in pixels; none counts as more than one pixel, and as much if its
    /// projector was not solved.
    pub(super) fn left_over_px(&self, shots: &[Shot]) -> f64 {
        let all = || self.misses.iter().flatten().map(|[_, by]| by.length().min(1.0));
        let n_seen: usize = shots.iter().flat_map(|shot| &shot.sightings).map(|it| it.points.len()).sum();
        (all().sum::<f64>() + n_seen.saturating_sub(all().count()) as f64) / n_seen.max(1) as f64
    }

    /// How well a projector fits.
    pub(super) fn fit(&self, projector: usize) -> Fit {
        self.fits[projector]
    }

    /// A projector's crossings in its pixels, and how far from there they were seen.
    pub(super) fn misses(&self, projector: usize) -> Vec<[DVec2; 2]> {
        self.misses[projector].iter().map(|[px, by]| [self.in_pixels(projector, *px), *by]).collect()
    }

    /// Columns and rows of a projector's pixels.
    pub(super) fn size(&self, projector: usize) -> DVec2 {
        self.sizes[projector]
    }

    /// Pixels of a projector, from [`Seen::px`].
    fn in_pixels(&self, projector: usize, px: DVec2) -> DVec2 {
        let size = self.sizes[projector];
        px * size.max_element() / 2.0 + size / 2.0
    }

    /// Whether a projector's pixels light a place on the unrolled wall.
    pub(super) fn lights(&self, projector: usize, place: DVec2) -> bool {
        let size = self.sizes[projector];
        let image = self.bundle.projections[projector].as_ref();
        let image = image.and_then(|rows| projected(rows, self.surface.in_space(place)));
        image.is_some_and(|image| image.abs().cmple(size / size.max_element()).all())
    }

    /// A projector's crossings, in its pixels, with their places on the unrolled wall in metres.
    pub(super) fn crossings(&self, projector: usize) -> impl Iterator<Item = [DVec2; 2]> + '_ {
        self.crossings[projector].iter().map(move |[px, place]| [self.in_pixels(projector, *px), *place])
    }

    /// The place on the unrolled wall, in metres, that a projector's pixel lights; `None` if it was not solved.
    ///
    /// Newton's method from the nearest crossing.
    pub(super) fn place_at(&self, projector: usize, px: DVec2) -> Option<DVec2> {
        let rows = self.bundle.projections[projector].as_ref()?;
        let size = self.sizes[projector];
        let wanted = (px - size / 2.0) / (size.max_element() / 2.0);
        let near = self.crossings[projector]
            .iter()
            .min_by(|a, b| a[0].distance_squared(wanted).total_cmp(&b[0].distance_squared(wanted)))?;
        let image = |place: DVec2| projected(rows, self.surface.in_space(place));
        let mut place = near[1];
        for _ in 0..20 {
            let here = image(place)?;
            let away = wanted - here;
            if away.length() < 1e-10 {
                break;
            }
            const STEP: f64 = 1e-6;
            let slope = |axis: DVec2| Some((image(place + axis * STEP)? - image(place - axis * STEP)?) / (2.0 * STEP));
            let slopes = DMat2::from_cols(slope(DVec2::X)?, slope(DVec2::Y)?);
            place += slopes.inverse() * away;
        }
        place.is_finite().then_some(place)
    }
}
