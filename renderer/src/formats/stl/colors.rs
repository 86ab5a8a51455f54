//! Colours of a binary STL: programs keep them in its title, and in the two bytes after each triangle.
//!
//! "STL (file format)", Wikipedia, has both layouts: that of Materialise Magics, and that of VisCAM and SolidView.

use crate::formats::{
    assembly::AssemblyError,
    wedges::{self, Look},
};
use crate::model::{mesh::Mesh, normal::Normal};

/// The colour of triangles that have none.
const WHITE: [u8; 3] = [u8::MAX; 3];

/// The colours of triangles, taken as sRGB: the format names no colour space.
pub(super) struct Colors {
    /// The whole model's, if the title has it: then triangles are coloured as by Magics.
    of_model: Option<[u8; 3]>,
    /// The last two bytes of triangles, up to the last that are not 0.
    of_triangles: Vec<u16>,
}

impl Colors {
    pub(super) fn new(title: &[u8]) -> Self {
        const MARK: &[u8] = b"COLOR=";
        let mark = title.windows(MARK.len()).position(|bytes| bytes == MARK);
        let of_model = mark.and_then(|at| title[at + MARK.len()..].first_chunk().copied());
        Self { of_model, of_triangles: Vec::new() }
    }

    /// Adds the last two bytes of a triangle; `triangle` counts up.
    pub(super) fn push(&mut self, triangle: usize, bytes: [u8; 2]) {
        let bits = u16::from_le_bytes(bytes);
        if bits != 0 {
            self.of_triangles.resize(triangle, 0);
            self.of_triangles.push(bits);
        }
    }

    fn of(&self, triangle: usize) -> [u8; 3] {
        let bits = self.of_triangles.get(triangle).copied().unwrap_or(0);
        let parts = [0, 5, 10].map(|shift| ((u32::from(bits >> shift & 31) * 255 + 15) / 31) as u8);
        let [low, green, high] = parts;
        let is_marked = bits >> 15 == 1;
        match self.of_model {
            // Programs that leave all these bytes alone do not mean black.
            Some(color) if is_marked || self.of_triangles.is_empty() => color,
            Some(_) => [low, green, high],
            None if is_marked => [high, green, low],
            None => WHITE,
        }
    }

    /// Gives a mesh the colours. A vertex is split where triangles of different colours meet.
    pub(super) fn paint(&self, mesh: &mut Mesh) -> Result<(), AssemblyError> {
        let first = self.of(0);
        if (1..mesh.triangles.len()).any(|triangle| self.of(triangle) != first) {
            let color = |triangle: usize| Some(self.of(triangle));
            return wedges::split(mesh, |triangle, _, _| Look {
                texture_coordinates: None,
                normal: Normal::OF_TRIANGLE,
                color: color(triangle),
            });
        }
        if first != WHITE {
            mesh.colors = vec![first; mesh.vertices.len()];
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The colours of the corners of each triangle of a strip.
    fn painted(title: &[u8], of_triangles: &[u16]) -> Vec<[[u8; 3]; 3]> {
        let mut colors = Colors::new(title);
        for (triangle, bits) in of_triangles.iter().enumerate() {
            colors.push(triangle, bits.to_le_bytes());
        }
        let n = of_triangles.len() as u32;
        let mut mesh = Mesh {
            vertices: (0..n + 2).map(|i| [i as f32, (i % 2) as f32, 0.0]).collect(),
            triangles: (0..n).map(|i| [i, i + 1, i + 2]).collect(),
            ..Mesh::default()
        };
        let before: Vec<_> = (0..of_triangles.len()).map(|triangle| mesh.corners(triangle)).collect();
        colors.paint(&mut mesh).unwrap();
        assert!((0..of_triangles.len()).all(|triangle| mesh.corners(triangle) == before[triangle]));
        let color = |vertex: u32| mesh.colors.get(vertex as usize).copied().unwrap_or(WHITE);
        mesh.triangles.iter().map(|corners| corners.map(color)).collect()
    }

    #[test]
    fn triangles_have_the_colours_of_their_program() {
        const RED: [u8; 3] = [255, 0, 0];
        const MAGICS: &[u8] = b"a part COLOR=\xff\x00\x00\xff,MATERIAL=";
        for (title, of_triangles, expected) in [
            (&b"VXelements"[..], [0x801f, 0xfc00, 0x83e0], [[0, 0, 255], RED, [0, 255, 0]]),
            // Without its bit, a colour is none.
            (b"", [0x001f, 0xc210, 0], [WHITE, [132; 3], WHITE]),
            (b"", [0; 3], [WHITE; 3]),
            (b"", [0xfc00; 3], [RED; 3]),
            (MAGICS, [0x7c00, 0x8000, 0x03e0], [[0, 0, 255], RED, [0, 255, 0]]),
            (MAGICS, [0, 0xffff, 0x001f], [[0; 3], RED, RED]),
            (MAGICS, [0; 3], [RED; 3]),
            (b"COLOR=\xff", [0; 3], [WHITE; 3]),
        ] {
            let corners = painted(title, &of_triangles);
            assert_eq!(corners, expected.map(|color| [color; 3]), "{title:?}: {of_triangles:x?}");
        }
    }
}
