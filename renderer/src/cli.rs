//! The command line of the `renderer` program; the wall runs the same for its local render servers.

use clap::{Parser, Subcommand};

use crate::generate::{self, GenerateArgs};
use crate::trace::{self, TraceArgs};

/// Render server of the display wall
#[derive(Debug, Parser)]
#[command(version, about, long_about = None)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What the program can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Write a built-in model to a file
    #[command(subcommand_required = true)]
    Generate(GenerateArgs),
    /// Trace frames without a network, and measure them
    Trace(TraceArgs),
}

/// Does it.
pub fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Generate(args) => generate::run(&args),
        Command::Trace(args) => trace::run(&args),
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
