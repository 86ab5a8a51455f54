//! The command line of the `renderer` program, which the wall also uses to start local render servers.

pub mod appearance_args;
pub mod build;
pub mod cache;
pub mod free_memory;
pub mod generate;
pub mod key;
pub mod large_file;
pub mod picture_args;
pub mod progress;
pub mod recent_log;
pub mod scene_args;
pub mod stop;
pub mod trace;

use std::{
    ffi::OsString,
    fmt::{Debug, Display},
    io::{self, ErrorKind, IsTerminal, Write},
    ops::RangeInclusive,
    path::Path,
    process::ExitCode,
    str::FromStr,
};

use anyhow::{Context, Result, anyhow};
use channel::files;
use clap::{Parser, Subcommand, error::ErrorKind as ParseErrorKind};
use shared::printable::{printable_line, printable_lines};
use tracing::{Subscriber, field::Field};
use tracing_subscriber::{
    EnvFilter,
    field::MakeExt,
    fmt::{MakeWriter, format},
    layer::SubscriberExt,
};

use crate::{
    cli::{
        build::BuildArgs,
        cache::CacheArgs,
        free_memory::{FreeMemory, addresses_left},
        generate::GenerateArgs,
        key::KeyArgs,
        recent_log::RecentLog,
        stop::Stopped,
        trace::TraceArgs,
    },
    memory::share_one_arena,
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
    /// Build a model's scene ahead, and write it to a file that walls and render servers use in its place
    Build(BuildArgs),
    /// List or clear the scenes of models that were shown on this machine
    Cache(CacheArgs),
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
    FreeMemory::at_start();
    try_parse(std::env::args_os()).unwrap_or_else(|error| {
        let is_help = error.kind() == ParseErrorKind::DisplayHelpOnMissingArgumentOrSubcommand;
        if is_help || !error.use_stderr() {
            error.exit()
        }
        eprintln!("{}", one_line(&error));
        std::process::exit(error.exit_code())
    })
}

/// An error of the command line, without the usage and the hint at --help that follow it.
fn one_line(error: &clap::Error) -> String {
    let text = error.to_string();
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let told = lines.take_while(|line| !line.starts_with("Usage:") && !line.starts_with("For more information"));
    let join = |text: String, line: &str| {
        let between = if text.ends_with(':') { " " } else { "; " };
        text + between + line
    };
    printable_line(&told.map(str::to_owned).reduce(|text, line| join(text, &line)).unwrap_or_default())
}

/// Parses whole numbers of a range.
pub fn between<T: FromStr + PartialOrd + Display>(
    range: RangeInclusive<T>,
) -> impl Fn(&str) -> Result<T, String> + Clone
where
    RangeInclusive<T>: Clone,
{
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        number.ok_or_else(|| match text.parse::<i128>() {
            Ok(_) => format!("{text} is not between {} and {}", range.start(), range.end()),
            Err(_) => format!("it is not a whole number between {} and {}", range.start(), range.end()),
        })
    }
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
        Command::Build(args) => build::run(&args),
        Command::Cache(args) => cache::run(&args),
        Command::Connect(args) => connect::run(args),
        Command::Generate(args) => generate::run(&args),
        Command::Key(args) => key::run(&args),
        Command::Trace(args) => trace::run(&args),
    }
}

/// Checks that a file can be written, before the work whose result it takes.
///
/// # Errors
/// The file or its folder cannot be written.
pub fn check_writable(path: &Path) -> Result<()> {
    files::check(path).map_err(|error| cannot_write(path, &error))
}

/// The error of a file that cannot be written, with its cure.
pub fn cannot_write(path: &Path, error: &io::Error) -> anyhow::Error {
    let cure = match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "free some of its disk, or name a file on another",
        ErrorKind::FileTooLarge => "let files grow larger (ulimit -f), or name one on another disk",
        _ => "name a file in a folder that is there and may be written",
    };
    anyhow!("cannot write {}: {error}; {cure}", path.display())
}

/// Starts what every program needs first: its log, the thread that listens for signals, and rayon's threads, which panic
/// if they are first asked for where the system has none left.
pub fn start() -> Result<()> {
    start_logging();
    if addresses_left().is_some() {
        share_one_arena();
    }
    stop::listen();
    rayon::ThreadPoolBuilder::new()
        .build_global()
        .context("the system starts no more threads: allow more (ulimit -u) or free memory")
}

/// Logs to standard error, at the levels of the variable RUST_LOG or at defaults for operators.
fn start_logging() {
    let filter = EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| EnvFilter::new("warn,winit=error,renderer=info,compositor=info"));
    // Fails only if a subscriber is set already.
    let log = log(filter, io::stderr, io::stderr().is_terminal());
    let _ = tracing::subscriber::set_global_default(log.with(RecentLog));
}

/// A log with one line for each event, whatever peers and files put into its message.
fn log(
    filter: EnvFilter,
    writer: impl for<'a> MakeWriter<'a> + Send + Sync + 'static,
    has_colors: bool,
) -> impl Subscriber {
    let field = |out: &mut format::Writer<'_>, field: &Field, value: &dyn Debug| {
        let name = if field.name() == "message" { String::new() } else { format!("{field}=") };
        write!(out, "{name}{}", printable_line(&format!("{value:?}")))
    };
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(writer)
        .with_ansi(has_colors)
        .with_target(false)
        .fmt_fields(format::debug_fn(field).delimited(" "))
        .finish()
}

/// Prints lines to standard output, without control characters. A closed pipe is no error; a full disk is.
pub fn say(lines: impl Display) -> Result<()> {
    match writeln!(io::stdout(), "{}", printable_lines(&lines.to_string())) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("cannot write to standard output"),
        _ => Ok(()),
    }
}

/// Prints an error with its chain of causes on one line, whatever files and peers put into it. Work that a signal has cut
/// off is no error of its own: its exit code names the signal.
pub fn exit_code(result: Result<()>) -> ExitCode {
    let Err(error) = result else { return ExitCode::SUCCESS };
    let text = printable_line(&format!("{error:#}"));
    match error.downcast_ref::<Stopped>() {
        Some(stopped) => {
            eprintln!("{text}");
            ExitCode::from(stopped.signal.exit_code())
        }
        None => {
            eprintln!("error: {text}");
            ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use clap::CommandFactory;

    use super::*;

    #[test]
    fn a_logged_text_forges_no_line_and_no_color() {
        #[derive(Clone, Default)]
        struct Written(Arc<Mutex<Vec<u8>>>);
        impl Write for Written {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0.lock().unwrap().write(bytes)
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let written = Written::default();
        let out = written.clone();
        let log = log(EnvFilter::new("info"), move || out.clone(), false);
        tracing::subscriber::with_default(log, || {
            let reason = "no\n2026-01-01T00:00:00Z  INFO forged\u{1b}[31m\u{9b}1m\u{202e}";
            tracing::warn!(count = 3, "lost: {reason}");
        });
        let text = String::from_utf8(written.0.lock().unwrap().clone()).unwrap();
        assert!(text.ends_with(" WARN lost: no 2026-01-01T00:00:00Z  INFO forged[31m1m count=3\n"), "{text:?}");
        assert_eq!(text.lines().count(), 1);
    }

    #[test]
    fn mistakes_on_the_command_line_take_one_plain_line() {
        for (arguments, told) in [
            (&["connect", "a", "--threads", "0"][..], "--threads <N>': 0 is not between 1 and 1024"),
            (&["connect", "a", "--threads", "-1"], "-1 is not between 1 and 1024"),
            (&["connect", "a", "--threads", "all"], "it is not a whole number between 1 and 1024"),
            (&["connect", "a", "--thread", "1"], "'--thread' found; tip: a similar argument exists: '--threads'"),
            (&["trace"], "were not provided: --image <FILE.png>"),
            (
                &["trace", "--camera", "a", "--up", "x", "--image", "a.png"],
                "'--camera <FILE>' cannot be used with '--up <AXIS>'",
            ),
            (&["generate", "statue", "st.obj"], "no other format is written: give a name that ends with .ply"),
            (&["trace", "a.ply", "--model", "b.ply"], "argument '[MODEL]' cannot be used with '--model <FILE>'"),
        ] {
            let line = one_line(&try_parse::<Cli>(["renderer"].iter().chain(arguments)).unwrap_err());
            assert!(line.starts_with("error: ") && line.ends_with(told), "{line}");
        }
    }

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
