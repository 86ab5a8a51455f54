//! Chooses the density of a scene's tree, and predicts time and memory for this and other storages.
//!
//! The tree divides cells into 4×4×4 until each holds at most [`LEAF_SIZE`] triangles, so densities 64 times apart give
//! the same leaves. In between, leaves of an even scan hold 16 to 256 triangles; the smaller they are, the more leaves
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
//! ten million triangles the predicted references are within 2 % of the built ones (`renderer trace --explain --json`
//! prints both). On CAD models and on a hall with a teapot the error is up to 40 %: a cube there holds several
//! surfaces, of triangles of all sizes. The variation of areas reveals such scenes, and they get a fixed density:
//! [`UNEVEN_DENSITY`].

use glam::{DVec3, Vec3};
use serde::Serialize;

use crate::{
    grid::{
        GridOptions, MeshLayout, Storage,
        build::{BOX_BYTES_PER_REFERENCE, PROGRAM_BYTES},
        traced::TracedMesh,
        tree::{CELLS_PER_BRICK, LEVELS, divide::LEAF_SIZE},
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

/// The density at which uniform grids are predicted: no other is much faster on the scans of the chart.
const UNIFORM_DENSITY: f64 = 4.0;

/// Triangles of a run.
const TRIANGLES_PER_RUN: usize = 16;

/// Most runs that are measured.
const MOST_RUNS: usize = 1024;

/// Width of the curve in (3), in the logarithm of a cell's triangles: fitted to the references of four scans and a bust
/// at eight densities.
const TRANSITION_WIDTH: f64 = 0.2 / 1.7;

/// Relative time that one more reference a triangle adds: the slope over the densities of the chart is 0.25 to 0.38 on
/// the bunny, Igea, the dragon and a knot of ten million triangles.
const TIME_PER_REFERENCE: f64 = 0.3;

/// Least relative time of uniform grids, which single rays walk, on even scenes; in the chart 7 to 14.
const UNIFORM_TIME: f64 = 9.0;

/// Relative time of uniform grids for each triangle of a cell: 273 in the hall with 18,000 triangles, 683 with 45,000.
const UNIFORM_TIME_PER_TRIANGLE: f64 = 1.0 / 66.0;

/// Bytes of row displacement a cell, occupied or not: 0.13 to 0.29 on scans at densities of 4 to 64.
const DISPLACED_BYTES_PER_CELL: f64 = 0.2;

/// Predicted memory and time of a scene's storage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Prediction {
    /// Storage of the cells.
    pub storage: &'static str,
    /// Storage of the triangles.
    pub mesh: &'static str,
    /// Cells per triangle.
    pub density: f64,
    /// Cells or leaves that list a triangle.
    pub references_per_triangle: f64,
    /// Triangles of an occupied cell's list, averaged over triangles.
    pub triangles_per_list: f64,
    /// Bytes of mesh and grid.
    pub bytes_per_triangle: f64,
    /// CPU time of camera rays, relative to the choice.
    pub relative_time: f64,
    /// Whether loading the scene stays within the memory budget.
    pub fits: bool,
    /// Whether this is the choice.
    pub is_chosen: bool,
}

/// The reason for a scene's density.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reason {
    /// The options set it, or it is the paper's.
    Asked,
    /// It gives the fewest references.
    FewestReferences,
    /// The model does not fit the scene: it is small, uneven or empty.
    #[default]
    Uneven,
}

/// A scene's storage and density, the reason, and predictions for others.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Choice {
    /// Cells per triangle.
    pub density: f64,
    /// Reason for this density.
    pub reason: Reason,
    /// Predictions, that of the choice first; empty for an empty scene.
    pub predictions: Vec<Prediction>,
}

/// Means over the triangles of a run.
struct Run {
    area: f64,
    box_sides: f64,
    projected_areas: f64,
}

/// Measurements of a mesh before its grid is built.
struct Survey<'a> {
    mesh: &'a Mesh,
    n_triangles: usize,
    extent: DVec3,
    runs: Vec<Run>,
}

impl Choice {
    /// Measures some of a mesh's triangles, and chooses the density unless the options set it: in an even scene that of
    /// the fewest references, which is the fastest and nearly the smallest.
    pub(crate) fn new(mesh: &Mesh, options: &GridOptions) -> Self {
        let survey = Survey::new(mesh);
        let asked = match options.storage {
            Storage::Tree => options.density,
            // The paper's structure has the paper's density.
            Storage::Plain | Storage::RowDisplacement => options.density.or(Some(GridOptions::PAPER_DENSITY)),
        };
        if survey.runs.is_empty() {
            return Self { density: asked.unwrap_or(UNEVEN_DENSITY), ..Self::default() };
        }

        // Choose the density of the fewest references.
        let tree =
            |density| survey.predict(&GridOptions { density: Some(density), storage: Storage::Tree, ..*options });
        let tree_predictions = DENSITIES.map(tree);
        let best =
            tree_predictions.into_iter().min_by(|a, b| a.references_per_triangle.total_cmp(&b.references_per_triangle));
        let (density, reason) = match (asked, best) {
            (Some(density), _) => (density, Reason::Asked),
            (None, Some(best)) if survey.is_even() => (best.density, Reason::FewestReferences),
            (None, _) => (UNEVEN_DENSITY, Reason::Uneven),
        };
        let chosen = survey.predict(&GridOptions { density: Some(density), ..*options });

        // Predict other storages too, relative to the choice.
        let other_mesh = match options.mesh {
            MeshLayout::Indexed => MeshLayout::Flat,
            MeshLayout::Flat => MeshLayout::Indexed,
        };
        let uniform = |storage| survey.predict(&GridOptions { density: Some(UNIFORM_DENSITY), storage, ..*options });
        let others = tree_predictions.into_iter().chain([
            survey.predict(&GridOptions { density: Some(density), mesh: other_mesh, ..*options }),
            uniform(Storage::RowDisplacement),
            uniform(Storage::Plain),
        ]);
        let mut predictions = vec![Prediction { is_chosen: true, ..chosen }];
        predictions.extend(others.filter(|other| *other != chosen));
        for prediction in &mut predictions {
            prediction.relative_time /= chosen.relative_time;
        }
        Self { density, reason, predictions }
    }

    /// The choice, in one line.
    pub fn summary(&self) -> String {
        let Some(chosen) = self.predictions.first() else { return "the scene is empty".to_owned() };
        let Prediction { storage, mesh, density, triangles_per_list, .. } = chosen;
        let origin = if self.reason == Reason::Asked { "as set" } else { "chosen" };
        let lists = if *storage == <&str>::from(Storage::Tree) { "leaf" } else { "cell" };
        format!(
            "{storage}, {mesh} mesh, {density} cells a triangle ({origin}): about {triangles_per_list:.0} triangles a {lists}"
        )
    }

    /// The choice, its reason, and a table of all predictions.
    pub fn explanation(&self) -> String {
        let why = match self.reason {
            Reason::Asked => "The density is set by --density, or is the paper's.",
            Reason::FewestReferences => "The scene is even: at this density the fewest leaves share triangles.",
            Reason::Uneven => {
                "The scene is small or uneven: densities differ little, and the model cannot predict how."
            }
        };
        let mut lines = vec![
            format!("grid        {}", self.summary()),
            format!("            {why}"),
            format!(
                "{:18} {:8} {:>7} {:>10} {:>10} {:>9} {:>6}",
                "  predicted", "mesh", "density", "lists/tri", "bytes/tri", "time", "fits"
            ),
        ];
        lines.extend(self.predictions.iter().map(|prediction| {
            format!(
                "{} {:16} {:8} {:7} {:10.2} {:10.1} {:8.2}× {:>6}",
                if prediction.is_chosen { "*" } else { " " },
                prediction.storage,
                prediction.mesh,
                prediction.density,
                prediction.references_per_triangle,
                prediction.bytes_per_triangle,
                prediction.relative_time,
                if prediction.fits { "yes" } else { "no" }
            )
        }));
        lines.join("\n")
    }
}

impl<'a> Survey<'a> {
    fn new(mesh: &'a Mesh) -> Self {
        let bounds = mesh.bounds();
        let [min, max] = [bounds.min, bounds.max].map(|corner| Vec3::from_array(corner).as_dvec3());
        let n_runs = mesh.triangles.len().div_ceil(TRIANGLES_PER_RUN).min(MOST_RUNS);
        let first_triangle_of =
            |run: usize| run * mesh.triangles.len().saturating_sub(TRIANGLES_PER_RUN) / n_runs.max(2).saturating_sub(1);
        let runs = (0..n_runs).filter_map(|run| Run::of(mesh, first_triangle_of(run))).collect();
        Self { mesh, n_triangles: mesh.triangles.len() - mesh.n_rejected, extent: max - min, runs }
    }

    /// Whether the model fits the scene.
    fn is_even(&self) -> bool {
        let n = self.runs.len() as f64;
        let logarithms = || self.runs.iter().map(|run| run.area.ln());
        let mean = logarithms().sum::<f64>() / n;
        let variance = logarithms().map(|logarithm| (logarithm - mean).powi(2)).sum::<f64>() / n;
        self.n_triangles >= FEWEST_TRIANGLES && variance.sqrt() < MOST_VARIATION
    }

    /// Predicts memory and time of a storage; the time has no unit yet.
    fn predict(&self, options: &GridOptions) -> Prediction {
        let GridOptions { density, storage, mesh, .. } = *options;
        let density = density.unwrap_or(GridOptions::PAPER_DENSITY);
        let (_, cell_size) = resolution(self.extent, self.n_triangles, density);
        let is_tree = storage == Storage::Tree;

        // Average the lists over all runs.
        let lists = self
            .runs
            .iter()
            .map(|run| if is_tree { run.lists_in_tree(cell_size) } else { run.lists_in_cubes(cell_size) });
        let (mut references, mut triangles_per_list) = (0.0, 0.0);
        for (n, triangles) in lists {
            references += n / self.runs.len() as f64;
            triangles_per_list += triangles / self.runs.len() as f64;
        }
        let is_flat = mesh == MeshLayout::Flat;
        let n_triangles = self.n_triangles as f64;
        let mesh_bytes = if is_flat { 40.0 * n_triangles } else { TracedMesh::bytes_in_order(self.mesh, false) as f64 };

        // Sum up the bytes: references, boxes, and the lists' starts.
        let tree_bytes = (4 + BOX_BYTES_PER_REFERENCE) as f64 * references + 4.0 * references / triangles_per_list;
        let (grid_bytes, relative_time) = match storage {
            Storage::Tree => (tree_bytes, 1.0 + TIME_PER_REFERENCE * (references - 1.0)),
            Storage::Plain => (4.0 * (references + density), 0.0),
            Storage::RowDisplacement => (4.0 * references + DISPLACED_BYTES_PER_CELL * density, 0.0),
        };
        let uniform_time = UNIFORM_TIME.max(UNIFORM_TIME_PER_TRIANGLE * triangles_per_list);

        // Compare the peak with the budget, as the build does.
        let peak = TracedMesh::peak_bytes(self.mesh, is_flat) as f64
            + (grid_bytes - if is_tree { BOX_BYTES_PER_REFERENCE as f64 * references } else { 0.0 }) * n_triangles;
        let ordered_bytes = TracedMesh::bytes_in_order(self.mesh, is_flat) as f64 + grid_bytes * n_triangles;
        let needed = PROGRAM_BYTES as f64 + peak.max(ordered_bytes);
        Prediction {
            storage: storage.into(),
            mesh: mesh.into(),
            density,
            references_per_triangle: references,
            triangles_per_list,
            bytes_per_triangle: mesh_bytes / n_triangles + grid_bytes,
            relative_time: if is_tree { relative_time } else { uniform_time },
            fits: !options.memory_budget.is_exceeded_by(needed as u64),
            is_chosen: false,
        }
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

    /// The same for the leaves of a tree over cells of a side: (3) of the model.
    fn lists_in_tree(&self, cell_size: f64) -> (f64, f64) {
        let (mut references, mut triangles_per_list, mut divided) = (0.0, 0.0, 1.0);
        let mut side = cell_size * f64::from(CELLS_PER_BRICK);
        for level in 0..=LEVELS {
            let (here, triangles) = self.lists_in_cubes(side);
            side /= 4.0;
            let (below, _) = self.lists_in_cubes(side);
            // The tree stops dividing where triangles are larger than cells.
            let is_last = level == LEVELS || below >= 8.0 * here;
            let part =
                if is_last { 1.0 } else { 1.0 / (1.0 + (triangles / LEAF_SIZE as f64).powf(1.0 / TRANSITION_WIDTH)) };
            references += divided * part * here;
            triangles_per_list += divided * part * triangles;
            divided -= divided * part;
        }
        (references, triangles_per_list)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        grid::{Grid, MemoryBudget},
        model::statue,
    };

    fn built(mesh: &Mesh, density: Option<f64>) -> Grid {
        Grid::build(mesh.clone(), &GridOptions { density, ..GridOptions::default() }, &|_| ())
    }

    #[test]
    fn the_model_predicts_the_tree_of_a_scan() {
        let mesh = statue::generate(60_000, &|_| ());
        for density in DENSITIES {
            let grid = built(&mesh, Some(density));
            let (figures, chosen) = (grid.figures(), grid.choice().predictions[0]);
            let n_triangles = grid.mesh().n_triangles() as f64;
            let references = figures.references as f64 / n_triangles;
            let bytes = (grid.mesh().n_bytes() + grid.n_bytes()) as f64 / n_triangles;
            assert!((chosen.references_per_triangle / references - 1.0).abs() < 0.1, "{references}, {chosen:?}");
            assert!((chosen.bytes_per_triangle / bytes - 1.0).abs() < 0.05, "{bytes}, {chosen:?}");
            assert!(grid.choice().reason == Reason::Asked && chosen.is_chosen && chosen.relative_time == 1.0);
        }
    }

    #[test]
    fn the_choice_has_nearly_the_fewest_references() {
        for n_triangles in [40_000, 70_000, 120_000] {
            let mesh = statue::generate(n_triangles, &|_| ());
            let chosen = built(&mesh, None);
            let fewest = DENSITIES.map(|density| built(&mesh, Some(density)).figures().references).into_iter().min();
            let (ours, fewest) = (chosen.figures().references as f64, fewest.unwrap() as f64);
            assert!(ours <= 1.05 * fewest, "{n_triangles}: {ours} and {fewest}, {:?}", chosen.choice());
            assert!(
                chosen.choice().reason == Reason::FewestReferences
                    && chosen.figures().density == chosen.choice().density
            );
        }
    }

    #[test]
    fn a_scene_of_triangles_of_all_sizes_is_uneven() {
        let (mut mesh, hall) = (statue::generate(60_000, &|_| ()), statue::generate(20_000, &|_| ()));
        let first = mesh.vertices.len() as u32;
        mesh.vertices.extend(hall.vertices.iter().map(|vertex| vertex.map(|x| 300.0 * x)));
        mesh.triangles.extend(hall.triangles.iter().map(|corners| corners.map(|corner| corner + first)));
        let choice = Choice::new(&mesh, &GridOptions::default());
        assert_eq!((choice.density, choice.reason), (UNEVEN_DENSITY, Reason::Uneven));
    }

    #[test]
    fn storages_beyond_the_budget_do_not_fit() {
        let mesh = statue::generate(200_000, &|_| ());
        let memory_budget: MemoryBudget = "52M".parse().unwrap();
        let choice = Choice::new(&mesh, &GridOptions { memory_budget, ..GridOptions::default() });
        let plain = choice.predictions.iter().find(|prediction| prediction.storage == "plain").unwrap();
        assert!(choice.predictions[0].fits && !plain.fits, "{plain:?}");
        assert!(choice.explanation().lines().count() > 8 && choice.explanation().contains("* masks"));
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
            let choice = Choice::new(&mesh, &GridOptions::default());
            assert!(GridOptions::DENSITIES.contains(&choice.density), "{choice:?}");
            assert!(choice.predictions.iter().all(|p| p.bytes_per_triangle.is_finite() && p.relative_time.is_finite()));
            assert!(!choice.explanation().is_empty());
        }
    }
}
