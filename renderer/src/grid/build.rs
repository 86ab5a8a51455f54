//! Builds a grid: triangles into bricks, then each brick by itself, all in parallel.
//!
//! The result does not depend on the number of threads: bricks are divided by rules that look at nothing but the brick,
//! and put together in order.

use std::{
    sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed},
    time::Duration,
};

use glam::Vec3;
use rayon::prelude::*;

use super::{
    BRICK_SIZE, CELLS_PER_BRICK, Grid, GridOptions, InstructionSet, LEVELS, MemoryShortage, MeshLayout, Node, Storage,
    boxes::Boxes,
    overlap::{self, DILATION},
    resolution::{CellSpace, resolution},
    scatter::Scatter,
    uniform::Uniform,
};
use crate::{
    mesh::{Aabb, Mesh},
    traced::TracedMesh,
};

/// References that one task divides, and above which the children of one node are divided in parallel.
const REFERENCES_PER_TASK: usize = 1 << 15;

/// Cubes that hold no more than this are not divided: the boxes of 16 triangles are tested faster than one more leaf is
/// found. Between 128 and 512 speed is flat; memory falls with it.
const LEAF_SIZE: usize = 256;

/// What one reference takes with its part of leaves and nodes.
const TREE_BYTES_PER_REFERENCE: u64 = 5;

/// What its box takes, which is measured when the mesh as it was loaded is gone.
const BOX_BYTES_PER_REFERENCE: u64 = 6;

/// What the program takes before it has a scene.
pub(super) const PROGRAM_BYTES: u64 = 40_000_000;

impl Grid {
    /// Builds the grid of a mesh, and orders the mesh by it.
    ///
    /// `progress` is told now and then what part is done, from 0 to 1, from any thread. A grid that would need more
    /// memory than the options allow is made coarser; [`Grid::shortage`] says so.
    pub fn build(mesh: Mesh, options: &GridOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        let bounds = mesh.bounds();
        if bounds.is_empty() {
            return Self::empty(TracedMesh::new(mesh, &mut []));
        }
        let is_flat = options.mesh == MeshLayout::Flat;
        let mesh_bytes = PROGRAM_BYTES + TracedMesh::peak_bytes(&mesh, is_flat);
        let mesh_bytes_in_order = PROGRAM_BYTES + TracedMesh::bytes_in_order(&mesh, is_flat);
        let most_bytes = options.memory_budget.left_beside(mesh_bytes);
        let grid = match options.storage {
            Storage::Masks => Self::masks(mesh, &bounds, options, most_bytes, progress),
            Storage::Plain | Storage::RowDisplacement => Self::uniform(mesh, &bounds, options, most_bytes),
        };
        // Boxes come when the mesh as it was loaded is gone.
        let (grid_bytes, box_bytes) = (grid.n_bytes() as u64, grid.boxes.n_bytes() as u64);
        let all_bytes = (mesh_bytes + grid_bytes - box_bytes).max(mesh_bytes_in_order + grid_bytes);
        let budget = options.memory_budget;
        let (is_coarser, is_too_much) = (grid.shortage.is_some(), budget.is_less_than(all_bytes));
        let needed_bytes = is_too_much.then_some(all_bytes);
        let shortage = (is_coarser || is_too_much).then_some(MemoryShortage { budget, is_coarser, needed_bytes });
        Self { shortage, ..grid }.with_mesh_layout(options.mesh)
    }

    /// The tree of masks. Where it would take too much memory cubes stay undivided.
    fn masks(
        mesh: Mesh,
        bounds: &Aabb,
        options: &GridOptions,
        most_bytes: u64,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Self {
        let n_triangles = mesh.triangles.len() - mesh.n_rejected;
        let corner = |corner: [f32; 3]| Vec3::from_array(corner).as_dvec3();
        let (cells, cell_size) = resolution(corner(bounds.max) - corner(bounds.min), n_triangles, options.density);

        let mut bricks_in_cells = CELLS_PER_BRICK;
        // Room for triangles that each lie in several bricks; large ones are met with larger bricks.
        let most = (4 * n_triangles as u64 + (1 << 16)).min(u64::from(u32::MAX));
        let brick = |dims: [u32; 3], [x, y, z]: [u32; 3]| {
            (z as usize * dims[1] as usize + y as usize) * dims[0] as usize + x as usize
        };
        let (scatter, counts) = loop {
            let scatter = Scatter {
                mesh: &mesh,
                space: CellSpace::new(bounds, cell_size * f64::from(bricks_in_cells) / f64::from(BRICK_SIZE)),
                cube_size: BRICK_SIZE,
                dims: cells.map(|n| n.div_ceil(bricks_in_cells)),
            };
            let n_bricks: usize = scatter.dims.iter().map(|&n| n as usize).product();
            let is_coarsest = scatter.dims == [1; 3];
            if is_coarsest || n_bricks as u64 <= most_bytes / 32 {
                let most = if is_coarsest { u64::MAX } else { most };
                if let Some(counts) = scatter.count(n_bricks, most, |cube| brick(scatter.dims, cube)) {
                    break (scatter, counts);
                }
            }
            bricks_in_cells *= 2;
        };
        progress(0.15);
        let (starts, references) = scatter.fill(counts, |cube| brick(scatter.dims, cube));
        progress(0.3);
        let (space, dims) = (scatter.space, scatter.dims);
        // Small scenes can afford more references for each triangle, and large triangles need them.
        let wanted = ((1 << 24) / n_triangles as u64).clamp(6, 64) * references.len() as u64;
        let mesh_bytes = PROGRAM_BYTES + TracedMesh::bytes_in_order(&mesh, options.mesh == MeshLayout::Flat);
        let most_bytes_in_order = options.memory_budget.left_beside(mesh_bytes);
        let affordable = (most_bytes / TREE_BYTES_PER_REFERENCE)
            .min(most_bytes_in_order / (TREE_BYTES_PER_REFERENCE + BOX_BYTES_PER_REFERENCE))
            .min(u64::from(u32::MAX));
        let builder = Builder {
            scatter,
            n_in_bricks: references.len() as u64,
            most_references: wanted.min(affordable),
            is_short: affordable < wanted,
            gave_up: AtomicBool::new(false),
        };
        let (bricks, piece) = builder.divide(&starts, references, &|done| progress(0.3 + 0.6 * done));
        let shortage = builder.gave_up.into_inner().then_some(MemoryShortage {
            budget: options.memory_budget,
            is_coarser: true,
            needed_bytes: None,
        });
        let Piece { nodes, leaf_ends, mut references } = piece;
        let mut leaf_starts = leaf_ends;
        leaf_starts.insert(0, 0);
        let mesh = TracedMesh::new(mesh, &mut references);
        let instructions = InstructionSet::best();
        let boxes = Boxes::new(&space, dims, &bricks, &nodes, &leaf_starts, &references, &mesh);
        Self {
            space,
            dims,
            bricks,
            nodes,
            leaf_starts,
            references,
            boxes,
            largest_skip: largest_skip(options.macrocell_levels),
            uniform: None,
            placement: Duration::ZERO,
            density: options.density,
            shortage,
            mesh,
            instructions,
        }
    }

    /// The paper's uniform grid. One that would take too much memory is made coarser.
    fn uniform(mesh: Mesh, bounds: &Aabb, options: &GridOptions, most_bytes: u64) -> Self {
        let extent = Vec3::from_array(bounds.max).as_dvec3() - Vec3::from_array(bounds.min).as_dvec3();
        let n_triangles = mesh.triangles.len() - mesh.n_rejected;
        let mut density = options.density;
        let (space, mut uniform, placement) = loop {
            let (dims, cell_size) = resolution(extent, n_triangles, density);
            let space = CellSpace::new(bounds, cell_size);
            let scatter = Scatter { mesh: &mesh, space, cube_size: 1, dims };
            // The coarsest grid of all is taken whatever it needs.
            let most_bytes = if dims == [1; 3] { u64::MAX } else { most_bytes };
            if let Some((uniform, placement)) = Uniform::build(&scatter, options, most_bytes) {
                break (space, uniform, placement);
            }
            density /= 2.0;
        };
        let traced = TracedMesh::new(mesh, uniform.references_mut());
        let shortage = (density < options.density).then_some(MemoryShortage {
            budget: options.memory_budget,
            is_coarser: true,
            needed_bytes: None,
        });
        Self { space, uniform: Some(uniform), placement, density, shortage, ..Self::empty(traced) }
    }

    fn empty(mesh: TracedMesh) -> Self {
        Self {
            space: CellSpace::new(&Aabb { min: [0.0; 3], max: [0.0; 3] }, 1.0),
            dims: [1; 3],
            bricks: vec![Self::EMPTY],
            nodes: Vec::new(),
            leaf_starts: vec![0],
            references: Vec::new(),
            boxes: Boxes::default(),
            largest_skip: largest_skip(0),
            uniform: None,
            placement: Duration::ZERO,
            density: 0.0,
            shortage: None,
            mesh,
            instructions: InstructionSet::best(),
        }
    }
}

/// The largest empty cube that may be skipped whole, log₂ in finest cells: half a cell of the paper's without
/// macrocells, and four times as much for each level of them.
fn largest_skip(macrocell_levels: u8) -> u32 {
    2 * (LEVELS - 3) + 2 * u32::from(macrocell_levels)
}

struct Builder<'a> {
    scatter: Scatter<'a>,
    /// References of all bricks, before they are divided.
    n_in_bricks: u64,
    /// What all leaves may hold in all.
    most_references: u64,
    /// Whether that is little for want of memory.
    is_short: bool,
    /// Whether a cube stays undivided because of that.
    gave_up: AtomicBool,
}

impl Builder<'_> {
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
        let [x_dim, y_dim, _] = self.scatter.dims.map(|n| n as usize);
        let corner = [brick % x_dim, brick / x_dim % y_dim, brick / x_dim / y_dim].map(|b| b as u32 * BRICK_SIZE);
        let share = references.len() as u128 * u128::from(self.most_references) / u128::from(self.n_in_bricks);
        let cube = Cube { corner, level: 0, most_references: share as usize };
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
        let mut counts = [0u32; 64];
        let mut masks = Vec::with_capacity(references.len());
        for &triangle in references {
            let corners = self.scatter.corners(triangle).expect("a rejected triangle is in no brick");
            let mask = overlap::children(&overlap::corners_in(&corners, cube.corner, scale), DILATION * scale);
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
        // A ray through the cube meets a child with probability 1/16 on average (the ratio of their surfaces), so
        // dividing saves tests only while the children hold less than 16 times as much; half of that pays the steps.
        let total = starts[64] as usize;
        if total >= 8 * references.len() {
            return None;
        }
        if total > cube.most_references {
            if self.is_short {
                self.gave_up.store(true, Relaxed);
            }
            return None;
        }
        let mut next = starts;
        let mut distributed = vec![0; total];
        for (&triangle, &mask) in references.iter().zip(&masks) {
            let mut left = mask;
            while left != 0 {
                let place = &mut next[left.trailing_zeros() as usize];
                distributed[*place as usize] = triangle;
                *place += 1;
                left &= left - 1;
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
        let place = overlap::place(child);
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
