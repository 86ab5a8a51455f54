//! Works out where all projectors' pixels lie on the wall, from what several photographs show of them.
//!
//! A flat wall, a pinhole camera and a projector are related by homographies, as in Chen, Sukthankar, Wallace and Li,
//! "Scalable Alignment of Large-Format Multi-Projector Displays Using Camera Homography Trees" (2002). A tree joins
//! photographs through projectors that both show; then all homographies and the lenses are adjusted together, which
//! needs no calibrated camera: a wrong lens bends what projectors show straight.

use std::collections::HashSet;

use glam::{DMat3, DVec2};

use super::{
    adjust::{Estimate, Layout, adjusted},
    fitting::{fitted, median, quantile, with_unit_depth},
    identify::Sighting,
    lens::Lens,
};
use crate::wall::homography::apply;

/// The sightings of one photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Shot {
    /// Columns and rows of the photograph.
    pub size: [usize; 2],
    /// The parts of patterns in it.
    pub sightings: Vec<Sighting>,
}

impl Shot {
    /// The shot with at most so many points of each sighting.
    pub(super) fn thinned(&self, most: usize) -> Self {
        let mut thinned = self.clone();
        for sighting in &mut thinned.sightings {
            let step = sighting.points.len().div_ceil(most).max(1);
            sighting.points = sighting.points.iter().step_by(step).copied().collect();
        }
        thinned
    }
}

/// Where projectors' pixels lie, on a plane that is the wall's up to a homography.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// For each projector: from the plane to its pixels; `None` if it could not be joined with the others.
    pub px_from_plane: Vec<Option<DMat3>>,
    /// For each shot: from its pinhole picture to the plane; `None` if it could not be joined with the others.
    pub plane_from_shot: Vec<Option<DMat3>>,
    /// For each shot: its lens.
    pub lenses: Vec<Lens>,
    /// For each projector: how well it fits.
    pub fits: Vec<Fit>,
    /// For each projector: its crossings in its pixels, all shots together, and how far from there they were seen.
    pub misses: Vec<Vec<[DVec2; 2]>>,
    /// For each shot: half of its points are nearer than this to their places, in projector pixels.
    pub shot_medians_px: Vec<f64>,
}

/// How well a projector's points fit.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fit {
    /// Crossings seen, all shots together.
    pub n_points: usize,
    /// Shots that show the projector.
    pub n_shots: usize,
    /// Crossings that were seen at least once.
    pub n_crossings: usize,
    /// Half of the points are nearer than this to their places, in the projector's pixels.
    pub median_px: f64,
    /// Nineteen of twenty points are.
    pub p95_px: f64,
}

/// One crossing in one shot.
pub(super) struct Observation {
    pub shot: usize,
    pub projector: usize,
    /// Normalised, in the photograph.
    pub seen: DVec2,
    /// In the projector's pixels.
    pub px: DVec2,
}

/// Solves for all projectors that shots join.
pub fn solve(n_projectors: usize, shots: &[Shot]) -> Solution {
    solve_from(&vec![None; n_projectors], shots)
}

/// The same if the maps of some projectors from the plane are known: they stay as they are.
pub(super) fn solve_from(known: &[Option<DMat3>], shots: &[Shot]) -> Solution {
    let n_projectors = known.len();
    let observations = observations(shots);
    let (shot_maps, projector_maps) = joined(known, shots, &observations);
    let is_joined = |it: &&Observation| shot_maps[it.shot].is_some() && projector_maps[it.projector].is_some();
    let used: Vec<&Observation> = observations.iter().filter(is_joined).collect();
    let is_held: Vec<bool> = known.iter().map(Option::is_some).collect();
    let layout = Layout::new(shots, &shot_maps, &projector_maps, &is_held);
    let estimate = adjusted(&layout, &used, Estimate { lenses: layout.lenses(), shot_maps, projector_maps });
    let away: Vec<DVec2> = layout.misses(&estimate, &used);
    let misses = |projector: usize| -> Vec<[DVec2; 2]> {
        std::iter::zip(&used, &away).filter(|(it, _)| it.projector == projector).map(|(it, by)| [it.px, *by]).collect()
    };
    let misses = (0..n_projectors).map(misses).collect();
    let away = away.into_iter().map(DVec2::length);
    let distances: Vec<(&Observation, f64)> = std::iter::zip(used, away).collect();
    let of_shot = |shot: usize| distances.iter().filter(move |(it, _)| it.shot == shot).map(|(_, away)| *away);
    Solution {
        lenses: (0..shots.len()).map(|shot| estimate.lenses[layout.lens_of_shot[shot]]).collect(),
        shot_medians_px: (0..shots.len()).map(|shot| median(of_shot(shot).collect())).collect(),
        misses,
        fits: (0..n_projectors).map(|projector| fit_of(projector, &distances)).collect(),
        px_from_plane: estimate.projector_maps,
        plane_from_shot: estimate.shot_maps,
    }
}

fn observations(shots: &[Shot]) -> Vec<Observation> {
    let of_shot = |(shot, it): (usize, &Shot)| {
        let size = it.size;
        let of_sighting = move |sighting: &Sighting| {
            let projector = sighting.projector_idx;
            let of_point =
                |[px, at]: &[DVec2; 2]| Observation { shot, projector, seen: Lens::normalised(size, *at), px: *px };
            sighting.points.iter().map(of_point).collect::<Vec<_>>()
        };
        it.sightings.iter().flat_map(of_sighting).collect::<Vec<_>>()
    };
    shots.iter().enumerate().flat_map(of_shot).collect()
}

/// Joins shots and projectors one by one, without regard to lenses: maps from shots to the plane, and from the plane to
/// projectors. The plane is that of the projectors' maps that are known, or else the picture of the shot that shows most.
fn joined(
    known: &[Option<DMat3>],
    shots: &[Shot],
    observations: &[Observation],
) -> (Vec<Option<DMat3>>, Vec<Option<DMat3>>) {
    let mut shot_maps: Vec<Option<DMat3>> = vec![None; shots.len()];
    let mut projector_maps: Vec<Option<DMat3>> = known.to_vec();
    let of = |shot: usize| observations.iter().filter(move |it| it.shot == shot);
    let n_shown = |shot: usize| {
        let mut projectors: Vec<usize> = of(shot).map(|it| it.projector).collect();
        let n_points = projectors.len();
        projectors.dedup();
        projectors.sort_unstable();
        projectors.dedup();
        (projectors.len(), n_points)
    };
    // The open shot that shares most points with the projectors that are joined.
    let next_of = |shot_maps: &[Option<DMat3>], projector_maps: &[Option<DMat3>]| {
        let plane_from_px: Vec<Option<DMat3>> = projector_maps.iter().map(|map| map.map(|map| map.inverse())).collect();
        let pairs_of = |shot: usize| -> Vec<[DVec2; 2]> {
            let pair = |it: &Observation| Some([it.seen, apply(plane_from_px[it.projector]?, it.px)?]);
            of(shot).filter_map(pair).collect()
        };
        let open = (0..shots.len()).filter(|&shot| shot_maps[shot].is_none());
        let most = open.map(|shot| (shot, pairs_of(shot))).max_by_key(|(shot, pairs)| (pairs.len(), usize::MAX - shot));
        most.filter(|(_, pairs)| pairs.len() >= 24)
            .and_then(|(shot, pairs)| Some((shot, with_unit_depth(fitted(&pairs)?))))
    };
    let first = || (0..shots.len()).max_by_key(|&shot| (n_shown(shot), std::cmp::Reverse(shot)));
    let mut next = if known.iter().any(Option::is_some) {
        next_of(&shot_maps, &projector_maps)
    } else {
        first().map(|first| (first, DMat3::IDENTITY))
    };
    while let Some((shot, map)) = next {
        shot_maps[shot] = Some(map);
        for (projector, projector_map) in projector_maps.iter_mut().enumerate().filter(|(_, map)| map.is_none()) {
            let own = of(shot).filter(|it| it.projector == projector);
            let pairs: Vec<[DVec2; 2]> = own.filter_map(|it| Some([apply(map, it.seen)?, it.px])).collect();
            if pairs.len() >= 12 {
                *projector_map = fitted(&pairs).map(with_unit_depth);
            }
        }
        next = next_of(&shot_maps, &projector_maps);
    }
    (shot_maps, projector_maps)
}

fn fit_of(projector: usize, distances: &[(&Observation, f64)]) -> Fit {
    let own: Vec<_> = distances.iter().filter(|(it, _)| it.projector == projector).collect();
    if own.is_empty() {
        return Fit::default();
    }
    let mut shots: Vec<usize> = own.iter().map(|(it, _)| it.shot).collect();
    shots.sort_unstable();
    shots.dedup();
    let crossings: HashSet<[u64; 2]> = own.iter().map(|(it, _)| it.px.to_array().map(f64::to_bits)).collect();
    let mut values: Vec<f64> = own.iter().map(|(_, away)| *away).collect();
    Fit {
        n_points: own.len(),
        n_shots: shots.len(),
        n_crossings: crossings.len(),
        median_px: quantile(&mut values, 0.5),
        p95_px: quantile(&mut values, 0.95),
    }
}
