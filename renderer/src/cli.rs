//! The command line of the `renderer` program, which the wall also uses to start local render servers.

pub mod appearance_args;
pub mod generate;
pub mod key;
pub mod path_bytes;
pub mod progress;
pub mod scene_args;
pub mod trace;

use std::{
    ffi::OsString,
    fmt::Display,
    io::{ErrorKind, IsTerminal, Write},
    process::ExitCode,
};

use anyhow::{Context, Result};
use clap::{Parser, Subcommand};

use crate::{
    cli::{generate::GenerateArgs, key::KeyArgs, trace::TraceArgs},
    server::connect::{self, ConnectArgs},
};

/// Render server of the display wall
#[derive(Debug, Parser)]
#[command(version, about, long_about = None)]
pub struct Cli {
    /// The subcommand.
    #[command(subcommand)]
    pub command: Command,
}

/// Subcommands of `renderer`.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Render for a wall until told to stop
    Connect(ConnectArgs),
    /// Write a built-in model to a file
    Generate(GenerateArgs),
    /// Make a key file, which lets render servers and walls on other machines trust each other
    Key(KeyArgs),
    /// Render one picture without a network
    Trace(TraceArgs),
}

/// Parses the program's command line; on an error, prints it and exits.
pub fn parse<P: Parser>() -> P {
    try_parse(std::env::args_os()).unwrap_or_else(|error| error.exit())
}

/// Parses a command line; the first argument is the program's name.
pub(crate) fn try_parse<P: Parser>(
    arguments: impl IntoIterator<Item = impl Into<OsString> + Clone>,
) -> Result<P, clap::Error> {
    let mut command = with_negative_numbers(P::command());
    let matches = command.try_get_matches_from_mut(arguments)?;
    P::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// Lets options take negative numbers as values, so that the error names the option's range instead of an unknown option.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    command
        .mut_args(|arg| if arg.get_action().takes_values() { arg.allow_negative_numbers(true) } else { arg })
        .mut_subcommands(with_negative_numbers)
}

/// Runs a subcommand.
pub fn run(command: Command) -> Result<()> {
    match command {
        Command::Connect(args) => connect::run(args),
        Command::Generate(args) => generate::run(&args),
        Command::Key(args) => key::run(&args),
        Command::Trace(args) => trace::run(&args),
    }
}

/// Logs to standard error, at the levels of the variable RUST_LOG or at defaults for operators.
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

/// Prints a line to standard output. A closed pipe is no error; a full disk is.
pub fn say(line: impl Display) -> Result<()> {
    match writeln!(std::io::stdout(), "{line}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// Prints an error with its chain of causes on one line.
pub fn exit_code(result: Result<()>) -> ExitCode {
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
