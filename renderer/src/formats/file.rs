//! Reads a model's file, whatever its format: the content tells it, not the name.

use std::{
    fmt,
    io::{self, BufRead, BufReader, Read},
    path::{Path, PathBuf},
    time::SystemTime,
};

use channel::files::{self, ReadError};

use crate::{
    formats::{
        assembly::TextProblem,
        companions::Companions,
        foreign, gltf,
        images::{self, ImageSource},
        obj, ply,
        sources::{Sources, Stamp},
        stl, tiles,
    },
    model::mesh::Mesh,
    scene_file,
};

/// Some editors on Windows begin UTF-8 with it.
pub(super) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// The remark on textures of a mesh that has no coordinates for them.
pub(super) const IDLE_TEXTURES: &str = "its textures are left out: it has no texture coordinates";

/// The endings of files that are shown, in small letters.
const ENDINGS: [&str; 6] = ["ply", "obj", "stl", "gltf", "glb", scene_file::cache::ENDING];

/// Whether a file is a model by the ending of its name.
pub fn is_named_as_model(path: &Path) -> bool {
    let ending = path.extension().unwrap_or_default();
    ENDINGS.iter().any(|known| ending.eq_ignore_ascii_case(known))
}

/// A model's mesh with its images, and what is to be said of it.
#[derive(Debug)]
pub struct Reading {
    /// The mesh.
    pub mesh: Mesh,
    /// Lines for the log: what was left out, and why.
    pub remarks: Vec<String>,
}

/// A mesh as its file describes it. Its materials name images by their index in `images`, which are still to be decoded.
#[derive(Debug, Default)]
pub struct Draft {
    /// The mesh, without images.
    pub mesh: Mesh,
    /// Where the images are.
    pub images: Vec<ImageSource>,
    /// Remarks on parts that were left out, and why.
    pub remarks: Vec<String>,
}

impl Draft {
    /// Leaves the textures out, with a remark, if the mesh has no coordinates for them.
    pub(super) fn drop_idle_textures(&mut self) {
        if !self.mesh.texture_coordinates.is_empty() {
            return;
        }
        self.images.clear();
        let mut has_textures = false;
        for material in &mut self.mesh.materials.materials {
            material.keep_textures(|_| {
                has_textures = true;
                None
            });
        }
        if has_textures {
            self.remarks.push(IDLE_TEXTURES.to_owned());
        }
    }
}

/// Why a file cannot be read as a mesh.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct FileError {
    /// The file.
    pub path: PathBuf,
    /// The fault. Not the error's source, because the message contains it already.
    pub problem: Problem,
}

/// A fault of a model's file.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Problem {
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    // It has no size to compare its counts with, or cannot be opened.
    #[error(transparent)]
    Unreadable(#[from] ReadError),
    // A file of another kind, or a damaged one.
    #[error("{0}")]
    Foreign(String),
    #[error("{0}{cure}", cure = cure_of_ply(.0))]
    Ply(#[from] ply::Problem),
    #[error("{0}{cure}", cure = if let TextProblem::Line { .. } = .0 { COPY_AGAIN } else { "" })]
    Text(#[from] TextProblem),
    #[error("{0}{cure}", cure = cure_of_gltf(.0))]
    Gltf(#[from] gltf::Problem),
}

/// The cure of a file that may be damaged.
const COPY_AGAIN: &str = "; copy the file again, or export the model again";
/// The cure of a file that another program wrote in its own way.
const EXPORT_AGAIN: &str = "; export the model again, for example with Blender or MeshLab";

fn cure_of_ply(problem: &ply::Problem) -> &'static str {
    use ply::Problem::{Assembly, HeaderEnds, Io, Row, TooShort};
    match problem {
        Io(_) | Assembly(_) => "",
        HeaderEnds | TooShort { .. } | Row { .. } => COPY_AGAIN,
        _ => EXPORT_AGAIN,
    }
}

fn cure_of_gltf(problem: &gltf::Problem) -> &'static str {
    use gltf::Problem::{Document, JsonTooShort, Nothing, TooDamaged, TooShort};
    match problem {
        Document(_) | JsonTooShort { .. } | Nothing(_) | TooDamaged(_) | TooShort { .. } => COPY_AGAIN,
        _ => "",
    }
}

/// A format of models.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names say it")]
pub enum Format {
    Ply,
    Obj,
    StlText,
    StlBinary,
    GltfText,
    GltfBinary,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ply => "PLY",
            Self::Obj => "OBJ",
            Self::StlText => "text STL",
            Self::StlBinary => "binary STL",
            Self::GltfText => "glTF",
            Self::GltfBinary => "GLB",
        })
    }
}

/// Reads a file of any format, and the files that it names: materials, buffers and images.
///
/// A file without triangles is a mesh without triangles.
/// `progress` receives the fraction of the file read so far, 0 to 1.
///
/// # Errors
/// The file cannot be read, is of no known format, or is damaged. What its files lack is no error, but a remark.
pub fn read(path: &Path, progress: &(dyn Fn(f32) + Sync)) -> Result<Reading, FileError> {
    read_with_sources(path, progress).map(|(reading, _)| reading)
}

/// [`read`], with the files that were read; `None` if there is no telling whether they have changed since.
///
/// # Errors
/// As for [`read`].
pub fn read_with_sources(
    path: &Path,
    progress: &(dyn Fn(f32) + Sync),
) -> Result<(Reading, Option<Sources>), FileError> {
    let (companions, began_at) = (Companions::beside(path), SystemTime::now());
    let open = || -> Result<(Draft, Stamp), Problem> {
        let file = files::open(path)?;
        let metadata = file.metadata()?;
        let n_bytes = metadata.len();
        let metered = ProgressReader { inner: file, n_read: 0, n_bytes, progress };
        let draft = read_from(BufReader::with_capacity(BUFFER_BYTES, metered), n_bytes, &companions)?;
        Ok((draft, Stamp::of(&metadata)))
    };
    let (draft, stamp) = open().map_err(|problem| FileError { path: path.to_owned(), problem })?;
    let reading = images::decode(draft, &companions);
    Ok((reading, Sources::new(path, stamp, &companions, began_at)))
}

/// Reads a model of `n_bytes` bytes from its beginning, without its images.
pub fn read_from(mut reader: impl BufRead, n_bytes: u64, companions: &Companions) -> Result<Draft, Problem> {
    // A buffer may be filled only in part.
    let mut start = Vec::new();
    reader.by_ref().take(START_BYTES).read_to_end(&mut start)?;
    let format = Format::of(&start, n_bytes).ok_or_else(|| Problem::Foreign(foreign::fault(&start, n_bytes)))?;
    let reader = start.chain(reader);
    Ok(match format {
        Format::Ply => tiles::divide(ply::read_from(reader, n_bytes)?, companions),
        Format::Obj => tiles::divide(obj::read_from(reader, n_bytes, companions)?, companions),
        Format::StlText => stl::read_text(reader)?,
        Format::StlBinary => stl::read_binary(reader, n_bytes)?,
        Format::GltfText => gltf::read_text(reader, n_bytes, companions)?,
        Format::GltfBinary => gltf::read_binary(reader, n_bytes, companions)?,
    })
}

/// Large enough that system calls cost nothing, small beside any mesh.
const BUFFER_BYTES: usize = 256 * 1024;

/// Bytes that tell the format; comments may precede what is telling, as a licence.
const START_BYTES: u64 = 1 << 16;

impl Format {
    /// The format of a file of `n_bytes` bytes that starts like this.
    pub fn of(start: &[u8], n_bytes: u64) -> Option<Self> {
        let text = start.strip_prefix(BYTE_ORDER_MARK).unwrap_or(start).trim_ascii_start();
        let is_solid = text.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
        Some(match start {
            [b'p', b'l', b'y', ..] => Self::Ply,
            [b'g', b'l', b'T', b'F', ..] => Self::GltfBinary,
            // Many a binary file begins with `solid`.
            _ if stl::binary_bytes(start) == Some(n_bytes) => Self::StlBinary,
            _ if is_solid && (has_word(text, b"facet") || has_word(text, b"endsolid")) => Self::StlText,
            _ if text.starts_with(b"{") => Self::GltfText,
            _ if text.split(|&byte| matches!(byte, b'\n' | b'\r')).any(obj::is_telling) => Self::Obj,
            // Some programs append their own data.
            _ if stl::binary_bytes(start).is_some_and(|needed| (85..=n_bytes).contains(&needed)) => Self::StlBinary,
            _ => return None,
        })
    }
}

fn has_word(text: &[u8], word: &[u8]) -> bool {
    text.split(u8::is_ascii_whitespace).any(|token| token.eq_ignore_ascii_case(word))
}

struct ProgressReader<'a, R> {
    inner: R,
    n_read: u64,
    n_bytes: u64,
    progress: &'a (dyn Fn(f32) + Sync),
}

impl<R: Read> Read for ProgressReader<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.inner.read(buffer)?;
        self.n_read += n as u64;
        (self.progress)((self.n_read as f64 / self.n_bytes.max(1) as f64).min(1.0) as f32);
        Ok(n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_have_a_cure() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model");
        let ply = "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\n\
            element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n";
        for (text, cure) in [
            (ply.to_owned(), "; copy the file again, or export the model again"),
            (ply.replace("float y", "bool y"), "; export the model again, for example with Blender or MeshLab"),
            ("v 0 0 0\nv 1 0 x\nf 1 2 1\n".to_owned(), "; copy the file again, or export the model again"),
            ("glTF\u{2}\0\0\0@\0\0\0\u{20}\0\0\0JSON{}".to_owned(), "; copy the file again, or export the model again"),
            ("{\"asset\":{\"vers".to_owned(), "; copy the file again, or export the model again"),
            ("{\"nodes\":[]}".to_owned(), "; copy the file again, or export the model again"),
            ("{\"asset\":{\"version\":\"2.0\"}}".to_owned(), "; copy the file again, or export the model again"),
            (
                ply.replace("element face 1", "element vertex 1"),
                "; export the model again, for example with Blender or MeshLab",
            ),
        ] {
            std::fs::write(&path, text).unwrap();
            let told = read(&path, &|_| ()).unwrap_err().to_string();
            assert!(told.ends_with(cure), "{told}");
        }
    }

    #[test]
    fn the_content_tells_the_format() {
        let binary_stl = |title: &str, n_bytes: usize| {
            let mut bytes = title.as_bytes().to_vec();
            bytes.resize(80, b' ');
            bytes.extend([2, 0, 0, 0]);
            bytes.resize(n_bytes, 0);
            bytes
        };
        let stl = Some(Format::StlBinary);
        for (bytes, format) in [
            (b"ply\nformat ascii 1.0\n".to_vec(), Some(Format::Ply)),
            (b"glTF\x02\0\0\0".to_vec(), Some(Format::GltfBinary)),
            (b"\xef\xbb\xbf\n {\"asset\":{}}".to_vec(), Some(Format::GltfText)),
            (b"solid x\n facet normal 0 0 1\n".to_vec(), Some(Format::StlText)),
            (b"SOLID\nENDSOLID\n".to_vec(), Some(Format::StlText)),
            (binary_stl("solid facet ", 184), stl),
            (binary_stl("v 1 2 3", 184), stl),
            (binary_stl("solid ", 200), stl),
            (binary_stl("solid ", 183), None),
            (b"# Blender\n# www\nmtllib a.mtl\n".to_vec(), Some(Format::Obj)),
            (b"\xef\xbb\xbfv 1 2 3".to_vec(), Some(Format::Obj)),
            (b"solid v\nv 1 2 3\n".to_vec(), Some(Format::Obj)),
            (b"plain text\n".to_vec(), None),
            (b"v\nf\n\n".to_vec(), None),
            (Vec::new(), None),
        ] {
            let said = String::from_utf8_lossy(&bytes);
            assert_eq!(Format::of(&bytes, bytes.len() as u64), format, "{said}");
        }
    }

    #[test]
    fn a_file_of_another_kind_is_told_what_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.obj");
        for (text, told) in [("", "is empty"), ("Hello", "is no model that is read (PLY, OBJ, STL, glTF, GLB)")] {
            std::fs::write(&path, text).unwrap();
            let error = read(&path, &|_| ()).unwrap_err().to_string();
            assert!(error.contains(&format!("a.obj: {told}")), "{error}");
        }
    }
}
