//! The wall's program.

use std::process::ExitCode;

use compositor::cli::args::{Args, Command};

fn main() -> ExitCode {
    let args: Args = renderer::cli::parse();
    renderer::cli::start_logging();
    let result = match args.command {
        Some(Command::Renderer(command)) => renderer::cli::run(command),
        Some(Command::Check(args)) => compositor::cli::check::run(&args),
        None => compositor::cli::run::run(&args.wall),
    };
    renderer::cli::exit_code(result)
}
