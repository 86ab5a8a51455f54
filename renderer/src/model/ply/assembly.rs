//! Assembles a mesh from rows in any order, and finally rejects triangles that cannot be traced.

use glam::{DVec3, Vec3};

use crate::{
    memory,
    model::{
        mesh::Mesh,
        ply::{Problem, element::Vertex},
    },
};

/// A mesh whose indices are not checked yet.
#[derive(Default)]
pub(super) struct MeshBuilder {
    mesh: Mesh,
    colored: bool,
}

impl MeshBuilder {
    /// Reserves memory; `n_vertices` must have been checked against the file's size.
    pub(super) fn reserve_vertices(&mut self, n_vertices: usize, colored: bool) -> Result<(), Problem> {
        if n_vertices >= u32::MAX as usize {
            return Err(Problem::TooMany("vertices"));
        }
        self.colored = colored;
        reserve(&mut self.mesh.vertices, n_vertices, "vertices")?;
        if colored { reserve(&mut self.mesh.colors, n_vertices, "colours") } else { Ok(()) }
    }

    pub(super) fn reserve_triangles(&mut self, n_triangles: usize) -> Result<(), Problem> {
        reserve(&mut self.mesh.triangles, n_triangles, "triangles")
    }

    pub(super) fn push_vertex(&mut self, vertex: &Vertex) -> Result<(), Problem> {
        self.place_origin(vertex.position);
        self.mesh.vertices.push((vertex.position - self.mesh.origin).as_vec3().to_array());
        if self.colored {
            self.mesh.colors.push(vertex.color);
        }
        Ok(())
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

    /// Fans a polygon: (0, 1, 2), (0, 2, 3), …
    pub(super) fn push_polygon(&mut self, corners: &[u32]) -> Result<(), Problem> {
        let Some((&first, rest)) = corners.split_first() else { return Ok(()) };
        self.check_triangle_count(rest.len().saturating_sub(1))?;
        self.mesh.triangles.extend(rest.windows(2).map(|edge| [first, edge[0], edge[1]]));
        Ok(())
    }

    /// Unrolls strips, separated by negative indices; flips every other triangle, so that all face the same way.
    pub(super) fn push_strips(&mut self, corners: &[u32]) -> Result<(), Problem> {
        self.check_triangle_count(corners.len())?;
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
        for triangle in &mut mesh.triangles {
            if !triangle.iter().all(usable) {
                *triangle = Mesh::REJECTED;
                mesh.n_rejected += 1;
            }
        }
        mesh
    }

    fn check_triangle_count(&mut self, n_triangles: usize) -> Result<(), Problem> {
        // The triangle index `u32::MAX` means a miss, and the one before it a cap.
        if self.mesh.triangles.len() + n_triangles >= u32::MAX as usize {
            return Err(Problem::TooMany("triangles"));
        }
        Ok(())
    }
}

fn reserve<T>(items: &mut Vec<T>, n_items: usize, what: &'static str) -> Result<(), Problem> {
    let n_bytes = n_items.saturating_mul(size_of::<T>());
    memory::handling_failure(|| items.try_reserve_exact(n_items)).map_err(|_| Problem::OutOfMemory { what, n_bytes })
}
