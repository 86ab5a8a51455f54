//! The built-in model: a closed, indexed mesh of a weathered stone figure, with any number of triangles.
//!
//! The mesh is the surface of a box, `n` cells around each of its four sides and `m` up, mapped to rays that leave the
//! figure's axis in all directions without crossing; each vertex lies as far out on its ray as the [`sculpture`] has stone along it.
//!
//! The bits are the same on every machine and for any number of threads: each vertex depends on itself alone, and uses only
//! + − × ÷ √, comparisons and integers, never functions whose last bits differ between platforms.

mod noise;
mod sculpture;

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use crate::model::mesh::Mesh;

/// Enough for a good picture, and generated within a second.
pub const DEFAULT_TRIANGLES: u32 = 1_000_000;

/// A box with one cell on each of its sides.
pub const FEWEST_TRIANGLES: u32 = 12;

/// Takes 18 GB.
pub const MOST_TRIANGLES: u32 = 1_000_000_000;

/// Generates the statue with about `triangles` triangles, clamped to [`FEWEST_TRIANGLES`] and [`MOST_TRIANGLES`].
///
/// The actual number is 4·n·(2m + n) for integers n and m: the nearest to `triangles` among cells of good shape, within
/// 0.2 % beyond 10,000, and exact for a million.
/// World space: y up, the face towards +z, the base around the origin, 3.7 high.
/// `progress` receives the fraction done, 0 to 1.
pub fn generate(triangles: u32, progress: &(dyn Fn(f32) + Sync)) -> Mesh {
    let cells = BoxCells::nearest(triangles.clamp(FEWEST_TRIANGLES, MOST_TRIANGLES));
    let n_vertices = cells.n_vertices();

    let n_done = AtomicUsize::new(0);
    let mut vertices = vec![[0.0; 3]; n_vertices];
    vertices.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, positions)| {
        for (i, position) in positions.iter_mut().enumerate() {
            *position = sculpture::surface(cells.box_point(chunk * CHUNK + i));
        }
        let done = n_done.fetch_add(positions.len(), Ordering::Relaxed) + positions.len();
        progress(done as f32 / n_vertices as f32);
    });

    let mut triangles = vec![[0; 3]; 2 * cells.n_quads()];
    triangles.par_chunks_exact_mut(2).enumerate().for_each(|(quad, pair)| {
        let [a, b, c, d] = cells.quad(quad);
        let length2 = |from: u32, to: u32| {
            let (p, q) = (vertices[from as usize], vertices[to as usize]);
            (0..3).map(|axis| (p[axis] - q[axis]) * (p[axis] - q[axis])).sum::<f32>()
        };
        // Split along the shorter diagonal: fewer slivers where rays graze the surface.
        let split = if length2(a, c) <= length2(b, d) { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] };
        pair.copy_from_slice(&split);
    });
    Mesh { vertices, triangles, ..Mesh::default() }
}

/// Vertices computed between two reports of progress.
const CHUNK: usize = 4096;

/// A vertex's position on the surface of the box.
#[derive(Clone, Copy, Debug, PartialEq)]
enum BoxPoint {
    /// On a side or its edges: a point of the square's outline, −1 to 1, and a height, 0 to 1.
    Side([f32; 2], f32),
    Top([f32; 2]),
    Bottom([f32; 2]),
}

/// The cells of the box: `n`×`n` on top and bottom, `n`×`m` on each side.
///
/// Vertices in order: `m + 1` rings of 4n from the bottom upwards, the inside of the bottom, the inside of the top.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct BoxCells {
    n: usize,
    m: usize,
}

impl BoxCells {
    fn nearest(triangles: u32) -> Self {
        let square_cells = |n: usize| {
            let rows = (f64::from(triangles) / (4 * n) as f64 - n as f64) / 2.0;
            Self { n, m: (rows.round() as usize).max(1) }
        };
        // With m = 2.6 n, 4·n·(2m + n) = 24.8 n²; cells keep a good shape for n a quarter larger or a fifth smaller.
        let middle = (f64::from(triangles) / 24.8).sqrt();
        let [low, high] = [0.8, 1.25].map(|factor| ((middle * factor).round() as usize).max(1));
        (low..=high)
            .map(square_cells)
            .min_by_key(|cells| {
                ((2 * cells.n_quads()).abs_diff(triangles as usize), cells.n.abs_diff(middle.round() as usize))
            })
            .unwrap_or(Self { n: 1, m: 1 })
    }

    fn n_vertices(self) -> usize {
        self.n_ring_vertices() + 2 * (self.n - 1) * (self.n - 1)
    }

    fn n_ring_vertices(self) -> usize {
        4 * self.n * (self.m + 1)
    }

    fn n_quads(self) -> usize {
        4 * self.n * self.m + 2 * self.n * self.n
    }

    fn box_point(self, vertex: usize) -> BoxPoint {
        let Self { n, m } = self;
        let on_square = |[i, j]: [usize; 2]| [i, j].map(|k| (2 * k) as f32 / n as f32 - 1.0);
        let inside = |k: usize| on_square([1 + k / (n - 1), 1 + k % (n - 1)]);
        let n_inside = (n - 1) * (n - 1);
        match vertex.checked_sub(self.n_ring_vertices()) {
            None => BoxPoint::Side(on_square(self.outline(vertex % (4 * n))), (vertex / (4 * n)) as f32 / m as f32),
            Some(k) if k < n_inside => BoxPoint::Bottom(inside(k)),
            Some(k) => BoxPoint::Top(inside(k - n_inside)),
        }
    }

    /// The k-th point on the outline of the square, with coordinates 0 to n.
    fn outline(self, k: usize) -> [usize; 2] {
        let n = self.n;
        match (k / n, k % n) {
            (0, r) => [r, 0],
            (1, r) => [n, r],
            (2, r) => [n - r, n],
            (_, r) => [0, n - r],
        }
    }

    /// The vertex at a point of the bottom (`ring` 0) or top (`ring` m).
    fn cap_vertex(self, ring: usize, [i, j]: [usize; 2]) -> u32 {
        let Self { n, m } = self;
        let around = match [i, j] {
            [i, 0] => i,
            [i, j] if i == n => n + j,
            [i, j] if j == n => 3 * n - i,
            [0, j] => 4 * n - j,
            [i, j] => {
                let first = self.n_ring_vertices() + if ring == m { (n - 1) * (n - 1) } else { 0 };
                return (first + (i - 1) * (n - 1) + j - 1) as u32;
            }
        };
        (ring * 4 * n + around) as u32
    }

    /// The corners of a quad, counter-clockwise seen from outside.
    fn quad(self, quad: usize) -> [u32; 4] {
        let Self { n, m } = self;
        if let Some(quad) = quad.checked_sub(4 * n * m) {
            let (ring, cell) = if quad < n * n { (0, quad) } else { (m, quad - n * n) };
            let (i, j) = (cell / n, cell % n);
            let corners = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]].map(|at| self.cap_vertex(ring, at));
            return if ring == 0 { corners } else { [corners[0], corners[3], corners[2], corners[1]] };
        }
        let (row, k) = (quad / (4 * n), quad % (4 * n));
        let next = (k + 1) % (4 * n);
        [(row, k), (row + 1, k), (row + 1, next), (row, next)].map(|(ring, k)| (ring * 4 * n + k) as u32)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    #[test]
    fn every_edge_has_a_triangle_on_either_side() {
        for triangles in [0, 12, 13, 50, 333, 20_000] {
            let mesh = generate(triangles, &|_| ());
            let mut edges = HashMap::new();
            for &[a, b, c] in &mesh.triangles {
                for (from, to) in [(a, b), (b, c), (c, a)] {
                    assert_eq!(edges.insert((from, to), ()), None, "an edge is used twice in one direction");
                }
            }
            assert!(edges.keys().all(|&(from, to)| edges.contains_key(&(to, from))));
            // Euler's formula for a sphere: nothing is left over, nothing is torn.
            assert_eq!(mesh.vertices.len() + mesh.triangles.len(), edges.len() / 2 + 2);
            assert!(mesh.triangles.as_flattened().iter().all(|&index| (index as usize) < mesh.vertices.len()));
        }
    }

    #[test]
    fn triangles_face_outwards() {
        let mesh = generate(20_000, &|_| ());
        let volume: f64 = (0..mesh.triangles.len())
            .map(|i| {
                let [a, b, c] = mesh.corners(i).unwrap().map(|corner| glam::DVec3::from(corner.map(f64::from)));
                a.dot(b.cross(c)) / 6.0
            })
            .sum();
        assert!((2.0..8.0).contains(&volume), "{volume}");
    }

    #[test]
    fn the_number_of_triangles_is_near_what_was_asked() {
        for asked in [20_000, 100_000, 1_000_000, 10_000_000, 77_777_777, MOST_TRIANGLES] {
            let made = 2 * BoxCells::nearest(asked).n_quads();
            assert!(made.abs_diff(asked as usize) <= asked as usize / 500, "{asked}: {made}");
        }
        assert_eq!(2 * BoxCells::nearest(DEFAULT_TRIANGLES).n_quads(), 1_000_000);
    }

    #[test]
    fn triangles_lie_where_they_are_expected() {
        let mesh = generate(20_000, &|_| ());
        let bounds = mesh.bounds();
        assert!(bounds.min[1].abs() < 0.1 && (3.5..3.8).contains(&bounds.max[1]), "{bounds:?}");
        assert!(mesh.vertices.iter().all(|&position| Mesh::is_usable(position)));
    }

    #[test]
    fn the_bits_are_the_same_on_every_machine() {
        // A change of the figure changes this hash.
        let mesh = generate(20_000, &|_| ());
        let bytes: Vec<u8> = mesh.vertices.as_flattened().iter().flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(&blake3::hash(&bytes).to_hex()[..16], "8caa4753d10c6b6b");
    }

    #[test]
    fn any_number_of_threads_makes_the_same_bits() {
        let with = |n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            pool.install(|| generate(20_000, &|_| ()))
        };
        assert_eq!(with(1), with(3));
    }
}
