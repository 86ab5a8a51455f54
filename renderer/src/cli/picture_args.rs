//! Command-line options of a model and of a picture of it, shared by all programs that render.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use anyhow::{Context, Result, anyhow};
use channel::files;
use rayon::ThreadPool;
use shared::{
    camera::{Camera, CanvasPart, Shape, UpAxis},
    detail::Detail,
    division::FrameSize,
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::{Crease, Precision, SceneId, Treatment},
};

use crate::{
    cli::{appearance_args::AppearanceArgs, between, large_file, progress::Progress, scene_args::SceneArgs},
    formats::{file::is_named_as_model, sky::SkyError},
    grid::GridOptions,
    model::{
        mesh::Mesh,
        scene::{self, LoadError, LoadedMesh, SceneSource},
        solid::UNFILLED,
        statue,
    },
    render::{scene::Scene, sky::SkyMap, threads},
    scene_file::store::StoredScene,
};

/// The model.
#[derive(Clone, Debug, clap::Args)]
pub struct ModelArgs {
    /// The model's file: PLY, OBJ, STL, glTF or GLB, or a scene file that `renderer build` has made of one [default: the built-in statue]
    #[arg(value_name = "MODEL")]
    file: Option<PathBuf>,

    /// The same as MODEL
    #[arg(long, value_name = "FILE", conflicts_with = "file")]
    model: Option<PathBuf>,

    /// Approximate number of triangles of the built-in statue
    #[arg(long, value_name = "N", default_value_t = statue::DEFAULT_TRIANGLES, conflicts_with_all = ["model", "file"],
        value_parser = between(100..=SceneId::LARGEST_STATUE))]
    pub triangles: u32,

    #[command(flatten)]
    treatment: TreatmentArgs,
}

/// The surface.
#[derive(Clone, Debug, clap::Args)]
pub struct TreatmentArgs {
    /// Angle between triangles, in degrees, up to which a model without normals is smooth; 0 shows each triangle flat
    #[arg(long, value_name = "DEGREES", default_value_t = Crease::default(), allow_hyphen_values = true)]
    crease: Crease,

    /// Bits of each coordinate of a position, 8 to 21, for a smaller scene; the log says how far positions are off
    #[arg(long, value_name = "BITS", default_value_t = Precision::default(), allow_hyphen_values = true)]
    geometry: Precision,
}

impl TreatmentArgs {
    /// How a model's surface is made.
    pub fn treatment(&self) -> Treatment {
        Treatment { crease: self.crease, precision: self.geometry }
    }
}

/// The warning about a picture without anything but its background.
pub const SHOWS_NOTHING: &str = "the picture shows nothing of the model: leave --camera, --path and --clip out to see all \
    of it; without them, it is finer than a sample (try a larger --size), or smaller than 1e-36 (give it a smaller unit)";

/// The axis that points up where nobody chose one, told in the log unless it is the usual.
pub fn guessed_up(shape: &Shape) -> UpAxis {
    if shape.up != UpAxis::Y {
        tracing::info!("{} is guessed to point up: --up chooses another axis", shape.up);
    }
    shape.up
}

impl ModelArgs {
    /// The file, if one is given.
    pub fn path(&self) -> Option<&Path> {
        self.model.as_deref().or(self.file.as_deref())
    }

    /// The file, or the statue.
    pub fn source(&self) -> SceneSource {
        let statue = SceneSource::Statue { triangles: self.triangles };
        self.path().map_or(statue, |path| SceneSource::File(path.to_owned()))
    }

    /// How the model's surface is made.
    pub fn treatment(&self) -> Treatment {
        self.treatment.treatment()
    }

    /// Loads and treats the model, with a progress bar.
    pub fn load(&self) -> Result<LoadedMesh, LoadError> {
        let source = self.source();
        let progress = Progress::new(format!("loading {source}"));
        let loaded = scene::load(&source, self.treatment(), &|done| progress.set(done))?;
        loaded.log(&source);
        Ok(loaded.treated())
    }
}

/// A picture of a model.
#[derive(Debug, clap::Args)]
pub struct PictureArgs {
    /// The model.
    #[command(flatten)]
    pub model: ModelArgs,

    /// A camera file with eye, ll, u and v [default: a camera that sees the whole model]
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,

    /// The model's axis that points up when no camera is given: x, y, z, -x, -y or -z [default: guessed from what the model stands on]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true, conflicts_with = "camera")]
    up: Option<UpAxis>,

    /// Size of the frame in samples
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value_t = FrameSize::PAPER, allow_hyphen_values = true)]
    size: FrameSize,

    /// Number of threads that build and trace [default: one for each core]
    #[arg(long, value_name = "N", value_parser = between(1_u16..=1024))]
    threads: Option<u16>,

    /// Shading of the samples: shaded, normals, or cost (cells visited in blue, triangles tested in orange)
    #[arg(long, value_name = "VIEW", default_value = "shaded")]
    view: ShadingMode,

    /// The rays that light the picture: primary, shadows, ambient (shadows and ambient occlusion), or path (light of sun and
    /// sky that bounces)
    #[arg(long, value_name = "RAYS", default_value_t = LightingMode::default())]
    rays: LightingMode,

    #[command(flatten)]
    appearance: AppearanceArgs,

    #[command(flatten)]
    scene: SceneArgs,
}

impl PictureArgs {
    /// The pool of threads that build and trace.
    pub fn pool(&self) -> Result<ThreadPool> {
        threads::pool(self.threads.map(usize::from))
    }

    /// The options of the grid.
    pub fn options(&self) -> GridOptions {
        self.scene.options()
    }

    /// The camera of the file, if there is one.
    pub fn read_camera(&self) -> Result<Option<Camera>> {
        self.camera.as_deref().map(read_camera).transpose()
    }

    /// A camera that sees all of a model, with samples as wide as high.
    pub fn view_all(&self, shape: &Shape) -> Camera {
        let aspect = f64::from(self.size.xres()) / f64::from(self.size.yres());
        Camera::view_all(shape, self.up.unwrap_or_else(|| guessed_up(shape)), aspect, CanvasPart::WHOLE)
    }

    /// Reads the sky image, if one is given.
    pub fn read_sky(&self) -> Result<Option<Arc<SkyMap>>, SkyError> {
        Ok(self.appearance.read_sky()?.map(Arc::new))
    }

    /// Lights a scene's frame by a sky image; image and ground stand upright around its model.
    pub fn light(&self, spec: &mut FrameSpec, scene: &mut Scene, shape: &Shape, sky: Option<Arc<SkyMap>>) {
        spec.appearance.sky = sky.as_ref().map(|sky| sky.id());
        spec.appearance.up = self.up.unwrap_or(shape.up);
        scene.sky = sky;
    }

    /// Loads the scene, from its file if there is one, with a progress bar. The log tells what its model holds and lacks.
    pub fn load_scene(&self) -> Result<StoredScene, LoadError> {
        let (source, store, options) = (self.model.source(), self.scene.store(), self.scene.options());
        self.scene.warn_of_scene_file(&source);
        if !store.has(&source, self.model.treatment()) {
            large_file::warn_of_large_file(&source, 1);
        }
        let progress = Progress::new(format!("loading {source}"));
        let stored = store.load(&source, self.model.treatment(), &options, &|stage, done| {
            progress.report(stage, &source, done);
        })?;
        stored.info.log(&source);
        self.warn_of(&stored.scene);
        Ok(stored)
    }

    /// Builds the grid on the current rayon pool, with a progress bar.
    pub fn build(&self, mesh: Mesh) -> Scene {
        let progress = Progress::new("building the grid");
        let scene = Scene::build(mesh, &self.scene.options(), &|done| progress.set(done));
        self.warn_of(&scene);
        scene
    }

    fn warn_of(&self, scene: &Scene) {
        if let Some(shortage) = scene.grid.shortage() {
            tracing::warn!("{}: {shortage}", self.model.source());
        }
        if self.appearance.appearance().clip.is_some() && scene.mesh().facing().is_none() {
            tracing::warn!("{}: {UNFILLED}", self.model.source());
        }
    }

    /// The line about options that have no effect, because no paths light the picture; `has_noise` if a noise was asked for.
    pub fn unused(&self, has_noise: bool) -> Option<String> {
        if self.rays == LightingMode::Path {
            return None;
        }
        let mut options = self.appearance.of_paths();
        options.extend(has_noise.then_some("--noise"));
        let is_one = options.len() == 1;
        let last = options.pop()?;
        let names = if options.is_empty() { last.to_owned() } else { format!("{} and {last}", options.join(", ")) };
        let verb = if is_one { "has" } else { "have" };
        Some(format!("{names} {verb} no effect with --rays {}: add --rays path", self.rays))
    }

    /// The frame that shows the scene named `id`, through the centres of its samples.
    pub fn spec(&self, id: SceneId, camera: Camera) -> FrameSpec {
        FrameSpec {
            scene: id,
            camera,
            size: self.size,
            view: self.view,
            rays: self.rays,
            samples: SampleRange::CENTRE,
            detail: Detail::FULL,
            appearance: self.appearance.appearance(),
        }
    }
}

/// A file's path, unless its name ends like a file of another kind; a path without an ending is of any kind.
///
/// # Errors
/// A text that names the ending to give.
pub fn with_ending(path: PathBuf, ending: &str) -> Result<PathBuf, String> {
    match path.extension() {
        Some(other) if !other.eq_ignore_ascii_case(ending) => {
            Err(format!("no other format is written: give a name that ends with .{ending}"))
        }
        _ => Ok(path),
    }
}

/// Reads and checks a camera file.
pub fn read_camera(path: &Path) -> Result<Camera> {
    let name = path.display();
    let read = || {
        let text = files::read_text(path, 1 << 20).with_context(|| name.to_string())?;
        Camera::from_toml(&text).with_context(|| format!("{name} is not a camera file"))
    };
    read().map_err(|error| match is_named_as_model(path) && path.is_file() {
        true => anyhow!("{name} is a model by its name, and a camera file is TOML: --model {name} shows it"),
        false => error,
    })
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli;

    #[derive(Debug, Parser)]
    struct Program {
        #[command(flatten)]
        picture: PictureArgs,
    }

    #[test]
    fn a_model_is_given_with_or_without_its_option_but_once() {
        for arguments in [&["a.ply"][..], &["--model", "a.ply"], &["--size", "8x8", "a.ply", "--view", "cost"]] {
            let Program { picture } = cli::try_parse(["program"].iter().chain(arguments)).unwrap();
            assert_eq!(picture.model.source(), SceneSource::File("a.ply".into()), "{arguments:?}");
        }
        for refused in [&["a.ply", "--model", "a.ply"][..], &["a.ply", "b.ply"], &["a.ply", "--triangles", "1000"]] {
            assert!(cli::try_parse::<Program>(["program"].iter().chain(refused)).is_err(), "{refused:?}");
        }
    }

    #[test]
    fn options_without_effect_are_named_with_the_cure() {
        let unused = |arguments: &[&str], has_noise| {
            let Program { picture } = cli::try_parse(["program"].iter().chain(arguments)).unwrap();
            picture.unused(has_noise)
        };
        assert_eq!(unused(&[], false), None);
        assert_eq!(unused(&["--rays", "path", "--sun", "1", "--sky", "a.hdr"], true), None);
        let line = unused(&["--rays", "shadows", "--sun", "1"], false);
        assert_eq!(line.as_deref(), Some("--sun has no effect with --rays shadows: add --rays path"));
        let line = unused(&["--bounces", "0", "--exposure", "1", "--sky", "a.hdr"], true).unwrap();
        assert!(
            line.starts_with("--bounces, --exposure, --sky and --noise have no effect with --rays primary"),
            "{line}"
        );
    }

    #[test]
    fn the_opposite_of_an_axis_may_point_up() {
        let Program { picture } = cli::try_parse(["program", "--up", "-z"]).unwrap();
        let camera = picture.view_all(&statue::generate(1000, &|_| ()).shape());
        assert!(camera.v().z < 0.0 && camera.v().z.abs() > camera.v().y.abs(), "{}", camera.v());
    }

    #[test]
    fn without_a_camera_samples_are_as_wide_as_high() {
        for (size, aspect) in [("480x360", 4.0 / 3.0), ("1024x512", 2.0)] {
            let Program { picture } = cli::try_parse(["program", "--size", size]).unwrap();
            let camera = picture.view_all(&statue::generate(1000, &|_| ()).shape());
            assert!((camera.u().length() / camera.v().length() - aspect).abs() < 1e-9, "{size}");
        }
    }
}
