//! `renderer trace`: renders one picture without a network.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::builder::{PathBufValueParser, TypedValueParser};
use shared::{
    printable::counted,
    protocol::{FrameSpec, LightingMode, SampleRange},
};

use crate::{
    cli::{
        between, check_writable,
        picture_args::{PictureArgs, SHOWS_NOTHING, with_ending},
        say,
        stop::Task,
    },
    render::image,
};

/// The picture, and the file to write.
#[derive(Debug, clap::Args)]
pub struct TraceArgs {
    #[command(flatten)]
    picture: PictureArgs,

    /// The PNG file to write
    #[arg(long, value_name = "FILE.png",
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "png")))]
    image: PathBuf,

    /// Rays averaged for each sample [default: 1; with --rays path 64]
    #[arg(long, value_name = "N", value_parser = between(1..=SampleRange::LARGEST_COUNT))]
    samples: Option<u32>,
}

/// Paths of each sample: fewer are noisy.
const PATHS: u32 = 64;

/// Loads, builds and renders, and writes the picture.
pub fn run(TraceArgs { picture, image, samples }: &TraceArgs) -> Result<()> {
    check_writable(image)?;
    picture.pool()?.install(|| {
        // Camera and sky are checked before a large model is read.
        let camera = picture.read_camera()?;
        let sky = picture.read_sky()?;
        let mut stored = picture.load_scene()?;
        let (info, scene) = (&stored.info, &mut stored.scene);
        let mut spec = picture.spec(info.id, camera.unwrap_or_else(|| picture.view_all(&info.shape)));
        picture.light(&mut spec, scene, &info.shape, sky);
        let count = samples.unwrap_or(if spec.rays == LightingMode::Path { PATHS } else { 1 });
        let spec = FrameSpec { samples: SampleRange { count, ..spec.samples }, ..spec };
        let _task = Task::named("rendering the picture");
        let (rgb, _) = scene.render_frame(&spec);
        if spec.appearance.background.fills(spec.size, rgb.as_chunks().0.iter().copied()) {
            tracing::warn!("{}: {SHOWS_NOTHING}", image.display());
        }
        image::write_png(image, spec.size, &rgb).with_context(|| format!("cannot write {}", image.display()))?;
        say(format_args!("{}: {} samples, {}", image.display(), spec.size, counted(scene.n_triangles(), "triangle")))?;
        stored.finish();
        Ok(())
    })
}
