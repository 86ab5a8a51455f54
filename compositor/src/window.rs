//! The wall in one window, or in one window for each output, controlled by mouse and keyboard.
//!
//! All of this runs on the main thread, and only after an event: of a window, of a timer, or from another thread through
//! a [`Waker`]. A wall at rest uses no CPU time.

mod app;
mod calibrating;
mod effect;
mod frame_rate;
mod jobs;
mod join;
mod model_loader;
mod outputs;
mod painter;
mod screen;
mod screenshots;
pub(crate) mod session;
mod waker;

use std::ops::ControlFlow;

use anyhow::{Context, anyhow};
use winit::event_loop::EventLoop;

pub(crate) use self::{
    calibrating::{OnWish, Page, Wish},
    join::{host_name, join_hint, own_address},
    waker::Waker,
};
use self::{session::display_environment, waker::Call};
use crate::{
    calibration::Plan,
    cli::args::{Inputs, WallArgs},
    devices::Devices,
    farm::{Farm, Frame, stats::DisplayStats},
    remote::Remote,
    supervisor::SupervisorLink,
    wall::Wall,
};

/// Called for every new frame once it is on screen; breaks to close the window.
pub(crate) type OnShown = Box<dyn FnMut(&Frame, &DisplayStats) -> ControlFlow<()>>;

/// Whom the window obeys beside keys and mouse.
#[derive(Debug)]
pub(crate) struct Steering {
    pub(crate) remote: Option<Remote>,
    pub(crate) devices: Devices,
}

/// The connection to the display; [`WindowLoop::run`] opens the window.
#[derive(Debug)]
pub(crate) struct WindowLoop(EventLoop<Call>);

impl WindowLoop {
    /// Connects to the display, unless there is none or a library is missing: then `otherwise` says how to do without a
    /// window. Call it on the main thread, and only once.
    pub(crate) fn new(otherwise: &str) -> anyhow::Result<Self> {
        display_environment::check().map_err(|error| anyhow!("{error}; or {otherwise}"))?;
        let event_loop = EventLoop::with_user_event().build().with_context(|| {
            let display = |name| std::env::var(name).unwrap_or_default();
            format!(
                "no window can be opened (DISPLAY={}, WAYLAND_DISPLAY={}): check that the display runs and lets this \
                 user in, or {otherwise}",
                display("DISPLAY"),
                display("WAYLAND_DISPLAY")
            )
        })?;
        Ok(Self(event_loop))
    }

    /// Wakes this window: for [`Farm::start`].
    pub(crate) fn waker(&self) -> Waker {
        Waker(self.0.create_proxy())
    }

    /// Opens the windows and shows a page of a calibration, then what `on_wish` wants, until it breaks. See
    /// [`calibrating::Patterns`].
    pub(crate) fn calibrate(self, wall: &Wall, plan: &Plan, first: Page, on_wish: OnWish<'_>) -> anyhow::Result<()> {
        let mut patterns = calibrating::Patterns::new(wall, plan, first, on_wish);
        self.0.run_app(&mut patterns).context("the display connection failed")?;
        patterns.into_outcome()
    }

    /// Opens the windows and shows the frames of `farm` until one is closed, the GPU fails, or the first model cannot be
    /// read. Reports windows and the first frame to the `supervisor`, and obeys those who steer.
    pub(crate) fn run(
        self,
        args: &WallArgs,
        inputs: Inputs,
        farm: &Farm,
        on_shown: OnShown,
        supervisor: Option<SupervisorLink>,
        steering: Steering,
    ) -> anyhow::Result<()> {
        let waker = self.waker();
        let mut app = app::App::new(args, inputs, farm, on_shown, waker, supervisor, steering);
        self.0.run_app(&mut app).context("the display connection failed")?;
        app.into_outcome()
    }
}
