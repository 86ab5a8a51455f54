//! Normals, colours and footprints on textures, of many hits at once: loops over arrays, which the compiler turns into vector
//! instructions.

mod triangles;

use glam::{DVec3, Vec2, Vec3};

use crate::{
    grid::traced::TracedMesh,
    intersect::{ray::Hit, triangle},
    render::surface::triangles::{FewTriangles, TriangleLanes},
    simd::{Kernel, Simd},
    texture::{
        footprint::{self, FootprintLanes, Footprints, WideHit, WideRays},
        materials::PointMaterial,
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

/// The surfaces at up to 64 hits, by their number.
///
/// It is written again for each block of samples: copies took up to 5 % of a frame's time.
pub(super) struct SurfaceBatch {
    /// `None` for misses and caps.
    pub(super) surfaces: [Option<Surface>; 64],
    /// `None` also for surfaces that only scatter light.
    pub(super) materials: [Option<PointMaterial>; 64],
    /// On textures, if the mesh has texture coordinates.
    pub(super) footprints: Footprints,
}

impl SurfaceBatch {
    pub(super) const NONE: Self = Self { surfaces: [None; 64], materials: [None; 64], footprints: Footprints::NONE };
}

/// Interpolates normals and colours of a mesh where up to 64 rays hit its triangles; `None` for misses and caps.
pub(super) struct Surfaces<'a, R> {
    pub(super) mesh: &'a TracedMesh,
    pub(super) rays: R,
    pub(super) hits: &'a [Hit],
    /// That of a mesh without colours.
    pub(super) plain_color: Vec3,
    /// Entries beyond the hits are left as they are.
    pub(super) surfaces: &'a mut [Option<Surface>; 64],
    /// Those on textures, if the mesh has texture coordinates.
    pub(super) footprints: &'a mut Footprints,
}

impl<R: WideRays> Kernel for Surfaces<'_, R> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { mesh, rays, hits, plain_color, surfaces, footprints } = self;
        footprints.clear();
        surfaces[..hits.len()].fill(None);
        let on_triangles = TriangleHits::of(hits);
        let triangles = on_triangles.triangles(hits);
        // Close to a model many samples show the same triangle, whose corners are found and decoded once.
        let few = FewTriangles::of::<S>(&triangles, on_triangles.n);
        let mut of_few = None;
        if let Some(few) = &few {
            of_few = Some(TriangleLanes::gather::<S>(mesh, &few.triangles));
        }
        for (chunk, (of_lanes, n)) in on_triangles.lanes().enumerate() {
            let triangles = match (&few, &of_few) {
                (Some(few), Some(of_few)) => of_few.pick::<S>(&few.places.as_chunks().0[chunk]),
                _ => TriangleLanes::gather::<S>(mesh, &triangles.as_chunks().0[chunk]),
            };
            let hits = RayHits::of(rays, hits, &of_lanes);
            let found = hits.interpolate(&triangles, |lane| rays.origin(of_lanes[lane]), plain_color);
            if let Some(coordinates) = &triangles.coordinates {
                footprints.push(&hits.footprints(rays, &of_lanes, &triangles, coordinates, &found), n);
            }
            for (lane, &sample) in of_lanes.iter().enumerate().take(n) {
                surfaces[sample] = Some(Surface {
                    to_eye: get(&found.to_eyes, lane),
                    geometric: get(&found.geometrics, lane),
                    shading: get(&found.shadings, lane),
                    color: get(&found.colors, lane),
                });
            }
        }
    }
}

/// The numbers of those of up to 64 hits that are neither misses nor caps.
pub(super) struct TriangleHits {
    numbers: [usize; 64],
    n: usize,
}

impl TriangleHits {
    #[inline(always)]
    pub(super) fn of(hits: &[Hit]) -> Self {
        let (mut numbers, mut n) = ([0; 64], 0);
        for (number, hit) in (0..64).zip(hits) {
            numbers[n] = number;
            n += usize::from(!hit.is_miss() && !hit.is_cap());
        }
        Self { numbers, n }
    }

    /// The hits' triangles; the last is repeated.
    #[inline(always)]
    fn triangles(&self, hits: &[Hit]) -> [u32; 64] {
        let mut triangles = [0; 64];
        if self.n > 0 {
            for (place, triangle) in triangles.iter_mut().enumerate() {
                *triangle = hits[self.numbers[place.min(self.n - 1)]].triangle;
            }
        }
        triangles
    }

    /// The numbers, [`N`] at a time, and how many these are: lanes beyond the last repeat it. They are chosen here: loops with a
    /// check do not become vector instructions, and a frame's shading took 1.5 times as long.
    #[inline(always)]
    pub(super) fn lanes(&self) -> impl Iterator<Item = ([usize; N], usize)> {
        self.numbers[..self.n].chunks(N).map(|numbers| {
            let n = numbers.len();
            (std::array::from_fn(|lane| numbers[lane.min(n - 1)]), n)
        })
    }
}

/// Rays, and how far away they hit triangles.
struct RayHits {
    directions: Vectors,
    /// In lengths of the directions.
    distances: [f32; N],
}

/// The surfaces at hits, and the corners' parts in the hit points.
struct SurfaceLanes {
    weights: Vectors,
    /// Those of [`Surface`].
    to_eyes: Vectors,
    geometrics: Vectors,
    shadings: Vectors,
    colors: Vectors,
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

    /// The surfaces where rays from `origin` of a lane hit; `plain_color` is that of a mesh without colours.
    #[inline(always)]
    fn interpolate(
        &self,
        triangles: &TriangleLanes,
        origin: impl Fn(usize) -> Vec3,
        plain_color: Vec3,
    ) -> SurfaceLanes {
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
        let mut colors = plain_color.to_array().map(|channel| [channel; N]);
        if let Some(of_corners) = &triangles.colors {
            for lane in 0..N {
                set(&mut colors, lane, weighted(of_corners, &weights, lane));
            }
        }
        SurfaceLanes { weights, to_eyes, geometrics, shadings, colors }
    }

    /// The footprints of rays with the numbers `of_lanes`.
    #[inline(always)]
    fn footprints(
        &self,
        rays: impl WideRays,
        of_lanes: &[usize; N],
        triangles: &TriangleLanes,
        coordinates: &[footprint::Points; 3],
        surfaces: &SurfaceLanes,
    ) -> FootprintLanes {
        let mut footprints = FootprintLanes::NONE;
        for lane in 0..N {
            let hit = WideHit {
                direction: get(&self.directions, lane),
                sides: rays.sides(of_lanes[lane]),
                corners: triangles.corners.each_ref().map(|corner| get(corner, lane)),
                normal: get(&triangles.normals, lane),
                distance_by_area: (f64::from(self.distances[lane]) * triangles.inverse_areas[lane]) as f32,
            };
            let point = |[u, v]: &footprint::Points| Vec2::new(u[lane], v[lane]);
            let coordinates = [point(&coordinates[0]), point(&coordinates[1]), point(&coordinates[2])];
            footprints.set(lane, &hit.footprint(coordinates, get(&surfaces.weights, lane)));
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
