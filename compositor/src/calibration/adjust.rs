//! Adjusts lenses and all homographies together: bundle adjustment (Triggs et al. 1999) of a flat wall.

use glam::{DMat2, DMat3, DVec2};

use super::{
    fitting::{median, solve_symmetric},
    lens::Lens,
    solve::{Observation, Shot},
};
use crate::wall::homography::apply;

/// Lenses, and maps whose last entry is 1.
#[derive(Clone, Debug)]
pub(super) struct Estimate {
    pub lenses: Vec<Lens>,
    /// From each shot's pinhole picture to the plane.
    pub shot_maps: Vec<Option<DMat3>>,
    /// From the plane to each projector's pixels.
    pub projector_maps: Vec<Option<DMat3>>,
}

/// Where parameters begin, and what they are.
pub(super) struct Layout {
    /// Shots of the same size share a lens.
    pub lens_of_shot: Vec<usize>,
    n_lenses: usize,
    /// The first of eight parameters of each map; `None` for the shot whose picture is the plane, and for what is not joined.
    shot_at: Vec<Option<usize>>,
    projector_at: Vec<Option<usize>>,
    n: usize,
}

/// Rounds of adjusting; a wall takes about ten.
const MOST_ROUNDS: usize = 50;
/// A step that needs more damping changes nothing.
const MOST_DAMPING: f64 = 1e8;
/// Points farther off than this many medians count little.
const SCALE: f64 = 3.0;

/// The estimate that fits best, by the method of Levenberg and Marquardt with Cauchy's weights.
pub(super) fn adjusted(layout: &Layout, observations: &[&Observation], mut estimate: Estimate) -> Estimate {
    let scale_of = |estimate: &Estimate| (SCALE * median(layout.distances(estimate, observations))).max(1e-3);
    let (mut scale, mut damping) = (scale_of(&estimate), 1e-4);
    for _ in 0..MOST_ROUNDS {
        let before = cost(layout, observations, &estimate, scale);
        let (matrix, right) = normal_equations(layout, observations, &estimate, scale);
        // Raise the damping until a step improves the estimate.
        let (next, now) = loop {
            let next = step(&matrix, &right, damping).map(|step| layout.moved(&estimate, &step));
            let next = next.map(|next| (cost(layout, observations, &next, scale), next));
            match next {
                Some((now, next)) if now <= before => break (next, now),
                _ if damping > MOST_DAMPING => return estimate,
                _ => damping *= 10.0,
            }
        };
        estimate = next;
        damping = (damping * 0.2).max(1e-12);
        // Weights follow the residuals as they shrink.
        let next_scale = scale_of(&estimate).min(scale);
        if before - now <= 1e-7 * before && next_scale > 0.999 * scale {
            break;
        }
        scale = next_scale;
    }
    estimate
}

/// The solution of the damped equations; `None` if there is none.
fn step(matrix: &[f64], right: &[f64], damping: f64) -> Option<Vec<f64>> {
    let (mut matrix, mut step) = (matrix.to_vec(), right.to_vec());
    for index in 0..step.len() {
        matrix[index * right.len() + index] *= 1.0 + damping;
    }
    solve_symmetric(&mut matrix, &mut step).then_some(step)
}

impl Layout {
    /// Maps of projectors that are held are no parameters.
    pub(super) fn new(
        shots: &[Shot],
        shot_maps: &[Option<DMat3>],
        projector_maps: &[Option<DMat3>],
        is_held: &[bool],
    ) -> Self {
        let mut sizes: Vec<[usize; 2]> = Vec::new();
        let lens_of_shot = shots
            .iter()
            .map(|shot| {
                sizes.iter().position(|size| *size == shot.size).unwrap_or_else(|| {
                    sizes.push(shot.size);
                    sizes.len() - 1
                })
            })
            .collect();
        let mut n = sizes.len() * Lens::N;
        let mut place = |is_free: bool| {
            is_free.then(|| {
                n += 8;
                n - 8
            })
        };
        // The plane is that of the first shot whose map is the identity, or that of projectors that are held.
        let fixed = shot_maps.iter().position(|map| *map == Some(DMat3::IDENTITY));
        let shot_at = (0..shots.len()).map(|shot| place(shot_maps[shot].is_some() && Some(shot) != fixed)).collect();
        let both = projector_maps.iter().zip(is_held);
        let projector_at = both.map(|(map, is_held)| place(map.is_some() && !is_held)).collect();
        Self { lens_of_shot, n_lenses: sizes.len(), shot_at, projector_at, n }
    }

    /// Lenses without distortion.
    pub(super) fn lenses(&self) -> Vec<Lens> {
        vec![Lens::default(); self.n_lenses]
    }

    /// How far each observation is from where it should be, in the projector's pixels.
    pub(super) fn distances(&self, estimate: &Estimate, observations: &[&Observation]) -> Vec<f64> {
        self.misses(estimate, observations).into_iter().map(DVec2::length).collect()
    }

    /// From where each observation should be to where it is, in the projector's pixels.
    pub(super) fn misses(&self, estimate: &Estimate, observations: &[&Observation]) -> Vec<DVec2> {
        let miss = |it: &&Observation| {
            let lens = &estimate.lenses[self.lens_of_shot[it.shot]];
            let plane = apply(estimate.shot_maps[it.shot]?, lens.undistorted(it.seen).at)?;
            Some(apply(estimate.projector_maps[it.projector]?, plane)? - it.px)
        };
        // A point beyond a horizon is far.
        observations.iter().map(|it| miss(it).unwrap_or(1e6 * DVec2::X)).collect()
    }

    /// The estimate after a step of all parameters.
    fn moved(&self, estimate: &Estimate, step: &[f64]) -> Estimate {
        let mut moved = estimate.clone();
        for (index, lens) in moved.lenses.iter_mut().enumerate() {
            lens.coefficients.iter_mut().zip(&step[index * Lens::N..]).for_each(|(entry, by)| *entry += by);
        }
        let shots = moved.shot_maps.iter_mut().zip(&self.shot_at);
        let projectors = moved.projector_maps.iter_mut().zip(&self.projector_at);
        for (map, at) in shots.chain(projectors) {
            if let (Some(map), Some(at)) = (map, at) {
                let by = &step[*at..*at + 8];
                *map += DMat3::from_cols_array(&[by[0], by[3], by[6], by[1], by[4], by[7], by[2], by[5], 0.0]);
            }
        }
        moved
    }
}

/// The image of a point under a map, with derivatives by the point and by the map's first eight entries, row by row.
fn image(map: DMat3, point: DVec2) -> Option<(DVec2, DMat2, [DVec2; 8])> {
    let at = apply(map, point)?;
    let depth = (map * point.extend(1.0)).z;
    let column = |index: usize| (map.col(index).truncate() - at * map.col(index).z) / depth;
    let (x, y) = (DVec2::X / depth, DVec2::Y / depth);
    let by_entry =
        [x * point.x, x * point.y, x, y * point.x, y * point.y, y, -at * (point.x / depth), -at * (point.y / depth)];
    Some((at, DMat2::from_cols(column(0), column(1)), by_entry))
}

/// The sum of Cauchy's losses, and of the lenses' distances from none.
fn cost(layout: &Layout, observations: &[&Observation], estimate: &Estimate, scale: f64) -> f64 {
    let loss = |distance: f64| scale * scale * (distance / scale).powi(2).ln_1p();
    let entries = estimate.lenses.iter().flat_map(|lens| lens.coefficients.into_iter().zip(Lens::SPREAD));
    let prior: f64 = entries.map(|(it, spread)| (it / spread).powi(2)).sum();
    layout.distances(estimate, observations).into_iter().map(loss).sum::<f64>() + prior
}

/// The matrix of the normal equations, row by row, and their right side.
fn normal_equations(
    layout: &Layout,
    observations: &[&Observation],
    Estimate { lenses, shot_maps, projector_maps }: &Estimate,
    scale: f64,
) -> (Vec<f64>, Vec<f64>) {
    let n = layout.n;
    let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
    for (index, lens) in lenses.iter().enumerate() {
        for (coefficient, (value, spread)) in lens.coefficients.iter().zip(Lens::SPREAD).enumerate() {
            let at = index * Lens::N + coefficient;
            matrix[at * n + at] += 1.0 / (spread * spread);
            right[at] -= value / (spread * spread);
        }
    }
    let mut places: Vec<usize> = Vec::new();
    let mut slopes: Vec<DVec2> = Vec::new();
    for it in observations {
        let lens_idx = layout.lens_of_shot[it.shot];
        let undistorted = lenses[lens_idx].undistorted(it.seen);
        let (Some(shot), Some(projector)) = (shot_maps[it.shot], projector_maps[it.projector]) else { continue };
        let Some((plane, by_pinhole, by_shot)) = image(shot, undistorted.at) else { continue };
        let Some((px, by_plane, by_projector)) = image(projector, plane) else { continue };
        let away = it.px - px;
        let weight = 1.0 / (1.0 + away.length_squared() / (scale * scale));
        places.clear();
        slopes.clear();
        let by_lens = by_plane * by_pinhole;
        for (coefficient, slope) in undistorted.by_coefficient.iter().enumerate() {
            places.push(lens_idx * Lens::N + coefficient);
            slopes.push(by_lens * *slope);
        }
        for (at, by_entry, outer) in [
            (layout.shot_at[it.shot], by_shot, by_plane),
            (layout.projector_at[it.projector], by_projector, DMat2::IDENTITY),
        ] {
            let Some(at) = at else { continue };
            for (entry, slope) in by_entry.iter().enumerate() {
                places.push(at + entry);
                slopes.push(outer * *slope);
            }
        }
        for (a, slope) in places.iter().zip(&slopes) {
            for (b, other) in places.iter().zip(&slopes) {
                matrix[a * n + b] += weight * slope.dot(*other);
            }
            right[*a] += weight * slope.dot(away);
        }
    }
    (matrix, right)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_of_images_are_those_of_small_steps() {
        let map = DMat3::from_cols_array(&[1.2, 0.1, 0.02, -0.2, 0.9, -0.03, 5.0, 7.0, 1.0]);
        let point = DVec2::new(1.5, -2.0);
        let (_, by_point, by_entry) = image(map, point).expect("before the horizon");
        for (axis, step) in [DVec2::X, DVec2::Y].into_iter().enumerate() {
            let at = |by: f64| apply(map, point + by * step).expect("there");
            assert!(((at(1e-6) - at(-1e-6)) / 2e-6).distance(by_point.col(axis)) < 1e-6);
        }
        for (entry, slope) in by_entry.into_iter().enumerate() {
            let at = |by: f64| {
                let mut map = map.to_cols_array();
                // Entries are row by row, and glam's matrices column by column.
                map[entry % 3 * 3 + entry / 3] += by;
                apply(DMat3::from_cols_array(&map), point).expect("there")
            };
            assert!(((at(1e-6) - at(-1e-6)) / 2e-6).distance(slope) < 1e-6, "{entry}");
        }
    }
}
