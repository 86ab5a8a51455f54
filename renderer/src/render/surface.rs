//! Normals, colours and footprints on textures, of many hits at once: loops over arrays, which the compiler turns into vector
//! instructions.

mod triangles;

use glam::{DVec3, Vec2, Vec3};

use crate::{
    grid::traced::TracedMesh,
    intersect::{ray::Hit, triangle},
    render::surface::triangles::{FewTriangles, TriangleLanes},
    simd::{InstructionSet, Kernel, Simd},
    texture::{
        footprint::{self, FootprintLanes, Footprints, WideHit, WideRays},
        materials::{PointMaterial, PointMaterials},
    },
};

/// Hits that are done at once.
pub(super) const N: usize = footprint::N;

/// A vector for each of [`N`] hits, by axis.
pub(super) type Vectors = [[f32; N]; 3];

/// The surface at a hit: vectors of unit length, all on the side of the ray's origin, and its colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// The direction to the ray's origin, which is the eye's for rays of a camera.
    pub to_eye: Vec3,
    /// The triangle's normal, or the cap's; zero for slivers too thin to have one.
    pub geometric: Vec3,
    /// The normal that light falls on.
    pub shading: Vec3,
    /// The part of light that is scattered, linear.
    pub color: Vec3,
}

/// The surfaces at up to 64 hits.
///
/// It is written again for each block of samples: copies took up to 5 % of a frame's time.
pub(super) struct SurfaceBatch {
    on_triangles: TriangleHits,
    /// Of the hits on triangles, as all that follows.
    lanes: [SurfaceLanes; 64 / N],
    /// Linear, by channel.
    colors: [[f32; 64]; 3],
    materials: PointMaterials,
    /// On textures, if the mesh has texture coordinates.
    footprints: Footprints,
}

impl SurfaceBatch {
    pub(super) const NONE: Self = Self {
        on_triangles: TriangleHits::NONE,
        lanes: [SurfaceLanes::NONE; 64 / N],
        colors: [[0.0; 64]; 3],
        materials: PointMaterials::NONE,
        footprints: Footprints::NONE,
    };

    /// The surface at a hit, by its number; `None` for misses and caps.
    #[inline(always)]
    pub(super) fn surface(&self, hit: usize) -> Option<Surface> {
        let place = self.on_triangles.place(hit)?;
        let (lanes, lane) = (&self.lanes[place / N], place % N);
        Some(Surface {
            to_eye: get(&lanes.to_eyes, lane),
            geometric: get(&lanes.geometrics, lane),
            shading: get(&lanes.shadings, lane),
            color: Vec3::new(self.colors[0][place], self.colors[1][place], self.colors[2][place]),
        })
    }

    /// The material there; `None` also for surfaces that only scatter light.
    #[inline(always)]
    pub(super) fn material(&self, hit: usize) -> Option<&PointMaterial> {
        self.materials.get(self.on_triangles.place(hit)?)
    }

    /// Finds the materials, and multiplies their base colours into those of the surfaces.
    pub(super) fn find_materials(&mut self, mesh: &TracedMesh, instructions: InstructionSet) {
        let Self { on_triangles, colors, materials, footprints, .. } = self;
        mesh.find_materials(instructions, on_triangles.triangles(), footprints, colors, materials);
    }
}

/// Interpolates normals and colours of a mesh where up to 64 rays hit its triangles.
pub(super) struct Surfaces<'a, R> {
    pub(super) mesh: &'a TracedMesh,
    pub(super) rays: R,
    pub(super) hits: &'a [Hit],
    /// That of a mesh without colours.
    pub(super) plain_color: Vec3,
    /// Materials stay as they are.
    pub(super) batch: &'a mut SurfaceBatch,
}

impl<R: WideRays> Kernel for Surfaces<'_, R> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { mesh, rays, hits, plain_color, batch } = self;
        let SurfaceBatch { on_triangles, lanes, colors, footprints, .. } = batch;
        footprints.clear();
        *on_triangles = TriangleHits::of(hits);
        // Close to a model many samples show the same triangle, whose corners are found and decoded once.
        let few = FewTriangles::gather::<S>(mesh, &on_triangles.triangles, on_triangles.n);
        for (chunk, (of_lanes, triangles, n)) in on_triangles.lanes().enumerate() {
            let triangles = match &few {
                Some(few) => few.pick::<S>(chunk),
                None => TriangleLanes::gather::<S>(mesh, triangles),
            };
            let hits = RayHits::of(rays, hits, &of_lanes);
            let colors = colors.each_mut().map(|channel| &mut channel.as_chunks_mut().0[chunk]);
            let weights = hits.interpolate(
                &triangles,
                |lane| rays.origin(of_lanes[lane]),
                plain_color,
                (&mut lanes[chunk], colors),
            );
            if let Some(coordinates) = &triangles.coordinates {
                footprints.push(&hits.footprints(rays, &of_lanes, &triangles, coordinates, &weights), n);
            }
        }
    }
}

/// Those of up to 64 hits that are neither misses nor caps.
pub(super) struct TriangleHits {
    n: usize,
    /// Their numbers among all hits.
    numbers: [usize; 64],
    /// Their triangles; the last is repeated.
    triangles: [u32; 64],
    /// The place of each hit among them, or [`NOWHERE`].
    places: [u8; 64],
}

/// The place of misses and caps.
const NOWHERE: u8 = u8::MAX;

impl TriangleHits {
    const NONE: Self = Self { n: 0, numbers: [0; 64], triangles: [0; 64], places: [NOWHERE; 64] };

    #[inline(always)]
    pub(super) fn of(hits: &[Hit]) -> Self {
        let mut on_triangles = Self::NONE;
        let Self { n, numbers, triangles, places } = &mut on_triangles;
        for (number, hit) in (0..64).zip(hits) {
            let is_on_triangle = !hit.is_miss() && !hit.is_cap();
            (numbers[*n], triangles[*n]) = (number, hit.triangle);
            places[number] = if is_on_triangle { *n as u8 } else { NOWHERE };
            *n += usize::from(is_on_triangle);
        }
        if *n > 0 {
            let last = triangles[*n - 1];
            triangles[*n..].fill(last);
        }
        on_triangles
    }

    /// Their triangles, in their order.
    fn triangles(&self) -> &[u32] {
        &self.triangles[..self.n]
    }

    /// The place of a hit among them.
    #[inline(always)]
    fn place(&self, hit: usize) -> Option<usize> {
        let place = usize::from(self.places[hit]);
        (place < 64).then_some(place)
    }

    /// Their numbers and triangles, [`N`] at a time, and how many these are: lanes beyond the last repeat it. They are chosen here:
    /// loops with a check do not become vector instructions, and a frame's shading took 1.5 times as long.
    #[inline(always)]
    pub(super) fn lanes(&self) -> impl Iterator<Item = ([usize; N], &[u32; N], usize)> {
        self.numbers[..self.n].chunks(N).zip(self.triangles.as_chunks().0).map(|(numbers, triangles)| {
            let n = numbers.len();
            (std::array::from_fn(|lane| numbers[lane.min(n - 1)]), triangles, n)
        })
    }
}

/// Rays, and how far away they hit triangles.
struct RayHits {
    directions: Vectors,
    /// In lengths of the directions.
    distances: [f32; N],
}

/// Vectors of [`Surface`].
#[derive(Clone, Copy)]
struct SurfaceLanes {
    to_eyes: Vectors,
    geometrics: Vectors,
    shadings: Vectors,
}

impl SurfaceLanes {
    const NONE: Self = Self { to_eyes: [[0.0; N]; 3], geometrics: [[0.0; N]; 3], shadings: [[0.0; N]; 3] };
}

impl RayHits {
    #[inline(always)]
    fn of(rays: impl WideRays, hits: &[Hit], samples: &[usize; N]) -> Self {
        let mut of_lanes = Self { directions: [[0.0; N]; 3], distances: [0.0; N] };
        for (lane, &sample) in samples.iter().enumerate() {
            of_lanes.distances[lane] = hits[sample].t;
            set(&mut of_lanes.directions, lane, rays.direction(sample));
        }
        of_lanes
    }

    /// Finds the surfaces and colours where rays from `origin` of a lane hit; `plain_color` is that of a mesh without colours.
    /// Returns the corners' parts in the hit points.
    #[inline(always)]
    fn interpolate(
        &self,
        triangles: &TriangleLanes,
        origin: impl Fn(usize) -> Vec3,
        plain_color: Vec3,
        (surfaces, colors): (&mut SurfaceLanes, [&mut [f32; N]; 3]),
    ) -> Vectors {
        let [mut to_eyes, mut geometrics, mut weights] = [[[0.0; N]; 3]; 3];
        // In double precision, for triangles of any size.
        for lane in 0..N {
            let direction = get(&self.directions, lane);
            let [a, b, c] = triangles.corners.each_ref().map(|corner| get(corner, lane));
            let parts = triangle::corner_weights(origin(lane), direction, &[a.to_array(), b.to_array(), c.to_array()]);
            set(&mut weights, lane, Vec3::new(parts[0] as f32, parts[1] as f32, parts[2] as f32));
            let direction = direction.as_dvec3();
            set(&mut to_eyes, lane, -normalize_or_zero(direction));
            let normal = (b.as_dvec3() - a.as_dvec3()).cross(c.as_dvec3() - a.as_dvec3());
            let of_triangle = get(&triangles.normals, lane);
            set(&mut geometrics, lane, if normal.dot(direction) > 0.0 { -of_triangle } else { of_triangle });
        }
        // Interpolate in single precision.
        let mut shadings = geometrics;
        if let Some(corner_normals) = &triangles.corner_normals {
            for lane in 0..N {
                let normal = weighted(corner_normals, &weights, lane);
                set(&mut shadings, lane, visible_normal(normal, get(&geometrics, lane), get(&to_eyes, lane)));
            }
        }
        let mut mixed = plain_color.to_array().map(|channel| [channel; N]);
        if let Some(of_corners) = &triangles.colors {
            for lane in 0..N {
                set(&mut mixed, lane, weighted(of_corners, &weights, lane));
            }
        }
        colors.into_iter().zip(mixed).for_each(|(channel, mixed)| *channel = mixed);
        *surfaces = SurfaceLanes { to_eyes, geometrics, shadings };
        weights
    }

    /// The footprints of rays with the numbers `of_lanes`.
    #[inline(always)]
    fn footprints(
        &self,
        rays: impl WideRays,
        of_lanes: &[usize; N],
        triangles: &TriangleLanes,
        coordinates: &[footprint::Points; 3],
        weights: &Vectors,
    ) -> FootprintLanes {
        let mut footprints = FootprintLanes::NONE;
        for lane in 0..N {
            let hit = WideHit {
                direction: get(&self.directions, lane),
                sides: rays.sides(of_lanes[lane]),
                corners: triangles.corners.each_ref().map(|corner| get(corner, lane)),
                normal: get(&triangles.normals, lane),
                distance_by_area: self.distances[lane] * triangles.inverse_areas[lane],
            };
            let point = |[u, v]: &footprint::Points| Vec2::new(u[lane], v[lane]);
            let coordinates = [point(&coordinates[0]), point(&coordinates[1]), point(&coordinates[2])];
            footprints.set(lane, &hit.footprint(coordinates, get(weights, lane)));
        }
        footprints
    }
}

/// The sum of the corners' vectors by their weights.
#[inline(always)]
fn weighted([a, b, c]: &[Vectors; 3], weights: &Vectors, lane: usize) -> Vec3 {
    let weight = get(weights, lane);
    get(a, lane) * weight.x + get(b, lane) * weight.y + get(c, lane) * weight.z
}

#[inline(always)]
pub(super) fn get([x, y, z]: &Vectors, lane: usize) -> Vec3 {
    Vec3::new(x[lane], y[lane], z[lane])
}

#[inline(always)]
pub(super) fn set([x, y, z]: &mut Vectors, lane: usize, vector: Vec3) {
    (x[lane], y[lane], z[lane]) = (vector.x, vector.y, vector.z);
}

/// An interpolated normal of any length, turned to the side of the geometric normal; bent to the rim of what the eye sees
/// if it points away from it.
#[inline(always)]
pub(super) fn visible_normal(normal: Vec3, geometric: Vec3, to_eye: Vec3) -> Vec3 {
    let normal = if normal.dot(geometric) < 0.0 { -normal } else { normal };
    let depth = normal.dot(to_eye);
    let normal = if depth < 0.0 { normal - to_eye * depth } else { normal };
    let length = normal.length();
    // Too short is the mean of opposite normals.
    if length > 1e-3 { normal * (1.0 / length) } else { geometric }
}

/// The normalized vector, or zero. No square of single precision overflows or underflows in `f64`.
#[inline(always)]
pub(super) fn normalize_or_zero(v: DVec3) -> Vec3 {
    let inverse = 1.0 / v.length();
    if inverse.is_finite() { (v * inverse).as_vec3() } else { Vec3::ZERO }
}
