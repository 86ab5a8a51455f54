//! The wall in one window, or in one window for each output, controlled by mouse and keyboard.
//!
//! All of this runs on the main thread, and only after an event: of a window, of a timer, or from another thread through
//! a [`Waker`]. A wall at rest uses no CPU time.

mod app;
mod frame_rate;
mod jobs;
mod join;
mod model_loader;
mod options;
mod outputs;
mod painter;
mod screen;
mod screenshots;
pub mod session;
mod waker;

use anyhow::Context;
use winit::event_loop::EventLoop;

pub use self::{
    options::{OnShown, WindowOptions},
    waker::Waker,
};
use self::{session::display_environment, waker::Call};
use crate::{farm::Farm, supervisor::SupervisorLink};

/// The connection to the display; [`WindowLoop::run`] opens the window.
#[derive(Debug)]
pub struct WindowLoop(EventLoop<Call>);

impl WindowLoop {
    /// Connects to the display. Call it on the main thread, and only once in a program.
    ///
    /// # Errors
    ///
    /// There is no display, or a library that windows need is not installed.
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

    /// Wakes this window: for [`Farm::start`].
    pub fn waker(&self) -> Waker {
        Waker(self.0.create_proxy())
    }

    /// Opens the windows and shows the frames of `farm` until one of them is closed.
    ///
    /// Reports windows and the first frame to the process at the other end of `supervisor`, if there is one.
    ///
    /// # Errors
    ///
    /// No GPU can draw on the window, the GPU fails, or the first model cannot be read. Each message says what to do.
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
