//! The header of a PLY file: normalized for ply-rs' grammar, then compared with the file's size.

use std::io::{self, BufRead, Cursor, Read};

use ply_rs::{
    parser::{Parser, Reader},
    ply::{ElementDef, Encoding, PropertyType, ScalarType},
};

use crate::formats::ply::{Problem, element::Skipped};

/// Limit of a header's length: real headers have a few KB, and an endless one must not fill the memory.
pub(super) const MAX_HEADER_BYTES: u64 = 1 << 20;

/// Real files have a handful of elements: each costs time wherever elements are gone through.
pub(super) const MOST_ELEMENTS: usize = 1000;

/// The most properties of all elements together; real files have up to a few hundred.
pub(super) const MOST_PROPERTIES: usize = 10_000;

#[derive(Debug)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    /// Ends each line: `\n` (also after `\r`), or `\r` alone.
    pub(super) line_end: u8,
    pub(super) n_bytes: u64,
    pub(super) elements: Vec<Element>,
    /// Files of textures, as MeshLab names them in comments, and other programs in `obj_info`.
    pub(super) textures: Vec<String>,
}

#[derive(Debug)]
pub(super) struct Element {
    pub(super) kind: ElementKind,
    /// As in the file.
    pub(super) name: String,
    /// For ply-rs, each property named by its role: `x y z`, `nx ny nz`, `r g b`, `s t`, `i` for indices, `c` for
    /// corners' texture coordinates, `n` for the texture's number, `_0 _1 …` to be skipped.
    pub(super) def: ElementDef,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ElementKind {
    /// Which numbers of the look all vertices have.
    Vertices {
        colored: bool,
        with_normals: bool,
        textured: bool,
    },
    /// Which numbers of the look all faces have: texture coordinates are those of their corners.
    Faces {
        colored: bool,
        textured: bool,
        numbered: bool,
    },
    Strips,
    Other,
}

impl Header {
    /// Reads up to and including `end_header` and its line end.
    pub(super) fn read(reader: &mut impl BufRead) -> Result<Self, Problem> {
        let mut lines = Lines::begin(reader)?;
        // One line for each of the file's, so that ply-rs' line numbers are the file's.
        let mut tidy = String::from("ply\n");
        let mut texts = vec![String::from("ply")];
        let mut declared = Vec::<DeclaredElement>::new();
        let mut n_properties = 0;
        let mut textures = Vec::new();
        loop {
            let text = lines.next()?;
            let words: Vec<&str> = text.split_whitespace().collect();
            if let ["comment" | "obj_info", word, _, ..] = *words.as_slice()
                && (word.eq_ignore_ascii_case("TextureFile") || words[0] == "obj_info" && word == "texture")
            {
                let name = text.split_once(word).map_or("", |(_, name)| name.trim());
                textures.push(name.to_owned());
            }
            let line = match *words.as_slice() {
                [] | ["comment" | "obj_info", ..] => String::from("comment"),
                ["end_header"] => break,
                ["element", name, count] => {
                    if declared.iter().any(|element| element.name == name) {
                        return Err(Problem::Repeated(name.to_owned()));
                    }
                    if declared.len() == MOST_ELEMENTS {
                        return Err(Problem::TooManyDeclared("elements", MOST_ELEMENTS));
                    }
                    declared.push(DeclaredElement { name: name.to_owned(), taken_roles: Vec::new() });
                    format!("element e{} {count}", declared.len())
                }
                ["property", ref types @ .., name] if !types.is_empty() => {
                    n_properties += 1;
                    if n_properties > MOST_PROPERTIES {
                        return Err(Problem::TooManyDeclared("properties", MOST_PROPERTIES));
                    }
                    let role =
                        declared.last_mut().map_or("_".to_owned(), |element| element.role(name, types[0] == "list"));
                    format!("property {} {role}", types.join(" "))
                }
                _ => words.join(" "),
            };
            tidy += &line;
            tidy.push('\n');
            texts.push(text);
        }
        tidy += "end_header\n";
        let (line_end, n_bytes) = (lines.line_end, lines.n_bytes);

        let parsed = Parser::<Skipped>::new().read_header(&mut Reader::new(Cursor::new(tidy))).map_err(|error| {
            match error.line().and_then(|line| Some((line, texts.get(line - 1)?))) {
                Some((line, text)) => Problem::HeaderLine { line, text: text.chars().take(60).collect() },
                None => Problem::Header(error.to_string()),
            }
        })?;
        let elements = (parsed.elements.into_values().zip(declared))
            .map(|(def, declared)| Element::new(declared.name, def))
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Self { encoding: parsed.encoding, line_end, n_bytes, elements, textures })
    }

    /// Checks that `n_left` bytes after the header suffice for its counts.
    pub(super) fn check_size(&self, n_left: u64) -> Result<(), Problem> {
        let mut left = n_left;
        for Element { name, def, .. } in &self.elements {
            let needed = fewest_row_bytes(def, self.encoding) * def.count as u128;
            // The last line of an ASCII file may lack its line end.
            let spared = u128::from(self.encoding == Encoding::Ascii);
            if needed > u128::from(left) + spared {
                return Err(Problem::TooShort { element: name.clone(), count: def.count, needed, left });
            }
            left = left.saturating_sub(needed as u64);
        }
        Ok(())
    }
}

impl Element {
    fn new(name: String, def: ElementDef) -> Result<Self, Problem> {
        let has = |role: &str| def.properties.contains_key(role);
        let has_all = |roles: &[&str]| roles.iter().all(|role| has(role));
        let kind = match name.as_str() {
            "vertex" => ElementKind::Vertices {
                colored: has_all(&["r", "g", "b"]),
                with_normals: has_all(&["nx", "ny", "nz"]),
                textured: has_all(&["s", "t"]),
            },
            "face" => ElementKind::Faces { colored: has_all(&["r", "g", "b"]), textured: has("c"), numbered: has("n") },
            "tristrips" | "tristrip" => ElementKind::Strips,
            _ => ElementKind::Other,
        };
        let needed: &[(&str, &str)] = match kind {
            ElementKind::Vertices { .. } => &[("x", "coordinate x"), ("y", "coordinate y"), ("z", "coordinate z")],
            ElementKind::Faces { .. } | ElementKind::Strips => &[("i", "list vertex_indices")],
            ElementKind::Other => &[],
        };
        match needed.iter().find(|(role, _)| def.count > 0 && !has(role)) {
            Some(&(_, property)) => Err(Problem::Missing { element: name, property }),
            None => Ok(Self { kind, name, def }),
        }
    }

    pub(super) fn fewest_bytes(&self, encoding: Encoding) -> u128 {
        fewest_row_bytes(&self.def, encoding) * self.def.count as u128
    }

    /// The most rows with three indices that `n_left` bytes and the count allow.
    pub(super) fn most_triangle_rows(&self, encoding: Encoding, n_left: u64) -> usize {
        let index_bytes = match self.def.properties.get("i").map(|property| &property.data_type) {
            Some(PropertyType::List(_, scalar)) if encoding != Encoding::Ascii => scalar_bytes(scalar),
            _ => 2,
        };
        let row_bytes = fewest_row_bytes(&self.def, encoding) + 3 * index_bytes;
        self.def.count.min((u128::from(n_left) / row_bytes) as usize)
    }
}

/// An element while its properties are being declared.
struct DeclaredElement {
    name: String,
    taken_roles: Vec<&'static str>,
}

impl DeclaredElement {
    /// The role of a property. A second property in the same role is skipped, like one without a role.
    fn role(&mut self, property: &str, is_list: bool) -> String {
        let role = match (self.name.as_str(), property, is_list) {
            ("vertex", "x", false) => "x",
            ("vertex", "y", false) => "y",
            ("vertex", "z", false) => "z",
            ("vertex", "nx" | "normal_x", false) => "nx",
            ("vertex", "ny" | "normal_y", false) => "ny",
            ("vertex", "nz" | "normal_z", false) => "nz",
            ("vertex", "s" | "u" | "texture_u", false) => "s",
            ("vertex", "t" | "v" | "texture_v", false) => "t",
            ("vertex" | "face", "red" | "diffuse_red", false) => "r",
            ("vertex" | "face", "green" | "diffuse_green", false) => "g",
            ("vertex" | "face", "blue" | "diffuse_blue", false) => "b",
            ("face", "texcoord", true) => "c",
            ("face", "texnumber", false) => "n",
            ("face" | "tristrips" | "tristrip", "vertex_indices" | "vertex_index", true) => "i",
            _ => "",
        };
        let role = if self.taken_roles.contains(&role) { "" } else { role };
        self.taken_roles.push(role);
        if role.is_empty() { format!("_{}", self.taken_roles.len()) } else { role.to_owned() }
    }
}

fn scalar_bytes(scalar: &ScalarType) -> u128 {
    match scalar {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// Assumes empty lists and, in ASCII, one digit and one space for each number.
fn fewest_row_bytes(def: &ElementDef, encoding: Encoding) -> u128 {
    let bytes = |property_type: &PropertyType| match property_type {
        _ if encoding == Encoding::Ascii => 2,
        PropertyType::Scalar(scalar) | PropertyType::List(scalar, _) => scalar_bytes(scalar),
    };
    def.properties.values().map(|property| bytes(&property.data_type)).sum()
}

/// Reads the header's lines after the first, trimmed; comments may have any encoding.
struct Lines<'a, R> {
    reader: &'a mut R,
    line_end: u8,
    n_bytes: u64,
}

impl<'a, R: BufRead> Lines<'a, R> {
    /// Reads the first line, which shows how lines end.
    fn begin(reader: &'a mut R) -> Result<Self, Problem> {
        let mut magic = [0; 3];
        reader.read_exact(&mut magic).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => Problem::NotPly,
            _ => Problem::Io(error),
        })?;
        if magic != *b"ply" {
            return Err(Problem::NotPly);
        }
        let mut n_bytes = 3;
        loop {
            let byte = reader.fill_buf()?.first().copied();
            reader.consume(usize::from(byte.is_some()));
            n_bytes += 1;
            match byte {
                Some(b' ' | b'\t') if n_bytes < MAX_HEADER_BYTES => {}
                Some(b'\n') => return Ok(Self { reader, line_end: b'\n', n_bytes }),
                Some(b'\r') => {
                    let is_pair = reader.fill_buf()?.first() == Some(&b'\n');
                    reader.consume(usize::from(is_pair));
                    let line_end = if is_pair { b'\n' } else { b'\r' };
                    return Ok(Self { reader, line_end, n_bytes: n_bytes + u64::from(is_pair) });
                }
                None => return Err(Problem::HeaderEnds),
                Some(_) => return Err(Problem::NotPly),
            }
        }
    }

    fn next(&mut self) -> Result<String, Problem> {
        let mut line = Vec::new();
        let n = self.reader.take(MAX_HEADER_BYTES.saturating_sub(self.n_bytes)).read_until(self.line_end, &mut line)?
            as u64;
        self.n_bytes += n;
        let text = String::from_utf8_lossy(&line).trim().to_owned();
        if line.last() == Some(&self.line_end) || text == "end_header" {
            return Ok(text);
        }
        Err(if self.n_bytes >= MAX_HEADER_BYTES { Problem::HeaderTooLong } else { Problem::HeaderEnds })
    }
}
