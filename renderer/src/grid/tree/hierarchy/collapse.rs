//! The nodes of a binary tree over items, joined so that rays pass the fewest.
//!
//! A ray passes a node about as often as its surface is large. Which nodes have the least surface together is found from the
//! bottom, after Ylitie, Karras and Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs" (2017):
//! for each subtree and each number of roots, the cheapest forest of so many nodes, and all below, in its place.

use super::{
    BoundedItem, Bounds, CHILDREN, FEW_ITEMS, Part,
    split::{Split, granule},
};

/// Each node costs so many mean surfaces of items beside its own, so that nodes are full: without this, they take half as much
/// memory again, and rays pass up to a twentieth fewer.
const NODE_COST: f32 = 5.0;

/// Below so many levels, splits halve: cheaper ones may take off one item after the other, as of nested ones, and the way down
/// would exceed a thread's stack.
const MOST_UNEVEN_LEVELS: usize = 40;

/// A node of a binary tree over items, and all below it.
pub(super) struct BinaryNode {
    pub(super) part: Part,
    children: Option<Box<[Self; 2]>>,
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

impl BinaryNode {
    /// Orders items into a tree, in parallel. With `OF_TRIANGLES`, a node lies over up to [`CHILDREN`] of them.
    pub(super) fn over<const OF_TRIANGLES: bool>(items: &mut [BoundedItem]) -> Self {
        let mean_area = items.iter().map(|item| item.bounds.half_area()).sum::<f32>() / items.len() as f32;
        // Where no item has a surface, nodes are still worth saving.
        let node_cost = (NODE_COST * mean_area).max(f32::MIN_POSITIVE);
        Self::new::<OF_TRIANGLES>(items, 0, node_cost, 0)
    }

    /// The node over items that are numbered from `first` on, `depth` levels below the root.
    fn new<const OF_TRIANGLES: bool>(items: &mut [BoundedItem], first: usize, node_cost: f32, depth: usize) -> Self {
        let part = Part { first, n: items.len(), bounds: Bounds::of(items) };
        let own_cost = part.bounds.half_area() + node_cost;
        let alone = Forest { cost: if OF_TRIANGLES { own_cost } else { 0.0 }, n_roots: [0; 2] };
        let mut node = Self { part, children: None, forests: [alone; CHILDREN], below: alone };
        if part.n > granule::<OF_TRIANGLES>() {
            let split = if depth < MOST_UNEVEN_LEVELS {
                Split::best(items, granule::<OF_TRIANGLES>())
            } else {
                Split::half(part.n, &part.bounds)
            };
            let n_low = split.apply(items);
            let (low, high) = items.split_at_mut(n_low);
            let mut low = || Self::new::<OF_TRIANGLES>(low, first, node_cost, depth + 1);
            let mut high = || Self::new::<OF_TRIANGLES>(high, first + n_low, node_cost, depth + 1);
            let children = if part.n > FEW_ITEMS { rayon::join(low, high) } else { (low(), high()) };
            node.join(children.into(), own_cost);
        }
        node
    }

    /// Finds the cheapest forests of a node with two children.
    fn join(&mut self, children: [Self; 2], own_cost: f32) {
        let [first, second] = &children;
        let mut best = Forest { cost: f32::INFINITY, n_roots: [0; 2] };
        for n_roots in 2..=CHILDREN {
            for n_in_first in 1..n_roots {
                let n_in_second = n_roots - n_in_first;
                let cost = first.forests[n_in_first - 1].cost + second.forests[n_in_second - 1].cost;
                if cost < best.cost {
                    best = Forest { cost, n_roots: [n_in_first as u8, n_in_second as u8] };
                }
            }
            self.forests[n_roots - 1] = best;
        }
        self.children = Some(Box::new(children));
        self.below = best;
        let alone = Forest { cost: best.cost + own_cost, n_roots: [0; 2] };
        self.forests[0] = alone;
        for forest in &mut self.forests[1..] {
            if alone.cost <= forest.cost {
                *forest = alone;
            }
        }
    }

    /// The children of the node that is joined from this one and others below.
    pub(super) fn children(&self) -> Vec<&Self> {
        let mut children = Vec::with_capacity(CHILDREN);
        self.push_roots(self.below, &mut children);
        children
    }

    /// Appends the roots of a forest in the place of the node.
    fn push_roots<'a>(&'a self, forest: Forest, roots: &mut Vec<&'a Self>) {
        let Some(children) = self.children.as_ref().filter(|_| forest.n_roots != [0; 2]) else {
            return roots.push(self);
        };
        for (child, n_roots) in children.iter().zip(forest.n_roots) {
            child.push_roots(child.forests[usize::from(n_roots) - 1], roots);
        }
    }

    /// Nodes on the longest way down, with the node itself.
    pub(super) fn n_levels<const OF_TRIANGLES: bool>(&self) -> usize {
        if self.part.n <= granule::<OF_TRIANGLES>() {
            return usize::from(OF_TRIANGLES);
        }
        1 + self.children().into_iter().map(Self::n_levels::<OF_TRIANGLES>).max().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use std::{iter, ptr};

    use glam::DVec3;

    use super::*;

    /// Boxes of many sizes along a curve.
    fn items(n: u32) -> Vec<BoundedItem> {
        let low = |k: u32| DVec3::new(f64::from(k * 7 % 13), f64::from(k * k % 11), f64::from(k / 3));
        let size = |k: u32| DVec3::new(1.0, f64::from(k % 5), if k.is_multiple_of(6) { 9.0 } else { 0.3 });
        (0..n).map(|item| BoundedItem { bounds: Bounds::new(low(item), low(item) + size(item)), item }).collect()
    }

    impl BinaryNode {
        /// The cost of a node and all below if those nodes of the binary tree are kept for which `is_kept` holds; `None` if one has
        /// too many children.
        fn cost(&self, node_cost: f32, is_kept: &impl Fn(&Self) -> bool) -> Option<f32> {
            let (mut cost, mut n_children) = (self.part.bounds.half_area() + node_cost, 0);
            let mut below: Vec<_> = self.children.as_ref()?.iter().collect();
            while let Some(node) = below.pop() {
                match &node.children {
                    None => n_children += 1,
                    Some(_) if is_kept(node) => {
                        (n_children, cost) = (n_children + 1, cost + node.cost(node_cost, is_kept)?);
                    }
                    Some(children) => below.extend(children.iter()),
                }
            }
            (n_children <= CHILDREN).then_some(cost)
        }

        /// The nodes below that have children.
        fn inner_nodes(&self) -> Vec<&Self> {
            let with_children =
                self.children.iter().flat_map(|children| children.iter()).filter(|child| child.children.is_some());
            with_children.flat_map(|child| iter::once(child).chain(child.inner_nodes())).collect()
        }

        /// The nodes below that are not joined with their parent.
        fn kept(&self) -> Vec<&Self> {
            let children = self.children().into_iter().filter(|child| child.children.is_some());
            children.flat_map(|child| iter::once(child).chain(child.kept())).collect()
        }
    }

    #[test]
    fn no_other_nodes_cost_less() {
        for n in [17, 18] {
            let mut items = items(n);
            let mean_area = items.iter().map(|item| item.bounds.half_area()).sum::<f32>() / n as f32;
            let (tree, node_cost) = (BinaryNode::over::<false>(&mut items), NODE_COST * mean_area);
            let inner = tree.inner_nodes();
            let cost = |mask: u64| {
                let is_kept = |node: &BinaryNode| {
                    (0..).zip(&inner).any(|(bit, &of_bit)| mask >> bit & 1 == 1 && ptr::eq(of_bit, node))
                };
                tree.cost(node_cost, &is_kept)
            };
            let least = (0..1 << inner.len()).filter_map(cost).fold(f32::INFINITY, f32::min);
            let kept = tree.kept();
            let found = tree.cost(node_cost, &|node| kept.iter().any(|&of_kept| ptr::eq(of_kept, node))).unwrap();
            assert!(found <= least * (1.0 + 1e-5), "{n}: {found} instead of {least}");
        }
    }

    #[test]
    fn no_thread_runs_out_of_stack_where_items_are_nested() {
        let size = |k: u32| DVec3::splat(1e-30 * 1.001f64.powi(k as i32));
        let item = |item| BoundedItem { bounds: Bounds::new(DVec3::ZERO, size(item)), item };
        let tree = BinaryNode::over::<true>(&mut (0..80_000).map(item).collect::<Vec<_>>());
        fn depth(node: &BinaryNode) -> usize {
            1 + node.children.iter().flat_map(|children| children.iter()).map(depth).max().unwrap_or(0)
        }
        let most = MOST_UNEVEN_LEVELS + 20;
        assert!(depth(&tree) <= most, "{} levels", depth(&tree));
    }

    #[test]
    fn nodes_are_full_where_all_triangles_lie_in_a_point() {
        let item = |item| BoundedItem { bounds: Bounds::new(DVec3::ZERO, DVec3::ZERO), item };
        let tree = BinaryNode::over::<true>(&mut (0..256).map(item).collect::<Vec<_>>());
        let children = tree.children();
        assert!(children.len() == 16 && children.into_iter().all(|child| child.part.n == 16));
    }

    #[test]
    fn nodes_of_triangles_are_full_unless_they_lie_apart() {
        let sizes = |distance: f64| {
            let low = |k: u32| DVec3::new(f64::from(k) + if k < 20 { 0.0 } else { distance }, 0.0, 0.0);
            let item = |item: u32| BoundedItem { bounds: Bounds::new(low(item), low(item) + DVec3::ONE), item };
            let tree = BinaryNode::over::<true>(&mut (0..32).map(item).collect::<Vec<_>>());
            let mut sizes: Vec<_> = tree.children().into_iter().map(|child| child.part.n).collect();
            sizes.sort_unstable();
            sizes
        };
        assert_eq!(sizes(0.0), [16, 16]);
        assert_eq!(sizes(1e4), [4, 12, 16]);
    }
}
