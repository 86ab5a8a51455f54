//! Divides bricks into nodes and leaves, in parallel.
//!
//! The result does not depend on the number of threads: rules look at one brick only, and parts are joined in order.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::grid::tree::{
    BRICK_SIZE, LEVELS, Tree, TreeNode,
    boxes::GROUP,
    overlap::{self, DILATION},
    scatter::Scatter,
};

/// References of one job; nodes with more divide their children in parallel.
const REFERENCES_PER_JOB: usize = 1 << 15;

/// Cells with no more triangles than this are not divided: testing 16 boxes is faster than finding one more leaf.
/// Between 128 and 512 speed is flat, and memory falls as fewer triangles lie in several leaves. With 1,024 a scan of ten
/// million triangles takes a byte a triangle less, and a frame a tenth longer.
pub(crate) const LEAF_SIZE: usize = 512;

/// The same for a compact tree, in which fewer triangles lie in several leaves. With 8,192 a scan takes a 500th
/// less memory, and a frame 5 % longer.
pub(crate) const COMPACT_LEAF_SIZE: usize = 6144;

pub(crate) struct Builder<'a> {
    pub(crate) scatter: Scatter<'a>,
    /// Most triangles of a cell that is not divided.
    pub(crate) leaf_size: usize,
    /// References of all bricks before they are divided.
    pub(crate) n_in_bricks: u64,
    pub(crate) most_references: u64,
    /// Whether memory, not speed, sets `most_references`.
    pub(crate) is_memory_limited: bool,
    /// Whether a cell stayed undivided because of that.
    pub(crate) hit_memory_limit: AtomicBool,
}

impl Builder<'_> {
    /// Divides all bricks, whose `references` begin at `starts`, into [`Tree::bricks`] and the tree below them.
    pub(crate) fn divide(
        &self,
        starts: &[u32],
        mut references: Vec<u32>,
        progress: &(dyn Fn(f32) + Sync),
    ) -> (Vec<u32>, TreePart) {
        // Group bricks into jobs of similar size.
        let total = references.len();
        let mut jobs = Vec::new();
        let mut rest = &mut *references;
        let mut first = 0;
        for brick in 1..starts.len() {
            let size = (starts[brick] - starts[first]) as usize;
            if size >= REFERENCES_PER_JOB || brick + 1 == starts.len() {
                let (these, others) = rest.split_at_mut(size);
                jobs.push((first..brick, these));
                (first, rest) = (brick, others);
            }
        }

        // Divide the bricks of each job into a part of the tree.
        let done = AtomicU64::new(0);
        let parts: Vec<_> = jobs
            .into_par_iter()
            .map(|(bricks, references)| {
                let mut part = TreePart::default();
                let base = starts[bricks.start] as usize;
                let roots: Vec<u32> = bricks
                    .map(|brick| {
                        let range = starts[brick] as usize - base..starts[brick + 1] as usize - base;
                        self.divide_brick(&mut part, brick, &mut references[range])
                    })
                    .collect();
                // All parts wait in memory for each other.
                part.references.shrink_to_fit();
                let done = done.fetch_add(references.len() as u64, Relaxed) + references.len() as u64;
                progress(done as f32 / total as f32);
                (roots, part)
            })
            .collect();
        drop(references);

        // Join the parts in order: indices of nodes and leaves move up.
        let mut bricks = Vec::with_capacity(starts.len() - 1);
        let mut whole = TreePart::with_capacity(parts.iter().map(|(_, part)| part));
        let mut lists = Vec::with_capacity(parts.len());
        for (roots, part) in parts {
            let offset = whole.append(&part);
            lists.push(part.references);
            bricks.extend(roots.into_iter().map(|root| match root {
                Tree::EMPTY => Tree::EMPTY,
                leaf if leaf & Tree::LEAF != 0 => leaf + offset.leaf,
                node => node + offset.node,
            }));
        }
        whole.references = concat(lists);
        (bricks, whole)
    }

    /// Adds one brick to a part of the tree; returns its entry there.
    fn divide_brick(&self, part: &mut TreePart, brick: usize, references: &mut [u32]) -> u32 {
        if references.is_empty() {
            return Tree::EMPTY;
        }

        // Sort the references, which threads found in any order, and give the brick its quota of references.
        references.sort_unstable();
        let [x_dim, y_dim, _] = self.scatter.dims.map(|n| n as usize);
        let corner = [brick % x_dim, brick / x_dim % y_dim, brick / x_dim / y_dim].map(|b| b as u32 * BRICK_SIZE);
        let quota = references.len() as u128 * u128::from(self.most_references) / u128::from(self.n_in_bricks);
        let cell = BuildCell { corner, level: 0, most_references: quota as usize };

        // Make it a leaf or a node.
        match self.plan(references, &cell) {
            None => {
                self.push_leaf(part, &cell, references);
                (part.leaf_ends.len() as u32 - 1) | Tree::LEAF
            }
            Some(plan) => {
                let root = part.nodes.len();
                part.nodes.push(TreeNode::default());
                part.nodes[root] = self.emit_node(part, &cell, &plan);
                root as u32
            }
        }
    }

    /// Adds a leaf. Its references are ordered so that those of a group of boxes are close.
    fn push_leaf(&self, part: &mut TreePart, cell: &BuildCell, references: &[u32]) {
        if references.len() > GROUP {
            let corner = DVec3::from_array(cell.corner.map(f64::from));
            let within = |point: DVec3| (point - corner).clamp(DVec3::ZERO, DVec3::splat(f64::from(cell.size())));
            let mut placed: Vec<_> = references
                .iter()
                .map(|&triangle| {
                    let [a, b, c] = self.scatter.corners(triangle).unwrap_or_default();
                    let centre = (within(a.min(b).min(c)) + within(a.max(b).max(c))) * 0.5;
                    PlacedTriangle { centre: centre.as_vec3().to_array(), triangle }
                })
                .collect();
            group_neighbours(&mut placed);
            part.references.extend(placed.into_iter().map(|placed| placed.triangle));
        } else {
            part.references.extend_from_slice(references);
        }
        part.leaf_ends.push(part.references.len() as u32);
    }

    /// Distributes a cell's triangles among its children, if that pays.
    fn plan(&self, references: &[u32], cell: &BuildCell) -> Option<ChildLists> {
        if references.len() <= self.leaf_size || cell.level == LEVELS {
            return None;
        }

        // Find the children that each triangle overlaps, and count the triangles of each child.
        let scale = 1.0 / f64::from(cell.child_size());
        let mut counts = [0u32; 64];
        let mut masks = Vec::with_capacity(references.len());
        for &triangle in references {
            let corners = self.scatter.corners(triangle).expect("a rejected triangle is in no brick");
            let mask =
                overlap::overlapped_children(&overlap::corners_in_cube(&corners, cell.corner, scale), DILATION * scale);
            let mut left = mask;
            while left != 0 {
                counts[left.trailing_zeros() as usize] += 1;
                left &= left - 1;
            }
            masks.push(mask);
        }
        let mut starts = [0; 65];
        for child in 0..64 {
            starts[child + 1] = starts[child] + counts[child];
        }

        // A ray through the cell meets a child with probability 1/16 (the ratio of their surfaces), so dividing saves
        // tests only while the references grow less than 16 times; half of that pays the steps.
        let total = starts[64] as usize;
        if total >= 8 * references.len() {
            return None;
        }
        if total > cell.most_references {
            if self.is_memory_limited {
                self.hit_memory_limit.store(true, Relaxed);
            }
            return None;
        }

        // Write each child's list.
        let mut next = starts;
        let mut distributed = vec![0; total];
        for (&triangle, &mask) in references.iter().zip(&masks) {
            let mut left = mask;
            while left != 0 {
                let slot = &mut next[left.trailing_zeros() as usize];
                distributed[*slot as usize] = triangle;
                *slot += 1;
                left &= left - 1;
            }
        }
        Some(ChildLists { starts, references: distributed })
    }

    /// Adds the children of a planned node to a part; returns the node.
    fn emit_node(&self, part: &mut TreePart, cell: &BuildCell, plan: &ChildLists) -> TreeNode {
        // Decide for each child whether it is divided.
        let children: Vec<_> = (0..64).filter(|&child| !plan.of(child).is_empty()).collect();
        let plan_child = |&child: &u32| {
            let child_cell = cell.child(child, plan);
            let child_plan = self.plan(plan.of(child), &child_cell);
            (child, child_cell, child_plan)
        };
        let is_parallel = plan.references.len() > REFERENCES_PER_JOB;
        let planned: Vec<_> = if is_parallel {
            children.par_iter().map(plan_child).collect()
        } else {
            children.iter().map(plan_child).collect()
        };

        // Add the leaves, and room for the nodes, so that siblings follow each other.
        let mut node = TreeNode {
            first_node: part.nodes.len() as u32,
            first_leaf: part.leaf_ends.len() as u32,
            ..TreeNode::default()
        };
        for (child, child_cell, child_plan) in &planned {
            node.occupied |= 1 << child;
            match child_plan {
                None => self.push_leaf(part, child_cell, plan.of(*child)),
                Some(_) => {
                    node.divided |= 1 << child;
                    part.nodes.push(TreeNode::default());
                }
            }
        }

        // Fill in the nodes; large subtrees are built in parallel and appended in order.
        let divided = planned.into_iter().filter_map(|(_, cell, plan)| Some((cell, plan?)));
        if is_parallel {
            let subtrees: Vec<_> = divided
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|(cell, plan)| {
                    let mut subtree = TreePart::default();
                    (self.emit_node(&mut subtree, &cell, &plan), subtree)
                })
                .collect();
            for (index, (root, subtree)) in subtrees.into_iter().enumerate() {
                let offset = part.append(&subtree);
                part.references.extend(subtree.references);
                part.nodes[node.first_node as usize + index] = root.moved(&offset);
            }
        } else {
            for (index, (cell, plan)) in divided.enumerate() {
                part.nodes[node.first_node as usize + index] = self.emit_node(part, &cell, &plan);
            }
        }
        node
    }
}

struct BuildCell {
    /// Its lowest corner, in finest cells.
    corner: [u32; 3],
    /// 0 for a brick.
    level: u32,
    /// Most references of its leaves.
    most_references: usize,
}

impl BuildCell {
    fn size(&self) -> u32 {
        BRICK_SIZE >> (2 * self.level)
    }

    fn child_size(&self) -> u32 {
        self.size() / 4
    }

    fn child(&self, child: u32, plan: &ChildLists) -> Self {
        let position = overlap::child_position(child);
        let quota = plan.of(child).len() as u128 * self.most_references as u128 / plan.references.len() as u128;
        Self {
            corner: [0, 1, 2].map(|axis| self.corner[axis] + position[axis] * self.child_size()),
            level: self.level + 1,
            most_references: quota as usize,
        }
    }
}

struct ChildLists {
    starts: [u32; 65],
    references: Vec<u32>,
}

impl ChildLists {
    fn of(&self, child: u32) -> &[u32] {
        &self.references[self.starts[child as usize] as usize..self.starts[child as usize + 1] as usize]
    }
}

/// A part of a tree, with indices that count from its own beginning.
#[derive(Default)]
pub(crate) struct TreePart {
    pub(crate) nodes: Vec<TreeNode>,
    /// End of each leaf's references; they begin where those of the leaf before end.
    pub(crate) leaf_ends: Vec<u32>,
    pub(crate) references: Vec<u32>,
}

struct Offset {
    node: u32,
    leaf: u32,
}

impl TreePart {
    /// An empty part with room for the nodes and leaves of others.
    fn with_capacity<'a>(parts: impl Iterator<Item = &'a Self> + Clone) -> Self {
        Self {
            nodes: Vec::with_capacity(parts.clone().map(|part| part.nodes.len()).sum()),
            leaf_ends: Vec::with_capacity(parts.map(|part| part.leaf_ends.len()).sum()),
            references: Vec::new(),
        }
    }

    /// Appends the nodes and leaves of another; the caller adds its references.
    fn append(&mut self, other: &Self) -> Offset {
        let offset = Offset { node: self.nodes.len() as u32, leaf: self.leaf_ends.len() as u32 };
        let base = self.leaf_ends.last().copied().unwrap_or(0);
        self.nodes.extend(other.nodes.iter().map(|node| node.moved(&offset)));
        self.leaf_ends.extend(other.leaf_ends.iter().map(|end| base + end));
        offset
    }
}

/// A triangle of a leaf, and the centre of its bounds in the leaf's cube, from the cube's lowest corner, in finest cells.
struct PlacedTriangle {
    centre: [f32; 3],
    triangle: u32,
}

/// Orders triangles so that every [`GROUP`] of them are close, from the first on: divides them across the longest side of the
/// bounds of their centres, at a multiple of [`GROUP`] near the middle, and so on. Groups keep the order of the file, so
/// that numbers in the file take fewer bits.
fn group_neighbours(placed: &mut [PlacedTriangle]) {
    if placed.len() <= GROUP {
        placed.sort_unstable_by_key(|placed| placed.triangle);
        return;
    }
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for PlacedTriangle { centre, .. } in &*placed {
        (low, high) = (low.min(Vec3::from_array(*centre)), high.max(Vec3::from_array(*centre)));
    }
    let axis = (high - low).max_position();
    let middle = placed.len().div_ceil(GROUP) / 2 * GROUP;
    // Numbers decide between equal centres, so that the result is one, and the halves of a quadrangle stay together.
    placed.select_nth_unstable_by(middle, |a, b| {
        a.centre[axis].total_cmp(&b.centre[axis]).then(a.triangle.cmp(&b.triangle))
    });
    let (before, after) = placed.split_at_mut(middle);
    group_neighbours(before);
    group_neighbours(after);
}

/// Joins lists, in parallel: the first write to fresh memory waits for page faults.
fn concat(lists: Vec<Vec<u32>>) -> Vec<u32> {
    let mut all = vec![0; lists.iter().map(Vec::len).sum()];
    let mut rest = &mut *all;
    let mut copies = Vec::with_capacity(lists.len());
    for list in lists {
        let (part, others) = rest.split_at_mut(list.len());
        copies.push((part, list));
        rest = others;
    }
    copies.into_par_iter().for_each(|(part, list)| part.copy_from_slice(&list));
    all
}

impl TreeNode {
    fn moved(self, offset: &Offset) -> Self {
        Self { first_node: self.first_node + offset.node, first_leaf: self.first_leaf + offset.leaf, ..self }
    }
}
