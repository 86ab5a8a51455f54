//! The `lab` program.

use std::process::ExitCode;

use renderer::{cli, memory::EndingAllocator};

/// Without memory, the program ends with a line that names the cure.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

fn main() -> ExitCode {
    let command = cli::parse::<lab::Cli>().command;
    cli::exit_code(cli::start().and_then(|()| lab::run(command)))
}
