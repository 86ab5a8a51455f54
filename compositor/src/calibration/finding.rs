//! What was found of one projector, as numbers: for drawings.

use std::collections::BTreeMap;

use glam::DVec2;

use super::solve::Fit;

/// What photographs told of one projector.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Finding {
    /// How well it fits; `None` if it was not found.
    pub fit: Option<Fit>,
    /// The part of its crossings that was seen.
    pub covered: f64,
    /// How far its corners move, at most, in its pixels; `None` for meshes, and for what was not found.
    pub moved_px: Option<f64>,
    /// Crossings in its pixels, and how far from there they were seen: means over parts of its picture.
    pub misses: Vec<[DVec2; 2]>,
    /// Whether something speaks against it.
    pub has_fault: bool,
}

/// Parts of a picture, along its longer side, for which the mean miss is told.
const N_PARTS: f64 = 10.0;

/// Means of misses over parts of a picture of `size` pixels: a single crossing tells the camera's noise.
pub(super) fn means(misses: &[[DVec2; 2]], size: DVec2) -> Vec<[DVec2; 2]> {
    let side = size.max_element() / N_PARTS;
    let mut parts: BTreeMap<[i32; 2], (DVec2, DVec2, f64)> = BTreeMap::new();
    for [px, by] in misses {
        let (places, sum, n) = parts.entry((*px / side).floor().as_ivec2().to_array()).or_default();
        (*places, *sum, *n) = (*places + *px, *sum + *by, *n + 1.0);
    }
    parts.into_values().map(|(places, sum, n)| [places / n, sum / n]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn misses_of_one_part_are_one() {
        let miss = |n: u32| [DVec2::new(f64::from(n % 4) * 10.0 + 5.0, 5.0), DVec2::new(0.1, f64::from(n % 2))];
        let all: Vec<_> = (0..8).map(miss).collect();
        let of = means(&all, DVec2::new(200.0, 100.0));
        assert_eq!(of.len(), 2);
        assert!(
            (of[0][0] - DVec2::new(10.0, 5.0)).length() < 1e-9 && (of[0][1] - DVec2::new(0.1, 0.5)).length() < 1e-9
        );
        assert!(means(&[], DVec2::ONE).is_empty());
    }
}
