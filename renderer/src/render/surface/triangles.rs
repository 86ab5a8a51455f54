//! Triangles of many hits: gathered for each lane, or once for all hits that share one.

use glam::Vec3;

use crate::{
    grid::traced::TracedMesh,
    model::normal::Normal,
    render::surface::{N, Vectors, get, normalize_or_zero, set},
    simd::Simd,
    texture::footprint::Points,
};

/// A triangle in each lane, and what the mesh has for its corners.
pub(super) struct TriangleLanes {
    pub(super) corners: [Vectors; 3],
    /// Of unit length, on the side where the corners run counter-clockwise; zero for slivers too thin to have one.
    pub(super) normals: Vectors,
    /// 1 over twice the area, infinite for slivers too thin to have one.
    pub(super) inverse_areas: [f32; N],
    /// Of about unit length; those of the triangle where a corner has none.
    pub(super) corner_normals: Option<[Vectors; 3]>,
    /// Linear.
    pub(super) colors: Option<[Vectors; 3]>,
    pub(super) coordinates: Option<[Points; 3]>,
}

impl TriangleLanes {
    #[inline(always)]
    pub(super) fn gather<S: Simd>(mesh: &TracedMesh, triangles: &[u32; N]) -> Self {
        let mut lanes = Self {
            corners: [[[0.0; N]; 3]; 3],
            normals: [[0.0; N]; 3],
            inverse_areas: [0.0; N],
            corner_normals: None,
            colors: mesh.has_colors().then_some([[[0.0; N]; 3]; 3]),
            coordinates: mesh.has_texture_coordinates().then_some([[[0.0; N]; 2]; 3]),
        };
        let mut normals = mesh.has_normals().then_some([[0; N]; 3]);
        for first in (0..N).step_by(S::LANES) {
            let mut next = [0; 16];
            next[..S::LANES].copy_from_slice(&triangles[first..first + S::LANES]);
            let vertices = mesh.corner_vertices::<S>(&next);
            let [a, b, c] = &vertices;
            // SAFETY: all vertices of triangles exist.
            let positions = unsafe { mesh.gather_vertices::<S>([a, b, c]) };
            if let Some([of_a, of_b, of_c]) = &mut normals {
                mesh.gather_normals::<S>(
                    &next,
                    &vertices,
                    [&mut of_a[first..], &mut of_b[first..], &mut of_c[first..]],
                );
            }
            for corner in 0..3 {
                for (position, lanes) in positions[corner].iter().zip(&mut lanes.corners[corner]) {
                    position.store(&mut lanes[first..]);
                }
                if let Some(colors) = &mut lanes.colors {
                    mesh.gather_colors::<S>(&vertices[corner], &mut colors[corner], first);
                }
                if let Some(coordinates) = &mut lanes.coordinates {
                    let to = coordinates[corner].each_mut().map(|lanes| &mut lanes[first..]);
                    mesh.gather_coordinates::<S>(&vertices[corner], to);
                }
            }
        }
        lanes.find_normals();
        if let Some(normals) = &normals {
            lanes.decode_normals(normals);
        }
        lanes
    }

    /// Finds normals and areas in double precision, for triangles of any size.
    #[inline(always)]
    fn find_normals(&mut self) {
        let [a, b, c] = &self.corners;
        for lane in 0..N {
            let [a, b, c] = [get(a, lane).as_dvec3(), get(b, lane).as_dvec3(), get(c, lane).as_dvec3()];
            let normal = (b - a).cross(c - a);
            set(&mut self.normals, lane, normalize_or_zero(normal));
            self.inverse_areas[lane] = (1.0 / normal.length()) as f32;
        }
    }

    #[inline(always)]
    fn decode_normals(&mut self, bits: &[[u32; N]; 3]) {
        let corner_normals = self.corner_normals.insert([[[0.0; N]; 3]; 3]);
        for (bits, to) in bits.iter().zip(corner_normals) {
            for (lane, &bits) in bits.iter().enumerate() {
                set(to, lane, corner_direction(Normal::of_bits(bits), get(&self.normals, lane)));
            }
        }
    }

    /// The triangles at some places, below [`N`], of these.
    #[inline(always)]
    fn pick<S: Simd>(&self, places: &[u32; N]) -> Self {
        let mut picked = Self {
            corners: pick_vectors::<S, 3>(&self.corners, places),
            normals: pick::<S, 3>(&self.normals, places),
            inverse_areas: [0.0; N],
            corner_normals: None,
            colors: None,
            coordinates: None,
        };
        if let Some(corner_normals) = &self.corner_normals {
            picked.corner_normals = Some(pick_vectors::<S, 3>(corner_normals, places));
        }
        if let Some(colors) = &self.colors {
            picked.colors = Some(pick_vectors::<S, 3>(colors, places));
        }
        if let Some(coordinates) = &self.coordinates {
            picked.coordinates = Some(pick_vectors::<S, 2>(coordinates, places));
            let [inverse_areas] = pick::<S, 1>(std::array::from_ref(&self.inverse_areas), places);
            picked.inverse_areas = inverse_areas;
        }
        picked
    }
}

#[inline(always)]
fn pick_vectors<S: Simd, const AXES: usize>(
    of_corners: &[[[f32; N]; AXES]; 3],
    places: &[u32; N],
) -> [[[f32; N]; AXES]; 3] {
    let [a, b, c] = of_corners;
    [pick::<S, AXES>(a, places), pick::<S, AXES>(b, places), pick::<S, AXES>(c, places)]
}

#[inline(always)]
fn pick<S: Simd, const AXES: usize>(from: &[[f32; N]; AXES], places: &[u32; N]) -> [[f32; N]; AXES] {
    let mut picked = [[0.0; N]; AXES];
    for (picked, from) in picked.iter_mut().zip(from) {
        for first in (0..N).step_by(S::LANES) {
            S::pick(from, &places[first..]).store(&mut picked[first..]);
        }
    }
    picked
}

/// The direction of a corner's normal, or the triangle's where the corner has none.
#[inline(always)]
fn corner_direction(normal: Normal, of_triangle: Vec3) -> Vec3 {
    let direction = normal.direction();
    if normal == Normal::OF_TRIANGLE { of_triangle } else { direction }
}

/// The triangles of up to 64 hits, which are few, and the place of each hit's among them.
pub(super) struct FewTriangles {
    lanes: TriangleLanes,
    places: [u32; 64],
}

/// Where more neighbours than so many differ, there are mostly more than [`N`] triangles.
const MOST_CHANGES: u32 = 36;

impl FewTriangles {
    /// `None` if there are more than [`N`], or so few hits that they are done at once in any case.
    #[inline(always)]
    pub(super) fn gather<S: Simd>(mesh: &TracedMesh, of_hits: &[u32; 64], n_hits: usize) -> Option<Self> {
        let n_changes: u32 = of_hits.iter().zip(&of_hits[1..]).map(|(one, next)| u32::from(one != next)).sum();
        if n_hits <= N || n_changes > MOST_CHANGES {
            return None;
        }
        let (mut triangles, mut places, mut rest) = ([of_hits[0]; N], [0; 64], u64::MAX);
        for place in 0..N {
            triangles[place] = of_hits[rest.trailing_zeros() as usize % 64];
            for first in (0..64).step_by(S::LANES) {
                let same = S::eq_mask(&of_hits[first..], triangles[place]);
                S::masked_fill(place as u32, same, &mut places[first..]);
                rest &= !(u64::from(same) << first);
            }
            if rest == 0 {
                return Some(Self { lanes: TriangleLanes::gather::<S>(mesh, &triangles), places });
            }
        }
        None
    }

    /// The triangles of a chunk of [`N`] hits.
    #[inline(always)]
    pub(super) fn pick<S: Simd>(&self, chunk: usize) -> TriangleLanes {
        self.lanes.pick::<S>(&self.places.as_chunks().0[chunk])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::{mesh::Mesh, statue},
        simd::{InstructionSet, Kernel},
    };

    /// Finds some triangles of a mesh in lanes of their own, and by their places among few.
    struct PicksTriangles<'a>(&'a TracedMesh);

    impl Kernel for PicksTriangles<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self) {
            for n_triangles in 1..=N as u32 {
                // Runs of three, as neighbours mostly are.
                let triangles: [u32; 64] = std::array::from_fn(|hit| 7 * (hit as u32 / 3 % n_triangles));
                let few = FewTriangles::gather::<S>(self.0, &triangles, 64).expect("few triangles");
                for (chunk, triangles) in triangles.as_chunks().0.iter().enumerate() {
                    let (picked, own) = (few.pick::<S>(chunk), TriangleLanes::gather::<S>(self.0, triangles));
                    assert_eq!(picked.corners, own.corners);
                    assert_eq!(picked.normals, own.normals);
                    assert_eq!(picked.corner_normals, own.corner_normals);
                    assert_eq!(picked.colors, own.colors);
                }
            }
            let n_changes = MOST_CHANGES / 2;
            let many = std::array::from_fn(|hit| if hit < 2 { 0 } else { hit as u32 % n_changes });
            assert!(FewTriangles::gather::<S>(self.0, &many, 64).is_none(), "{n_changes} triangles");
            assert!(FewTriangles::gather::<S>(self.0, &[1; 64], N).is_none(), "hits of a single chunk");
        }
    }

    #[test]
    fn few_triangles_are_those_of_the_hits() {
        let mesh = statue::generate(1000, &|_| ());
        let colors = mesh.vertices.iter().map(|vertex| vertex.map(|x| x.to_bits().to_le_bytes()[1])).collect();
        // Every other vertex has no normal of its own.
        let normal = |(vertex, n): (&[f32; 3], usize)| Normal::new(Vec3::from(*vertex) * (n % 2) as f32);
        let normals = mesh.vertices.iter().zip(0..).map(normal).collect();
        let order = (0..mesh.triangles.len() as u32).collect();
        let mesh = TracedMesh::new(Mesh { colors, normals, ..mesh }, order);
        for instructions in InstructionSet::available() {
            // SAFETY: it is available.
            unsafe { instructions.call(PicksTriangles(&mesh)) };
        }
    }
}
