//! Which of a node's 4×4×4 children a triangle touches.
//!
//! After Schwarz and Seidel, "Fast Parallel Surface and Solid Voxelization on GPUs" (2010): a box meets a triangle if
//! their bounds meet, the triangle's plane cuts the box, and in each of the three projections along an axis the box
//! reaches inside all three edges. That is exact.

use glam::DVec3;

/// How far boxes are enlarged, in finest cells: much more than traversal's rounding, and of no weight for speed.
pub(super) const DILATION: f64 = 1.0 / 8192.0;

/// A triangle made ready to be tested against unit cubes whose corners are integers.
struct TriangleOverlap {
    normal: DVec3,
    plane_low: f64,
    plane_high: f64,
    plane_slack: f64,
    /// For each edge and each projection (y, z), (z, x), (x, y): the inward normal and the offset.
    edges: [[EdgeFunction; 3]; 3],
}

#[derive(Clone, Copy)]
struct EdgeFunction {
    normal: [f64; 2],
    offset: f64,
}

impl TriangleOverlap {
    /// Corners in a space where the boxes are unit cubes within 0..span; `dilation` in the same unit.
    #[inline]
    fn new(corners: &[DVec3; 3], dilation: f64, span: f64) -> Self {
        let [a, b, c] = *corners;
        let edge_vectors = [b - a, c - b, a - c];
        let normal = edge_vectors[0].cross(edge_vectors[1]);
        let side = 1.0 + 2.0 * dilation;
        let reach = edge_vectors.iter().map(|e| e.abs().max_element()).fold(2.0 * span, f64::max);
        // What rounding can do to the sums below, for corners within reach.
        let edge_slack = reach * reach * (16.0 * f64::EPSILON);
        let plane_slack = edge_slack * reach;

        // The cube's corner is p − dilation; the corners nearest and farthest along the normal bound its distances.
        let at_corner = normal.dot(a + DVec3::splat(dilation));
        let farther = side * (normal.x.max(0.0) + normal.y.max(0.0) + normal.z.max(0.0));
        let nearer = side * (normal.x.min(0.0) + normal.y.min(0.0) + normal.z.min(0.0));

        let edges = [0, 1, 2].map(|edge| {
            [0, 1, 2].map(|axis| {
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let sign = if normal[axis] < 0.0 { -1.0 } else { 1.0 };
                let inward = [-edge_vectors[edge][v] * sign, edge_vectors[edge][u] * sign];
                let from = corners[edge];
                let at_corner = inward[0] * (from[u] + dilation) + inward[1] * (from[v] + dilation);
                let reach_of_box = side * (inward[0].max(0.0) + inward[1].max(0.0));
                EdgeFunction { normal: inward, offset: reach_of_box - at_corner + edge_slack }
            })
        });
        Self { normal, plane_low: nearer - at_corner, plane_high: farther - at_corner, plane_slack, edges }
    }

    /// Whether the cube from (x, y, z) to (x + 1, y + 1, z + 1), enlarged, meets the triangle; within its bounds.
    #[inline]
    fn meets(&self, cube: [u32; 3]) -> bool {
        let p = cube.map(f64::from);
        let distance = self.normal.dot(DVec3::from_array(p));
        if distance + self.plane_low > self.plane_slack || distance + self.plane_high < -self.plane_slack {
            return false;
        }
        self.edges.iter().all(|projections| {
            projections.iter().enumerate().all(|(axis, edge)| {
                edge.normal[0] * p[(axis + 1) % 3] + edge.normal[1] * p[(axis + 2) % 3] + edge.offset >= 0.0
            })
        })
    }
}

/// The children of a node that a triangle touches, as a mask with bit 16·z + 4·y + x.
///
/// Corners are in a space where the node spans 0..4 and its children are unit cubes.
#[inline]
pub(super) fn children(corners: &[DVec3; 3], dilation: f64) -> u64 {
    let [a, b, c] = *corners;
    let low = a.min(b).min(c) - dilation;
    let high = a.max(b).max(c) + dilation;
    if low.max_element() > 4.0 || high.min_element() < 0.0 {
        return 0;
    }
    let first = low.to_array().map(|x| x.clamp(0.0, 3.0) as u32);
    let last = high.to_array().map(|x| x.clamp(0.0, 3.0) as u32);
    if first == last {
        return 1 << child(first);
    }
    let triangle = TriangleOverlap::new(corners, dilation, 4.0);
    let mut mask = 0;
    for z in first[2]..=last[2] {
        for y in first[1]..=last[1] {
            for x in first[0]..=last[0] {
                mask |= u64::from(triangle.meets([x, y, z])) << child([x, y, z]);
            }
        }
    }
    mask
}

/// The number of a child by its place.
#[inline]
pub(super) fn child([x, y, z]: [u32; 3]) -> u32 {
    z << 4 | y << 2 | x
}

/// Calls `visit` with every unit cube within 0..dims that the triangle touches.
#[inline]
pub(super) fn for_each_cube(corners: &[DVec3; 3], dilation: f64, dims: [u32; 3], mut visit: impl FnMut([u32; 3])) {
    let [a, b, c] = *corners;
    let low = a.min(b).min(c) - dilation;
    let high = a.max(b).max(c) + dilation;
    let clamp = |x: f64, axis: usize| x.clamp(0.0, f64::from(dims[axis] - 1)) as u32;
    let first = [0, 1, 2].map(|axis| clamp(low[axis], axis));
    let last = [0, 1, 2].map(|axis| clamp(high[axis], axis));
    if first == last {
        return visit(first);
    }
    let size = [0, 1, 2].map(|axis| last[axis] - first[axis] + 1);
    let longest = size[0].max(size[1]).max(size[2]);
    if longest > 4 {
        // Blocks of 4×4×4 cubes, and blocks of those, so that space beside a large triangle is left out at once.
        let block = 4u32.pow((longest - 1).ilog(4));
        return descend(corners, dilation, first, block, last, &mut visit);
    }
    let corner = DVec3::from_array(first.map(f64::from));
    let triangle = TriangleOverlap::new(&corners.map(|c| c - corner), dilation, 4.0);
    for z in 0..size[2] {
        for y in 0..size[1] {
            for x in 0..size[0] {
                if triangle.meets([x, y, z]) {
                    visit([first[0] + x, first[1] + y, first[2] + z]);
                }
            }
        }
    }
}

/// Visits the unit cubes from `first` to `last` that lie in the 4×4×4 blocks at `first`, each of `block`³ cubes.
fn descend(
    corners: &[DVec3; 3],
    dilation: f64,
    first: [u32; 3],
    block: u32,
    last: [u32; 3],
    visit: &mut impl FnMut([u32; 3]),
) {
    let corner = DVec3::from_array(first.map(f64::from));
    let scale = 1.0 / f64::from(block);
    for child in super::bits(children(&corners.map(|c| (c - corner) * scale), dilation * scale)) {
        let place = [child & 3, child >> 2 & 3, child >> 4];
        let low = [0, 1, 2].map(|axis| first[axis] + place[axis] * block);
        if (0..3).any(|axis| low[axis] > last[axis]) {
            continue;
        }
        if block == 1 {
            visit(low);
        } else {
            descend(corners, dilation, low, block / 4, last, visit);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Clips the triangle to the box: what is left says whether they meet (Sutherland and Hodgman).
    fn meets_by_clipping(corners: &[DVec3; 3], min: DVec3, max: DVec3) -> bool {
        let mut polygon = corners.to_vec();
        for axis in 0..3 {
            for (sign, limit) in [(1.0, max[axis]), (-1.0, -min[axis])] {
                let inside = |p: DVec3| sign * p[axis] <= limit;
                let mut clipped = Vec::new();
                for (index, &p) in polygon.iter().enumerate() {
                    let q = polygon[(index + 1) % polygon.len()];
                    if inside(p) {
                        clipped.push(p);
                    }
                    if inside(p) != inside(q) {
                        let s = (limit - sign * p[axis]) / (sign * (q[axis] - p[axis]));
                        clipped.push(p + (q - p) * s);
                    }
                }
                polygon = clipped;
            }
        }
        !polygon.is_empty()
    }

    fn random(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 40) as f64 / (1u64 << 24) as f64
    }

    #[test]
    fn the_children_touched_are_those_that_clipping_finds() {
        let mut state = 7;
        let mut disagreements = 0;
        for round in 0..3000 {
            let size = [0.3, 2.0, 9.0, 400.0][round % 4];
            let centre = DVec3::from_array([0; 3].map(|_| random(&mut state) * 5.0 - 0.5));
            let mut corners =
                [0; 3].map(|_| centre + DVec3::from_array([0; 3].map(|_| (random(&mut state) - 0.5) * size)));
            if round % 7 == 0 {
                corners[2] = corners[0] + (corners[1] - corners[0]) * 0.3;
            }
            if round % 11 == 0 {
                corners = corners.map(|p| DVec3::new(p.x, p.y, 2.0));
            }
            let mask = children(&corners, DILATION);
            for bit in 0..64u32 {
                let min = DVec3::new(f64::from(bit & 3), f64::from(bit >> 2 & 3), f64::from(bit >> 4));
                let strictly = meets_by_clipping(&corners, min, min + 1.0);
                let loosely = meets_by_clipping(&corners, min - 3.0 * DILATION, min + 1.0 + 3.0 * DILATION);
                let touched = mask >> bit & 1 == 1;
                assert!(touched || !strictly, "lost: child {bit} of {corners:?}");
                disagreements += usize::from(touched && !loosely);
            }
        }
        assert!(disagreements < 20, "{disagreements} children too many");
    }
}
