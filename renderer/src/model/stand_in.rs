//! Coarser meshes in the place of a model whose triangles are finer than a frame's samples.
//!
//! Their cells and triangles depend on the mesh alone, so every render server has the same.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::model::{clusters::clustered, mesh::Mesh};

/// Models with fewer triangles have no stand-ins: a frame of them takes few milliseconds more.
pub const LEAST_TRIANGLES: usize = 1 << 24;

/// How many times fewer triangles a stand-in has at least: the first than the mesh, each other than the one before it.
const LEAST_FACTOR: [usize; 2] = [4, 2];

/// A surface of a cell's square gives about this many triangles: two, and more where it passes slantwise.
const TRIANGLES_PER_SQUARE: f64 = 4.0;

/// Cells of the first stand-in have at least about this many triangles a square: all stand-ins together then usually have a
/// sixth of those of the mesh.
const FIRST_FACTOR: f64 = 8.0;

/// The most sizes of cells that are tried for the next stand-in.
const MOST_TRIES: u8 = 4;

/// Triangles whose areas are added in order.
const CHUNK: usize = 1 << 14;

/// A mesh of cells with this side.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct StandInMesh {
    pub(crate) side: f32,
    pub(crate) mesh: Mesh,
}

/// The stand-ins of a mesh, the finest first; none of one with fewer triangles than `least`, or with textures, which clusters
/// would blur.
pub(crate) fn stand_ins(mesh: &Mesh, least: usize) -> Vec<StandInMesh> {
    let n_triangles = mesh.triangles.len() - mesh.n_rejected;
    let mut found = Vec::<StandInMesh>::new();
    if n_triangles < least || !mesh.materials.images.is_empty() {
        return found;
    }
    let Some(mut side) = first_side(mesh) else { return found };
    let [first_factor, factor] = LEAST_FACTOR;
    let mut n_most = n_triangles / first_factor;
    while n_most >= least / 32 {
        let finer = found.last().map_or(mesh, |finer| &finer.mesh);
        // Cells lie in those of twice their side, so no vertex leaves its cell, however often it was moved.
        let tried = (0..MOST_TRIES).map(|n| side * f32::from(n).exp2());
        let tried = tried.map(|side| StandInMesh { side, mesh: clustered(finer, f64::from(side)) });
        let small = tried.into_iter().find(|coarse| coarse.mesh.triangles.len() <= n_most);
        let Some(coarse) = small.filter(|coarse| !coarse.mesh.triangles.is_empty()) else { break };
        (side, n_most) = (2.0 * coarse.side, coarse.mesh.triangles.len() / factor);
        found.push(coarse);
    }
    found
}

/// The side of the first stand-in's cells; `None` if no cells fit.
fn first_side(mesh: &Mesh) -> Option<f32> {
    let n_triangles = mesh.triangles.len() - mesh.n_rejected;
    let side = (area(mesh) * TRIANGLES_PER_SQUARE * FIRST_FACTOR / n_triangles as f64).sqrt() as f32;
    let largest = mesh.bounds().corners().map(|corner| corner.abs().max_element());
    // Cells are numbered in `i64`.
    let is_usable = side.is_normal() && largest[0].max(largest[1]) < f64::from(side) * 2f64.powi(60);
    is_usable.then_some(side)
}

/// The area of all triangles; added in order, it is the same on every machine.
fn area(mesh: &Mesh) -> f64 {
    let of_triangle = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|corner| Vec3::from_array(mesh.vertices[corner as usize]).as_dvec3());
        0.5 * DVec3::cross(b - a, c - a).length()
    };
    let accepted =
        |chunk: &[[u32; 3]]| chunk.iter().filter(|&&triangle| triangle != Mesh::REJECTED).map(of_triangle).sum();
    let of_chunks: Vec<f64> = mesh.triangles.par_chunks(CHUNK).map(accepted).collect();
    of_chunks.into_iter().sum()
}

#[cfg(test)]
mod tests {
    use shared::scene::Crease;

    use super::*;
    use crate::model::{
        material::{Image, Materials},
        statue,
    };

    #[test]
    fn each_stand_in_has_cells_twice_as_wide_and_all_have_a_sixth_of_the_triangles() {
        let mesh = statue::generate(200_000, &|_| ()).smooth(Crease::default());
        let n_triangles = mesh.triangles.len();
        let stand_ins = stand_ins(&mesh, n_triangles / 8);
        let counts: Vec<_> = stand_ins.iter().map(|coarse| coarse.mesh.triangles.len()).collect();
        assert!(stand_ins.len() >= 2 && counts.iter().sum::<usize>() < n_triangles / 5, "{counts:?}");
        assert!(stand_ins.is_sorted_by(|a, b| 2.0 * a.side <= b.side));
        assert!(counts[0] > n_triangles / 50 && counts.last().is_some_and(|n| *n > 1000), "{counts:?}");
        assert_eq!(super::stand_ins(&mesh, n_triangles + 1), []);
    }

    #[test]
    fn a_mesh_without_area_or_with_textures_has_none() {
        let mesh = statue::generate(20_000, &|_| ());
        let image = Image { width: 1, height: 1, texels: vec![[0; 4]] };
        let textured = Mesh { materials: Materials { images: vec![image], ..Materials::default() }, ..mesh.clone() };
        let flat = Mesh { vertices: vec![[1.0; 3]; mesh.vertices.len()], ..mesh.clone() };
        let far =
            |x: f32| Mesh { vertices: mesh.vertices.iter().map(|[_, y, z]| [x, *y, *z]).collect(), ..mesh.clone() };
        for mesh in [textured, flat, Mesh::default()] {
            assert_eq!(stand_ins(&mesh, 0), []);
        }
        assert!(!stand_ins(&far(1.0), 0).is_empty());
        for far in [far(1e17), far(-1e18)] {
            let _ = stand_ins(&far, 0);
        }
    }
}
