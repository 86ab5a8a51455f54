//! A hierarchy of boxes over the leaves of a tree, for rays that go alone.
//!
//! A node has up to 16 children, whose boxes a ray is compared with all at once. Nodes are few beside triangles: a leaf of
//! the tree holds dozens of them. They are made from the top by the surface area heuristic (MacDonald and Booth, "Heuristics
//! for Ray Tracing Using Space Subdivision", 1990), so where little is there, ways are short.

use glam::DVec3;
use rayon::prelude::*;

/// Most children of a node.
pub(crate) const CHILDREN: usize = 16;

/// Most nodes on the way from the root to a leaf: enough for 2³² leaves, with four to spare for ways of other lengths.
pub(crate) const LEVELS: usize = 12;

/// A root, a node or a leaf: an index, with [`LEAF`] set for leaves.
pub(crate) type Entry = u32;

/// Marks leaves among entries.
pub(crate) const LEAF: Entry = 1 << 31;

/// The root of no leaves.
pub(crate) const NONE: Entry = u32::MAX;

/// Up to [`CHILDREN`] boxes.
///
/// Children are in slots: a slot's number has a bit for each axis, [`SLOT_BITS`], set for children that lie rather on the
/// upper side, so a ray meets the slots roughly in the order of their numbers with some bits inverted.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct HierarchyNode {
    /// Least x of each child, greatest x, then y and z, in finest cells. An empty slot has an inverted box.
    pub(crate) sides: [[f32; CHILDREN]; 6],
    pub(crate) children: [Entry; CHILDREN],
}

/// The bits of a slot's number for x, y and z. The bit that is left tells two children on the same side apart.
pub(crate) const SLOT_BITS: [u32; 3] = [2, 4, 8];

/// The hierarchy.
#[derive(Debug, PartialEq)]
pub(crate) struct Hierarchy {
    pub(crate) root: Entry,
    pub(crate) nodes: Vec<HierarchyNode>,
}

impl Default for Hierarchy {
    fn default() -> Self {
        Self { root: NONE, nodes: Vec::new() }
    }
}

/// A leaf and its bounds.
#[derive(Clone, Copy)]
struct BoundedLeaf {
    bounds: Bounds,
    leaf: u32,
}

impl Hierarchy {
    /// Builds the hierarchy of leaves with these bounds in finest cells, in parallel.
    pub(crate) fn new(bounds: impl IndexedParallelIterator<Item = Bounds>) -> Self {
        let leaf = |(leaf, bounds): (usize, Bounds)| BoundedLeaf { bounds, leaf: leaf as u32 };
        let mut leaves: Vec<_> = bounds.enumerate().map(leaf).collect();
        let mut nodes = Vec::new();
        let root = build(&mut leaves, LEVELS, &mut nodes);
        nodes.shrink_to_fit();
        Self { root, nodes }
    }

    pub(crate) fn n_bytes(&self) -> usize {
        size_of_val(&*self.nodes)
    }
}

/// Appends the nodes of some leaves, at most [`CHILDREN`] to the power of `n_levels`; returns their root.
fn build(leaves: &mut [BoundedLeaf], n_levels: usize, nodes: &mut Vec<HierarchyNode>) -> Entry {
    match leaves {
        [] => return NONE,
        [only] => return LEAF | only.leaf,
        _ => (),
    }
    let parts = divide(leaves, n_levels);
    let mut node = HierarchyNode::EMPTY;
    let slots = slots(&parts);
    let mut jobs = Vec::with_capacity(parts.len());
    let mut rest = leaves;
    for (part, &slot) in parts.iter().zip(&slots) {
        let (of_part, others) = rest.split_at_mut(part.n);
        rest = others;
        node.set_sides(slot, &part.bounds);
        jobs.push((slot, of_part));
    }

    // Few leaves are not worth a job each.
    const FEW: usize = 4096;
    let node_idx = nodes.len();
    nodes.push(node);
    if jobs.iter().map(|(_, part)| part.len()).sum::<usize>() <= FEW {
        for (slot, part) in jobs {
            nodes[node_idx].children[slot] = build(part, n_levels - 1, nodes);
        }
        return node_idx as Entry;
    }
    let subtree = |(slot, part)| {
        let mut nodes = Vec::new();
        (slot, build(part, n_levels - 1, &mut nodes), nodes)
    };
    let subtrees: Vec<_> = jobs.into_par_iter().map(subtree).collect();
    for (slot, root, of_subtree) in subtrees {
        // Nodes of a subtree count from its first one.
        let first = nodes.len() as Entry;
        let moved = |entry: Entry| if entry & LEAF == 0 { entry + first } else { entry };
        let moved_node = |node: HierarchyNode| HierarchyNode { children: node.children.map(moved), ..node };
        nodes.extend(of_subtree.into_iter().map(moved_node));
        nodes[node_idx].children[slot] = moved(root);
    }
    node_idx as Entry
}

impl HierarchyNode {
    /// All boxes are inverted: no ray passes one.
    const EMPTY: Self = {
        let (low, high) = ([f32::INFINITY; CHILDREN], [f32::NEG_INFINITY; CHILDREN]);
        Self { sides: [low, high, low, high, low, high], children: [NONE; CHILDREN] }
    };

    /// Gives a slot the bounds of a child, rounded outward.
    fn set_sides(&mut self, slot: usize, bounds: &Bounds) {
        for axis in 0..3 {
            self.sides[2 * axis][slot] = (bounds.low[axis] as f32).next_down();
            self.sides[2 * axis + 1][slot] = (bounds.high[axis] as f32).next_up();
        }
    }
}

/// A box in finest cells.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    pub(crate) low: DVec3,
    pub(crate) high: DVec3,
}

impl Bounds {
    const EMPTY: Self = Self { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY };

    fn of(leaves: &[BoundedLeaf]) -> Self {
        leaves.iter().fold(Self::EMPTY, |bounds, leaf| bounds.with(&leaf.bounds))
    }

    fn with(&self, other: &Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    /// Half the surface; 0 if the box is empty.
    fn half_area(&self) -> f64 {
        let size = (self.high - self.low).max(DVec3::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }

    /// Twice the centre.
    fn centre(&self) -> DVec3 {
        self.low + self.high
    }
}

/// Leaves that follow each other.
struct Part {
    first: usize,
    n: usize,
    bounds: Bounds,
}

impl Part {
    fn new(leaves: &[BoundedLeaf], first: usize, n: usize) -> Self {
        Self { first, n, bounds: Bounds::of(&leaves[first..first + n]) }
    }
}

/// Orders leaves into the parts of a node's children: the part with the largest surface is split until there are enough.
///
/// Where so many leaves are left that only full nodes can hold them, the parts have equal numbers.
fn divide(leaves: &mut [BoundedLeaf], n_levels: usize) -> Vec<Part> {
    let is_tight = CHILDREN.checked_pow(n_levels as u32 - 1).is_some_and(|most| leaves.len() > most);
    // The children of a node with more than 16 leaves are nodes too: full ones are worth more than a shorter way.
    let smallest = if leaves.len() > CHILDREN { CHILDREN } else { 1 };
    let mut parts = vec![Part::new(leaves, 0, leaves.len())];
    while parts.len() < CHILDREN {
        let size = |part: &Part| if is_tight { part.n as f64 } else { part.bounds.half_area() };
        let divisible = (0..parts.len()).filter(|&index| parts[index].n > smallest);
        let Some(largest) = divisible.max_by(|&a, &b| size(&parts[a]).total_cmp(&size(&parts[b]))) else { break };
        let Part { first, n, bounds } = parts[largest];
        let of_part = &mut leaves[first..first + n];
        let Split { axis, n_low, .. } = if is_tight { Split::half(n, &bounds) } else { Split::best(of_part) };
        let along = |leaf: &BoundedLeaf| leaf.bounds.centre()[axis];
        of_part.select_nth_unstable_by(n_low, |a, b| along(a).total_cmp(&along(b)));
        parts[largest] = Part::new(leaves, first, n_low);
        parts.insert(largest + 1, Part::new(leaves, first + n_low, n - n_low));
    }
    parts
}

/// A split of a part in two.
struct Split {
    axis: usize,
    /// Leaves on the low side.
    n_low: usize,
    /// Sum over both sides of area times leaves.
    cost: f64,
}

impl Split {
    /// Halves along the longest axis.
    fn half(n: usize, bounds: &Bounds) -> Self {
        let axis = (bounds.high - bounds.low).max_position();
        Self { axis, n_low: n / 2, cost: f64::INFINITY }
    }

    /// The best of the splits between 16 bins along each axis.
    fn best(leaves: &[BoundedLeaf]) -> Self {
        const N_BINS: usize = 16;
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for leaf in leaves {
            (low, high) = (low.min(leaf.bounds.centre()), high.max(leaf.bounds.centre()));
        }
        let n = leaves.len();
        // Multiples of 16 leaves make full nodes; those above are few.
        let granule = if n > CHILDREN { CHILDREN } else { 1 };
        let mut best = Self::half(n, &Bounds { low, high });
        best.n_low = best.n_low.next_multiple_of(granule);
        for axis in 0..3 {
            // Sort into bins of equal width.
            let bins_per_unit = N_BINS as f64 / (high[axis] - low[axis]).max(f64::MIN_POSITIVE);
            let mut bins = [(0, Bounds::EMPTY); N_BINS];
            for leaf in leaves {
                let bin = ((leaf.bounds.centre()[axis] - low[axis]) * bins_per_unit) as usize;
                let (n, bounds) = &mut bins[bin.min(N_BINS - 1)];
                (*n, *bounds) = (*n + 1, bounds.with(&leaf.bounds));
            }

            // Compare the splits between them.
            let mut areas_above = [0.0; N_BINS];
            let mut above = Bounds::EMPTY;
            for bin in (1..N_BINS).rev() {
                above = above.with(&bins[bin].1);
                areas_above[bin] = above.half_area();
            }
            let (mut n_below, mut below) = (0, Bounds::EMPTY);
            for bin in 1..N_BINS {
                (n_below, below) = (n_below + bins[bin - 1].0, below.with(&bins[bin - 1].1));
                let n_low = ((n_below + granule / 2) / granule).clamp(1, (n - 1) / granule) * granule;
                let cost = below.half_area() * n_low as f64 + areas_above[bin] * (n - n_low) as f64;
                if cost < best.cost {
                    best = Self { axis, n_low, cost };
                }
            }
        }
        best
    }
}

/// The slots of parts: one after the other, the part and the slot that lies farthest on the part's side of the centre.
fn slots(parts: &[Part]) -> Vec<usize> {
    let centre = parts.iter().map(|part| part.bounds.centre()).sum::<DVec3>() / parts.len() as f64;
    let mut slots = vec![CHILDREN; parts.len()];
    let mut is_free = [true; CHILDREN];
    for _ in parts {
        let (mut best, mut farthest) = ((0, 0), f64::NEG_INFINITY);
        for part in (0..parts.len()).filter(|&part| slots[part] == CHILDREN) {
            let from_centre = parts[part].bounds.centre() - centre;
            for slot in (0..CHILDREN).filter(|&slot| is_free[slot]) {
                let side = |axis: usize| if slot as u32 & SLOT_BITS[axis] != 0 { 1.0 } else { -1.0 };
                let distance = from_centre.dot(DVec3::new(side(0), side(1), side(2)));
                if distance > farthest {
                    (best, farthest) = ((part, slot), distance);
                }
            }
        }
        slots[best.0] = best.1;
        is_free[best.1] = false;
    }
    slots
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Boxes of many sizes, some the same, along a curve.
    fn boxes(n: usize) -> Vec<Bounds> {
        let along = |k: usize| DVec3::new((k * 7 % 1013) as f64, (k * k % 797) as f64, (k / 3) as f64);
        let size = |k: usize| DVec3::new(1.0, (k % 5) as f64, if k.is_multiple_of(97) { 500.0 } else { 0.3 });
        (0..n).map(|k| Bounds { low: along(k), high: along(k) + size(k) }).collect()
    }

    /// Calls `visit` with each leaf, the boxes on the way to it, and their number.
    fn walk(
        hierarchy: &Hierarchy,
        entry: Entry,
        way: &mut Vec<[[f32; 2]; 3]>,
        visit: &mut impl FnMut(u32, &[[[f32; 2]; 3]]),
    ) {
        if entry & LEAF != 0 {
            return visit(entry & !LEAF, way);
        }
        let node = &hierarchy.nodes[entry as usize];
        for slot in (0..CHILDREN).filter(|&slot| node.children[slot] != NONE) {
            way.push([0, 1, 2].map(|axis| [node.sides[2 * axis][slot], node.sides[2 * axis + 1][slot]]));
            walk(hierarchy, node.children[slot], way, visit);
            way.pop();
        }
    }

    #[test]
    fn each_leaf_lies_in_all_boxes_on_the_only_way_to_it() {
        for n in [1, 2, 16, 17, 255, 257, 5000, 70_000] {
            let boxes = boxes(n);
            let hierarchy = Hierarchy::new(boxes.par_iter().copied());
            let mut found = vec![0; n];
            walk(&hierarchy, hierarchy.root, &mut Vec::new(), &mut |leaf, way| {
                found[leaf as usize] += 1;
                assert!(way.len() <= LEVELS, "{n}: {} nodes", way.len());
                let Bounds { low, high } = boxes[leaf as usize];
                let holds =
                    |axis: usize, [from, to]: [f32; 2]| f64::from(from) <= low[axis] && high[axis] <= f64::from(to);
                assert!(way.iter().all(|sides| (0..3).all(|axis| holds(axis, sides[axis]))), "{n}: leaf {leaf}");
            });
            assert!(found.iter().all(|&times| times == 1), "{n}");
        }
        assert_eq!(Hierarchy::new(boxes(0).par_iter().copied()).root, NONE);
    }

    #[test]
    fn few_levels_hold_as_many_leaves_as_they_can() {
        let mut leaves: Vec<_> = (0..).zip(boxes(256)).map(|(leaf, bounds)| BoundedLeaf { bounds, leaf }).collect();
        let mut nodes = Vec::new();
        build(&mut leaves, 2, &mut nodes);
        assert_eq!(nodes.len(), 17);
    }
}
