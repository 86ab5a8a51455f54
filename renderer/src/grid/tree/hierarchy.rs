//! A hierarchy of boxes over a scene, for rays that go alone or in bundles.
//!
//! A node has up to 16 children, whose boxes a ray is compared with all at once. They are made by the surface area heuristic
//! (MacDonald and Booth, "Heuristics for Ray Tracing Using Space Subdivision", 1990), so where little is there, ways are
//! short: over triangles as [`collapse`] finds best, over leaves from the top, until few of them are left.
//!
//! Below lie the leaves of a tree: nodes are few beside triangles, as a leaf holds dozens of them. Where triangles are
//! large beside leaves, each lies in several, and a ray is tested against it in each; where they are of all sizes, as in
//! architecture, boxes of neighbours are mostly empty. There, and in scenes that are small enough, the triangles themselves
//! lie below, which takes more memory and 0.55 to 0.95 of the time.

mod collapse;
pub(crate) mod pieces;
mod split;

use bytemuck::{Pod, Zeroable};
use glam::{DVec3, Vec3A};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{scene_file::section::Section, simd::Simd};
use collapse::BinaryNode;
use split::{Split, granule};

/// Most children of a node.
pub(crate) const CHILDREN: usize = 16;

/// Most nodes on the way from the root to a leaf: enough for 2³² leaves, with four to spare for ways of other lengths.
pub(crate) const LEVELS: usize = 12;

/// A root, a node or a leaf: an index, with [`LEAF`] set for leaves of a tree and for triangle nodes.
pub(crate) type Entry = u32;

/// Marks leaves among entries.
pub(crate) const LEAF: Entry = 1 << 31;

/// The root of no leaves.
pub(crate) const NONE: Entry = u32::MAX;

/// Most triangles of a scene that affords a hierarchy over them in any case: it takes 130 to 160 MB.
const FEW_TRIANGLES: usize = 1 << 22;

/// References for each triangle from which larger scenes afford it too, as do those of triangles of all sizes: rays take two
/// thirds of the time there.
const MANY_REFERENCES: f64 = 1.5;

/// Most leaves whose nodes [`collapse`] finds, because with eight times as many rays take as long, and most items that one
/// thread takes.
const FEW_ITEMS: usize = 4096;

/// Bytes for each piece of a triangle while a hierarchy over triangles is built: an item, its part of the binary tree, and of nodes
/// that are nearly full, twice: those of parts are put together.
const BYTES_PER_PIECE: u64 = 48 + 32 + 2 * 36;

/// Up to [`CHILDREN`] boxes.
///
/// Sides in bytes, after Ylitie, Karras and Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs"
/// (2017), would take 18 bytes a triangle less and 1.04 to 1.3 of the time, on the dragon.
///
/// Children are in slots: a slot's number has a bit for each axis, [`SLOT_BITS`], set for children that lie rather on the
/// upper side, so a ray meets the slots roughly in the order of their numbers with some bits inverted.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct HierarchyNode {
    /// Least x of each child, greatest x, then y and z, in finest cells. An empty slot has an inverted box.
    pub(crate) sides: [[f32; CHILDREN]; 6],
    pub(crate) children: [Entry; CHILDREN],
}

/// The bits of a slot's number for x, y and z. The bit that is left tells two children on the same side apart.
pub(crate) const SLOT_BITS: [u32; 3] = [2, 4, 8];

/// The hierarchy.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Hierarchy {
    pub(crate) root: Entry,
    #[serde(skip)]
    pub(crate) nodes: Section<HierarchyNode>,
    /// Nodes whose children are triangles, by index. None over the leaves of a tree.
    #[serde(skip)]
    pub(crate) triangle_nodes: Section<HierarchyNode>,
    /// Half the surface of the box that a ray is likely to pass: the mean of all items, weighted by itself.
    pub(crate) typical_area: f32,
}

/// The nodes of a hierarchy that is being built.
#[derive(Default)]
struct Nodes {
    nodes: Vec<HierarchyNode>,
    triangle_nodes: Vec<HierarchyNode>,
}

impl Default for Hierarchy {
    fn default() -> Self {
        Self { root: NONE, nodes: Section::default(), triangle_nodes: Section::default(), typical_area: 0.0 }
    }
}

/// A leaf of a tree, or a piece of a triangle, and its bounds.
#[derive(Clone, Copy)]
struct BoundedItem {
    bounds: Bounds,
    item: u32,
}

impl Hierarchy {
    /// Builds the hierarchy over a tree's leaves with these bounds in finest cells, in parallel.
    pub(crate) fn over_leaves(bounds: impl IndexedParallelIterator<Item = Bounds>) -> Self {
        Self::new::<false>(bounds.enumerate().map(|(leaf, bounds)| (leaf as u32, bounds)))
    }

    /// Builds the hierarchy over triangles, or [`pieces`] of them, by index, with these bounds in finest cells, in parallel.
    pub(crate) fn over_triangles(triangles: impl ParallelIterator<Item = (u32, Bounds)>) -> Self {
        Self::new::<true>(triangles)
    }

    fn new<const OF_TRIANGLES: bool>(items: impl ParallelIterator<Item = (u32, Bounds)>) -> Self {
        let mut items: Vec<_> = items.map(|(item, bounds)| BoundedItem { bounds, item }).collect();
        let areas = || items.iter().map(|item| f64::from(item.bounds.half_area()));
        let typical_area = areas().map(|area| area * area).sum::<f64>() / areas().sum::<f64>();
        // None without surfaces.
        let typical_area = (typical_area as f32).max(0.0);
        let mut nodes = Nodes::default();
        let root = nodes.append::<OF_TRIANGLES>(&mut items, LEVELS);
        let Nodes { mut nodes, mut triangle_nodes } = nodes;
        nodes.shrink_to_fit();
        triangle_nodes.shrink_to_fit();
        Self { root, nodes: nodes.into(), triangle_nodes: triangle_nodes.into(), typical_area }
    }

    /// Whether a hierarchy over triangles is worth its memory, of which so many bytes are left, in a tree with so many
    /// references to them; `is_even` if they are of similar sizes.
    pub(crate) fn is_over_triangles(n_triangles: usize, n_references: usize, is_even: bool, n_bytes_left: u64) -> bool {
        let are_large = n_references as f64 >= MANY_REFERENCES * n_triangles as f64;
        let is_faster = n_triangles <= FEW_TRIANGLES || are_large || !is_even;
        is_faster && n_triangles as u64 * BYTES_PER_PIECE <= n_bytes_left
    }

    /// Most pieces of so many triangles, for each of which there is memory.
    pub(crate) fn most_pieces(n_triangles: usize, n_bytes_left: u64) -> u64 {
        let n_triangles = n_triangles as u64;
        (n_triangles + n_triangles / 4).min(n_bytes_left / BYTES_PER_PIECE)
    }

    /// Hints that the node of an entry will be read soon. Nothing is checked: a hint may lead anywhere.
    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, entry: Entry) {
        const ROWS: usize = size_of::<HierarchyNode>() / size_of::<[f32; CHILDREN]>();
        let nodes = if entry & LEAF == 0 { &self.nodes } else { &self.triangle_nodes };
        let rows: &[[f32; CHILDREN]] = bytemuck::cast_slice(nodes);
        for row in 0..ROWS {
            S::prefetch(rows, ROWS * (entry & !LEAF) as usize + row);
        }
    }

    pub(crate) fn n_bytes(&self) -> usize {
        size_of_val(&*self.nodes) + size_of_val(&*self.triangle_nodes)
    }
}

impl Nodes {
    /// Appends the nodes of some items, at most [`CHILDREN`] to the power of `n_levels`; returns their root.
    fn append<const OF_TRIANGLES: bool>(&mut self, items: &mut [BoundedItem], n_levels: usize) -> Entry {
        if let Some(leaf) = self.append_leaf::<OF_TRIANGLES>(items) {
            return leaf;
        }
        // Where the binary tree of all triangles has too many levels, it is not made anew for each large part.
        let is_whole = OF_TRIANGLES && n_levels == LEVELS;
        if is_whole || items.len() <= FEW_ITEMS {
            let tree = BinaryNode::over::<OF_TRIANGLES>(items);
            if tree.n_levels::<OF_TRIANGLES>() <= n_levels {
                return self.append_collapsed::<OF_TRIANGLES>(items, &tree);
            }
        }
        let parts = divide(items, n_levels, granule::<OF_TRIANGLES>());
        let (mut of_parts, mut rest) = (Vec::with_capacity(parts.len()), items);
        for part in &parts {
            let (of_part, others) = rest.split_at_mut(part.n);
            rest = others;
            of_parts.push(of_part);
        }
        self.append_node(&parts, of_parts, |nodes, of_part| nodes.append::<OF_TRIANGLES>(of_part, n_levels - 1))
    }

    /// Appends the nodes of a binary tree over items; returns their root.
    fn append_collapsed<const OF_TRIANGLES: bool>(&mut self, items: &[BoundedItem], tree: &BinaryNode) -> Entry {
        let Part { first, n, .. } = tree.part;
        if let Some(leaf) = self.append_leaf::<OF_TRIANGLES>(&items[first..first + n]) {
            return leaf;
        }
        let children = tree.children();
        let parts: Vec<_> = children.iter().map(|child| child.part).collect();
        self.append_node(&parts, children, |nodes, child| nodes.append_collapsed::<OF_TRIANGLES>(items, child))
    }

    /// Appends a node with these parts, and what `append` adds for each of them, in parallel where items are many; returns its index.
    fn append_node<T: Send>(
        &mut self,
        parts: &[Part],
        of_parts: Vec<T>,
        append: impl Fn(&mut Self, T) -> Entry + Sync,
    ) -> Entry {
        let (node_idx, slots) = (self.nodes.len(), slots(parts));
        self.nodes.push(HierarchyNode::EMPTY);
        if parts.iter().map(|part| part.n).sum::<usize>() <= FEW_ITEMS {
            for ((part, slot), of_part) in parts.iter().zip(slots).zip(of_parts) {
                let child = append(self, of_part);
                self.nodes[node_idx].set_child(slot, child, &part.bounds);
            }
            return node_idx as Entry;
        }

        let subtree = |of_part| {
            let mut subtree = Self::default();
            (append(&mut subtree, of_part), subtree)
        };
        let subtrees: Vec<_> = of_parts.into_par_iter().map(subtree).collect();
        let n_nodes = |of: fn(&Self) -> usize| subtrees.iter().map(|(_, subtree)| of(subtree)).sum();
        self.nodes.reserve_exact(n_nodes(|subtree| subtree.nodes.len()));
        self.triangle_nodes.reserve_exact(n_nodes(|subtree| subtree.triangle_nodes.len()));
        for ((part, slot), (root, subtree)) in parts.iter().zip(slots).zip(subtrees) {
            // Nodes of a subtree count from its first one. A tree's leaves stay where they are: no triangle nodes are before.
            let (first, first_triangles) = (self.nodes.len() as Entry, self.triangle_nodes.len() as Entry);
            let moved = |entry: Entry| match entry {
                NONE => NONE,
                _ if entry & LEAF == 0 => entry + first,
                _ => entry + first_triangles,
            };
            let moved_node = |node: HierarchyNode| HierarchyNode { children: node.children.map(moved), ..node };
            self.nodes.extend(subtree.nodes.into_iter().map(moved_node));
            self.triangle_nodes.extend(subtree.triangle_nodes);
            self.nodes[node_idx].set_child(slot, moved(root), &part.bounds);
        }
        node_idx as Entry
    }

    /// The entry of items that need no node above them: a leaf, or the triangles of one node.
    fn append_leaf<const OF_TRIANGLES: bool>(&mut self, items: &[BoundedItem]) -> Option<Entry> {
        match items {
            [] => Some(NONE),
            [only] if !OF_TRIANGLES => Some(LEAF | only.item),
            _ if OF_TRIANGLES && items.len() <= CHILDREN => {
                let mut node = HierarchyNode::EMPTY;
                for (slot, item) in items.iter().enumerate() {
                    node.set_child(slot, item.item, &item.bounds);
                }
                self.triangle_nodes.push(node);
                Some(LEAF | (self.triangle_nodes.len() - 1) as Entry)
            }
            _ => None,
        }
    }
}

impl HierarchyNode {
    /// All boxes are inverted: no ray passes one.
    const EMPTY: Self = {
        let (low, high) = ([f32::INFINITY; CHILDREN], [f32::NEG_INFINITY; CHILDREN]);
        Self { sides: [low, high, low, high, low, high], children: [NONE; CHILDREN] }
    };

    /// Whether no ray passes the box of a slot.
    pub(super) fn is_empty_at(&self, slot: usize) -> bool {
        (0..6).all(|side| self.sides[side][slot] == Self::EMPTY.sides[side][slot])
    }

    /// Puts a child with its bounds into a slot.
    fn set_child(&mut self, slot: usize, child: Entry, bounds: &Bounds) {
        self.children[slot] = child;
        for axis in 0..3 {
            self.sides[2 * axis][slot] = bounds.low[axis];
            self.sides[2 * axis + 1][slot] = bounds.high[axis];
        }
    }
}

/// A box in finest cells.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    low: Vec3A,
    high: Vec3A,
}

impl Bounds {
    const EMPTY: Self = Self { low: Vec3A::INFINITY, high: Vec3A::NEG_INFINITY };

    #[cfg(test)]
    fn holds(&self, point: DVec3) -> bool {
        self.low.as_dvec3().cmple(point).all() && point.cmple(self.high.as_dvec3()).all()
    }

    /// The box from `low` to `high`, rounded outward.
    pub(crate) fn new(low: DVec3, high: DVec3) -> Self {
        // Not to subnormal numbers, as beside 0: for them Intel's processors resort to microcode, and every ray meets boxes at
        // the bounds of the grid.
        let down = |x: f64| (x as f32).next_down().min((x - f64::from(f32::MIN_POSITIVE)) as f32);
        let up = |x: f64| (x as f32).next_up().max((x + f64::from(f32::MIN_POSITIVE)) as f32);
        let low = Vec3A::new(down(low.x), down(low.y), down(low.z));
        Self { low, high: Vec3A::new(up(high.x), up(high.y), up(high.z)) }
    }

    fn of(leaves: &[BoundedItem]) -> Self {
        leaves.iter().fold(Self::EMPTY, |bounds, leaf| bounds.with(&leaf.bounds))
    }

    fn with(&self, other: &Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    /// Half the surface; 0 if the box is empty.
    fn half_area(&self) -> f32 {
        let size = (self.high - self.low).max(Vec3A::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }

    /// Twice the centre.
    fn centre(&self) -> Vec3A {
        self.low + self.high
    }
}

/// Leaves that follow each other.
#[derive(Clone, Copy)]
struct Part {
    first: usize,
    n: usize,
    bounds: Bounds,
}

impl Part {
    fn new(leaves: &[BoundedItem], first: usize, n: usize) -> Self {
        Self { first, n, bounds: Bounds::of(&leaves[first..first + n]) }
    }
}

/// Orders leaves into the parts of a node's children: the part with the largest surface is split until there are enough.
///
/// Where so many leaves are left that only full nodes can hold them, the parts have equal numbers.
fn divide(leaves: &mut [BoundedItem], n_levels: usize, granule: usize) -> Vec<Part> {
    let is_tight = CHILDREN.checked_pow(n_levels as u32 - 1).is_some_and(|most| leaves.len() > most);
    // Parts of up to 16 leaves make a node each: full ones are worth more than a shorter way.
    let smallest = if leaves.len() > CHILDREN { CHILDREN } else { 1 };
    let mut parts = vec![Part::new(leaves, 0, leaves.len())];
    while parts.len() < CHILDREN {
        let size = |part: &Part| if is_tight { part.n as f32 } else { part.bounds.half_area() };
        let divisible = (0..parts.len()).filter(|&index| parts[index].n > smallest);
        let Some(largest) = divisible.max_by(|&a, &b| size(&parts[a]).total_cmp(&size(&parts[b]))) else { break };
        let Part { first, n, bounds } = parts[largest];
        let of_part = &mut leaves[first..first + n];
        let split = if is_tight { Split::half(n, &bounds) } else { Split::best(of_part, granule) };
        let n_low = split.apply(of_part);
        parts[largest] = Part::new(leaves, first, n_low);
        parts.insert(largest + 1, Part::new(leaves, first + n_low, n - n_low));
    }
    parts
}

/// The slots of parts: one after the other, the part and the slot that lies farthest on the part's side of the centre.
fn slots(parts: &[Part]) -> Vec<usize> {
    let centre = parts.iter().map(|part| part.bounds.centre()).sum::<Vec3A>() / parts.len() as f32;
    let mut slots = vec![CHILDREN; parts.len()];
    let mut is_free = [true; CHILDREN];
    for _ in parts {
        let (mut best, mut farthest) = ((0, 0), f32::NEG_INFINITY);
        for part in (0..parts.len()).filter(|&part| slots[part] == CHILDREN) {
            let from_centre = parts[part].bounds.centre() - centre;
            for slot in (0..CHILDREN).filter(|&slot| is_free[slot]) {
                let side = |axis: usize| if slot as u32 & SLOT_BITS[axis] != 0 { 1.0 } else { -1.0 };
                let distance = from_centre.dot(Vec3A::new(side(0), side(1), side(2)));
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
        (0..n).map(|k| Bounds::new(along(k), along(k) + size(k))).collect()
    }

    /// Calls `visit` with each leaf or triangle, and the boxes on the way to it.
    fn walk(hierarchy: &Hierarchy, entry: Entry, way: &mut Vec<Bounds>, visit: &mut impl FnMut(u32, &[Bounds])) {
        let is_leaf = entry & LEAF != 0;
        let index = (entry & !LEAF) as usize;
        if is_leaf && hierarchy.triangle_nodes.is_empty() {
            return visit(index as u32, way);
        }
        let node = if is_leaf { &hierarchy.triangle_nodes[index] } else { &hierarchy.nodes[index] };
        for slot in (0..CHILDREN).filter(|&slot| node.children[slot] != NONE) {
            let side = |offset: usize| Vec3A::from([0, 2, 4].map(|row| node.sides[row + offset][slot]));
            way.push(Bounds { low: side(0), high: side(1) });
            if is_leaf {
                visit(node.children[slot], way);
            } else {
                walk(hierarchy, node.children[slot], way, visit);
            }
            way.pop();
        }
    }

    #[test]
    fn each_item_lies_in_all_boxes_on_the_only_way_to_it() {
        for n in [0, 1, 2, 16, 17, 255, 257, 5000, 70_000] {
            let boxes = boxes(n);
            let bounds = || boxes.par_iter().copied();
            let triangles = || bounds().enumerate().map(|(triangle, bounds)| (triangle as u32, bounds));
            for hierarchy in [Hierarchy::over_leaves(bounds()), Hierarchy::over_triangles(triangles())] {
                let mut found = vec![0; n];
                if hierarchy.root != NONE {
                    walk(&hierarchy, hierarchy.root, &mut Vec::new(), &mut |item, way| {
                        found[item as usize] += 1;
                        assert!(way.len() <= LEVELS, "{n}: {} nodes", way.len());
                        let Bounds { low, high } = boxes[item as usize];
                        let holds = |bounds: &Bounds| bounds.low.cmple(low).all() && high.cmple(bounds.high).all();
                        assert!(way.iter().all(holds), "{n}: item {item}");
                    });
                }
                assert!(found.iter().all(|&times| times == 1), "{n}");
            }
        }
    }

    #[test]
    fn no_way_is_too_long_where_splits_are_lopsided() {
        let place = |k: usize| DVec3::splat(1.01f64.powi(k as i32));
        let boxes: Vec<_> = (0..FEW_ITEMS).map(|k| Bounds::new(place(k), place(k) * 1.001)).collect();
        let mut items: Vec<_> = (0..).zip(boxes.clone()).map(|(item, bounds)| BoundedItem { bounds, item }).collect();
        let tree = BinaryNode::over::<false>(&mut items);
        assert!(tree.n_levels::<false>() > LEVELS);
        let hierarchy = Hierarchy::over_leaves(boxes.into_par_iter());
        walk(&hierarchy, hierarchy.root, &mut Vec::new(), &mut |_, way| assert!(way.len() <= LEVELS));
    }

    #[test]
    fn bounds_are_rounded_outward() {
        let (low, high) = (DVec3::new(0.1, -0.1, 1e-60), DVec3::new(0.2, 16_777_217.0, 0.0));
        let bounds = Bounds::new(low, high);
        assert!(bounds.low.as_dvec3().cmplt(low).all() && bounds.high.as_dvec3().cmpgt(high).all());
        for side in [bounds.low, bounds.high].map(|side| side.to_array()).as_flattened() {
            assert!(!side.is_subnormal(), "{side:e}");
        }
    }

    #[test]
    fn few_levels_hold_as_many_items_as_they_can() {
        let mut items: Vec<_> = (0..).zip(boxes(256)).map(|(item, bounds)| BoundedItem { bounds, item }).collect();
        let mut over_leaves = Nodes::default();
        over_leaves.append::<false>(&mut items, 2);
        assert_eq!(over_leaves.nodes.len(), 17);
        let mut over_triangles = Nodes::default();
        over_triangles.append::<true>(&mut items, 2);
        assert_eq!((over_triangles.nodes.len(), over_triangles.triangle_nodes.len()), (1, 16));
    }

    #[test]
    fn only_scenes_with_memory_to_spare_have_a_hierarchy_over_triangles() {
        let (small, scan) = ((1_000_000, 1_000_000, true), (10_000_000, 14_000_000, true));
        let (large_triangles, courtyard) = ((8_000_000, 13_000_000, true), (8_000_000, 11_000_000, false));
        let is_over_triangles =
            |(n, n_references, is_even), bytes| Hierarchy::is_over_triangles(n, n_references, is_even, bytes);
        assert!(is_over_triangles(small, 160_000_000) && !is_over_triangles(small, 50_000_000));
        assert!(is_over_triangles(large_triangles, u64::MAX) && is_over_triangles(courtyard, u64::MAX));
        assert!(!is_over_triangles(scan, u64::MAX));
        assert_eq!(Hierarchy::most_pieces(1_000_000, u64::MAX), 1_250_000);
        assert_eq!(Hierarchy::most_pieces(1_000_000, 120_000_000), 120_000_000 / BYTES_PER_PIECE);
    }
}
