//! Command-line options of the grid, shared by all programs that build one.

use crate::{
    cli::free_memory::FreeMemory,
    grid::{GridOptions, MemoryBudget, Storage},
    model::scene::SceneSource,
    scene_file::{SceneStore, file::is_scene_file},
};

/// Each option names it: a heading of the struct would also head the options after it.
const HEADING: &str = "The grid: changes time and memory, but no picture";

/// Storage of mesh and grid. No option changes a picture.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct SceneArgs {
    /// Cells of the grid for each triangle, the paper's ρ [default: chosen for the scene]
    #[arg(long, help_heading = HEADING, value_name = "RHO", value_parser = density)]
    density: Option<f64>,

    /// Storage of the grid: plain or row-displacement for the paper's uniform grid; masks for a tree that is finer where
    /// triangles are dense; or compact for the same in the least memory, in which frames take up to twice as long, and
    /// those with ambient occlusion or paths up to four times
    #[arg(long, help_heading = HEADING, value_name = "HOW", default_value_t = Storage::default())]
    storage: Storage,

    /// Levels of empty macrocells over the paper's uniform grid that a ray may skip
    #[arg(long, help_heading = HEADING, value_name = "N", default_value_t = GridOptions::default().macrocell_levels,
        value_parser = macrocell_levels)]
    macrocell_levels: u8,

    /// Limit of the memory to load and build a scene, for example 512M or 1.5G; what takes more is built in temporary files, or,
    /// where there is no disk for them, with a coarser grid [default: three quarters of what is free; the local render
    /// servers of a wall share it, others that start by themselves do not]
    #[arg(long, help_heading = HEADING, value_name = "SIZE")]
    memory_budget: Option<MemoryBudget>,

    /// Build the model's scene at each start, and keep no file of it
    #[arg(long, help_heading = HEADING)]
    no_cache: bool,
}

impl SceneArgs {
    /// The grid options that the arguments describe.
    pub fn options(&self) -> GridOptions {
        let Self { density, storage, macrocell_levels, memory_budget, no_cache: _ } = *self;
        let memory_budget = memory_budget.unwrap_or_else(|| budget_of_machine(1));
        GridOptions { density, macrocell_levels, storage, memory_budget }
    }

    /// The same for `n_programs` that divide the free memory of this machine, if no limit was asked for.
    #[must_use]
    pub fn shared_by(self, n_programs: u32) -> Self {
        let memory_budget = self.memory_budget.unwrap_or_else(|| budget_of_machine(n_programs));
        Self { memory_budget: Some(memory_budget), ..self }
    }

    /// Logs the limit that `n_programs` choose for themselves, if none was asked for.
    pub fn log_budget(&self, n_programs: u32) {
        if self.memory_budget.is_none() {
            let budget = budget_of_machine(n_programs);
            let each = if n_programs > 1 { "each local render server" } else { "the render server" };
            tracing::info!("{each} may take {budget} of memory: --memory-budget sets another limit");
        }
    }

    /// Warns of options that were given with a scene file, which keeps its own grid.
    pub fn warn_of_scene_file(&self, source: &SceneSource) {
        let given = [
            self.density.map(|_| "--density"),
            (self.storage != Storage::default()).then_some("--storage"),
            self.memory_budget.map(|_| "--memory-budget"),
        ];
        let given: Vec<_> = given.into_iter().flatten().collect();
        if let SceneSource::File(path) = source
            && !given.is_empty()
            && is_scene_file(path)
        {
            tracing::warn!("{source}: a scene file keeps its grid, without effect: {}", given.join(", "));
        }
    }

    /// Where scenes come from, and where they are kept.
    pub fn store(&self) -> SceneStore {
        if self.no_cache { SceneStore::default() } else { SceneStore::of_user() }
    }

    /// The arguments that give another program the same options.
    pub fn to_arguments(&self) -> Vec<String> {
        let density = self.density.map(|density| format!("--density={density}"));
        let budget = self.memory_budget.map(|budget| format!("--memory-budget={budget}"));
        let others = [format!("--storage={}", self.storage), format!("--macrocell-levels={}", self.macrocell_levels)];
        let no_cache = self.no_cache.then(|| "--no-cache".to_owned());
        density.into_iter().chain(budget).chain(others).chain(no_cache).collect()
    }
}

fn budget_of_machine(n_programs: u32) -> MemoryBudget {
    let FreeMemory { shared, own } = FreeMemory::at_start();
    MemoryBudget::of_machine(shared, own, n_programs)
}

fn density(text: &str) -> Result<f64, String> {
    let range = GridOptions::DENSITIES;
    let density = text.parse().ok().filter(|density| range.contains(density));
    density.ok_or_else(|| format!("the density must be from {} to {} cells per triangle", range.start(), range.end()))
}

fn macrocell_levels(text: &str) -> Result<u8, String> {
    let range = GridOptions::MACROCELL_LEVELS;
    let levels = text.parse().ok().filter(|levels| range.contains(levels));
    levels.ok_or_else(|| format!("there are from {} to {} levels of macrocells", range.start(), range.end()))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli;

    #[derive(Debug, Parser)]
    struct Program {
        #[command(flatten)]
        scene: SceneArgs,
    }

    fn parse(arguments: &[&str]) -> Result<SceneArgs, clap::Error> {
        cli::try_parse(["program"].iter().chain(arguments)).map(|program: Program| program.scene)
    }

    #[test]
    fn nothing_asked_for_is_the_default_and_the_memory_of_the_machine() {
        let asked = parse(&[]).unwrap();
        let memory_budget = budget_of_machine(1);
        assert_eq!(asked.options(), GridOptions { memory_budget, ..GridOptions::default() });
        // Each of many has less, and is told so.
        let shared = parse(&[]).unwrap().shared_by(4);
        assert_eq!(shared.options().memory_budget, budget_of_machine(4));
        assert!(shared.to_arguments().contains(&format!("--memory-budget={}", budget_of_machine(4))));
        assert_eq!(parse(&["--memory-budget", "2G"]).unwrap().shared_by(4).options().memory_budget.to_string(), "2G");
    }

    #[test]
    fn arguments_survive_being_handed_on() {
        let asked = [
            "--density",
            "0.1",
            "--storage",
            "row-displacement",
            "--macrocell-levels",
            "1",
            "--memory-budget",
            "0.123G",
        ];
        let options = parse(&asked).unwrap();
        let handed_on = options.to_arguments();
        let again = parse(&handed_on.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
        assert_eq!(again.options(), options.options());
        assert_ne!(again.options(), GridOptions::default());
    }

    #[test]
    fn values_out_of_range_are_answered_with_the_range() {
        for (arguments, told) in [
            (["--density", "0"], "from 0.015625 to 4096 cells per triangle"),
            (["--density", "NaN"], "from 0.015625 to 4096 cells per triangle"),
            (["--density", "5000"], "from 0.015625 to 4096 cells per triangle"),
            (["--macrocell-levels", "4"], "from 0 to 3 levels"),
            (["--density", "-1"], "from 0.015625 to 4096 cells per triangle"),
            (["--density", "much"], "from 0.015625 to 4096 cells per triangle"),
            (["--macrocell-levels", "-1"], "from 0 to 3 levels"),
            (["--memory-budget", "-1"], "from 16M to 1T"),
            (["--memory-budget", "1K"], "from 16M to 1T"),
            (["--storage", "hash"], "is not one of: plain, row-displacement, masks, compact"),
        ] {
            let error = parse(&arguments).unwrap_err().to_string();
            assert!(error.contains(told), "{arguments:?}: {error}");
        }
    }
}
