//! Corners that meet in one position with different looks: each look gets a vertex of its own.

use crate::formats::assembly::AssemblyError;
use crate::model::{mesh::Mesh, normal::Normal};

/// The look of a corner.
#[derive(Clone, Copy)]
pub(super) struct Look {
    pub(super) texture_coordinates: Option<[f32; 2]>,
    pub(super) normal: Normal,
    /// Replaces the vertex's own, if there is one.
    pub(super) color: Option<[u8; 3]>,
}

impl Look {
    fn is_same(&self, other: &Self) -> bool {
        let bits = |look: &Self| look.texture_coordinates.map(|coordinates| coordinates.map(f32::to_bits));
        bits(self) == bits(other) && self.normal == other.normal && self.color == other.color
    }
}

/// Vertices of one position that a new look is compared with. A million triangles around one position take no time.
const MOST_COMPARED: usize = 32;
/// No further vertex has this position.
const LAST: u32 = u32::MAX;
/// No corner has this vertex yet.
const UNUSED: u32 = u32::MAX - 1;

/// Gives vertices the looks of their corners, and splits those whose corners differ. `look` receives a triangle, one of
/// its corners, 0 to 2, and the vertex there.
pub(super) fn split(mesh: &mut Mesh, look: impl Fn(usize, usize, usize) -> Look) -> Result<(), AssemblyError> {
    let n_positions = mesh.vertices.len();
    let none = Look { texture_coordinates: None, normal: Normal::OF_TRIANGLE, color: None };
    let mut looks = vec![none; n_positions];
    let mut next = vec![UNUSED; n_positions];
    for triangle in 0..mesh.triangles.len() {
        if mesh.triangles[triangle] == Mesh::REJECTED {
            continue;
        }
        for corner in 0..3 {
            let position = mesh.triangles[triangle][corner] as usize;
            let look = look(triangle, corner, position);
            if next[position] == UNUSED {
                (looks[position], next[position]) = (look, LAST);
            }
            let mut vertices = std::iter::successors(Some(position as u32), |&vertex| {
                Some(next[vertex as usize]).filter(|&next| next != LAST)
            });
            let same = vertices.by_ref().take(MOST_COMPARED).find(|&vertex| looks[vertex as usize].is_same(&look));
            mesh.triangles[triangle][corner] = match same {
                Some(vertex) => vertex,
                None => {
                    let vertex = looks.len();
                    if vertex >= UNUSED as usize {
                        return Err(AssemblyError::TooMany("vertices"));
                    }
                    looks.push(look);
                    next.push(next[position]);
                    next[position] = vertex as u32;
                    mesh.vertices.push(mesh.vertices[position]);
                    if !mesh.colors.is_empty() {
                        mesh.colors.push(mesh.colors[position]);
                    }
                    vertex as u32
                }
            };
        }
    }
    mesh.vertices.shrink_to_fit();
    if looks.iter().any(|look| look.normal != Normal::OF_TRIANGLE) {
        mesh.normals = looks.iter().map(|look| look.normal).collect();
    }
    if looks.iter().any(|look| look.texture_coordinates.is_some()) {
        mesh.texture_coordinates = looks.iter().map(|look| look.texture_coordinates.unwrap_or_default()).collect();
    }
    if looks.iter().any(|look| look.color.is_some()) {
        mesh.colors = looks.iter().map(|look| look.color.unwrap_or([u8::MAX; 3])).collect();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_corners_that_differ_get_vertices_of_their_own() {
        let mut mesh = Mesh {
            vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [9.0; 3]],
            triangles: vec![[0, 1, 2], Mesh::REJECTED, [2, 1, 0], [0, 1, 2]],
            colors: vec![[1; 3], [2; 3], [3; 3], [4; 3]],
            ..Mesh::default()
        };
        let before: Vec<_> = (0..4).map(|triangle| mesh.corners(triangle)).collect();
        split(&mut mesh, |triangle, corner, _| Look {
            texture_coordinates: Some(if (triangle, corner) == (2, 2) { [1.0, 0.0] } else { [0.0; 2] }),
            normal: Normal::OF_TRIANGLE,
            color: None,
        })
        .unwrap();
        assert_eq!(mesh.triangles, [[0, 1, 2], Mesh::REJECTED, [2, 1, 4], [0, 1, 2]]);
        assert_eq!((0..4).map(|triangle| mesh.corners(triangle)).collect::<Vec<_>>(), before);
        assert_eq!((mesh.colors[4], mesh.texture_coordinates[4]), ([1; 3], [1.0, 0.0]));
        assert!(mesh.normals.is_empty());
    }

    #[test]
    fn many_looks_of_one_position_take_no_time() {
        let n = 200_000;
        let mut mesh = Mesh { vertices: vec![[0.0; 3]], triangles: vec![[0; 3]; n], ..Mesh::default() };
        split(&mut mesh, |triangle, corner, _| Look {
            texture_coordinates: Some([triangle as f32, corner as f32]),
            normal: Normal::OF_TRIANGLE,
            color: None,
        })
        .unwrap();
        assert_eq!(mesh.vertices.len(), 3 * n);
    }
}
