//! The command line of the `renderer` program; the wall runs the same for its local render servers.

use std::{
    fmt::Display,
    io::{ErrorKind, IsTerminal, Write},
    process::ExitCode,
};

use anyhow::Context;

use clap::{Parser, Subcommand};

use crate::{
    chart::{self, ChartArgs},
    connect::{self, ConnectArgs},
    generate::{self, GenerateArgs},
    key::{self, KeyArgs},
    stability::{self, StabilityArgs},
    trace::{self, TraceArgs},
};

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
    /// Measure speed against accuracy of ways to intersect rays with triangles, and draw a chart
    Chart(ChartArgs),
    /// Render for a wall until told to stop
    Connect(ConnectArgs),
    /// Write a built-in model to a file
    Generate(GenerateArgs),
    /// Make a key file, which lets render servers and walls on other machines trust each other
    Key(KeyArgs),
    /// Try the ways to intersect rays with triangles where they fail
    Stability(StabilityArgs),
    /// Trace frames without a network, and measure them
    Trace(TraceArgs),
}

/// Does it.
pub fn run(command: Command) -> anyhow::Result<()> {
    match command {
        Command::Chart(args) => chart::run(&args),
        Command::Connect(args) => connect::run(args),
        Command::Generate(args) => generate::run(&args),
        Command::Key(args) => key::run(&args),
        Command::Stability(args) => stability::run(&args),
        Command::Trace(args) => trace::run(&args),
    }
}

/// Logs to standard error: what a person should know, or what the variable RUST_LOG asks for.
pub fn start_logging() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn,winit=error,renderer=info,compositor=info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .init();
}

/// Prints a line to standard output. Nobody listening any more is no error; a full disk is.
pub fn say(line: impl Display) -> anyhow::Result<()> {
    match writeln!(std::io::stdout(), "{line}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// Prints an error as one line that names the whole chain of causes.
pub fn exit_code(result: anyhow::Result<()>) -> ExitCode {
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
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
