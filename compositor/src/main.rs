//! The wall's program.

use std::{path::Path, process::ExitCode};

use compositor::cli::args::{Args, Command};
use renderer::memory::EndingAllocator;

/// Without memory, the program ends with a line that names the cure.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

fn main() -> ExitCode {
    quieten_device_select();
    let args: Args = renderer::cli::parse();
    let result = renderer::cli::start().and_then(|()| match args.command {
        Some(Command::Renderer(command)) => renderer::cli::run(command),
        Some(Command::Check(args)) => compositor::cli::check::run(&args),
        Some(Command::RemoteToken(args)) => compositor::remote::tokens::run(&args),
        Some(Command::Calibrate(args)) => compositor::cli::calibrate::run(&args),
        Some(Command::Import(args)) => compositor::cli::import::run(&args),
        Some(Command::Export(args)) => compositor::cli::export::run(&args),
        Some(Command::Annotations(args)) => compositor::cli::annotations::run(&args),
        None => compositor::cli::run::run(&args.wall),
    });
    renderer::cli::exit_code(result)
}

/// Without a folder for the session's sockets, Mesa's layer that sorts graphics cards complains twice, in words of a
/// library of Wayland, and then sorts nothing: it is left out.
fn quieten_device_select() {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none_or(|folder| !Path::new(&folder).is_dir()) {
        // SAFETY: the program has no other thread yet.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
}
