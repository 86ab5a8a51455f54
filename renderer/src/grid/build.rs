//! Builds a grid, in parallel and within a memory budget.

use std::sync::atomic::AtomicBool;

use crate::{
    grid::{
        Grid, GridOptions, MemoryBudget, MemoryShortage, Storage, Structure,
        cells::CellSpace,
        choice,
        traced::TracedMesh,
        tree::{
            BRICK_SIZE, CELLS_PER_BRICK, Tree,
            boxes::{QuantizedBoxes, leaf_cubes},
            divide::{Builder, TreePart},
            hierarchy::Hierarchy,
            items::Items,
            scatter::Scatter,
        },
        uniform::{DenseIndex, UniformGrid, resolution::resolution, row_displacement::RowDisplacement},
    },
    model::mesh::{Aabb, Mesh},
    simd::InstructionSet,
};

/// Bytes of a triangle in a tree's leaf, with its part of leaves and nodes; guests take less.
const TREE_BYTES_PER_REFERENCE: u64 = TracedMesh::BYTES_PER_TRIANGLE + 1;

/// Bytes of its box, with its part of groups and the hierarchy; they are made after the loaded mesh is dropped.
const BOX_BYTES_PER_REFERENCE: u64 = 4;

/// The same without its own box, in a compact tree.
const GROUP_BYTES_PER_REFERENCE: u64 = 1;

/// Bytes of the program before it has a scene.
pub(crate) const PROGRAM_BYTES: u64 = 40_000_000;

fn box_bytes_per_reference(storage: Storage) -> u64 {
    if storage == Storage::Compact { GROUP_BYTES_PER_REFERENCE } else { BOX_BYTES_PER_REFERENCE }
}

impl Grid {
    /// Builds the grid of a mesh, and orders the mesh by it.
    ///
    /// `progress` is called from any thread with the part that is done, from 0 to 1. A grid that would need more memory
    /// than the options allow is made coarser: see [`Grid::shortage`].
    pub fn build(mesh: Mesh, options: &GridOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        Self::build_beside(0, mesh, options, progress)
    }

    /// As [`Grid::build`], where the program holds so many bytes already.
    pub(crate) fn build_beside(
        n_bytes: usize,
        mesh: Mesh,
        options: &GridOptions,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Self {
        let program_bytes = PROGRAM_BYTES + n_bytes as u64;
        let bounds = mesh.bounds();
        if bounds.is_empty() {
            return Self::empty(TracedMesh::new(mesh, Vec::new()));
        }

        // Choose the density, and find the memory that is left for the grid beside the mesh.
        let density = choice::density(&mesh, options);
        let mesh_bytes = program_bytes + TracedMesh::peak_bytes(&mesh);
        let mesh_bytes_in_order = program_bytes + TracedMesh::bytes_in_order(&mesh);
        let most_bytes = options.memory_budget.remaining_beside(mesh_bytes);
        let loaded_bytes = mesh.n_bytes() as u64;
        let storage = options.storage;
        let references = storage.is_tree().then(|| choice::references(&mesh, storage, density)).flatten();
        let (grid, is_coarser, wanted_references) = match storage {
            Storage::Tree | Storage::Compact => {
                let most_bytes_in_order = options.memory_budget.remaining_beside(mesh_bytes_in_order);
                let most_bytes = [most_bytes, most_bytes_in_order];
                // Where sizes are not, the model of references does not hold.
                let is_even = references.is_some();
                let (grid, wanted) = Self::tree(mesh, &bounds, storage, density, is_even, most_bytes, progress);
                (grid, wanted.is_some(), wanted)
            }
            Storage::Plain | Storage::RowDisplacement => {
                let n_bytes = TracedMesh::BYTES_PER_TRIANGLE * mesh.triangles.len() as u64;
                let (grid, is_coarser) =
                    Self::uniform(mesh, &bounds, density, options, most_bytes.saturating_sub(n_bytes));
                (grid, is_coarser, None)
            }
        };

        // Compare the peak with the budget; boxes are measured after the loaded mesh is dropped.
        let all_bytes = program_bytes + (grid.mesh.n_bytes() + grid.n_bytes()) as u64;
        let box_bytes = grid.figures().box_bytes.unwrap_or(0) as u64;
        let all_bytes = all_bytes.max(all_bytes + loaded_bytes - box_bytes);
        let budget = options.memory_budget;
        let needed_bytes = budget.is_exceeded_by(all_bytes).then_some(all_bytes);
        let is_short = is_coarser || needed_bytes.is_some();
        // Each cell has a part of the references that the budget allows, so their sum must have room. Where many lie in few
        // cells that is too little, and so many as no cell wants more are enough.
        let enough_bytes = [references.map(|n| 2 * n), wanted_references].into_iter().flatten().map(|n| {
            let in_order = mesh_bytes_in_order + n * (TREE_BYTES_PER_REFERENCE + box_bytes_per_reference(storage));
            in_order.max(mesh_bytes + n * TREE_BYTES_PER_REFERENCE)
        });
        let enough_bytes = enough_bytes.filter(|&n_bytes| budget.is_exceeded_by(n_bytes)).min();
        let enough = if is_coarser { enough_bytes } else { needed_bytes }.map(MemoryBudget::of_at_least);
        let shortage = is_short.then_some(MemoryShortage { budget, is_coarser, enough, needed_bytes });
        Self { shortage, is_limited: is_coarser || grid.is_limited, ..grid }
    }

    /// Builds a tree of triangles whose sizes may be even, of at most so many bytes beside the mesh as loaded, and beside the
    /// mesh in the tree's order. Returns, second, how many references it may want if cells stay undivided to save memory.
    fn tree(
        mesh: Mesh,
        bounds: &Aabb,
        storage: Storage,
        density: f64,
        is_even: bool,
        [most_bytes, most_bytes_in_order]: [u64; 2],
        progress: &(dyn Fn(f32) + Sync),
    ) -> (Self, Option<u64>) {
        let n_triangles = mesh.triangles.len() - mesh.n_rejected;
        let [min, max] = bounds.corners();
        let (cells, cell_size) = resolution(max - min, n_triangles, density);

        // Sort the triangles into bricks; bricks grow until most triangles lie in few of them.
        let mut cells_per_brick_side = CELLS_PER_BRICK;
        let most = (4 * n_triangles as u64 + (1 << 16)).min(u64::from(u32::MAX));
        let brick = |dims: [u32; 3], [x, y, z]: [u32; 3]| {
            (z as usize * dims[1] as usize + y as usize) * dims[0] as usize + x as usize
        };
        let (scatter, counts) = loop {
            let scatter = Scatter {
                mesh: &mesh,
                space: CellSpace::new(bounds, cell_size * f64::from(cells_per_brick_side) / f64::from(BRICK_SIZE)),
                cube_size: BRICK_SIZE,
                dims: cells.map(|n| n.div_ceil(cells_per_brick_side)),
            };
            let n_bricks: usize = scatter.dims.iter().map(|&n| n as usize).product();
            let is_coarsest = scatter.dims == [1; 3];
            if is_coarsest || n_bricks as u64 <= most_bytes / 32 {
                let most = if is_coarsest { u64::MAX } else { most };
                if let Some(counts) = scatter.count(n_bricks, most, |cube| brick(scatter.dims, cube)) {
                    break (scatter, counts);
                }
            }
            cells_per_brick_side *= 2;
        };
        progress(0.15);
        let (starts, references) = scatter.fill(counts, |cube| brick(scatter.dims, cube));
        progress(0.3);
        let (space, dims) = (scatter.space, scatter.dims);

        // Limit the references: small scenes can afford more a triangle, and large triangles need them.
        let wanted_references = ((1 << 24) / n_triangles as u64).clamp(6, 64) * references.len() as u64;
        let wanted_references = wanted_references.min(u64::from(u32::MAX));
        let affordable_references = (most_bytes / TREE_BYTES_PER_REFERENCE)
            .min(most_bytes_in_order / (TREE_BYTES_PER_REFERENCE + box_bytes_per_reference(storage)));

        // Divide the bricks into a tree.
        let builder = Builder {
            scatter,
            leaf_size: choice::leaf_size(storage),
            n_in_bricks: references.len() as u64,
            most_references: wanted_references.min(affordable_references),
            is_memory_limited: affordable_references < wanted_references,
            hit_memory_limit: AtomicBool::default(),
        };
        let (bricks, part) = builder.divide(&starts, references, &|done| progress(0.3 + 0.6 * done));
        let wanted_references = builder.hit_memory_limit.into_inner().then_some(wanted_references);

        // Order the mesh by the tree, which drops the loaded mesh, and measure the boxes.
        let TreePart { nodes, leaf_ends: mut leaf_starts, references } = part;
        leaf_starts.insert(0, 0);
        let (items, order) = Items::new(references, mesh.triangles.len());
        let mesh = TracedMesh::new(mesh, order);
        let leaf_cubes = leaf_cubes(dims, &bricks, &nodes, leaf_starts.len() - 1);
        let is_compact = storage == Storage::Compact;
        let boxes = QuantizedBoxes::new(&space, &leaf_cubes, &leaf_starts, &items, &mesh, is_compact);
        let extent = space.point_to_cells(max).to_array();
        let extent = [0, 1, 2].map(|axis| (extent[axis] as u32 + 1).min(dims[axis] * BRICK_SIZE));
        let hierarchy = Hierarchy::default();
        let mut tree = Tree {
            dims,
            extent,
            bricks: bricks.into(),
            nodes: nodes.into(),
            leaf_starts: leaf_starts.into(),
            items,
            is_compact,
            boxes,
            leaf_cubes: leaf_cubes.into(),
            hierarchy,
        };
        let n_bytes_left = most_bytes_in_order.saturating_sub(tree.figures().n_bytes() as u64);
        let n_items = tree.n_items();
        let is_over_triangles = |n_bytes_left| {
            !is_compact && Hierarchy::is_over_triangles(mesh.n_triangles(), n_items, is_even, n_bytes_left)
        };
        let is_limited = is_over_triangles(u64::MAX) && !is_over_triangles(n_bytes_left);
        tree.hierarchy = if is_over_triangles(n_bytes_left) {
            Tree::hierarchy_over_triangles(&space, &mesh, n_bytes_left)
        } else {
            tree.hierarchy_over_leaves()
        };
        (Self { space, structure: Structure::Tree(tree), density, is_limited, ..Self::empty(mesh) }, wanted_references)
    }

    /// Builds the paper's uniform grid. Returns true, second, if it is coarser to save memory.
    fn uniform(
        mesh: Mesh,
        bounds: &Aabb,
        requested_density: f64,
        options: &GridOptions,
        most_bytes: u64,
    ) -> (Self, bool) {
        let [min, max] = bounds.corners();
        let n_triangles = mesh.triangles.len() - mesh.n_rejected;
        let mut density = requested_density;
        let (space, mut structure) = loop {
            let (dims, cell_size) = resolution(max - min, n_triangles, density);
            let space = CellSpace::new(bounds, cell_size);
            let scatter = Scatter { mesh: &mesh, space, cube_size: 1, dims };
            // The coarsest grid of all may take any memory.
            let most_bytes = if dims == [1; 3] { u64::MAX } else { most_bytes };
            let n_levels = options.macrocell_levels;
            let structure = if options.storage == Storage::Plain {
                UniformGrid::<DenseIndex>::build(&scatter, n_levels, most_bytes).map(Structure::Plain)
            } else {
                UniformGrid::<RowDisplacement>::build(&scatter, n_levels, most_bytes).map(Structure::RowDisplacement)
            };
            if let Some(structure) = structure {
                break (space, structure);
            }
            density /= 2.0;
        };
        let traced = TracedMesh::in_order_of(mesh, structure.references_mut());
        (Self { space, structure, density, ..Self::empty(traced) }, density < requested_density)
    }

    fn empty(mesh: TracedMesh) -> Self {
        Self {
            space: CellSpace::new(&Aabb { min: [0.0; 3], max: [0.0; 3] }, 1.0),
            structure: Structure::Tree(Tree::empty()),
            density: 0.0,
            shortage: None,
            is_limited: false,
            mesh,
            instructions: InstructionSet::best(),
        }
    }
}
