//! A coarser mesh in the place of one whose triangles are finer than samples.

use std::{
    collections::{HashMap, HashSet},
    hash::Hash,
};

use glam::{DVec3, IVec3, Vec3};
use renderer::model::{mesh::Mesh, normal::Normal};

/// Steps of a normal's coordinates from 0 to 1: creases separate normals, and small cells keep all of them.
const NORMAL_STEPS: f32 = 2.0;

/// Numbers keys in the order in which they come.
struct Numbers<K>(HashMap<K, u32>);

impl<K: Hash + Eq> Numbers<K> {
    fn number_of(&mut self, key: K) -> u32 {
        let next = self.0.len() as u32;
        *self.0.entry(key).or_insert(next)
    }
}

/// A mesh, with normals, whose vertices in one cell of a lattice of cubes have one place, the mean of theirs, and one normal for
/// each direction in which surfaces there face. Triangles that have no three cells, or the same as another, are left out, as are
/// colours and materials.
///
/// After Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes" (1993).
pub(super) fn clustered(mesh: &Mesh, cell: f64) -> Mesh {
    let (mut cells, mut vertices) = (Numbers(HashMap::new()), Numbers(HashMap::new()));
    let mut places: Vec<(DVec3, u32)> = Vec::new();
    let mut normals: Vec<Vec3> = Vec::new();
    let mut cell_of = Vec::new();
    let number_vertex = |(index, &position): (usize, &[f32; 3])| {
        let position = Vec3::from_array(position).as_dvec3();
        let cell = cells.number_of((position / cell).floor().as_ivec3());
        let normal = mesh.normals.get(index).and_then(|normal| normal.vector());
        let facing = normal.map(|normal| (normal * NORMAL_STEPS).round().as_ivec3());
        // Vertices without a normal of their own share the key that no normal has.
        let vertex = vertices.number_of((cell, facing.unwrap_or(IVec3::MAX)));
        if cell as usize == places.len() {
            places.push((DVec3::ZERO, 0));
        }
        if vertex as usize == normals.len() {
            normals.push(Vec3::ZERO);
            cell_of.push(cell);
        }
        places[cell as usize].0 += position;
        places[cell as usize].1 += 1;
        normals[vertex as usize] += normal.unwrap_or(Vec3::ZERO);
        vertex
    };
    let vertex_of: Vec<u32> = mesh.vertices.iter().enumerate().map(number_vertex).collect();
    drop((cells, vertices));

    let mut seen = HashSet::new();
    let is_kept = |triangle: &[u32; 3]| {
        let [p, q, r] = triangle.map(|vertex| cell_of[vertex as usize]);
        // The same triangle begins with any of its corners.
        let first = p.min(q).min(r);
        let turned = if first == p {
            [p, q, r]
        } else if first == q {
            [q, r, p]
        } else {
            [r, p, q]
        };
        p != q && q != r && r != p && seen.insert(turned)
    };
    let of_mesh = mesh.triangles.iter().filter(|&&triangle| triangle != Mesh::REJECTED);
    let triangles = of_mesh.map(|triangle| triangle.map(|corner| vertex_of[corner as usize])).filter(is_kept).collect();
    let place = |&cell: &u32| {
        let (sum, n_vertices) = places[cell as usize];
        (sum / f64::from(n_vertices)).as_vec3().to_array()
    };
    Mesh {
        vertices: cell_of.iter().map(place).collect(),
        normals: normals.into_iter().map(Normal::new).collect(),
        triangles,
        origin: mesh.origin,
        up: mesh.up,
        ..Mesh::default()
    }
}

#[cfg(test)]
mod tests {
    use renderer::model::statue;
    use shared::scene::Crease;

    use super::*;

    /// Positions and normals of the corners of all triangles.
    fn corners(mesh: &Mesh) -> Vec<([f32; 3], Normal)> {
        let corners = mesh.triangles.as_flattened().iter().map(|&corner| corner as usize);
        corners.map(|corner| (mesh.vertices[corner], mesh.normals[corner])).collect()
    }

    #[test]
    fn small_cells_change_nothing_and_large_ones_leave_few_triangles_on_the_surface() {
        let mesh = statue::generate(20_000, &|_| ()).smooth(Crease::default());
        let same = clustered(&mesh, 1e-5);
        assert_eq!(same.triangles.len(), mesh.triangles.len());
        let cosine = |a: Normal, b: Normal| a.vector().zip(b.vector()).map_or(1.0, |(a, b)| a.dot(b));
        for ((place, normal), (other, of_other)) in corners(&same).into_iter().zip(corners(&mesh)) {
            assert!(place == other && cosine(normal, of_other) > 0.9999, "{place:?} {other:?}");
        }

        let cell = 0.1;
        let coarse = clustered(&mesh, cell);
        assert!((100..10_000).contains(&coarse.triangles.len()), "{}", coarse.triangles.len());
        // Means of points of a cell lie in it, so each is near one of them.
        let distance = |(point, _): &([f32; 3], Normal)| {
            let point = Vec3::from_array(*point);
            let distances = mesh.vertices.iter().map(|other| point.distance(Vec3::from_array(*other)));
            distances.fold(f32::INFINITY, f32::min)
        };
        assert!(corners(&coarse).iter().all(|corner| distance(corner) < 1.8 * cell as f32));
    }
}
