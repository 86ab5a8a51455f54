//! Drops triangles of a list that a single ray certainly misses, many at once.
//!
//! Every test accounts for rounding; [`crate::intersect::triangle`] decides the rest.

use crate::{
    grid::{cells::TriangleList, traced::TracedMesh, tree::boxes::LeafBoxes},
    intersect::{
        margins::{SIDE_MARGIN, UNDERFLOW_MARGIN},
        ray::{Ray, major_axis},
    },
    simd::{InstructionSet, Kernel, Simd},
};

/// Triangles that are filtered together.
pub const BATCH: usize = 16;

/// A ray, prepared to reject triangles.
pub(super) struct RayFilter<'a> {
    instructions: InstructionSet,
    mesh: &'a TracedMesh,
    ray: &'a Ray,
    /// The ray's major axis, and the two others.
    axes: [usize; 3],
    /// Slopes against the major axis.
    u: f32,
    v: f32,
}

impl<'a> RayFilter<'a> {
    /// Prepares a ray; `instructions` are those of a grid.
    #[inline]
    pub(super) fn new(instructions: InstructionSet, mesh: &'a TracedMesh, ray: &'a Ray) -> Self {
        let k = major_axis(ray.direction.to_array());
        let axes = [k, (k + 1) % 3, (k + 2) % 3];
        let depth = ray.direction[k].abs();
        Self { instructions, mesh, ray, axes, u: ray.direction[axes[1]] / depth, v: ray.direction[axes[2]] / depth }
    }

    /// Calls `visit` with each triangle of a list that the ray may hit; cell as in [`LeafBoxes::new`].
    #[inline(always)]
    pub(super) fn for_each(
        &self,
        list: &TriangleList<'_>,
        corner_from_origin: [f64; 3],
        size: i32,
        mut visit: impl FnMut(u32),
    ) {
        let is_backward = self.ray.direction[self.axes[0]] < 0.0;
        let corner = self.axes.map(|axis| corner_from_origin[axis]);
        let boxes = (!list.boxes.is_empty()).then(|| LeafBoxes::new(list.boxes, self.axes, is_backward, corner, size));
        for (batch, triangles) in list.triangles.chunks(BATCH).enumerate() {
            let mut left = match &boxes {
                Some(boxes) => self.passed_boxes(boxes, batch * BATCH),
                // SAFETY: as in `passed_boxes`.
                None => unsafe { may_hit(self.instructions, self.mesh, self.ray, triangles) },
            };
            while left != 0 {
                visit(triangles[left.trailing_zeros() as usize]);
                left &= left - 1;
            }
        }
    }

    /// A bit for each of the [`BATCH`] boxes from number `first` on that the ray may pass.
    #[inline]
    fn passed_boxes(&self, boxes: &LeafBoxes<'_>, first: usize) -> u32 {
        struct PassedBoxes<'a>(&'a RayFilter<'a>, &'a LeafBoxes<'a>, usize);
        impl Kernel for PassedBoxes<'_> {
            type Output = u32;
            #[inline(always)]
            fn run<S: Simd>(self) -> u32 {
                let Self(&RayFilter { u, v, .. }, boxes, first) = self;
                let mut all = 0;
                let mut first_in_batch = 0;
                while first_in_batch < BATCH {
                    let missed = boxes.bounds::<S>(first + first_in_batch).miss_signs([u, u, v, v], 0.0).sign_mask();
                    all |= (!missed & ((1 << S::LANES) - 1)) << first_in_batch;
                    first_in_batch += S::LANES;
                    if first + first_in_batch >= boxes.n() {
                        break;
                    }
                }
                all & (u32::MAX >> (32 - (boxes.n() - first).min(BATCH)))
            }
        }
        // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
        unsafe { self.instructions.call(PassedBoxes(self, boxes, first)) }
    }
}

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
