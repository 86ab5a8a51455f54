//! Builds a grid: triangles into bricks, then each brick by itself, all in parallel.
//!
//! The result does not depend on the number of threads: bricks are divided by rules that look at nothing but the brick,
//! and put together in order.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::{
    BRICK_SIZE, CELLS_PER_BRICK, Grid, GridOptions, InstructionSet, LEVELS, Node,
    overlap::{self, DILATION},
    resolution::{CellSpace, resolution},
};
use crate::{mesh::Mesh, traced::TracedMesh};

/// Triangles that one task puts into bricks.
const TRIANGLES_PER_TASK: usize = 1 << 14;

/// References that one task divides, and above which the children of one node are divided in parallel.
const REFERENCES_PER_TASK: usize = 1 << 15;

/// Cubes that hold no more than this are not divided. Packets test 16 triangles as fast as they find one more leaf, so
/// the fastest is far above what single rays would like; memory falls with it.
const LEAF_SIZE: usize = 48;

impl Grid {
    /// Builds the grid of a mesh, and orders the mesh by it. `progress` is told now and then what part is done, from 0 to 1, from any thread.
    pub fn build(mesh: Mesh, options: &GridOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        let bounds = mesh.bounds();
        if bounds.is_empty() {
            return Self::empty(mesh);
        }
        let n_triangles = mesh.triangles.len() - mesh.n_rejected;
        let corner = |corner: [f32; 3]| Vec3::from_array(corner).as_dvec3();
        let (cells, cell_size) = resolution(corner(bounds.max) - corner(bounds.min), n_triangles, options.density);

        let mut bricks_in_cells = CELLS_PER_BRICK;
        // Room for triangles that each lie in several bricks; large ones are met with larger bricks.
        let most = (4 * n_triangles as u64 + (1 << 16)).min(u64::from(u32::MAX));
        let (builder, counts) = loop {
            let builder = Builder {
                mesh: &mesh,
                space: CellSpace::new(&bounds, cell_size * f64::from(bricks_in_cells) / f64::from(BRICK_SIZE)),
                dims: cells.map(|n| n.div_ceil(bricks_in_cells)),
                n_triangles,
            };
            if let Some(counts) = builder.count(most) {
                break (builder, counts);
            }
            bricks_in_cells *= 2;
        };
        progress(0.15);
        let (starts, references) = builder.fill(counts);
        progress(0.3);
        let (space, dims) = (builder.space, builder.dims);
        let (bricks, piece) = builder.divide(&starts, references, &|done| progress(0.3 + 0.6 * done));
        let Piece { nodes, leaf_ends, mut references } = piece;
        let mut leaf_starts = leaf_ends;
        leaf_starts.insert(0, 0);
        let mesh = TracedMesh::new(mesh, &mut references);
        let instructions = InstructionSet::best();
        Self { space, dims, bricks, nodes, leaf_starts, references, mesh, instructions }
    }

    fn empty(mesh: Mesh) -> Self {
        Self {
            space: CellSpace::new(&crate::mesh::Aabb { min: [0.0; 3], max: [0.0; 3] }, 1.0),
            dims: [1; 3],
            bricks: vec![Self::EMPTY],
            nodes: Vec::new(),
            leaf_starts: vec![0],
            references: Vec::new(),
            mesh: TracedMesh::new(mesh, &mut []),
            instructions: InstructionSet::best(),
        }
    }
}

struct Builder<'a> {
    mesh: &'a Mesh,
    space: CellSpace,
    dims: [u32; 3],
    n_triangles: usize,
}

impl Builder<'_> {
    fn corners(&self, triangle: u32) -> Option<[DVec3; 3]> {
        let corners = self.mesh.corners(triangle as usize)?;
        Some(corners.map(|corner| self.space.point(Vec3::from_array(corner).as_dvec3())))
    }

    /// Whether two of a triangle's corners are one point, so that no ray hits it: a polygon can have millions of these in
    /// one place, where nothing would tell them apart.
    fn is_seen_by_no_ray(&self, triangle: u32) -> bool {
        self.mesh.corners(triangle as usize).is_none_or(|[a, b, c]| a == b || b == c || c == a)
    }

    /// Calls `visit` with the brick and the triangle of every pair that touches, in parallel.
    /// It stops early when a task's call returns false.
    fn for_each_in_brick(&self, after_task: impl Fn() -> bool + Sync, visit: impl Fn(usize, u32) + Sync) -> bool {
        let n_tasks = self.mesh.triangles.len().div_ceil(TRIANGLES_PER_TASK);
        let scale = 1.0 / f64::from(BRICK_SIZE);
        (0..n_tasks).into_par_iter().all(|task| {
            let end = ((task + 1) * TRIANGLES_PER_TASK).min(self.mesh.triangles.len());
            for triangle in (task * TRIANGLES_PER_TASK) as u32..end as u32 {
                if self.is_seen_by_no_ray(triangle) {
                    continue;
                }
                let Some(corners) = self.corners(triangle) else { continue };
                overlap::for_each_cube(&corners.map(|c| c * scale), DILATION * scale, self.dims, |[x, y, z]| {
                    let brick = (z as usize * self.dims[1] as usize + y as usize) * self.dims[0] as usize + x as usize;
                    visit(brick, triangle);
                });
            }
            after_task()
        })
    }

    /// References of each brick, or `None` if there are more than `most` in all.
    fn count(&self, most: u64) -> Option<Vec<AtomicU32>> {
        let n_bricks = self.dims.iter().map(|&n| n as usize).product();
        let counts: Vec<_> = (0..n_bricks).map(|_| AtomicU32::new(0)).collect();
        let total = AtomicU64::new(0);
        self.for_each_in_brick(
            || total.load(Relaxed) <= most,
            |brick, _| {
                counts[brick].fetch_add(1, Relaxed);
                total.fetch_add(1, Relaxed);
            },
        )
        .then_some(counts)
    }

    /// The triangles of each brick, ascending, and where each brick's begin.
    fn fill(&self, counts: Vec<AtomicU32>) -> (Vec<u32>, Vec<u32>) {
        let mut starts = Vec::with_capacity(counts.len() + 1);
        let mut total = 0;
        for count in &counts {
            starts.push(total);
            total += count.swap(total, Relaxed);
        }
        starts.push(total);
        let next = counts;
        let filled: Vec<_> = (0..total).map(|_| AtomicU32::new(0)).collect();
        self.for_each_in_brick(
            || true,
            |brick, triangle| filled[next[brick].fetch_add(1, Relaxed) as usize].store(triangle, Relaxed),
        );
        let references = filled.into_iter().map(AtomicU32::into_inner).collect();
        (starts, references)
    }

    fn divide(&self, starts: &[u32], mut references: Vec<u32>, progress: &(dyn Fn(f32) + Sync)) -> (Vec<u32>, Piece) {
        let total = references.len();
        let mut tasks = Vec::new();
        let mut rest = &mut *references;
        let mut first = 0;
        for brick in 1..starts.len() {
            let size = (starts[brick] - starts[first]) as usize;
            if size >= REFERENCES_PER_TASK || brick + 1 == starts.len() {
                let (these, others) = rest.split_at_mut(size);
                tasks.push((first..brick, these));
                (first, rest) = (brick, others);
            }
        }
        let done = AtomicU64::new(0);
        let pieces: Vec<_> = tasks
            .into_par_iter()
            .map(|(bricks, references)| {
                let mut piece = Piece::default();
                let base = starts[bricks.start] as usize;
                let roots: Vec<u32> = bricks
                    .map(|brick| {
                        let range = starts[brick] as usize - base..starts[brick + 1] as usize - base;
                        self.divide_brick(&mut piece, brick, &mut references[range])
                    })
                    .collect();
                let done = done.fetch_add(references.len() as u64, Relaxed) + references.len() as u64;
                progress(done as f32 / total as f32);
                (roots, piece)
            })
            .collect();

        let mut bricks = Vec::with_capacity(starts.len() - 1);
        let mut whole = Piece::with_capacity(pieces.iter().map(|(_, piece)| piece));
        for (roots, piece) in pieces {
            let offset = whole.append(&piece);
            bricks.extend(roots.into_iter().map(|root| match root {
                Grid::EMPTY => Grid::EMPTY,
                leaf if leaf & Grid::LEAF != 0 => leaf + offset.leaf,
                node => node + offset.node,
            }));
        }
        (bricks, whole)
    }

    /// Adds one brick to a piece of the grid; returns its entry there.
    fn divide_brick(&self, piece: &mut Piece, brick: usize, references: &mut [u32]) -> u32 {
        if references.is_empty() {
            return Grid::EMPTY;
        }
        references.sort_unstable();
        let [x_dim, y_dim, _] = self.dims.map(|n| n as usize);
        let corner = [brick % x_dim, brick / x_dim % y_dim, brick / x_dim / y_dim].map(|b| b as u32 * BRICK_SIZE);
        // Small scenes can afford more references for each triangle, and large triangles need them.
        let per_triangle = ((1 << 24) / self.n_triangles).clamp(6, 64);
        let cube = Cube { corner, level: 0, most_references: references.len() * per_triangle + 64 };
        match self.plan(references, &cube) {
            None => {
                piece.push_leaf(references);
                (piece.leaf_ends.len() as u32 - 1) | Grid::LEAF
            }
            Some(plan) => {
                let root = piece.nodes.len();
                piece.nodes.push(Node::default());
                piece.nodes[root] = self.emit(piece, &cube, &plan);
                root as u32
            }
        }
    }

    /// Distributes a cube's triangles among its children, if that pays.
    fn plan(&self, references: &[u32], cube: &Cube) -> Option<Plan> {
        if references.len() <= LEAF_SIZE || cube.level == LEVELS {
            return None;
        }
        let scale = 1.0 / f64::from(cube.child_size());
        let corner = DVec3::from_array(cube.corner.map(f64::from));
        let mut starts = [0; 65];
        let masks: Vec<u64> = references
            .iter()
            .map(|&triangle| {
                let corners = self.corners(triangle).expect("a rejected triangle is in no brick");
                let mask = overlap::children(&corners.map(|c| (c - corner) * scale), DILATION * scale);
                bits(mask).for_each(|child| starts[child as usize + 1] += 1);
                mask
            })
            .collect();
        for child in 0..64 {
            starts[child + 1] += starts[child];
        }
        // A ray through the cube meets a child with probability 1/16 on average (the ratio of their surfaces), so
        // dividing saves tests only while the children hold less than 16 times as much; half of that pays the steps.
        let total = starts[64] as usize;
        if total > cube.most_references || total >= 8 * references.len() {
            return None;
        }
        let mut next = starts;
        let mut distributed = vec![0; total];
        for (&triangle, &mask) in references.iter().zip(&masks) {
            for child in bits(mask) {
                distributed[next[child as usize] as usize] = triangle;
                next[child as usize] += 1;
            }
        }
        Some(Plan { starts, references: distributed })
    }

    /// Adds the children of a planned node to a piece; returns the node.
    fn emit(&self, piece: &mut Piece, cube: &Cube, plan: &Plan) -> Node {
        let children: Vec<_> = (0..64).filter(|&child| !plan.of(child).is_empty()).collect();
        let plan_child = |&child: &u32| {
            let child_cube = cube.child(child, plan);
            let child_plan = self.plan(plan.of(child), &child_cube);
            (child, child_cube, child_plan)
        };
        let parallel = plan.references.len() > REFERENCES_PER_TASK;
        let planned: Vec<_> = if parallel {
            children.par_iter().map(plan_child).collect()
        } else {
            children.iter().map(plan_child).collect()
        };

        let mut node =
            Node { first_node: piece.nodes.len() as u32, first_leaf: piece.leaf_ends.len() as u32, ..Node::default() };
        for (child, _, child_plan) in &planned {
            node.occupied |= 1 << child;
            match child_plan {
                None => piece.push_leaf(plan.of(*child)),
                Some(_) => {
                    node.divided |= 1 << child;
                    piece.nodes.push(Node::default());
                }
            }
        }
        let divided = planned.into_iter().filter_map(|(_, cube, plan)| Some((cube, plan?)));
        if parallel {
            let subtrees: Vec<_> = divided
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|(cube, plan)| {
                    let mut subtree = Piece::default();
                    (self.emit(&mut subtree, &cube, &plan), subtree)
                })
                .collect();
            for (index, (root, subtree)) in subtrees.into_iter().enumerate() {
                let offset = piece.append(&subtree);
                piece.nodes[node.first_node as usize + index] = root.moved(&offset);
            }
        } else {
            for (index, (cube, plan)) in divided.enumerate() {
                piece.nodes[node.first_node as usize + index] = self.emit(piece, &cube, &plan);
            }
        }
        node
    }
}

/// The place of a node while it is built.
struct Cube {
    /// Its lowest corner, in finest cells.
    corner: [u32; 3],
    /// 0 for a brick.
    level: u32,
    /// What its leaves may hold in all.
    most_references: usize,
}

impl Cube {
    fn child_size(&self) -> u32 {
        BRICK_SIZE >> (2 * (self.level + 1))
    }

    fn child(&self, child: u32, plan: &Plan) -> Self {
        let place = [child & 3, child >> 2 & 3, child >> 4];
        let share = plan.of(child).len() as u128 * self.most_references as u128 / plan.references.len() as u128;
        Self {
            corner: [0, 1, 2].map(|axis| self.corner[axis] + place[axis] * self.child_size()),
            level: self.level + 1,
            most_references: share as usize,
        }
    }
}

/// The triangles of a node's 64 children.
struct Plan {
    starts: [u32; 65],
    references: Vec<u32>,
}

impl Plan {
    fn of(&self, child: u32) -> &[u32] {
        &self.references[self.starts[child as usize] as usize..self.starts[child as usize + 1] as usize]
    }
}

/// A part of a grid, with numbers that count from its own beginning.
#[derive(Default)]
struct Piece {
    nodes: Vec<Node>,
    /// Where the references of each leaf end; they begin where the last leaf's end.
    leaf_ends: Vec<u32>,
    references: Vec<u32>,
}

/// Where one piece begins in another.
struct Offset {
    node: u32,
    leaf: u32,
}

impl Piece {
    fn with_capacity<'a>(pieces: impl Iterator<Item = &'a Self> + Clone) -> Self {
        Self {
            nodes: Vec::with_capacity(pieces.clone().map(|piece| piece.nodes.len()).sum()),
            leaf_ends: Vec::with_capacity(pieces.clone().map(|piece| piece.leaf_ends.len()).sum()),
            references: Vec::with_capacity(pieces.map(|piece| piece.references.len()).sum()),
        }
    }

    fn push_leaf(&mut self, references: &[u32]) {
        self.references.extend_from_slice(references);
        self.leaf_ends.push(self.references.len() as u32);
    }

    fn append(&mut self, other: &Self) -> Offset {
        let offset = Offset { node: self.nodes.len() as u32, leaf: self.leaf_ends.len() as u32 };
        let base = self.references.len() as u32;
        self.nodes.extend(other.nodes.iter().map(|node| node.moved(&offset)));
        self.leaf_ends.extend(other.leaf_ends.iter().map(|end| base + end));
        self.references.extend_from_slice(&other.references);
        offset
    }
}

impl Node {
    fn moved(self, offset: &Offset) -> Self {
        Self { first_node: self.first_node + offset.node, first_leaf: self.first_leaf + offset.leaf, ..self }
    }
}

/// The numbers of the bits that are set, ascending.
fn bits(mut mask: u64) -> impl Iterator<Item = u32> {
    std::iter::from_fn(move || {
        let bit = mask.trailing_zeros();
        mask &= mask.wrapping_sub(1);
        (bit < 64).then_some(bit)
    })
}
