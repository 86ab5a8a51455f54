//! The laboratory: everything that measures and compares, and nothing that a wall needs. It measures the programs' own
//! code.
//!
//! [`mod@bench`], [`chart`], [`detail`], [`large`], [`stability`] and [`trace`] are its commands; [`farm`] and [`light`] serve the examples. [`files`], [`plot`],
//! [`random`], [`statistics`] and [`vector`] serve all of them.

mod bench;
mod chart;
mod detail;
pub mod farm;
mod files;
mod large;
pub mod light;
mod plot;
mod random;
mod stability;
pub mod statistics;
pub mod trace;
mod vector;

use anyhow::Result;
use clap::{Parser, Subcommand};

use crate::{
    bench::BenchArgs, chart::ChartArgs, detail::DetailArgs, large::LargeArgs, stability::StabilityArgs,
    trace::TraceArgs,
};

/// Measures what a display wall runs
#[derive(Debug, Parser)]
#[command(version, about, long_about = None)]
pub struct Cli {
    /// The measurement.
    #[command(subcommand)]
    pub command: Command,
}

/// The measurements.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Chart the speed of intersection methods against accuracy, memory and sharpness, and of light against its error
    Chart(ChartArgs),
    /// Try intersection methods in difficult cases, and count wrong hits
    Stability(StabilityArgs),
    /// Repeat the paper's experiment: bytes and time per frame by division and number of render servers
    Bench(BenchArgs),
    /// Measure what a coarser stand-in for a very fine model would save, and what it costs
    Detail(DetailArgs),
    /// Measure very large models: building, starting, frames and memory
    Large(LargeArgs),
    /// Trace frames without a network, and measure them
    Trace(Box<TraceArgs>),
    /// Run a render server: `lab bench` starts them
    #[command(subcommand, hide = true)]
    Renderer(Box<renderer::cli::Command>),
}

/// Runs a command.
///
/// # Errors
/// The command cannot be done; the text says why.
pub fn run(command: Command) -> Result<()> {
    match command {
        Command::Bench(args) => bench::run(&args),
        Command::Chart(args) => chart::run(&args),
        Command::Detail(args) => detail::run(&args),
        Command::Large(args) => large::run(&args),
        Command::Stability(args) => stability::run(&args),
        Command::Trace(args) => trace::run(&args),
        Command::Renderer(command) => renderer::cli::run(*command),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn a_bench_has_a_folder_for_its_figures_or_measures_the_display() {
        let parse = |args: &[&str]| Cli::try_parse_from(["lab", "bench"].iter().chain(args)).is_ok();
        assert!(parse(&["--out", "figures"]) && parse(&["--display"]) && parse(&["--display", "--json"]));
        for refused in [&[][..], &["--display", "--out", "figures"], &["--json", "--out", "figures"], &["--json"]] {
            assert!(!parse(refused), "{refused:?}");
        }
    }
}
