//! A farm whose frames are not displayed, and render servers for it: for measurements of links, motions and losses.

use std::{
    net::SocketAddr,
    path::PathBuf,
    process::{Child, Command},
    sync::mpsc::{self, Receiver, RecvTimeoutError},
    time::{Duration, Instant},
};

use anyhow::{Context, ensure};
use compositor::farm::{Farm, Frame, RenderGoal};
use shared::{
    appearance::Appearance,
    camera::Camera,
    detail::Detail,
    division::{Division, FrameSize},
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};
use tokio::{net::TcpListener, runtime::Runtime};

/// A frame of primary rays through the centres of samples.
pub fn frame_spec(scene: SceneId, camera: Camera, size: FrameSize) -> FrameSpec {
    FrameSpec {
        scene,
        camera,
        size,
        view: ShadingMode::Shaded,
        rays: LightingMode::default(),
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    }
}

/// Frame after frame, two in flight, as soon as `min_renderers` render servers are ready. There is no spec yet.
pub fn goal(division: Division, min_renderers: u32) -> RenderGoal {
    RenderGoal {
        spec: None,
        scene_path: None,
        next_scene: None,
        change: 0,
        sky_path: None,
        is_refinement: false,
        division,
        min_renderers,
        repeat: true,
        in_flight: 2,
        encoding: None,
        moved_at: Instant::now(),
    }
}

/// No frame and no state of the farm may take longer.
pub const TIMEOUT: Duration = Duration::from_secs(60);

/// A farm without a display.
pub struct MeasuredFarm {
    /// The farm.
    pub farm: Farm,
    wakeups: Receiver<()>,
    _runtime: Runtime,
}

impl MeasuredFarm {
    /// Listens, and renders `goal`.
    pub fn start(listen: SocketAddr, goal: RenderGoal) -> anyhow::Result<Self> {
        let runtime = compositor::cli::run::network_threads()?;
        let listener = runtime.block_on(TcpListener::bind(listen))?;
        let (wake, wakeups) = mpsc::sync_channel(1);
        let farm = {
            let _guard = runtime.enter();
            Farm::start(listener, None, goal, move || {
                // One unread wake-up call is enough.
                let _ = wake.try_send(());
            })?
        };
        Ok(Self { farm, wakeups, _runtime: runtime })
    }

    /// Waits for the farm's next wake-up call, at most `timeout`; whether there was one.
    pub fn wait(&self, timeout: Duration) -> bool {
        self.wakeups.recv_timeout(timeout) != Err(RecvTimeoutError::Timeout)
    }

    /// Waits for the next complete frame. An error after [`TIMEOUT`] says how the farm is.
    pub fn next_frame(&self) -> anyhow::Result<Frame> {
        loop {
            if let Some(frame) = self.farm.take_frame() {
                return Ok(frame);
            }
            ensure!(self.wait(TIMEOUT), "no frame comes: {:?}", self.farm.status());
        }
    }
}

/// The program `renderer`, which is built beside the laboratory's program or its examples.
pub fn renderer_program() -> anyhow::Result<PathBuf> {
    let own = std::env::current_exe()?;
    let folder = own.parent().context("a program lies in a folder")?;
    let folder = if folder.ends_with("examples") { folder.parent().unwrap_or(folder) } else { folder };
    Ok(folder.join("renderer").with_extension(std::env::consts::EXE_EXTENSION))
}

/// A render server with one thread; its process ends when this is dropped.
pub struct ServerProcess {
    /// The name that it joins with.
    pub name: String,
    process: Child,
}

impl ServerProcess {
    /// Starts the program `renderer`, built beside the examples, for the wall at `address`. `launcher` holds the words of
    /// a command that starts it, if any.
    pub fn start(name: String, address: SocketAddr, launcher: &str, options: &[&str]) -> anyhow::Result<Self> {
        let program = renderer_program()?.display().to_string();
        let mut words = launcher.split_whitespace().chain([program.as_str()]);
        let mut command = Command::new(words.next().context("the last word is the program")?);
        command.args(words).args(["connect", &address.to_string(), "--insecure", "--threads", "1", "--name", &name]);
        Self::spawn(name, command.args(options).env("RUST_LOG", "error"))
    }

    /// Starts a command that is a render server of this name.
    pub fn spawn(name: String, command: &mut Command) -> anyhow::Result<Self> {
        let process = command.spawn().with_context(|| {
            format!("{} does not start: build it with cargo build --release", command.get_program().display())
        })?;
        Ok(Self { name, process })
    }

    /// The process's number.
    pub fn id(&self) -> u32 {
        self.process.id()
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // One that has ended by itself is only waited for.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Render servers that answer at once, with synthetic pictures.
#[derive(clap::Args)]
pub struct SyntheticServers {
    /// Answer with this picture in place of noise
    #[arg(long, value_name = "FILE.png")]
    replay: Option<PathBuf>,
    /// The address to listen on, for example in a network namespace with a link of limited rate
    #[arg(long, default_value = "127.0.0.1:0")]
    pub listen: SocketAddr,
    /// The command that starts render servers, for example "ip netns exec other"
    #[arg(long, default_value = "")]
    through: String,
}

impl SyntheticServers {
    /// Starts `n_servers` for the wall at `address`.
    pub fn start(&self, n_servers: u32, address: SocketAddr) -> anyhow::Result<Vec<ServerProcess>> {
        let picture = self.replay.as_ref().map(|picture| picture.to_string_lossy());
        let options = picture.as_ref().map_or(vec!["--blank"], |picture| vec!["--replay", picture]);
        let start = |number| ServerProcess::start(format!("blank-{number}"), address, &self.through, &options);
        (1..=n_servers).map(start).collect()
    }
}
