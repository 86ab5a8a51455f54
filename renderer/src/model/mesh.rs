//! A triangle mesh as read from a file: indexed, in file order, with unusable triangles marked.

use glam::{DVec3, Vec3, Vec3A};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use shared::camera::UpAxis;

use crate::model::{lattice::Lattice, material::Materials, normal::Normal};

/// A triangle mesh, in model space: the file's coordinates, which are world space, relative to an origin.
///
/// At the coordinates of a map grid `f32` steps by half a metre, beside an origin on the model by micrometres.
///
/// Invariant: every triangle either has indices of usable vertices or is [`Mesh::REJECTED`]. Rejected triangles are kept, so
/// that a triangle's position in `triangles` is its file index.
/// `colors`, `normals` and `texture_coordinates` are empty or have one entry per vertex. Vertices that differ in one of these
/// alone have equal positions, so hits do not depend on them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Positions. Vertices that no accepted triangle uses may hold any value, even NaN.
    pub vertices: Vec<[f32; 3]>,
    /// The lattice that all usable positions lie on, if they do.
    pub lattice: Option<Lattice>,
    /// The zero of model space, in world space; finite. It is zero if `f32` holds the file's coordinates as they are.
    pub origin: DVec3,
    /// Vertex indices, polygons fanned in file order.
    pub triangles: Vec<[u32; 3]>,
    /// sRGB colours of the vertices.
    pub colors: Vec<[u8; 3]>,
    /// Normals of the vertices; see [`Mesh::smooth`].
    pub normals: Vec<Normal>,
    /// Coordinates u and v of the vertices on textures, as glTF has them: (0, 0) is the upper left corner of the image, (1, 1)
    /// the lower right. They may hold any value, even NaN.
    pub texture_coordinates: Vec<[f32; 2]>,
    /// The materials of the triangles.
    pub materials: Materials,
    /// The axis that points up, if the file's format says so.
    pub up: Option<UpAxis>,
    /// Number of triangles that are [`Mesh::REJECTED`].
    pub n_rejected: usize,
}

/// An axis-aligned bounding box, in model space. Empty boxes have `min > max`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Aabb {
    /// Lowest coordinates.
    pub min: [f32; 3],
    /// Highest coordinates.
    pub max: [f32; 3],
}

impl Aabb {
    /// The empty box.
    pub const EMPTY: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    /// The smallest box around this box and a point.
    #[must_use]
    pub fn extend(self, point: [f32; 3]) -> Self {
        self.union(Self { min: point, max: point })
    }

    /// The smallest box around both boxes.
    #[must_use]
    pub fn union(mut self, other: Self) -> Self {
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(other.min[axis]);
            self.max[axis] = self.max[axis].max(other.max[axis]);
        }
        self
    }

    /// Lowest and highest corner.
    pub fn corners(&self) -> [DVec3; 2] {
        [self.min, self.max].map(|corner| Vec3::from_array(corner).as_dvec3())
    }

    /// Whether the box contains no point.
    pub fn is_empty(&self) -> bool {
        self.min[0] > self.max[0]
    }
}

impl Mesh {
    /// Replaces a triangle with an index out of range, or a vertex that is not [usable](Mesh::is_usable).
    pub const REJECTED: [u32; 3] = [u32::MAX; 3];

    /// Limit of coordinates: a camera that sees the whole model is nearer than 10¹⁸, beyond which products would overflow `f32`.
    pub const LARGEST_COORDINATE: f32 = 1e17;

    /// Whether a triangle with a vertex at this position can be traced.
    pub fn is_usable(position: [f32; 3]) -> bool {
        position.iter().all(|x| x.abs() < Self::LARGEST_COORDINATE)
    }

    /// The corners of a triangle; `None` if it was rejected.
    #[inline]
    pub fn corners(&self, triangle: usize) -> Option<[[f32; 3]; 3]> {
        let [a, b, c] = self.triangles[triangle];
        let vertex = |index: u32| self.vertices[index as usize];
        ([a, b, c] != Self::REJECTED).then(|| [vertex(a), vertex(b), vertex(c)])
    }

    /// The bounds of all triangles that can be traced.
    pub fn bounds(&self) -> Aabb {
        const TRIANGLES_PER_JOB: usize = 1 << 14;
        let of_some = |triangles: &[[u32; 3]]| {
            let (mut min, mut max) = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
            for &index in triangles.iter().filter(|triangle| **triangle != Self::REJECTED).flatten() {
                let vertex = Vec3A::from_array(self.vertices[index as usize]);
                (min, max) = (min.min(vertex), max.max(vertex));
            }
            Aabb { min: min.to_array(), max: max.to_array() }
        };
        self.triangles.par_chunks(TRIANGLES_PER_JOB).map(of_some).reduce(|| Aabb::EMPTY, Aabb::union)
    }

    /// The lowest and highest corner of the bounds, in world space.
    pub fn extent(&self) -> [DVec3; 2] {
        self.bounds().corners().map(|corner| corner + self.origin)
    }

    /// The farthest that rounding to `f32` can have moved a coordinate of a triangle, in world units.
    pub fn largest_rounding(&self) -> f64 {
        let largest = self.bounds().corners().map(|corner| corner.abs().max_element());
        let half_step = 0.5 * f64::from(f32::EPSILON);
        if self.origin == DVec3::ZERO { 0.0 } else { largest[0].max(largest[1]) * half_step }
    }

    /// Bytes of the mesh in memory.
    pub fn n_bytes(&self) -> usize {
        size_of_val(&*self.vertices)
            + size_of_val(&*self.triangles)
            + size_of_val(&*self.colors)
            + size_of_val(&*self.normals)
            + size_of_val(&*self.texture_coordinates)
            + self.materials.n_bytes()
    }
}
