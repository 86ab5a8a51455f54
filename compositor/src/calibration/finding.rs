//! The result of calibrating one projector, as numbers: for drawings.

use std::collections::BTreeMap;

use glam::DVec2;

use super::{fitting::median, solve::Fit};
use crate::wall::Wall;

/// A projector as photographs show it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Finding {
    /// How well it fits; `None` if it was not found.
    pub fit: Option<Fit>,
    /// The part of its crossings that was seen.
    pub covered: f64,
    /// How far its corners move, at most, in its pixels; `None` for meshes, and for what was not found.
    pub moved_px: Option<f64>,
    /// Places in its pixels, and how far from there they were seen: medians over parts of its picture.
    pub misses: Vec<[DVec2; 2]>,
    /// Whether something speaks against it.
    pub has_fault: bool,
}

/// Parts of a picture, along its longer side, for which a typical miss is told.
const N_PARTS: f64 = 10.0;

/// Typical misses over parts of a picture of `size` pixels: a single crossing tells the camera's noise.
pub(super) fn typical(misses: &[[DVec2; 2]], size: DVec2) -> Vec<[DVec2; 2]> {
    let side = size.max_element() / N_PARTS;
    let mut parts: BTreeMap<[i32; 2], Vec<[DVec2; 2]>> = BTreeMap::new();
    for miss in misses {
        parts.entry((miss[0] / side).floor().as_ivec2().to_array()).or_default().push(*miss);
    }
    let of_part = |all: Vec<[DVec2; 2]>| {
        let along = |axis: usize| median(all.iter().map(|[_, by]| by[axis]).collect());
        let place = all.iter().map(|[px, _]| *px).sum::<DVec2>() / all.len() as f64;
        [place, DVec2::new(along(0), along(1))]
    };
    parts.into_values().map(of_part).collect()
}

/// Projectors that are off by no more than this may be so by chance.
const LEAST_OFF_PX: f64 = 0.02;

/// The number of projectors that are off by more than so many pixels throughout, and the name of the worst with its distance:
/// single crossings tell noise, and parts of a picture what all of their crossings have in common.
pub(super) fn off_throughout<'a>(
    names: &[&'a str],
    findings: &[&Finding],
    more_than_px: f64,
) -> Option<(usize, &'a str, f64)> {
    let off_px = |finding: &Finding| median(finding.misses.iter().map(|[_, by]| by.length()).collect());
    let off: Vec<(&str, f64)> = std::iter::zip(names, findings)
        .filter(|(_, finding)| !finding.misses.is_empty())
        .map(|(name, finding)| (*name, off_px(finding)))
        .filter(|(_, off_px)| *off_px > more_than_px)
        .collect();
    let (worst, worst_px) = off.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1))?;
    Some((off.len(), worst, worst_px))
}

/// A line if projectors are off throughout by more than noise: so little fits with the allowed distances, but seams between
/// projectors may be several times as wide.
pub(super) fn off_remark(wall: &Wall, findings: &[Finding], noise_px: f64) -> Option<String> {
    let names: Vec<&str> = wall.projectors().iter().map(|projector| projector.name.as_str()).collect();
    let (_, worst, by_px) = off_throughout(&names, &findings.iter().collect::<Vec<_>>(), noise_px.max(LEAST_OFF_PX))?;
    let shape = if wall.surface().is_none() { "quite flat" } else { "quite of the shape that [surface] says" };
    Some(format!(
        "\"{worst}\" is off by {by_px:.2} pixels throughout, where the noise of crossings is {noise_px:.2}, and seams may be \
         several times as wide: the wall is not {shape}, a projector's lens bends, or photographs were stretched: take some \
         from other places, and leave them as the camera made them"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn misses_of_one_part_are_one_and_strays_do_not_count() {
        let miss = |n: u32| {
            let px = DVec2::new(f64::from(n % 2) * 20.0 + 5.0, 5.0);
            [px, if n > 7 { DVec2::new(50.0, -50.0) } else { DVec2::new(0.1, 0.2) }]
        };
        let all: Vec<_> = (0..10).map(miss).collect();
        let of = typical(&all, DVec2::new(200.0, 100.0));
        assert_eq!(of, [[DVec2::new(5.0, 5.0), DVec2::new(0.1, 0.2)], [DVec2::new(25.0, 5.0), DVec2::new(0.1, 0.2)]]);
        assert!(typical(&[], DVec2::ONE).is_empty());
    }
}
