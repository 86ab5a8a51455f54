//! Loads meshes and identifies them.

use std::{fmt, path::PathBuf};

use glam::DVec3;
use shared::scene::SceneId;

use crate::model::{
    mesh::Mesh,
    ply::{self, PlyError},
    statue,
};

#[cfg(target_endian = "big")]
compile_error!("a scene's id is the hash of its numbers in memory, little endian: swap their bytes in `mesh_id` first");

/// Where a mesh comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SceneSource {
    /// The built-in statue.
    Statue {
        /// Approximate number of triangles.
        triangles: u32,
    },
    /// A file.
    File(PathBuf),
}

impl fmt::Display for SceneSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Statue { .. } => f.write_str("the built-in statue"),
            Self::File(path) => write!(f, "{}", path.display()),
        }
    }
}

/// A mesh with its id.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedMesh {
    /// Identifies the mesh on all machines.
    pub id: SceneId,
    /// Has at least one triangle that can be traced.
    pub mesh: Mesh,
}

/// Why a scene cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum LoadError {
    #[error(transparent)]
    Ply(#[from] PlyError),
    #[error("{}: has {n_vertices} vertices and no triangles: a point cloud must be meshed first", path.display())]
    NoTriangles { path: PathBuf, n_vertices: usize },
    #[error("{}: has {n_vertices} vertices, and each of its {n_rejected} triangles has a corner that is none of them, or \
        that has no usable position: export the model again", path.display())]
    NoneUsable { path: PathBuf, n_vertices: usize, n_rejected: usize },
}

/// Loads a mesh; `progress` receives the fraction done, 0 to 1.
pub fn load(source: &SceneSource, progress: &(dyn Fn(f32) + Sync)) -> Result<LoadedMesh, LoadError> {
    match source {
        &SceneSource::Statue { triangles } => {
            Ok(LoadedMesh { id: SceneId::Statue { triangles }, mesh: statue::generate(triangles, progress) })
        }
        SceneSource::File(path) => {
            let mesh = ply::read(path, progress)?;
            let (n_vertices, n_rejected) = (mesh.vertices.len(), mesh.n_rejected);
            let path = path.clone();
            if mesh.triangles.is_empty() {
                return Err(LoadError::NoTriangles { path, n_vertices });
            }
            if n_rejected == mesh.triangles.len() {
                return Err(LoadError::NoneUsable { path, n_vertices, n_rejected });
            }
            if n_rejected > 0 {
                let (path, n) = (path.display(), mesh.triangles.len());
                tracing::warn!("{path}: {n_rejected} of {n} triangles are left out: a corner is missing or not finite");
            }
            if mesh.origin != DVec3::ZERO {
                let DVec3 { x, y, z } = mesh.origin;
                let rounding = mesh.largest_rounding();
                let path = path.display();
                tracing::info!("{path}: traced relative to ({x}, {y}, {z}), rounded by at most {rounding:.1e}");
            }
            Ok(LoadedMesh { id: mesh_id(&mesh), mesh })
        }
    }
}

/// BLAKE3 over vertices, triangles and colours: for each its length as `u64`, then its numbers, all little endian; then
/// over the origin's numbers if it is not zero.
pub fn mesh_id(mesh: &Mesh) -> SceneId {
    let mut hasher = blake3::Hasher::new();
    let mut part = |n_items: usize, bytes: &[u8]| {
        hasher.update(&(n_items as u64).to_le_bytes());
        hasher.update(bytes);
    };
    part(mesh.vertices.len(), bytemuck::cast_slice(&mesh.vertices));
    part(mesh.triangles.len(), bytemuck::cast_slice(&mesh.triangles));
    part(mesh.colors.len(), bytemuck::cast_slice(&mesh.colors));
    if mesh.origin != DVec3::ZERO {
        hasher.update(bytemuck::cast_slice(&mesh.origin.to_array()));
    }
    SceneId::Mesh { blake3: *hasher.finalize().as_bytes() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_id_hashes_little_endian_numbers() {
        let mesh = Mesh {
            vertices: vec![[1.0, 0.0, 0.0]],
            triangles: vec![[0, 0, 0]],
            colors: vec![[1, 2, 3]],
            ..Mesh::default()
        };
        let bytes = [&[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 0x3f][..], &[0; 8], &[1, 0, 0, 0, 0, 0, 0, 0], &[0; 12]];
        let bytes = [bytes.concat(), vec![1, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3]].concat();
        assert_eq!(mesh_id(&mesh), SceneId::Mesh { blake3: *blake3::hash(&bytes).as_bytes() });
    }

    #[test]
    fn equal_numbers_in_other_roles_give_another_id() {
        let vertices = Mesh { vertices: vec![[0.0; 3]; 2], ..Mesh::default() };
        let both = Mesh { vertices: vec![[0.0; 3]], triangles: vec![[0; 3]], ..Mesh::default() };
        assert_ne!(mesh_id(&vertices), mesh_id(&both));
        assert_ne!(mesh_id(&both), mesh_id(&Mesh { origin: DVec3::X, ..both.clone() }));
    }

    #[test]
    fn a_model_without_triangles_is_told_from_one_with_wrong_indices() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let error = |faces: &str| {
            let header =
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
            std::fs::write(&path, format!("{header}{faces}")).unwrap();
            load(&SceneSource::File(path.clone()), &|_| ()).unwrap_err().to_string()
        };
        assert!(error("end_header\n0 0 0\n").ends_with("a point cloud must be meshed first"));
        let face = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 1 2\n";
        assert!(error(face).ends_with("export the model again"), "{}", error(face));
    }

    #[test]
    fn a_missing_model_is_named() {
        let error = load(&SceneSource::File("no/such.ply".into()), &|_| ()).unwrap_err();
        assert!(error.to_string().starts_with("no/such.ply: cannot be read: "), "{error}");
    }
}
