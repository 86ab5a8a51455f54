//! The copy of a mesh that rays meet: what lies close together in space lies close together in memory.

use crate::mesh::{Aabb, Mesh};

/// A mesh in the order of a grid's cells, without what cannot be hit.
///
/// Triangles are named by their *place* here; [`TracedMesh::number`] gives a triangle's number in the file.
#[derive(Debug)]
pub struct TracedMesh {
    vertices: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
    /// Numbers in the file, by place.
    numbers: Vec<u32>,
    /// Empty, or one for each vertex.
    colors: Vec<[u8; 3]>,
    bounds: Aabb,
}

impl TracedMesh {
    /// Orders a mesh by the first mention of each triangle in `references`, and makes the references places.
    pub(crate) fn new(mesh: Mesh, references: &mut [u32]) -> Self {
        let bounds = mesh.bounds();
        let Mesh { vertices, triangles, colors, .. } = mesh;
        let mut numbers = Vec::new();
        let mut places = Renumbering::new(triangles.len());
        for reference in references {
            *reference = places.place(*reference, |number| numbers.push(number));
        }
        let mut kept = Vec::new();
        let mut places = Renumbering::new(vertices.len());
        let triangles = numbers
            .iter()
            .map(|&number| triangles[number as usize].map(|vertex| places.place(vertex, |vertex| kept.push(vertex))))
            .collect();
        Self {
            vertices: kept.iter().map(|&vertex| vertices[vertex as usize]).collect(),
            triangles,
            numbers,
            colors: if colors.is_empty() {
                colors
            } else {
                kept.iter().map(|&vertex| colors[vertex as usize]).collect()
            },
            bounds,
        }
    }

    /// How many triangles can be hit.
    pub fn n_triangles(&self) -> usize {
        self.triangles.len()
    }

    /// The number in the file of the triangle at a place.
    #[inline]
    pub fn number(&self, place: u32) -> u32 {
        self.numbers[place as usize]
    }

    /// The corners of the triangle at a place, in world space.
    #[inline]
    pub fn corners(&self, place: u32) -> [[f32; 3]; 3] {
        self.triangles[place as usize].map(|vertex| self.vertices[vertex as usize])
    }

    /// The sRGB colours of the corners of the triangle at a place, if the mesh has colours.
    #[inline]
    pub fn corner_colors(&self, place: u32) -> Option<[[u8; 3]; 3]> {
        let color = |vertex: u32| self.colors[vertex as usize];
        (!self.colors.is_empty()).then(|| self.triangles[place as usize].map(color))
    }

    /// The bounds of all triangles, in world space.
    pub fn bounds(&self) -> Aabb {
        self.bounds
    }

    /// Bytes in memory.
    pub fn n_bytes(&self) -> usize {
        size_of_val(&*self.vertices)
            + size_of_val(&*self.triangles)
            + size_of_val(&*self.numbers)
            + size_of_val(&*self.colors)
    }

    pub(crate) fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    pub(crate) fn vertices(&self) -> &[[f32; 3]] {
        &self.vertices
    }
}

/// New numbers, given in the order of first mention.
struct Renumbering {
    places: Vec<u32>,
    n_given: u32,
}

impl Renumbering {
    fn new(n: usize) -> Self {
        Self { places: vec![u32::MAX; n], n_given: 0 }
    }

    /// The new number of `old`; calls `first` if it has none yet.
    #[inline]
    fn place(&mut self, old: u32, first: impl FnOnce(u32)) -> u32 {
        let place = &mut self.places[old as usize];
        if *place == u32::MAX {
            *place = self.n_given;
            self.n_given += 1;
            first(old);
        }
        *place
    }
}
