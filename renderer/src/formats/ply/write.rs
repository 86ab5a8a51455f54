//! Writes a mesh as a binary little-endian PLY.

use std::{
    io::{self, Write},
    path::Path,
};

use channel::files;

use crate::model::mesh::Mesh;

/// Atomically writes a mesh to `path`: an old file stays until the new one is complete.
pub fn write(path: &Path, mesh: &Mesh) -> io::Result<()> {
    files::write(path, |mut out| write_to(&mut out, mesh))
}

/// Writes a mesh, whose origin must be zero, as that of everything generated is.
///
/// Rejected triangles get the indices −1, so that a reader rejects them again and file indices stay.
pub fn write_to(writer: &mut impl Write, mesh: &Mesh) -> io::Result<()> {
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
