//! A coarser mesh in the place of one whose triangles are finer than samples.
//!
//! After Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes" (1993): vertices in one cell of
//! a lattice become one. Cells are followed in the order of the mesh, and neighbours in a file mostly lie in one brick of cells,
//! so few steps leave the cache.

use std::collections::HashMap;

use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use shared::srgb;

use crate::model::{material::Materials, mesh::Mesh, normal::Normal};

/// Steps of a normal's coordinates from 0 to 1: creases separate normals, and small cells keep all of them.
const NORMAL_STEPS: f32 = 2.0;

/// Cells along a brick's side, and in a brick.
const BRICK_SIDE: i64 = 8;
const BRICK_CELLS: usize = BRICK_SIDE.pow(3) as usize;

/// No number.
const NONE: u32 = u32::MAX;

/// Cubes that fill space, numbered in the order in which they are met.
struct Lattice {
    /// Of a cell.
    side: f64,
    bricks: HashMap<[i64; 3], usize>,
    /// The numbers of each brick's cells.
    numbers: Vec<[u32; BRICK_CELLS]>,
    /// The brick that was met last.
    last: ([i64; 3], usize),
    n_cells: u32,
}

impl Lattice {
    fn new(side: f64) -> Self {
        Self { side, bricks: HashMap::new(), numbers: Vec::new(), last: ([0; 3], usize::MAX), n_cells: 0 }
    }

    /// The number of the cell around a point.
    fn number_at(&mut self, point: DVec3) -> u32 {
        let cell = (point / self.side).floor().to_array().map(|coordinate| coordinate as i64);
        let brick = cell.map(|coordinate| coordinate.div_euclid(BRICK_SIDE));
        if self.last.0 != brick || self.last.1 == usize::MAX {
            let next = self.numbers.len();
            let index = *self.bricks.entry(brick).or_insert(next);
            if index == next {
                self.numbers.push([NONE; BRICK_CELLS]);
            }
            self.last = (brick, index);
        }
        let [x, y, z] = cell.map(|coordinate| coordinate.rem_euclid(BRICK_SIDE) as usize);
        let number = &mut self.numbers[self.last.1][(z * BRICK_SIDE as usize + y) * BRICK_SIDE as usize + x];
        if *number == NONE {
            *number = self.n_cells;
            self.n_cells += 1;
        }
        *number
    }
}

/// The vertices of one cell of a lattice.
struct Cell {
    sum: DVec3,
    n_vertices: u32,
    /// The first of the vertices in its place.
    first: u32,
}

/// A vertex in the place of those of a cell that face about the same way.
struct Cluster {
    cell: u32,
    facing: IVec3,
    normal: Vec3,
    /// Sum of linear light.
    color: Vec3,
    n_vertices: u32,
    /// Another of this cell.
    next: u32,
}

/// The clusters of a mesh's vertices.
struct Clusters<'a> {
    mesh: &'a Mesh,
    lattice: Lattice,
    cells: Vec<Cell>,
    clusters: Vec<Cluster>,
    /// Of each vertex of the mesh.
    of_vertices: Vec<u32>,
}

impl<'a> Clusters<'a> {
    fn new(mesh: &'a Mesh, side: f64) -> Self {
        let of_vertices = vec![NONE; mesh.vertices.len()];
        Self { mesh, lattice: Lattice::new(side), cells: Vec::new(), clusters: Vec::new(), of_vertices }
    }

    /// The cluster of a vertex.
    fn of(&mut self, vertex: u32) -> u32 {
        let index = vertex as usize;
        if self.of_vertices[index] == NONE {
            self.of_vertices[index] = self.assign(index);
        }
        self.of_vertices[index]
    }

    /// Adds a vertex to its cluster.
    fn assign(&mut self, vertex: usize) -> u32 {
        let Self { mesh, lattice, cells, clusters, .. } = self;
        let position = Vec3::from_array(mesh.vertices[vertex]).as_dvec3();
        let cell = lattice.number_at(position);
        if cell as usize == cells.len() {
            cells.push(Cell { sum: DVec3::ZERO, n_vertices: 0, first: NONE });
        }
        let of_cell = &mut cells[cell as usize];
        of_cell.sum += position;
        of_cell.n_vertices += 1;

        let normal = mesh.normals.get(vertex).and_then(|normal| normal.vector());
        // Vertices without a normal of their own share the key that no normal has.
        let facing = normal.map_or(IVec3::MAX, |normal| (normal * NORMAL_STEPS).round().as_ivec3());
        let mut index = of_cell.first;
        while clusters.get(index as usize).is_some_and(|cluster| cluster.facing != facing) {
            index = clusters[index as usize].next;
        }
        if index == NONE {
            index = clusters.len() as u32;
            let next = std::mem::replace(&mut of_cell.first, index);
            clusters.push(Cluster { cell, facing, normal: Vec3::ZERO, color: Vec3::ZERO, n_vertices: 0, next });
        }
        let cluster = &mut clusters[index as usize];
        cluster.normal += normal.unwrap_or(Vec3::ZERO);
        cluster.color += mesh.colors.get(vertex).map_or(Vec3::ZERO, |color| color.map(srgb::decode).into());
        cluster.n_vertices += 1;
        index
    }

    /// The cells of a triangle's corners, from the lowest on; `None` unless they are three.
    fn cells_of(&mut self, triangle: [u32; 3]) -> Option<[u32; 3]> {
        let [p, q, r] = triangle.map(|corner| self.of(corner)).map(|cluster| self.clusters[cluster as usize].cell);
        let first = p.min(q).min(r);
        let turned = match first {
            _ if first == p => [p, q, r],
            _ if first == q => [q, r, p],
            _ => [r, p, q],
        };
        (p != q && q != r && r != p).then_some(turned)
    }

    /// The vertices, normals and colours in the place of the mesh's.
    fn vertices(&self) -> (Vec<[f32; 3]>, Vec<Normal>, Vec<[u8; 3]>) {
        let place = |cluster: &Cluster| {
            let cell = &self.cells[cluster.cell as usize];
            (cell.sum / f64::from(cell.n_vertices)).as_vec3().to_array()
        };
        let color = |cluster: &Cluster| (cluster.color / cluster.n_vertices as f32).to_array().map(srgb::encode);
        let of_normals = if self.mesh.normals.is_empty() { &[] } else { &*self.clusters };
        let of_colors = if self.mesh.colors.is_empty() { &[] } else { &*self.clusters };
        let vertices = self.clusters.par_iter().map(place).collect();
        let normals = of_normals.par_iter().map(|cluster| Normal::new(cluster.normal)).collect();
        (vertices, normals, of_colors.par_iter().map(color).collect())
    }
}

/// A mesh whose vertices in one cell of a lattice of cubes have one place, the mean of theirs; for each direction in which
/// surfaces there face, it has a normal, and a colour, the mean of theirs.
///
/// Triangles keep their order and materials, without textures. Those that have no three cells, or the same as an earlier one,
/// are left out. Every vertex stays in its cell of the given side, in units of the mesh.
pub fn clustered(mesh: &Mesh, side: f64) -> Mesh {
    let mut clusters = Clusters::new(mesh, side);
    let mut kept = Vec::new();
    for (index, &triangle) in mesh.triangles.iter().enumerate() {
        if triangle != Mesh::REJECTED
            && let Some(cells) = clusters.cells_of(triangle)
        {
            kept.push((cells, index as u32));
        }
    }
    // The first of each cells, in the order of the mesh.
    kept.par_sort_unstable();
    kept.dedup_by_key(|(cells, _)| *cells);
    let mut kept: Vec<_> = kept.into_iter().map(|(_, index)| index as usize).collect();
    kept.par_sort_unstable();

    let cluster_of = |corner: u32| clusters.of_vertices[corner as usize];
    let of_triangles = &mesh.materials.of_triangles;
    let (vertices, normals, colors) = clusters.vertices();
    Mesh {
        vertices,
        normals,
        colors,
        triangles: kept.par_iter().map(|&index| mesh.triangles[index].map(cluster_of)).collect(),
        materials: Materials {
            materials: mesh.materials.materials.clone(),
            images: Vec::new(),
            of_triangles: kept.iter().filter_map(|&index| of_triangles.get(index).copied()).collect(),
        },
        origin: mesh.origin,
        up: mesh.up,
        ..Mesh::default()
    }
}

#[cfg(test)]
mod tests {
    use shared::scene::Crease;

    use super::*;
    use crate::model::{material::Material, statue};

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

        let side = 0.1;
        let coarse = clustered(&mesh, side);
        assert!((100..10_000).contains(&coarse.triangles.len()), "{}", coarse.triangles.len());
        // Means of points of a cell lie in it, so each is near one of them.
        let distance = |(point, _): &([f32; 3], Normal)| {
            let point = Vec3::from_array(*point);
            let distances = mesh.vertices.iter().map(|other| point.distance(Vec3::from_array(*other)));
            distances.fold(f32::INFINITY, f32::min)
        };
        assert!(corners(&coarse).iter().all(|corner| distance(corner) < 1.8 * side as f32));
    }

    /// A square of unit cells around zero, each of 4×4 vertices, with a colour for each half of the cells and a material for
    /// each row.
    fn sheet() -> Mesh {
        let n = 16u32;
        let at = |index: u32| (index as f32 + 0.5) / 4.0 - 2.0;
        let vertices = (0..n * n).map(|index| [at(index % n), at(index / n), 0.25]).collect();
        let colors = (0..n * n).map(|index| if index % 2 == 0 { [255, 0, 10] } else { [0, 0, 10] }).collect();
        let squares = (0..n - 1).flat_map(|row| (0..n - 1).map(move |column| row * n + column));
        let triangles: Vec<_> =
            squares.flat_map(|first| [[first, first + 1, first + n], [first + 1, first + n + 1, first + n]]).collect();
        let of_triangles = triangles.iter().map(|triangle| u16::from(triangle[0] / n % 8 == 3)).collect();
        let materials = vec![Material::default(), Material { metallic: 1.0, ..Material::default() }];
        Mesh {
            vertices,
            triangles,
            colors,
            materials: Materials { materials, images: Vec::new(), of_triangles },
            ..Mesh::default()
        }
    }

    #[test]
    fn a_cell_has_the_mean_of_its_places_and_of_its_light_and_triangles_keep_their_materials() {
        let coarse = clustered(&sheet(), 1.0);
        // 4×4 cells, with two triangles for each square between their middles.
        assert_eq!((coarse.vertices.len(), coarse.triangles.len()), (16, 18));
        for vertex in &coarse.vertices {
            assert!(vertex.iter().zip([0.5, 0.5, 0.25]).all(|(x, middle)| (x - middle).fract() == 0.0), "{vertex:?}");
        }
        // Half of the light of 255.
        assert!(coarse.colors.iter().all(|color| *color == [188, 0, 10]), "{:?}", coarse.colors);
        assert!(coarse.normals.is_empty());
        // Triangles that cross from one row of cells to the next come from the rows between them.
        let Materials { materials, of_triangles, .. } = &coarse.materials;
        assert_eq!((materials.len(), of_triangles.len()), (2, 18));
        assert_eq!(of_triangles.iter().filter(|&&material| material == 1).count(), 12);
        assert_eq!(clustered(&sheet(), 8.0).triangles.len(), 2, "all four quadrants");
        let places =
            |mesh: &Mesh| mesh.triangles.iter().flatten().map(|&at| mesh.vertices[at as usize]).collect::<Vec<_>>();
        assert_eq!(places(&clustered(&sheet(), 0.25)), places(&sheet()));
    }

    #[test]
    fn vertices_of_no_triangle_have_no_part_in_it() {
        let mut mesh = sheet();
        mesh.vertices.push([f32::NAN; 3]);
        mesh.vertices.push([0.1; 3]);
        mesh.colors.extend([[9; 3]; 2]);
        mesh.triangles.insert(0, Mesh::REJECTED);
        mesh.materials.of_triangles.insert(0, 1);
        mesh.n_rejected = 1;
        assert_eq!(clustered(&mesh, 1.0), clustered(&sheet(), 1.0));
    }
}
