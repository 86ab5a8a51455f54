//! The `lab` program.

use std::process::ExitCode;

use renderer::cli;

fn main() -> ExitCode {
    let command = cli::parse::<lab::Cli>().command;
    cli::start_logging();
    cli::exit_code(lab::run(command))
}
