//! Textures, and what faces and their corners look like.

use crate::formats::{
    assembly::AssemblyError,
    file::{Draft, IDLE_TEXTURES},
    images::ImageSource,
    ply::element::Corners,
    polygon::Division,
    wedges::{self, Look},
};
use crate::model::{
    material::{Material, TextureUse, Wrap},
    mesh::Mesh,
    normal::Normal,
};

/// The looks of triangles, in file order; each list is empty, or ends with the last triangle of faces.
#[derive(Default)]
pub(super) struct FaceLooks {
    pub(super) colors: Vec<[u8; 3]>,
    /// Numbers of textures.
    pub(super) textures: Vec<u16>,
    /// Texture coordinates of corners.
    corners: Vec<Option<[[f32; 2]; 3]>>,
}

/// PLY counts v from the lower edge.
pub(super) fn flipped([u, v]: [f32; 2]) -> [f32; 2] {
    [u, 1.0 - v]
}

impl FaceLooks {
    /// Begins with faces after `n_triangles` of strips, which have no looks of their own, but the first texture.
    pub(super) fn begin(&mut self, n_triangles: usize, [colored, numbered, textured]: [bool; 3]) {
        self.colors.resize(if colored { n_triangles } else { 0 }, [u8::MAX; 3]);
        self.textures.resize(if numbered { n_triangles } else { 0 }, 0);
        self.corners.resize(if textured { n_triangles } else { 0 }, None);
    }

    /// Adds the texture coordinates of a polygon's triangles.
    pub(super) fn push_corners(&mut self, face: &Corners, division: Division<'_>) {
        let coordinates = face.texture_coordinates.as_chunks().0;
        let are_whole = coordinates.len() == face.indices.len();
        let of_corner = |number: u32| flipped(coordinates[number as usize]);
        self.corners.extend(division.triangles().map(|triangle| are_whole.then(|| triangle.map(of_corner))));
    }

    /// Gives a mesh its looks. Colours of vertices count more than those of faces, coordinates of corners more than those of
    /// vertices.
    pub(super) fn finish(mut self, mut mesh: Mesh, textures: Vec<String>) -> Result<Draft, AssemblyError> {
        if !mesh.colors.is_empty() {
            self.colors.clear();
        }
        if !(self.colors.is_empty() && self.corners.is_empty()) {
            let normals = std::mem::take(&mut mesh.normals);
            let coordinates = std::mem::take(&mut mesh.texture_coordinates);
            wedges::split(&mut mesh, |triangle, corner, vertex| Look {
                texture_coordinates: match self.corners.get(triangle) {
                    Some(&Some(corners)) => Some(corners[corner]),
                    _ => coordinates.get(vertex).copied(),
                },
                normal: normals.get(vertex).copied().unwrap_or(Normal::OF_TRIANGLE),
                color: self.colors.get(triangle).copied(),
            })?;
        }
        let mut draft = Draft { mesh, ..Draft::default() };
        if !draft.mesh.texture_coordinates.is_empty() {
            add_textures(&mut draft, textures, self.textures);
        } else if !textures.is_empty() {
            draft.remarks.push(IDLE_TEXTURES.to_owned());
        }
        Ok(draft)
    }
}

fn add_textures(draft: &mut Draft, textures: Vec<String>, of_triangles: Vec<u16>) {
    let look = &mut draft.mesh.materials;
    let material = |(image, name): (usize, &String)| Material {
        name: name.clone(),
        base_color_texture: Some(TextureUse {
            image: image as u32,
            wrap: [Wrap::Repeat; 2],
            transform: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        }),
        ..Material::default()
    };
    look.materials = textures.iter().take(usize::from(u16::MAX)).enumerate().map(material).collect();
    let n = look.materials.len() as u16;
    if !of_triangles.is_empty() && n > 0 && of_triangles.iter().any(|&number| number != 0) {
        // A number beyond the textures is a surface without one.
        look.materials.push(Material::default());
        look.of_triangles = of_triangles.into_iter().map(|number| number.min(n)).collect();
        look.of_triangles.resize(draft.mesh.triangles.len(), n);
    }
    draft.images = textures.into_iter().take(usize::from(u16::MAX)).map(ImageSource::file).collect();
}
