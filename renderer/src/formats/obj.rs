//! Reads OBJ files with their materials (MTL).
//!
//! [`piece`] parses pieces of the text on all cores; here their rows are put together in order, so the mesh does not depend
//! on where the text was cut.

mod mtl;
mod piece;
#[cfg(test)]
mod tests;

use std::{
    collections::{HashMap, HashSet},
    io::{BufRead, Read},
};

use rayon::prelude::*;

use self::piece::{Fault, Piece};
use crate::formats::{
    assembly::{AssemblyError, MeshBuilder, TextProblem},
    companions::Companions,
    file::{BYTE_ORDER_MARK, Draft},
    wedges::{self, Look},
};
use crate::model::{material::Material, normal::Normal};

pub use self::mtl::Library;

/// Bytes of a piece: large beside a line, small beside a core's cache.
const PIECE_BYTES: usize = 1 << 19;
/// The longest file of materials; real ones have some KB.
const LONGEST_LIBRARY: u64 = 1 << 26;
/// The most rows that name such files; real models have one.
const MOST_LIBRARIES: usize = 100;
/// Words that begin a line of an OBJ and of hardly any other file.
const WORDS: [&[u8]; 15] =
    [b"v", b"vt", b"vn", b"vp", b"f", b"l", b"p", b"o", b"g", b"s", b"mtllib", b"usemtl", b"cstype", b"deg", b"fo"];

/// Whether a line tells that a file is an OBJ: a word of its own with something after it.
pub(super) fn is_telling(line: &[u8]) -> bool {
    let mut words = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
    let is_word = words.next().is_some_and(|word| WORDS.contains(&word));
    is_word && words.next().is_some_and(|word| str::from_utf8(word).is_ok() && !word.contains(&0))
}

/// Reads an OBJ of `n_bytes` bytes from its beginning, and the materials that it names: polygons are fanned, points, lines and
/// curved surfaces are left out.
///
/// Takes at most a small multiple of the file's bytes of memory.
///
/// # Errors
/// It cannot be read, a row of it is no numbers, or it has too many vertices or triangles.
pub fn read_from(mut reader: impl BufRead, n_bytes: u64, companions: &Companions) -> Result<Draft, TextProblem> {
    let mut model = Model::default();
    let batch_bytes = (PIECE_BYTES * 4 * rayon::current_num_threads()).min(n_bytes as usize + 1);
    let (mut text, mut n_lines, mut at_end) = (Vec::new(), 0, false);
    let mut has_old_ends = None;
    while !at_end {
        let n_before = text.len();
        let n_read = reader.by_ref().take(batch_bytes as u64).read_to_end(&mut text)?;
        at_end = n_read < batch_bytes;
        if n_lines == 0 && text.starts_with(BYTE_ORDER_MARK) {
            text.drain(..BYTE_ORDER_MARK.len());
        }
        // Old Macs end lines with it alone.
        if *has_old_ends.get_or_insert_with(|| !text.contains(&b'\n') && text.contains(&b'\r')) {
            let n_old = n_before.min(text.len());
            text[n_old..].iter_mut().filter(|byte| **byte == b'\r').for_each(|byte| *byte = b'\n');
        }
        let end = if at_end { Some(text.len()) } else { end_of_lines(&text, n_before, text.len()) };
        // One line may be longer than a batch.
        let Some(end) = end else { continue };
        let texts = cut(&text[..end]);
        let parsed: Vec<_> = texts.par_iter().map(|text| (Piece::parse(text), count_lines(text))).collect();
        for (piece, n_more) in parsed {
            model.add(piece.map_err(|Fault { line, what }| TextProblem::Line { line: n_lines + line + 1, what })?)?;
            n_lines += n_more;
        }
        text.drain(..end);
    }
    model.finish(companions)
}

/// The last place after `from` and at most at `to` where a line ends that does not go on.
fn end_of_lines(text: &[u8], from: usize, to: usize) -> Option<usize> {
    let is_end = |&at: &usize| text[at] == b'\n' && !piece::goes_on(&text[..at]);
    (from..to).rev().find(is_end).map(|at| at + 1)
}

/// Cuts a text between lines into pieces of about [`PIECE_BYTES`].
fn cut(text: &[u8]) -> Vec<&[u8]> {
    let (mut pieces, mut from) = (Vec::new(), 0);
    while from < text.len() {
        let mut to = from;
        let end = loop {
            to = (to + PIECE_BYTES).min(text.len());
            match end_of_lines(text, from, to) {
                _ if to == text.len() => break to,
                Some(end) => break end,
                None => {}
            }
        };
        pieces.push(&text[from..end]);
        from = end;
    }
    pieces
}

fn count_lines(text: &[u8]) -> usize {
    text.iter().filter(|&&byte| byte == b'\n').count()
}

/// Rows of a file in order.
#[derive(Default)]
struct Model {
    builder: MeshBuilder,
    /// Whether positions have more digits than `f32` holds.
    is_precise: bool,
    texture_coordinates: Vec<[f32; 2]>,
    normals: Vec<Normal>,
    /// Rows of the corners of each triangle, [`u32::MAX`] for none; shorter if the last triangles have none.
    texture_corners: Vec<[u32; 3]>,
    normal_corners: Vec<[u32; 3]>,
    /// Names of materials in the order of their first use, and their places in it.
    names: Vec<String>,
    places: HashMap<String, usize>,
    /// For each triangle 0, or the index of its name plus 1; shorter if the current one goes on.
    of_triangles: Vec<u16>,
    current: u16,
    libraries: Vec<String>,
    n_left_out: usize,
    n_short: usize,
    is_cut: bool,
}

/// A corner without texture coordinates, or without normal.
const NO_ROW: [u32; 3] = [u32::MAX; 3];

impl Model {
    fn add(&mut self, piece: Piece) -> Result<(), AssemblyError> {
        let before = [self.builder.n_vertices(), self.texture_coordinates.len(), self.normals.len()];
        self.builder.check_vertices(piece.positions.len())?;
        for (i, &position) in piece.positions.iter().enumerate() {
            // All positions from the first on that needs it: zeros at a number's end are often left out.
            self.is_precise |= piece.precise_from == Some(i);
            self.builder.push_vertex(if self.is_precise { position } else { position.as_vec3().as_dvec3() });
        }
        let colors = &mut self.builder.mesh.colors;
        if !(colors.is_empty() && piece.colors.is_empty()) {
            colors.resize(before[0], [u8::MAX; 3]);
            colors.extend(piece.colors);
            colors.resize(before[0] + piece.positions.len(), [u8::MAX; 3]);
        }
        self.texture_coordinates.extend(piece.texture_coordinates);
        self.normals.extend(piece.normals);
        self.libraries.extend(piece.libraries);
        self.n_left_out += piece.n_left_out;
        self.n_short += piece.n_short;
        self.is_cut |= piece.is_cut;

        let mut materials = piece.materials.into_iter().peekable();
        let (mut start, mut vertices) = (0, Vec::new());
        for (polygon, &end) in piece.polygons.iter().enumerate() {
            while let Some((_, name)) = materials.next_if(|(first, _)| *first <= polygon) {
                self.use_material(name);
            }
            let corners = &piece.corners[start..end];
            start = end;
            let row = |kind: usize, index: i64| piece::absolute(index, before[kind]).unwrap_or(u32::MAX);
            vertices.clear();
            vertices.extend(corners.iter().map(|corner| row(0, corner[0])));
            let first = self.builder.n_triangles();
            for (triangle, numbers) in (first..).zip(self.builder.push_polygon(&vertices)?.triangles()) {
                let triangle_corners = numbers.map(|number| corners[number as usize]);
                for (kind, of_corners) in [(1, &mut self.texture_corners), (2, &mut self.normal_corners)] {
                    if triangle_corners.iter().any(|corner| corner[kind] != piece::NONE) {
                        of_corners.resize(triangle, NO_ROW);
                        of_corners.push(triangle_corners.map(|corner| row(kind, corner[kind])));
                    }
                }
            }
        }
        materials.for_each(|(_, name)| self.use_material(name));
        Ok(())
    }

    fn use_material(&mut self, name: String) {
        self.of_triangles.resize(self.builder.n_triangles(), self.current);
        let place = *self.places.entry(name).or_insert_with_key(|name| {
            self.names.push(name.clone());
            self.names.len() - 1
        });
        // More materials than can be numbered share the look of none.
        self.current = u16::try_from(place + 1).unwrap_or(0);
    }

    fn finish(mut self, companions: &Companions) -> Result<Draft, TextProblem> {
        self.of_triangles.resize(self.builder.n_triangles(), self.current);
        let mut mesh = self.builder.finish();
        if !(self.texture_corners.is_empty() && self.normal_corners.is_empty()) {
            let row = |corners: &[[u32; 3]], triangle: usize, corner: usize| {
                corners.get(triangle).map_or(usize::MAX, |rows| rows[corner] as usize)
            };
            wedges::split(&mut mesh, |triangle, corner, _| Look {
                texture_coordinates: (self.texture_coordinates)
                    .get(row(&self.texture_corners, triangle, corner))
                    .copied(),
                normal: (self.normals)
                    .get(row(&self.normal_corners, triangle, corner))
                    .copied()
                    .unwrap_or(Normal::OF_TRIANGLE),
                color: None,
            })?;
        }
        let mut draft = Draft { mesh, ..Draft::default() };
        if self.n_left_out > 0 {
            draft.remarks.push(format!("points, lines and curved surfaces are left out: {}", self.n_left_out));
        }
        if self.n_short > 0 {
            draft.remarks.push(format!("faces with fewer than three corners are left out: {}", self.n_short));
        }
        if self.is_cut {
            draft.remarks.push("ends in the middle of a face: it may have been cut short".to_owned());
        }
        if self.libraries.is_empty() && !self.names.is_empty() {
            // As many viewers do.
            self.libraries.extend(companions.of_same_name("mtl"));
            if self.libraries.is_empty() {
                draft.remarks.push("its materials are left out: no line `mtllib` names their file".to_owned());
            }
        }
        let library = read_libraries(&self.libraries, companions, &mut draft.remarks);
        assign_materials(&mut draft, library, &self.names, self.of_triangles);
        draft.drop_idle_textures();
        Ok(draft)
    }
}

/// Reads files of materials. A row names one file, or several.
fn read_libraries(rows: &[String], companions: &Companions, remarks: &mut Vec<String>) -> Library {
    let mut library = Library::default();
    let mut seen = HashSet::new();
    for row in rows.iter().take(MOST_LIBRARIES) {
        for name in library_names(row, |name| companions.find("", name).is_ok()) {
            if !seen.insert(name.clone()) {
                continue;
            }
            let path = name.replace('\\', "/");
            let mut found = companions.read("", &name, LONGEST_LIBRARY);
            // A model and its materials are often renamed together.
            let same = found.is_err().then(|| companions.of_same_name("mtl")).flatten();
            if let Some(same) = same.filter(|same| seen.insert(same.clone())) {
                found = companions.read("", &same, LONGEST_LIBRARY);
            }
            match found {
                Ok(bytes) => library.read(&bytes, path.rsplit_once('/').map_or("", |(folder, _)| folder)),
                Err(fault) => remarks.push(format!("its materials are left out: {fault}")),
            }
        }
    }
    library
}

/// The files of materials that a row names. Their names may have spaces: in quotes, behind backslashes, or as they are.
fn library_names(row: &str, is_there: impl Fn(&str) -> bool) -> Vec<String> {
    if row.contains('"') {
        return row.split('"').map(str::trim).filter(|name| !name.is_empty()).map(str::to_owned).collect();
    }
    if is_there(row) {
        return vec![row.to_owned()];
    }
    let joined = row.replace("\\ ", "\0");
    let words: Vec<_> = joined.split_whitespace().map(|word| word.replace('\0', " ")).collect();
    let is_end = |word: &String| word.to_ascii_lowercase().ends_with(".mtl");
    let mut names = Vec::new();
    for name in words.split_inclusive(is_end) {
        let whole = name.join(" ");
        // Where none of the words is a file, one name with spaces is likelier than names that do not end in `.mtl`.
        let is_one = is_there(&whole) || !name.iter().any(|word| is_there(word));
        names.extend(if is_one { vec![whole] } else { name.to_vec() });
    }
    names
}

/// Gives triangles the materials of a library. `of_triangles` holds 0 for no material, or an index into `names` plus 1.
fn assign_materials(draft: &mut Draft, library: Library, names: &[String], of_triangles: Vec<u16>) {
    let Library { materials, images, remarks, .. } = library;
    draft.remarks.extend(remarks);
    if materials.is_empty() {
        return;
    }
    draft.images = images;
    let look = &mut draft.mesh.materials;
    if names.is_empty() {
        // Some programs use the only material without a word.
        look.materials.extend((materials.len() == 1).then(|| materials[0].clone()));
        return;
    }
    let mut n_missing = 0;
    // The first of equal names counts.
    let known: HashMap<_, _> = materials.iter().rev().map(|material| (material.name.as_str(), material)).collect();
    let mut of_name = |name: &String| {
        let found = known.get(name.as_str()).copied();
        n_missing += usize::from(found.is_none());
        found.cloned().unwrap_or_else(|| Material { name: name.clone(), ..Material::default() })
    };
    look.materials = [Material::default()].into_iter().chain(names.iter().map(&mut of_name)).collect();
    look.materials.truncate(1 << 16);
    if names.len() >= 1 << 16 {
        draft.remarks.push("materials beyond the 65535th are left out".to_owned());
    }
    if n_missing > 0 {
        draft
            .remarks
            .push(format!("materials that none of its files of materials has: {n_missing} of {}", names.len()));
    }
    look.of_triangles = of_triangles;
    if let Some(&only) = look.of_triangles.first().filter(|&only| look.of_triangles.iter().all(|it| it == only)) {
        look.materials = vec![look.materials.swap_remove(usize::from(only))];
        look.of_triangles = Vec::new();
    } else if !look.of_triangles.contains(&0) {
        look.materials.remove(0);
        look.of_triangles.iter_mut().for_each(|material| *material -= 1);
    }
}
