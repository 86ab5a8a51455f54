//! Which triangles of a list a single ray may hit, told for many triangles at once.
//!
//! It only drops what certainly misses, with rounding accounted for; [`crate::intersect::triangle`] decides the rest.

#[cfg(target_arch = "x86_64")]
use crate::{
    grid::{traced::TracedMesh, tree::boxes::LeafBoxes},
    intersect::{
        InstructionSet,
        packet::prepared::{SIDE_MARGIN, UNDERFLOW_MARGIN},
        ray::Ray,
        simd::{Avx2, Avx512, Portable, Simd},
        walk::TriangleList,
    },
};

/// Triangles that are filtered together.
pub const BATCH: usize = 16;

/// A ray, ready to meet lists of triangles.
pub(crate) struct RayFilter<'a> {
    instructions: InstructionSet,
    mesh: &'a TracedMesh,
    ray: &'a Ray,
    /// The axis along which the ray advances most, and the two others.
    axes: [usize; 3],
    /// The ray's slopes across that axis.
    u: f32,
    v: f32,
}

impl<'a> RayFilter<'a> {
    #[inline]
    pub(crate) fn new(instructions: InstructionSet, mesh: &'a TracedMesh, ray: &'a Ray) -> Self {
        let [x, y, z] = ray.direction.to_array().map(f32::abs);
        let k = if x >= y && x >= z {
            0
        } else if y >= z {
            1
        } else {
            2
        };
        let axes = [k, (k + 1) % 3, (k + 2) % 3];
        let depth = ray.direction[k].abs();
        Self { instructions, mesh, ray, axes, u: ray.direction[axes[1]] / depth, v: ray.direction[axes[2]] / depth }
    }

    /// Calls `visit` with each triangle of a list that the ray may hit. The list's cell has `size` finest cells along an
    /// edge, and its lowest corner at `corner_from_origin`.
    #[inline(always)]
    pub(crate) fn for_each(
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
                // SAFETY: a grid holds only what `InstructionSet::available` has found.
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
        match self.instructions {
            InstructionSet::Portable => self.passed_boxes_generic::<Portable>(boxes, first),
            // SAFETY: the caller promises that this machine has them.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => unsafe { self.passed_boxes_avx2(boxes, first) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => unsafe { self.passed_boxes_avx512(boxes, first) },
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
    fn passed_boxes_avx2(&self, boxes: &LeafBoxes<'_>, first: usize) -> u32 {
        self.passed_boxes_generic::<Avx2>(boxes, first)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
    fn passed_boxes_avx512(&self, boxes: &LeafBoxes<'_>, first: usize) -> u32 {
        self.passed_boxes_generic::<Avx512>(boxes, first)
    }

    #[inline(always)]
    fn passed_boxes_generic<S: Simd>(&self, boxes: &LeafBoxes<'_>, first: usize) -> u32 {
        let slopes = [self.u, self.u, self.v, self.v];
        let mut all = 0;
        let mut first_in_batch = 0;
        while first_in_batch < BATCH {
            let missed = boxes.bounds::<S>(first + first_in_batch).miss_signs(slopes, 0.0).sign_mask();
            all |= (!missed & ((1 << S::LANES) - 1)) << first_in_batch;
            first_in_batch += S::LANES;
            if first + first_in_batch >= boxes.n() {
                break;
            }
        }
        all & (u32::MAX >> (32 - (boxes.n() - first).min(BATCH)))
    }
}

/// A bit for each of up to [`BATCH`] triangles that the ray may hit.
///
/// # Safety
/// This machine has the `instructions`.
#[inline]
pub unsafe fn may_hit(instructions: InstructionSet, mesh: &TracedMesh, ray: &Ray, triangles: &[u32]) -> u32 {
    match instructions {
        InstructionSet::Portable => may_hit_generic::<Portable>(mesh, ray, triangles),
        // SAFETY: the caller promises that this machine has them.
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx2 => unsafe { may_hit_avx2(mesh, ray, triangles) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx512 => unsafe { may_hit_avx512(mesh, ray, triangles) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
fn may_hit_avx2(mesh: &TracedMesh, ray: &Ray, triangles: &[u32]) -> u32 {
    may_hit_generic::<Avx2>(mesh, ray, triangles)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
fn may_hit_avx512(mesh: &TracedMesh, ray: &Ray, triangles: &[u32]) -> u32 {
    may_hit_generic::<Avx512>(mesh, ray, triangles)
}

/// No closures here: they would not be compiled for the caller's instruction set.
#[inline(always)]
fn may_hit_generic<S: Simd>(mesh: &TracedMesh, ray: &Ray, triangles: &[u32]) -> u32 {
    let reach = [ray.direction.x.abs(), ray.direction.y.abs(), ray.direction.z.abs()];
    let underflow = UNDERFLOW_MARGIN * (1.0 + reach[0] + reach[1] + reach[2]);
    let mut all = 0;
    let mut first = 0;
    while first < triangles.len().min(BATCH) {
        let mut triangles_in_lanes = [triangles[first]; 16];
        let n = (triangles.len() - first).min(S::LANES);
        triangles_in_lanes[..n].copy_from_slice(&triangles[first..first + n]);
        let corners = mesh.gather_corners::<S>(&triangles_in_lanes);
        let zero = S::splat(0.0);
        // The side of the edge from p to q is direction·(p × (q − p)), seen from the origin.
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
                sum = absolute.mul_add(S::splat(reach[axis]), sum);
            }
            (low, high, products) = (low.min(side), high.max(side), products.max(sum));
        }
        let margin = products.mul_add(S::splat(SIDE_MARGIN), S::splat(underflow));
        let misses = low.lt(zero.sub(margin)) & margin.lt(high);
        all |= (!misses & ((1 << n) - 1)) << first;
        first += S::LANES;
    }
    all
}
