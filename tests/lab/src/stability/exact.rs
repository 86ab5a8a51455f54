//! The exact truth where all numbers are integers, triangle by triangle.

use super::{contenders::Answer, solids::Lattice};
use crate::vector::{cross, dot, sub};

pub(super) struct ExactTruth {
    /// All triangles hit, with t.
    hits: Vec<(u32, f64)>,
    nearest: f64,
}

/// Relative error of t that does not make a hit wrong.
const DEPTH_TOLERANCE: f64 = 1e-4;

/// Relative difference of t of triangles that count as equally near: their quotients are rounded once.
const SAME_DEPTH: f64 = 1e-9;

/// A ray hits a triangle if it passes no two edges on opposite sides and at least one edge at a distance; a ray in the
/// triangle's plane misses. Coordinates up to 2²⁴ are far from the limits of `i128`.
pub(super) fn truth(lattice: &Lattice, origin: [i32; 3], direction: [i32; 3]) -> ExactTruth {
    let wide = |vector: [i32; 3]| vector.map(i128::from);
    let (origin, direction) = (wide(origin), wide(direction));
    let mut hits = Vec::new();
    for (number, corners) in lattice.iter().enumerate() {
        let [a, b, c] = corners.map(|corner| sub(wide(corner), origin));
        let sides = [(a, b), (b, c), (c, a)].map(|(from, to)| dot(direction, cross(from, to)));
        let (any_left, any_right) = (sides.iter().any(|&side| side > 0), sides.iter().any(|&side| side < 0));
        if any_left == any_right {
            continue;
        }
        let normal = cross(sub(b, a), sub(c, a));
        let t = dot(normal, a) as f64 / dot(normal, direction) as f64;
        if t >= 0.0 {
            hits.push((number as u32, t));
        }
    }
    ExactTruth { nearest: nearest(&hits), hits }
}

fn nearest(hits: &[(u32, f64)]) -> f64 {
    hits.iter().fold(f64::INFINITY, |nearest, &(_, t)| nearest.min(t))
}

impl ExactTruth {
    /// The truth for the part of the ray from `t_min` to `t_max`.
    pub(super) fn within(mut self, t_min: f32, t_max: f32) -> Self {
        self.hits.retain(|&(_, t)| f64::from(t_min) <= t && t <= f64::from(t_max));
        self.nearest = nearest(&self.hits);
        self
    }

    /// Whether an answer names a nearest triangle and its t.
    pub(super) fn allows(&self, answer: Answer) -> bool {
        let Some((number, t)) = answer else { return self.hits.is_empty() };
        let is_near = |expected: f64, tolerance: f64| (t - expected).abs() <= tolerance * expected.max(1e-2);
        self.hits.iter().any(|&(other, expected)| {
            other == number && expected <= self.nearest * (1.0 + SAME_DEPTH) && is_near(expected, DEPTH_TOLERANCE)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_belong_to_triangles_and_planes_do_not() {
        let lattice = vec![[[0, 0, 5], [4, 0, 5], [0, 4, 5]], [[0, 0, 9], [4, 0, 9], [0, 4, 9]], [[1, 1, 4]; 3]];
        for (direction, hits) in [([1, 1, 5], 2), ([0, 0, 1], 2), ([4, 0, 5], 1), ([3, 3, 5], 0), ([9, 9, 5], 0)] {
            let truth = truth(&lattice, [0; 3], direction);
            assert_eq!(truth.hits.len(), hits, "{direction:?}");
            assert_eq!(truth.allows(None), hits == 0, "{direction:?}");
        }
        assert!(truth(&lattice, [0; 3], [1, 1, 5]).allows(Some((0, 1.00001))));
        for wrong in [Some((0, 1.001)), Some((1, 1.8)), Some((2, 1.0)), None] {
            assert!(!truth(&lattice, [0; 3], [1, 1, 5]).allows(wrong), "{wrong:?}");
        }
        let both = || truth(&lattice, [0; 3], [1, 1, 5]);
        assert!(both().within(1.5, 2.0).allows(Some((1, 1.8))) && both().within(0.0, 0.5).allows(None));
        assert!(!both().within(1.5, 2.0).allows(Some((0, 1.0))) && !both().within(2.0, 1.0).allows(Some((0, 1.0))));
        let in_plane = truth(&lattice, [-1, 1, 5], [1, 0, 0]);
        assert!(in_plane.allows(None) && !in_plane.allows(Some((0, 1.0))));
        let from_it = truth(&lattice, [1, 1, 5], [0, 0, 1]);
        assert!(from_it.allows(Some((0, 0.0))) && !from_it.allows(Some((1, 4.0))));
    }
}
