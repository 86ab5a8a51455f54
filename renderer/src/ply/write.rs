//! Writes a mesh as a binary little-endian PLY.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

use crate::mesh::Mesh;

/// Writes all of the mesh or leaves what `path` held before: it becomes a file of that name only when it is complete.
pub fn write(path: &Path, mesh: &Mesh) -> io::Result<()> {
    let Some(name) = path.file_name() else {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "names no file"));
    };
    let mut partial_name = name.to_owned();
    partial_name.push(format!(".{}.partial", std::process::id()));
    let partial = path.with_file_name(partial_name);
    let written = write_new(&partial, mesh).and_then(|()| fs::rename(&partial, path));
    if written.is_err() {
        // There may be nothing to remove; what went wrong first is what counts.
        let _ = fs::remove_file(&partial);
    }
    written
}

fn write_new(path: &Path, mesh: &Mesh) -> io::Result<()> {
    let mut writer = BufWriter::with_capacity(1 << 20, File::create_new(path)?);
    write_to(&mut writer, mesh)?;
    writer.into_inner()?.sync_all()
}

/// Rejected triangles are written with the indices −1, so that they are rejected again and keep their place.
pub(super) fn write_to(writer: &mut impl Write, mesh: &Mesh) -> io::Result<()> {
    let n_vertices = mesh.vertices.len();
    writeln!(writer, "ply\nformat binary_little_endian 1.0\nelement vertex {n_vertices}")?;
    writeln!(writer, "property float x\nproperty float y\nproperty float z")?;
    if !mesh.colors.is_empty() {
        writeln!(writer, "property uchar red\nproperty uchar green\nproperty uchar blue")?;
    }
    writeln!(writer, "element face {}", mesh.triangles.len())?;
    writeln!(writer, "property list uchar int vertex_indices\nend_header")?;
    for (i, position) in mesh.vertices.iter().enumerate() {
        writer.write_all(position.map(f32::to_le_bytes).as_flattened())?;
        if let Some(color) = mesh.colors.get(i) {
            writer.write_all(color)?;
        }
    }
    for triangle in &mesh.triangles {
        writer.write_all(&[3])?;
        writer.write_all(triangle.map(u32::to_le_bytes).as_flattened())?;
    }
    Ok(())
}
