//! A coarser mesh in the place of one whose triangles are finer than samples.

use std::collections::{HashMap, HashSet, hash_map::Entry};

use glam::{DVec3, Vec3};
use renderer::model::{mesh::Mesh, normal::Normal};

/// The vertices of one cell.
#[derive(Clone, Copy, Default)]
struct Cluster {
    position: DVec3,
    n_vertices: u32,
    /// Of all triangles with a corner here, as long as their areas are large.
    normal: Vec3,
}

/// The mesh with one vertex in each cell of a lattice of cubes, at the mean of those that lie there, and with the mean normal of
/// their triangles; triangles that have no three cells, or the same as another, are left out. Without colours and materials.
///
/// After Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes" (1993).
pub(super) fn clustered(mesh: &Mesh, cell: f64) -> Mesh {
    let mut numbers = HashMap::new();
    let mut clusters: Vec<Cluster> = Vec::new();
    let cluster_of: Vec<u32> = mesh
        .vertices
        .iter()
        .map(|&position| {
            let position = Vec3::from_array(position).as_dvec3();
            let number = match numbers.entry((position / cell).floor().as_i64vec3()) {
                Entry::Occupied(number) => *number.get(),
                Entry::Vacant(place) => {
                    clusters.push(Cluster::default());
                    *place.insert(clusters.len() as u32 - 1)
                }
            };
            let cluster = &mut clusters[number as usize];
            cluster.position += position;
            cluster.n_vertices += 1;
            number
        })
        .collect();
    drop(numbers);

    let (mut triangles, mut seen) = (Vec::new(), HashSet::new());
    for &triangle in mesh.triangles.iter().filter(|&&triangle| triangle != Mesh::REJECTED) {
        let [a, b, c] = triangle.map(|corner| Vec3::from_array(mesh.vertices[corner as usize]));
        let [p, q, r] = triangle.map(|corner| cluster_of[corner as usize]);
        let normal = (b - a).cross(c - a);
        [p, q, r].iter().for_each(|&number| clusters[number as usize].normal += normal);
        if p == q || q == r || r == p {
            continue;
        }
        // The same triangle begins with any of its corners.
        let first = p.min(q).min(r);
        let turned = if first == p {
            [p, q, r]
        } else if first == q {
            [q, r, p]
        } else {
            [r, p, q]
        };
        if seen.insert(turned) {
            triangles.push(turned);
        }
    }
    let position = |cluster: &Cluster| (cluster.position / f64::from(cluster.n_vertices)).as_vec3().to_array();
    Mesh {
        vertices: clusters.iter().map(position).collect(),
        normals: clusters.iter().map(|cluster| Normal::new(cluster.normal)).collect(),
        triangles,
        origin: mesh.origin,
        up: mesh.up,
        ..Mesh::default()
    }
}

#[cfg(test)]
mod tests {
    use renderer::model::statue;

    use super::*;

    #[test]
    fn small_cells_change_nothing_and_large_ones_leave_few_triangles_on_the_surface() {
        let mesh = statue::generate(20_000, &|_| ());
        let same = clustered(&mesh, 1e-6);
        assert_eq!((same.vertices.len(), same.triangles.len()), (mesh.vertices.len(), mesh.triangles.len()));
        let cell = 0.1;
        let coarse = clustered(&mesh, cell);
        assert!((100..10_000).contains(&coarse.triangles.len()), "{}", coarse.triangles.len());
        let corners = coarse.triangles.as_flattened();
        assert!(corners.iter().all(|&corner| (corner as usize) < coarse.vertices.len()));
        // Means of points of a cell lie in it, so each is near one of them.
        let distance = |point: &[f32; 3]| {
            let distances =
                mesh.vertices.iter().map(|other| Vec3::from_array(*point).distance(Vec3::from_array(*other)));
            distances.fold(f32::INFINITY, f32::min)
        };
        assert!(coarse.vertices.iter().all(|point| distance(point) < cell as f32));
        // A box stays closed where its corners lie in cells of their own: each edge is passed both ways.
        let edges = |triangle: &[u32; 3]| [[0, 1], [1, 2], [2, 0]].map(|edge| edge.map(|corner| triangle[corner]));
        let all: HashSet<_> = same.triangles.iter().flat_map(edges).collect();
        assert!(all.iter().all(|[from, to]| all.contains(&[*to, *from])));
    }
}
