//! The mesh that rays hit: ordered so that triangles close in space are close in memory.

mod corners;
mod file_indices;
mod numbering;
mod positions;
mod stored;

use bytemuck::Pod;
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use shared::srgb;

use crate::{
    intersect::ray::Ray,
    model::{
        lattice::Lattice,
        mesh::{Aabb, Mesh},
        normal::Normal,
        solid::Facing,
    },
    scene_file::section::Section,
    simd::{InstructionSet, Simd},
    texture::{
        footprint::{Footprints, texture_point},
        materials::{PointMaterials, TracedMaterials},
        packed_rgb::{self, PackedRgb},
    },
};
use corners::Corners;
use file_indices::FileIndices;
use numbering::Vertices;
use positions::Positions;

/// Bytes of a file index, rounded up; more where neighbours come from far apart in the file.
const FILE_INDEX_BYTES: u64 = 3;

/// A mesh in the order of a grid's cells, without triangles that cannot be hit.
///
/// A triangle index is a position here; [`TracedMesh::file_index`] is the triangle's number in the file.
#[derive(Debug, Serialize, Deserialize)]
pub struct TracedMesh {
    positions: Positions,
    /// The vertices of each triangle, which all have [`TracedMesh::positions`].
    #[serde(skip)]
    corners: Corners,
    file_indices: FileIndices,
    /// Linear; one for each vertex; empty in a mesh without colours.
    #[serde(skip)]
    colors: Section<PackedRgb>,
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
    /// Bytes of a triangle, without vertices.
    pub(crate) const BYTES_PER_TRIANGLE: u64 = FILE_INDEX_BYTES + Corners::BYTES_PER_TRIANGLE;

    /// Bytes that a mesh takes while it is ordered, as loaded and as traced, without triangles of the latter.
    pub(crate) fn peak_bytes(mesh: &Mesh) -> u64 {
        let geometry_bytes = (mesh.n_bytes() - mesh.materials.n_bytes()) as u64;
        // Triangles are dropped before the vertices are ordered.
        let triangle_bytes = size_of_val(&*mesh.triangles) as u64;
        let geometry_bytes = geometry_bytes.max(geometry_bytes - triangle_bytes + Self::vertex_bytes(mesh));
        let n_numbers = mesh.triangles.len() as u64 + vertices_in_order(mesh);
        geometry_bytes + size_of::<u32>() as u64 * n_numbers + TracedMaterials::peak_bytes(&mesh.materials)
    }

    /// Bytes of an ordered mesh, without triangles.
    pub(crate) fn bytes_in_order(mesh: &Mesh) -> u64 {
        Self::vertex_bytes(mesh) + TracedMaterials::n_bytes_of(&mesh.materials)
    }

    fn vertex_bytes(mesh: &Mesh) -> u64 {
        let bytes_per_vertex = Positions::bytes_per_vertex(mesh.lattice.as_ref())
            + usize::from(!mesh.colors.is_empty()) * size_of::<PackedRgb>()
            + usize::from(!mesh.normals.is_empty()) * size_of::<Normal>()
            + usize::from(!mesh.texture_coordinates.is_empty()) * size_of::<[f32; 2]>();
        bytes_per_vertex as u64 * vertices_in_order(mesh)
    }

    /// A mesh of these triangles in this order, by their number in `mesh`.
    pub fn new(mesh: Mesh, order: Vec<u32>) -> Self {
        let (bounds, bulk_bounds, facing) = (mesh.bounds(), mesh.bulk().bounds, mesh.facing());
        let Mesh { vertices, lattice, triangles, colors, normals, texture_coordinates, materials, origin, .. } = mesh;
        let materials = TracedMaterials::new(materials, &order);
        let texture_coordinates = if materials.has_textures() { texture_coordinates } else { Vec::new() };
        let of_vertices =
            Vertices { positions: &vertices, normals: &normals, colors: &colors, coordinates: &texture_coordinates };
        let (corners, kept) = Corners::new(&order, &triangles, &of_vertices);
        drop(triangles);
        let file_indices = FileIndices::new(&order);
        drop(order);
        Self {
            positions: Positions::new(&vertices, lattice, &kept),
            corners,
            file_indices,
            colors: values_of(&colors, &kept, |color| PackedRgb::nearest(color.map(srgb::decode))).into(),
            normals: values_of(&normals, &kept, |normal| normal).into(),
            texture_coordinates: values_of(&texture_coordinates, &kept, |point| point).into(),
            materials,
            bounds,
            bulk_bounds,
            facing,
            origin,
        }
    }

    /// A mesh whose triangles have the order of their first mention in `references`, which become triangle indices.
    pub(crate) fn in_order_of(mesh: Mesh, references: &mut [u32]) -> Self {
        let mut triangle_indices = vec![u32::MAX; mesh.triangles.len()];
        let mut order = Vec::with_capacity(mesh.triangles.len());
        for reference in references {
            let triangle_idx = &mut triangle_indices[*reference as usize];
            if *triangle_idx == u32::MAX {
                *triangle_idx = order.len() as u32;
                order.push(*reference);
            }
            *reference = *triangle_idx;
        }
        Self::new(mesh, order)
    }

    /// Number of triangles.
    pub fn n_triangles(&self) -> usize {
        self.file_indices.len()
    }

    /// Number of vertices; those that far triangles share count twice.
    pub fn n_vertices(&self) -> usize {
        self.positions.len()
    }

    /// A triangle's number in the file.
    #[inline]
    pub fn file_index(&self, triangle_idx: u32) -> u32 {
        self.file_indices.get(triangle_idx as usize)
    }

    /// A triangle's corners, in model space.
    #[inline(always)]
    pub fn corners(&self, triangle_idx: u32) -> [[f32; 3]; 3] {
        // Without a call, as of an array's map: what that writes to the stack is read late.
        let [a, b, c] = self.corners.of(triangle_idx);
        [self.positions.of(a), self.positions.of(b), self.positions.of(c)]
    }

    /// [`TracedMesh::corners`] by a call: long kernels are slower with its code in them.
    #[inline(never)]
    pub(crate) fn corners_by_call(&self, triangle_idx: u32) -> [[f32; 3]; 3] {
        self.corners(triangle_idx)
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

    /// Finds the materials of hits on triangles: see [`TracedMaterials::find`].
    pub(crate) fn find_materials(
        &self,
        instructions: InstructionSet,
        triangles: &[u32],
        footprints: &Footprints,
        colors: &mut [[f32; 64]; 3],
        materials: &mut PointMaterials,
    ) {
        self.materials.find(instructions, triangles, footprints, colors, materials);
    }

    /// Whether a ray passes a triangle that it hits, where the triangle's material has a gap.
    #[inline]
    pub(crate) fn is_passed(&self, triangle_idx: u32, ray: &Ray) -> bool {
        let point =
            || Some(texture_point(ray, &self.corners_by_call(triangle_idx), self.corner_coordinates(triangle_idx)?));
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
        (!self.texture_coordinates.is_empty()).then(|| self.corners.of(triangle_idx).map(coordinates))
    }

    /// Bounds of all triangles, in model space.
    pub fn bounds(&self) -> Aabb {
        self.bounds
    }

    /// Bounds of all triangles but [strays](Mesh::bulk), in model space.
    pub fn bulk_bounds(&self) -> Aabb {
        self.bulk_bounds
    }

    /// The farthest that positions may be from those of the model, in its units; 0 if they are the same.
    pub fn largest_error(&self) -> f64 {
        self.positions.lattice().map_or(0.0, Lattice::largest_error)
    }

    /// The zero of model space, in world space.
    pub fn origin(&self) -> DVec3 {
        self.origin
    }

    /// Bytes in memory.
    pub fn n_bytes(&self) -> usize {
        self.positions.n_bytes()
            + self.corners.n_bytes()
            + self.file_indices.n_bytes()
            + size_of_val(&*self.colors)
            + size_of_val(&*self.texture_coordinates)
            + self.materials.n_bytes()
            + size_of_val(&*self.normals)
    }

    /// Hints that a triangle's corners will be named soon.
    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, triangle_idx: u32) {
        self.corners.prefetch::<S>(triangle_idx);
    }

    /// The vertices of a triangle, which will be read soon: see [`TracedMesh::gather_vertices`].
    #[inline(always)]
    pub(crate) fn prefetch_vertices<S: Simd>(&self, triangle_idx: u32) -> [u32; 3] {
        let [a, b, c] = self.corners.of(triangle_idx);
        self.positions.prefetch::<S>(a);
        self.positions.prefetch::<S>(b);
        self.positions.prefetch::<S>(c);
        [a, b, c]
    }

    /// Gathers the coordinates of triangles' corners, one triangle per lane, by corner and axis.
    #[inline(always)]
    pub(crate) fn gather_corners<S: Simd>(&self, triangle_indices: &[u32; 16]) -> [[S; 3]; 3] {
        let [a, b, c] = &self.corners.of_lanes::<S>(triangle_indices);
        // SAFETY: all vertices of triangles exist.
        unsafe { self.gather_vertices([a, b, c]) }
    }

    /// Gathers the coordinates of vertices, one triangle per lane, by corner and axis.
    ///
    /// # Safety
    ///
    /// The vertices in the first [`Simd::LANES`] lanes are those of triangles of this mesh.
    #[inline(always)]
    pub(crate) unsafe fn gather_vertices<S: Simd>(&self, vertices: [&[u32; 16]; 3]) -> [[S; 3]; 3] {
        // SAFETY: the caller's.
        unsafe { self.positions.gather(vertices) }
    }

    /// The vertices of triangles' corners, one triangle per lane, by corner. Lanes from [`Simd::LANES`] on hold none.
    #[inline(always)]
    pub(crate) fn corner_vertices<S: Simd>(&self, triangle_indices: &[u32; 16]) -> [[u32; 16]; 3] {
        self.corners.of_lanes::<S>(triangle_indices)
    }

    /// Gathers the bits of the normals of triangles' corners, one triangle per lane, by corner, into as many lanes as a vector
    /// has; the mesh must have normals.
    #[inline(always)]
    pub(crate) fn gather_normals<S: Simd>(
        &self,
        triangle_indices: &[u32; 16],
        vertices: &[[u32; 16]; 3],
        to: [&mut [u32]; 3],
    ) {
        let [to_a, to_b, to_c] = to;
        S::gather_bits(&self.normals, &vertices[0]).store_bits(to_a);
        S::gather_bits(&self.normals, &vertices[1]).store_bits(to_b);
        S::gather_bits(&self.normals, &vertices[2]).store_bits(to_c);
        self.corners.flatten::<S>(triangle_indices, [to_a, to_b, to_c]);
    }

    /// Gathers the linear colours of vertices by channel into as many lanes as a vector has; the mesh must have colours.
    #[inline(always)]
    pub(crate) fn gather_colors<S: Simd>(&self, vertices: &[u32; 16], to: &mut [[f32; 16]; 3], first: usize) {
        let mut colors = [0u32; 16];
        S::gather_bits(&self.colors, vertices).store_bits(&mut colors);
        for (channel, to) in to.iter_mut().enumerate() {
            for (to, &color) in to[first..first + S::LANES].iter_mut().zip(&colors) {
                *to = PackedRgb::of_bits(color).scaled(channel) * packed_rgb::UNITS[channel];
            }
        }
    }

    /// Gathers the texture coordinates of vertices, u and v, into as many lanes as a vector has; the mesh must have textures.
    #[inline(always)]
    pub(crate) fn gather_coordinates<S: Simd>(&self, vertices: &[u32; 16], [to_u, to_v]: [&mut [f32]; 2]) {
        let coordinates: &[f32] = bytemuck::cast_slice(&self.texture_coordinates);
        let (mut of_u, mut of_v) = ([0; 16], [0; 16]);
        for lane in 0..16 {
            (of_u[lane], of_v[lane]) = (2 * vertices[lane], 2 * vertices[lane] + 1);
        }
        S::gather_bits(coordinates, &of_u).store(to_u);
        S::gather_bits(coordinates, &of_v).store(to_v);
    }
}

/// Vertices of an ordered mesh, as they mostly are: those that far triangles share are there twice.
fn vertices_in_order(mesh: &Mesh) -> u64 {
    mesh.vertices.len() as u64 * 3 / 2
}

/// Values of the kept vertices, as they are traced; none where the mesh has none.
fn values_of<T: Pod + Sync, U: Pod + Send>(values: &[T], kept: &[Vec<u32>], traced: impl Fn(T) -> U + Sync) -> Vec<U> {
    if values.is_empty() {
        return Vec::new();
    }
    in_order(kept, 1, 0, |vertex, to| to[0] = traced(values[vertex as usize]))
}

/// The kept vertices' values as `write` gives them by the vertices' numbers as loaded, `stride` items for each, and so many more
/// zeros. Threads write in parallel, because the first write to fresh memory waits for page faults.
fn in_order<U: Pod + Send>(
    kept: &[Vec<u32>],
    stride: usize,
    n_zeros: usize,
    write: impl Fn(u32, &mut [U]) + Sync,
) -> Vec<U> {
    let mut in_order = vec![U::zeroed(); kept.iter().map(Vec::len).sum::<usize>() * stride + n_zeros];
    let mut rest = &mut *in_order;
    let mut parts = Vec::with_capacity(kept.len());
    for of_part in kept {
        let (part, others) = rest.split_at_mut(of_part.len() * stride);
        parts.push((part, of_part));
        rest = others;
    }
    parts.into_par_iter().for_each(|(part, of_part)| {
        for (item, &vertex) in part.chunks_exact_mut(stride).zip(of_part) {
            write(vertex, item);
        }
    });
    in_order
}
