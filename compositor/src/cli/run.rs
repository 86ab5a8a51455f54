//! Runs a wall from its command line: model, farm, local render servers, with or without a window.

use std::{
    cell::RefCell,
    io,
    net::{Ipv4Addr, SocketAddr},
    ops::ControlFlow,
    rc::Rc,
    sync::mpsc,
    time::Instant,
};

use anyhow::{Context, anyhow, bail};
use channel::key::{Key, have_key_advice};
use renderer::cli::{
    check_writable,
    large_file::warn_of_large_file,
    picture_args::guessed_up,
    progress::Progress,
    say,
    stop::{self, Signal, Stopped},
};
use shared::{
    appearance::Appearance,
    camera::{Camera, CanvasPart},
    printable::counted,
    protocol::FrameSpec,
    sky::Sky,
};
use tokio::{
    net::{TcpListener, lookup_host},
    runtime::Runtime,
};

use super::{
    args::{Inputs, WallArgs},
    headless::{Film, Headless, Output, Pictures, Video, Wakeup, Wakeups},
    local::LocalServers,
    report::Report,
};
use crate::{
    control::{
        model::Model,
        refinement::Refinement,
        sidecar::{self, SidecarFiles},
    },
    farm::{Farm, RenderGoal},
    remote::Remote,
    supervisor::{self, SupervisorLink},
    window::{OnShown, WindowLoop, join_hint},
};

/// Runs a wall to its end.
pub fn run(args: &WallArgs) -> anyhow::Result<()> {
    let sky = args.appearance.read_sky()?.map(|sky| sky.id());
    let mut inputs = Inputs {
        sky,
        wall: args.show.load_wall()?,
        camera: args.show.read_camera()?,
        path: args.path.as_deref().map(sidecar::read_path).transpose().map_err(anyhow::Error::msg)?,
    };
    let native_of_film = args.writes_film().then(|| inputs.wall.native_size());
    if let Some(size) = args.size.or(native_of_film) {
        inputs.wall = inputs.wall.with_frame_size(size);
    }
    [&args.screenshot, &args.stats].into_iter().flatten().try_for_each(|path| check_writable(path))?;
    if args.headless {
        return run_headless(args, inputs);
    }
    if args.spanning {
        inputs.wall = inputs.wall.without_monitors();
    }
    let on_loss = args.on_loss.unwrap_or(inputs.wall.on_loss());
    let supervisor = SupervisorLink::of_this_process();
    let fills_screens = args.fullscreen || args.kiosk.is_some() || !inputs.wall.monitors().is_empty();
    // A wall that is measured runs without a supervisor.
    if supervisor::IS_SUPPORTED && supervisor.is_none() && fills_screens && args.frames.is_none() {
        return supervisor::run(on_loss);
    }
    inputs.wall = inputs.wall.with_on_loss(on_loss);
    run_window(args, inputs, supervisor)
}

fn run_headless(args: &WallArgs, Inputs { wall, sky, camera, path }: Inputs) -> anyhow::Result<()> {
    if args.up.is_some() && (camera.is_some() || path.is_some()) {
        bail!("--up has no effect on a --camera or --path without a window: leave out one of them");
    }
    let n_frames = args.frames.unwrap_or(10);
    let (aspect, size) = (wall.aspect(), wall.frame_size());
    let mut refinement = Refinement::new(args.refinement(&wall));
    // Quick checks come first: reading a model can take minutes.
    let output = film_output(args, wall.output_size())?;
    let runtime = network_threads()?;
    let key = args.key.as_deref().map(Key::read).transpose()?;
    let listener = listen(&runtime, args)?;
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
    let film = path.map(|path| Film { path, fps: args.fps, most: args.frames.unwrap_or(u32::MAX) });
    let up = args.up.or_else(|| SidecarFiles::read(&model.source).views().and_then(|views| views.up));
    let camera = camera.or_else(|| film.as_ref().map(|film| film.path.at(0.0))).unwrap_or_else(|| {
        let up = up.unwrap_or_else(|| guessed_up(&model.shape));
        Camera::view_all(&model.shape, up, aspect, CanvasPart::WHOLE)
    });
    let sky = sky.map(|id| Sky { id, up: up.unwrap_or(model.shape.up) });
    let spec = FrameSpec {
        scene: model.scene,
        camera,
        size,
        view: args.view,
        rays: args.rays.unwrap_or_default(),
        samples: args.sample_range(),
        appearance: Appearance { sky, ..args.appearance.appearance() },
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
    let report = match film {
        Some(film) => headless.show_film(&farm, &wakeups, &film, output)?,
        None if refinement.is_on() => headless.show_refined(&farm, &wakeups, n_frames, spec, &mut refinement)?,
        None => headless.show_frames(&farm, &wakeups, n_frames)?,
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

/// Begins what the film goes to; pictures have `size`: columns, rows.
fn film_output(args: &WallArgs, size: [u32; 2]) -> anyhow::Result<Output> {
    Ok(match (&args.pictures, &args.film) {
        (Some(folder), _) => Output::Pictures(Pictures::begin(folder, args.fps, size, args.resume)?),
        (_, Some(path)) => Output::Video(Box::new(Video::begin(path, args.fps, size)?)),
        _ => Output::Nowhere,
    })
}

fn run_window(args: &WallArgs, inputs: Inputs, supervisor: Option<SupervisorLink>) -> anyhow::Result<()> {
    let window = WindowLoop::new()?;
    stop::on_signal({
        let waker = window.waker();
        move |_| waker.close()
    });
    if let Some(supervisor) = &supervisor {
        supervisor
            .on_stop_request(|| stop::receive(Signal::Terminate))
            .context("cannot start a thread to listen to the supervisor")?;
        supervisor.abort_on_panic();
    }
    let runtime = network_threads()?;
    let key = args.key.as_deref().map(Key::read).transpose()?;
    let listener = listen(&runtime, args)?;
    // A wall for people runs with one render server; frames that are counted wait for all of them.
    let n_needed = if args.frames.is_some() { args.min_renderers() } else { args.min_renderers.unwrap_or(1) };
    let remote = args.remote.options().map(|options| {
        let waker = window.waker();
        Remote::start(&options, move || waker.wake())
    });
    let remote = remote.transpose()?;
    let waker = window.waker();
    // Made before the farm, so that they end after it: otherwise the farm would report them as lost.
    let mut servers = LocalServers::empty(listener.local_addr()?, args.key.as_deref(), &args.scene)?;
    let farm = start_farm(&runtime, listener, key, args, n_needed, move || waker.wake())?;
    servers.start(args.n_local(), farm.local_reporter())?;
    let report = Rc::new(RefCell::new(Report::default()));
    let on_shown = watch_frames(args, Rc::clone(&report));
    let outcome = window.run(args, inputs, &farm, on_shown, supervisor, remote);
    // Ends before its local render servers, so that their end is not reported as a loss.
    drop(farm);
    if let Some(stopped) = stop::unfinished() {
        return Err(stopped.into());
    }
    outcome?;
    if args.frames.is_some() {
        say(report.borrow().table())?;
    }
    if let Some(path) = &args.stats {
        report.borrow().write(path)?;
    }
    Ok(())
}

/// Counts frames for `--frames`, and collects measurements for `--stats`; without both, a wall collects nothing, however
/// long it runs.
fn watch_frames(args: &WallArgs, report: Rc<RefCell<Report>>) -> OnShown {
    let (n_frames, is_collecting) = (args.frames, args.stats.is_some() || args.frames.is_some());
    let mut n_shown = 0;
    let mut shown_at = Instant::now();
    Box::new(move |frame, display| {
        let frame_ms = shown_at.elapsed().as_secs_f64() * 1e3;
        shown_at = Instant::now();
        if is_collecting {
            report.borrow_mut().add(frame, *display, frame_ms);
        }
        n_shown += 1;
        if n_frames.is_some_and(|n_frames| n_shown >= n_frames) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    })
}

/// The farm, with nothing to render yet; it calls `wake` when it has news.
fn start_farm(
    runtime: &Runtime,
    listener: TcpListener,
    key: Option<Key>,
    args: &WallArgs,
    min_renderers: u32,
    wake: impl Fn() + Send + Sync + 'static,
) -> anyhow::Result<Farm> {
    let goal = RenderGoal {
        spec: None,
        scene_path: None,
        sky_path: args.appearance.sky.as_ref().map(|path| std::path::absolute(path).unwrap_or_else(|_| path.clone())),
        is_refinement: false,
        division: args.division,
        min_renderers,
        // Frames that are counted follow each other; a window renders when something changes.
        repeat: args.headless || args.frames.is_some(),
        in_flight: args.in_flight,
        encoding: args.encoding,
        moved_at: Instant::now(),
    };
    let _guard = runtime.enter();
    let farm = Farm::start(listener, key, goal, wake)?;
    // The wall builds as one more program beside its local render servers.
    farm.give_scene_files(args.scene.store(), args.scene.shared_by(1 + args.n_local()).options());
    Ok(farm)
}

/// Wake-up calls for a wall without a window.
pub fn wakeups() -> (mpsc::SyncSender<Wakeup>, Wakeups) {
    // Holds one of each kind.
    mpsc::sync_channel(2)
}

/// From now on, a signal wakes the wall to end in its own way.
pub fn wake_to_stop(wake: mpsc::SyncSender<Wakeup>) {
    // `send` may wait while the wall draws; it fails once the wall has ended.
    stop::on_signal(move |_| {
        let _ = wake.send(Wakeup::Stop);
    });
}

/// The runtime of the farm's connections.
pub fn network_threads() -> anyhow::Result<Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("network")
        .enable_all()
        .build()
        .context("cannot start the network threads")
}

fn listen(runtime: &Runtime, args: &WallArgs) -> anyhow::Result<TcpListener> {
    let address = args.listen();
    let resolved = runtime.block_on(lookup_host(&address)).with_context(|| {
        format!(
            "--listen {address} is no address or name of this machine: write it as HOST:PORT, for example 0.0.0.0:7117"
        )
    })?;
    let addresses: Vec<SocketAddr> = resolved.collect();
    let is_loopback = addresses.iter().all(|address| address.ip().to_canonical().is_loopback());
    if !is_loopback && args.key.is_none() && !args.insecure {
        bail!(
            "--listen {address} is open to the network: {}, copy it to the render servers and give it to both sides \
             with --key wall.key, or add --insecure if you trust everybody on the network",
            have_key_advice("wall.key".as_ref())
        );
    }
    let bind = |addresses: &[SocketAddr]| runtime.block_on(TcpListener::bind(addresses));
    let listener = match bind(&addresses) {
        // Nobody else was told the port: the wall's own render servers learn it from the wall.
        Err(error) if error.kind() == io::ErrorKind::AddrInUse && args.listen.is_none() && args.n_local() > 0 => {
            tracing::info!("{address} is taken, as by another wall: this one takes a free port");
            bind(&[(Ipv4Addr::LOCALHOST, 0).into()])
        }
        bound => bound,
    };
    let listener =
        listener.map_err(|error| anyhow!("cannot listen on {address}: {}", listen_fault(&address, &error)))?;
    // Scripts and people read the address to connect to.
    say(format_args!("listening on {}", listener.local_addr()?))?;
    Ok(listener)
}

/// The cause that the wall cannot listen on HOST:PORT, and its cure.
fn listen_fault(address: &str, error: &io::Error) -> String {
    let (host, port) = address.rsplit_once(':').unwrap_or((address, ""));
    match error.kind() {
        io::ErrorKind::AddrInUse => {
            format!("the port is taken; is another wall running? --listen {host}:0 --local 2 takes a free port")
        }
        io::ErrorKind::AddrNotAvailable => {
            format!("this machine does not have that address; --listen 0.0.0.0:{port} listens on all that it has")
        }
        io::ErrorKind::PermissionDenied => {
            format!("the system reserves that port; --listen {host}:7117 takes one that it does not")
        }
        _ => error.to_string(),
    }
}

fn load_model(args: &WallArgs) -> anyhow::Result<Model> {
    let model = &args.show.model;
    let source = model.source();
    tracing::info!("loading {source}");
    args.scene.warn_of_scene_file(&source);
    let store = args.scene.store();
    if !store.has(&source, model.crease) {
        warn_of_large_file(&source, 1 + args.n_local(), args.scene.shared_by(args.n_local()).options().memory_budget);
    }
    let bar = Progress::new(format!("loading {source}"));
    Ok(Model::load(source, model.crease, &store, &|fraction| bar.set(fraction))?)
}
