//! The `renderer` program: the render server's command line.

use std::process::ExitCode;

use renderer::{
    cli::{self, Cli},
    memory::EndingAllocator,
};

/// Without memory, the program ends with a line that names the cure.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

fn main() -> ExitCode {
    let command = cli::parse::<Cli>().command;
    cli::exit_code(cli::start().and_then(|()| cli::run(command)))
}
