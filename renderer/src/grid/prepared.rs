//! Triangles, one in each lane of a vector, made ready for many rays with a common origin.

use crate::{simd::Simd, traced::TracedMesh};

/// What single precision can lose, relative: four roundings of 2⁻²⁴ in a slope, with as much again to spare.
pub(super) const SLOPE_MARGIN: f32 = 1.0 / (1u32 << 20) as f32;

/// The same for the sides of edges, relative to the sum of absolute products: eight roundings, doubled.
pub(super) const SIDE_MARGIN: f32 = 1.0 / (1u32 << 20) as f32;

/// More than the absolute error where products leave the range of normal numbers.
pub(super) const UNDERFLOW_MARGIN: f32 = 1e-36;

/// What the rays of a packet have in common.
pub(super) struct Bundle {
    /// Where they begin, in world space.
    pub(super) origin: [f32; 3],
    /// The major axis and the two others.
    pub(super) axes: [usize; 3],
    /// The sign of all directions along the major axis.
    pub(super) sign: f32,
    /// Bounds of the slopes of all rays without a final answer: least and largest u, least and largest v.
    pub(super) slopes: [f32; 4],
    /// The largest absolute components of all directions.
    pub(super) reach: [f32; 3],
}

/// Triangles made ready for the rays, one in each lane.
#[derive(Default)]
#[repr(align(64))]
pub(super) struct Prepared {
    /// Their places in the mesh.
    pub(super) places: [u32; 16],
    /// Normals of the planes through the origin and the three edges.
    pub(super) normals: [[[f32; 16]; 3]; 3],
    pub(super) side_margin: [f32; 16],
    /// Bounds of the slopes.
    pub(super) u: [[f32; 16]; 2],
    pub(super) v: [[f32; 16]; 2],
    /// The least depth along the major axis.
    pub(super) depth: [f32; 16],
}

impl Prepared {
    /// Reads the triangles at `places`, and makes them ready; returns a bit for each that some ray of the bundle may hit.
    /// The others are not ready.
    #[inline(always)]
    pub(super) fn prepare<S: Simd>(&mut self, mesh: &TracedMesh, bundle: &Bundle) -> u32 {
        let [k, u, v] = bundle.axes;
        let corners = mesh.corners_in_lanes::<S>(&self.places);
        let mut from_origin = corners;
        for corner in 0..3 {
            for axis in 0..3 {
                from_origin[corner][axis] = corners[corner][axis].sub(S::splat(bundle.origin[axis]));
            }
        }
        let zero = S::splat(0.0);
        let [a, b, c] = &from_origin;

        // Bounds in slopes and depth.
        let sign = S::splat(bundle.sign);
        let depths = [a[k].mul(sign), b[k].mul(sign), c[k].mul(sign)];
        let nearest = depths[0].min(depths[1]).min(depths[2]);
        let farthest = depths[0].max(depths[1]).max(depths[2]);
        let one = S::splat(1.0);
        let inverse = [one.div(depths[0]), one.div(depths[1]), one.div(depths[2])];
        let u_bounds = slope_bounds([a[u], b[u], c[u]], inverse);
        let v_bounds = slope_bounds([a[v], b[v], c[v]], inverse);
        // Triangles that reach behind the origin have no such bounds.
        let unbounded = nearest.below(S::splat(1e-30));
        let [u_low, u_high, v_low, v_high] = bundle.slopes;
        let within = u_bounds[0].up_to(S::splat(u_high))
            & S::splat(u_low).up_to(u_bounds[1])
            & v_bounds[0].up_to(S::splat(v_high))
            & S::splat(v_low).up_to(v_bounds[1]);
        let left = (within | unbounded) & zero.up_to(farthest);
        if left == 0 {
            return 0;
        }
        u_bounds[0].store(&mut self.u[0]);
        u_bounds[1].store(&mut self.u[1]);
        v_bounds[0].store(&mut self.v[0]);
        v_bounds[1].store(&mut self.v[1]);
        nearest.mul(S::splat(1.0 - SLOPE_MARGIN)).store(&mut self.depth);
        let mut without_bounds = left & unbounded;
        while without_bounds != 0 {
            let lane = without_bounds.trailing_zeros() as usize;
            without_bounds &= without_bounds - 1;
            for bounds in [&mut self.u, &mut self.v] {
                bounds[0][lane] = f32::NEG_INFINITY;
                bounds[1][lane] = f32::INFINITY;
            }
            self.depth[lane] = 0.0;
        }

        // The planes through the origin and the edges: p × (q − p) for the edge from p to q.
        let mut reach_of_corners = [zero; 3];
        let mut reach_of_edges = [zero; 3];
        for edge in 0..3 {
            let (from, to) = (edge, (edge + 1) % 3);
            let mut e = [zero; 3];
            for axis in 0..3 {
                e[axis] = corners[to][axis].sub(corners[from][axis]);
                reach_of_edges[axis] = reach_of_edges[axis].max(e[axis].abs());
                reach_of_corners[axis] = reach_of_corners[axis].max(from_origin[from][axis].abs());
            }
            let p = &from_origin[from];
            p[1].mul_sub(e[2], p[2].mul(e[1])).store(&mut self.normals[edge][0]);
            p[2].mul_sub(e[0], p[0].mul(e[2])).store(&mut self.normals[edge][1]);
            p[0].mul_sub(e[1], p[1].mul(e[0])).store(&mut self.normals[edge][2]);
        }
        let mut products = zero;
        for axis in 0..3 {
            let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
            let minor =
                reach_of_corners[next].mul_add(reach_of_edges[last], reach_of_corners[last].mul(reach_of_edges[next]));
            products = minor.mul_add(S::splat(bundle.reach[axis]), products);
        }
        let underflow = UNDERFLOW_MARGIN * (1.0 + bundle.reach[0] + bundle.reach[1] + bundle.reach[2]);
        products.mul_add(S::splat(SIDE_MARGIN), S::splat(underflow)).store(&mut self.side_margin);
        left
    }
}

/// Bounds of three corners' slopes, from their places along an axis and their inverse depths.
#[inline(always)]
fn slope_bounds<S: Simd>(places: [S; 3], inverse_depths: [S; 3]) -> [S; 2] {
    let slopes = [places[0].mul(inverse_depths[0]), places[1].mul(inverse_depths[1]), places[2].mul(inverse_depths[2])];
    let low = slopes[0].min(slopes[1]).min(slopes[2]);
    let high = slopes[0].max(slopes[1]).max(slopes[2]);
    let margin = low.abs().max(high.abs()).mul_add(S::splat(SLOPE_MARGIN), S::splat(UNDERFLOW_MARGIN));
    [low.sub(margin), high.add(margin)]
}
