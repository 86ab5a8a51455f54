//! `renderer build`: writes a model's scene to a file.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use channel::files;
use clap::builder::{PathBufValueParser, TypedValueParser};
use shared::printable::{bytes, counted};

use crate::{
    cli::{
        between, check_writable,
        large_file::warn_of_large_file,
        picture_args::{TreatmentArgs, with_ending},
        progress::Progress,
        say,
        scene_args::SceneArgs,
    },
    model::scene::SceneSource,
    render::threads,
    scene_file::{cache::ENDING, store},
};

/// The model, and the file to write.
#[derive(Debug, clap::Args)]
pub struct BuildArgs {
    /// The model's file: PLY, OBJ, STL, glTF or GLB
    #[arg(value_name = "MODEL")]
    model: PathBuf,

    /// The scene file to write, .raywall; an old one is replaced only when the new one is complete
    #[arg(value_name = "FILE.raywall",
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, ENDING)))]
    out: PathBuf,

    /// Number of threads that build [default: one for each core]
    #[arg(long, value_name = "N", value_parser = between(1_u16..=1024))]
    threads: Option<u16>,

    #[command(flatten)]
    treatment: TreatmentArgs,

    #[command(flatten)]
    scene: SceneArgs,
}

/// Builds the scene, writes it, and prints what it holds.
pub fn run(BuildArgs { model, out, threads, treatment, scene }: &BuildArgs) -> Result<()> {
    ensure!(
        !files::are_one_file(model, out),
        "{} is the model itself, which the scene would replace: name another file",
        out.display()
    );
    let source = SceneSource::File(model.clone());
    check_writable(out)?;
    threads::pool(threads.map(usize::from))?.install(|| {
        let options = scene.options();
        warn_of_large_file(&source, 1);
        let progress = Progress::new(format!("loading {source}"));
        let built = store::build_file(&source, treatment.treatment(), &options, out, &|stage, done| {
            progress.report(stage, &source, done);
        });
        let (info, n_bytes) = built.with_context(|| format!("cannot build {}", out.display()))?;
        drop(progress);
        info.log(&source);
        say(format_args!("{}: {}, {}", out.display(), counted(info.n_triangles, "triangle"), bytes(n_bytes)))
    })
}
