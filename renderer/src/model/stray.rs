//! Stray triangles: a few that reach far beyond all others, as false points of a scanner do.

use glam::DVec3;
use rayon::prelude::*;
use shared::printable::counted;

use crate::model::mesh::{Aabb, Mesh};

/// The triangles of a mesh without its strays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bulk {
    /// Their bounds, in model space.
    pub bounds: Aabb,
    /// Number of strays.
    pub n_strays: usize,
    /// The farthest that a stray reaches from the middle of the bulk, in world units; 0 without strays.
    pub farthest: f64,
    /// A triangle with a corner outside is a stray.
    limits: [DVec3; 2],
}

/// Triangles by which quartiles are estimated.
const SAMPLED: usize = 1 << 16;

/// A stray reaches this many times the largest distance of two quartiles from the middle: five times the size of an even mesh.
const REACH: f64 = 10.0;

/// Strays are at most this many, and one more for each thousand triangles; if there are more, they belong to the model.
const FEW: usize = 8;

impl Mesh {
    /// Tells a few triangles that reach far beyond all others from these.
    pub fn bulk(&self) -> Bulk {
        let bounds = self.bounds();
        let everything = Bulk { bounds, n_strays: 0, farthest: 0.0, limits: bounds.corners() };
        let [min, max] = bounds.corners();
        let limits = self.limits();
        if min.cmpge(limits[0]).all() && max.cmple(limits[1]).all() {
            return everything;
        }
        let all = Bulk { bounds: Aabb::EMPTY, limits, ..everything };
        let add = |mut bulk: Bulk, triangle: usize| {
            let Some(corners) = self.corners(triangle) else { return bulk };
            if bulk.holds(corners) {
                bulk.bounds = corners.into_iter().fold(bulk.bounds, Aabb::extend);
            } else {
                bulk.n_strays += 1;
            }
            bulk
        };
        let merge =
            |a: Bulk, b: Bulk| Bulk { bounds: a.bounds.union(b.bounds), n_strays: a.n_strays + b.n_strays, ..a };
        let bulk = (0..self.triangles.len()).into_par_iter().fold(|| all, add).reduce(|| all, merge);
        let n_triangles = self.triangles.len() - self.n_rejected;
        if bulk.n_strays > (FEW + n_triangles / 1000).min(n_triangles / 4) {
            return everything;
        }
        let [low, high] = bulk.bounds.corners();
        let middle = (low + high) * 0.5;
        Bulk { farthest: (max - middle).max(middle - min).max_element(), ..bulk }
    }

    /// Lowest and highest corner of the box that holds all but strays; infinite if there is no telling.
    fn limits(&self) -> [DVec3; 2] {
        let step = self.triangles.len().div_ceil(SAMPLED).max(1);
        let corners = (0..self.triangles.len()).step_by(step).filter_map(|triangle| self.corners(triangle));
        let centres: Vec<_> = corners.map(|corners| corners.map(to_f64).into_iter().sum::<DVec3>() / 3.0).collect();
        let quartile = |axis: usize, quarter: usize| {
            let mut coordinates: Vec<_> = centres.iter().map(|centre| centre[axis]).collect();
            let rank = coordinates.len() * quarter / 4;
            *coordinates.select_nth_unstable_by(rank, f64::total_cmp).1
        };
        if centres.is_empty() {
            return [DVec3::NEG_INFINITY, DVec3::INFINITY];
        }
        let [low, high] = [1, 3].map(|quarter| DVec3::from([0, 1, 2].map(|axis| quartile(axis, quarter))));
        let spread = (high - low).max_element();
        // Triangles with one common centre say nothing of the size of the model.
        let reach = if spread > 0.0 { spread * REACH } else { f64::INFINITY };
        let middle = (low + high) * 0.5;
        [middle - reach, middle + reach]
    }
}

impl Bulk {
    /// Whether a triangle with these corners, in model space, is no stray.
    pub fn holds(&self, corners: [[f32; 3]; 3]) -> bool {
        let [low, high] = self.limits;
        corners.map(to_f64).iter().all(|corner| corner.cmpge(low).all() && corner.cmple(high).all())
    }

    /// One line on the strays of a mesh, fit for a log; `None` without any.
    pub fn remark(&self, n_triangles: usize) -> Option<String> {
        let Self { n_strays, farthest, .. } = self;
        let strays = counted(n_strays, "triangle");
        (*n_strays > 0).then(|| {
            format!(
                "{strays}, of {n_triangles}, lie far from all others, up to {farthest:.3e} away; the view of the whole \
                 leaves them out: remove them from the model"
            )
        })
    }
}

fn to_f64(point: [f32; 3]) -> DVec3 {
    DVec3::from(point.map(f64::from))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::statue;

    #[test]
    fn a_vertex_far_away_is_told_from_the_model() {
        for n_triangles in [100, 20_000] {
            let mut mesh = statue::generate(n_triangles, &|_| ());
            let whole = mesh.bulk();
            assert_eq!((whole.bounds, whole.n_strays, whole.remark(9)), (mesh.bounds(), 0, None));
            let [x, y, z] = mesh.vertices[7];
            for far in [[1e6, 1e6, -1e6], [x, y + 40.0, z], [-1e17, y, z]] {
                mesh.vertices[7] = far;
                let n_far = mesh.triangles.iter().filter(|triangle| triangle.contains(&7)).count();
                let bulk = mesh.bulk();
                assert_eq!(bulk.n_strays, n_far, "{far:?}");
                let [size, size_before] = [bulk.bounds, whole.bounds].map(|bounds| {
                    let [min, max] = bounds.corners();
                    max - min
                });
                assert!((size - size_before).abs().max_element() < 0.2, "{size} {size_before}");
                assert!(bulk.remark(9).unwrap().contains(&format!("{n_far} triangles, of 9, lie far")));
            }
            mesh.vertices[7] = [x, y + 4.0, z];
            assert_eq!(mesh.bulk().n_strays, 0, "a part that stands out is no stray");
        }
    }

    #[test]
    fn many_triangles_far_away_are_a_part_of_the_model() {
        let mut mesh = statue::generate(20_000, &|_| ());
        let n_near = mesh.triangles.len();
        for index in 0..40_u32 {
            let first = mesh.vertices.len() as u32;
            let x = 100.0 + index as f32;
            mesh.vertices.extend([[x, 0.0, 0.0], [x, 1.0, 0.0], [x, 0.0, 1.0]]);
            mesh.triangles.push([first, first + 1, first + 2]);
        }
        assert_eq!((mesh.bulk().n_strays, mesh.bulk().bounds), (0, mesh.bounds()));
        mesh.triangles.truncate(n_near + 28);
        assert_eq!(mesh.bulk().n_strays, 28, "8 and one of a thousand");
    }

    #[test]
    fn small_and_flat_meshes_have_no_strays() {
        let quad = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1e9, 0.0]];
        let quad = Mesh { vertices: quad.to_vec(), triangles: vec![[0, 1, 2], [0, 2, 3]], ..Mesh::default() };
        let same = Mesh { triangles: vec![[0, 1, 2]; 100], ..quad.clone() };
        let rejected = Mesh { triangles: vec![Mesh::REJECTED; 3], n_rejected: 3, ..quad.clone() };
        for mesh in [quad, same, rejected, Mesh::default()] {
            assert_eq!((mesh.bulk().n_strays, mesh.bulk().bounds), (0, mesh.bounds()));
        }
    }
}
