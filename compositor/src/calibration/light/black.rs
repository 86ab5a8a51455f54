//! The light of projectors' black, from the steps that it makes in dark squares of their neighbours.
//!
//! A dark square has the light of the room and of its own projector's black, and what scatters from bright squares: all
//! vary slowly within a field. The black of another projector begins at that one's edge, so its step there tells it.

use glam::{DMat3, DVec2};

use super::{
    arrow::{Arrow, robust_weights},
    field::{Basis, Fields},
    ink::Ink,
    levels::{Lit, place},
    response::white_terms,
};
use crate::wall::{Projector, Wall, homography::apply};

/// The light of a projector's black, as a part of the light of its white; `None` if no neighbour's square tells it.
pub(super) type Blacks = Vec<Option<f64>>;

/// Blacks are told at least this well, as a part of white.
const LARGEST_DEVIATION: f64 = 0.002;
/// Blacks are about as large, with this deviation, unless squares tell.
const USUAL: [f64; 2] = [0.002, 0.02];
/// Squares so near to another projector's edge, in its sides, lie partly within: they tell no black.
const EDGE: f64 = 0.015;
/// Terms of what varies slowly within a field.
const N_TERMS: usize = 6;
/// Rounds of weighing anew.
const N_ROUNDS: usize = 5;

/// Where projectors' pixels land on one another.
pub(super) struct Overlaps<'a> {
    projectors: &'a [Projector],
    /// For each: from its image to its pixels as stored, and as seen on the wall.
    maps: Vec<Option<[DMat3; 2]>>,
}

impl<'a> Overlaps<'a> {
    pub(super) fn new(wall: &'a Wall) -> Self {
        let maps = |projector: &Projector| {
            let upright = projector.upright_from_image()?;
            Some([projector.raster_from_upright() * upright, upright])
        };
        Self { projectors: wall.projectors(), maps: wall.projectors().iter().map(maps).collect() }
    }

    /// The other projectors that light a place of a projector's pixels.
    fn others(&self, index: usize, raster: DVec2) -> Option<Vec<Other>> {
        let own = &self.projectors[index];
        let image = apply(self.maps[index]?[0].inverse(), raster)?;
        let canvas = own.canvas.canvas_from_rect(own.rect_at(image));
        let mut others = Vec::new();
        for (other_idx, other) in self.projectors.iter().enumerate().filter(|(other_idx, _)| *other_idx != index) {
            let rect_point = other.canvas.rect_from_canvas(canvas);
            // Beyond a mesh there is no image.
            let is_near = (rect_point - 0.5).abs().max_element() <= if other.mesh.is_some() { 0.5 } else { 1.0 };
            let upright =
                self.maps[other_idx].filter(|_| is_near).and_then(|maps| apply(maps[1], other.image_at(rect_point)));
            let Some(upright) = upright else { continue };
            let inside = upright.min(1.0 - upright).min_element();
            let part = (0.5 + 0.5 * inside / EDGE).clamp(0.0, 1.0);
            if part > 0.0 {
                others.push(Other { projector: other_idx, upright: upright.clamp(DVec2::ZERO, DVec2::ONE), part });
            }
        }
        Some(others)
    }
}

/// Another projector that lights a place.
struct Other {
    projector: usize,
    /// The place in its pixels as seen on the wall.
    upright: DVec2,
    /// The part of a square there that it lights: less than 1 near its edge.
    part: f64,
}

/// The light that other projectors' black adds to each square.
pub(super) fn foreign(
    overlaps: &Overlaps<'_>,
    lits: &[Lit],
    fields: &Fields,
    camera_of: &[usize],
    blacks: &Blacks,
) -> Vec<[f64; 3]> {
    let basis = Basis::new();
    let foreign = |it: &Lit| {
        let others = overlaps.others(it.projector, it.raster).unwrap_or_default();
        std::array::from_fn(|channel| {
            let of = |other: &Other| {
                let white = fields.white(other.projector, channel, other.upright, &basis);
                blacks[other.projector].map_or(0.0, |black| black * other.part * white)
            };
            others.iter().map(of).sum::<f64>() * fields.seen(it.shot, camera_of[it.shot], channel, it.at)
        })
    };
    lits.iter().map(foreign).collect()
}

/// Finds blacks from dark squares; `camera_of` tells the camera of a shot.
pub(super) fn solve(
    overlaps: &Overlaps<'_>,
    lits: &[Lit],
    fields: &Fields,
    camera_of: &[usize],
    is_solved: &[bool],
) -> Blacks {
    struct Dark {
        block: usize,
        place: DVec2,
        /// The light that others' white would give.
        others: Vec<(usize, f64)>,
        light: f64,
        error: f64,
    }
    let n_projectors = is_solved.len();
    let basis = Basis::new();
    let mut groups: Vec<(usize, usize)> = lits.iter().map(|it| (it.shot, it.projector)).collect();
    groups.sort_unstable();
    groups.dedup();
    let mut darks = Vec::new();
    for it in lits.iter().filter(|it| it.ink == Ink::Grey(0) && is_solved[it.projector]) {
        let Some(others) = overlaps.others(it.projector, it.raster) else { continue };
        if others.iter().any(|other| !is_solved[other.projector] || other.part < 1.0) {
            continue;
        }
        let group = groups.binary_search(&(it.shot, it.projector)).unwrap_or_default();
        for channel in 0..3 {
            let Some([light, slope]) = it.light[channel] else { continue };
            let seen = fields.seen(it.shot, camera_of[it.shot], channel, it.at);
            let white = |it: &Other| (it.projector, fields.white(it.projector, channel, it.upright, &basis));
            let others = others.iter().map(white).collect();
            let block = 3 * group + channel;
            darks.push(Dark { block, place: place(it.raster), others, light: light / seen, error: slope / seen });
        }
    }
    let mut weights = vec![1.0; darks.len()];
    let mut sigma = 0.01;
    let mut found = None;
    for _ in 0..N_ROUNDS {
        let mut arrow = Arrow::new(3 * groups.len(), N_TERMS, n_projectors);
        // Room light and the own black, behind a lens that may darken the edges of photographs.
        let row = |it: &Dark| -> [(usize, f64); N_TERMS] {
            let terms = white_terms(it.place);
            std::array::from_fn(|n| (n, terms[n]))
        };
        for (it, weight) in darks.iter().zip(&weights) {
            arrow.add(it.block, &row(it), &it.others, it.light, weight / (it.error * it.error));
        }
        for block in 0..3 * groups.len() {
            (0..N_TERMS).for_each(|term| arrow.add(block, &[(term, 1.0)], &[], 0.0, 1e-6));
        }
        for index in 0..n_projectors {
            arrow.add_shared(&[(index, 1.0)], USUAL[0], (sigma / USUAL[1]).powi(2).max(1e-9));
        }
        let Some(solved) = arrow.solve() else { break };
        let away = |it: &Dark| {
            let sum = |row: &[(usize, f64)], of: &[f64]| row.iter().map(|(n, factor)| factor * of[*n]).sum::<f64>();
            (it.light - sum(&row(it), &solved.local[it.block]) - sum(&it.others, &solved.shared)) / it.error
        };
        let errors: Vec<f64> = darks.iter().map(away).collect();
        (weights, sigma) = robust_weights(&errors);
        found = Some(solved);
    }
    let black = |index: usize| {
        let solved = found.as_ref()?;
        let is_told = sigma * solved.deviation(&[(index, 1.0)]) <= LARGEST_DEVIATION;
        is_told.then(|| solved.shared[index].max(0.0))
    };
    (0..n_projectors).map(black).collect()
}
