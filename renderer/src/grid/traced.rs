//! The copy of a mesh that rays meet: what lies close together in space lies close together in memory.

use rayon::prelude::*;

use crate::{
    intersect::simd::Simd,
    model::mesh::{Aabb, Mesh},
};

/// A mesh in the order of a grid's cells, without what cannot be hit.
///
/// Triangles are named by their *place* here; [`TracedMesh::number`] gives a triangle's number in the file.
#[derive(Debug)]
pub struct TracedMesh {
    /// Positions; without indices three for each triangle.
    /// One more than the triangles mention, see [`TracedMesh::coordinates`].
    vertices: Vec<[f32; 3]>,
    /// The vertices of each triangle; empty in a flat mesh.
    triangles: Vec<[u32; 3]>,
    /// Numbers in the file, by place.
    file_indices: Vec<u32>,
    /// Empty, or one for each vertex.
    colors: Vec<[u8; 3]>,
    bounds: Aabb,
}

impl TracedMesh {
    /// Bytes that a mesh takes at most while it is put in order, as loaded and as traced, the references not counted.
    pub(crate) fn peak_bytes(mesh: &Mesh, is_flat: bool) -> u64 {
        // With new numbers of triangles and vertices in both directions.
        let (n_triangles, n_vertices) = (mesh.triangles.len() as u64, mesh.vertices.len() as u64);
        let ordering = mesh.n_bytes() as u64 + Self::bytes_in_order(mesh, false) + 4 * n_triangles + 8 * n_vertices;
        ordering.max(Self::bytes_in_order(mesh, is_flat))
    }

    /// Bytes that a mesh takes at most once it is in order, the references not counted.
    pub(crate) fn bytes_in_order(mesh: &Mesh, is_flat: bool) -> u64 {
        let (n_triangles, n_vertices) = (mesh.triangles.len() as u64, mesh.vertices.len() as u64);
        let color_bytes = size_of_val(&*mesh.colors) as u64;
        // With numbers in the file.
        let indexed = 16 * n_triangles + 12 * n_vertices + color_bytes;
        let flat_corner_bytes = if mesh.colors.is_empty() { 12 } else { 15 };
        if is_flat { indexed + 3 * flat_corner_bytes * n_triangles } else { indexed }
    }

    /// Orders a mesh by the first mention of each triangle in `references`, and makes the references places.
    pub fn new(mesh: Mesh, references: &mut [u32]) -> Self {
        let bounds = mesh.bounds();
        let Mesh { vertices, triangles, colors, .. } = mesh;
        let mut file_indices = Vec::new();
        let mut places = Renumbering::new(triangles.len());
        for &reference in &*references {
            places.assign(reference, |number| file_indices.push(number));
        }
        let Renumbering { places, .. } = places;
        let to_places = || references.par_iter_mut().for_each(|reference| *reference = places[*reference as usize]);
        let mut kept_vertices = Vec::new();
        let mut vertex_places = Renumbering::new(vertices.len());
        let place_vertices = || {
            for vertex in file_indices.iter().flat_map(|&number| triangles[number as usize]) {
                vertex_places.assign(vertex, |vertex| kept_vertices.push(vertex));
            }
        };
        rayon::join(to_places, place_vertices);
        drop(places);
        // By all threads, for memory that is written for the first time is waited for.
        let in_order = file_indices.par_iter().map(|&number| triangles[number as usize]);
        let new_places = |of_triangle: [u32; 3]| of_triangle.map(|vertex| vertex_places.places[vertex as usize]);
        let triangles_in_order = in_order.map(new_places).collect();
        drop((triangles, vertex_places));
        let is_colored = !colors.is_empty();
        Self {
            vertices: padded(kept_vertices.par_iter().map(|&vertex| vertices[vertex as usize])),
            triangles: triangles_in_order,
            file_indices,
            colors: kept_vertices.iter().filter(|_| is_colored).map(|&vertex| colors[vertex as usize]).collect(),
            bounds,
        }
    }

    /// The same mesh with three corners of its own for each triangle, and no indices.
    #[must_use]
    pub(crate) fn into_flat(self) -> Self {
        let Self { vertices, triangles, file_indices, colors, bounds } = self;
        let is_colored = !colors.is_empty();
        Self {
            vertices: padded((0..3 * triangles.len()).into_par_iter().map(|corner| {
                let vertex = triangles[corner / 3][corner % 3];
                vertices[vertex as usize]
            })),
            colors: triangles.iter().flatten().filter(|_| is_colored).map(|&v| colors[v as usize]).collect(),
            triangles: Vec::new(),
            file_indices,
            bounds,
        }
    }

    /// How many triangles can be hit.
    pub fn n_triangles(&self) -> usize {
        self.file_indices.len()
    }

    /// The number in the file of the triangle at a place.
    #[inline]
    pub fn file_index(&self, triangle_idx: u32) -> u32 {
        self.file_indices[triangle_idx as usize]
    }

    /// The corners of the triangle at a place, in world space.
    #[inline]
    pub fn corners(&self, triangle_idx: u32) -> [[f32; 3]; 3] {
        self.indices(triangle_idx).map(|vertex| self.vertices[vertex as usize])
    }

    /// The vertices of the triangle at a place, which are all there.
    ///
    /// # Panics
    ///
    /// If there is no such triangle.
    #[inline]
    pub(crate) fn indices(&self, triangle_idx: u32) -> [u32; 3] {
        if self.triangles.is_empty() {
            assert!((triangle_idx as usize) < self.n_triangles(), "no triangle {triangle_idx}");
            [3 * triangle_idx, 3 * triangle_idx + 1, 3 * triangle_idx + 2]
        } else {
            self.triangles[triangle_idx as usize]
        }
    }

    /// The sRGB colours of the corners of the triangle at a place, if the mesh has colours.
    #[inline]
    pub fn corner_colors(&self, triangle_idx: u32) -> Option<[[u8; 3]; 3]> {
        let color = |vertex: u32| self.colors[vertex as usize];
        (!self.colors.is_empty()).then(|| self.indices(triangle_idx).map(color))
    }

    /// The bounds of all triangles, in world space.
    pub fn bounds(&self) -> Aabb {
        self.bounds
    }

    /// Bytes in memory.
    pub fn n_bytes(&self) -> usize {
        size_of_val(&*self.vertices)
            + size_of_val(&*self.triangles)
            + size_of_val(&*self.file_indices)
            + size_of_val(&*self.colors)
    }

    /// Hints that the triangle at a place will be read soon.
    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, triangle_idx: u32) {
        if self.triangles.is_empty() {
            S::prefetch(&self.vertices, 3 * triangle_idx as usize);
        } else {
            S::prefetch(&self.triangles, triangle_idx as usize);
        }
    }

    /// Hints that the corners of the triangle at a place will be read soon; the triangle itself is read now.
    #[inline(always)]
    pub(crate) fn prefetch_corners<S: Simd>(&self, triangle_idx: u32) {
        if let Some(&[a, b, c]) = self.triangles.get(triangle_idx as usize) {
            S::prefetch(&self.vertices, a as usize);
            S::prefetch(&self.vertices, b as usize);
            S::prefetch(&self.vertices, c as usize);
        }
    }

    /// For each corner of the triangles at some places, and for each axis, its coordinates.
    #[inline(always)]
    pub(crate) fn gather_corners<S: Simd>(&self, places: &[u32; 16]) -> [[S; 3]; 3] {
        let mut vertices = [[0; 16]; 3];
        for lane in 0..S::LANES {
            let [a, b, c] = self.indices(places[lane]);
            (vertices[0][lane], vertices[1][lane], vertices[2][lane]) = (a, b, c);
        }
        let coordinates = self.coordinates();
        let [a, b, c] = &vertices;
        // SAFETY: triangles have vertices that are there, and another follows the last.
        unsafe { [S::gather_xyz(coordinates, a), S::gather_xyz(coordinates, b), S::gather_xyz(coordinates, c)] }
    }

    /// The coordinates of all vertices, one vertex after the other, and three more.
    pub(crate) fn coordinates(&self) -> &[f32] {
        bytemuck::cast_slice(&self.vertices)
    }
}

/// Vertices and one more, so that vectors can be loaded from the last.
fn padded(vertices: impl IndexedParallelIterator<Item = [f32; 3]>) -> Vec<[f32; 3]> {
    let mut padded = Vec::with_capacity(vertices.len() + 1);
    padded.par_extend(vertices);
    padded.push([0.0; 3]);
    padded
}

/// New numbers, given in the order of first mention.
struct Renumbering {
    places: Vec<u32>,
    n_assigned: u32,
}

impl Renumbering {
    fn new(n: usize) -> Self {
        Self { places: vec![u32::MAX; n], n_assigned: 0 }
    }

    /// The new number of `old`; calls `first` if it has none yet.
    #[inline]
    fn assign(&mut self, old: u32, first: impl FnOnce(u32)) -> u32 {
        let new_index = &mut self.places[old as usize];
        if *new_index == u32::MAX {
            *new_index = self.n_assigned;
            self.n_assigned += 1;
            first(old);
        }
        *new_index
    }
}
