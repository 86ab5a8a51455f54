//! Reads and writes PLY files.
//!
//! ply-rs parses the header's lines and the binary rows. This module compares the header's counts with the file's size,
//! checks indices and vertices, and skips names that ply-rs cannot hold. [`ascii`] reads ASCII rows, because ply-rs'
//! grammar lacks `nan`, `inf`, `1.` and `.5`.

mod ascii;
mod element;
mod header;
mod look;
#[cfg(test)]
mod tests;
mod write;

use std::io::{self, BufRead};

use ply_rs::{
    parser::Parser,
    ply::{Encoding, PropertyAccess},
};

pub use self::write::{write, write_to};
use self::{
    element::{Corners, Skipped, Vertex},
    header::{Element, ElementKind, Header},
    look::FaceLooks,
};
use crate::formats::{
    assembly::{AssemblyError, MeshBuilder, reserve},
    file::Draft,
};
use crate::model::normal::Normal;

/// A fault of a PLY file, and its place: lines count from 1, rows from 0.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Problem {
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    #[error("is not a PLY file, which begins with a line `ply`")]
    NotPly,
    #[error("ends inside its header: no line `end_header`")]
    HeaderEnds,
    #[error("has no line `end_header` in its first {} KB", header::MAX_HEADER_BYTES / 1024)]
    HeaderTooLong,
    #[error("header line {line} is not understood: `{text}`")]
    HeaderLine { line: usize, text: String },
    #[error("its header is not understood: {0}")]
    Header(String),
    #[error("declares more than {1} {0}")]
    TooManyDeclared(&'static str, usize),
    #[error("declares element `{0}` twice")]
    Repeated(String),
    #[error("its element `{element}` has no {property}")]
    Missing { element: String, property: &'static str },
    #[error(
        "is cut short, or its header is wrong: {count} rows of `{element}` need at least {needed} bytes, {left} are left"
    )]
    TooShort { element: String, count: usize, needed: u128, left: u64 },
    #[error(transparent)]
    Assembly(#[from] AssemblyError),
    #[error("row {row} of element `{element}`: {what}")]
    Row { element: String, row: usize, what: String },
}

/// Reads a PLY of `n_bytes` bytes from its beginning: ASCII or binary, polygons divided, strips unrolled.
///
/// A file without faces or without vertices is a mesh without triangles.
/// Takes at most a small multiple of `n_bytes` of memory, even if the header lies.
pub fn read_from(mut reader: impl BufRead, n_bytes: u64) -> Result<Draft, Problem> {
    let header = Header::read(&mut reader)?;
    let mut n_left = n_bytes.saturating_sub(header.n_bytes);
    header.check_size(n_left)?;
    let mut assembly = MeshBuilder::default();
    let mut faces = FaceLooks::default();
    for element in &header.elements {
        match element.kind {
            ElementKind::Vertices { colored, with_normals, textured } => {
                assembly.reserve_vertices(element.def.count)?;
                if colored {
                    reserve(&mut assembly.mesh.colors, element.def.count, "colours")?;
                }
                if with_normals {
                    reserve(&mut assembly.mesh.normals, element.def.count, "normals")?;
                }
                if textured {
                    reserve(&mut assembly.mesh.texture_coordinates, element.def.count, "texture coordinates")?;
                }
                read_rows(&mut reader, &header, element, |vertex: &Vertex| {
                    assembly.push_vertex(vertex.position);
                    let mesh = &mut assembly.mesh;
                    mesh.colors.extend(colored.then_some(vertex.color));
                    mesh.normals.extend(with_normals.then(|| Normal::new(vertex.normal.into())));
                    mesh.texture_coordinates.extend(textured.then(|| look::flipped(vertex.texture_coordinates)));
                    Ok(())
                })?;
            }
            ElementKind::Faces { colored, textured, numbered } => {
                assembly.reserve_triangles(element.most_triangle_rows(header.encoding, n_left))?;
                faces.begin(assembly.n_triangles(), [colored, numbered, textured]);
                read_rows(&mut reader, &header, element, |face: &Corners| {
                    let division = assembly.push_polygon(&face.indices)?;
                    let n = division.len();
                    faces.colors.extend(std::iter::repeat_n(face.color, if colored { n } else { 0 }));
                    faces.textures.extend(std::iter::repeat_n(face.texture, if numbered { n } else { 0 }));
                    if textured {
                        faces.push_corners(face, division);
                    }
                    Ok(())
                })?;
            }
            ElementKind::Strips => {
                read_rows(&mut reader, &header, element, |strip: &Corners| Ok(assembly.push_strips(&strip.indices)?))?;
            }
            ElementKind::Other => read_rows(&mut reader, &header, element, |_: &Skipped| Ok(()))?,
        }
        n_left = n_left.saturating_sub(element.fewest_bytes(header.encoding) as u64);
    }
    Ok(faces.finish(assembly.finish(), header.textures)?)
}

fn read_rows<E: PropertyAccess>(
    reader: &mut impl BufRead,
    header: &Header,
    element: &Element,
    mut take: impl FnMut(&E) -> Result<(), Problem>,
) -> Result<(), Problem> {
    if element.def.properties.is_empty() {
        return Ok(()); // takes no bytes, so its count is bounded by nothing
    }
    let problem = |row, what| Problem::Row { element: element.name.clone(), row, what };
    if header.encoding == Encoding::Ascii {
        let mut rows = ascii::Rows::new(reader, header.line_end);
        for row in 0..element.def.count {
            take(&rows.next(&element.def).map_err(|what| problem(row, what))?)?;
        }
        return Ok(());
    }
    let parser = Parser::<E>::new();
    for row in 0..element.def.count {
        let parsed = match header.encoding {
            Encoding::BinaryBigEndian => parser.read_big_endian_element(reader, &element.def),
            _ => parser.read_little_endian_element(reader, &element.def),
        };
        take(&parsed.map_err(|error| {
            let cut = error.kind() == io::ErrorKind::UnexpectedEof;
            problem(
                row,
                if cut {
                    ENDS_HERE.to_owned()
                } else {
                    error.to_string().replace("\n\t", " ").trim_end_matches('.').to_owned()
                },
            )
        })?)?;
    }
    Ok(())
}

const ENDS_HERE: &str = "the file ends here";
