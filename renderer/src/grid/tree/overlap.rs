//! Which of a node's 4×4×4 children a triangle overlaps.
//!
//! After Schwarz and Seidel, "Fast Parallel Surface and Solid Voxelization on GPUs" (2010): a box meets a triangle if
//! their bounds meet, the triangle's plane cuts the box, and in each of the three projections along an axis the box
//! reaches inside all three edges. That is exact.

use glam::DVec3;

/// Enlargement of boxes, in finest cells: far above the rounding errors of traversal, too small to cost speed.
pub(crate) const DILATION: f64 = 1.0 / 8192.0;

/// Difference of child indices for a step along x, y and z.
const STRIDES: [u32; 3] = [1, 4, 16];

/// Masks of the first row of four children along x, y and z.
const ROWS: [u64; 3] = [0xf, 0x1111, 0x0001_0001_0001_0001];

/// The children of a node that a triangle overlaps, as a mask with bit 16·z + 4·y + x.
///
/// Corners are in a space where the node spans 0..4 and its children are unit cubes.
//
// No closures: they are not inlined, and a build spends most of its time here.
#[inline]
pub(crate) fn overlapped_children(corners: &[DVec3; 3], dilation: f64) -> u64 {
    // Begin with the children that the triangle's bounds overlap.
    let [a, b, c] = *corners;
    let (low, high) = (a.min(b).min(c) - dilation, a.max(b).max(c) + dilation);
    if low.max_element() > 4.0 || high.min_element() < 0.0 {
        return 0;
    }
    let first = low.clamp(DVec3::ZERO, LAST_CHILD).as_uvec3().to_array();
    let last = high.clamp(DVec3::ZERO, LAST_CHILD).as_uvec3().to_array();
    let mut mask = block(first, last);

    // Find the axes along which the triangle is thicker than one layer of cubes; a triangle within a row overlaps all.
    let mut is_thick = [false; 3];
    for axis in 0..3 {
        is_thick[axis] = low[axis] < f64::from(first[axis]) || high[axis] > f64::from(first[axis] + 1);
    }
    let n_thick = is_thick[0] as u32 + is_thick[1] as u32 + is_thick[2] as u32;
    if n_thick <= 1 {
        return mask;
    }

    // Bound the rounding errors of the sums below.
    let edges = [b - a, c - b, a - c];
    let normal = edges[0].cross(edges[1]);
    let longest_edge = edges[0].abs().max(edges[1].abs()).max(edges[2].abs()).max_element();
    let longest = longest_edge.max(8.0);
    let edge_slack = longest * longest * (16.0 * f64::EPSILON);
    let side = 1.0 + 2.0 * dilation;

    // Drop cubes that the triangle misses in a projection along an axis.
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        // For a layer of cubes only the projection across it matters: in the others it is a row.
        if n_thick == 2 && is_thick[axis] {
            continue;
        }

        // Set up the edges' inward normals in the projection, and the distance of each cube's innermost corner.
        let sign = if normal[axis] < 0.0 { -1.0 } else { 1.0 };
        let (mut along_u, mut along_v, mut offset) = ([0.0; 3], [0.0; 3], [0.0; 3]);
        for edge in 0..3 {
            let (inward_u, inward_v) = (-edges[edge][v] * sign, edges[edge][u] * sign);
            let from = corners[edge] + dilation;
            let at_corner = inward_u * from[u] + inward_v * from[v];
            let innermost_offset = side * (inward_u.max(0.0) + inward_v.max(0.0));
            (along_u[edge], along_v[edge]) = (inward_u, inward_v);
            offset[edge] = innermost_offset - at_corner + edge_slack;
        }

        // Test all columns of cubes against the three edges.
        let mut projected_mask = 0;
        for child_v in first[v]..=last[v] {
            for child_u in first[u]..=last[u] {
                let (x, y) = (f64::from(child_u), f64::from(child_v));
                let is_inside = (along_u[0] * x + along_v[0] * y + offset[0] >= 0.0)
                    & (along_u[1] * x + along_v[1] * y + offset[1] >= 0.0)
                    & (along_u[2] * x + along_v[2] * y + offset[2] >= 0.0);
                projected_mask |= (u64::from(is_inside) * ROWS[axis]) << (child_u * STRIDES[u] + child_v * STRIDES[v]);
            }
        }
        mask &= projected_mask;
    }
    if n_thick == 2 {
        return mask;
    }

    // Drop cubes that the plane misses: their corners nearest and farthest along the normal lie on one side.
    let slack = edge_slack * longest;
    let at_corner = normal.dot(a + dilation);
    let farther = side * normal.max(DVec3::ZERO).element_sum() - at_corner + slack;
    let nearer = side * normal.min(DVec3::ZERO).element_sum() - at_corner - slack;
    let mut left = mask;
    while left != 0 {
        let child = left.trailing_zeros();
        left &= left - 1;
        let [x, y, z] = child_position(child);
        let distance = normal.x * f64::from(x) + normal.y * f64::from(y) + normal.z * f64::from(z);
        mask &= !(u64::from(distance + nearer > 0.0 || distance + farther < 0.0) << child);
    }
    mask
}

/// Mask of the block of children from `first` to `last`.
#[inline]
fn block(first: [u32; 3], last: [u32; 3]) -> u64 {
    let along_x = (0xf << first[0]) & (0xf >> (3 - last[0]));
    let along_y = (0xffff << (4 * first[1])) & (0xffff >> (4 * (3 - last[1])));
    let along_z = (u64::MAX << (16 * first[2])) & (u64::MAX >> (16 * (3 - last[2])));
    (along_x * 0x1111_1111_1111_1111) & (along_y * ROWS[2]) & along_z
}

const LAST_CHILD: DVec3 = DVec3::splat(3.0);

/// Position of child number z·16 + y·4 + x, 0..4 along each axis.
#[inline]
pub(crate) fn child_position(child: u32) -> [u32; 3] {
    [child & 3, child >> 2 & 3, child >> 4]
}

/// Corners relative to `corner`, scaled.
#[inline]
pub(crate) fn corners_in_cube(corners: &[DVec3; 3], corner: [u32; 3], scale: f64) -> [DVec3; 3] {
    let corner = DVec3::new(f64::from(corner[0]), f64::from(corner[1]), f64::from(corner[2]));
    [(corners[0] - corner) * scale, (corners[1] - corner) * scale, (corners[2] - corner) * scale]
}

/// Calls `visit` with every unit cube within 0..dims that the triangle overlaps.
#[inline]
pub(crate) fn for_each_cube(corners: &[DVec3; 3], dilation: f64, dims: [u32; 3], mut visit: impl FnMut([u32; 3])) {
    let [a, b, c] = *corners;
    let end = DVec3::new(f64::from(dims[0] - 1), f64::from(dims[1] - 1), f64::from(dims[2] - 1));
    let low = (a.min(b).min(c) - dilation).clamp(DVec3::ZERO, end);
    let high = (a.max(b).max(c) + dilation).clamp(DVec3::ZERO, end);
    let (first, last) = (low.as_uvec3().to_array(), high.as_uvec3().to_array());
    if first == last {
        return visit(first);
    }
    // Begin with blocks of 4ⁿ cubes, so that empty space beside a large triangle is dropped at once.
    let longest = (last[0] - first[0]).max(last[1] - first[1]).max(last[2] - first[2]);
    visit_overlapped(corners, dilation, first, 4u32.pow(longest.ilog(4)), last, &mut visit);
}

/// Visits the unit cubes from `first` to `last` that lie in the 4×4×4 blocks at `first`, each of `block`³ cubes.
#[inline]
fn visit_overlapped(
    corners: &[DVec3; 3],
    dilation: f64,
    first: [u32; 3],
    block: u32,
    last: [u32; 3],
    visit: &mut impl FnMut([u32; 3]),
) {
    let scale = 1.0 / f64::from(block);
    let mut left = overlapped_children(&corners_in_cube(corners, first, scale), dilation * scale);
    while left != 0 {
        let [x, y, z] = child_position(left.trailing_zeros());
        left &= left - 1;
        let low = [first[0] + x * block, first[1] + y * block, first[2] + z * block];
        if low[0] > last[0] || low[1] > last[1] || low[2] > last[2] {
            continue;
        }
        if block == 1 {
            visit(low);
        } else {
            visit_overlapped(corners, dilation, low, block / 4, last, visit);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether a part of the triangle remains when it is clipped to the box (Sutherland and Hodgman).
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
    fn the_children_overlapped_are_those_that_clipping_finds() {
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
            let mask = overlapped_children(&corners, DILATION);
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
