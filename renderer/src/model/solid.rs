//! Tells whether a mesh bounds a solid, so that a plane that cuts it shows matter.

use std::cmp::Ordering;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::model::mesh::Mesh;

/// The side of its triangles on which a solid has no matter: where their corners run counter-clockwise, or the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[expect(missing_docs, reason = "the names say it")]
pub enum Facing {
    Outward,
    Inward,
}

/// Says why cuts through a mesh that bounds no solid are not filled.
pub const UNFILLED: &str = "Cuts show the inside: the surface has holes, or triangles that face different ways";

/// Triangles whose volumes are added in order.
const CHUNK: usize = 1 << 14;

impl Mesh {
    /// How the triangles of a solid face; `None` if they leave holes, face different ways, or enclose no volume.
    ///
    /// Each edge adds a hash of its ends to a sum, and subtracts it where a triangle passes it the other way: a mesh with
    /// an edge that is not passed as often both ways has the sum 0 once in 2⁶⁴. Ends are told apart by position, because
    /// many files repeat a vertex for each of its triangles.
    pub fn facing(&self) -> Option<Facing> {
        let origin = (0..self.triangles.len()).find_map(|triangle| self.corners(triangle))?[0];
        let origin = Vec3::from_array(origin).as_dvec3();
        let of_chunk = |(chunk, triangles): (usize, &[[u32; 3]])| {
            let indices = (0..triangles.len()).map(|index| chunk * CHUNK + index);
            indices.filter_map(|triangle| self.corners(triangle)).fold((0u64, 0.0), |(edges, volume), corners| {
                let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3() - origin);
                (edges.wrapping_add(signed_edges(corners)), volume + a.dot(DVec3::cross(b, c)))
            })
        };
        let parts: Vec<_> = self.triangles.par_chunks(CHUNK).enumerate().map(of_chunk).collect();
        // Added in order, the volumes have the same sign on every machine.
        let (edges, volume) = parts.into_iter().fold((0u64, 0.0), |(edges, volume), (more_edges, more_volume)| {
            (edges.wrapping_add(more_edges), volume + more_volume)
        });
        match volume.partial_cmp(&0.0)? {
            _ if edges != 0 => None,
            Ordering::Greater => Some(Facing::Outward),
            Ordering::Less => Some(Facing::Inward),
            Ordering::Equal => None,
        }
    }
}

/// The sum of a triangle's edges, each with the sign of its direction.
fn signed_edges(corners: [[f32; 3]; 3]) -> u64 {
    let [a, b, c] = corners.map(|corner| {
        // Adding 0 makes −0 equal to 0.
        let [x, y, z] = corner.map(|coordinate| u64::from((coordinate + 0.0).to_bits()));
        scramble((x | y << 32).wrapping_mul(0xd6e8_feb8_6659_fd93) ^ z.rotate_left(20))
    });
    let edge = |from: u64, to: u64| match from.cmp(&to) {
        Ordering::Less => scramble(from.wrapping_mul(3) ^ to),
        Ordering::Equal => 0,
        Ordering::Greater => scramble(to.wrapping_mul(3) ^ from).wrapping_neg(),
    };
    edge(a, b).wrapping_add(edge(b, c)).wrapping_add(edge(c, a))
}

/// The finalizer of `SplitMix64`.
fn scramble(bits: u64) -> u64 {
    let bits = bits.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ bits >> 31
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::statue;

    #[test]
    fn solids_are_told_from_surfaces_with_holes() {
        let solid = statue::generate(40_000, &|_| ());
        assert_eq!(solid.facing(), Some(Facing::Outward));

        let mut inward = solid.clone();
        inward.triangles.iter_mut().for_each(|corners| corners.swap(1, 2));
        assert_eq!(inward.facing(), Some(Facing::Inward));

        // As exported from STL: each triangle has vertices of its own, and some zeros are negative.
        let corners = solid.triangles.as_flattened().iter();
        let mut unshared = Mesh {
            vertices: corners.map(|&vertex| solid.vertices[vertex as usize]).collect(),
            triangles: (0..solid.triangles.len() as u32).map(|n| [3 * n, 3 * n + 1, 3 * n + 2]).collect(),
            ..Mesh::default()
        };
        unshared.vertices.iter_mut().step_by(2).flatten().filter(|x| **x == 0.0).for_each(|x| *x = -0.0);
        assert_eq!(unshared.facing(), Some(Facing::Outward));

        for spoil in [
            |mesh: &mut Mesh| mesh.triangles.truncate(39_000),
            |mesh: &mut Mesh| mesh.triangles[777] = Mesh::REJECTED,
            |mesh: &mut Mesh| mesh.triangles[777].swap(0, 1),
            |mesh: &mut Mesh| mesh.triangles.push([1, 2, 3]),
            |mesh: &mut Mesh| mesh.triangles.clear(),
        ] {
            let mut spoilt = solid.clone();
            spoil(&mut spoilt);
            assert_eq!(spoilt.facing(), None);
        }

        // A sheet with two sides is closed, but encloses nothing; repeated corners change nothing.
        let vertices = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let facing = |triangles: &[[u32; 3]]| {
            Mesh { vertices: vertices.clone(), triangles: triangles.to_vec(), ..Mesh::default() }.facing()
        };
        assert_eq!(facing(&[[0, 1, 2], [2, 1, 0]]), None);
        assert_eq!(facing(&[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3], [1, 1, 3]]), Some(Facing::Outward));
    }
}
