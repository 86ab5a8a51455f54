//! Loads what is to be traced, and names it.

use std::{fmt, path::PathBuf};

use shared::scene::SceneId;

use crate::model::{
    mesh::Mesh,
    ply::{self, PlyError},
    statue,
};

#[cfg(target_endian = "big")]
compile_error!(
    "a scene's identity is the hash of little-endian numbers as they lie in memory: swap them in `mesh_id` first"
);

/// Where a mesh comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SceneSource {
    /// The built-in statue.
    Statue {
        /// About how many triangles.
        triangles: u32,
    },
    /// A PLY file.
    Ply(PathBuf),
}

impl fmt::Display for SceneSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Statue { .. } => f.write_str("the built-in statue"),
            Self::Ply(path) => write!(f, "{}", path.display()),
        }
    }
}

/// A mesh and its name.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedMesh {
    /// The same on all machines, for the same mesh only.
    pub id: SceneId,
    /// At least one triangle of it can be traced.
    pub mesh: Mesh,
}

/// Why there is nothing to trace.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The file gives no mesh.
    #[error(transparent)]
    Ply(#[from] PlyError),
    /// The file gives a mesh of which nothing can be seen.
    #[error("{}: has no triangles that can be traced ({n_vertices} vertices, {n_rejected} triangles rejected): \
        a point cloud must be meshed first", path.display())]
    NoTriangles {
        /// The file.
        path: PathBuf,
        /// What it holds.
        n_vertices: usize,
        /// Triangles with indices or coordinates that cannot be used.
        n_rejected: usize,
    },
}

/// Loads a scene; `progress` is told what fraction is done, 0 to 1.
pub fn load(source: &SceneSource, progress: &(dyn Fn(f32) + Sync)) -> Result<LoadedMesh, LoadError> {
    match source {
        &SceneSource::Statue { triangles } => {
            Ok(LoadedMesh { id: SceneId::Statue { triangles }, mesh: statue::generate(triangles, progress) })
        }
        SceneSource::Ply(path) => {
            let mesh = ply::read(path, progress)?;
            let (n_vertices, n_rejected) = (mesh.vertices.len(), mesh.n_rejected);
            if n_rejected == mesh.triangles.len() {
                return Err(LoadError::NoTriangles { path: path.clone(), n_vertices, n_rejected });
            }
            Ok(LoadedMesh { id: mesh_id(&mesh), mesh })
        }
    }
}

/// BLAKE3 over vertices, triangles and colours: of each first how many (`u64`), then the numbers, all little endian.
pub fn mesh_id(mesh: &Mesh) -> SceneId {
    let mut hasher = blake3::Hasher::new();
    let mut part = |n_items: usize, bytes: &[u8]| {
        hasher.update(&(n_items as u64).to_le_bytes());
        hasher.update(bytes);
    };
    part(mesh.vertices.len(), bytemuck::cast_slice(&mesh.vertices));
    part(mesh.triangles.len(), bytemuck::cast_slice(&mesh.triangles));
    part(mesh.colors.len(), bytemuck::cast_slice(&mesh.colors));
    SceneId::Mesh { blake3: *hasher.finalize().as_bytes() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mesh_is_named_by_its_little_endian_numbers() {
        let mesh = Mesh {
            vertices: vec![[1.0, 0.0, 0.0]],
            triangles: vec![[0, 0, 0]],
            colors: vec![[1, 2, 3]],
            n_rejected: 0,
        };
        let bytes = [&[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 0x3f][..], &[0; 8], &[1, 0, 0, 0, 0, 0, 0, 0], &[0; 12]];
        let bytes = [bytes.concat(), vec![1, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3]].concat();
        assert_eq!(mesh_id(&mesh), SceneId::Mesh { blake3: *blake3::hash(&bytes).as_bytes() });
    }

    #[test]
    fn numbers_that_change_sides_make_another_name() {
        let vertices = Mesh { vertices: vec![[0.0; 3]; 2], ..Mesh::default() };
        let both = Mesh { vertices: vec![[0.0; 3]], triangles: vec![[0; 3]], ..Mesh::default() };
        assert_ne!(mesh_id(&vertices), mesh_id(&both));
    }

    #[test]
    fn a_missing_model_is_named() {
        let error = load(&SceneSource::Ply("no/such.ply".into()), &|_| ()).unwrap_err();
        assert!(error.to_string().starts_with("no/such.ply: cannot be read: "), "{error}");
    }
}
