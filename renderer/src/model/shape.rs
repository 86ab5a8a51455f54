//! The shape of a mesh: what a view of the whole depends on.

use glam::DVec3;
use rayon::prelude::*;
use shared::camera::{Shape, UpAxis};

use crate::model::mesh::Mesh;

/// Triangles that are compared with the outline by their common bounds first.
const BLOCK: usize = 64;
/// A model stands on all points within this part of its size above the lowest.
const SOLE: f64 = 0.03;
/// Another axis than y points up only if the model would stand on this many times the area: scans have y up.
const CLEARLY: f64 = 2.0;

impl Mesh {
    /// Bounds, outline and likely up axis of the triangles that can be traced, in world space, without
    /// [strays](Mesh::bulk).
    ///
    /// If the file does not say what points up, the model is taken to stand on its largest supporting face: the hull of the
    /// points near the lowest.
    pub fn shape(&self) -> Shape {
        let bulk = self.bulk();
        let [min, max] = bulk.bounds.corners();
        let directions = directions();
        let height = (max - min).max_element() * SOLE;
        let sole = |&up: &UpAxis| {
            let axis = up.direction();
            let ring = directions.iter().copied().filter(|direction| direction.dot(axis) == 0.0).collect();
            Extremes::new(ring, axis, min.dot(axis) + height)
        };
        let mut all = vec![Extremes::new(directions.clone(), DVec3::ZERO, 0.0)];
        all.extend(UpAxis::POSITIVE.iter().map(sole));
        let add_block = |mut all: Vec<Extremes>, block: &[[u32; 3]]| {
            let used = block.iter().filter(|&&triangle| triangle != Self::REJECTED);
            let corners = used.map(|triangle| triangle.map(|index| self.vertices[index as usize]));
            let points = corners.filter(|&corners| bulk.holds(corners)).flatten();
            let points: Vec<_> = points.map(|point| DVec3::from(point.map(f64::from))).collect();
            all.iter_mut().for_each(|extremes| extremes.add(&points));
            all
        };
        let merge = |mut a: Vec<Extremes>, b: Vec<Extremes>| {
            a.iter_mut().zip(b).for_each(|(a, b)| a.add(&b.points().collect::<Vec<_>>()));
            a
        };
        let found = self.triangles.par_chunks(BLOCK).fold(|| all.clone(), add_block).reduce(|| all.clone(), merge);
        let areas = UpAxis::POSITIVE.iter().zip(&found[1..]).map(|(&up, sole)| (up, sole.hull_area(up.direction())));
        let [y, others @ ..] = &*areas.collect::<Vec<_>>() else { unreachable!("there are three axes") };
        let larger = others.iter().filter(|(_, area)| *area > y.1 * CLEARLY).max_by(|a, b| a.1.total_cmp(&b.1));
        let mut outline: Vec<_> = found[0].points().map(|point| point + self.origin).collect();
        outline.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)).then(a.z.total_cmp(&b.z)));
        outline.dedup();
        let up = self.up.unwrap_or(larger.unwrap_or(y).0);
        Shape { bounds: (min + self.origin, max + self.origin), outline, up }
    }
}

/// Directions at most 14° from their neighbours', those within each plane of two axes among them.
fn directions() -> Vec<DVec3> {
    let side = || -3..=3;
    let lattice = side().flat_map(|x| side().flat_map(move |y| side().map(move |z| [x, y, z])));
    let surface = lattice.filter(|point| point.iter().any(|x: &i32| x.abs() == 3));
    surface.map(|point| DVec3::from(point.map(f64::from)).normalize()).collect()
}

/// The points of a half space that lie farthest in some directions.
#[derive(Clone)]
struct Extremes {
    axis: DVec3,
    highest: f64,
    farthest: Vec<(DVec3, f64, DVec3)>,
}

impl Extremes {
    /// Of points whose coordinate along `axis` is at most `highest`.
    fn new(directions: Vec<DVec3>, axis: DVec3, highest: f64) -> Self {
        let farthest = directions.into_iter().map(|it| (it, f64::NEG_INFINITY, DVec3::ZERO)).collect();
        Self { axis, highest, farthest }
    }

    /// Adds points. Equally far ones are ordered by their coordinates, so the order of calls does not matter.
    fn add(&mut self, points: &[DVec3]) {
        let inside = |point: &&DVec3| point.dot(self.axis) <= self.highest;
        let (min, max) = points
            .iter()
            .filter(inside)
            .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(min, max), point| (min.min(*point), max.max(*point)));
        if min.x > max.x {
            return;
        }
        let (centre, half) = ((min + max) * 0.5, (max - min) * 0.5);
        // More than the dot products' rounding.
        let slack = (centre.abs() + half).element_sum() * 1e-12;
        for (direction, reach, farthest) in &mut self.farthest {
            if direction.dot(centre) + direction.abs().dot(half) + slack < *reach {
                continue;
            }
            for &point in points.iter().filter(inside) {
                let dot = direction.dot(point);
                if dot > *reach || dot == *reach && point.to_array() < farthest.to_array() {
                    (*reach, *farthest) = (dot, point);
                }
            }
        }
    }

    fn points(&self) -> impl Iterator<Item = DVec3> {
        self.farthest.iter().filter(|(_, reach, _)| reach.is_finite()).map(|&(_, _, point)| point)
    }

    /// The area of the points' hull, seen along `axis`, to which all directions are perpendicular.
    fn hull_area(&self, axis: DVec3) -> f64 {
        let right = axis.any_orthonormal_vector();
        let angle = |direction: DVec3| direction.dot(axis.cross(right)).atan2(direction.dot(right));
        let mut corners: Vec<_> = self.farthest.iter().filter(|(_, reach, _)| reach.is_finite()).collect();
        corners.sort_by(|a, b| angle(a.0).total_cmp(&angle(b.0)));
        let next = corners.iter().cycle().skip(1);
        corners.iter().zip(next).map(|(a, b)| (a.2 - corners[0].2).cross(b.2 - corners[0].2).dot(axis)).sum::<f64>()
            * 0.5
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::statue;

    /// The statue with its axes renamed: coordinate `axes[i]` becomes coordinate i.
    fn turned(axes: [usize; 3]) -> Mesh {
        let mut mesh = statue::generate(100_000, &|_| ());
        mesh.vertices.iter_mut().for_each(|vertex| *vertex = axes.map(|axis| vertex[axis]));
        mesh
    }

    #[test]
    fn a_model_stands_on_its_largest_supporting_face() {
        for (axes, up) in [([0, 1, 2], UpAxis::Y), ([2, 0, 1], UpAxis::Z), ([1, 2, 0], UpAxis::X)] {
            assert_eq!(turned(axes).shape().up, up);
        }
    }

    #[test]
    fn where_nothing_clearly_supports_a_model_y_points_up() {
        let cube = Mesh {
            vertices: (0..8u8).map(|corner| [0, 1, 2].map(|bit| f32::from(corner >> bit & 1))).collect(),
            triangles: vec![[0, 1, 2], [5, 6, 7], [3, 4, 5]],
            ..Mesh::default()
        };
        assert_eq!(cube.shape().up, UpAxis::Y);
        assert_eq!(cube.shape().outline.len(), 8);
        assert_eq!(Mesh::default().shape().up, UpAxis::Y);
    }

    #[test]
    fn no_vertex_stands_out_of_the_outline_by_much() {
        let mesh = turned([0, 1, 2]);
        let Shape { outline, .. } = mesh.shape();
        for direction in [DVec3::new(1.0, 2.0, 0.3), DVec3::new(-0.2, 0.1, 1.0), DVec3::new(-5.0, -3.0, -4.0)] {
            let reach = |point: DVec3| point.dot(direction.normalize());
            let farthest =
                |points: &mut dyn Iterator<Item = DVec3>| points.map(reach).fold(f64::NEG_INFINITY, f64::max);
            let inner = farthest(&mut outline.iter().copied());
            let outer = farthest(&mut mesh.vertices.iter().map(|vertex| DVec3::from(vertex.map(f64::from))));
            assert!((0.0..0.03).contains(&(outer - inner)), "{outer} {inner}");
        }
    }

    #[test]
    fn strays_change_neither_bounds_nor_outline_nor_axis() {
        let mut mesh = turned([2, 0, 1]);
        let shape = mesh.shape();
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend([[1e6, -1e6, 1e6], [1e6, 0.0, 1e6], [-1e6, -1e6, 0.0]]);
        mesh.triangles.insert(0, [first, first + 1, first + 2]);
        assert_eq!(mesh.shape(), shape);
    }

    #[test]
    fn the_shape_depends_on_no_order_and_on_no_rejected_triangle() {
        let mut mesh = turned([2, 0, 1]);
        let shape = mesh.shape();
        mesh.triangles.reverse();
        mesh.triangles.push(Mesh::REJECTED);
        mesh.vertices.push([f32::NAN; 3]);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        assert_eq!(pool.install(|| mesh.shape()), shape);
    }
}
