//! Runs a wall without a window from its command line.

use std::{sync::mpsc, time::Instant};

use anyhow::bail;
use channel::key::Key;
use renderer::cli::{large_file::warn_of_large_file, picture_args::guessed_up, progress::Progress, say, stop::Stopped};
use shared::{
    appearance::Appearance,
    camera::{Camera, CameraPath, CanvasPart},
    detail::Detail,
    division::FrameSize,
    printable::counted,
    protocol::FrameSpec,
    sky::SkyId,
};

use super::{
    Film, Headless, Output, Pictures, Video, Wakeup, Wakeups,
    show::{Setting, make_folder},
};
use crate::{
    cli::{
        announcing::announce,
        args::{Inputs, WallArgs},
        local::LocalServers,
        report::Report,
        run::{listen, network_threads, start_farm, wake_to_stop, wakeups},
    },
    control::{model::Model, refinement::Refinement, sidecar::SidecarFiles},
    farm::Farm,
    window::join_hint,
};

/// Runs a wall without a window to its end.
pub(crate) fn run_headless(args: &WallArgs, Inputs { wall, sky, camera, path, show }: Inputs) -> anyhow::Result<()> {
    if args.up.is_some() && (camera.is_some() || path.is_some()) {
        bail!("--up has no effect on a --camera or --path without a window: leave out one of them");
    }
    if let Some((file, _)) = show.as_ref().filter(|(_, show)| show.scenes.is_empty()) {
        bail!("{} has no scenes yet: Ctrl+K on a wall that plays it keeps views as scenes", file.display());
    }
    let mut picture = Picture {
        camera,
        path,
        sky,
        aspect: wall.aspect(),
        size: wall.frame_size(),
        refinement: Refinement::new(args.refinement(&wall)),
    };
    // Quick checks come first: reading a model can take minutes.
    let output = film_output(args, wall.output_size())?;
    let runtime = network_threads()?;
    let key = args.key.as_deref().map(Key::read).transpose()?;
    let listener = listen(&runtime, args)?;
    let _announcement = announce(args, &listener, key.as_ref())?;
    let mut headless = Headless::new(wall)?.with_key_file(args.key.clone());
    // Made before the farm, so that they end after it: otherwise the farm would report them as lost.
    let mut servers = LocalServers::empty(listener.local_addr()?, args.key.as_deref(), &args.scene)?;
    let (wake, wakeups) = wakeups();
    let wake_farm = wake.clone();
    let farm = start_farm(&runtime, listener, key, args, args.min_renderers(), move || {
        // A full channel already holds a wake-up call.
        let _ = wake_farm.try_send(Wakeup::Farm);
    })?;
    servers.start(args.n_local(), farm.local_reporter())?;
    let report = match show {
        Some((_, show)) => {
            wake_to_stop(wake.clone());
            headless.show_show(&farm, (wake, &wakeups), show, &picture.setting(args))?
        }
        None => show_model(args, &mut picture, (&mut headless, &farm), (wake, &wakeups), output)?,
    };
    if report.n_frames() > 0 {
        say(report.table())?;
    }
    // Measurements first: a screenshot that cannot be written must not lose them.
    if let Some(path) = &args.stats {
        report.write(path)?;
    }
    if report.n_frames() == 0
        && let Some(stopped) = Stopped::by_signal("stopped before the first frame: nothing was shown or written")
    {
        return Err(stopped.into());
    }
    if let Some(path) = &args.screenshot {
        headless.image()?.write_png(path)?;
        say(format_args!("wrote {}", path.display()))?;
    }
    Ok(())
}

/// What a wall without a window shows, beside its model.
struct Picture {
    camera: Option<Camera>,
    path: Option<CameraPath>,
    sky: Option<SkyId>,
    /// The canvas's width over its height.
    aspect: f64,
    size: FrameSize,
    refinement: Refinement,
}

impl Picture {
    fn setting(&self, args: &WallArgs) -> Setting {
        Setting {
            source: args.show.model.source(),
            treatment: args.show.model.treatment(),
            store: args.scene.store(),
            size: self.size,
            view: args.view,
            rays: args.rays,
            samples: args.sample_range(),
            appearance: args.appearance.appearance(),
            sky: self.sky,
            aspect: self.aspect,
            pictures: args.pictures.clone(),
        }
    }
}

/// Shows the model of the command line: as a film, refined, or frame by frame.
fn show_model(
    args: &WallArgs,
    picture: &mut Picture,
    (headless, farm): (&mut Headless, &Farm),
    (wake, wakeups): (mpsc::SyncSender<Wakeup>, &Wakeups),
    output: Output,
) -> anyhow::Result<Report> {
    let model = load_model(args)?;
    if args.n_local() < args.min_renderers() {
        let files = [model.path(), args.appearance.sky.clone()];
        let join = join_hint(farm.address(), args.key.as_deref(), files.each_ref().map(Option::as_deref));
        tracing::info!(
            "waiting for {}; start one with: {}",
            counted(args.min_renderers(), "render server"),
            join.command
        );
    }
    let Picture { camera, path, sky, aspect, size, refinement } = picture;
    let n_frames = args.frames.unwrap_or(10);
    let film = path.take().map(|path| Film { path, fps: args.fps, most: args.frames.unwrap_or(u32::MAX) });
    let up = args.up.or_else(|| SidecarFiles::read(&model.source).views().and_then(|views| views.up));
    let camera = camera.or_else(|| film.as_ref().map(|film| film.path.at(0.0))).unwrap_or_else(|| {
        let up = up.unwrap_or_else(|| guessed_up(&model.shape));
        Camera::view_all(&model.shape, up, *aspect, CanvasPart::WHOLE)
    });
    let spec = FrameSpec {
        scene: model.scene,
        camera,
        size: *size,
        view: args.view,
        rays: args.rays.unwrap_or_default(),
        samples: args.sample_range(),
        detail: Detail::FULL,
        appearance: Appearance { sky: *sky, up: up.unwrap_or(model.shape.up), ..args.appearance.appearance() },
    };
    farm.update_goal(|goal| {
        goal.spec = Some(spec);
        goal.scene_path = model.path();
        goal.moved_at = Instant::now();
    });
    // A film that is stopped is cut off, as loading is. Without one, the wall serves until it is stopped.
    if film.is_none() {
        wake_to_stop(wake);
    }
    match film {
        Some(film) => headless.show_film(farm, wakeups, &film, output),
        None if refinement.is_on() => {
            headless.show_refined(farm, wakeups, n_frames, (spec, model.fine_bounds()), refinement)
        }
        None => headless.show_frames(farm, wakeups, n_frames),
    }
}

/// Begins what the film goes to; pictures have `size`: columns, rows.
fn film_output(args: &WallArgs, size: [u32; 2]) -> anyhow::Result<Output> {
    Ok(match (&args.pictures, &args.film) {
        (Some(folder), _) if args.show_file.is_some() => {
            make_folder(folder)?;
            Output::Nowhere
        }
        (Some(folder), _) => Output::Pictures(Pictures::begin(folder, args.fps, size, args.resume)?),
        (_, Some(path)) => Output::Video(Box::new(Video::begin(path, args.fps, size)?)),
        _ => Output::Nowhere,
    })
}

fn load_model(args: &WallArgs) -> anyhow::Result<Model> {
    let model = &args.show.model;
    let source = model.source();
    tracing::info!("loading {source}");
    args.scene.warn_of_scene_file(&source);
    let store = args.scene.store();
    if !store.has(&source, model.treatment()) {
        warn_of_large_file(&source, 1 + args.n_local());
    }
    let bar = Progress::new(format!("loading {source}"));
    Ok(Model::load(source, model.treatment(), &store, &|fraction| bar.set(fraction))?)
}
