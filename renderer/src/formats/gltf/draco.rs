//! Decompresses primitives: `KHR_draco_mesh_compression`.

use draco_core::{DecodeLimits, DecoderBuffer, Mesh, MeshDecoder};

use crate::formats::gltf::{accessor::Elements, document::Accessor};

/// The triangles of a compressed primitive.
pub(super) struct Geometry(Mesh);

impl Geometry {
    /// Decodes a primitive of at most `most_elements` points and triangles each.
    pub(super) fn decode(bytes: &[u8], most_elements: u64) -> Result<Self, String> {
        let limits = DecodeLimits::default()
            .with_max_points(most_elements)
            .with_max_faces(most_elements)
            .with_max_decoded_bytes(most_elements.saturating_mul(64));
        let mut mesh = Mesh::new();
        MeshDecoder::new()
            .decode(&mut DecoderBuffer::new(bytes).with_limits(limits), &mut mesh)
            .map_err(|error| format!("its Draco data is damaged: {error}"))?;
        Ok(Self(mesh))
    }

    /// How many points and corners it has.
    pub(super) fn n_elements(&self) -> u64 {
        (self.0.num_points() + 3 * self.0.num_faces()) as u64
    }

    /// The numbers of an attribute. The accessor says whether its integers are from −1 or 0 to 1.
    pub(super) fn attribute(&self, number: u32, accessor: Option<&Accessor>) -> Result<Elements<'static>, String> {
        let attribute = self.0.attribute_by_unique_id(number).ok_or_else(|| format!("it has no attribute {number}"))?;
        let n_components = usize::from(attribute.num_components()).clamp(1, 4);
        let mut numbers = attribute.read_f32s(self.0.num_points(), n_components);
        let largest = match accessor.filter(|accessor| accessor.normalized).map(|accessor| accessor.component_type) {
            Some(5120) => 127.0,
            Some(5121) => 255.0,
            Some(5122) => 32767.0,
            Some(5123) => 65535.0,
            _ => 1.0,
        };
        if largest != 1.0 {
            numbers.iter_mut().for_each(|number| *number = (*number / largest).max(-1.0));
        }
        Ok(Elements::from_floats(&numbers, n_components))
    }

    /// The corners of the triangles.
    pub(super) fn indices(&self) -> Elements<'static> {
        Elements::from_indices(self.0.faces().as_flattened().iter().map(|index| index.0))
    }
}
