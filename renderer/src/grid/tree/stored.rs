//! Trees in scene files.

use rayon::prelude::*;

use crate::{
    grid::tree::{
        BRICK_SIZE, LEVELS, Tree,
        boxes::leaf_cubes,
        hierarchy::{self, CHILDREN, Hierarchy, HierarchyNode, NONE},
    },
    scene_file::{
        fault::{Damage, Fault},
        sections::{SectionVisitor, expect},
    },
};

/// More bricks along an axis than any grid has; packets pass them one by one.
const MOST_BRICKS: u32 = 1024;

impl Tree {
    pub(in crate::grid) fn visit_sections<'a>(
        &'a mut self,
        visitor: &mut impl SectionVisitor<'a>,
    ) -> Result<(), Fault> {
        visitor.visit("bricks", &mut self.bricks)?;
        visitor.visit("nodes", &mut self.nodes)?;
        visitor.visit("leaves", &mut self.leaf_starts)?;
        self.items.visit_sections(visitor)?;
        visitor.visit("cubes", &mut self.leaf_cubes)?;
        self.boxes.visit_sections(visitor)?;
        visitor.visit("hierarchy nodes", &mut self.hierarchy.nodes)?;
        visitor.visit("triangle nodes", &mut self.hierarchy.triangle_nodes)
    }

    /// Checks the sizes for a mesh of so many triangles.
    pub(in crate::grid) fn check_sizes(&self, n_triangles: usize) -> Result<(), Damage> {
        let n_bricks = self.dims.iter().try_fold(1u64, |n, &along| n.checked_mul(along.into()));
        let fits = |axis: usize| {
            let n = self.dims[axis];
            (1..=MOST_BRICKS).contains(&n) && (1..=n * BRICK_SIZE).contains(&self.extent[axis])
        };
        expect(n_bricks == Some(self.bricks.len() as u64) && (0..3).all(fits), "bricks")?;
        let n_leaves = self.leaf_starts.len().checked_sub(1).ok_or(Damage::Content("leaves"))?;
        let (first, end) = (self.leaf_starts[0] as usize, self.leaf_starts[n_leaves] as usize);
        expect(first == 0 && n_leaves <= Self::LEAF as usize, "leaves")?;
        self.items.check_sizes(end, n_triangles)?;
        expect(self.leaf_cubes.len() == n_leaves, "cubes")?;
        expect(self.boxes.are_as_many_as(n_leaves, end, self.is_compact), "boxes")
    }

    pub(in crate::grid) fn check_contents(&self, n_triangles: usize) -> Result<(), Damage> {
        expect(self.leaf_starts.par_windows(2).all(|starts| starts[0] < starts[1]), "leaves")?;
        self.items.check_contents(self.n_items(), n_triangles)?;
        expect(self.is_a_tree(), "nodes")?;
        let cubes = leaf_cubes(self.dims, &self.bricks, &self.nodes, self.leaf_cubes.len());
        expect(*self.leaf_cubes == *cubes, "cubes")?;
        self.hierarchy.check_contents(self.leaf_cubes.len(), n_triangles)
    }

    /// Whether each node and each leaf belongs to one brick or node, which comes before it, and none is too deep.
    fn is_a_tree(&self) -> bool {
        let mut nodes = Children::new(self.nodes.len(), LEVELS);
        let mut leaves = Children::new(self.leaf_cubes.len(), LEVELS + 1);
        let has_brick = |&brick: &u32| match brick {
            Self::EMPTY => true,
            _ if brick & Self::LEAF != 0 => leaves.adopt((brick & !Self::LEAF).into(), 0),
            _ => nodes.adopt(brick.into(), 0),
        };
        if !self.bricks.iter().all(has_brick) {
            return false;
        }
        let are_parents = self.nodes.iter().enumerate().all(|(number, node)| {
            let Some(level) = nodes.level(number) else { return false };
            let child = |first: u32, n: u32| (0..n).map(move |nth| u64::from(first) + u64::from(nth));
            let (n_divided, n_leaves) = (node.divided.count_ones(), (node.occupied & !node.divided).count_ones());
            node.divided & !node.occupied == 0
                && child(node.first_node, n_divided).all(|it| it > number as u64 && nodes.adopt(it, level + 1))
                && child(node.first_leaf, n_leaves).all(|it| leaves.adopt(it, level + 1))
        });
        are_parents && leaves.are_all_adopted()
    }
}

impl Hierarchy {
    /// Checks that each node and each leaf has one parent, which comes before it, that no way is too long, and that all
    /// triangles exist.
    fn check_contents(&self, n_leaves: usize, n_triangles: usize) -> Result<(), Damage> {
        let is_over_triangles = !self.triangle_nodes.is_empty();
        let mut nodes = Children::new(self.nodes.len(), hierarchy::LEVELS as u32);
        let n_below = if is_over_triangles { self.triangle_nodes.len() } else { n_leaves };
        // Above leaves of a tree lie at most as many nodes as levels; triangle nodes are the last of them.
        let mut below = Children::new(n_below, hierarchy::LEVELS as u32 + u32::from(!is_over_triangles));
        let mut adopt = |entry: u32, after: Option<usize>, level: u32, nodes: &mut Children| {
            if entry & hierarchy::LEAF != 0 {
                below.adopt((entry & !hierarchy::LEAF).into(), level)
            } else {
                after.is_none_or(|after| entry as usize > after) && nodes.adopt(entry.into(), level)
            }
        };
        let has_root = self.root == NONE || adopt(self.root, None, 0, &mut nodes);
        let are_parents = self.nodes.iter().enumerate().all(|(number, node)| {
            let Some(level) = nodes.level(number) else { return false };
            let is_sound = |slot: usize| match node.children[slot] {
                NONE => node.is_empty_at(slot),
                child => adopt(child, Some(number), level + 1, &mut nodes),
            };
            (0..CHILDREN).all(is_sound)
        });
        expect(has_root && are_parents && below.are_all_adopted(), "hierarchy nodes")?;
        let are_triangles = |node: &HierarchyNode| {
            (0..CHILDREN).all(|slot| match node.children[slot] {
                NONE => node.is_empty_at(slot),
                triangle => (triangle as usize) < n_triangles,
            })
        };
        expect(self.triangle_nodes.par_iter().all(are_triangles), "triangle nodes")
    }
}

/// The levels of items of which each must be the child of exactly one.
struct Children {
    /// 0 for those that have no parent yet, else one more than the level.
    levels: Vec<u8>,
    n_levels: u32,
}

impl Children {
    /// Of `n` items on less than `n_levels` levels.
    fn new(n: usize, n_levels: u32) -> Self {
        Self { levels: vec![0; n], n_levels }
    }

    /// Gives an item its parent; false if it has one, does not exist, or is too deep.
    fn adopt(&mut self, item: u64, level: u32) -> bool {
        let levels = usize::try_from(item).ok().and_then(|item| self.levels.get_mut(item));
        levels.is_some_and(|of_item| std::mem::replace(of_item, level as u8 + 1) == 0 && level < self.n_levels)
    }

    /// The level of an item that has a parent.
    fn level(&self, item: usize) -> Option<u32> {
        u32::from(self.levels[item]).checked_sub(1)
    }

    fn are_all_adopted(&self) -> bool {
        !self.levels.contains(&0)
    }
}
