//! The wall in a window, or in one for each of its outputs, under mouse and keyboard.
//!
//! Everything here runs on the main thread and only when something happened: an event of the window, a [`Waker`] of
//! another thread, or a moment that was waited for. A resting wall costs nothing.

mod app;
mod frame_rate;
mod jobs;
mod model_loader;
mod outputs;
mod painter;
mod screen;
mod screenshots;
pub mod session;

use std::{
    net::SocketAddr,
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::Context;
use renderer::model::scene::SceneSource;
use shared::{
    appearance::Appearance,
    camera::{Camera, CameraPath, UpAxis},
    protocol::{LightingMode, ShadingMode},
};
use winit::event_loop::{EventLoop, EventLoopProxy};

use self::session::display_environment;
use crate::{
    control::refinement::RefinementOptions,
    farm::{Farm, Frame, stats::DisplayStats},
    overlay::JoinHint,
    supervisor::SupervisorLink,
    wall::Wall,
};

/// What the windows show and how.
#[derive(Clone, Debug)]
pub struct WindowOptions {
    /// The wall that is shown, each part of it scaled to fit its window.
    pub wall: Wall,
    /// Where the wall's file is, if it is not the default: its corners are saved there.
    pub wall_file: Option<PathBuf>,
    /// The first model; others come by being dropped on the window.
    pub source: SceneSource,
    /// The camera on the first model; without one all of it is seen.
    pub camera: Option<Camera>,
    /// The axis that points up; without one that kept with the model's views, or y.
    pub up: Option<UpAxis>,
    /// A path to follow from the start, again and again.
    pub path: Option<CameraPath>,
    /// Whether visitors can only steer; how long after the last touch the wall goes back to its path, or to the whole model.
    pub kiosk: Option<Duration>,
    /// What the samples show at first.
    pub view: ShadingMode,
    /// By which rays they are lit.
    pub rays: LightingMode,
    /// From where they are lit at first, and what is behind the model.
    pub appearance: Appearance,
    /// How finely it is rendered.
    pub refinement: RefinementOptions,
    /// Whether the window fills the screen from the start; those of walls that name outputs do.
    pub fullscreen: bool,
    /// Whether the overlay is shown at first.
    pub overlay: bool,
    /// Where screenshots go.
    pub screenshot_folder: PathBuf,
    /// Where the wall is written to when the window closes.
    pub screenshot_at_end: Option<PathBuf>,
}

/// Told of every new frame once it is on screen; breaks to close the window.
pub type OnShown = Box<dyn FnMut(&Frame, &DisplayStats) -> ControlFlow<()>>;

/// What other threads want of the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Call {
    /// There is a frame to take, or something else to look at.
    Appearance,
    /// The wall is to end.
    Close,
}

/// Calls the window from other threads.
#[derive(Clone, Debug)]
pub struct Waker(EventLoopProxy<Call>);

impl Waker {
    /// Makes the window look.
    pub fn wake(&self) {
        // A window that is closed needs no waking.
        let _ = self.0.send_event(Call::Appearance);
    }

    /// Closes the window as an operator would.
    pub fn close(&self) {
        let _ = self.0.send_event(Call::Close);
    }
}

/// The connection to the display; the window itself opens with [`WindowLoop::run`].
#[derive(Debug)]
pub struct WindowLoop(EventLoop<Call>);

impl WindowLoop {
    /// Connects to the display; on the main thread, and once in a program.
    ///
    /// # Errors
    ///
    /// No display, or something that windows need is not installed.
    pub fn new() -> anyhow::Result<Self> {
        display_environment::check()?;
        let event_loop = EventLoop::with_user_event().build().with_context(|| {
            let display = |name| std::env::var(name).unwrap_or_default();
            format!(
                "no window can be opened (DISPLAY={}, WAYLAND_DISPLAY={}): check that the display runs and lets this \
                 user in, or use --headless",
                display("DISPLAY"),
                display("WAYLAND_DISPLAY")
            )
        })?;
        Ok(Self(event_loop))
    }

    /// For [`Farm::start`].
    pub fn waker(&self) -> Waker {
        Waker(self.0.create_proxy())
    }

    /// Opens the windows and shows what `farm` renders until one of them is closed; a guard hears of it through its `supervisor`.
    ///
    /// # Errors
    ///
    /// No GPU can draw on the window, the GPU fails, or the first model cannot be read; each with its cure.
    pub fn run(
        self,
        options: WindowOptions,
        farm: &Farm,
        on_shown: OnShown,
        supervisor: Option<SupervisorLink>,
    ) -> anyhow::Result<()> {
        let waker = self.waker();
        let mut app = app::App::new(options, farm, on_shown, waker, supervisor);
        self.0.run_app(&mut app).context("the display connection failed")?;
        app.into_outcome()
    }
}

/// The command that makes a render server join the wall that listens on `address` and shows `model`, if that is a
/// file; and a note on where.
fn join_hint(address: SocketAddr, model: Option<&Path>) -> JoinHint {
    let port = address.port();
    let (host, insecure, mut note) = if address.ip().is_loopback() {
        let note =
            format!("On this machine. For others to reach the wall, start it with --listen 0.0.0.0:{port} --insecure.");
        (address.ip().to_string(), "", note)
    } else {
        let host = if address.ip().is_unspecified() { host_name() } else { address.ip().to_string() };
        (host, " --insecure", "On this machine, or on any that reaches it.".to_owned())
    };
    let host = if host.contains(':') { format!("[{host}]") } else { host };
    let mut command = format!("renderer connect {host}:{port}{insecure}");
    if let Some(path) = model {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        command += &format!(" --model {}", shell_word(&path.to_string_lossy()));
        note += " The model is read from the render server's own disk.";
    }
    JoinHint { command, note }
}

/// Text as one word of a shell's command line.
fn shell_word(text: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+=:@,".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

/// What others call this machine, as far as it knows.
fn host_name() -> String {
    std::fs::read_to_string("/proc/sys/kernel/hostname")
        .ok()
        .map(|name| name.trim().to_owned())
        .filter(|name| !name.is_empty())
        .unwrap_or_else(|| "THIS-MACHINE".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_to_join_can_be_typed_as_it_stands() {
        let hint = |address: &str| join_hint(address.parse().expect(address), None);
        assert_eq!(hint("127.0.0.1:7117").command, "renderer connect 127.0.0.1:7117");
        assert!(hint("127.0.0.1:7117").note.contains("--listen 0.0.0.0:7117 --insecure"));
        assert_eq!(hint("10.1.2.3:80").command, "renderer connect 10.1.2.3:80 --insecure");
        assert_eq!(hint("[fe80::1]:80").command, "renderer connect [fe80::1]:80 --insecure");
        let any = hint("0.0.0.0:7117").command;
        assert!(any.ends_with(":7117 --insecure") && !any.contains("0.0.0.0"), "{any}");
        let with_model = join_hint(([127, 0, 0, 1], 80).into(), Some(Path::new("/models/it's a dragon.ply")));
        assert_eq!(with_model.command, r"renderer connect 127.0.0.1:80 --model '/models/it'\''s a dragon.ply'");
    }
}
