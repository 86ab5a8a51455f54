//! The nodes over few items: those of a binary tree, joined so that rays pass the fewest.
//!
//! A ray passes a node about as often as its surface is large. Which nodes have the least surface together is found from the
//! bottom, after Ylitie, Karras and Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs" (2017):
//! for each subtree and each number of roots, the cheapest forest of so many nodes, and all below, in its place.

use super::{BoundedItem, CHILDREN, Part, Split, granule};

/// Each node costs so many mean surfaces of items beside its own, so that nodes are full: without this, they take half as much
/// memory again, and rays pass up to a twentieth fewer.
const NODE_COST: f32 = 5.0;

/// A binary tree over items. The children of a node come before it.
pub(super) struct BinaryTree {
    nodes: Vec<BinaryNode>,
    node_cost: f32,
}

struct BinaryNode {
    part: Part,
    children: Option<[usize; 2]>,
    /// The cheapest of up to one root, two, and so on.
    forests: [Forest; CHILDREN],
    /// The cheapest of up to [`CHILDREN`] roots that are not the node itself: its children.
    below: Forest,
}

/// Some nodes in the place of a subtree.
#[derive(Clone, Copy)]
struct Forest {
    cost: f32,
    /// How many of them lie in the first child, and in the second; none if the node itself is the only one.
    n_roots: [u8; 2],
}

impl BinaryTree {
    /// Orders items into a tree. With `OF_TRIANGLES`, a node lies over up to [`CHILDREN`] of them.
    pub(super) fn new<const OF_TRIANGLES: bool>(items: &mut [BoundedItem]) -> Self {
        let mean_area = items.iter().map(|item| item.bounds.half_area()).sum::<f32>() / items.len() as f32;
        // Where no item has a surface, nodes are still worth saving.
        let node_cost = (NODE_COST * mean_area).max(f32::MIN_POSITIVE);
        let mut tree = Self { nodes: Vec::new(), node_cost };
        tree.append::<OF_TRIANGLES>(items, 0, items.len());
        tree
    }

    /// Appends the nodes over `n` items from `first` on; returns their root.
    fn append<const OF_TRIANGLES: bool>(&mut self, items: &mut [BoundedItem], first: usize, n: usize) -> usize {
        let part = Part::new(items, first, n);
        let cost = if OF_TRIANGLES { part.bounds.half_area() + self.node_cost } else { 0.0 };
        let alone = Forest { cost, n_roots: [0; 2] };
        let mut node = BinaryNode { part, children: None, forests: [alone; CHILDREN], below: alone };
        if n > granule::<OF_TRIANGLES>() {
            let of_node = &mut items[first..first + n];
            let n_low = Split::best(of_node, granule::<OF_TRIANGLES>()).apply(of_node);
            let low = self.append::<OF_TRIANGLES>(items, first, n_low);
            let high = self.append::<OF_TRIANGLES>(items, first + n_low, n - n_low);
            self.join(&mut node, [low, high]);
        }
        self.nodes.push(node);
        self.nodes.len() - 1
    }

    /// Finds the cheapest forests of a node with two children.
    fn join(&self, node: &mut BinaryNode, children: [usize; 2]) {
        let [first, second] = children.map(|child| &self.nodes[child].forests);
        let mut best = Forest { cost: f32::INFINITY, n_roots: [0; 2] };
        for n_roots in 2..=CHILDREN {
            for n_in_first in 1..n_roots {
                let n_in_second = n_roots - n_in_first;
                let cost = first[n_in_first - 1].cost + second[n_in_second - 1].cost;
                if cost < best.cost {
                    best = Forest { cost, n_roots: [n_in_first as u8, n_in_second as u8] };
                }
            }
            node.forests[n_roots - 1] = best;
        }
        node.children = Some(children);
        node.below = best;
        let alone = Forest { cost: best.cost + node.part.bounds.half_area() + self.node_cost, n_roots: [0; 2] };
        node.forests[0] = alone;
        for forest in &mut node.forests[1..] {
            if alone.cost <= forest.cost {
                *forest = alone;
            }
        }
    }

    /// The node over all items.
    pub(super) fn root(&self) -> usize {
        self.nodes.len() - 1
    }

    /// The items of a node.
    pub(super) fn part(&self, node: usize) -> &Part {
        &self.nodes[node].part
    }

    /// The children of a node.
    pub(super) fn children(&self, node: usize) -> Vec<usize> {
        let mut children = Vec::with_capacity(CHILDREN);
        self.push_roots(node, self.nodes[node].below, &mut children);
        children
    }

    /// Appends the roots of a forest in the place of a node.
    fn push_roots(&self, node: usize, forest: Forest, roots: &mut Vec<usize>) {
        let Some(children) = self.nodes[node].children.filter(|_| forest.n_roots != [0; 2]) else {
            return roots.push(node);
        };
        for (child, n_roots) in children.into_iter().zip(forest.n_roots) {
            self.push_roots(child, self.nodes[child].forests[usize::from(n_roots) - 1], roots);
        }
    }

    /// Nodes on the longest way down from a node, with itself.
    pub(super) fn n_levels<const OF_TRIANGLES: bool>(&self, node: usize) -> usize {
        if self.part(node).n <= granule::<OF_TRIANGLES>() {
            return usize::from(OF_TRIANGLES);
        }
        1 + self.children(node).into_iter().map(|child| self.n_levels::<OF_TRIANGLES>(child)).max().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::grid::tree::hierarchy::Bounds;

    /// Boxes of many sizes along a curve.
    fn items(n: u32) -> Vec<BoundedItem> {
        let low = |k: u32| DVec3::new(f64::from(k * 7 % 13), f64::from(k * k % 11), f64::from(k / 3));
        let size = |k: u32| DVec3::new(1.0, f64::from(k % 5), if k.is_multiple_of(6) { 9.0 } else { 0.3 });
        (0..n).map(|item| BoundedItem { bounds: Bounds::new(low(item), low(item) + size(item)), item }).collect()
    }

    impl BinaryTree {
        /// The cost of a node and all below if those nodes of the binary tree are kept that have a bit in `kept`; `None` if one has
        /// too many children.
        fn cost(&self, node: usize, kept: u64) -> Option<f32> {
            let (mut cost, mut n_children) = (self.nodes[node].part.bounds.half_area() + self.node_cost, 0);
            let mut below = self.nodes[node].children?.to_vec();
            while let Some(node) = below.pop() {
                match self.nodes[node].children {
                    None => n_children += 1,
                    Some(_) if kept >> node & 1 == 1 => {
                        (n_children, cost) = (n_children + 1, cost + self.cost(node, kept)?);
                    }
                    Some(children) => below.extend(children),
                }
            }
            (n_children <= CHILDREN).then_some(cost)
        }

        /// A bit for each node that is not joined with its parent.
        fn kept(&self, node: usize) -> u64 {
            let children = self.children(node).into_iter().filter(|&child| self.nodes[child].children.is_some());
            children.fold(1 << node, |kept, child| kept | self.kept(child))
        }
    }

    #[test]
    fn no_other_nodes_cost_less() {
        for n in [17, 18] {
            let tree = BinaryTree::new::<false>(&mut items(n));
            let inner: Vec<_> = (0..tree.root()).filter(|&node| tree.nodes[node].children.is_some()).collect();
            let kept = |mask: u64| (0..).zip(&inner).fold(0, |kept, (bit, node)| kept | (mask >> bit & 1) << node);
            let all = (0..1 << inner.len()).filter_map(|mask| tree.cost(tree.root(), kept(mask)));
            let least = all.fold(f32::INFINITY, f32::min);
            let found = tree.cost(tree.root(), tree.kept(tree.root())).unwrap();
            assert!(found <= least * (1.0 + 1e-5), "{n}: {found} instead of {least}");
        }
    }

    #[test]
    fn nodes_are_full_where_all_triangles_lie_in_a_point() {
        let item = |item| BoundedItem { bounds: Bounds::new(DVec3::ZERO, DVec3::ZERO), item };
        let tree = BinaryTree::new::<true>(&mut (0..256).map(item).collect::<Vec<_>>());
        let children = tree.children(tree.root());
        assert!(children.len() == 16 && children.into_iter().all(|child| tree.part(child).n == 16));
    }

    #[test]
    fn nodes_of_triangles_are_full_unless_they_lie_apart() {
        let sizes = |distance: f64| {
            let low = |k: u32| DVec3::new(f64::from(k) + if k < 20 { 0.0 } else { distance }, 0.0, 0.0);
            let item = |item: u32| BoundedItem { bounds: Bounds::new(low(item), low(item) + DVec3::ONE), item };
            let tree = BinaryTree::new::<true>(&mut (0..32).map(item).collect::<Vec<_>>());
            let mut sizes: Vec<_> = tree.children(tree.root()).into_iter().map(|child| tree.part(child).n).collect();
            sizes.sort_unstable();
            sizes
        };
        assert_eq!(sizes(0.0), [16, 16]);
        assert_eq!(sizes(1e4), [4, 12, 16]);
    }
}
