//! The meshes of the cases.

use glam::DVec3;
use renderer::model::mesh::Mesh;

use crate::random::Random;

/// Triangles with integer corners, for which hits are exact.
pub(super) type Lattice = Vec<[[i32; 3]; 3]>;

/// A mesh of triangles that share no vertices; `unit` is the size of an integer step.
pub(super) fn mesh_of(lattice: &Lattice, unit: f32) -> Mesh {
    Mesh {
        vertices: lattice.iter().flatten().map(|corner| corner.map(|x| x as f32 * unit)).collect(),
        triangles: (0..lattice.len() as u32).map(|number| [3 * number, 3 * number + 1, 3 * number + 2]).collect(),
        ..Mesh::default()
    }
}

/// A closed sphere of `n_rows` circles of latitude between two poles.
pub(super) fn sphere(centre: [f64; 3], radius: f64, n_rows: u32) -> Mesh {
    let centre = DVec3::from_array(centre);
    let n_columns = 2 * n_rows;
    let at = |point: DVec3| (centre + point * radius).as_vec3().to_array();
    let mut mesh = Mesh { vertices: vec![at(DVec3::Y), at(DVec3::NEG_Y)], ..Mesh::default() };
    let vertex = |row: u32, column: u32| match row {
        0 => 0,
        row if row == n_rows => 1,
        row => 2 + (row - 1) * n_columns + column % n_columns,
    };
    for row in 0..n_rows {
        for column in 0..n_columns {
            if row > 0 {
                let (sin, cos) = (std::f64::consts::PI * f64::from(row) / f64::from(n_rows)).sin_cos();
                let around = (std::f64::consts::TAU * f64::from(column) / f64::from(n_columns)).sin_cos();
                mesh.vertices.push(at(DVec3::new(sin * around.1, cos, sin * around.0)));
            }
            let [a, b] = [vertex(row, column), vertex(row, column + 1)];
            let [c, d] = [vertex(row + 1, column), vertex(row + 1, column + 1)];
            // At the poles one of the two triangles would have no area.
            mesh.triangles.extend((row > 0).then_some([a, b, d]));
            mesh.triangles.extend((row + 1 < n_rows).then_some([a, d, c]));
        }
    }
    mesh
}

/// The surface of n×n×n unit cubes with a corner at the origin, two triangles for each face.
pub(super) fn cube(n: i32) -> Lattice {
    let mut lattice = Lattice::new();
    for axis in 0..3 {
        for (u, v, side) in (0..n).flat_map(|u| (0..n).flat_map(move |v| [(u, v, 0), (u, v, n)])) {
            let at = |u: i32, v: i32| {
                let mut point = [0; 3];
                (point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3]) = (side, u, v);
                point
            };
            lattice.push([at(u, v), at(u + 1, v), at(u + 1, v + 1)]);
            lattice.push([at(u, v), at(u + 1, v + 1), at(u, v + 1)]);
        }
    }
    lattice
}

/// Random triangles with coordinates from 0 to `size`; one in eight is perpendicular to an axis.
pub(super) fn soup(random: &mut Random, n: usize, size: i32) -> Lattice {
    (0..n)
        .map(|_| {
            let mut triangle = [[0; 3]; 3].map(|corner| corner.map(|_: i32| random.whole(0, size)));
            let axis = random.whole(0, 23) as usize;
            if axis < 3 {
                let position = triangle[0][axis];
                triangle.iter_mut().for_each(|corner| corner[axis] = position);
            }
            triangle
        })
        .collect()
}
