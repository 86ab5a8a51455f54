//! Puts the triangles of all meshes together, in world space.

use std::collections::{BTreeMap, HashMap};

use glam::{DMat3, DMat4, DVec3, DVec4};
use shared::srgb;

use crate::formats::{
    assembly::{MeshBuilder, extend},
    file::Draft,
    gltf::{
        Problem,
        accessor::Elements,
        buffers::Buffers,
        document::{AlphaMode, Document, Kind, Primitive},
        draco,
        look::Look,
        nodes::Instance,
    },
};
use crate::model::normal::Normal;

/// Beyond this many metres from zero, `f32` steps by more than a tenth of a millimetre: positions keep an origin there.
const FAR: f64 = 1024.0;
/// Triangles that copies of meshes may add up to, if the file has fewer bytes.
const MOST_COPIES: u64 = 1 << 25;
/// A primitive without elements takes about as long as this many.
const ELEMENTS_OF_PRIMITIVE: u64 = 16;
/// Why a primitive without triangles is left out.
pub(super) const POINTS: &str = "points and lines are left out: a point cloud must be meshed first";

/// The mesh so far.
pub(super) struct Geometry<'a> {
    document: &'a Document<'a>,
    buffers: &'a Buffers<'a>,
    builder: MeshBuilder,
    look: Look<'a>,
    /// For each triangle 0, or the number of its material plus 1.
    of_triangles: Vec<u16>,
    /// How many nodes have each mesh.
    n_uses: HashMap<usize, usize>,
    /// Decompressed views of meshes that come again, and those that are damaged.
    decompressed: HashMap<usize, Result<draco::Geometry, String>>,
    /// Why something was left out, and how often.
    faults: BTreeMap<String, usize>,
    /// Elements that were gone through, and their limit: nodes can repeat a mesh without end.
    n_elements: u64,
    most_elements: u64,
    /// Those among them of primitives that are left out, and why the last of these is.
    in_vain: (u64, String),
}

/// The numbers of a primitive.
struct Attributes<'a> {
    positions: Elements<'a>,
    normals: Option<Elements<'a>>,
    texture_coordinates: Option<Elements<'a>>,
    colors: Option<Elements<'a>>,
    joints: Option<(Elements<'a>, Elements<'a>)>,
    indices: Option<Elements<'a>>,
    /// Why attributes are left out that it could do without.
    faults: Vec<String>,
}

impl<'a> Geometry<'a> {
    pub(super) fn new(document: &'a Document<'a>, buffers: &'a Buffers<'a>, n_json_bytes: usize) -> Self {
        let n_bytes = (buffers.n_bytes + n_json_bytes) as u64;
        let mut n_uses = HashMap::new();
        for node in &document.nodes {
            if let Some(mesh) = node.mesh {
                *n_uses.entry(mesh).or_default() += if node.extensions.copies.is_some() { 2 } else { 1 };
            }
        }
        Self {
            document,
            buffers,
            builder: MeshBuilder::default(),
            look: Look::new(document, buffers),
            of_triangles: Vec::new(),
            n_uses,
            decompressed: HashMap::new(),
            faults: BTreeMap::new(),
            n_elements: 0,
            most_elements: MOST_COPIES.saturating_add(n_bytes),
            in_vain: (0, String::new()),
        }
    }

    /// Adds a mesh of the scene.
    pub(super) fn add(&mut self, instance: &Instance) -> Result<(), Problem> {
        let document = self.document;
        let Some(mesh) = document.meshes.get(instance.mesh) else {
            self.note(format!("there is no mesh {}", instance.mesh));
            return Ok(());
        };
        if instance.is_blended {
            self.note("a shape that is blended with others is shown without them".to_owned());
        }
        for primitive in &mesh.primitives {
            self.count(ELEMENTS_OF_PRIMITIVE)?;
            if !(4..=6).contains(&primitive.mode) {
                self.note(POINTS.to_owned());
                continue;
            }
            let view = primitive.extensions.draco.as_deref().map(|compressed| compressed.buffer_view);
            if let Some(Err(fault)) = view.map(|view| self.decompress(view)) {
                self.note(format!("a mesh is left out: {fault}"));
                continue;
            }
            let draco = view.and_then(|view| self.decompressed.remove(&view));
            let n_before = self.n_elements;
            let added = match &draco {
                Some(Ok(draco)) => self.add_primitive(primitive, Some(draco), instance),
                _ => self.add_primitive(primitive, None, instance),
            };
            if self.n_uses.get(&instance.mesh).is_some_and(|&n| n > 1) {
                self.decompressed.extend(view.zip(draco));
            }
            if let Err(fault) = added? {
                self.note(format!("a mesh is left out: {fault}"));
                self.in_vain = (self.in_vain.0 + self.n_elements - n_before, fault);
            }
        }
        Ok(())
    }

    /// Counts elements before they are gone through, also in vain.
    fn count(&mut self, n: u64) -> Result<(), Problem> {
        self.n_elements += n;
        let (n_in_vain, fault) = &self.in_vain;
        match self.n_elements > self.most_elements.saturating_mul(4) {
            true if *n_in_vain > self.n_elements / 2 => Err(Problem::TooDamaged(fault.clone())),
            true => Err(Problem::TooManyCopies(self.most_elements)),
            false => Ok(()),
        }
    }

    fn note(&mut self, fault: String) {
        *self.faults.entry(fault).or_default() += 1;
    }

    /// Decompresses a view, unless that was done before.
    fn decompress(&mut self, view: usize) -> Result<(), String> {
        let (document, buffers) = (self.document, self.buffers);
        let decode = || {
            let (bytes, _) = buffers.view(document, view)?;
            // Damaged bytes take time too.
            self.n_elements += bytes.len() as u64;
            draco::Geometry::decode(bytes, self.most_elements.saturating_sub(self.n_elements))
        };
        let decoded = self.decompressed.entry(view).or_insert_with(decode);
        decoded.as_ref().map(drop).map_err(Clone::clone)
    }

    /// The elements that are gone through to read a primitive, whether or not it can be used.
    fn n_elements_of(&self, primitive: &Primitive, draco: Option<&draco::Geometry>) -> u64 {
        // An accessor may claim more than the file can hold.
        let held = |count: usize| count.min(self.buffers.n_bytes) as u64;
        let accessor = |index: &usize| self.document.accessors.get(*index);
        let is_compressed = |name: &String| {
            let compressed = primitive.extensions.draco.as_deref().filter(|_| draco.is_some());
            compressed.is_some_and(|compressed| compressed.attributes.contains_key(name))
        };
        let indices = primitive.indices.as_ref().filter(|_| draco.is_none());
        let attributes = primitive.attributes.iter().filter(|(name, _)| !is_compressed(name));
        let mut n = primitive.attributes.len() as u64 + draco.map_or(0, draco::Geometry::n_elements);
        for (is_whole, index) in
            attributes.map(|(name, index)| (name == "POSITION", index)).chain(indices.map(|index| (true, index)))
        {
            let Some(accessor) = accessor(index) else { continue };
            let is_copied = accessor.sparse.is_some() || accessor.buffer_view.is_none();
            n += held(accessor.count) * (u64::from(is_whole) + u64::from(is_copied));
            n += accessor.sparse.as_ref().map_or(0, |sparse| held(sparse.count));
        }
        n
    }

    /// Adds a primitive. The inner error is a fault of it alone.
    fn add_primitive(
        &mut self,
        primitive: &Primitive,
        draco: Option<&draco::Geometry>,
        instance: &Instance,
    ) -> Result<Result<(), String>, Problem> {
        self.count(self.n_elements_of(primitive, draco))?;
        let set = self.look.texture_set(primitive.material);
        let attributes = match self.attributes(primitive, draco, set) {
            Ok(attributes) => attributes,
            Err(fault) => return Ok(Err(fault)),
        };
        for fault in &attributes.faults {
            self.note(fault.clone());
        }
        let n_positions = attributes.positions.count;
        if self.has_gaps(primitive)
            && attributes.colors.as_ref().is_some_and(|colors| has_coverage(colors, n_positions))
        {
            self.note("the coverage of vertices' colours is left out".to_owned());
        }
        let indices = attributes.indices.as_ref().map(Elements::indices);
        let vertices = UsedVertices::new(indices.as_deref(), n_positions);
        self.add_vertices(&attributes, &vertices, instance)?;
        self.add_triangles(primitive, indices.as_deref(), n_positions, &vertices, instance)?;
        let material = primitive.material.and_then(|material| self.look.number(material));
        if let Some(index) = primitive.material.filter(|_| material.is_none()) {
            self.note(match self.document.materials.get(index) {
                Some(_) => "materials beyond the 65535th are left out".to_owned(),
                None => format!("there is no material {index}: a mesh is shown without one"),
            });
        }
        if !self.document.materials.is_empty() {
            self.of_triangles.resize(self.builder.n_triangles(), material.map_or(0, |number| number + 1));
        }
        Ok(Ok(()))
    }

    fn attributes<'b>(
        &self,
        primitive: &Primitive,
        draco: Option<&draco::Geometry>,
        set: u32,
    ) -> Result<Attributes<'b>, String>
    where
        'a: 'b,
    {
        let read = |name: &str, kinds: &[Kind]| -> Result<Option<Elements<'b>>, String> {
            let compressed = primitive.extensions.draco.as_deref().zip(draco);
            let number = compressed.and_then(|(names, draco)| Some((draco, names.attributes.get(name)?)));
            if let Some((draco, &number)) = number {
                let index = primitive.attributes.get(name);
                let accessor = index.and_then(|&index| self.document.accessors.get(index));
                let elements = draco.attribute(number, accessor)?;
                return match elements.has_numbers_of(kinds) {
                    true => Ok(Some(elements)),
                    false => Err(format!("its attribute {number} is of another type than its use needs")),
                };
            }
            let index = primitive.attributes.get(name);
            index.map(|&index| Elements::new(self.document, self.buffers, index, kinds)).transpose()
        };
        let positions = read("POSITION", &[Kind::Vec3])?.ok_or("it has no positions")?;
        let n_positions = positions.count;
        let mut faults = Vec::new();
        let mut optional = |name: &str, kinds: &[Kind]| {
            let elements = read(name, kinds).and_then(|elements| match elements {
                Some(Elements { count, .. }) if count < n_positions => {
                    Err(format!("it has {count} elements for {n_positions} vertices"))
                }
                elements => Ok(elements),
            });
            elements.unwrap_or_else(|fault| {
                faults.push(format!("{name} of a mesh is left out: {fault}"));
                None
            })
        };
        let indices = match draco {
            Some(draco) => Some(draco.indices()),
            None => primitive
                .indices
                .map(|index| Elements::new(self.document, self.buffers, index, &[Kind::Scalar]))
                .transpose()?,
        };
        Ok(Attributes {
            normals: optional("NORMAL", &[Kind::Vec3]),
            texture_coordinates: optional(&format!("TEXCOORD_{set}"), &[Kind::Vec2]),
            colors: optional("COLOR_0", &[Kind::Vec3, Kind::Vec4]),
            joints: optional("JOINTS_0", &[Kind::Vec4]).zip(optional("WEIGHTS_0", &[Kind::Vec4])),
            positions,
            indices,
            faults,
        })
    }

    /// Whether a primitive's material is not there, or not wholly, where its coverage is low.
    fn has_gaps(&self, primitive: &Primitive) -> bool {
        let material = primitive.material.and_then(|index| self.document.materials.get(index));
        material.is_some_and(|material| material.alpha_mode != AlphaMode::Opaque)
    }

    fn add_vertices(
        &mut self,
        attributes: &Attributes<'_>,
        vertices: &UsedVertices,
        instance: &Instance,
    ) -> Result<(), Problem> {
        let before = self.builder.n_vertices();
        let after = before + vertices.n;
        self.builder.check_vertices(vertices.n)?;
        let linear = DMat3::from_mat4(instance.transform);
        let cofactors = cofactors(linear);
        let is_far = instance.transform.w_axis.truncate().abs().max_element() > FAR;
        let transform = |vertex: usize| {
            let (joints, weights) = attributes.joints.as_ref()?;
            blend(&instance.joints, joints, weights, vertex)
        };
        let in_place = attributes.positions.in_place::<3>();
        let world = |vertex: usize| {
            let position = in_place.map_or_else(|| attributes.positions.get::<3>(vertex), |all| all[vertex]);
            let position = DVec3::from(position.map(f64::from));
            transform(vertex).unwrap_or(instance.transform).transform_point3(position)
        };
        if is_far {
            (0..vertices.n).for_each(|k| self.builder.push_vertex(world(vertices.vertex(k))));
        } else {
            self.builder.extend_vertices(vertices.n, |k| world(vertices.vertex(k)).as_vec3());
        }
        let mesh = &mut self.builder.mesh;
        if let Some(normals) = &attributes.normals {
            let turned = |vertex: usize| {
                let normal = DVec3::from(normals.get::<3>(vertex).map(f64::from));
                let turn = transform(vertex).map_or(cofactors, |it| self::cofactors(DMat3::from_mat4(it)));
                Normal::new((turn * normal).as_vec3())
            };
            mesh.normals.resize(before, Normal::OF_TRIANGLE);
            extend(&mut mesh.normals, vertices.n, |k| turned(vertices.vertex(k)));
        } else if !mesh.normals.is_empty() {
            mesh.normals.resize(after, Normal::OF_TRIANGLE);
        }
        if let Some(coordinates) = &attributes.texture_coordinates {
            mesh.texture_coordinates.resize(before, [0.0; 2]);
            extend(&mut mesh.texture_coordinates, vertices.n, |k| coordinates.get::<2>(vertices.vertex(k)));
        } else if !mesh.texture_coordinates.is_empty() {
            mesh.texture_coordinates.resize(after, [0.0; 2]);
        }
        if let Some(colors) = &attributes.colors {
            mesh.colors.resize(before, [u8::MAX; 3]);
            extend(&mut mesh.colors, vertices.n, |k| colors.get::<3>(vertices.vertex(k)).map(srgb::encode));
        } else if !mesh.colors.is_empty() {
            mesh.colors.resize(after, [u8::MAX; 3]);
        }
        Ok(())
    }

    /// Adds the triangles of a list, strip or fan. A mirror turns them over, so that they face the same way.
    fn add_triangles(
        &mut self,
        primitive: &Primitive,
        indices: Option<&[u32]>,
        n_positions: usize,
        vertices: &UsedVertices,
        instance: &Instance,
    ) -> Result<(), Problem> {
        let first = (self.builder.n_vertices() - vertices.n) as u32;
        let corner = |k: usize| match indices {
            Some(indices) => vertices.place(indices[k]).map_or(u32::MAX, |place| first + place),
            None => first + k as u32,
        };
        let n_corners = indices.map_or(n_positions, <[u32]>::len);
        let is_mirrored = DMat3::from_mat4(instance.transform).determinant() < 0.0;
        let n_triangles = if primitive.mode == 4 { n_corners / 3 } else { n_corners.saturating_sub(2) };
        let triangle = |k: usize| {
            let [a, b, c] = match primitive.mode {
                4 => [3 * k, 3 * k + 1, 3 * k + 2],
                5 if k % 2 == 1 => [k, k + 2, k + 1],
                5 => [k, k + 1, k + 2],
                _ => [0, k + 1, k + 2],
            };
            let [b, c] = if is_mirrored { [c, b] } else { [b, c] };
            [corner(a), corner(b), corner(c)]
        };
        Ok(self.builder.extend_triangles(n_triangles, triangle)?)
    }

    /// The draft of all that was added.
    pub(super) fn finish(self, mut remarks: Vec<String>) -> Draft {
        let Self { builder, look, of_triangles, faults, .. } = self;
        remarks
            .extend(faults.into_iter().map(|(fault, n)| if n == 1 { fault } else { format!("{fault} ({n} times)") }));
        let mut draft = Draft { mesh: builder.finish(), remarks, ..Draft::default() };
        look.finish(&mut draft, of_triangles);
        draft
    }
}

/// The vertices that a primitive uses: many primitives may share one accessor.
struct UsedVertices {
    /// How many there are.
    n: usize,
    /// Their numbers in the accessor, in order, and the place of each vertex among those; `None` if all are used.
    some: Option<(Vec<u32>, Vec<u32>)>,
}

impl UsedVertices {
    fn new(indices: Option<&[u32]>, n_positions: usize) -> Self {
        let all = Self { n: n_positions, some: None };
        let Some(indices) = indices else { return all };
        let mut is_used = vec![false; n_positions];
        for &index in indices {
            if let Some(is_used) = is_used.get_mut(index as usize) {
                *is_used = true;
            }
        }
        if is_used.iter().all(|&is_used| is_used) {
            return all;
        }
        let (mut used, mut places) = (Vec::new(), vec![u32::MAX; n_positions]);
        for (vertex, place) in places.iter_mut().enumerate().filter(|(vertex, _)| is_used[*vertex]) {
            *place = used.len() as u32;
            used.push(vertex as u32);
        }
        Self { n: used.len(), some: Some((used, places)) }
    }

    /// The number of the k-th of them in the accessor.
    fn vertex(&self, k: usize) -> usize {
        self.some.as_ref().map_or(k, |(used, _)| used[k] as usize)
    }

    /// The place of a vertex among them; `None` if there is no such vertex.
    fn place(&self, vertex: u32) -> Option<u32> {
        match &self.some {
            Some((_, places)) => places.get(vertex as usize).copied(),
            None => Some(vertex).filter(|&vertex| (vertex as usize) < self.n),
        }
    }
}

/// Whether the first `n` colours have a coverage, which somewhere is not whole.
fn has_coverage(colors: &Elements<'_>, n: usize) -> bool {
    colors.has_numbers_of(&[Kind::Vec4]) && (0..n).any(|vertex| colors.get::<4>(vertex)[3] < 1.0)
}

/// The matrix that turns normals: the inverse transpose, times a factor of the determinant's sign, even if there is none.
fn cofactors(matrix: DMat3) -> DMat3 {
    let DMat3 { x_axis: x, y_axis: y, z_axis: z } = matrix;
    let cofactors = DMat3::from_cols(y.cross(z), z.cross(x), x.cross(y));
    if matrix.determinant() < 0.0 { -cofactors } else { cofactors }
}

/// The weighted transform of a vertex's joints; `None` if it has none.
fn blend(transforms: &[DMat4], joints: &Elements<'_>, weights: &Elements<'_>, vertex: usize) -> Option<DMat4> {
    let weights = weights.get::<4>(vertex).map(f64::from);
    let sum = DVec4::from(weights).element_sum();
    let mut blended = DMat4::ZERO;
    for (component, weight) in weights.into_iter().enumerate().filter(|(_, weight)| *weight != 0.0) {
        blended += *transforms.get(joints.integer(vertex, component) as usize)? * (weight / sum);
    }
    (sum > 0.0).then_some(blended)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normals_stand_on_their_surface_after_any_transform() {
        let matrix =
            DMat3::from_cols(DVec3::new(2.0, 0.5, 0.0), DVec3::new(0.0, -1.0, 0.25), DVec3::new(1.0, 0.0, 3.0));
        let (a, b) = (DVec3::new(1.0, 2.0, 0.0), DVec3::new(0.0, 1.0, 1.0));
        let normal = cofactors(matrix) * a.cross(b);
        assert!(normal.dot(matrix * a).abs() < 1e-12 && normal.dot(matrix * b).abs() < 1e-12);
    }
}
