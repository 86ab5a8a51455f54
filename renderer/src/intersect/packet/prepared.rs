//! Prepares triangles, one per lane, for many rays with a common origin.

use crate::{
    intersect::margins::{PLANE_MARGIN, SIDE_MARGIN, SLOPE_MARGIN, UNDERFLOW_MARGIN},
    simd::Simd,
};

/// Common properties and bounds of all rays of the packets.
pub(super) struct RayBounds {
    /// Common origin, in model space.
    pub(super) origin: [f32; 3],
    /// The major axis k, then u and v.
    pub(super) axes: [usize; 3],
    /// Sign of all directions along the major axis.
    pub(super) sign: f32,
    /// Bounds of the slopes of all rays without a final answer: least and largest u, least and largest v.
    pub(super) slopes: [f32; 4],
    /// Largest absolute components of all directions along `axes`, the directions scaled to 1 along the major axis.
    pub(super) max_abs_direction: [f32; 3],
}

/// Triangles prepared for the rays, one per lane.
#[derive(Default)]
#[repr(align(64))]
pub(super) struct PreparedTriangles {
    pub(super) triangle_indices: [u32; 16],
    /// Normals of the planes through the origin and the three edges, along the rays' axes. All three dot products with
    /// a ray's direction are positive if the ray hits the triangle in front of the origin.
    pub(super) sides: [[[f32; 16]; 3]; 3],
    /// Rounding error of these products.
    pub(super) side_margin: [f32; 16],
    /// Upper bound of the products with a ray, less the terms of its slopes.
    pub(super) greatest_sides: [[f32; 16]; 3],
    /// The normal of the triangle's plane, divided by its offset from the origin: the dot product with a direction of
    /// length 1 along the major axis is the inverse depth of the hit.
    pub(super) plane: [[f32; 16]; 3],
    /// Rounding error of inverse depths, relative and absolute.
    pub(super) plane_margins: [[f32; 16]; 2],
    /// Bounds of the corners' slopes; infinite for triangles that reach behind the origin.
    pub(super) u: [[f32; 16]; 2],
    pub(super) v: [[f32; 16]; 2],
    /// Inverse of the least depth along the major axis.
    pub(super) inverse_depth: [f32; 16],
}

impl PreparedTriangles {
    /// Prepares triangles with these corners; returns a bit for each that the rays' bounds meet. Lanes without it are
    /// undefined.
    #[inline(always)]
    pub(super) fn prepare<S: Simd>(&mut self, corners: [[S; 3]; 3], ray_bounds: &RayBounds) -> u32 {
        // Move the origin to zero.
        let [k, u, v] = ray_bounds.axes;
        let mut from_origin = corners;
        for corner in 0..3 {
            for axis in 0..3 {
                from_origin[corner][axis] = corners[corner][axis].sub(S::splat(ray_bounds.origin[axis]));
            }
        }
        let zero = S::splat(0.0);
        let [a, b, c] = &from_origin;

        // Compute the triangles' bounds in slopes and inverse depth.
        let sign = S::splat(ray_bounds.sign);
        let depths = [a[k].mul(sign), b[k].mul(sign), c[k].mul(sign)];
        let nearest = depths[0].min(depths[1]).min(depths[2]);
        let farthest = depths[0].max(depths[1]).max(depths[2]);
        let one = S::splat(1.0);
        let inverse = [one.div(depths[0]), one.div(depths[1]), one.div(depths[2])];
        let nearest_inverse = inverse[0].max(inverse[1]).max(inverse[2]);
        let u_bounds = slope_bounds([a[u], b[u], c[u]], inverse);
        let v_bounds = slope_bounds([a[v], b[v], c[v]], inverse);

        // Keep triangles whose bounds meet the rays', and those that reach behind the origin and so have no bounds.
        let unbounded = nearest.lt(S::splat(1e-30));
        let [u_low, u_high, v_low, v_high] = ray_bounds.slopes;
        let within = u_bounds[0].le(S::splat(u_high))
            & S::splat(u_low).le(u_bounds[1])
            & v_bounds[0].le(S::splat(v_high))
            & S::splat(v_low).le(v_bounds[1]);
        let left = (within | unbounded) & zero.le(farthest);
        if left == 0 {
            return 0;
        }

        // Store the bounds; infinite ones where there are none.
        u_bounds[0].store(&mut self.u[0]);
        u_bounds[1].store(&mut self.u[1]);
        v_bounds[0].store(&mut self.v[0]);
        v_bounds[1].store(&mut self.v[1]);
        nearest_inverse.mul(S::splat(1.0 + SLOPE_MARGIN)).store(&mut self.inverse_depth);
        let mut without_bounds = left & unbounded;
        while without_bounds != 0 {
            let lane = without_bounds.trailing_zeros() as usize;
            without_bounds &= without_bounds - 1;
            for bounds in [&mut self.u, &mut self.v] {
                bounds[0][lane] = f32::NEG_INFINITY;
                bounds[1][lane] = f32::INFINITY;
            }
            // Rays without an interval left have an infinite limit, and so do not hit it.
            self.inverse_depth[lane] = f32::MAX;
        }

        // Compute the planes through the origin and the edges: p × (q − p) for the edge from p to q.
        let mut sides = [[zero; 3]; 3];
        let mut edges = [[zero; 3]; 3];
        let mut max_abs_corner = [zero; 3];
        let mut max_abs_edge = [zero; 3];
        for edge in 0..3 {
            let mut p = [zero; 3];
            for local_axis in 0..3 {
                let axis = ray_bounds.axes[local_axis];
                p[local_axis] = from_origin[edge][axis];
                edges[edge][local_axis] = corners[(edge + 1) % 3][axis].sub(corners[edge][axis]);
                max_abs_corner[local_axis] = max_abs_corner[local_axis].max(p[local_axis].abs());
                max_abs_edge[local_axis] = max_abs_edge[local_axis].max(edges[edge][local_axis].abs());
            }
            sides[edge] = cross(p, edges[edge]);
        }

        // Compute the triangle's plane: normal · x = offset.
        let normal = cross(edges[0], edges[1]);
        let offset = normal[0].mul_add(a[k], normal[1].mul_add(a[u], normal[2].mul(a[v])));

        // Bound the rounding errors by products of the largest components.
        let (mut side_error, mut normal_error, mut offset_error, mut underflow) = (zero, zero, zero, one);
        for local_axis in 0..3 {
            let (next, last) = ((local_axis + 1) % 3, (local_axis + 2) % 3);
            let max_abs_direction = S::splat(ray_bounds.max_abs_direction[local_axis]);
            let (next_corner, last_corner) = (max_abs_corner[next], max_abs_corner[last]);
            let side = next_corner.mul_add(max_abs_edge[last], last_corner.mul(max_abs_edge[next]));
            let area = max_abs_edge[next].mul(max_abs_edge[last]);
            side_error = side.mul_add(max_abs_direction, side_error);
            normal_error = area.mul_add(max_abs_direction, normal_error);
            offset_error = area.mul_add(max_abs_corner[local_axis], offset_error);
            underflow = underflow.add(max_abs_direction).add(max_abs_corner[local_axis]);
        }
        let underflow = underflow.mul(S::splat(UNDERFLOW_MARGIN));
        let side_margin = side_error.mul_add(S::splat(SIDE_MARGIN), underflow);
        let normal_margin = normal_error.mul_add(S::splat(PLANE_MARGIN), underflow);
        let offset_margin = offset_error.mul_add(S::splat(PLANE_MARGIN), underflow);
        side_margin.store(&mut self.side_margin);

        // Scale the plane to give inverse depths, and its error with it.
        let inverse_offset = one.div(offset);
        normal[0].mul(inverse_offset).mul(sign).store(&mut self.plane[0]);
        normal[1].mul(inverse_offset).store(&mut self.plane[1]);
        normal[2].mul(inverse_offset).store(&mut self.plane[2]);
        offset_margin.mul_add(inverse_offset.abs(), S::splat(SLOPE_MARGIN)).store(&mut self.plane_margins[0]);
        normal_margin.mul(inverse_offset.abs()).store(&mut self.plane_margins[1]);

        // Orient the edge planes by the side of the triangle that faces the origin: then hits have positive products.
        let orientation = S::select(zero.lt(offset), one, zero.sub(one));
        let is_oriented = offset_margin.lt(offset.abs());

        // Bound the products from above; without a certain orientation the bound is infinite.
        let margin = S::select(is_oriented, side_margin.mul(S::splat(4.0)), S::splat(f32::INFINITY));
        for edge in 0..3 {
            let along_k = sides[edge][0].mul(sign).mul(orientation);
            along_k.add(margin).store(&mut self.greatest_sides[edge]);
            along_k.store(&mut self.sides[edge][0]);
            sides[edge][1].mul(orientation).store(&mut self.sides[edge][1]);
            sides[edge][2].mul(orientation).store(&mut self.sides[edge][2]);
        }
        left
    }
}

#[inline(always)]
fn cross<S: Simd>(a: [S; 3], b: [S; 3]) -> [S; 3] {
    [a[1].mul_sub(b[2], a[2].mul(b[1])), a[2].mul_sub(b[0], a[0].mul(b[2])), a[0].mul_sub(b[1], a[1].mul(b[0]))]
}

/// Bounds of three corners' slopes, from their coordinates along an axis and their inverse depths.
#[inline(always)]
fn slope_bounds<S: Simd>(coordinates: [S; 3], inverse_depths: [S; 3]) -> [S; 2] {
    let slopes = [
        coordinates[0].mul(inverse_depths[0]),
        coordinates[1].mul(inverse_depths[1]),
        coordinates[2].mul(inverse_depths[2]),
    ];
    let low = slopes[0].min(slopes[1]).min(slopes[2]);
    let high = slopes[0].max(slopes[1]).max(slopes[2]);
    let margin = low.abs().max(high.abs()).mul_add(S::splat(SLOPE_MARGIN), S::splat(UNDERFLOW_MARGIN));
    [low.sub(margin), high.add(margin)]
}
