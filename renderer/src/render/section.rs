//! Ways along the surface: from one point to another in a plane across it, as a tape measure is laid.
//!
//! The plane cuts each triangle that it crosses in a line, whose ends lie on edges of the triangle; triangles that share an edge
//! share its point, bit for bit. The shortest way over these lines is Dijkstra's, "A Note on Two Problems in Connexion with
//! Graphs" (1959).

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap},
};

use glam::{DVec3, Vec3};
use shared::marks::SurfaceWay;

use crate::{grid::traced::TracedMesh, render::scene::Scene};

/// More triangles are crossed only where a plane lies in the surface: of a model of a billion, a section has some 100,000.
const MOST_LINES: usize = 1 << 22;

/// Points lie this near to a line of the section, as a part of the model's diagonal: those of pictures are rounded.
const NEAR: f64 = 1e-4;

/// Bits of the coordinates of an edge's ends, the smaller first.
type Edge = [[u32; 3]; 2];

/// The line in which the plane cuts a triangle: its ends by number.
type Line = [u32; 2];

impl Scene {
    /// The shortest way between two points of the surface (world space) in the plane that they span with the direction `across`;
    /// `None` if there is no such plane, if a point lies beside the surface, or if no way leads there.
    pub fn way(&self, ends: [DVec3; 2], across: DVec3) -> Option<SurfaceWay> {
        let mesh = self.mesh();
        let ends = ends.map(|end| end - mesh.origin());
        let normal = (ends[1] - ends[0]).cross(across).try_normalize()?;
        let section = Section::cut(mesh, ends[0], normal)?;
        let [min, max] = mesh.bulk_bounds().corners();
        let points = section.way(ends, NEAR * (max - min).length())?;
        let length = points.array_windows().map(|[a, b]| a.distance(*b)).sum();
        let n_kept = points.len().min(SurfaceWay::MOST_POINTS);
        let kept = |index: usize| mesh.origin() + points[index * (points.len() - 1) / (n_kept - 1)];
        Some(SurfaceWay { length, points: (0..n_kept).map(kept).collect() })
    }
}

/// The lines in which a plane cuts a surface.
#[derive(Default)]
struct Section {
    /// In model space.
    points: Vec<DVec3>,
    lines: Vec<Line>,
}

impl Section {
    /// Cuts a mesh by a plane; `None` if it crosses too many triangles.
    fn cut(mesh: &TracedMesh, origin: DVec3, normal: DVec3) -> Option<Self> {
        let height = |corner: Vec3| normal.dot(corner.as_dvec3() - origin);
        let (mut section, mut numbers) = (Self::default(), HashMap::<Edge, u32>::new());
        for triangle in 0..mesh.n_triangles() as u32 {
            let corners = mesh.corners(triangle).map(Vec3::from_array);
            let is_above = corners.map(|corner| height(corner) >= 0.0);
            if is_above == [is_above[0]; 3] {
                continue;
            }
            if section.lines.len() == MOST_LINES {
                return None;
            }
            let mut of_edge = |[a, b]: [Vec3; 2]| {
                // The same arithmetic for all triangles at the edge.
                let [a, b] = if bits(a) <= bits(b) { [a, b] } else { [b, a] };
                *numbers.entry([bits(a), bits(b)]).or_insert_with(|| {
                    let part = height(a) / (height(a) - height(b));
                    section.points.push(a.as_dvec3().lerp(b.as_dvec3(), part));
                    section.points.len() as u32 - 1
                })
            };
            let sides = [0, 1, 2].map(|corner| [corner, (corner + 1) % 3]);
            let mut crossed = sides.into_iter().filter(|&[from, to]| is_above[from] != is_above[to]);
            let mut next = || crossed.next().map(|side| of_edge(side.map(|corner| corners[corner])));
            if let (Some(from), Some(to)) = (next(), next()) {
                section.lines.push([from, to]);
            }
        }
        Some(section)
    }

    /// The points of the shortest way between two points that lie within `near` of a line.
    fn way(&self, ends: [DVec3; 2], near: f64) -> Option<Vec<DVec3>> {
        let distance = |line: &Line, point: DVec3| {
            let [a, b] = line.map(|number| self.points[number as usize]);
            let along = b - a;
            let part = ((point - a).dot(along) / along.length_squared()).clamp(0.0, 1.0);
            point.distance(if part.is_nan() { a } else { a + along * part })
        };
        let line_at = |point: DVec3| {
            let nearest = self.lines.iter().min_by(|a, b| distance(a, point).total_cmp(&distance(b, point)))?;
            (distance(nearest, point) <= near).then_some(*nearest)
        };
        let [start, end] = [line_at(ends[0])?, line_at(ends[1])?];
        if start == end {
            return Some(ends.to_vec());
        }
        let mut neighbours = vec![Vec::new(); self.points.len()];
        for &[from, to] in &self.lines {
            neighbours[from as usize].push(to);
            neighbours[to as usize].push(from);
        }
        let point = |number: u32| self.points[number as usize];
        // The length of the shortest way to a point that is known, and the point before it.
        let mut known = vec![(f64::INFINITY, u32::MAX); self.points.len()];
        let mut queue = BinaryHeap::new();
        let reach = |known: &mut Vec<(f64, u32)>, queue: &mut BinaryHeap<_>, number: u32, length: f64, before: u32| {
            if length < known[number as usize].0 {
                known[number as usize] = (length, before);
                // Lengths are positive, so their bits have their order.
                queue.push(Reverse((length.to_bits(), number)));
            }
        };
        for number in start {
            reach(&mut known, &mut queue, number, ends[0].distance(point(number)), u32::MAX);
        }
        while let Some(Reverse((length, number))) = queue.pop() {
            let length = f64::from_bits(length);
            if length > known[number as usize].0 {
                continue;
            }
            for &next in &neighbours[number as usize] {
                reach(&mut known, &mut queue, next, length + point(number).distance(point(next)), number);
            }
        }
        let whole = |number: u32| known[number as usize].0 + point(number).distance(ends[1]);
        let last = end.into_iter().min_by(|&a, &b| whole(a).total_cmp(&whole(b)))?;
        if !whole(last).is_finite() {
            return None;
        }
        let before = |&number: &u32| Some(known[number as usize].1).filter(|&before| before != u32::MAX);
        let mut way: Vec<_> = std::iter::successors(Some(last), before).map(point).collect();
        way.push(ends[0]);
        way.reverse();
        way.push(ends[1]);
        Some(way)
    }
}

/// The coordinates of a point as bits, which tell those of two edges apart; both zeros are one.
fn bits(point: Vec3) -> [u32; 3] {
    (point + Vec3::ZERO).to_array().map(f32::to_bits)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::{grid::GridOptions, model::mesh::Mesh};

    fn build(mesh: Mesh) -> Scene {
        Scene::build(mesh, &GridOptions::default(), &|_| ())
    }

    /// A tube of radius 1 along z, of so many flat sides and rows, with a slit where it begins; corners are not shared.
    fn tube(n_sides: u32, n_rows: u32) -> Mesh {
        let mut mesh = Mesh::default();
        let point = |side: u32, row: u32| {
            let (sin, cos) = (2.0 * PI * f64::from(side) / f64::from(n_sides)).sin_cos();
            [cos as f32, sin as f32, row as f32]
        };
        for (side, row) in (0..n_sides - 1).flat_map(|side| (0..n_rows).map(move |row| (side, row))) {
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend(
                [[side, row], [side + 1, row], [side + 1, row + 1], [side, row + 1]]
                    .map(|[side, row]| point(side, row)),
            );
            mesh.triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        }
        mesh
    }

    fn on_tube(n_sides: u32, side: f64, z: f64) -> DVec3 {
        let at = |side: f64| {
            let (sin, cos) = (2.0 * PI * side / f64::from(n_sides)).sin_cos();
            DVec3::new(cos, sin, z)
        };
        at(side.floor()).lerp(at(side.ceil()), side.fract())
    }

    #[test]
    fn a_way_round_a_tube_has_the_length_of_its_sides() {
        let n_sides = 64;
        let scene = build(tube(n_sides, 8));
        let side = 2.0 * (PI / f64::from(n_sides)).sin();
        // Across the tube, at one height.
        for (from, to) in [(2.0, 18.0), (2.25, 10.5), (5.25, 5.75), (60.5, 3.5)] {
            let ends = [from, to].map(|at| on_tube(n_sides, at, 3.3));
            let way = scene.way(ends, ends[0] + ends[1] + DVec3::X * 1e-3 - DVec3::Z * (2.0 * 3.3)).unwrap();
            // The slit lets nothing pass.
            let expected: f64 = side * f64::abs(to - from);
            assert!((way.length - expected).abs() < 1e-6, "{from} to {to}: {} is not {expected}", way.length);
            assert_eq!([way.points[0], way.points[way.points.len() - 1]], ends);
            assert!(way.points.len() <= SurfaceWay::MOST_POINTS);
        }
        // Along the tube a way is straight.
        let ends = [1.5, 6.5].map(|z| on_tube(n_sides, 7.0, z));
        let way = scene.way(ends, ends[0] - DVec3::Z * 1.5).unwrap();
        assert!((way.length - 5.0).abs() < 1e-6, "{}", way.length);
    }

    #[test]
    fn a_way_over_a_fold_follows_the_fold() {
        // Two squares at a right angle, on a map grid.
        let origin = DVec3::new(512_345.0, 5_412_345.0, 64.0);
        let mesh = Mesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [2.0, 0.0, 0.0],
                [2.0, 2.0, 0.0],
                [0.0, 2.0, 0.0],
                [2.0, 0.0, -2.0],
                [2.0, 2.0, -2.0],
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]],
            origin,
            ..Mesh::default()
        };
        let scene = build(mesh);
        let ends = [DVec3::new(1.0, 0.5, 0.0), DVec3::new(2.0, 0.5, -1.5)].map(|end| origin + end);
        let way = scene.way(ends, DVec3::new(1.0, 0.0, 1.0)).unwrap();
        assert!((way.length - 2.5).abs() < 1e-9, "{way:?}");
        assert!(way.points.iter().any(|point| point.distance(origin + DVec3::new(2.0, 0.5, 0.0)) < 1e-9), "{way:?}");
        // Oblique: half of the plane's way lies in each square.
        let ends = [DVec3::new(1.0, 0.2, 0.0), DVec3::new(2.0, 1.4, -1.0)].map(|end| origin + end);
        let way = scene.way(ends, DVec3::new(1.0, 0.0, 1.0)).unwrap();
        let expected = 2.0 * f64::hypot(1.0, 0.6);
        assert!((way.length - expected).abs() < 1e-9, "{way:?}");
    }

    #[test]
    fn where_no_way_leads_there_is_none() {
        let scene = build(tube(64, 2));
        let on = |side: f64| on_tube(64, side, 0.7);
        let across = DVec3::new(0.1, 0.2, 0.0);
        assert!(scene.way([on(3.5), on(9.5)], across).is_some());
        // Beside the surface, without a plane, and no numbers at all.
        assert_eq!(scene.way([on(3.5), DVec3::ZERO], DVec3::X), None);
        assert_eq!(scene.way([on(3.5), on(3.5)], across), None);
        assert_eq!(scene.way([on(3.5), on(9.5)], on(3.5) - on(9.5)), None);
        for bad in [f64::NAN, f64::INFINITY, 1e300] {
            assert_eq!(scene.way([on(3.5), DVec3::splat(bad)], DVec3::X), None);
            assert_eq!(scene.way([on(3.5), on(9.5)], DVec3::splat(bad)).filter(|way| !way.length.is_finite()), None);
        }
        // Two tubes that do not touch.
        let mut mesh = tube(64, 2);
        let n_vertices = mesh.vertices.len() as u32;
        let second: Vec<_> = mesh.vertices.iter().map(|&[x, y, z]| [x + 3.0, y, z]).collect();
        mesh.vertices.extend(second);
        let second: Vec<_> = mesh.triangles.iter().map(|triangle| triangle.map(|corner| corner + n_vertices)).collect();
        mesh.triangles.extend(second);
        assert_eq!(build(mesh).way([on(16.0), on(16.0) + DVec3::X * 3.0], DVec3::Y), None);
        assert_eq!(build(Mesh::default()).way([DVec3::X, DVec3::Y], DVec3::Z), None);
    }
}
