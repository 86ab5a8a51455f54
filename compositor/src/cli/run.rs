//! Runs a wall from its command line: model, farm, local render servers, with or without a window.

use std::{
    cell::RefCell,
    io,
    net::{Ipv4Addr, SocketAddr},
    ops::ControlFlow,
    path::{Path, PathBuf},
    rc::Rc,
    sync::mpsc,
    time::Instant,
};

use anyhow::{Context, anyhow, bail};
use channel::key::{Key, have_key_advice};
use renderer::cli::{
    check_writable, say,
    stop::{self, Signal},
};
use tokio::{
    net::{TcpListener, lookup_host},
    runtime::Runtime,
};

use super::{
    announcing::announce,
    args::{Inputs, WallArgs},
    headless::{Wakeup, Wakeups, run_headless},
    local::LocalServers,
    report::Report,
};
use crate::{
    control::{
        show::{self, Show},
        sidecar,
    },
    devices::Devices,
    farm::{Farm, RenderGoal},
    remote::Remote,
    supervisor::{self, SupervisorLink},
    window::{OnShown, Steering, WindowLoop},
};

/// Runs a wall to its end.
pub fn run(args: &WallArgs) -> anyhow::Result<()> {
    let sky = args.appearance.read_sky()?.map(|sky| sky.id());
    let mut inputs = Inputs {
        sky,
        wall: args.show.load_wall()?,
        camera: args.show.read_camera()?,
        path: args.path.as_deref().map(sidecar::read_path).transpose().map_err(anyhow::Error::msg)?,
        show: args.show_file.as_deref().map(read_show).transpose()?,
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

/// The show of a file, with the file's path.
fn read_show(file: &Path) -> anyhow::Result<(PathBuf, Show)> {
    // Scenes name their files beside it, wherever the wall was started.
    let file = std::path::absolute(file).unwrap_or_else(|_| file.to_owned());
    let show = show::read(&file).map_err(anyhow::Error::msg)?;
    Ok((file, show))
}

fn run_window(args: &WallArgs, inputs: Inputs, supervisor: Option<SupervisorLink>) -> anyhow::Result<()> {
    let window = WindowLoop::new("use --headless")?;
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
    let devices = Devices::start(&args.devices.options(), move || waker.wake())?;
    let waker = window.waker();
    let _announcement = announce(args, &listener, key.as_ref())?;
    // Made before the farm, so that they end after it: otherwise the farm would report them as lost.
    let mut servers = LocalServers::empty(listener.local_addr()?, args.key.as_deref(), &args.scene)?;
    let farm = start_farm(&runtime, listener, key, args, n_needed, move || waker.wake())?;
    servers.start(args.n_local(), farm.local_reporter())?;
    let report = Rc::new(RefCell::new(Report::default()));
    let on_shown = watch_frames(args, Rc::clone(&report));
    let outcome = window.run(args, inputs, &farm, on_shown, supervisor, Steering { remote, devices });
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
pub(super) fn start_farm(
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
        next_scene: None,
        change: 0,
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

pub(super) fn listen(runtime: &Runtime, args: &WallArgs) -> anyhow::Result<TcpListener> {
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
