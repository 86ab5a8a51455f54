//! Reads glTF 2.0, as text or binary (GLB), with the extensions of scans: quantized, meshopt- and Draco-compressed geometry,
//! and transformed textures.
//!
//! [`document`] is the JSON, [`buffers`] and [`accessor`] are its numbers, [`nodes`] places meshes, [`geometry`] puts their
//! triangles together, [`look`] reads materials, [`images`] finds the images that they show. Nothing in a file is trusted:
//! what is missing or damaged is left out with a remark, unless nothing remains.

mod accessor;
mod buffers;
mod document;
mod draco;
mod geometry;
mod images;
mod look;
mod meshopt;
mod nodes;
#[cfg(test)]
mod tests;

use std::io::{self, BufRead, Read};

use serde::Deserialize;
use serde_json::Value;
use shared::camera::UpAxis;

use self::{
    buffers::Buffers,
    document::{Document, Header},
    geometry::Geometry,
};
use crate::formats::{
    assembly::AssemblyError,
    companions::Companions,
    file::{BYTE_ORDER_MARK, Draft},
};

/// A fault of a glTF.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Problem {
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    #[error("is no glTF 2.0: {0}")]
    Document(String),
    #[error("has version {0} of glTF: convert it to 2.0, for example with Blender")]
    Version(String),
    #[error("is cut short: {needed} bytes are needed, it has {n_bytes}")]
    TooShort { needed: u64, n_bytes: u64 },
    #[error("is cut short: its JSON breaks off in line {line}, column {column}")]
    JsonTooShort { line: usize, column: usize },
    #[error("holds nothing that can be shown: {0}")]
    Nothing(String),
    #[error("holds no triangles: {0}")]
    NoTriangles(String),
    #[error("holds too many damaged meshes: {0}")]
    TooDamaged(String),
    #[error("repeats its meshes to more than {0} triangles: export fewer copies")]
    TooManyCopies(u64),
    #[error(transparent)]
    Assembly(#[from] AssemblyError),
}

/// Extensions that may be required: those that are read, and those without effect on shape and base colour.
const KNOWN: [&str; 20] = [
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
    "KHR_node_visibility",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "KHR_draco_mesh_compression",
    "KHR_texture_transform",
    "EXT_texture_webp",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_materials_clearcoat",
    "KHR_materials_ior",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_volume",
    "KHR_materials_variants",
    "KHR_lights_punctual",
    "KHR_xmp_json_ld",
];

/// The type of a GLB's chunk.
const JSON: [u8; 4] = *b"JSON";
const BINARY: [u8; 4] = *b"BIN\0";

/// Reads a GLB of `n_bytes` bytes.
///
/// # Errors
/// It is cut short or no glTF 2.0, or nothing in it can be shown.
pub fn read_binary(mut reader: impl BufRead, n_bytes: u64, companions: &Companions) -> Result<Draft, Problem> {
    let mut header = [0; 12];
    reader.read_exact(&mut header).map_err(|_| Problem::TooShort { needed: 12, n_bytes })?;
    let [_, version, n_declared] = header.as_chunks::<4>().0 else {
        return Err(Problem::TooShort { needed: 12, n_bytes });
    };
    let version = u32::from_le_bytes(*version);
    if version != 2 {
        return Err(Problem::Version(version.to_string()));
    }
    let n_declared = u64::from(u32::from_le_bytes(*n_declared));
    let (mut json, mut binary) = (None, Vec::new());
    let mut n_read = 12;
    let mut chunk_header = [0; 8];
    // Bytes after the declared ones are no chunks; some programs declare none.
    while binary.is_empty() && n_read != n_declared && reader.read_exact(&mut chunk_header).is_ok() {
        let [length, kind] = chunk_header.as_chunks::<4>().0 else { break };
        let length = u64::from(u32::from_le_bytes(*length));
        n_read += 8 + length;
        if n_read > n_bytes {
            return Err(Problem::TooShort { needed: n_read, n_bytes });
        }
        let mut chunk = Vec::with_capacity(length as usize);
        reader.by_ref().take(length).read_to_end(&mut chunk)?;
        match *kind {
            JSON if json.is_none() => json = Some(chunk),
            BINARY => binary = chunk,
            _ => {}
        }
    }
    let json = json.ok_or_else(|| Problem::Document("it has no JSON".to_owned()))?;
    read_parts(&json, &binary, companions)
}

/// Reads a glTF in JSON of `n_bytes` bytes.
///
/// # Errors
/// It is no glTF 2.0, or nothing in it can be shown.
pub fn read_text(mut reader: impl BufRead, n_bytes: u64, companions: &Companions) -> Result<Draft, Problem> {
    let mut json = Vec::new();
    reader.by_ref().take(n_bytes).read_to_end(&mut json)?;
    read_parts(json.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&json), &[], companions)
}

fn read_parts(json: &[u8], binary: &[u8], companions: &Companions) -> Result<Draft, Problem> {
    // Before the rest: version 1 has other types.
    let Header { asset } = parse(json)?;
    if !asset.version.starts_with("2.") {
        return Err(Problem::Version(asset.version));
    }
    let mended;
    let document = match parse::<Document<'_>>(json) {
        Ok(document) => document,
        Err(problem) => {
            mended = mended_json(json);
            Document::deserialize(&mended).map_err(|_| problem)?
        }
    };
    let mut remarks = Vec::new();
    let unknown: Vec<_> = document.extensions_required.iter().filter(|it| !KNOWN.contains(&it.as_str())).collect();
    for extension in unknown {
        remarks.push(format!("needs {extension}, which is not read: parts may be missing; export without it"));
    }
    if !document.animations.is_empty() {
        remarks.push("its animations are left out: it is shown at rest".to_owned());
    }
    let buffers = Buffers::read(&document, binary, companions);
    let mut geometry = Geometry::new(&document, &buffers, json.len());
    let n_before = remarks.len();
    let instances = nodes::instances(&document, &buffers, &mut remarks);
    if instances.is_empty() && remarks.len() == n_before {
        return Err(Problem::Nothing("its scene has no meshes, or hides them".to_owned()));
    }
    for instance in instances {
        geometry.add(&instance)?;
    }
    let mut draft = geometry.finish(remarks);
    if draft.mesh.triangles.is_empty() {
        draft.remarks.extend(draft.remarks.is_empty().then(|| "its meshes have no triangles".to_owned()));
        let has_points = draft.remarks.iter().any(|remark| remark.starts_with(geometry::POINTS));
        let problem = if has_points { Problem::NoTriangles } else { Problem::Nothing };
        return Err(problem(draft.remarks.join("; ")));
    }
    draft.drop_idle_textures();
    draft.mesh.up = Some(UpAxis::Y);
    Ok(draft)
}

fn parse<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<T, Problem> {
    serde_json::from_slice(json).map_err(|error| match error.is_eof() {
        true => Problem::JsonTooShort { line: error.line(), column: error.column() },
        false => Problem::Document(error.to_string()),
    })
}

/// The longest JSON that is mended: in between it takes many times its bytes.
const LONGEST_MENDED: usize = 1 << 26;

/// Below this, `f64` holds all integers.
const EXACT: f64 = (1_u64 << 53) as f64;

/// The JSON that some programs mean: integers have no `.0`, and of properties with the same name the last counts.
fn mended_json(json: &[u8]) -> Value {
    fn mend(value: &mut Value) {
        match value {
            Value::Number(number) if number.is_f64() => {
                let whole = number.as_f64().filter(|number| number.fract() == 0.0 && number.abs() < EXACT);
                if let Some(whole) = whole {
                    *value = Value::from(whole as i64);
                }
            }
            Value::Array(values) => values.iter_mut().for_each(mend),
            Value::Object(values) => values.values_mut().for_each(mend),
            _ => {}
        }
    }
    let json = Some(json).filter(|json| json.len() <= LONGEST_MENDED);
    let mut value = json.and_then(|json| serde_json::from_slice(json).ok()).unwrap_or_default();
    mend(&mut value);
    value
}
