//! Chooses the density of a scene's tree: that of the fewest references, which is the fastest and nearly the smallest.
//!
//! The tree divides cells into 4×4×4 until each holds at most [`leaf_size`] triangles, so densities 64 times apart give
//! the same leaves. In between, leaves of an even scan hold 8 to 512 triangles; the smaller they are, the more leaves
//! list the same triangle. The model predicts these references:
//!
//! 1. A triangle in a random position overlaps on average `1 + B/h + P/h²` cubes of side h, where B is the sum of the
//!    sides of its box, and P the sum of its projected areas along the three axes: the mixed volumes of a triangle and
//!    a cube (Schneider and Weil, "Stochastic and Integral Geometry", 2008). This is exact.
//! 2. Where triangles have a mean area a, a cube that their surface passes holds `h²/a` times as many as (1) says.
//! 3. Cells that the tree does not divide are leaves. The surface cuts cells differently, so near the limit only some
//!    are divided: a logistic curve gives the portion of leaves.
//!
//! Areas come from runs of consecutive triangles of the file, which are neighbours in most files. On scans of 70,000 to
//! ten million triangles the predicted references are within 2 % of the built ones. On CAD models and on a hall with a
//! teapot the error is up to 40 %: a cube there holds several surfaces, of triangles of all sizes. The variation of
//! areas reveals these scenes, and they get a fixed density: [`UNEVEN_DENSITY`].

use glam::{DVec3, Vec3};

use crate::{
    grid::{
        GridOptions, Storage,
        tree::{
            CELLS_PER_BRICK, LEVELS,
            divide::{COMPACT_LEAF_SIZE, LEAF_SIZE},
        },
        uniform::resolution::resolution,
    },
    model::mesh::Mesh,
};

/// The densities to choose from: one period, in the steps of the chart.
const DENSITIES: [f64; 6] = [4.0, 8.0, 16.0, 32.0, 64.0, 128.0];

/// Largest variation of areas from run to run for which the model holds, as the standard deviation of their logarithm:
/// scans have 0.1 to 0.7, the statue 1.1, the CAD board of the chart 2.2, a hall with a teapot 3.7.
const MOST_VARIATION: f64 = 1.5;

/// Fewest triangles for which the model holds: a few leaves hold fewer, and chance decides.
const FEWEST_TRIANGLES: usize = 1 << 15;

/// The density of scenes that the model does not fit. Rays enter small bricks directly and large ones in several steps,
/// but pass more of the small. Compared with 64, a frame takes up to 15 % less in the hall (5 % more where the teapot
/// fills it), and from 7 % less to 9 % more on the board.
const UNEVEN_DENSITY: f64 = 256.0;

const TRIANGLES_PER_RUN: usize = 16;

const MOST_RUNS: usize = 1024;

/// Width of the curve in (3), in the logarithm of a cell's triangles: fitted to four scans and a bust at 8 densities.
const TRANSITION_WIDTH: f64 = 0.2 / 1.7;

/// The density of a mesh's grid: that of the options, the paper's in the paper's grid, or the best for the scene.
pub(crate) fn density(mesh: &Mesh, options: &GridOptions) -> f64 {
    match options.storage {
        Storage::Tree | Storage::Compact => {
            options.density.unwrap_or_else(|| Survey::new(mesh, leaf_size(options.storage)).best_density())
        }
        Storage::Plain | Storage::RowDisplacement => options.density.unwrap_or(GridOptions::PAPER_DENSITY),
    }
}

/// Most triangles of a cell that a tree does not divide.
pub(crate) fn leaf_size(storage: Storage) -> usize {
    if storage == Storage::Compact { COMPACT_LEAF_SIZE } else { LEAF_SIZE }
}

/// Predicts the references of a mesh's tree; `None` where the model does not hold.
pub(crate) fn references(mesh: &Mesh, storage: Storage, density: f64) -> Option<u64> {
    let survey = Survey::new(mesh, leaf_size(storage));
    survey.is_even().then(|| (survey.references_per_triangle(density) * survey.n_triangles as f64) as u64)
}

struct Run {
    area: f64,
    box_sides: f64,
    projected_areas: f64,
}

/// Measurements of a mesh before its grid is built.
struct Survey {
    n_triangles: usize,
    leaf_size: usize,
    extent: DVec3,
    runs: Vec<Run>,
}

impl Survey {
    fn new(mesh: &Mesh, leaf_size: usize) -> Self {
        let [min, max] = mesh.bounds().corners();
        let n_runs = mesh.triangles.len().div_ceil(TRIANGLES_PER_RUN).min(MOST_RUNS);
        let first_triangle_of =
            |run: usize| run * mesh.triangles.len().saturating_sub(TRIANGLES_PER_RUN) / n_runs.max(2).saturating_sub(1);
        let runs = (0..n_runs).filter_map(|run| Run::of(mesh, first_triangle_of(run))).collect();
        Self { n_triangles: mesh.triangles.len() - mesh.n_rejected, leaf_size, extent: max - min, runs }
    }

    /// The density of the fewest references, or a fixed one where the model does not fit the scene.
    fn best_density(&self) -> f64 {
        if !self.is_even() {
            return UNEVEN_DENSITY;
        }
        let predicted = DENSITIES.map(|density| (self.references_per_triangle(density), density));
        predicted.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).map_or(UNEVEN_DENSITY, |(_, density)| density)
    }

    fn is_even(&self) -> bool {
        let n = self.runs.len() as f64;
        let logarithms = || self.runs.iter().map(|run| run.area.ln());
        let mean = logarithms().sum::<f64>() / n;
        let variance = logarithms().map(|logarithm| (logarithm - mean).powi(2)).sum::<f64>() / n;
        self.n_triangles >= FEWEST_TRIANGLES && variance.sqrt() < MOST_VARIATION
    }

    /// Predicts the leaves of a tree that list a triangle.
    fn references_per_triangle(&self, density: f64) -> f64 {
        let (_, cell_size) = resolution(self.extent, self.n_triangles, density);
        self.runs.iter().map(|run| run.references_in_tree(cell_size, self.leaf_size) / self.runs.len() as f64).sum()
    }
}

impl Run {
    /// Measures the triangles from `first` on; `None` if none of them has an area.
    fn of(mesh: &Mesh, first: usize) -> Option<Self> {
        let (mut n, mut sum) = (0.0, Self { area: 0.0, box_sides: 0.0, projected_areas: 0.0 });
        for corners in
            (first..(first + TRIANGLES_PER_RUN).min(mesh.triangles.len())).filter_map(|triangle| mesh.corners(triangle))
        {
            let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
            let area = (b - a).cross(c - a) * 0.5;
            if area == DVec3::ZERO || !area.is_finite() {
                continue;
            }
            n += 1.0;
            sum.area += area.length();
            sum.projected_areas += area.abs().element_sum();
            sum.box_sides += (a.max(b).max(c) - a.min(b).min(c)).element_sum();
        }
        let mean = Self { area: sum.area / n, box_sides: sum.box_sides / n, projected_areas: sum.projected_areas / n };
        (n > 0.0 && mean.area > 0.0 && mean.area.is_finite()).then_some(mean)
    }

    /// Cubes of a side that list a triangle, and triangles that a cube lists: (1) and (2) of the model.
    fn lists_in_cubes(&self, side: f64) -> (f64, f64) {
        let references = 1.0 + self.box_sides / side + self.projected_areas / (side * side);
        (references, references * (side * side / self.area).max(1.0))
    }

    /// Leaves of a tree over cells of a side that list a triangle: (3) of the model.
    fn references_in_tree(&self, cell_size: f64, leaf_size: usize) -> f64 {
        let (mut references, mut divided) = (0.0, 1.0);
        let mut side = cell_size * f64::from(CELLS_PER_BRICK);
        for level in 0..=LEVELS {
            let (here, triangles) = self.lists_in_cubes(side);
            side /= 4.0;
            let (below, _) = self.lists_in_cubes(side);
            // The tree stops dividing where triangles are larger than cells.
            let is_last = level == LEVELS || below >= 8.0 * here;
            let part =
                if is_last { 1.0 } else { 1.0 / (1.0 + (triangles / leaf_size as f64).powf(1.0 / TRANSITION_WIDTH)) };
            references += divided * part * here;
            divided -= divided * part;
        }
        references
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{grid::Grid, model::statue};

    fn built(mesh: &Mesh, density: Option<f64>) -> Grid {
        Grid::build(mesh.clone(), &GridOptions { density, ..GridOptions::default() }, &|_| ())
    }

    #[test]
    fn the_model_predicts_the_tree_of_a_scan() {
        let mesh = statue::generate(60_000, &|_| ());
        for density in DENSITIES {
            let grid = built(&mesh, Some(density));
            let references = grid.figures().references as f64 / grid.mesh().n_triangles() as f64;
            let predicted = Survey::new(&mesh, LEAF_SIZE).references_per_triangle(density);
            assert!((predicted / references - 1.0).abs() < 0.1, "{references}, {predicted}");
        }
    }

    #[test]
    fn the_choice_has_nearly_the_fewest_references() {
        for n_triangles in [40_000, 70_000, 120_000] {
            let mesh = statue::generate(n_triangles, &|_| ());
            let chosen = built(&mesh, None);
            let fewest = DENSITIES.map(|density| built(&mesh, Some(density)).figures().references).into_iter().min();
            let (ours, fewest) = (chosen.figures().references as f64, fewest.unwrap() as f64);
            assert!(ours <= 1.05 * fewest, "{n_triangles}: {ours} and {fewest}");
            assert_eq!(chosen.figures().density, Survey::new(&mesh, LEAF_SIZE).best_density());
            assert!(Survey::new(&mesh, LEAF_SIZE).is_even());
        }
    }

    #[test]
    fn a_scene_of_triangles_of_all_sizes_is_uneven() {
        let (mut mesh, hall) = (statue::generate(60_000, &|_| ()), statue::generate(20_000, &|_| ()));
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend(hall.vertices.iter().map(|vertex| vertex.map(|x| 300.0 * x)));
        mesh.triangles.extend(hall.triangles.iter().map(|corners| corners.map(|corner| corner + first)));
        assert_eq!(density(&mesh, &GridOptions::default()), UNEVEN_DENSITY);
        assert!(!Survey::new(&mesh, LEAF_SIZE).is_even());
    }

    #[test]
    fn any_scene_has_a_choice() {
        let odd = [
            Mesh::default(),
            Mesh { vertices: vec![[0.0; 3]], triangles: vec![[0; 3]; 40], ..Mesh::default() },
            Mesh { vertices: vec![[0.0; 3], [1.0; 3], [2.0; 3]], triangles: vec![[0, 1, 2]], ..Mesh::default() },
            Mesh {
                vertices: vec![[0.0; 3], [1e18, 0.0, 0.0], [0.0, 1e18, 0.0]],
                triangles: vec![[0, 1, 2]; 3],
                ..Mesh::default()
            },
            Mesh {
                vertices: vec![[0.0; 3], [1e-20, 0.0, 0.0], [0.0, 1e-20, 0.0]],
                triangles: vec![[0, 1, 2]; 17],
                ..Mesh::default()
            },
        ];
        for mesh in odd {
            assert!(GridOptions::DENSITIES.contains(&density(&mesh, &GridOptions::default())), "{mesh:?}");
        }
    }
}
