//! Drops triangles of a list that a single ray certainly misses, many at once.
//!
//! Every test accounts for rounding; [`crate::intersect::triangle`] decides the rest.

use crate::{
    grid::traced::TracedMesh,
    intersect::{
        margins::{SIDE_MARGIN, UNDERFLOW_MARGIN},
        ray::Ray,
    },
    simd::{InstructionSet, Kernel, Simd},
};

/// Triangles that are filtered together.
pub const BATCH: usize = 16;

/// A bit for each of up to [`BATCH`] triangles that the ray may hit.
///
/// # Safety
/// This machine has the `instructions`.
#[inline]
pub unsafe fn may_hit(instructions: InstructionSet, mesh: &TracedMesh, ray: &Ray, triangles: &[u32]) -> u32 {
    struct MayHit<'a>(&'a TracedMesh, &'a Ray, &'a [u32]);
    impl Kernel for MayHit<'_> {
        type Output = u32;
        #[inline(always)]
        fn run<S: Simd>(self) -> u32 {
            may_hit_generic::<S>(self.0, self.1, self.2)
        }
    }
    // SAFETY: the caller's.
    unsafe { instructions.call(MayHit(mesh, ray, triangles)) }
}

#[inline(always)]
fn may_hit_generic<S: Simd>(mesh: &TracedMesh, ray: &Ray, triangles: &[u32]) -> u32 {
    let abs_direction = [ray.direction.x.abs(), ray.direction.y.abs(), ray.direction.z.abs()];
    let underflow = UNDERFLOW_MARGIN * (1.0 + abs_direction[0] + abs_direction[1] + abs_direction[2]);
    let mut all = 0;
    let mut first = 0;
    while first < triangles.len().min(BATCH) {
        // Gather the corners; lanes without a triangle repeat the first.
        let mut triangles_in_lanes = [triangles[first]; 16];
        let n = (triangles.len() - first).min(S::LANES);
        triangles_in_lanes[..n].copy_from_slice(&triangles[first..first + n]);
        let corners = mesh.gather_corners::<S>(&triangles_in_lanes);
        let zero = S::splat(0.0);

        // Compute the side of each edge from p to q: direction·(p × (q − p)), relative to the origin.
        let (mut low, mut high, mut products) = (S::splat(f32::INFINITY), S::splat(f32::NEG_INFINITY), zero);
        for edge in 0..3 {
            let (from, to) = (corners[edge], corners[(edge + 1) % 3]);
            let (mut p, mut e) = ([zero; 3], [zero; 3]);
            for axis in 0..3 {
                p[axis] = from[axis].sub(S::splat(ray.origin[axis]));
                e[axis] = to[axis].sub(from[axis]);
            }
            let mut side = zero;
            let mut sum = zero;
            for axis in 0..3 {
                let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
                let minor = p[next].mul_sub(e[last], p[last].mul(e[next]));
                side = minor.mul_add(S::splat(ray.direction[axis]), side);
                let absolute = p[next].abs().mul_add(e[last].abs(), p[last].abs().mul(e[next].abs()));
                sum = absolute.mul_add(S::splat(abs_direction[axis]), sum);
            }
            (low, high, products) = (low.min(side), high.max(side), products.max(sum));
        }

        // The ray misses where two sides certainly differ.
        let margin = products.mul_add(S::splat(SIDE_MARGIN), S::splat(underflow));
        let misses = low.lt(zero.sub(margin)) & margin.lt(high);
        all |= (!misses & ((1 << n) - 1)) << first;
        first += S::LANES;
    }
    all
}
