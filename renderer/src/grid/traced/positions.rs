//! The positions of vertices: as `f32`, or as points of a lattice in few bits.

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
    simd::Simd,
};

/// Bytes that are loaded from a point's first.
const LOADED: usize = size_of::<u64>();

/// The positions of all vertices, in model space.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(super) struct Positions {
    /// Those of a mesh without a lattice, and one more, so that four numbers can be loaded from any position's first.
    #[serde(skip)]
    exact: Section<[f32; 3]>,
    /// The numbers of a lattice's points, x in the lowest bits; each point begins with a byte. With [`LOADED`] bytes more.
    #[serde(skip)]
    points: Section<u8>,
    lattice: Option<Lattice>,
}

/// Bytes of a lattice's point.
fn stride(lattice: &Lattice) -> usize {
    (3 * lattice.n_bits() as usize).div_ceil(8)
}

impl Positions {
    /// The positions of the kept vertices, which lie on the lattice if there is one.
    pub(super) fn new(vertices: &[[f32; 3]], lattice: Option<Lattice>, kept: &[Vec<u32>]) -> Self {
        let Some(lattice) = lattice else {
            let exact = in_order(vertices, kept, 1, 1, |vertex, to: &mut [[f32; 3]]| to[0] = *vertex);
            return Self { exact: exact.into(), ..Self::default() };
        };
        let stride = stride(&lattice);
        let points = in_order(vertices, kept, stride, LOADED, |vertex, to: &mut [u8]| {
            let [x, y, z] = lattice.nearest(*vertex).map(u64::from);
            let word = x | y << lattice.n_bits() | z << (2 * lattice.n_bits());
            to.copy_from_slice(&word.to_le_bytes()[..stride]);
        });
        Self { points: points.into(), lattice: Some(lattice), ..Self::default() }
    }

    /// Bytes of a vertex.
    pub(super) fn bytes_per_vertex(lattice: Option<&Lattice>) -> usize {
        lattice.map_or(size_of::<[f32; 3]>(), stride)
    }

    /// The lattice, unless positions are exact.
    pub(super) fn lattice(&self) -> Option<&Lattice> {
        self.lattice.as_ref()
    }

    /// Number of vertices.
    pub(super) fn len(&self) -> usize {
        match &self.lattice {
            None => self.exact.len() - 1,
            Some(lattice) => (self.points.len() - LOADED) / stride(lattice),
        }
    }

    /// The position of a vertex.
    #[inline]
    pub(super) fn of(&self, vertex: u32) -> [f32; 3] {
        let Some(lattice) = &self.lattice else { return self.exact[vertex as usize] };
        let first = stride(lattice) * vertex as usize;
        let word = u64::from_le_bytes(array::from_fn(|byte| self.points[first + byte]));
        let number = |axis: u32| (word >> (axis * lattice.n_bits())) as u32 & ((1 << lattice.n_bits()) - 1);
        lattice.position([number(0), number(1), number(2)])
    }

    /// Hints that a vertex will be read soon.
    #[inline(always)]
    pub(super) fn prefetch<S: Simd>(&self, vertex: u32) {
        match &self.lattice {
            None => S::prefetch(&self.exact, vertex as usize),
            Some(lattice) => S::prefetch(&self.points, stride(lattice) * vertex as usize),
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
        if let Some(lattice) = &self.lattice {
            let (stride, n_bits, step) = (stride(lattice), lattice.n_bits(), S::splat(lattice.step()));
            let [x, y, z] = lattice.min();
            let [x, y, z] = [S::splat(x), S::splat(y), S::splat(z)];
            for (gathered, vertices) in gathered.iter_mut().zip(vertices) {
                // SAFETY: the caller's, and as many bytes as are loaded follow the last point.
                let numbers = unsafe { S::gather_packed(&self.points, stride, n_bits, vertices) };
                // As in [`Lattice::position`].
                *gathered = [numbers[0].mul(step).add(x), numbers[1].mul(step).add(y), numbers[2].mul(step).add(z)];
            }
        } else {
            let coordinates = bytemuck::cast_slice(&self.exact);
            for (gathered, vertices) in gathered.iter_mut().zip(vertices) {
                // SAFETY: the caller's, and another vertex follows the last.
                *gathered = unsafe { S::gather_xyz(coordinates, vertices) };
            }
        }
        gathered
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.exact) + size_of_val(&*self.points)
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("vertices", &mut self.exact)?;
        visitor.visit("lattice points", &mut self.points)
    }

    /// Checks that the bytes are whole vertices.
    pub(super) fn check_sizes(&self) -> Result<(), Damage> {
        match &self.lattice {
            None => expect(!self.exact.is_empty() && self.points.is_empty(), "vertices"),
            Some(lattice) => {
                expect(lattice.is_sound() && self.exact.is_empty(), "vertices")?;
                let n_bytes = self.points.len().checked_sub(LOADED);
                expect(n_bytes.is_some_and(|n_bytes| n_bytes % stride(lattice) == 0), "vertices")
            }
        }
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
    fn every_instruction_set_gathers_the_positions_of_the_mesh() {
        for bits in [None, Some(8), Some(10), Some(11), Some(16), Some(20), Some(21)] {
            let precision = bits.map_or(Precision::EXACT, |bits: u8| bits.try_into().unwrap());
            let mesh = statue::generate(3000, &|_| ()).snapped(precision);
            let (first, second) = mesh.vertices.split_at(1000);
            let order = [(0..1000).rev().collect(), (1000..mesh.vertices.len() as u32).collect()];
            let positions = Positions::new(&mesh.vertices, mesh.lattice, &order);
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
