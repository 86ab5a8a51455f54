//! Textures, and what faces and their corners look like.

use crate::formats::{
    assembly::AssemblyError,
    file::Draft,
    images::ImageSource,
    ply::element::Corners,
    wedges::{self, Look},
};
use crate::model::{
    material::{Material, TextureUse, Wrap},
    mesh::Mesh,
    normal::Normal,
};

/// The looks of triangles, in file order; each list is empty, or as long as the triangles of faces.
#[derive(Default)]
pub(super) struct FaceLooks {
    pub(super) colors: Vec<[u8; 3]>,
    /// Numbers of textures.
    pub(super) textures: Vec<u16>,
    /// Texture coordinates of corners.
    corners: Vec<[[f32; 2]; 3]>,
}

/// PLY counts v from the lower edge.
pub(super) fn flipped([u, v]: [f32; 2]) -> [f32; 2] {
    [u, 1.0 - v]
}

impl FaceLooks {
    /// Adds the texture coordinates of a polygon, fanned like it.
    pub(super) fn push_corners(&mut self, face: &Corners) {
        let n_triangles = face.indices.len().saturating_sub(2);
        match *face.texture_coordinates.as_chunks::<2>().0 {
            [first, ref rest @ ..] if rest.len() + 1 == face.indices.len() => {
                self.corners.extend(rest.windows(2).map(|edge| [first, edge[0], edge[1]].map(flipped)));
            }
            _ => self.corners.extend(std::iter::repeat_n([[0.0; 2]; 3], n_triangles)),
        }
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
                    Some(corners) => corners[corner],
                    None => coordinates.get(vertex).copied().unwrap_or_default(),
                },
                normal: normals.get(vertex).copied().unwrap_or(Normal::OF_TRIANGLE),
                color: self.colors.get(triangle).copied(),
            })?;
        }
        let mut draft = Draft { mesh, ..Draft::default() };
        if !draft.mesh.texture_coordinates.is_empty() {
            add_textures(&mut draft, textures, self.textures);
        } else if !textures.is_empty() {
            draft.remarks.push("its textures are left out: it has no texture coordinates".to_owned());
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
