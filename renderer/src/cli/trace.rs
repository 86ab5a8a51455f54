//! `renderer trace`: renders one picture without a network.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::builder::{PathBufValueParser, TypedValueParser};
use shared::{detail::Detail, noise::NoiseLimit, printable::counted, protocol::SampleRange};

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

    /// Rays averaged for each sample; with --noise at most [default: 1; with --rays path 256]
    #[arg(long, value_name = "N", value_parser = between(1..=SampleRange::LARGEST_COUNT))]
    samples: Option<u32>,

    /// With --rays path: the noise at which a pixel gets no more rays, in levels of the 255 of a channel; 0 gives all pixels
    /// all --samples [default: 1.5; 0 with --samples]
    #[arg(long, value_name = "LEVELS", allow_hyphen_values = true)]
    noise: Option<NoiseLimit>,

    /// Show what is finer than samples by stand-ins, as a wall does while its camera moves; models of fewer than 16,777,216
    /// triangles, and those with textures, have none
    #[arg(long)]
    stand_ins: bool,
}

/// Loads, builds and renders, and writes the picture.
pub fn run(&TraceArgs { ref picture, ref image, samples, noise, stand_ins }: &TraceArgs) -> Result<()> {
    check_writable(image)?;
    if let Some(unused) = picture.unused(noise.is_some()) {
        tracing::warn!("{unused}");
    }
    picture.pool()?.install(|| {
        // Camera and sky are checked before a large model is read.
        let camera = picture.read_camera()?;
        let sky = picture.read_sky()?;
        let mut stored = picture.load_scene()?;
        let (info, scene) = (&stored.info, &mut stored.scene);
        let mut spec = picture.spec(info.id, camera.unwrap_or_else(|| picture.view_all(&info.shape)));
        picture.light(&mut spec, scene, &info.shape, sky);
        spec.samples = SampleRange::asked(spec.rays, samples, noise);
        if stand_ins {
            spec.detail = Detail::of_samples(&spec.camera, spec.size, info.shape.bounds);
        }
        let _task = Task::named("rendering the picture");
        let (rgb, _) = scene.render_frame(&spec);
        if spec.appearance.background.fills(spec.size, rgb.as_chunks().0.iter().copied()) {
            tracing::warn!("{}: {SHOWS_NOTHING}", image.display());
        }
        image::write_png(image, spec.size, &rgb).with_context(|| format!("cannot write {}", image.display()))?;
        say(format_args!(
            "{}: {} samples, {}",
            image.display(),
            spec.size,
            counted(scene.at(spec.detail).n_triangles(), "triangle")
        ))?;
        stored.finish();
        Ok(())
    })
}
