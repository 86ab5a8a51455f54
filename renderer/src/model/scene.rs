//! Loads meshes and identifies them.

use std::{fmt, path::PathBuf};

use bytemuck::NoUninit;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use shared::{
    camera::Shape,
    printable::{counted, printable_line},
    scene::{SceneId, Treatment},
};

use crate::{
    formats::{
        file::{self, FileError, Reading},
        sources::Sources,
    },
    model::{
        material::{Material, Materials, TextureUse},
        mesh::Mesh,
        statue,
    },
    scene_file::SceneFileError,
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
    /// A file of any format that is read.
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
    /// Parts of the file that are left out, by the view of the whole too, or shown otherwise than it says: a line each,
    /// without the file's name.
    pub left_out: Vec<String>,
    /// The files that it was read from, if there are any and nothing of them changed meanwhile.
    pub sources: Option<Sources>,
}

/// All that is told of a model, without its triangles: enough for the wall.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelInfo {
    /// Identifies the mesh on all machines.
    pub id: SceneId,
    /// Its bounds, outline and likely up axis.
    pub shape: Shape,
    /// Triangles, without rejected ones.
    pub n_triangles: usize,
    /// Whether the triangles bound a solid, which cuts fill.
    pub is_solid: bool,
    /// Other contents of its file, beside triangles; a line each.
    pub found: Vec<String>,
    /// As in [`LoadedMesh::left_out`].
    pub left_out: Vec<String>,
}

impl ModelInfo {
    /// Logs what the file holds, and what was left out.
    pub fn log(&self, source: &SceneSource) {
        log(source, &self.found, &self.left_out);
    }
}

fn log(source: &SceneSource, found: &[String], left_out: &[String]) {
    found.iter().for_each(|line| tracing::info!("{source}: {line}"));
    left_out.iter().for_each(|line| tracing::warn!("{source}: {line}"));
}

/// Why a scene cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum LoadError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    SceneFile(#[from] SceneFileError),
    #[error("{}: is empty: it has neither vertices nor triangles; export the model again", path.display())]
    Empty { path: PathBuf },
    #[error("{}: has {} and no triangles: a point cloud must be meshed first", path.display(), counted(n_vertices, "vertex"))]
    NoTriangles { path: PathBuf, n_vertices: usize },
    #[error("{}: has {} and no triangles; {remark}: export it as a mesh of triangles", path.display(), counted(n_vertices, "vertex"))]
    OnlyOthers { path: PathBuf, n_vertices: usize, remark: String },
    #[error("{}: has {}, and each triangle, of {n_rejected}, has a corner that is none of them, or that has no usable \
        position (finite, and below 1e17): export the model again", path.display(), counted(n_vertices, "vertex"))]
    NoneUsable { path: PathBuf, n_vertices: usize, n_rejected: usize },
    #[error("{}: no triangle, of {n_triangles}, has an area, so there is nothing to see: export the model again", path.display())]
    NoArea { path: PathBuf, n_triangles: usize },
}

impl LoadedMesh {
    /// The same scene with the normals and the positions that its id asks for. Normals are those of exact positions.
    #[must_use]
    pub fn treated(self) -> Self {
        let Treatment { crease, precision } = self.id.treatment();
        Self { mesh: self.mesh.smooth(crease).snapped(precision), ..self }
    }

    /// The facts of the model, which bounds a solid or not.
    pub fn info(&self, is_solid: bool) -> ModelInfo {
        let Self { id, mesh, left_out, .. } = self;
        ModelInfo {
            id: *id,
            shape: mesh.shape(),
            n_triangles: mesh.triangles.len() - mesh.n_rejected,
            is_solid,
            found: self.found(),
            left_out: left_out.clone(),
        }
    }

    /// Logs what the file holds, and what was left out.
    pub fn log(&self, source: &SceneSource) {
        log(source, &self.found(), &self.left_out);
    }

    /// Other contents of the file, beside triangles: a line each, without the file's name.
    fn found(&self) -> Vec<String> {
        let mesh = &self.mesh;
        let relative = (mesh.origin != DVec3::ZERO).then(|| {
            let DVec3 { x, y, z } = mesh.origin;
            let rounding = mesh.largest_rounding();
            format!("traced relative to ({x}, {y}, {z}), rounded by at most {rounding:.1e}")
        });
        let rounded = mesh.lattice_of(self.id.treatment().precision).map(|lattice| {
            let (n_bits, error) = (lattice.n_bits(), lattice.largest_error());
            format!("positions have {n_bits} bits for each coordinate, and are off by at most {error:.1e}")
        });
        mesh.materials.summary().into_iter().chain(relative).chain(rounded).collect()
    }
}

/// Loads a mesh, for a scene with this treatment; `progress` receives the fraction done, 0 to 1.
///
/// The mesh is that of the source: who renders it must [treat](LoadedMesh::treated) it.
pub fn load(
    source: &SceneSource,
    treatment: Treatment,
    progress: &(dyn Fn(f32) + Sync),
) -> Result<LoadedMesh, LoadError> {
    match source {
        &SceneSource::Statue { triangles } => {
            let mesh = statue::generate(triangles, progress);
            let id = SceneId::Statue { triangles, treatment };
            Ok(LoadedMesh { id, mesh, left_out: Vec::new(), sources: None })
        }
        SceneSource::File(path) => {
            let (Reading { mesh, remarks }, sources) = file::read_with_sources(path, progress)?;
            let (n_vertices, n_rejected) = (mesh.vertices.len(), mesh.n_rejected);
            let path = path.clone();
            if mesh.triangles.is_empty() {
                return Err(match (n_vertices, remarks.first()) {
                    (0, _) => LoadError::Empty { path },
                    (_, None) => LoadError::NoTriangles { path, n_vertices },
                    (_, Some(remark)) => LoadError::OnlyOthers { path, n_vertices, remark: printable_line(remark) },
                });
            }
            if n_rejected == mesh.triangles.len() {
                return Err(LoadError::NoneUsable { path, n_vertices, n_rejected });
            }
            if !has_area(&mesh) {
                return Err(LoadError::NoArea { path, n_triangles: mesh.triangles.len() });
            }
            Ok(LoadedMesh { id: mesh_id(&mesh, treatment), left_out: left_out(&mesh, &remarks), mesh, sources })
        }
    }
}

/// Whether any triangle has corners that are not in line.
fn has_area(mesh: &Mesh) -> bool {
    let corners = (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle));
    corners
        .map(|corners| corners.map(|corner| DVec3::from(corner.map(f64::from))))
        .any(|[a, b, c]| (b - a).cross(c - a) != DVec3::ZERO)
}

/// Remarks that are told; a model that has moved may lack a thousand images.
const MOST_REMARKS: usize = 10;

/// The parts that were left out, or that the view of the whole leaves out, in lines fit for a log.
fn left_out(mesh: &Mesh, remarks: &[String]) -> Vec<String> {
    let (n_triangles, n_rejected) = (mesh.triangles.len(), mesh.n_rejected);
    let n_more = remarks.len().saturating_sub(MOST_REMARKS);
    let more = (n_more > 0).then(|| format!("{} like these", counted(n_more, "more line")));
    let rejected = (n_rejected > 0).then(|| {
        format!("triangles with a corner that is missing or not finite are left out: {n_rejected} of {n_triangles}")
    });
    let strays = mesh.bulk().remark(n_triangles - n_rejected);
    let remarks = remarks.iter().take(MOST_REMARKS).map(|remark| printable_line(remark)).chain(more);
    remarks.chain(rejected).chain(strays).collect()
}

/// BLAKE3 over vertices, triangles and colours: for each its length as `u64`, then its numbers, all little endian; then
/// over the origin's numbers if it is not zero; then over normals, texture coordinates and materials if there are any, each
/// after its name.
pub fn mesh_id(mesh: &Mesh, treatment: Treatment) -> SceneId {
    let mut hasher = blake3::Hasher::new();
    hash(&mut hasher, "", &mesh.vertices);
    hash(&mut hasher, "", &mesh.triangles);
    hash(&mut hasher, "", &mesh.colors);
    if mesh.origin != DVec3::ZERO {
        hasher.update(bytemuck::cast_slice(&mesh.origin.to_array()));
    }
    if !mesh.normals.is_empty() {
        hash(&mut hasher, "normals", &mesh.normals);
    }
    if !mesh.texture_coordinates.is_empty() {
        hash(&mut hasher, "texture coordinates", &mesh.texture_coordinates);
    }
    if mesh.materials != Materials::default() {
        hash_materials(&mut hasher, &mesh.materials);
    }
    SceneId::Mesh { blake3: *hasher.finalize().as_bytes(), treatment }
}

fn hash<T: NoUninit>(hasher: &mut blake3::Hasher, name: &str, items: &[T]) {
    hasher.update(name.as_bytes());
    hasher.update(&(items.len() as u64).to_le_bytes());
    hasher.update(bytemuck::cast_slice(items));
}

/// Hashes all but names: materials that look the same are the same.
fn hash_materials(hasher: &mut blake3::Hasher, materials: &Materials) {
    hash(hasher, "materials", &[materials.materials.len() as u64]);
    for material in &materials.materials {
        let Material { name: _, base_color, metallic, roughness, emissive, alpha_cutoff, is_unlit, .. } = material;
        hash(hasher, "", base_color);
        hash(hasher, "", &[*metallic, *roughness]);
        hash(hasher, "", emissive);
        hash(hasher, "", alpha_cutoff.as_slice());
        hash(hasher, "", &[u8::from(*is_unlit)]);
        let Material { base_color_texture, metallic_roughness_texture, emissive_texture, .. } = material;
        for texture in [base_color_texture, metallic_roughness_texture, emissive_texture] {
            hash(hasher, "", texture.map(|texture| texture.image).as_slice());
            if let Some(TextureUse { wrap, transform, .. }) = texture {
                hash(hasher, "", &wrap.map(|wrap| wrap as u8));
                hash(hasher, "", transform);
            }
        }
    }
    hash(hasher, "images", &[materials.images.len() as u64]);
    for image in &materials.images {
        hash(hasher, "", &[image.width, image.height]);
        hash(hasher, "", &image.texels);
    }
    hash(hasher, "of triangles", &materials.of_triangles);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{
        material::{Image, Wrap},
        normal::Normal,
    };

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
        let id = SceneId::Mesh { blake3: *blake3::hash(&bytes).as_bytes(), treatment: Treatment::FLAT };
        assert_eq!(mesh_id(&mesh, Treatment::FLAT), id);
    }

    #[test]
    fn equal_numbers_in_other_roles_give_another_id() {
        let vertices = Mesh { vertices: vec![[0.0; 3]; 2], ..Mesh::default() };
        let both = Mesh { vertices: vec![[0.0; 3]], triangles: vec![[0; 3]], ..Mesh::default() };
        let mesh_id = |mesh| mesh_id(mesh, Treatment::FLAT);
        assert_ne!(mesh_id(&vertices), mesh_id(&both));
        assert_ne!(mesh_id(&both), mesh_id(&Mesh { origin: DVec3::X, ..both.clone() }));
    }

    #[test]
    fn every_part_of_a_look_gives_another_id() {
        let texture = TextureUse { image: 0, wrap: Default::default(), transform: [[1.0; 3]; 2] };
        let material = Material { base_color_texture: Some(texture), ..Material::default() };
        let image = Image { width: 1, height: 1, texels: vec![[0; 4]] };
        let materials = Materials { materials: vec![material], images: vec![image], of_triangles: Vec::new() };
        let plain = Mesh { vertices: vec![[0.0; 3]], triangles: vec![[0; 3]], ..Mesh::default() };
        let look = Mesh { materials, ..plain.clone() };
        let changes: [fn(&mut Mesh); 10] = [
            |mesh| mesh.normals = vec![Normal::OF_TRIANGLE],
            |mesh| mesh.texture_coordinates = vec![[0.0; 2]],
            |mesh| mesh.materials.of_triangles = vec![0],
            |mesh| mesh.materials.images[0].texels[0][3] = 1,
            |mesh| mesh.materials.materials[0].roughness = 0.5,
            |mesh| mesh.materials.materials[0].alpha_cutoff = Some(0.0),
            |mesh| mesh.materials.materials[0].is_unlit = true,
            |mesh| mesh.materials.materials[0].base_color_texture = None,
            |mesh| mesh.materials.materials[0].emissive_texture = mesh.materials.materials[0].base_color_texture,
            |mesh| mesh.materials.materials[0].base_color_texture.as_mut().unwrap().wrap[1] = Wrap::Clamp,
        ];
        let changed = changes.iter().map(|change| {
            let mut mesh = look.clone();
            change(&mut mesh);
            mesh
        });
        let ids: Vec<_> =
            [plain, look.clone()].into_iter().chain(changed).map(|mesh| mesh_id(&mesh, Treatment::FLAT)).collect();
        assert!(ids.iter().enumerate().all(|(i, id)| !ids[..i].contains(id)), "{ids:?}");
        let mut renamed = look;
        renamed.materials.materials[0].name = "other".to_owned();
        assert_eq!(mesh_id(&renamed, Treatment::FLAT), ids[1]);
    }

    #[test]
    fn a_model_without_triangles_is_told_from_one_with_wrong_indices() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let error = |faces: &str| {
            let header =
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n";
            std::fs::write(&path, format!("{header}{faces}")).unwrap();
            load(&SceneSource::File(path.clone()), Treatment::FLAT, &|_| ()).unwrap_err().to_string()
        };
        assert!(error("end_header\n0 0 0\n").ends_with("a point cloud must be meshed first"));
        std::fs::write(&path, "solid nothing\nendsolid\n").unwrap();
        let empty = load(&SceneSource::File(path.clone()), Treatment::default(), &|_| ()).unwrap_err().to_string();
        assert!(empty.contains("is empty"), "{empty}");
        std::fs::write(&path, "v 0 0 0\nv 1 0 0\nv 3 0 0\nf 1 1 2\nf 1 2 3\n").unwrap();
        let flat = load(&SceneSource::File(path.clone()), Treatment::default(), &|_| ()).unwrap_err().to_string();
        assert!(flat.contains("no triangle, of 2, has an area"), "{flat}");
        std::fs::write(&path, "v 0 0 0\nv 1 0 0\nl 1 2\n").unwrap();
        let lines = load(&SceneSource::File(path.clone()), Treatment::default(), &|_| ()).unwrap_err().to_string();
        assert!(lines.contains("points, lines and curved surfaces are left out: 1: export it"), "{lines}");
        let face = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 1 2\n";
        assert!(error(face).ends_with("export the model again"), "{}", error(face));
    }

    #[test]
    fn a_missing_model_is_named() {
        let error = load(&SceneSource::File("no/such.ply".into()), Treatment::FLAT, &|_| ()).unwrap_err();
        assert!(error.to_string().starts_with("no/such.ply: cannot be read: "), "{error}");
    }
}
