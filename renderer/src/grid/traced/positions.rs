//! The positions of vertices: as `f32`, as the same in fewer bytes, or as points of a lattice in few bits.

use std::array;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    grid::traced::in_order,
    model::{
        lattice::Lattice,
        mesh::{Aabb, Mesh},
    },
    scene_file::{
        fault::{Damage, Fault},
        section::Section,
        sections::{SectionVisitor, expect},
    },
    simd::{
        Simd,
        points::{LOADED, POINT, PointScale},
    },
};

/// Fewer vertices stay as they are. Packed ones take 2 to 7 % more time for a frame of primary rays, and 0.6 bytes less for a
/// triangle: many cost memory, few do not.
const FEW_VERTICES: usize = 1 << 21;

/// The positions of all vertices, in model space.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Positions {
    form: Form,
    /// Those as they are, and one more, so that four numbers can be loaded from any position's first.
    #[serde(skip)]
    floats: Section<[f32; 3]>,
    /// Those in another form, with [`LOADED`] bytes more.
    #[serde(skip)]
    bytes: Section<u8>,
}

#[derive(Debug, Serialize, Deserialize)]
enum Form {
    Floats,
    /// The same in [`POINT`] bytes each.
    Packed(PointScale),
    /// The numbers of a lattice's points, x in the lowest bits; each point begins with a byte.
    Lattice(Lattice),
}

/// Bytes of a lattice's point.
fn stride(lattice: &Lattice) -> usize {
    (3 * lattice.n_bits() as usize).div_ceil(8)
}

/// The scale for the kept vertices, if they can be packed.
fn scale_of(vertices: &[[f32; 3]], kept: &[Vec<u32>]) -> Option<PointScale> {
    let exponents_of = |part: &Vec<u32>| {
        let coordinates = part.iter().flat_map(|&vertex| vertices[vertex as usize]).filter(|&x| x != 0.0);
        let exponents = coordinates.map(|x| x.to_bits() >> 23 & 0xff);
        exponents.fold((u32::MAX, 0), |(least, greatest), it| (least.min(it), greatest.max(it)))
    };
    let of_both = |(a, b): (u32, u32), (c, d): (u32, u32)| (a.min(c), b.max(d));
    let (least, greatest) = kept.par_iter().map(exponents_of).reduce(|| (u32::MAX, 0), of_both);
    PointScale::of_exponents(least, greatest)
}

impl Positions {
    /// The positions of the kept vertices, which lie on the lattice if there is one.
    pub(super) fn new(vertices: &[[f32; 3]], lattice: Option<Lattice>, kept: &[Vec<u32>]) -> Self {
        let are_few = || kept.iter().map(Vec::len).sum::<usize>() < FEW_VERTICES;
        let form = match lattice {
            Some(lattice) => Form::Lattice(lattice),
            None if are_few() => Form::Floats,
            None => scale_of(vertices, kept).map_or(Form::Floats, Form::Packed),
        };
        Self::in_form(form, vertices, kept)
    }

    /// The positions of the kept vertices in this form.
    fn in_form(form: Form, vertices: &[[f32; 3]], kept: &[Vec<u32>]) -> Self {
        let (mut floats, mut bytes) = Default::default();
        let position = |vertex: u32| vertices[vertex as usize];
        match &form {
            Form::Floats => floats = in_order(kept, 1, 1, |vertex, to: &mut [[f32; 3]]| to[0] = position(vertex)),
            Form::Packed(scale) => {
                bytes = in_order(kept, POINT, LOADED, |vertex, to: &mut [u8]| {
                    scale.pack(position(vertex), to.try_into().expect("the bytes of a point"));
                });
            }
            Form::Lattice(lattice) => {
                let stride = stride(lattice);
                bytes = in_order(kept, stride, LOADED, |vertex, to: &mut [u8]| {
                    let [x, y, z] = lattice.nearest(position(vertex)).map(u64::from);
                    let word = x | y << lattice.n_bits() | z << (2 * lattice.n_bits());
                    to.copy_from_slice(&word.to_le_bytes()[..stride]);
                });
            }
        }
        Self { form, floats: floats.into(), bytes: bytes.into() }
    }

    /// Bytes of a vertex, at most.
    pub(super) fn bytes_per_vertex(lattice: Option<&Lattice>) -> usize {
        lattice.map_or(size_of::<[f32; 3]>(), stride)
    }

    /// The lattice, unless positions are exact.
    pub(super) fn lattice(&self) -> Option<&Lattice> {
        match &self.form {
            Form::Lattice(lattice) => Some(lattice),
            Form::Floats | Form::Packed(_) => None,
        }
    }

    /// Number of vertices.
    pub(super) fn len(&self) -> usize {
        match &self.form {
            Form::Floats => self.floats.len() - 1,
            Form::Packed(_) => (self.bytes.len() - LOADED) / POINT,
            Form::Lattice(lattice) => (self.bytes.len() - LOADED) / stride(lattice),
        }
    }

    /// The position of a vertex.
    #[inline(always)]
    pub(super) fn of(&self, vertex: u32) -> [f32; 3] {
        let vertex = vertex as usize;
        match &self.form {
            Form::Floats => self.floats[vertex],
            Form::Packed(scale) => {
                scale.unpack(self.bytes[POINT * vertex..].first_chunk().expect("all bytes of the point"))
            }
            Form::Lattice(lattice) => {
                let first = stride(lattice) * vertex;
                let word = u64::from_le_bytes(array::from_fn(|byte| self.bytes[first + byte]));
                let number = |axis: u32| (word >> (axis * lattice.n_bits())) as u32 & ((1 << lattice.n_bits()) - 1);
                lattice.position([number(0), number(1), number(2)])
            }
        }
    }

    /// Hints that a vertex will be read soon.
    #[inline(always)]
    pub(super) fn prefetch<S: Simd>(&self, vertex: u32) {
        let vertex = vertex as usize;
        match &self.form {
            Form::Floats => S::prefetch(&self.floats, vertex),
            Form::Packed(_) => S::prefetch(&self.bytes, POINT * vertex),
            Form::Lattice(lattice) => S::prefetch(&self.bytes, stride(lattice) * vertex),
        }
    }

    /// Gathers the coordinates of three vertices a lane, by vertex and axis.
    ///
    /// # Safety
    ///
    /// The vertices in the first [`Simd::LANES`] lanes exist.
    //
    // No closures: they are not compiled for the caller's instruction set.
    #[inline(always)]
    pub(super) unsafe fn gather<S: Simd>(&self, vertices: [&[u32; 16]; 3]) -> [[S; 3]; 3] {
        let mut gathered = [[S::splat(0.0); 3]; 3];
        match &self.form {
            Form::Floats => {
                let coordinates = bytemuck::cast_slice(&self.floats);
                for (gathered, vertices) in gathered.iter_mut().zip(vertices) {
                    // SAFETY: the caller's, and another vertex follows the last.
                    *gathered = unsafe { S::gather_xyz(coordinates, vertices) };
                }
            }
            Form::Packed(scale) => {
                for (gathered, vertices) in gathered.iter_mut().zip(vertices) {
                    // SAFETY: the caller's, and as many bytes as are loaded follow the last point.
                    *gathered = unsafe { S::gather_packed_points(&self.bytes, *scale, vertices) };
                }
            }
            Form::Lattice(lattice) => {
                let (stride, n_bits, step) = (stride(lattice), lattice.n_bits(), S::splat(lattice.step()));
                let [x, y, z] = lattice.min();
                let [x, y, z] = [S::splat(x), S::splat(y), S::splat(z)];
                for (gathered, vertices) in gathered.iter_mut().zip(vertices) {
                    // SAFETY: the caller's, and more bytes than are loaded follow the last point.
                    let numbers = unsafe { S::gather_lattice_points(&self.bytes, stride, n_bits, vertices) };
                    // As in [`Lattice::position`].
                    *gathered = [numbers[0].mul(step).add(x), numbers[1].mul(step).add(y), numbers[2].mul(step).add(z)];
                }
            }
        }
        gathered
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.floats) + size_of_val(&*self.bytes)
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("vertices", &mut self.floats)?;
        visitor.visit("packed vertices", &mut self.bytes)
    }

    /// Checks that the bytes are whole vertices.
    pub(super) fn check_sizes(&self) -> Result<(), Damage> {
        let stride = match &self.form {
            Form::Floats => return expect(!self.floats.is_empty() && self.bytes.is_empty(), "vertices"),
            Form::Packed(scale) => scale.is_sound().then_some(POINT),
            Form::Lattice(lattice) => lattice.is_sound().then(|| stride(lattice)),
        };
        let stride = stride.filter(|_| self.floats.is_empty()).ok_or(Damage::Content("vertices"))?;
        let n_bytes = self.bytes.len().checked_sub(LOADED);
        expect(n_bytes.is_some_and(|n_bytes| n_bytes.is_multiple_of(stride)), "vertices")
    }

    /// Checks that all vertices can be traced, and lie in the bounds: so distances from the grid's corner are bounded too.
    pub(super) fn check_contents(&self, bounds: &Aabb) -> Result<(), Damage> {
        let Aabb { min, max } = *bounds;
        let is_inside = |[x, y, z]: [f32; 3]| {
            min[0] <= x && x <= max[0] && min[1] <= y && y <= max[1] && min[2] <= z && z <= max[2]
        };
        let is_sound = |position: [f32; 3]| Mesh::is_usable(position) && is_inside(position);
        expect((0..self.len()).into_par_iter().all(|vertex| is_sound(self.of(vertex as u32))), "vertices")
    }
}

#[cfg(test)]
mod tests {
    use shared::scene::Precision;

    use super::*;
    use crate::{
        model::statue,
        simd::{InstructionSet, Kernel},
    };

    /// Compares what is gathered with single positions.
    struct Gathered<'a>(&'a Positions);

    impl Kernel for Gathered<'_> {
        type Output = ();
        #[inline(always)]
        fn run<S: Simd>(self) {
            let n_vertices = self.0.len() as u32;
            for first in (0..n_vertices).step_by(7) {
                let vertices = array::from_fn(|lane| (first + 977 * lane as u32) % n_vertices);
                // SAFETY: they exist.
                let gathered = unsafe { self.0.gather::<S>([&vertices, &vertices, &vertices]) };
                for (axis, lanes) in gathered[1].iter().enumerate() {
                    let mut stored = [0.0; 16];
                    lanes.store(&mut stored);
                    for lane in 0..S::LANES {
                        assert_eq!(stored[lane].to_bits(), self.0.of(vertices[lane])[axis].to_bits());
                    }
                }
            }
        }
    }

    #[test]
    fn a_lattice_without_bits_is_damage() {
        let mesh = statue::generate(100, &|_| ()).snapped(16.try_into().unwrap());
        let positions = Positions::new(&mesh.vertices, mesh.lattice, &[(0..mesh.vertices.len() as u32).collect()]);
        let whole = serde_json::to_string(&positions).unwrap();
        let without_bits = whole.replace("\"precision\":16", "\"precision\":0");
        assert_ne!(without_bits, whole);
        let damaged: Positions = serde_json::from_str(&without_bits).unwrap();
        assert!(Positions { bytes: positions.bytes, ..damaged }.check_sizes().is_err());
    }

    #[test]
    fn every_instruction_set_gathers_the_positions_of_the_mesh() {
        for bits in [None, Some(8), Some(10), Some(11), Some(16), Some(20), Some(21)] {
            let precision = bits.map_or(Precision::EXACT, |bits: u8| bits.try_into().unwrap());
            let mesh = statue::generate(3000, &|_| ()).snapped(precision);
            let (first, second) = mesh.vertices.split_at(1000);
            let order = [(0..1000).rev().collect(), (1000..mesh.vertices.len() as u32).collect()];
            let packed = || {
                let scale = scale_of(&mesh.vertices, &order).unwrap();
                Positions::in_form(Form::Packed(scale), &mesh.vertices, &order)
            };
            let packed = bits.is_none().then(packed);
            for positions in packed.into_iter().chain([Positions::new(&mesh.vertices, mesh.lattice, &order)]) {
                assert_eq!(positions.len(), mesh.vertices.len());
                let expected = first.iter().rev().chain(second);
                assert!((0..).zip(expected).all(|(vertex, &position)| positions.of(vertex) == position));
                positions.check_sizes().unwrap();
                positions.check_contents(&mesh.bounds()).unwrap();
                assert!(positions.check_contents(&Aabb { max: [0.0; 3], ..mesh.bounds() }).is_err());
                for instructions in InstructionSet::available() {
                    // SAFETY: they are available.
                    unsafe { instructions.call(Gathered(&positions)) };
                }
            }
        }
    }
}
