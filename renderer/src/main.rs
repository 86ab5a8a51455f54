//! The `renderer` program: the render server's command line.

use std::process::ExitCode;

use renderer::cli::{self, Cli};

fn main() -> ExitCode {
    let command = cli::parse::<Cli>().command;
    cli::start_logging();
    cli::exit_code(cli::run(command))
}
