//! Starts a wall from its command line: model, farm, local render servers, and then a window or none.

use std::{
    cell::RefCell,
    ops::ControlFlow,
    rc::Rc,
    sync::mpsc,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use channel::key::{Key, make_key_command};
use renderer::{
    cli::{progress::Progress, say},
    model::scene::SceneSource,
};
use shared::{
    camera::{Camera, CameraPath},
    division::FrameSize,
    protocol::FrameSpec,
};
use tokio::{net::TcpListener, runtime::Runtime};

use super::{
    args::WallArgs,
    headless::{Film, Headless, Wakeup, Wakeups},
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
    supervisor::{self, SupervisorLink},
    wall::Wall,
    window::{OnShown, WindowLoop, WindowOptions},
};

/// Runs a wall to its end.
pub fn run(args: &WallArgs) -> anyhow::Result<()> {
    let wall = args.show.load_wall()?;
    let wall = match args.size {
        Some(size) => wall.with_frame_size(size),
        None => wall,
    };
    let camera = args.show.read_camera()?;
    let path = args.path.as_deref().map(sidecar::read_path).transpose().map_err(anyhow::Error::msg)?;
    if args.headless {
        return run_headless(args, wall, camera, path);
    }
    let wall = if args.spanning { wall.without_monitors() } else { wall };
    let on_loss = args.on_loss.unwrap_or(wall.on_loss());
    let supervisor = SupervisorLink::of_this_process();
    let fills_screens = args.fullscreen || args.kiosk.is_some() || !wall.monitors().is_empty();
    // One that is measured runs alone.
    if supervisor::IS_SUPPORTED && supervisor.is_none() && fills_screens && args.frames.is_none() {
        return supervisor::run(on_loss);
    }
    run_window(args, wall.with_on_loss(on_loss), camera, path, supervisor)
}

fn run_headless(args: &WallArgs, wall: Wall, camera: Option<Camera>, path: Option<CameraPath>) -> anyhow::Result<()> {
    let n_frames = args.frames.unwrap_or(10);
    let (aspect, size) = (wall.aspect(), wall.frame_size());
    let mut refinement = Refinement::new(args.refinement(&wall));
    // First what fails at once: an operator learns of it before a model of minutes is read.
    let runtime = network_threads()?;
    let key = args.key.as_deref().map(Key::read).transpose()?;
    let listener = listen(&runtime, args)?;
    let mut headless = Headless::new(wall)?;
    let report = if args.min_renderers() == 0 {
        headless.show_blank_frames(size, n_frames)?
    } else {
        // Before the farm, so that it ends after it, and nobody takes the end for a loss.
        let _servers = LocalServers::start(args.n_local(), listener.local_addr()?, args.key.as_deref(), &args.scene)?;
        let (wake, wakeups) = wakeups(&runtime);
        let farm = start_farm(&runtime, listener, key, args, args.min_renderers(), move || {
            // A call that is still waiting to be heard is enough.
            let _ = wake.try_send(Wakeup::Farm);
        })?;
        let model = load_model(args.show.source())?;
        let film = path.map(|path| Film {
            path,
            fps: args.fps,
            most: args.frames.unwrap_or(u32::MAX),
            folder: args.pictures.clone(),
        });
        let camera = camera.or_else(|| film.as_ref().map(|film| film.path.at(0.0))).unwrap_or_else(|| {
            let kept_up = || SidecarFiles::read(&model.source).views().and_then(|views| views.up);
            let up = args.up.or_else(kept_up).unwrap_or_default();
            Camera::view_all(model.bounds.0, model.bounds.1, up, aspect)
        });
        farm.update_goal(|wanted| want_model(wanted, &model, camera, size, args));
        match film {
            Some(film) => headless.show_film(&farm, &wakeups, &film)?,
            None if refinement.is_on() => {
                let spec = frame_spec(&model, camera, size, args);
                refinement.limit_sides(headless.gpu().device.limits().max_texture_dimension_2d);
                headless.show_refined(&farm, &wakeups, n_frames, spec, &mut refinement)?
            }
            None => headless.show_frames(&farm, &wakeups, n_frames)?,
        }
    };
    say(report.table())?;
    // Figures first: a picture that cannot be written costs no measurement.
    if let Some(path) = &args.stats {
        report.write(path)?;
    }
    if report.n_frames() == 0 {
        bail!("stopped before the first frame: nothing is shown, and no screenshot written");
    }
    if let Some(path) = &args.screenshot {
        headless.write_screenshot(path)?;
        say(format_args!("wrote {}", path.display()))?;
    }
    Ok(())
}

fn frame_spec(model: &Model, camera: Camera, size: FrameSize, args: &WallArgs) -> FrameSpec {
    FrameSpec {
        scene: model.scene,
        camera,
        size,
        view: args.view,
        rays: args.rays,
        samples: args.sample_range(),
        appearance: args.appearance.appearance(),
    }
}

fn want_model(wanted: &mut RenderGoal, model: &Model, camera: Camera, size: FrameSize, args: &WallArgs) {
    wanted.spec = Some(frame_spec(model, camera, size, args));
    wanted.scene_path = model.path();
    wanted.moved_at = Instant::now();
}

fn run_window(
    args: &WallArgs,
    wall: Wall,
    camera: Option<Camera>,
    path: Option<CameraPath>,
    supervisor: Option<SupervisorLink>,
) -> anyhow::Result<()> {
    let window = WindowLoop::new()?;
    if let Some(supervisor) = &supervisor {
        let waker = window.waker();
        supervisor.on_stop_request(move || waker.close()).context("no thread to hear the guard")?;
        supervisor.abort_on_panic();
    }
    let runtime = network_threads()?;
    let key = args.key.as_deref().map(Key::read).transpose()?;
    let listener = listen(&runtime, args)?;
    // A wall that people look at goes on with one render server; frames that are counted wait for all.
    let n_needed = if args.frames.is_some() { args.min_renderers() } else { args.min_renderers.unwrap_or(1) };
    let waker = window.waker();
    runtime.spawn({
        let waker = window.waker();
        async move {
            if renderer::server::connect::stop_signal().await.is_ok() {
                waker.close();
            }
        }
    });
    // Before the farm, so that it ends after it, and nobody takes the end for a loss.
    let _servers = LocalServers::start(args.n_local(), listener.local_addr()?, args.key.as_deref(), &args.scene)?;
    let farm = start_farm(&runtime, listener, key, args, n_needed, move || waker.wake())?;
    let options = WindowOptions {
        wall_file: args.show.wall.clone(),
        source: args.show.source(),
        camera,
        up: args.up,
        path,
        kiosk: args.kiosk.map(|seconds| Duration::from_secs(seconds.into())),
        refinement: args.refinement(&wall),
        wall,
        view: args.view,
        rays: args.rays,
        appearance: args.appearance.appearance(),
        fullscreen: args.fullscreen || args.kiosk.is_some(),
        overlay: args.kiosk.is_none(),
        screenshot_folder: ".".into(),
        screenshot_at_end: args.screenshot.clone(),
    };
    let report = Rc::new(RefCell::new(Report::default()));
    let on_shown = watch_frames(args, Rc::clone(&report));
    let outcome = window.run(options, &farm, on_shown, supervisor);
    // Before its local render servers end: their loss is no news then.
    drop(farm);
    outcome?;
    if args.frames.is_some() {
        say(report.borrow().table())?;
    }
    if let Some(path) = &args.stats {
        report.borrow().write(path)?;
    }
    Ok(())
}

/// Counts frames for `--frames`, and keeps their figures for `--stats`; a wall that runs for days keeps none unasked.
fn watch_frames(args: &WallArgs, report: Rc<RefCell<Report>>) -> OnShown {
    let (n_frames, keeps_figures) = (args.frames, args.stats.is_some() || args.frames.is_some());
    let mut n_shown = 0;
    let mut shown_at = Instant::now();
    Box::new(move |frame, display| {
        let frame_ms = shown_at.elapsed().as_secs_f64() * 1e3;
        shown_at = Instant::now();
        if keeps_figures {
            report.borrow_mut().add(Some(frame), *display, frame_ms);
        }
        n_shown += 1;
        if n_frames.is_some_and(|n_frames| n_shown >= n_frames) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    })
}

/// The farm, wanting nothing yet; `wake` is called when it has news.
fn start_farm(
    runtime: &Runtime,
    listener: TcpListener,
    key: Option<Key>,
    args: &WallArgs,
    min_renderers: u32,
    wake: impl Fn() + Send + Sync + 'static,
) -> anyhow::Result<Farm> {
    let wanted = RenderGoal {
        spec: None,
        scene_path: None,
        is_refinement: false,
        division: args.division,
        min_renderers,
        // Frames that are counted come one after another; a window renders when something changes.
        repeat: args.headless || args.frames.is_some(),
        in_flight: args.in_flight,
        encoding: args.encoding,
        moved_at: Instant::now(),
    };
    let _guard = runtime.enter();
    Ok(Farm::start(listener, key, wanted, wake)?)
}

/// Wake-up calls for a wall without a window; a signal to stop is one of them.
pub(crate) fn wakeups(runtime: &Runtime) -> (mpsc::SyncSender<Wakeup>, Wakeups) {
    // Room for one of each kind.
    let (wake, wakeups) = mpsc::sync_channel(2);
    let stop = wake.clone();
    runtime.spawn(async move {
        if renderer::server::connect::stop_signal().await.is_ok() {
            // On a thread that may wait: the wall may be drawing.
            let _ = tokio::task::spawn_blocking(move || stop.send(Wakeup::Stop)).await;
        }
    });
    (wake, wakeups)
}

pub(crate) fn network_threads() -> anyhow::Result<Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("network")
        .enable_all()
        .build()
        .context("the network threads do not start")
}

fn listen(runtime: &Runtime, args: &WallArgs) -> anyhow::Result<TcpListener> {
    let address = args.listen();
    if !address.ip().to_canonical().is_loopback() && args.key.is_none() && !args.insecure {
        bail!(
            "--listen {address} is open to the network: make a key with `{}`, copy it to the render servers and \
             give it to both sides with --key wall.key, or add --insecure if you trust everybody on the network",
            make_key_command("wall.key".as_ref())
        );
    }
    let listener = runtime.block_on(TcpListener::bind(address)).with_context(|| {
        format!("cannot listen on {address}: is another wall running? --listen {}:0 takes a free port", address.ip())
    })?;
    // Scripts and people read where to connect to.
    say(format_args!("listening on {}", listener.local_addr()?))?;
    Ok(listener)
}

fn load_model(source: SceneSource) -> anyhow::Result<Model> {
    let bar = Progress::new(format!("loading {source}"));
    Ok(Model::load(source, &|fraction| bar.set(fraction))?)
}
