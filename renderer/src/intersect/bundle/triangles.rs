//! Tests triangles against the rays of a bundle, in single precision.
//!
//! After Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (2013): corners are sheared so that the ray becomes an
//! axis. [`triangle`] decides where rounding could change the answer, so the answers are those of rays that go alone.

use super::{Bundle, MOST_RAYS, RayLanes};
use crate::{
    intersect::{margins::UNDERFLOW_MARGIN, triangle},
    simd::Simd,
};

/// Rounding error of an edge's side, relative to the product of the farthest distance and the sheared corners' largest
/// coordinate: 46 roundings, for slopes up to 2, and 18 to spare.
const SIDE_MARGIN: f32 = 64.0 / (1u32 << 24) as f32;

/// Rounding error of a depth, relative to distances along the normal: 18 roundings, and 14 to spare.
const DEPTH_MARGIN: f32 = 32.0 / (1u32 << 24) as f32;

/// Least cosine, as it were, between ray and normal for which [`DEPTH_MARGIN`] holds.
const LEAST_COSINE: f32 = 1.0 / 4096.0;

impl Bundle<'_> {
    /// Tests a triangle against some rays.
    #[inline(always)]
    pub(super) fn test_triangle<S: Simd>(&mut self, triangle: u32, rays: u32) {
        let mesh = self.grid.mesh();
        let corners = mesh.corners_by_call(triangle);
        let mut points = [[0.0; 3]; 3];
        for corner in 0..3 {
            for axis in 0..3 {
                points[corner][axis] = corners[corner][self.axes[axis]] * self.shaft.signs[axis];
            }
        }
        let side_margin = self.reach * SIDE_MARGIN;
        let least_margin = S::splat(side_margin * side_margin + UNDERFLOW_MARGIN);
        let (zero, one, side_margin) = (S::splat(0.0), S::splat(1.0), S::splat(side_margin));
        for lane in (0..MOST_RAYS).step_by(S::LANES) {
            // Move the ray's origin to zero, and shear corners so that the ray becomes the axis k.
            let RayLanes { origins, slopes, intervals, .. } = &self.lanes;
            let origin = [S::load(&origins[0][lane..]), S::load(&origins[1][lane..]), S::load(&origins[2][lane..])];
            let slope = [S::load(&slopes[0][lane..]), S::load(&slopes[1][lane..])];
            let mut from_origin = [[zero; 3]; 3];
            let mut sheared = [[zero; 2]; 3];
            for corner in 0..3 {
                for axis in 0..3 {
                    from_origin[corner][axis] = S::splat(points[corner][axis]).sub(origin[axis]);
                }
                let [depth, u, v] = from_origin[corner];
                sheared[corner] = [slope[0].neg_mul_add(depth, u), slope[1].neg_mul_add(depth, v)];
            }

            // Find the side on which the ray passes each edge.
            let [a, b, c] = sheared;
            let sides = [
                c[0].mul_sub(b[1], c[1].mul(b[0])),
                a[0].mul_sub(c[1], a[1].mul(c[0])),
                b[0].mul_sub(a[1], b[1].mul(a[0])),
            ];
            let largest = a[0].abs().max(a[1].abs()).max(b[0].abs().max(b[1].abs())).max(c[0].abs().max(c[1].abs()));
            let margin = largest.mul_add(side_margin, least_margin);
            let low = sides[0].min(sides[1]).min(sides[2]);
            let high = sides[0].max(sides[1]).max(sides[2]);
            let inside = low.max(zero.sub(high));
            let all = ((1u64 << S::LANES) - 1) as u32;
            let possible = rays >> lane & all & !inside.lt(zero.sub(margin));
            if possible == 0 {
                continue;
            }

            // Bound the depth at which the ray meets the triangle's plane.
            let normal = normal(&points);
            let size = normal[0].abs() + normal[1].abs() + normal[2].abs();
            let [along_k, along_u, along_v] = [S::splat(normal[0]), S::splat(normal[1]), S::splat(normal[2])];
            let [depth, u, v] = from_origin[0];
            let offset = along_k.mul_add(depth, along_u.mul_add(u, along_v.mul(v)));
            let cosine = along_u.mul_add(slope[0], along_v.mul_add(slope[1], along_k));
            let inverse = one.div(cosine);
            let distance = depth.abs().max(u.abs()).max(v.abs());
            let depth = offset.mul(inverse);
            let error = distance.add(depth.abs()).mul(inverse.abs()).mul(S::splat(size * DEPTH_MARGIN));
            let (least, greatest) = (depth.sub(error), depth.add(error));

            // Keep certain hits, and decide those that rounding could change.
            let (start, end) = (S::load(&intervals[0][lane..]), S::load(&intervals[1][lane..]));
            let bounded = possible & S::splat(size * LEAST_COSINE).lt(cosine.abs());
            let outside = bounded & (greatest.lt(start) | end.lt(least));
            let hit =
                if mesh.has_masks() { 0 } else { bounded & margin.lt(inside) & start.lt(least) & greatest.lt(end) };
            self.occlude(triangle, hit << lane);
            let mut undecided = possible & !outside & !hit;
            while undecided != 0 {
                let ray_idx = lane + undecided.trailing_zeros() as usize;
                undecided &= undecided - 1;
                let ray = &self.rays[ray_idx];
                if triangle::intersect(ray, &corners).is_some() && !(mesh.has_masks() && mesh.is_passed(triangle, ray))
                {
                    self.occlude(triangle, 1 << ray_idx);
                }
            }
        }
    }
}

/// A vector of any length across a triangle, rounded once.
#[inline(always)]
fn normal(points: &[[f32; 3]; 3]) -> [f32; 3] {
    let [a, b, c] = points.map(|point| point.map(f64::from));
    let ([x, y, z], [p, q, r]) = ([b[0] - a[0], b[1] - a[1], b[2] - a[2]], [c[0] - a[0], c[1] - a[1], c[2] - a[2]]);
    [(y * r - z * q) as f32, (z * p - x * r) as f32, (x * q - y * p) as f32]
}
