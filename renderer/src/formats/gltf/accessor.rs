//! Numbers of accessors.

use std::borrow::Cow;

use crate::formats::{
    assembly,
    gltf::{
        buffers::Buffers,
        document::{Accessor, Document, Kind, Sparse},
    },
};

/// The type of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

impl Scalar {
    fn new(component_type: u32) -> Result<Self, String> {
        Ok(match component_type {
            5120 => Self::I8,
            5121 => Self::U8,
            5122 => Self::I16,
            5123 => Self::U16,
            5125 => Self::U32,
            5126 => Self::F32,
            _ => return Err(format!("{component_type} is no type of numbers")),
        })
    }

    fn n_bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::U32 | Self::F32 => 4,
        }
    }
}

/// The elements of an accessor, all of them within bounds.
pub(super) struct Elements<'a> {
    bytes: Cow<'a, [u8]>,
    stride: usize,
    scalar: Scalar,
    n_components: usize,
    normalized: bool,
    pub(super) count: usize,
}

impl<'a> Elements<'a> {
    /// The elements of an accessor of one of these kinds.
    pub(super) fn new(
        document: &Document<'_>,
        buffers: &'a Buffers<'_>,
        index: usize,
        kinds: &[Kind],
    ) -> Result<Self, String> {
        let accessor = document.accessors.get(index).ok_or_else(|| format!("there is no accessor {index}"))?;
        let fault = |fault: String| format!("accessor {index}: {fault}");
        if !kinds.contains(&accessor.kind) {
            return Err(fault("is of another type than its use needs".to_owned()));
        }
        let elements = Self::of(document, buffers, accessor).map_err(fault)?;
        match &accessor.sparse {
            Some(sparse) => elements.replaced(document, buffers, sparse).map_err(fault),
            None => Ok(elements),
        }
    }

    fn of(document: &Document<'_>, buffers: &'a Buffers<'_>, accessor: &Accessor) -> Result<Self, String> {
        let (scalar, n_components) = (Scalar::new(accessor.component_type)?, n_components(accessor.kind));
        let n_bytes = scalar.n_bytes() * n_components;
        let &Accessor { count, normalized, byte_offset, .. } = accessor;
        let (bytes, stride) = match accessor.buffer_view {
            Some(view) => {
                let (bytes, stride) = buffers.view(document, view)?;
                let bytes = bytes.get(byte_offset..).unwrap_or_default();
                (Cow::Borrowed(bytes), stride.filter(|&stride| stride > 0).unwrap_or(n_bytes))
            }
            // Zeros, most of which are replaced: no more than the file could hold.
            None if count <= buffers.n_bytes => (Cow::Owned(vec![0; count * n_bytes]), n_bytes),
            None => return Err(format!("counts {count} elements, and has no numbers")),
        };
        let needed = match count.checked_sub(1) {
            Some(last) => last.checked_mul(stride).and_then(|start| start.checked_add(n_bytes)),
            None => Some(0),
        };
        if needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(format!("is cut short: its view has no {count} elements"));
        }
        Ok(Self { bytes, stride, scalar, n_components, normalized, count })
    }

    /// Numbers that are not in a buffer, `n_components` for each element.
    pub(super) fn from_floats(floats: &[f32], n_components: usize) -> Self {
        let mut bytes = vec![0; 4 * floats.len()];
        bytes.as_chunks_mut().0.iter_mut().zip(floats).for_each(|(bytes, number)| *bytes = number.to_le_bytes());
        let (scalar, stride) = (Scalar::F32, 4 * n_components);
        Self {
            bytes: bytes.into(),
            stride,
            scalar,
            n_components,
            normalized: false,
            count: floats.len() / n_components,
        }
    }

    /// Whether an element has the numbers of one of these kinds.
    pub(super) fn has_numbers_of(&self, kinds: &[Kind]) -> bool {
        kinds.iter().any(|&kind| n_components(kind) == self.n_components)
    }

    /// Indices that are not in a buffer.
    pub(super) fn from_indices(indices: impl ExactSizeIterator<Item = u32>) -> Self {
        let count = indices.len();
        let mut bytes = vec![0; 4 * count];
        bytes.as_chunks_mut().0.iter_mut().zip(indices).for_each(|(bytes, index)| *bytes = index.to_le_bytes());
        Self { bytes: bytes.into(), stride: 4, scalar: Scalar::U32, n_components: 1, normalized: false, count }
    }

    /// With some elements replaced by others.
    fn replaced(self, document: &Document<'_>, buffers: &'a Buffers<'_>, sparse: &Sparse) -> Result<Self, String> {
        let n_bytes = self.scalar.n_bytes() * self.n_components;
        let accessor = |view, byte_offset, component_type, kind| Accessor {
            buffer_view: Some(view),
            byte_offset,
            component_type,
            normalized: false,
            count: sparse.count,
            kind,
            sparse: None,
        };
        let at = &sparse.indices;
        let places = accessor(at.buffer_view, at.byte_offset, at.component_type, Kind::Scalar);
        let places = Self::of(document, buffers, &places)?;
        let (values, _) = buffers.view(document, sparse.values.buffer_view)?;
        let values = values.get(sparse.values.byte_offset..).unwrap_or_default();
        let mut bytes = Vec::new();
        for element in 0..self.count {
            bytes.extend(&self.bytes[element * self.stride..][..n_bytes]);
        }
        let mut values = values.chunks_exact(n_bytes);
        for k in 0..sparse.count {
            let place = (places.index(k) as usize).saturating_mul(n_bytes);
            let target = bytes.get_mut(place..place.saturating_add(n_bytes));
            let (Some(target), Some(value)) = (target, values.next()) else {
                return Err("replaces elements that do not exist".to_owned());
            };
            target.copy_from_slice(value);
        }
        Ok(Self { bytes: bytes.into(), stride: n_bytes, ..self })
    }

    /// An element's first numbers. Missing ones are 0, integers from −1 or 0 to 1 if the accessor says so.
    #[inline]
    pub(super) fn get<const N: usize>(&self, element: usize) -> [f32; N] {
        let bytes = &self.bytes[element * self.stride..];
        let width = self.scalar.n_bytes();
        let number = |at: &[u8]| match (self.scalar, at) {
            (Scalar::F32, &[a, b, c, d, ..]) => f32::from_le_bytes([a, b, c, d]),
            (Scalar::U8, &[a, ..]) if self.normalized => f32::from(a) / 255.0,
            (Scalar::U8, &[a, ..]) => f32::from(a),
            (Scalar::I8, &[a, ..]) if self.normalized => (f32::from(a as i8) / 127.0).max(-1.0),
            (Scalar::I8, &[a, ..]) => f32::from(a as i8),
            (Scalar::U16, &[a, b, ..]) if self.normalized => f32::from(u16::from_le_bytes([a, b])) / 65535.0,
            (Scalar::U16, &[a, b, ..]) => f32::from(u16::from_le_bytes([a, b])),
            (Scalar::I16, &[a, b, ..]) if self.normalized => {
                (f32::from(i16::from_le_bytes([a, b])) / 32767.0).max(-1.0)
            }
            (Scalar::I16, &[a, b, ..]) => f32::from(i16::from_le_bytes([a, b])),
            (Scalar::U32, &[a, b, c, d, ..]) => u32::from_le_bytes([a, b, c, d]) as f32,
            _ => 0.0,
        };
        std::array::from_fn(|k| if k < self.n_components { number(&bytes[k * width..]) } else { 0.0 })
    }

    /// All elements of `N` numbers, if they lie as in memory.
    pub(super) fn in_place<const N: usize>(&self) -> Option<&[[f32; N]]>
    where
        [f32; N]: bytemuck::AnyBitPattern,
    {
        let is_tight = self.scalar == Scalar::F32 && self.n_components == N && self.stride == 4 * N;
        self.cast(is_tight, 4 * N)
    }

    /// The first number of all elements, as [`Elements::index`] gives them: in place if they lie as in memory.
    pub(super) fn indices(&self) -> Cow<'_, [u32]> {
        if let Some(indices) = self.cast(self.scalar == Scalar::U32 && self.stride == 4, 4) {
            return Cow::Borrowed(indices);
        }
        let mut indices = Vec::new();
        assembly::extend(&mut indices, self.count, |element| self.index(element));
        indices.into()
    }

    /// All elements, of `n_bytes` each, if they are tight, their bytes have this machine's order, and their place is aligned.
    fn cast<T: bytemuck::AnyBitPattern>(&self, is_tight: bool, n_bytes: usize) -> Option<&[T]> {
        let bytes = self.bytes.get(..self.count * n_bytes).filter(|_| is_tight && cfg!(target_endian = "little"))?;
        bytemuck::try_cast_slice(bytes).ok()
    }

    /// The first number of an element, an integer; [`u32::MAX`] if it is none.
    #[inline]
    pub(super) fn index(&self, element: usize) -> u32 {
        self.integer(element, 0)
    }

    /// An integer of an element, as [`Elements::index`]; it has that component.
    #[inline]
    pub(super) fn integer(&self, element: usize, component: usize) -> u32 {
        let at = &self.bytes[element * self.stride + component * self.scalar.n_bytes()..];
        match (self.scalar, at) {
            (Scalar::U8, &[a, ..]) => a.into(),
            (Scalar::U16, &[a, b, ..]) => u16::from_le_bytes([a, b]).into(),
            (Scalar::U32, &[a, b, c, d, ..]) => u32::from_le_bytes([a, b, c, d]),
            // As Draco gives them.
            (Scalar::F32, &[a, b, c, d, ..]) => {
                assembly::index_from_f64(f32::from_le_bytes([a, b, c, d]).into()).unwrap_or(u32::MAX)
            }
            _ => u32::MAX,
        }
    }
}

fn n_components(kind: Kind) -> usize {
    match kind {
        Kind::Scalar => 1,
        Kind::Vec2 => 2,
        Kind::Vec3 => 3,
        Kind::Vec4 | Kind::Mat2 => 4,
        Kind::Mat3 => 9,
        Kind::Mat4 => 16,
    }
}
