//! Measures what it costs to trace from a mapped scene file: CPU time of frames of the same scene in memory of its own and in
//! a file, in turns. The hits are the same bits.
//!
//!     cargo run --release -p lab --example mapped_cost -- --model dragon.ply --frames 100 --threads 1

use anyhow::{anyhow, ensure};
use clap::Parser;
use lab::statistics::{median, milliseconds};
use renderer::{
    cli::picture_args::PictureArgs,
    scene_file::{
        SceneStore,
        cache::Cache,
        store::{StoredScene, build_file},
    },
};

/// The frame, and the measurement.
#[derive(Parser)]
struct Args {
    #[command(flatten)]
    picture: PictureArgs,

    /// Frames of each kind; their median counts
    #[arg(long, default_value_t = 100)]
    frames: u32,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    args.picture.pool()?.install(|| run(&args))
}

fn run(args: &Args) -> anyhow::Result<()> {
    let camera = args.picture.read_camera()?;
    let (source, treatment, options) =
        (args.picture.model.source(), args.picture.model.treatment(), args.picture.options());
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("scene.raywall");
    build_file(&source, treatment, &options, &path, &|_, _| ())?;
    // Only beside a cache are files mapped.
    let cache = Cache::at(folder.path().join("cache"), 0).map_err(|fault| anyhow!(fault))?;
    let load = |store: SceneStore, source| store.load(source, treatment, &options, &|_, _| ());
    let file = renderer::model::scene::SceneSource::File(path);
    let scenes = [load(SceneStore::default(), &source)?, load(SceneStore::new(Some(cache)), &file)?];
    let [StoredScene { is_mapped: false, info, .. }, StoredScene { is_mapped: true, .. }] = &scenes else {
        anyhow::bail!("the file is not mapped: others may write in its folder")
    };
    let spec = args.picture.spec(info.id, camera.unwrap_or_else(|| args.picture.view_all(&info.shape)));
    let mut times = [Vec::new(), Vec::new()];
    for frame in 0..args.frames {
        let pictures = [0, 1].map(|turn| {
            // Each kind is the first as often as the other.
            let kind = (turn + frame as usize) % 2;
            let (rgb, time) = scenes[kind].scene.render_frame(&spec);
            times[kind].push(milliseconds(time));
            rgb
        });
        ensure!(pictures[0] == pictures[1], "the pictures differ");
    }
    let [owned, mapped] = times.map(median);
    println!("in memory {owned:.2} ms, mapped {mapped:.2} ms: {:.3} times", mapped / owned);
    Ok(())
}
