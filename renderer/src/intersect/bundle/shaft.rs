//! The bounds of a bundle's rays, and the boxes that they pass: nodes' children, and the groups and boxes in a tree's leaves.

use crate::{
    grid::tree::{
        boxes::{self, GROUP, GroupBatch, GroupBoxes, LeafCube, PlacedGroups},
        hierarchy::{CHILDREN, HierarchyNode},
    },
    simd::Simd,
};

/// Bounds of a bundle's rays, in finest cells from the first ray's origin; depths count from where the first ray begins.
#[derive(Default)]
pub(super) struct Shaft {
    /// The near and far side along each axis: twice the axis, and one more for the greatest side. All are below six, and two
    /// are those of one axis: groups and boxes are read without checks.
    pub(super) sides: [usize; 6],
    /// 1 or −1 along each axis, and where sides with coordinate 0 lie, moved out by the rounding error.
    pub(super) signs: [f32; 3],
    pub(super) bases: [f32; 6],
    /// The greatest depth.
    pub(super) end: f32,
    /// Least and greatest position at depth 0, of u and v, and slope.
    pub(super) starts: [[f32; 2]; 2],
    pub(super) slopes: [[f32; 2]; 2],
    /// The bits of a slot's number for axes along which rays go down: the slot whose child is nearest.
    pub(super) nearest: usize,
}

/// The sides of boxes in a shaft: near and far depth, then u and v.
#[derive(Default)]
#[repr(align(64))]
pub(super) struct BoxRows(pub(super) [[f32; CHILDREN]; 6]);

/// A map from the sides of groups in a leaf's cube to a shaft: a step along each axis, and where byte 0 of each side lies.
pub(super) struct LeafCubeInShaft {
    steps: [f32; 3],
    bases: [f32; 6],
}

impl Shaft {
    /// The area across the shaft where it ends or leaves the grid.
    #[inline(always)]
    pub(super) fn section(&self, extent: [u32; 3]) -> f32 {
        let depth = self.end.min(extent[self.sides[0] / 2] as f32);
        let mut section = 1.0;
        for across in 0..2 {
            let ([least, greatest], [from, to]) = (self.slopes[across], self.starts[across]);
            section *= (to - from) + (greatest - least) * depth;
        }
        section
    }

    /// Computes the sides of a node's boxes in the shaft. Returns a bit for each that it passes, at the slot's number with
    /// the bits of `nearest` inverted.
    #[inline(always)]
    pub(super) fn passed_children<S: Simd>(&self, node: &HierarchyNode, BoxRows(rows): &mut BoxRows) -> u32 {
        let mut passed = 0;
        let within = S::LANES - 1;
        for first in (0..CHILDREN).step_by(S::LANES) {
            let mut sides = [S::splat(0.0); 6];
            for side in 0..6 {
                let row = S::load(&node.sides[self.sides[side] % 6][first..]);
                sides[side] = row.mul_add(S::splat(self.signs[side / 2]), S::splat(self.bases[side]));
                sides[side].store(&mut rows[side][first..]);
            }
            let missed = self.miss_signs(sides).reflect((self.nearest & within) as u32).sign_mask();
            passed |= (!missed & ((1u64 << S::LANES) - 1) as u32) << (first ^ (self.nearest & !within));
        }
        passed
    }

    /// The bit in `passed` of the box with the largest surface, and those as large. The sides and bits are those of
    /// [`Shaft::passed_children`].
    #[inline(always)]
    pub(super) fn largest<S: Simd>(&self, BoxRows(rows): &BoxRows, passed: u32) -> u32 {
        const MOST_VECTORS: usize = 2;
        let within = S::LANES - 1;
        let (mut areas, mut greatest) = ([S::splat(0.0); MOST_VECTORS], S::splat(0.0));
        for first in (0..CHILDREN).step_by(S::LANES) {
            let mut sizes = [S::splat(0.0); 3];
            for axis in 0..3 {
                sizes[axis] = S::load(&rows[2 * axis + 1][first..]).sub(S::load(&rows[2 * axis][first..]));
            }
            let [k, u, v] = sizes;
            let area = k.mul_add(u, u.mul_add(v, v.mul(k))).reflect((self.nearest & within) as u32);
            let bits_first = first ^ (self.nearest & !within);
            let area = S::select(passed >> bits_first, area, S::splat(0.0));
            areas[bits_first / S::LANES % MOST_VECTORS] = area;
            greatest = greatest.max(area);
        }
        let (greatest, mut largest) = (S::splat(greatest.reduce_max()), 0);
        for first in (0..CHILDREN).step_by(S::LANES) {
            largest |= greatest.le(areas[first / S::LANES % MOST_VECTORS]) << first;
        }
        largest & passed
    }

    /// The map from the sides of groups in a leaf's cube to the shaft.
    #[inline(always)]
    pub(super) fn leaf_cube(&self, cube: LeafCube) -> LeafCubeInShaft {
        let (corner, step) = (cube.corner(), cube.size() as f32 * (1.0 / boxes::N_STEPS as f32));
        let (mut steps, mut bases) = ([0.0; 3], [0.0; 6]);
        for side in 0..6 {
            let (axis, sign) = (self.sides[side] / 2, self.signs[side / 2]);
            steps[side / 2] = sign * step;
            bases[side] = self.bases[side] + sign * (corner[axis % 3] as f32 - boxes::FIRST_STEP as f32 * step);
        }
        LeafCubeInShaft { steps, bases }
    }

    /// Computes the bounds of a leaf's groups in the shaft. Returns a bit for each that it passes.
    #[inline(always)]
    pub(super) fn passed_groups<S: Simd>(
        &self,
        cube: &LeafCubeInShaft,
        groups: GroupBatch<'_>,
        placed: &mut PlacedGroups,
    ) -> u32 {
        let mut passed = 0;
        for first in (0..GROUP).step_by(S::LANES) {
            // SAFETY: sides are those of three axes, and `first` is a multiple of the lanes.
            let of_cube = unsafe { groups.rows::<S>(self.sides, first) };
            let mut sides = [S::splat(0.0); 6];
            for side in 0..6 {
                sides[side] = of_cube[side].mul_add(S::splat(cube.steps[side / 2]), S::splat(cube.bases[side]));
                sides[side].store(&mut placed.sides[side][first..]);
            }
            for axis in 0..3 {
                let step = S::splat(cube.steps[axis] * (1.0 / f32::from(boxes::N_GROUP_STEPS)));
                of_cube[2 * axis + 1].sub(of_cube[2 * axis]).mul(step).store(&mut placed.steps[axis][first..]);
            }
            passed |= self.passed(sides) << first;
        }
        passed & groups.mask()
    }

    /// Computes the sides of a group's boxes in the shaft. Returns a bit for each that it passes.
    #[inline(always)]
    pub(super) fn passed_boxes<S: Simd>(
        &self,
        placed: &PlacedGroups,
        group: usize,
        boxes: GroupBoxes<'_>,
        BoxRows(rows): &mut BoxRows,
    ) -> u32 {
        let mut passed = 0;
        for first in (0..GROUP).step_by(S::LANES) {
            let sides = placed.boxes::<S>(self.sides, group, boxes, first);
            for side in 0..6 {
                sides[side].store(&mut rows[side][first..]);
            }
            passed |= self.passed(sides) << first;
        }
        passed & boxes.mask()
    }

    /// A bit for each lane whose box the shaft passes.
    #[inline(always)]
    fn passed<S: Simd>(&self, sides: [S; 6]) -> u32 {
        !self.miss_signs(sides).sign_mask() & ((1u64 << S::LANES) - 1) as u32
    }

    /// Sign bit set in lanes of boxes with these sides that the shaft misses.
    #[inline(always)]
    fn miss_signs<S: Simd>(&self, sides: [S; 6]) -> S {
        let near = sides[0].max(S::splat(0.0));
        let far = sides[1].min(S::splat(self.end));
        let mut missed = far.sub(near);
        for across in 0..2 {
            let ([least, greatest], [from, to]) = (self.slopes[across], self.starts[across]);
            let least = near.mul_add(S::splat(least), S::splat(from));
            let greatest = far.mul_add(S::splat(greatest), S::splat(to));
            missed = missed.or(sides[3 + 2 * across].sub(least)).or(greatest.sub(sides[2 + 2 * across]));
        }
        missed
    }
}

#[cfg(test)]
mod tests {
    use bytemuck::Zeroable;

    use super::*;
    use crate::simd::Portable;

    #[test]
    fn the_largest_of_the_boxes_that_are_passed_is_found() {
        // Cubes along the shaft, of which those with even numbers lie beside it.
        let mut node = HierarchyNode::zeroed();
        let size = |slot: usize| 1.0 + (slot * 5 % 16) as f32;
        for slot in 0..CHILDREN {
            let beside = if slot.is_multiple_of(2) { 100.0 } else { 0.0 };
            for (axis, low) in [1.0, beside - 0.5, -0.5].into_iter().enumerate() {
                (node.sides[2 * axis][slot], node.sides[2 * axis + 1][slot]) = (low, low + size(slot));
            }
        }
        let largest_slot = (1..CHILDREN).step_by(2).max_by(|&a, &b| size(a).total_cmp(&size(b))).unwrap();
        for nearest in [0, 2, 4, 8, 14] {
            let shaft = Shaft { sides: [0, 1, 2, 3, 4, 5], signs: [1.0; 3], end: 50.0, nearest, ..Shaft::default() };
            let mut rows = BoxRows::default();
            let passed = shaft.passed_children::<Portable>(&node, &mut rows);
            let slots: Vec<_> = (0..CHILDREN).filter(|&slot| passed >> (slot ^ nearest) & 1 == 1).collect();
            assert_eq!(slots, [1, 3, 5, 7, 9, 11, 13, 15]);
            assert_eq!(shaft.largest::<Portable>(&rows, passed), 1 << (largest_slot ^ nearest));
            assert_eq!(shaft.largest::<Portable>(&rows, 0), 0);
        }
    }
}
