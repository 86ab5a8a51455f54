//! The laboratory: everything that only measures. It stands on top of the programs and uses their own code, so that what
//! is measured is what runs.
//!
//! [`trace`], [`chart`] and [`stability`] are its commands. [`plot`], [`statistics`], [`random`] and [`vector`] serve all of
//! them.

pub mod chart;
pub mod plot;
pub mod random;
pub mod stability;
pub mod statistics;
pub mod trace;
pub mod vector;

use anyhow::Result;
use clap::{Parser, Subcommand};

use crate::{chart::ChartArgs, stability::StabilityArgs, trace::LabTraceArgs};

/// Laboratory of the display wall
#[derive(Debug, Parser)]
#[command(version, about, long_about = None)]
pub struct Cli {
    /// What to measure.
    #[command(subcommand)]
    pub command: Command,
}

/// What the program can measure.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Measure speed against accuracy of ways to intersect rays with triangles, and draw a chart
    Chart(ChartArgs),
    /// Try the ways to intersect rays with triangles where they fail
    Stability(StabilityArgs),
    /// Trace frames as `renderer trace` does, and measure more of them
    Trace(Box<LabTraceArgs>),
}

/// Runs a command.
///
/// # Errors
/// What the command cannot do.
pub fn run(command: &Command) -> Result<()> {
    match command {
        Command::Chart(args) => chart::run(args),
        Command::Stability(args) => stability::run(args),
        Command::Trace(args) => trace::run(args),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        super::Cli::command().debug_assert();
    }
}
