//! Where secondary rays start: hits, lifted off their surfaces.

use glam::{DVec3, Vec3};
use shared::appearance::ClipPlane;

use crate::{
    grid::traced::TracedMesh,
    intersect::ray::Hit,
    render::surface::{N, TriangleHits, get, set},
    simd::{InstructionSet, Kernel, Simd},
    texture::footprint::WideRays,
};

/// Lifts hits off the surfaces of a scene that a plane may cut open.
pub(super) struct Lift<'a> {
    mesh: &'a TracedMesh,
    clip: Option<ClipPlane>,
    /// How far points are lifted off their surfaces, in world units.
    pub(super) ray_offset: f64,
}

/// The start of secondary rays.
#[derive(Clone, Copy)]
pub(super) struct LiftedPoint {
    /// The hit point, lifted off the surface; model space.
    pub(super) point: DVec3,
    /// Unit length, on the side of the ray's origin.
    pub(super) normal: DVec3,
}

impl<'a> Lift<'a> {
    /// For rays between surfaces, and to another point.
    pub(super) fn new(mesh: &'a TracedMesh, clip: Option<ClipPlane>, other: Vec3) -> Self {
        let [min, max] = mesh.bounds().corners();
        // No coordinate exceeds this, and no difference its double. Rounding a point or a direction to single precision
        // moves it by at most √3·2⁻²⁴ of that.
        let max_coordinate = min.abs().max(max.abs()).max(other.as_dvec3().abs()).max_element();
        Self { mesh, clip, ray_offset: max_coordinate * (8.0 * f64::from(f32::EPSILON)) }
    }

    /// The starts of rays from up to 64 hits of rays, by their number; `None` for misses, and for slivers too thin to have a normal.
    pub(super) fn points(
        &self,
        instructions: InstructionSet,
        rays: impl WideRays,
        hits: &[Hit],
        points: &mut [Option<LiftedPoint>; 64],
    ) {
        // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
        unsafe { instructions.call(LiftedPoints { lift: self, rays, hits, points }) }
        let Some(ClipPlane { normal, offset }) = self.clip else { return };
        for number in (0..hits.len()).filter(|&number| hits[number].is_cap()) {
            let (origin, direction) = (rays.origin(number).as_dvec3(), rays.direction(number));
            points[number] = self.on_plane(origin, direction, (normal * offset, normal)).if_finite();
        }
    }

    /// [`Lift::points`] of one hit, in plain code that tests compare with.
    #[cfg(test)]
    pub(super) fn point(&self, origin: DVec3, direction: Vec3, hit: Hit) -> Option<LiftedPoint> {
        if hit.is_miss() {
            return None;
        }
        let plane = match self.clip {
            Some(ClipPlane { normal, offset }) if hit.is_cap() => (normal * offset, normal),
            _ => (Vec3::from_array(self.mesh.corners(hit.triangle)[0]).as_dvec3(), self.mesh.normal(hit.triangle)),
        };
        self.on_plane(origin, direction, plane).if_finite()
    }

    /// The point where a ray meets a plane, which has a point and a normal of any length.
    #[inline(always)]
    fn on_plane(&self, origin: DVec3, direction: Vec3, (on_plane, normal): (DVec3, DVec3)) -> LiftedPoint {
        let direction = direction.as_dvec3();
        let length = normal.length();
        let normal = if normal.dot(direction) > 0.0 { -normal } else { normal } * (1.0 / length);
        // Recompute t from the triangle's plane: single precision is too coarse for an eye far away.
        let t = normal.dot(on_plane - origin) / normal.dot(direction);
        LiftedPoint { point: origin + direction * t + normal * self.ray_offset, normal }
    }
}

impl LiftedPoint {
    /// A normal without a length gives no number.
    fn if_finite(self) -> Option<Self> {
        (self.point.is_finite() && self.normal.is_finite()).then_some(self)
    }
}

/// Lifts hits of triangles, many at once: loops over arrays, which the compiler turns into vector instructions.
struct LiftedPoints<'a, R> {
    lift: &'a Lift<'a>,
    rays: R,
    hits: &'a [Hit],
    points: &'a mut [Option<LiftedPoint>; 64],
}

impl<R: WideRays> Kernel for LiftedPoints<'_, R> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { lift, rays, hits, points } = self;
        points[..hits.len()].fill(None);
        for (of_lanes, triangles, n) in TriangleHits::of(hits).lanes() {
            // Gather the rays, and the triangles that they hit.
            let [mut origins, mut directions] = [[[0.0; N]; 3]; 2];
            for (lane, &number) in of_lanes.iter().enumerate() {
                set(&mut origins, lane, rays.origin(number));
                set(&mut directions, lane, rays.direction(number));
            }
            let mut corners = [[[0.0; N]; 3]; 3];
            for first in (0..N).step_by(S::LANES) {
                let mut next = [0; 16];
                next[..S::LANES].copy_from_slice(&triangles[first..first + S::LANES]);
                let gathered = lift.mesh.gather_corners::<S>(&next);
                for (gathered, corner) in gathered.iter().zip(&mut corners) {
                    gathered.iter().zip(corner).for_each(|(along, lanes)| along.store(&mut lanes[first..]));
                }
            }

            // Lift all of them, and keep those that have a normal.
            let [mut lifted, mut normals] = [[[0.0; N]; 3]; 2];
            for lane in 0..N {
                let [a, b, c] = [get(&corners[0], lane), get(&corners[1], lane), get(&corners[2], lane)];
                let [a, b, c] = [a.as_dvec3(), b.as_dvec3(), c.as_dvec3()];
                let origin = get(&origins, lane).as_dvec3();
                let LiftedPoint { point, normal } =
                    lift.on_plane(origin, get(&directions, lane), (a, (b - a).cross(c - a)));
                for axis in 0..3 {
                    (lifted[axis][lane], normals[axis][lane]) = (point[axis], normal[axis]);
                }
            }
            for (lane, &number) in of_lanes.iter().enumerate().take(n) {
                let vector = |[x, y, z]: &[[f64; N]; 3]| DVec3::new(x[lane], y[lane], z[lane]);
                points[number] = LiftedPoint { point: vector(&lifted), normal: vector(&normals) }.if_finite();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        grid::Grid,
        intersect::{clip, ray::Ray},
        model::statue,
        texture::footprint::SampleRays,
    };

    #[test]
    fn many_hits_are_lifted_to_the_points_of_single_ones() {
        let mesh = statue::generate(3000, &|_| ());
        let grid = Grid::build(mesh, &Default::default(), &|_| ());
        let [min, max] = grid.mesh().bounds().corners();
        let (middle, size) = ((min + max) * 0.5, (max - min).max_element());
        let plane = ClipPlane { normal: DVec3::Y, offset: middle.y };
        let eye = (middle + DVec3::new(0.3, 1.5, 2.0) * size).as_vec3();
        let target =
            |number: usize| DVec3::new((number % 8) as f64 - 3.5, (number / 8) as f64 - 3.5, 0.0) * (size / 8.0);
        let directions: [Vec3; 64] = std::array::from_fn(|number| (middle + target(number)).as_vec3() - eye);
        let rays = directions.map(|direction| Ray::new(eye, direction));
        for clip in [None, Some(plane)] {
            let mut hits = [Hit::MISS; 64];
            clip::intersect_rays(&grid, clip.as_ref(), &rays, &mut hits);
            assert!(hits.iter().any(|hit| hit.is_miss()) && hits.iter().any(|hit| !hit.is_miss() && !hit.is_cap()));
            assert_eq!(hits.iter().any(|hit| hit.is_cap()), clip.is_some());
            let lift = Lift::new(grid.mesh(), clip, Vec3::ZERO);
            let numbers =
                |lifted: LiftedPoint| [lifted.point, lifted.normal].map(|vector| vector.to_array().map(f64::to_bits));
            let single = |number: usize| lift.point(eye.as_dvec3(), directions[number], hits[number]);
            for instructions in InstructionSet::available() {
                for n in [64, 17, 1] {
                    let mut points = [None; 64];
                    let rays = SampleRays { eye, directions: &directions, sides: [Vec3::ZERO; 2] };
                    lift.points(instructions, rays, &hits[..n], &mut points);
                    for (number, &point) in points[..n].iter().enumerate() {
                        assert_eq!(point.map(numbers), single(number).map(numbers), "{instructions:?}: {number}");
                    }
                }
            }
        }
    }
}
