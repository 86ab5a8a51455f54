//! The command line of the `renderer` program; the wall runs the same for its local render servers.

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
    io::{BufRead, ErrorKind, IsTerminal, Read, Write},
    process::ExitCode,
};

use anyhow::{Context, Result, ensure};
use clap::{Parser, Subcommand};

use crate::server::connect::{self, ConnectArgs};
use generate::GenerateArgs;
use key::KeyArgs;
use trace::TraceArgs;

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
    /// Render for a wall until told to stop
    Connect(ConnectArgs),
    /// Write a built-in model to a file
    Generate(GenerateArgs),
    /// Make a key file, which lets render servers and walls on other machines trust each other
    Key(KeyArgs),
    /// Render one picture without a network
    Trace(TraceArgs),
}

/// Reads a program's command line; if there is something wrong with it, ends the program with what that is.
pub fn parse<P: Parser>() -> P {
    try_parse(std::env::args_os()).unwrap_or_else(|error| error.exit())
}

/// Reads a command line, the program's name first.
pub(crate) fn try_parse<P: Parser>(
    arguments: impl IntoIterator<Item = impl Into<OsString> + Clone>,
) -> Result<P, clap::Error> {
    let mut command = with_negative_numbers(P::command());
    let matches = command.try_get_matches_from_mut(arguments)?;
    P::from_arg_matches(&matches).map_err(|error| error.format(&mut command))
}

/// The same command line, but what looks like a negative number is an option's value, which is told its range, and not
/// an option that does not exist.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    command
        .mut_args(|arg| if arg.get_action().takes_values() { arg.allow_negative_numbers(true) } else { arg })
        .mut_subcommands(with_negative_numbers)
}

/// Does it.
pub fn run(command: Command) -> Result<()> {
    match command {
        Command::Connect(args) => connect::run(args),
        Command::Generate(args) => generate::run(&args),
        Command::Key(args) => key::run(&args),
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
pub fn say(line: impl Display) -> Result<()> {
    match writeln!(std::io::stdout(), "{line}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// Bytes of a line that is read at most: paths are shorter on all systems.
const LONGEST_LINE: u64 = 1 << 16;

/// Reads the next line in place of the last; returns whether there is one. One that does not end is an error.
pub fn read_line(input: &mut impl BufRead, line: &mut String) -> Result<bool> {
    line.clear();
    let n_bytes = input.take(LONGEST_LINE).read_line(line)? as u64;
    ensure!(n_bytes < LONGEST_LINE, "a line has {LONGEST_LINE} bytes or more");
    Ok(n_bytes > 0)
}

/// Prints an error as one line that names the whole chain of causes.
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
