//! Pieces of triangles whose boxes are mostly empty, as those of long thin ones that lie askew: the pieces' boxes are smaller
//! together, so rays pass fewer.
//!
//! After Ernst and Greiner, "Early Split Clipping for Bounding Volume Hierarchies" (2007); which triangles are worth it is
//! measured as Karras and Aila do, "Fast Parallel Construction of High-Quality Bounding Volume Hierarchies" (2013).

use glam::DVec3;
use rayon::prelude::*;

use super::Bounds;

/// Most emptiness of a piece, in mean boxes; doubled until pieces are few enough. Half of it costs memory, and time on scans.
const MOST_EMPTY: f64 = 2.0;

/// Most halvings on the way from a triangle to a piece.
const MOST_HALVINGS: u32 = 16;

/// More than the rounding error of where a triangle is cut, in finest cells.
const CUT_MARGIN: f64 = 1e-6;

/// Triangles whose boxes are added up by one thread, so that sums have the same bits on any machine.
const TRIANGLES_AT_ONCE: u32 = 1 << 14;

/// The bounds of all triangles, or of their pieces, with their indices: at most so many, and one for each triangle. All is in
/// finest cells.
pub(crate) fn of_triangles(
    n_triangles: u32,
    most_pieces: u64,
    corners: impl Fn(u32) -> [DVec3; 3] + Copy + Send + Sync,
) -> impl ParallelIterator<Item = (u32, Bounds)> {
    let box_area = |triangle: u32| Polygon(corners(triangle).to_vec()).box_area();
    let sum = |block: u32| {
        let first = block * TRIANGLES_AT_ONCE;
        (first..n_triangles.min(first.saturating_add(TRIANGLES_AT_ONCE))).map(box_area).sum::<f64>()
    };
    let sums: Vec<_> = (0..n_triangles.div_ceil(TRIANGLES_AT_ONCE)).into_par_iter().map(sum).collect();
    let mut most_empty = MOST_EMPTY * sums.iter().sum::<f64>() / f64::from(n_triangles);
    let n_pieces = |most_empty: f64| {
        (0..n_triangles)
            .into_par_iter()
            .map(|triangle| pieces(corners(triangle), most_empty).count() as u64)
            .sum::<u64>()
    };
    while n_pieces(most_empty) > most_pieces.max(n_triangles.into()) {
        most_empty *= 2.0;
    }
    (0..n_triangles)
        .into_par_iter()
        .flat_map_iter(move |triangle| pieces(corners(triangle), most_empty).map(move |bounds| (triangle, bounds)))
}

/// The bounds of a triangle, or of its pieces if its emptiness is greater than `most_empty`.
fn pieces(corners: [DVec3; 3], most_empty: f64) -> impl Iterator<Item = Bounds> {
    let whole = Polygon(corners.to_vec());
    let mut pieces = Vec::new();
    let mut bounds = None;
    if whole.emptiness() > most_empty {
        whole.append_pieces(most_empty, MOST_HALVINGS, &mut pieces);
    } else {
        let [low, high] = whole.bounds();
        bounds = Some(Bounds::new(low, high));
    }
    bounds.into_iter().chain(pieces)
}

/// A triangle, or a piece of it: a convex polygon.
struct Polygon(Vec<DVec3>);

impl Polygon {
    /// The least and greatest coordinates.
    fn bounds(&self) -> [DVec3; 2] {
        let none = [DVec3::INFINITY, DVec3::NEG_INFINITY];
        self.0.iter().fold(none, |[low, high], &point| [low.min(point), high.max(point)])
    }

    /// Half of the surface of its box.
    fn box_area(&self) -> f64 {
        let [low, high] = self.bounds();
        let size = high - low;
        size.x * size.y + size.y * size.z + size.z * size.x
    }

    /// Half of the surface of its box, less twice the areas that it covers seen along the axes; at most 0 where it fills the box
    /// as well as a triangle can.
    fn emptiness(&self) -> f64 {
        let first = self.0[0];
        let across = |pair: &[DVec3]| (pair[0] - first).cross(pair[1] - first);
        let twice_covered: DVec3 = self.0[1..].windows(2).map(across).sum();
        self.box_area() - twice_covered.abs().element_sum()
    }

    /// Appends the bounds of its pieces, for which it is cut in the middle of its longest side at most `n_halvings` times.
    fn append_pieces(&self, most_empty: f64, n_halvings: u32, pieces: &mut Vec<Bounds>) {
        let [low, high] = self.bounds();
        let axis = (high - low).max_position();
        let middle = 0.5 * (low[axis] + high[axis]);
        let is_divisible = low[axis] < middle && middle < high[axis];
        if n_halvings > 0 && is_divisible && self.emptiness() > most_empty {
            for part in self.cut(axis, middle) {
                part.append_pieces(most_empty, n_halvings - 1, pieces);
            }
        } else {
            pieces.push(Bounds::new(low - CUT_MARGIN, high + CUT_MARGIN));
        }
    }

    /// The parts on both sides of a plane across an axis that cuts it.
    fn cut(&self, axis: usize, at: f64) -> [Self; 2] {
        let (mut below, mut above) = (Vec::with_capacity(8), Vec::with_capacity(8));
        for (index, &point) in self.0.iter().enumerate() {
            let next = self.0[(index + 1) % self.0.len()];
            if point[axis] <= at {
                below.push(point);
            }
            if at <= point[axis] {
                above.push(point);
            }
            if point[axis].min(next[axis]) < at && at < point[axis].max(next[axis]) {
                let mut on_plane = point.lerp(next, (at - point[axis]) / (next[axis] - point[axis]));
                on_plane[axis] = at;
                below.push(on_plane);
                above.push(on_plane);
            }
        }
        [Self(below), Self(above)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_hold_all_of_a_triangle_and_little_more() {
        let corners = [DVec3::new(1.0, 2.0, 3.0), DVec3::new(101.0, 90.0, 70.0), DVec3::new(100.0, 93.0, 71.0)];
        let whole = Polygon(corners.to_vec());
        for most_empty in [f64::INFINITY, 5000.0, 500.0, 50.0] {
            let pieces: Vec<_> = pieces(corners, most_empty).collect();
            let holds = |point: DVec3| pieces.iter().any(|bounds| bounds.holds(point));
            for k in 0..=100 {
                for l in 0..=100 - k {
                    let [a, b] = [f64::from(k) / 100.0, f64::from(l) / 100.0];
                    assert!(holds(corners[0] * a + corners[1] * b + corners[2] * (1.0 - a - b)), "{k} {l}");
                }
            }
            let area: f64 = pieces.iter().map(|bounds| f64::from(bounds.half_area())).sum();
            match pieces.len() {
                1 => assert!(most_empty > whole.emptiness()),
                n => assert!(area < whole.box_area() * 1.5 / (n as f64).sqrt(), "{n} pieces: {area}"),
            }
        }
    }

    #[test]
    fn triangles_that_fill_their_boxes_are_whole_and_pieces_are_few() {
        // Large triangles along an axis, long ones askew, and many small ones.
        let corners = |triangle: u32| {
            let at = DVec3::splat(f64::from(triangle));
            let [b, c] = match triangle {
                0..10 => [DVec3::X * 1000.0, DVec3::Y * 1000.0],
                10..100 => [DVec3::splat(1000.0), DVec3::splat(1000.0) + DVec3::X],
                _ => [DVec3::X, DVec3::Y],
            };
            [at, at + b, at + c]
        };
        for n in [0, 1, 100, 1000, 50_000] {
            let most_pieces = u64::from(n + n / 4);
            let pieces: Vec<_> = of_triangles(n, most_pieces, corners).collect();
            assert!(pieces.is_sorted_by_key(|(triangle, _)| *triangle) && pieces.len() >= n as usize);
            assert!(pieces.len() as u64 <= most_pieces);
            assert_eq!(of_triangles(n, 0, corners).count(), n as usize);
            let n_pieces = |triangle: u32| pieces.iter().filter(|(of, _)| *of == triangle).count();
            assert!((0..n.min(10)).all(|flat| n_pieces(flat) == 1));
            assert!(n < 1000 || n_pieces(10) > 1, "{n}");
        }
    }
}
