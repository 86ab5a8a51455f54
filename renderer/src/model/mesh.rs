//! A triangle mesh as it comes from a file: indexed, in file order, with what cannot be traced marked.

use rayon::prelude::*;

/// A triangle mesh, in world space.
///
/// Invariant: every triangle's indices lie within `vertices` and point at usable vertices, or it is [`Mesh::REJECTED`]:
/// a rejected triangle keeps its place, so that a triangle's index is its number in the file.
/// `colors` is empty or has one entry per vertex.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Positions. Those that no accepted triangle uses may be anything.
    pub vertices: Vec<[f32; 3]>,
    /// Indices of vertices, polygons fanned in file order.
    pub triangles: Vec<[u32; 3]>,
    /// sRGB colours of the vertices.
    pub colors: Vec<[u8; 3]>,
    /// How many triangles are [`Mesh::REJECTED`].
    pub n_rejected: usize,
}

/// A box aligned with the axes, in world space. Empty boxes have `min > max`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Lowest coordinates.
    pub min: [f32; 3],
    /// Highest coordinates.
    pub max: [f32; 3],
}

impl Aabb {
    /// The box that holds nothing.
    pub const EMPTY: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    /// The smallest box around this one and a point.
    #[must_use]
    pub fn extend(self, point: [f32; 3]) -> Self {
        self.union(Self { min: point, max: point })
    }

    /// The smallest box around both.
    #[must_use]
    pub fn union(mut self, other: Self) -> Self {
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(other.min[axis]);
            self.max[axis] = self.max[axis].max(other.max[axis]);
        }
        self
    }

    /// Whether nothing is inside.
    pub fn is_empty(&self) -> bool {
        self.min[0] > self.max[0]
    }
}

impl Mesh {
    /// What stands in place of a triangle that cannot be traced: a vertex of it is not finite or not below
    /// [`Mesh::LARGEST_COORDINATE`], or an index points nowhere.
    pub const REJECTED: [u32; 3] = [u32::MAX; 3];

    /// Coordinates beyond this are rejected: their products with rays would leave the range of `f32` (Embree's limit).
    pub const LARGEST_COORDINATE: f32 = 1.844e18;

    /// Whether a position can be traced.
    pub fn is_usable(position: [f32; 3]) -> bool {
        position.iter().all(|x| x.abs() < Self::LARGEST_COORDINATE)
    }

    /// The corners of a triangle, or `None` if it was rejected.
    #[inline]
    pub fn corners(&self, triangle: usize) -> Option<[[f32; 3]; 3]> {
        let [a, b, c] = self.triangles[triangle];
        let vertex = |index: u32| self.vertices[index as usize];
        ([a, b, c] != Self::REJECTED).then(|| [vertex(a), vertex(b), vertex(c)])
    }

    /// The bounds of all triangles that can be traced.
    pub fn bounds(&self) -> Aabb {
        let extend = |bounds: Aabb, triangle| self.corners(triangle).into_iter().flatten().fold(bounds, Aabb::extend);
        let parts = (0..self.triangles.len()).into_par_iter().fold(|| Aabb::EMPTY, extend);
        parts.reduce(|| Aabb::EMPTY, Aabb::union)
    }

    /// Bytes of the mesh in memory.
    pub fn n_bytes(&self) -> usize {
        size_of_val(&*self.vertices) + size_of_val(&*self.triangles) + size_of_val(&*self.colors)
    }
}
