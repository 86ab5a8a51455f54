//! `renderer generate`: writes the built-in model to a file.

use std::path::PathBuf;

use anyhow::Context;
use clap::{
    Args, Subcommand,
    builder::{PathBufValueParser, TypedValueParser},
};
use shared::printable::counted;

use crate::{
    cli::{between, check_writable, picture_args::with_ending, progress::Progress, say, stop::Task},
    formats::ply,
    model::statue,
};

/// The model to generate.
#[derive(Debug, Args)]
pub struct GenerateArgs {
    #[command(subcommand)]
    model: Model,
}

#[derive(Debug, Subcommand)]
enum Model {
    /// The built-in statue, as a binary PLY file
    Statue {
        /// Approximate number of triangles
        #[arg(long, value_name = "N", default_value_t = statue::DEFAULT_TRIANGLES,
            value_parser = between(statue::FEWEST_TRIANGLES..=statue::MOST_TRIANGLES))]
        triangles: u32,
        /// The file to write, .ply; an old one is replaced only when the new one is complete
        #[arg(value_name = "FILE.ply",
            value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "ply")))]
        out: PathBuf,
    },
}

/// Writes the file and prints what it holds.
pub fn run(args: &GenerateArgs) -> anyhow::Result<()> {
    let Model::Statue { triangles, out } = &args.model;
    check_writable(out)?;
    let mesh = {
        let progress = Progress::new(format!("generating {triangles} triangles"));
        statue::generate(*triangles, &|fraction| progress.set(fraction))
    };
    let _task = Task::named(format!("writing {}", out.display()));
    ply::write(out, &mesh).with_context(|| format!("cannot write {}", out.display()))?;
    say(format_args!(
        "{}: {}, {}",
        out.display(),
        counted(mesh.vertices.len(), "vertex"),
        counted(mesh.triangles.len(), "triangle")
    ))
}
