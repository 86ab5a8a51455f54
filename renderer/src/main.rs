//! The `renderer` program.

use std::process::ExitCode;

use clap::Parser;
use renderer::cli::{self, Cli};

fn main() -> ExitCode {
    let command = Cli::parse().command;
    cli::start_logging();
    cli::exit_code(cli::run(command))
}
