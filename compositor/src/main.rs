//! The wall's program.

use std::process::ExitCode;

use compositor::cli::args::{Args, Command};
use renderer::memory::EndingAllocator;

/// Without memory, the program ends with a line that names the cure.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

fn main() -> ExitCode {
    let args: Args = renderer::cli::parse();
    let result = renderer::cli::start().and_then(|()| match args.command {
        Some(Command::Renderer(command)) => renderer::cli::run(command),
        Some(Command::Check(args)) => compositor::cli::check::run(&args),
        None => compositor::cli::run::run(&args.wall),
    });
    renderer::cli::exit_code(result)
}
