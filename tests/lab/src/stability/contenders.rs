//! The contenders: every method of the chart on the grid's candidates, and the grid itself.

use std::{iter::Sum, ops::AddAssign};

use glam::Vec3;
use rayon::prelude::*;
use renderer::{
    grid::Grid,
    intersect::{
        MOST_PACKETS, Packet, PacketScratch,
        ray::{Hit, Ray},
    },
};

use crate::chart::methods::Method;

/// The nearest hit of a ray: file index of the triangle, and t.
pub(super) type Answer = Option<(u32, f64)>;

/// An algorithm that finds the nearest triangle along rays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Contender {
    /// A method on all triangles of the cells along the ray, one by one.
    Rival(Method),
    /// Raywall's single rays: nearest hit and any hit.
    Single,
    /// Raywall's rays that share nothing, hundreds in a call: nearest hit and any hit.
    Batches,
    Packets,
}

impl Contender {
    pub(super) const ALL: [Self; 7] = [
        Self::Rival(Method::MollerTrumboreF32),
        Self::Rival(Method::PluckerF32),
        Self::Rival(Method::OriginEdgesF32),
        Self::Rival(Method::MollerTrumboreF64),
        Self::Single,
        Self::Batches,
        Self::Packets,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Rival(method) => method.label(),
            Self::Single => "Raywall, single rays",
            Self::Batches => "Raywall, rays in batches",
            Self::Packets => "Raywall, packets",
        }
    }

    pub(super) fn is_default(self) -> bool {
        !matches!(self, Self::Rival(_))
    }

    pub(super) fn trace(self, grid: &Grid, bundle: &RayBundle, scratch: &mut PacketScratch) -> Vec<Answer> {
        match self {
            Self::Rival(method) => {
                let file_index = |(triangle_idx, t)| (grid.mesh().file_index(triangle_idx), t);
                bundle.rays().map(|ray| nearest_candidate(grid, method, &ray).map(file_index)).collect()
            }
            Self::Single => bundle.rays().map(|ray| answer(grid, grid.intersect(&ray))).collect(),
            Self::Batches => batch(grid, &bundle.rays().collect::<Vec<_>>()),
            Self::Packets => packets(grid, bundle, bundle.directions.len().div_ceil(MOST_PACKETS), scratch),
        }
    }
}

/// The nearest triangle along each ray of a bundle, by packets of `n_rays` rays that are traced together.
fn packets(grid: &Grid, bundle: &RayBundle, n_rays: usize, scratch: &mut PacketScratch) -> Vec<Answer> {
    let packets: Vec<_> = bundle.directions.chunks(n_rays).map(|rays| packet(bundle.origin, rays)).collect();
    let mut hits = vec![[Hit::MISS; 64]; packets.len()];
    grid.intersect_packets(&packets, scratch, &mut hits);
    let of_rays = hits.iter().flat_map(|hits| &hits[..n_rays]).take(bundle.directions.len());
    of_rays.map(|&hit| answer(grid, hit)).collect()
}

/// The nearest triangle along each of many rays, in one call.
pub(super) fn batch(grid: &Grid, rays: &[Ray]) -> Vec<Answer> {
    let mut hits = vec![Hit::MISS; rays.len()];
    grid.intersect_rays(rays, &mut hits);
    hits.into_iter().map(|hit| answer(grid, hit)).collect()
}

/// Whether each of many rays hits anything, in one call.
pub(super) fn occluded(grid: &Grid, rays: &[Ray]) -> Vec<bool> {
    let mut occluded = vec![false; rays.len()];
    grid.occluded_rays(rays, &mut occluded);
    occluded
}

fn packet(origin: Vec3, rays: &[Vec3]) -> Packet {
    let ray = |lane: usize| rays[lane.min(rays.len() - 1)];
    Packet {
        origin,
        directions: [0, 1, 2].map(|axis| std::array::from_fn(|lane| ray(lane)[axis])),
        active: u64::MAX >> (64 - rays.len()),
        ..Packet::NONE
    }
}

/// The nearest of the grid's candidates along a ray, by a method: triangle index and t.
pub(super) fn nearest_candidate(grid: &Grid, method: Method, ray: &Ray) -> Option<(u32, f64)> {
    let mut nearest: Option<(u32, f64)> = None;
    grid.for_each_candidate(ray, |triangle_idx| {
        if let Some(t) = method.intersect(ray, &grid.mesh().corners(triangle_idx))
            && nearest.is_none_or(|(_, nearest_t)| t < nearest_t)
        {
            nearest = Some((triangle_idx, t));
        }
    });
    nearest
}

fn answer(grid: &Grid, hit: Hit) -> Answer {
    (!hit.is_miss()).then(|| (grid.mesh().file_index(hit.triangle), f64::from(hit.t)))
}

/// From 1 to 64 rays with a common origin, in model space.
#[derive(Clone, Debug)]
pub(super) struct RayBundle {
    pub(super) origin: Vec3,
    pub(super) directions: Vec<Vec3>,
}

impl RayBundle {
    pub(super) fn rays(&self) -> impl Iterator<Item = Ray> {
        self.directions.iter().map(|&direction| Ray::new(self.origin, direction))
    }
}

/// The number of rays, and of each contender's wrong answers.
#[derive(Clone, Debug, Default)]
pub(super) struct Tally {
    pub(super) n_rays: u64,
    /// In the order of [`Contender::ALL`]; `None` if the case does not try a contender.
    pub(super) wrong: [Option<u64>; Contender::ALL.len()],
    pub(super) first_failure: Option<String>,
}

impl Tally {
    /// Counts one answer; `what` describes a wrong one.
    pub(super) fn count(&mut self, contender: Contender, is_right: bool, what: impl FnOnce() -> String) {
        let index = Contender::ALL.iter().position(|&other| other == contender);
        let wrong = &mut self.wrong[index.expect("a contender")];
        *wrong = Some(wrong.unwrap_or(0) + u64::from(!is_right));
        if !is_right && contender.is_default() && self.first_failure.is_none() {
            self.first_failure = Some(format!("{}: {}", contender.name(), what()));
        }
    }
}

impl AddAssign for Tally {
    fn add_assign(&mut self, other: Self) {
        self.n_rays += other.n_rays;
        for (sum, wrong) in self.wrong.iter_mut().zip(other.wrong) {
            *sum = match (*sum, wrong) {
                (None, wrong) => wrong,
                (sum, None) => sum,
                (Some(sum), Some(wrong)) => Some(sum + wrong),
            };
        }
        self.first_failure = self.first_failure.take().or(other.first_failure);
    }
}

impl Sum for Tally {
    fn sum<I: Iterator<Item = Self>>(tallies: I) -> Self {
        tallies.fold(Self::default(), |mut sum, tally| {
            sum += tally;
            sum
        })
    }
}

/// Bundles whose rays form one batch.
const BUNDLES_PER_BATCH: u64 = 64;

/// Lets all contenders trace bundles 0 to `n_bundles`, on all threads. `truth` computes the right answer for a ray, and
/// `is_right` compares an answer with it.
pub(super) fn tally<T>(
    grid: &Grid,
    n_bundles: u64,
    bundle: impl Fn(u64) -> RayBundle + Sync,
    truth: impl Fn(&Ray) -> T + Sync,
    is_right: impl Fn(&Ray, &T, Answer) -> bool + Sync,
) -> Tally {
    let one = |scratch: &mut PacketScratch, first: u64| {
        let bundles: Vec<_> = (first..n_bundles.min(first + BUNDLES_PER_BATCH)).map(&bundle).collect();
        let rays: Vec<_> = bundles.iter().flat_map(RayBundle::rays).collect();
        let truths: Vec<_> = rays.iter().map(&truth).collect();
        let mut tally = Tally { n_rays: rays.len() as u64, ..Tally::default() };
        let trace = |contender: Contender, scratch: &mut PacketScratch| {
            bundles.iter().flat_map(|bundle| contender.trace(grid, bundle, scratch)).collect::<Vec<_>>()
        };
        let single = trace(Contender::Single, scratch);
        for contender in Contender::ALL {
            let (answers, agrees) = match contender {
                Contender::Rival(_) => (trace(contender, scratch), vec![true; rays.len()]),
                // Any hit must agree with the nearest hit,
                Contender::Single => {
                    let agrees = rays.iter().zip(&single).map(|(ray, answer)| grid.occluded(ray) == answer.is_some());
                    (single.clone(), agrees.collect())
                }
                // a ray in a batch with the ray alone, in any order,
                Contender::Batches => {
                    let answers = strangers_first(&bundles, &rays, |rays| batch(grid, rays));
                    let occluded = occluded(grid, &rays);
                    let agrees = answers.iter().zip(&single).zip(occluded);
                    let agrees =
                        agrees.map(|((answer, alone), occluded)| answer == alone && occluded == answer.is_some());
                    (answers.clone(), agrees.collect())
                }
                // and one packet with packets that are traced together.
                Contender::Packets => {
                    let answers = trace(contender, scratch);
                    let of_one = |bundle: &RayBundle| packets(grid, bundle, bundle.directions.len(), scratch);
                    let of_one: Vec<_> = bundles.iter().flat_map(of_one).collect();
                    let agrees = answers.iter().zip(&of_one).map(|(answer, of_one)| answer == of_one).collect();
                    (answers, agrees)
                }
            };
            for (((ray, truth), answer), agrees) in rays.iter().zip(&truths).zip(answers).zip(agrees) {
                let is_right = agrees && is_right(ray, truth, answer);
                tally.count(contender, is_right, || format!("{ray:?} is answered {answer:?}"));
            }
        }
        tally
    };
    let firsts = (0..n_bundles.div_ceil(BUNDLES_PER_BATCH)).into_par_iter().map(|index| index * BUNDLES_PER_BATCH);
    firsts.map_init(PacketScratch::default, one).sum()
}

/// Traces the rays of bundles so that neighbours come from different bundles, and returns the answers in the rays' order.
fn strangers_first(bundles: &[RayBundle], rays: &[Ray], trace: impl FnOnce(&[Ray]) -> Vec<Answer>) -> Vec<Answer> {
    let lanes = bundles.iter().flat_map(|bundle| 0..bundle.directions.len());
    let mut order: Vec<(usize, usize)> = lanes.zip(0..).collect();
    order.sort_unstable();
    let traced = trace(&order.iter().map(|&(_, index)| rays[index]).collect::<Vec<_>>());
    let mut answers = vec![None; rays.len()];
    order.into_iter().zip(traced).for_each(|((_, index), answer)| answers[index] = answer);
    answers
}
