//! The mesh that rays hit: ordered so that triangles close in space are close in memory.

mod stored;

use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use shared::srgb;

use crate::{
    intersect::ray::{Hit, Ray},
    model::{
        mesh::{Aabb, Mesh},
        normal::Normal,
        solid::Facing,
    },
    scene_file::section::Section,
    simd::{InstructionSet, Simd},
    texture::{
        footprint::{Footprints, texture_point},
        materials::{PointMaterial, TracedMaterials},
    },
};

/// A mesh in the order of a grid's cells, without triangles that cannot be hit.
///
/// A triangle index is a position here; [`TracedMesh::file_index`] gives the triangle's number in the file.
#[derive(Debug, Serialize, Deserialize)]
pub struct TracedMesh {
    /// Positions, and one more at the end, see [`TracedMesh::coordinates`].
    #[serde(skip)]
    vertices: Section<[f32; 3]>,
    /// The vertices of each triangle, all within [`TracedMesh::coordinates`].
    #[serde(skip)]
    triangles: Section<[u32; 3]>,
    #[serde(skip)]
    file_indices: Section<u32>,
    /// sRGB, one for each vertex; empty in a mesh without colours.
    #[serde(skip)]
    colors: Section<[u8; 3]>,
    /// One for each vertex; empty in a mesh without textures.
    #[serde(skip)]
    texture_coordinates: Section<[f32; 2]>,
    materials: TracedMaterials,
    /// One for each vertex; empty in a mesh of flat triangles.
    #[serde(skip)]
    normals: Section<Normal>,
    bounds: Aabb,
    bulk_bounds: Aabb,
    facing: Option<Facing>,
    origin: DVec3,
}

impl TracedMesh {
    /// Most bytes that a mesh takes while it is ordered, as loaded and as traced, without the references.
    pub(crate) fn peak_bytes(mesh: &Mesh) -> u64 {
        // With the renumbering of triangles and vertices in both directions.
        let (n_triangles, n_vertices) = (mesh.triangles.len() as u64, mesh.vertices.len() as u64);
        let geometry_bytes = mesh.n_bytes() - mesh.materials.n_bytes();
        geometry_bytes as u64
            + Self::geometry_bytes_in_order(mesh)
            + 4 * n_triangles
            + 8 * n_vertices
            + TracedMaterials::peak_bytes(&mesh.materials)
    }

    /// Most bytes that an ordered mesh takes, without the references.
    pub(crate) fn bytes_in_order(mesh: &Mesh) -> u64 {
        Self::geometry_bytes_in_order(mesh) + TracedMaterials::n_bytes_of(&mesh.materials)
    }

    fn geometry_bytes_in_order(mesh: &Mesh) -> u64 {
        let (n_triangles, n_vertices) = (mesh.triangles.len() as u64, mesh.vertices.len() as u64);
        // With file indices.
        let of_vertices =
            size_of_val(&*mesh.colors) + size_of_val(&*mesh.normals) + size_of_val(&*mesh.texture_coordinates);
        16 * n_triangles + 12 * n_vertices + of_vertices as u64
    }

    /// Orders a mesh by the first mention of each triangle in `references`, which become triangle indices.
    pub fn new(mesh: Mesh, references: &mut [u32]) -> Self {
        let (bounds, bulk_bounds, facing) = (mesh.bounds(), mesh.bulk().bounds, mesh.facing());
        let Mesh { vertices, triangles, colors, normals, texture_coordinates, materials, origin, .. } = mesh;

        // Number the triangles in the order of their first mention.
        let mut file_indices = Vec::new();
        let mut renumbering = Renumbering::new(triangles.len());
        for &reference in &*references {
            renumbering.assign(reference, |file_index| file_indices.push(file_index));
        }
        let Renumbering { new_indices, .. } = renumbering;

        // Replace the references, and number the vertices in the order of these triangles.
        let replace = || references.par_iter_mut().for_each(|reference| *reference = new_indices[*reference as usize]);
        let mut kept_vertices = Vec::new();
        let mut vertex_renumbering = Renumbering::new(vertices.len());
        let renumber_vertices = || {
            for vertex in file_indices.iter().flat_map(|&file_index| triangles[file_index as usize]) {
                vertex_renumbering.assign(vertex, |vertex| kept_vertices.push(vertex));
            }
        };
        rayon::join(replace, renumber_vertices);
        drop(new_indices);

        // Copy in the new order, in parallel: the first write to fresh memory waits for page faults.
        let in_order = file_indices.par_iter().map(|&file_index| triangles[file_index as usize]);
        let triangles_in_order: Vec<_> =
            in_order.map(|corners| corners.map(|vertex| vertex_renumbering.new_indices[vertex as usize])).collect();
        drop((triangles, vertex_renumbering));
        let materials = TracedMaterials::new(materials, &file_indices);
        let (is_colored, has_normals) = (!colors.is_empty(), !normals.is_empty());
        let kept_normals = kept_vertices.iter().filter(|_| has_normals);
        let is_textured = materials.has_textures() && !texture_coordinates.is_empty();
        let kept_coordinates = kept_vertices.iter().filter(|_| is_textured);
        Self {
            vertices: padded(kept_vertices.par_iter().map(|&vertex| vertices[vertex as usize])).into(),
            triangles: triangles_in_order.into(),
            file_indices: file_indices.into(),
            colors: kept_vertices.iter().filter(|_| is_colored).map(|&vertex| colors[vertex as usize]).collect(),
            normals: kept_normals.map(|&vertex| normals[vertex as usize]).collect(),
            texture_coordinates: kept_coordinates.map(|&vertex| texture_coordinates[vertex as usize]).collect(),
            materials,
            bounds,
            bulk_bounds,
            facing,
            origin,
        }
    }

    /// Number of triangles.
    pub fn n_triangles(&self) -> usize {
        self.file_indices.len()
    }

    /// A triangle's number in the file.
    #[inline]
    pub fn file_index(&self, triangle_idx: u32) -> u32 {
        self.file_indices[triangle_idx as usize]
    }

    /// A triangle's corners, in model space.
    #[inline]
    pub fn corners(&self, triangle_idx: u32) -> [[f32; 3]; 3] {
        self.triangles[triangle_idx as usize].map(|vertex| self.vertices[vertex as usize])
    }

    /// A vector of any length across a triangle, on the side where its corners run counter-clockwise.
    #[inline]
    pub(crate) fn normal(&self, triangle_idx: u32) -> DVec3 {
        let [a, b, c] = self.corners(triangle_idx).map(|corner| Vec3::from_array(corner).as_dvec3());
        (b - a).cross(c - a)
    }

    /// How the triangles face, if they bound a solid.
    pub fn facing(&self) -> Option<Facing> {
        self.facing
    }

    /// Whether corners have colours.
    pub(crate) fn has_colors(&self) -> bool {
        !self.colors.is_empty()
    }

    /// Whether corners have normals.
    pub(crate) fn has_normals(&self) -> bool {
        !self.normals.is_empty()
    }

    /// Whether corners have texture coordinates.
    pub(crate) fn has_texture_coordinates(&self) -> bool {
        !self.texture_coordinates.is_empty()
    }

    /// Whether a triangle's surface ignores light, and shows its colour.
    pub(crate) fn is_unlit(&self, triangle_idx: u32) -> bool {
        self.materials.is_unlit(triangle_idx)
    }

    /// Whether surfaces have materials.
    pub(crate) fn has_materials(&self) -> bool {
        self.materials.has_materials()
    }

    /// Finds the materials where up to 64 rays hit triangles; `None` for misses, caps, and in meshes without
    /// materials.
    pub(crate) fn find_materials(
        &self,
        instructions: InstructionSet,
        hits: &[Hit],
        footprints: &Footprints,
        materials: &mut [Option<PointMaterial>; 64],
    ) {
        let triangles = hits.iter().map(|hit| (!hit.is_miss() && !hit.is_cap()).then_some(hit.triangle));
        self.materials.find(instructions, triangles, footprints, materials);
    }

    /// Whether a ray passes a triangle that it hits, where the triangle's material has a gap.
    #[inline]
    pub(crate) fn is_passed(&self, triangle_idx: u32, ray: &Ray) -> bool {
        let point = || Some(texture_point(ray, &self.corners(triangle_idx), self.corner_coordinates(triangle_idx)?));
        self.materials.is_cut(triangle_idx, point)
    }

    /// Whether rays pass some triangles that they hit.
    #[inline]
    pub(crate) fn has_masks(&self) -> bool {
        self.materials.has_masks()
    }

    /// The texture coordinates of a triangle's corners, if the mesh has textures.
    #[inline]
    fn corner_coordinates(&self, triangle_idx: u32) -> Option<[Vec2; 3]> {
        let coordinates = |vertex: u32| Vec2::from_array(self.texture_coordinates[vertex as usize]);
        (!self.texture_coordinates.is_empty()).then(|| self.triangles[triangle_idx as usize].map(coordinates))
    }

    /// Bounds of all triangles, in model space.
    pub fn bounds(&self) -> Aabb {
        self.bounds
    }

    /// Bounds of all triangles but [strays](Mesh::bulk), in model space.
    pub fn bulk_bounds(&self) -> Aabb {
        self.bulk_bounds
    }

    /// The zero of model space, in world space.
    pub fn origin(&self) -> DVec3 {
        self.origin
    }

    /// Bytes in memory.
    pub fn n_bytes(&self) -> usize {
        size_of_val(&*self.vertices)
            + size_of_val(&*self.triangles)
            + size_of_val(&*self.file_indices)
            + size_of_val(&*self.colors)
            + size_of_val(&*self.texture_coordinates)
            + self.materials.n_bytes()
            + size_of_val(&*self.normals)
    }

    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, triangle_idx: u32) {
        S::prefetch(&self.triangles, triangle_idx as usize);
    }

    /// Hints that a triangle's corners will be read soon; its vertex indices are read now.
    #[inline(always)]
    pub(crate) fn prefetch_corners<S: Simd>(&self, triangle_idx: u32) {
        if let Some(&[a, b, c]) = self.triangles.get(triangle_idx as usize) {
            S::prefetch(&self.vertices, a as usize);
            S::prefetch(&self.vertices, b as usize);
            S::prefetch(&self.vertices, c as usize);
        }
    }

    /// Gathers the coordinates of triangles' corners, one triangle per lane, by corner and axis.
    #[inline(always)]
    pub(crate) fn gather_corners<S: Simd>(&self, triangle_indices: &[u32; 16]) -> [[S; 3]; 3] {
        let mut vertices = [[0; 16]; 3];
        for lane in 0..S::LANES {
            let [a, b, c] = self.triangles[triangle_indices[lane] as usize];
            (vertices[0][lane], vertices[1][lane], vertices[2][lane]) = (a, b, c);
        }
        let coordinates = self.coordinates();
        let [a, b, c] = &vertices;
        // SAFETY: all vertices of triangles exist, and another follows the last.
        unsafe { [S::gather_xyz(coordinates, a), S::gather_xyz(coordinates, b), S::gather_xyz(coordinates, c)] }
    }

    /// Gathers the normals of triangles' corners, by corner; the mesh must have normals.
    #[inline(always)]
    pub(crate) fn gather_corner_normals(&self, triangle_indices: &[u32; 16]) -> [[Normal; 16]; 3] {
        let mut normals = [[Normal::OF_TRIANGLE; 16]; 3];
        for (lane, &triangle_idx) in triangle_indices.iter().enumerate() {
            let [a, b, c] = self.triangles[triangle_idx as usize];
            normals[0][lane] = self.normals[a as usize];
            normals[1][lane] = self.normals[b as usize];
            normals[2][lane] = self.normals[c as usize];
        }
        normals
    }

    /// Gathers the colours of triangles' corners, in linear light, by corner and channel; the mesh must have colours.
    #[inline(always)]
    pub(crate) fn gather_corner_colors(&self, triangle_indices: &[u32; 16]) -> [[[f32; 16]; 3]; 3] {
        let mut colors = [[[0.0; 16]; 3]; 3];
        for (lane, &triangle_idx) in triangle_indices.iter().enumerate() {
            let corners = self.triangles[triangle_idx as usize];
            for (corner, &vertex) in corners.iter().enumerate() {
                let [red, green, blue] = self.colors[vertex as usize].map(srgb::decode);
                let of_corner = &mut colors[corner];
                (of_corner[0][lane], of_corner[1][lane], of_corner[2][lane]) = (red, green, blue);
            }
        }
        colors
    }

    /// Gathers the texture coordinates of triangles' corners, by corner; the mesh must have textures.
    #[inline(always)]
    pub(crate) fn gather_corner_coordinates(&self, triangle_indices: &[u32; 16]) -> [[[f32; 16]; 2]; 3] {
        let mut coordinates = [[[0.0; 16]; 2]; 3];
        for (lane, &triangle_idx) in triangle_indices.iter().enumerate() {
            let corners = self.triangles[triangle_idx as usize];
            for (corner, &vertex) in corners.iter().enumerate() {
                let [u, v] = self.texture_coordinates[vertex as usize];
                (coordinates[corner][0][lane], coordinates[corner][1][lane]) = (u, v);
            }
        }
        coordinates
    }

    /// Coordinates of all vertices, vertex after vertex, and three more numbers.
    pub(crate) fn coordinates(&self) -> &[f32] {
        bytemuck::cast_slice(&self.vertices)
    }
}

/// Vertices and one more, so that four numbers can be loaded from the last.
fn padded(vertices: impl IndexedParallelIterator<Item = [f32; 3]>) -> Vec<[f32; 3]> {
    let mut padded = Vec::with_capacity(vertices.len() + 1);
    padded.par_extend(vertices);
    padded.push([0.0; 3]);
    padded
}

/// New indices, assigned in the order of first mention.
struct Renumbering {
    new_indices: Vec<u32>,
    n_assigned: u32,
}

impl Renumbering {
    fn new(n: usize) -> Self {
        Self { new_indices: vec![u32::MAX; n], n_assigned: 0 }
    }

    /// Assigns the next index to `old` and calls `first`, if it has none yet.
    #[inline]
    fn assign(&mut self, old: u32, first: impl FnOnce(u32)) {
        let new_index = &mut self.new_indices[old as usize];
        if *new_index == u32::MAX {
            *new_index = self.n_assigned;
            self.n_assigned += 1;
            first(old);
        }
    }
}
