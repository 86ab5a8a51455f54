//! The command line of the wall.

use std::path::PathBuf;

use clap::builder::{PathBufValueParser, TypedValueParser};
use renderer::{
    cli::{
        appearance_args::AppearanceArgs,
        between,
        picture_args::{ModelArgs, read_camera, with_ending},
        scene_args::SceneArgs,
    },
    server::connect::with_port,
};
use shared::{
    camera::{Camera, CameraPath, UpAxis},
    division::{Division, FrameSize},
    noise::NoiseLimit,
    protocol::{Encoding, LightingMode, SampleRange, ShadingMode},
    sky::SkyId,
};

use super::{
    annotations::AnnotationArgs, calibrate::CalibrateArgs, check::CheckArgs, device_args::DeviceArgs,
    export::ExportArgs, import::ImportArgs, remote_args::RemoteArgs,
};
use crate::{
    control::{
        refinement::{self, DEFAULT_TARGET_RATE, RefinementOptions},
        show::Show,
    },
    remote::tokens::TokenArgs,
    wall::{OnLoss, Wall, WallError},
};

/// Shows a scanned model on a display wall, ray traced by render servers.
///
/// Without arguments: the built-in statue on a wall of 4×3 projectors, traced by two local render servers.
#[derive(Debug, clap::Parser)]
#[command(version, args_conflicts_with_subcommands = true, args_override_self = true)]
pub struct Args {
    /// The program to run instead of the wall
    #[command(subcommand)]
    pub command: Option<Command>,
    /// The wall's own arguments
    #[command(flatten)]
    pub wall: WallArgs,
}

/// Programs beside the wall.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Checks a wall file, prints it with every default filled in, and draws the wall with --svg
    Check(CheckArgs),
    /// Makes a token that lets a remote in, lists all, or revokes one
    RemoteToken(TokenArgs),
    /// Aligns a wall with a camera: shows patterns, reads photographs of them, and writes corners or meshes
    ///
    /// Without --photos and --patterns, the patterns are shown on the wall's outputs: Space shows the next one, Escape ends.
    /// With --watch, each photograph of a pattern shows the next one by itself, Tab what was seen so far, and Enter what was
    /// found; a second Enter writes it. The order of photographs does not matter.
    Calibrate(CalibrateArgs),
    /// Makes a wall file, and a mesh file for each projector, of an MPCDI file
    Import(ImportArgs),
    /// Writes a wall as an MPCDI file: warps, and maps of light
    Export(ExportArgs),
    /// Lists a model's annotations and measurements, and exchanges them with other programs
    Annotations(AnnotationArgs),
    /// The render server: the same as the program `renderer`
    #[command(subcommand)]
    Renderer(renderer::cli::Command),
}

/// The model, the wall and the camera.
#[derive(Clone, Debug, clap::Args)]
pub struct ShowArgs {
    /// The model.
    #[command(flatten)]
    pub model: ModelArgs,
    /// The wall file [default: the paper's 4×3 projectors]
    #[arg(long, value_name = "FILE.toml")]
    pub wall: Option<PathBuf>,
    /// The camera file [default: a camera that sees the whole model]
    #[arg(long, value_name = "FILE.toml")]
    pub camera: Option<PathBuf>,
}

impl ShowArgs {
    /// The wall of the file, or the default.
    pub fn load_wall(&self) -> Result<Wall, WallError> {
        self.wall.as_deref().map_or_else(|| Ok(Wall::paper()), Wall::load)
    }

    /// The camera of the file, if there is one.
    pub fn read_camera(&self) -> anyhow::Result<Option<Camera>> {
        self.camera.as_deref().map(read_camera).transpose()
    }
}

/// The files that a wall starts with.
#[derive(Clone, Debug)]
pub struct Inputs {
    /// The wall.
    pub wall: Wall,
    /// The image that lights path-traced pictures.
    pub sky: Option<SkyId>,
    /// The first camera; `None` shows the whole model.
    pub camera: Option<Camera>,
    /// The path that the camera takes from the start.
    pub path: Option<CameraPath>,
    /// The show's file, and the show.
    pub(crate) show: Option<(PathBuf, Show)>,
}

/// The wall's options.
#[derive(Clone, Debug, clap::Args)]
pub struct WallArgs {
    /// The model, the wall and the camera.
    #[command(flatten)]
    pub show: ShowArgs,
    /// The model's axis that points up: x, y, z, -x, -y or -z [default: the one in the file of the model's views, or
    /// guessed from what the model stands on]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    pub up: Option<UpAxis>,
    /// A recorded camera path, which is repeated; with --headless it is followed once, as a film
    #[arg(long, help_heading = "Film", value_name = "FILE.toml", conflicts_with = "camera", group = "programme")]
    pub path: Option<PathBuf>,
    /// The show to play: a file of scenes, each a model, a view of it, a caption and a time. With --headless it is played once
    #[arg(long = "show", help_heading = "Show", value_name = "FILE.toml", conflicts_with_all = ["camera", "path"],
        group = "programme")]
    pub show_file: Option<PathBuf>,
    /// Pictures a second of the film, with --headless and --path
    #[arg(long, help_heading = "Film", value_name = "F", default_value_t = 30.0, requires = "path",
        requires = "headless", conflicts_with = "show_file", value_parser = pictures_per_second)]
    pub fps: f64,
    /// Write each picture of the film, or one of each scene of the show, the whole wall at full resolution, to this folder;
    /// with --headless and --path or --show
    #[arg(long, help_heading = "Film", value_name = "FOLDER", requires = "programme", requires = "headless")]
    pub pictures: Option<PathBuf>,
    /// Go on after the last picture of the film that was begun in --pictures, with the same options; in an empty folder,
    /// begin it
    #[arg(long, help_heading = "Film", requires = "pictures", requires = "path", conflicts_with_all = ["film", "show_file"])]
    pub resume: bool,
    /// Write the film to this file, through ffmpeg; with --headless and --path
    #[arg(long, help_heading = "Film", value_name = "FILE.mp4", requires = "path", requires = "headless",
        conflicts_with_all = ["pictures", "show_file"],
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "mp4")))]
    pub film: Option<PathBuf>,
    /// Rays averaged for each sample, in linear light: 1 to 256 [default: 16 in a film, and at rest if the resolution
    /// follows the motion; with --rays path in a film, at rest and with --headless as many as --noise needs, up to 256; else 1]
    #[arg(long, value_name = "N", value_parser = between(1..=SampleRange::LARGEST_COUNT))]
    pub samples: Option<u32>,
    /// With --rays path: the noise at which a pixel gets no more rays, in levels of the 255 of a channel; 0 gives all pixels
    /// all --samples [default: 1.5; 0 with --samples]
    #[arg(long, value_name = "LEVELS", allow_hyphen_values = true)]
    pub noise: Option<NoiseLimit>,
    /// Frames a second while the camera moves: the resolution drops until this rate is reached; at rest the wall returns to
    /// native resolution. 0 keeps the resolution [default: 30 in a window, 0 with --headless, --size or --frames]
    #[arg(long, value_name = "F", conflicts_with_all = ["pictures", "film"], value_parser = target_rate)]
    pub target_rate: Option<f64>,
    /// The address or name on which to wait for render servers; port 0 takes a free port [default: 127.0.0.1:7117, or a free
    /// port if that is taken and --local servers are enough]
    #[arg(long, help_heading = "Render servers", value_name = "HOST:PORT")]
    pub listen: Option<String>,
    /// The key file: only render servers with a copy of it can join, and everything is encrypted
    #[arg(long, help_heading = "Render servers", value_name = "FILE", conflicts_with = "insecure")]
    pub key: Option<PathBuf>,
    /// Listen on the network without encryption and authentication
    #[arg(long, help_heading = "Render servers")]
    pub insecure: bool,
    /// Do not announce the wall in the network, where render servers without an address would find it
    #[arg(long, help_heading = "Render servers")]
    pub no_announce: bool,
    /// Render servers to start on this machine [default: 2; 0 with --listen]
    #[arg(long, help_heading = "Render servers", value_name = "N", value_parser = between(0_u32..=256))]
    pub local: Option<u32>,
    /// Wait for this many render servers before the first frame [default: 1, without a window as many as --local]
    #[arg(long, help_heading = "Render servers", value_name = "K", value_parser = between(1_u32..=u32::MAX))]
    pub min_renderers: Option<u32>,
    /// How frames are divided among render servers: interleaved, tiled or dynamic
    #[arg(long, help_heading = "Render servers", value_name = "D", default_value_t = Division::default())]
    pub division: Division,
    /// Frames in flight, 1 to 3: with 1, render servers wait for each other after each frame
    #[arg(long, help_heading = "Render servers", value_name = "N", default_value_t = 2, value_parser = between(1_u32..=3))]
    pub in_flight: u32,
    /// How samples travel: raw or lz4 [default: the faster one, as measured on each link]
    #[arg(long, help_heading = "Render servers", value_name = "E")]
    pub encoding: Option<Encoding>,
    /// Shading of the samples: shaded, normals or cost
    #[arg(long, value_name = "V", default_value_t = ShadingMode::default())]
    pub view: ShadingMode,
    /// The rays that light a sample: primary; shadows, which adds a ray to the key light; or ambient, which adds ambient
    /// occlusion; or path, light of sun and sky that bounces, at rest if the resolution follows the motion [default: primary;
    /// at rest path if the resolution follows the motion]
    #[arg(long, value_name = "RAYS")]
    pub rays: Option<LightingMode>,
    /// Key light, background and clip plane.
    #[command(flatten)]
    pub appearance: AppearanceArgs,
    /// Samples of a frame [default: of a film the wall's resolution, else as in the wall file, or 1024x512]
    #[arg(long, value_name = "WxH")]
    pub size: Option<FrameSize>,
    /// Fill the screen; a wall whose file names outputs always fills them
    #[arg(long, help_heading = "Window", conflicts_with = "headless")]
    pub fullscreen: bool,
    /// The wall's content while no render server is left, and after a crash until the restart [default: as in the wall
    /// file, or last-frame]
    #[arg(long, help_heading = "Window", value_name = "WHAT", conflicts_with = "headless")]
    pub on_loss: Option<OnLoss>,
    /// Show all of a wall whose file names outputs in one window
    #[arg(long, help_heading = "Window", conflicts_with = "headless")]
    pub spanning: bool,
    /// Kiosk: fill the screen, let visitors steer and nothing else, and return to the path or the whole model after this
    /// many seconds without input, 60 unless given; Ctrl+L unlocks
    #[arg(long, help_heading = "Window", value_name = "SECONDS", conflicts_with = "headless", num_args = 0..=1,
        require_equals = true, default_missing_value = "60", value_parser = between(1_u32..=86400))]
    pub kiosk: Option<u32>,
    /// Where the remote is served, and to whom.
    #[command(flatten)]
    pub remote: RemoteArgs,
    /// Which devices steer the wall.
    #[command(flatten)]
    pub devices: DeviceArgs,
    /// Open no window: render frames, print a table of timings, and end
    #[arg(long)]
    pub headless: bool,
    /// End after this many frames [default with --headless: 10]
    #[arg(long, value_name = "N", value_parser = between(1_u32..=u32::MAX))]
    pub frames: Option<u32>,
    /// At the end, write the wall without overlay to this file
    #[arg(long, value_name = "FILE.png",
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "png")))]
    pub screenshot: Option<PathBuf>,
    /// At the end, write the measurements of every frame to this file
    #[arg(long, value_name = "FILE.json",
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "json")))]
    pub stats: Option<PathBuf>,
    /// How local render servers prepare scenes
    #[command(flatten)]
    pub scene: SceneArgs,
}

fn pictures_per_second(text: &str) -> Result<f64, String> {
    let fps = text.parse().ok().filter(|fps| (0.01..=1000.0).contains(fps));
    fps.ok_or_else(|| "from 0.01 to 1000 pictures a second are possible".to_owned())
}

fn target_rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate| *rate == 0.0 || (0.1..=1000.0).contains(rate));
    rate.ok_or_else(|| "from 0.1 to 1000 frames a second are possible, or 0 for none".to_owned())
}

impl WallArgs {
    /// The rays averaged for each sample of frames whose resolution does not follow the motion.
    pub fn sample_range(&self) -> SampleRange {
        if self.rays == Some(LightingMode::Path) && self.headless {
            return self.paths();
        }
        let default = if self.writes_film() { refinement::DEFAULT_SAMPLES } else { 1 };
        SampleRange::all(0, self.samples.unwrap_or(default))
    }

    /// The paths of each sample of a picture at rest.
    fn paths(&self) -> SampleRange {
        SampleRange::asked(LightingMode::Path, self.samples, self.noise)
    }

    /// Whether pictures of a film are kept; otherwise a path is only measured.
    pub fn writes_film(&self) -> bool {
        self.pictures.is_some() || self.film.is_some()
    }

    /// The refinement's options. It is off by default where frames are counted or have a fixed size: these are measured.
    pub(crate) fn refinement(&self, wall: &Wall) -> RefinementOptions {
        let is_measured = self.headless || self.size.is_some() || self.frames.is_some();
        let target_rate = self.target_rate.unwrap_or(if is_measured { 0.0 } else { DEFAULT_TARGET_RATE });
        RefinementOptions {
            is_on: target_rate > 0.0,
            target_rate: if target_rate > 0.0 { target_rate } else { DEFAULT_TARGET_RATE },
            native: wall.native_size(),
            n_samples: self.samples.unwrap_or(refinement::DEFAULT_SAMPLES),
            paths: self.paths(),
            fixed_size: wall.frame_size(),
            fixed_samples: self.sample_range(),
            lights_at_rest: self.rays.is_none(),
        }
    }

    /// The number of local render servers.
    pub fn n_local(&self) -> u32 {
        self.local.unwrap_or(if self.listen.is_some() { 0 } else { 2 })
    }

    /// HOST:PORT on which the wall waits for render servers.
    pub fn listen(&self) -> String {
        with_port(self.listen.as_deref().unwrap_or("127.0.0.1"))
    }

    /// The number of render servers for which the first frame waits.
    pub fn min_renderers(&self) -> u32 {
        self.min_renderers.unwrap_or_else(|| self.n_local().max(1))
    }
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, Parser};

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Args::command().debug_assert();
    }

    #[test]
    fn a_heading_stands_over_its_own_options_only() {
        let command = Args::command();
        let heading = |name: &str| {
            let option = command.get_arguments().find(|option| option.get_long() == Some(name));
            option.expect("an option").get_help_heading()
        };
        assert_eq!(["size", "headless", "stats", "model"].map(heading), [None; 4]);
        assert_eq!([heading("clip"), heading("kiosk")], [Some("Appearance"), Some("Window")]);
    }

    #[test]
    fn a_film_has_the_walls_samples() {
        let parse =
            |args: &[&str]| Args::parse_from(["compositor", "--headless", "--path", "p"].iter().chain(args)).wall;
        let count = |args: &[&str]| parse(args).sample_range().count;
        assert_eq!([count(&[]), count(&["--pictures", "p"]), count(&["--film", "f.mp4"])], [1, 16, 16]);
        assert_eq!(count(&["--film", "f.mp4", "--samples", "2"]), 2);
    }

    #[test]
    fn without_arguments_two_local_render_servers_are_started() {
        let args = Args::parse_from(["compositor"]);
        assert_eq!((args.wall.n_local(), args.wall.min_renderers()), (2, 2));
    }

    #[test]
    fn the_resolution_follows_the_motion_in_a_window_unless_frames_are_measured() {
        let refinement = |args: &[&str]| {
            let args = Args::parse_from(["compositor"].iter().chain(args));
            args.wall.refinement(&Wall::paper().with_frame_size(args.wall.size.unwrap_or(FrameSize::PAPER)))
        };
        let options = refinement(&[]);
        assert_eq!((options.is_on, options.target_rate, options.n_samples), (true, 30.0, 16));
        assert_eq!((options.native, options.fixed_size), (FrameSize::new(4096, 2304).unwrap(), FrameSize::PAPER));
        for measured in [&["--headless"][..], &["--frames", "3"], &["--size", "64x32"], &["--target-rate", "0"]] {
            assert!(!refinement(measured).is_on, "{measured:?}");
        }
        let options = refinement(&["--headless", "--target-rate", "12.5", "--samples", "3"]);
        assert_eq!((options.is_on, options.target_rate, options.n_samples), (true, 12.5, 3));
        for refused in ["-1", "0.01", "1e9", "nan", "fast"] {
            let args = ["compositor".to_owned(), format!("--target-rate={refused}")];
            assert!(Args::try_parse_from(args).is_err(), "{refused}");
        }
    }

    #[test]
    fn options_without_effect_are_refused() {
        let is_refused = |args: &[&str]| Args::try_parse_from(["compositor"].iter().chain(args)).is_err();
        for window in [&["--fullscreen"][..], &["--spanning"], &["--on-loss", "black"], &["--kiosk"]] {
            assert!(!is_refused(window) && is_refused(&[&["--headless"], window].concat()), "{window:?}");
        }
        assert!(is_refused(&["--path", "p", "--fps", "10"]) && is_refused(&["--resume"]));
        assert!(is_refused(&["--headless", "--path", "p", "--film", "f.mp4", "--resume"]));
        let film = ["--headless", "--path", "p", "--pictures", "film"];
        assert!(!is_refused(&film) && is_refused(&[&film[..], &["--target-rate", "30"]].concat()));
    }

    #[test]
    fn a_kiosk_returns_after_a_minute_or_the_given_seconds() {
        let kiosk = |args: &[&str]| {
            Args::try_parse_from(["compositor"].iter().chain(args)).map(|args| args.wall.kiosk).map_err(drop)
        };
        assert_eq!([kiosk(&[]), kiosk(&["--kiosk"]), kiosk(&["--kiosk=5"])], [Ok(None), Ok(Some(60)), Ok(Some(5))]);
        for refused in ["--kiosk=0", "--kiosk=-1", "--kiosk=soon", "--kiosk=86401"] {
            assert!(kiosk(&[refused]).is_err(), "{refused}");
        }
    }

    #[test]
    fn a_wall_for_other_machines_starts_none() {
        let args = Args::parse_from(["compositor", "--listen", "0.0.0.0:7117"]);
        assert_eq!((args.wall.n_local(), args.wall.min_renderers()), (0, 1));
    }

    #[test]
    fn a_model_needs_no_option() {
        let path = |args: &[&str]| {
            let args = Args::try_parse_from(["compositor"].iter().chain(args)).map_err(drop)?;
            Ok(args.wall.show.model.path().map(PathBuf::from))
        };
        assert_eq!(path(&["scan.ply", "--headless"]), Ok(Some("scan.ply".into())));
        assert_eq!(path(&["--model", "scan.ply"]), Ok(Some("scan.ply".into())));
        assert_eq!(path(&["scan.ply", "--model", "scan.ply"]), Err(()));
    }

    #[test]
    fn the_wall_is_its_own_render_server() {
        let args = Args::parse_from(["compositor", "renderer", "connect", "127.0.0.1:1", "--local"]);
        assert!(matches!(args.command, Some(Command::Renderer(renderer::cli::Command::Connect(_)))));
    }
}
