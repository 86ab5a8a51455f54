//! Reads STL files, text or binary. Their triangles share no corners: equal positions become one vertex.

mod colors;
mod words;

use std::io::Read;

use glam::DVec3;

use self::{colors::Colors, words::Words};
use crate::formats::{
    assembly::{AssemblyError, MeshBuilder, TextProblem},
    decimal::Decimal,
    file::Draft,
};

/// Bytes before the triangles of a binary file: a title and their number.
const HEADER_BYTES: usize = 84;
const TITLE_BYTES: usize = 80;
/// A normal, three corners, and two bytes in which programs keep [`colors`].
const TRIANGLE_BYTES: usize = 50;
/// Triangles that are read at once.
const BATCH: usize = 8192;

/// The length of the binary file that starts like this.
pub(super) fn binary_bytes(start: &[u8]) -> Option<u64> {
    let count = start.get(TITLE_BYTES..HEADER_BYTES)?.first_chunk()?;
    Some(HEADER_BYTES as u64 + TRIANGLE_BYTES as u64 * u64::from(u32::from_le_bytes(*count)))
}

/// Whether a first triangle follows the header of a binary file: a normal no longer than 1, and corners that are near.
pub(super) fn begins_with_triangle(start: &[u8]) -> bool {
    let Some(numbers) = start.get(HEADER_BYTES..HEADER_BYTES + 48) else { return false };
    let mut numbers = numbers.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
    let is_unit = numbers.by_ref().take(3).map(|x| x * x).sum::<f32>() < 1.01;
    is_unit && numbers.all(|x| x == 0.0 || (1e-9..1e9).contains(&x.abs()))
}

/// Reads a binary STL of `n_bytes` bytes, at least as many as its header counts. A vertex is split where triangles of
/// different [`colors`] meet.
///
/// # Errors
/// It cannot be read, or has too many triangles.
pub fn read_binary(mut reader: impl Read, n_bytes: u64) -> Result<Draft, TextProblem> {
    let mut header = [0; HEADER_BYTES];
    reader.read_exact(&mut header)?;
    let declared = binary_bytes(&header).unwrap_or(0).min(n_bytes);
    let n_triangles = declared.saturating_sub(HEADER_BYTES as u64) as usize / TRIANGLE_BYTES;
    let mut corners = Welder::default();
    let mut colors = Colors::new(&header[..TITLE_BYTES]);
    corners.builder.reserve_triangles(n_triangles)?;
    let mut batch = vec![0; BATCH.min(n_triangles) * TRIANGLE_BYTES];
    let mut n_left = n_triangles;
    while n_left > 0 {
        let n = n_left.min(BATCH);
        let bytes = &mut batch[..n * TRIANGLE_BYTES];
        reader.read_exact(bytes)?;
        for triangle in bytes.as_chunks::<TRIANGLE_BYTES>().0 {
            let numbers: [f32; 9] =
                std::array::from_fn(|i| f32::from_le_bytes(std::array::from_fn(|k| triangle[12 + 4 * i + k])));
            for corner in numbers.as_chunks().0 {
                corners.push(*corner)?;
            }
            colors.push(corners.builder.n_triangles(), std::array::from_fn(|k| triangle[48 + k]));
            corners.end_polygon()?;
        }
        n_left -= n;
    }
    let mut draft = corners.finish()?;
    colors.paint(&mut draft.mesh)?;
    Ok(draft)
}

/// Reads a text STL. A facet of more than three corners is divided; several solids become one mesh.
///
/// # Errors
/// It cannot be read, a corner is not three numbers, or there are too many triangles.
pub fn read_text(reader: impl Read) -> Result<Draft, TextProblem> {
    let mut words = Words::new(reader)?;
    let mut corners = Welder::default();
    let (mut keyword, mut is_open, mut line_of_name) = (Keyword::Other, false, None);
    while let Some(word) = words.next()? {
        let before = std::mem::replace(&mut keyword, Keyword::of(word));
        if line_of_name == Some(words.line) {
            // A name may have any words, and ends with its line, unless the whole solid is on that.
            if (before, keyword) != (Keyword::Facet, Keyword::Normal) {
                continue;
            }
            line_of_name = None;
        }
        match keyword {
            Keyword::Vertex => corners.push(position(&mut words)?)?,
            Keyword::EndOfPolygon => corners.end_polygon()?,
            Keyword::Solid | Keyword::EndOfSolid => {
                (is_open, line_of_name) = (keyword == Keyword::Solid, Some(words.line));
            }
            Keyword::Normal => is_open = true,
            Keyword::Facet | Keyword::Other => {}
        }
    }
    let mut draft = corners.finish()?;
    if is_open {
        draft.remarks.push("ends without `endsolid`: it may have been cut short".to_owned());
    }
    Ok(draft)
}

/// A word of a text, in small or capital letters.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Keyword {
    Solid,
    Facet,
    Normal,
    Vertex,
    EndOfPolygon,
    EndOfSolid,
    Other,
}

impl Keyword {
    fn of(word: &[u8]) -> Self {
        let is = |keyword: &str| word.eq_ignore_ascii_case(keyword.as_bytes());
        match word.len() {
            5 if is("solid") => Self::Solid,
            5 if is("facet") => Self::Facet,
            6 if is("vertex") => Self::Vertex,
            6 if is("normal") => Self::Normal,
            7 if is("endloop") => Self::EndOfPolygon,
            8 if is("endfacet") => Self::EndOfPolygon,
            8 if is("endsolid") => Self::EndOfSolid,
            _ => Self::Other,
        }
    }
}

/// The three numbers of a vertex.
fn position(words: &mut Words<impl Read>) -> Result<[f32; 3], TextProblem> {
    let line = words.line;
    let mut position = [0.0; 3];
    for coordinate in &mut position {
        let Some(word) = words.next()? else {
            return Err(TextProblem::Line { line, what: "a vertex needs three numbers, and the file ends".to_owned() });
        };
        let Some(decimal) = Decimal::parse(word) else {
            let what = format!("`{}` is not a number: a vertex needs three", printable(word));
            return Err(TextProblem::Line { line: words.line, what });
        };
        *coordinate = decimal.value as f32;
    }
    Ok(position)
}

/// The beginning of a token, for an error.
pub(super) fn printable(token: &[u8]) -> String {
    String::from_utf8_lossy(token).chars().take(40).collect()
}

/// Gives corners of equal position, bit for bit, one vertex: then solids are closed, and memory is a third.
#[derive(Default)]
struct Welder {
    builder: MeshBuilder,
    /// A hash table with open addressing: the vertices, each near the slot of its hash. Its length is a power of two.
    slots: Vec<u32>,
    /// The corners of the polygon that is being read.
    pending: Vec<u32>,
}

impl Welder {
    const EMPTY: u32 = u32::MAX;

    /// Adds a corner of a polygon, which [`Welder::end_polygon`] ends.
    fn push(&mut self, position: [f32; 3]) -> Result<(), AssemblyError> {
        let vertex = self.vertex(position)?;
        self.pending.push(vertex);
        Ok(())
    }

    fn end_polygon(&mut self) -> Result<(), AssemblyError> {
        self.builder.push_polygon(&self.pending)?;
        self.pending.clear();
        Ok(())
    }

    fn vertex(&mut self, position: [f32; 3]) -> Result<u32, AssemblyError> {
        if self.slots.len() <= 2 * self.builder.n_vertices() {
            self.grow();
        }
        let slot = self.slot(position);
        if self.slots[slot] == Self::EMPTY {
            self.builder.check_vertices(1)?;
            self.slots[slot] = self.builder.n_vertices() as u32;
            self.builder.push_vertex(DVec3::from(position.map(f64::from)));
        }
        Ok(self.slots[slot])
    }

    /// The slot of the vertex at this position, or the empty one where it belongs.
    fn slot(&self, position: [f32; 3]) -> usize {
        let bits = position.map(f32::to_bits);
        let [x, y, z] = bits.map(u64::from);
        let hash = (x | y << 32).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ z.wrapping_mul(0xd6e8_feb8_6659_fd93);
        let mask = self.slots.len() - 1;
        let mut slot = (hash ^ hash >> 32).wrapping_mul(0x94d0_49bb_1331_11eb) as usize >> 16 & mask;
        loop {
            let vertex = self.slots[slot];
            let is_here = || self.builder.mesh.vertices[vertex as usize].map(f32::to_bits) == bits;
            if vertex == Self::EMPTY || is_here() {
                return slot;
            }
            slot = (slot + 1) & mask;
        }
    }

    fn grow(&mut self) {
        self.slots = vec![Self::EMPTY; (2 * self.slots.len()).max(64)];
        for vertex in 0..self.builder.n_vertices() {
            let slot = self.slot(self.builder.mesh.vertices[vertex]);
            self.slots[slot] = vertex as u32;
        }
    }

    fn finish(mut self) -> Result<Draft, AssemblyError> {
        self.end_polygon()?;
        Ok(Draft { mesh: self.builder.finish(), ..Draft::default() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::mesh::Mesh;

    const TEXT: &str = "solid two facets\nfacet normal 0 0 1\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 0 1 0\n \
        endloop\nendfacet\nfacet normal 0 0 1\nouter loop\nvertex 0 1 0\nvertex 1 0 0\nvertex 1.0 1.0e0 0\nendloop\nendfacet\n\
        endsolid two facets\n";

    fn binary(triangles: &[[[f32; 3]; 3]]) -> Vec<u8> {
        let mut bytes = [0; TITLE_BYTES].to_vec();
        bytes.extend((triangles.len() as u32).to_le_bytes());
        for corners in triangles {
            bytes.extend([0; 12]);
            bytes.extend(corners.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
            bytes.extend([0; 2]);
        }
        bytes
    }

    fn text_mesh(text: &str) -> Mesh {
        read_text(text.as_bytes()).unwrap_or_else(|problem| panic!("{problem}")).mesh
    }

    fn binary_mesh(bytes: &[u8]) -> Mesh {
        read_binary(bytes, bytes.len() as u64).unwrap().mesh
    }

    #[test]
    fn equal_corners_become_one_vertex() {
        let [a, b, c, d] = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
        let mesh = text_mesh(TEXT);
        assert_eq!((&mesh.vertices, &mesh.triangles), (&vec![a, b, c, d], &vec![[0, 1, 2], [2, 1, 3]]));
        assert_eq!(binary_mesh(&binary(&[[a, b, c], [c, b, d]])), mesh);
        // Two zeros are two vertices, as in a PLY.
        let zeros = binary_mesh(&binary(&[[a, b, c], [[-0.0, 0.0, 0.0], b, d]]));
        assert_eq!(zeros.triangles, [[0, 1, 2], [3, 1, 4]]);
    }

    #[test]
    fn a_statue_stays_closed() {
        let statue = crate::model::statue::generate(20_000, &|_| ());
        let corners: Vec<_> = (0..statue.triangles.len()).filter_map(|triangle| statue.corners(triangle)).collect();
        let mesh = binary_mesh(&binary(&corners));
        assert_eq!((mesh.vertices.len(), mesh.facing()), (statue.vertices.len(), statue.facing()));
        assert!((0..corners.len()).all(|triangle| mesh.corners(triangle) == Some(corners[triangle])));
    }

    #[test]
    fn triangles_keep_their_colours() {
        let [a, b, c, d] = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
        let mut bytes = binary(&[[a, b, c], [c, b, d]]);
        assert!(binary_mesh(&bytes).colors.is_empty());
        let n = bytes.len();
        bytes[n - 2..].copy_from_slice(&0xfc00_u16.to_le_bytes());
        let (white, red) = ([255; 3], [255, 0, 0]);
        let mesh = binary_mesh(&bytes);
        assert_eq!(mesh.triangles, [[0, 1, 2], [4, 5, 3]]);
        assert_eq!(mesh.colors, [white, white, white, red, red, red]);
        bytes[..10].copy_from_slice(b"COLOR=\xff\x00\x00\xff");
        bytes[n - 2..].copy_from_slice(&[0, 0x80]);
        assert_eq!(binary_mesh(&bytes).colors[3], red);
    }

    #[test]
    fn texts_vary() {
        let expected = text_mesh(TEXT);
        for text in [
            TEXT.to_uppercase(),
            TEXT.replace('\n', "\r\n"),
            TEXT.replace('\n', "\r"),
            TEXT.replace("endsolid two facets\n", ""),
            TEXT.replace("endfacet\nfacet", "endfacet\nendsolid a vertex\nsolid b vertex\nfacet"),
            TEXT.replace("two facets\n", "\u{e9} facet vertex\n"),
            format!("\u{feff}{}", TEXT.trim_start().replacen("two facets", "a vertex", 1)),
            // Lines may end anywhere but within a name.
            TEXT.replace('\n', " "),
            TEXT.replace([' ', '\n'], "\n").replace("solid\ntwo\nfacets", "solid two facets"),
            format!("{} {}", TEXT.replace('\n', " "), "solid b endsolid b ".repeat(10_000)),
        ] {
            assert_eq!(text_mesh(&text), expected, "{text}");
        }
        let cut = read_text(TEXT.replace("endsolid two facets\n", "").as_bytes()).unwrap();
        assert!(cut.remarks[0].contains("cut short") && read_text(TEXT.as_bytes()).unwrap().remarks.is_empty());
        let quad = TEXT.replace("endloop\nendfacet\nfacet normal 0 0 1\nouter loop\nvertex 0 1 0\nvertex 1 0 0\n", "");
        assert_eq!(text_mesh(&quad).triangles, [[0, 1, 2], [0, 2, 3]]);
    }

    #[test]
    fn faults_have_a_line() {
        for (from, to, expected) in [
            ("1.0e0", "1.0f", "line 13: `1.0f` is not a number: a vertex needs three"),
            ("vertex 1 0 0", "vertex 1 0", "line 6: `vertex` is not a number: a vertex needs three"),
        ] {
            let error = read_text(TEXT.replacen(from, to, 1).as_bytes()).unwrap_err().to_string();
            assert_eq!(error, expected);
        }
        let cut = format!("{}\n", &TEXT[..TEXT.find(" 0\n  vertex 0 1").unwrap()]);
        let cut = read_text(cut.as_bytes()).unwrap_err().to_string();
        assert_eq!(cut, "line 5: a vertex needs three numbers, and the file ends");
        let nan = binary_mesh(&binary(&[[[f32::NAN; 3]; 3], [[0.0; 3], [1.0; 3], [2.0; 3]]]));
        assert_eq!((nan.n_rejected, nan.triangles[0]), (1, Mesh::REJECTED));
    }

    #[test]
    fn counts_that_lie_take_no_memory() {
        let mut bytes = binary(&[[[0.0; 3]; 3]]);
        bytes[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(binary_mesh(&bytes).triangles.len() == 1);
    }
}
