//! Assembles a mesh from rows in any order, and finally rejects triangles that cannot be traced.

use std::io;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::{
    formats::polygon::{Division, PolygonDivider},
    memory,
    model::mesh::Mesh,
};

/// Why a mesh cannot be held.
#[derive(Debug, thiserror::Error)]
pub enum AssemblyError {
    /// Of something there is more than indices can name.
    #[error("holds more than 4294967294 {0}, which is more than this program can number: export it in parts")]
    TooMany(&'static str),
    /// The system refuses an allocation.
    #[error(
        "needs {n_bytes} bytes of memory for its {what}, more than the system gives: free some memory, or use a \
             machine with more"
    )]
    OutOfMemory {
        /// The kind of items.
        what: &'static str,
        /// The memory that they need.
        n_bytes: usize,
    },
}

/// A fault of an OBJ or STL file, and its place: lines count from 1.
#[derive(Debug, thiserror::Error)]
pub enum TextProblem {
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    #[error("line {line}: {what}")]
    Line { line: usize, what: String },
    #[error(transparent)]
    Assembly(#[from] AssemblyError),
}

/// The index equal to `value`, if there is one.
pub(super) fn index_from_f64(value: f64) -> Option<u32> {
    let index = value as u32;
    (f64::from(index) == value).then_some(index)
}

/// A mesh whose indices are not checked yet.
#[derive(Default)]
pub(super) struct MeshBuilder {
    /// All but `vertices`, `origin` and `triangles` may be filled from outside.
    pub(super) mesh: Mesh,
    polygons: PolygonDivider,
}

impl MeshBuilder {
    /// Reserves memory; `n_vertices` must have been checked against the file's size.
    pub(super) fn reserve_vertices(&mut self, n_vertices: usize) -> Result<(), AssemblyError> {
        self.check_vertices(n_vertices)?;
        reserve(&mut self.mesh.vertices, n_vertices, "vertices")
    }

    /// Checks that this program can number more vertices.
    pub(super) fn check_vertices(&self, n_more: usize) -> Result<(), AssemblyError> {
        check_count(self.mesh.vertices.len().saturating_add(n_more), "vertices")
    }

    pub(super) fn reserve_triangles(&mut self, n_triangles: usize) -> Result<(), AssemblyError> {
        reserve(&mut self.mesh.triangles, n_triangles, "triangles")
    }

    pub(super) fn n_vertices(&self) -> usize {
        self.mesh.vertices.len()
    }

    pub(super) fn n_triangles(&self) -> usize {
        self.mesh.triangles.len()
    }

    /// Adds a vertex; the number of vertices must have been [checked](Self::check_vertices).
    pub(super) fn push_vertex(&mut self, position: DVec3) {
        self.place_origin(position);
        self.mesh.vertices.push((position - self.mesh.origin).as_vec3().to_array());
    }

    /// Adds `n` vertices, of which `f32` holds each; their number must have been [checked](Self::check_vertices).
    pub(super) fn extend_vertices(&mut self, n: usize, position: impl Fn(usize) -> Vec3 + Sync) {
        let origin = self.mesh.origin;
        extend(&mut self.mesh.vertices, n, |k| (position(k).as_dvec3() - origin).as_vec3().to_array());
    }

    /// Moves the origin to the first vertex that `f32` cannot hold. All before it are exact, so each coordinate is rounded
    /// once, and every machine finds the same origin as it reads.
    fn place_origin(&mut self, position: DVec3) {
        let rounded = position.as_vec3();
        let is_exact = rounded.as_dvec3() == position;
        if self.mesh.origin != DVec3::ZERO || is_exact || !Mesh::is_usable(rounded.to_array()) {
            return;
        }
        self.mesh.origin = position;
        for vertex in &mut self.mesh.vertices {
            *vertex = (Vec3::from_array(*vertex).as_dvec3() - position).as_vec3().to_array();
        }
    }

    /// Adds `n` triangles.
    pub(super) fn extend_triangles(
        &mut self,
        n: usize,
        triangle: impl Fn(usize) -> [u32; 3] + Sync,
    ) -> Result<(), AssemblyError> {
        check_count(self.mesh.triangles.len().saturating_add(n), "triangles")?;
        extend(&mut self.mesh.triangles, n, triangle);
        Ok(())
    }

    /// Adds the triangles of a polygon, and returns them.
    pub(super) fn push_polygon(&mut self, corners: &[u32]) -> Result<Division<'_>, AssemblyError> {
        check_count(self.mesh.triangles.len() + corners.len().saturating_sub(2), "triangles")?;
        if let &[a, b, c] = corners {
            self.mesh.triangles.push([a, b, c]);
            return Ok(Division::fan(3));
        }
        let position = |number: usize| {
            let vertex = self.mesh.vertices.get(corners[number] as usize)?;
            Mesh::is_usable(*vertex).then(|| Vec3::from_array(*vertex).as_dvec3())
        };
        let division = self.polygons.divide(corners.len(), position);
        let vertices = |triangle: [u32; 3]| triangle.map(|number| corners[number as usize]);
        self.mesh.triangles.extend(division.triangles().map(vertices));
        Ok(division)
    }

    /// Unrolls strips, separated by negative indices; flips every other triangle, so that all face the same way.
    pub(super) fn push_strips(&mut self, corners: &[u32]) -> Result<(), AssemblyError> {
        check_count(self.mesh.triangles.len() + corners.len(), "triangles")?;
        for strip in corners.split(|&index| index == u32::MAX) {
            self.mesh.triangles.extend(strip.windows(3).enumerate().map(|(i, corners)| match *corners {
                [a, b, c] if i % 2 == 0 => [a, b, c],
                [a, b, c] => [b, a, c],
                _ => Mesh::REJECTED,
            }));
        }
        Ok(())
    }

    /// Rejects triangles whose indices or vertices cannot be used.
    pub(super) fn finish(self) -> Mesh {
        let mut mesh = self.mesh;
        let vertices = &mesh.vertices;
        let all_usable = vertices.iter().all(|&position| Mesh::is_usable(position));
        let usable = |&index: &u32| {
            (index as usize) < vertices.len() && (all_usable || Mesh::is_usable(vertices[index as usize]))
        };
        let reject = |triangle: &mut [u32; 3]| {
            let is_rejected = !triangle.iter().all(usable);
            if is_rejected {
                *triangle = Mesh::REJECTED;
            }
            is_rejected
        };
        mesh.n_rejected += if mesh.triangles.len() < FEW {
            mesh.triangles.iter_mut().map(reject).filter(|&is_rejected| is_rejected).count()
        } else {
            mesh.triangles.par_iter_mut().map(reject).filter(|&is_rejected| is_rejected).count()
        };
        come_near(&mut mesh);
        mesh
    }
}

/// Fewer items are not worth the way to other threads: a scene may have many small meshes.
const FEW: usize = 1 << 14;

/// Adds `n` items, in parallel if there are many.
pub(super) fn extend<T: Send>(items: &mut Vec<T>, n: usize, item: impl Fn(usize) -> T + Sync) {
    if n < FEW {
        items.extend((0..n).map(item));
    } else {
        items.par_extend((0..n).into_par_iter().map(&item));
    }
}

/// Distance from zero, relative to the size, from which a model has an origin of its own.
const FAR: f64 = 64.0;

/// Moves the origin of a model far from zero to its lowest corner, though `f32` holds its vertices: cameras and rays beside
/// them need finer steps. An axis along which any vertex would be rounded stays as it is.
fn come_near(mesh: &mut Mesh) {
    let [low, high] = mesh.bounds().corners();
    let is_far = low.abs().max(high.abs()).max_element() > FAR * (high - low).max_element();
    if mesh.origin != DVec3::ZERO || !is_far || !low.is_finite() {
        return;
    }
    for axis in 0..3 {
        let moved = |x: f32| f64::from(x) - low[axis];
        let is_exact = |vertex: &[f32; 3]| {
            !Mesh::is_usable(*vertex) || f64::from(moved(vertex[axis]) as f32) == moved(vertex[axis])
        };
        if mesh.vertices.iter().all(is_exact) {
            mesh.origin[axis] = low[axis];
            mesh.vertices.iter_mut().for_each(|vertex| vertex[axis] = moved(vertex[axis]) as f32);
        }
    }
}

/// Checks a number of vertices or triangles: the triangle index `u32::MAX` means a miss, and the one before it a cap.
fn check_count(n_items: usize, what: &'static str) -> Result<(), AssemblyError> {
    if n_items < u32::MAX as usize { Ok(()) } else { Err(AssemblyError::TooMany(what)) }
}

/// Reserves memory for a number of items that has been checked against the file's size.
pub(super) fn reserve<T>(items: &mut Vec<T>, n_items: usize, what: &'static str) -> Result<(), AssemblyError> {
    let n_bytes = n_items.saturating_mul(size_of::<T>());
    memory::handling_failure(|| items.try_reserve_exact(n_items))
        .map_err(|_| AssemblyError::OutOfMemory { what, n_bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle(corners: [[f64; 3]; 3]) -> Mesh {
        let mut builder = MeshBuilder::default();
        corners.into_iter().for_each(|corner| builder.push_vertex(DVec3::from_array(corner)));
        builder.push_polygon(&[0, 1, 2]).unwrap();
        builder.finish()
    }

    #[test]
    fn a_model_far_from_zero_has_an_origin_though_its_numbers_are_round() {
        let tiny = 2f64.powi(-40);
        let far =
            triangle([[500_000.0, 5_400_000.0, 0.125], [500_002.0, 5_400_000.5, 2.0], [500_001.0, 5_400_002.0, tiny]]);
        assert_eq!(far.origin, DVec3::new(500_000.0, 5_400_000.0, 0.0));
        assert_eq!(far.vertices[1], [2.0, 0.5, 2.0]);
        let near = triangle([[5.0, 1.0, 0.0], [6.0, 1.5, 2.0], [5.0, 2.0, 0.0]]);
        assert_eq!((near.origin, near.vertices[1]), (DVec3::ZERO, [6.0, 1.5, 2.0]));
    }
}
