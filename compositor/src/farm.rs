//! The farm: render servers that connect over TCP, and the frames that they render together.
//!
//! [`Farm::start`] listens and runs the farm on the caller's tokio runtime. The rest of the wall steers it through
//! [`Farm::want`] and takes finished frames from [`Farm::take_frame`]; neither ever waits.

mod connection;
mod frame_buffer;
pub(crate) mod replay;
mod scheduler;
mod service;
mod silence;
pub mod stats;
mod tile_row;
mod unit_set;

use std::{
    io,
    net::SocketAddr,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::Instant,
};

use channel::key::Key;
use shared::{
    appearance::Clip,
    camera::Camera,
    division::{Division, FrameSize},
    protocol::{Encoding, FrameSpec},
    scene::SceneId,
    structure::Structure,
};
use tokio::{
    net::TcpListener,
    sync::{Notify, watch},
};

pub use self::frame_buffer::FrameSamples;
use self::{
    frame_buffer::{BufferPool, PlaceError},
    stats::{FarmStatus, FrameStats},
};

/// What the wall wants to see: always the latest, whatever was wanted before.
#[derive(Clone, Debug)]
pub struct RenderGoal {
    /// The picture, once there is a scene to render.
    pub spec: Option<FrameSpec>,
    /// Where render servers on this machine find the scene.
    pub scene_path: Option<PathBuf>,
    /// Whether the picture only refines what was shown already: it is given up as soon as another is wanted.
    pub is_refinement: bool,
    /// How frames are divided.
    pub division: Division,
    /// No frame starts with fewer render servers ready.
    pub min_renderers: u32,
    /// Render frame after frame, even if nothing changed.
    pub repeat: bool,
    /// How many frames are rendered at a time, so that render servers do not wait for the wall; at least 1.
    pub in_flight: u32,
    /// How samples travel; `None`: whichever way each link is measured to be faster with.
    pub encoding: Option<Encoding>,
    /// When the camera moved to where it is.
    pub moved_at: Instant,
}

/// A whole frame.
#[derive(Clone, Debug)]
pub struct Frame {
    /// What it shows.
    pub spec: FrameSpec,
    /// Its samples.
    pub rgba: FrameSamples,
    /// How it came about.
    pub stats: FrameStats,
    /// When its camera was set.
    pub moved_at: Instant,
}

/// A question about the model: what is seen at one point of the canvas.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Probe {
    /// Each question has its own, from 1.
    pub number: u32,
    /// What is looked at, and from where; `None` asks nothing.
    pub view: Option<(SceneId, Camera)>,
    /// Which point of the view plane, as parts of its edges u and v.
    pub at: [f32; 2],
    /// Where it is cut open, if anywhere.
    pub clip: Option<Clip>,
}

/// Puts whole frames in their places as connections do, to measure what that takes.
#[derive(Debug, Default)]
pub(crate) struct SamplePlacer(BufferPool);

impl SamplePlacer {
    /// Takes all of a frame, divided for one render server, in chunks of at most so many bytes.
    pub(crate) fn place(
        &self,
        size: FrameSize,
        division: Division,
        mut rgb: &[u8],
        most_bytes: usize,
    ) -> Result<FrameSamples, PlaceError> {
        let task = division.task(0, 1);
        let share = task.share(size).expect("one render server can have all of a frame");
        let buffer = Arc::new(self.0.take(size));
        let n_units = (most_bytes as u32 / (3 * share.units().samples_per_full_unit())).max(1);
        for first in (0..share.count()).step_by(n_units as usize) {
            let count = n_units.min(share.count() - first);
            let n_samples: u32 = (first..first + count).map(|k| share.samples(k).count()).sum();
            let (chunk, rest) = rgb.split_at(rgb.len().min(3 * n_samples as usize));
            buffer.place(&share, first, count, chunk)?;
            rgb = rest;
        }
        Ok(buffer.into_samples(self.0.clone()))
    }
}

/// A running farm. Dropping it ends it, and with it every connection.
#[derive(Debug)]
pub struct Farm {
    address: SocketAddr,
    goal: watch::Sender<RenderGoal>,
    probe: watch::Sender<Probe>,
    structure: watch::Sender<Option<Structure>>,
    status: watch::Receiver<FarmStatus>,
    finished: Arc<FinishedFrame>,
    service: tokio::task::JoinHandle<()>,
}

impl Farm {
    /// Serves render servers that connect to `listener`, with a key only those that have it too; must be called within a
    /// tokio runtime.
    ///
    /// `wake` is called from the farm's threads whenever there is a frame to take or the status has changed.
    pub fn start(
        listener: TcpListener,
        key: Option<Key>,
        goal: RenderGoal,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let finished = Arc::new(FinishedFrame::default());
        let (goal, wanted_receiver) = watch::channel(goal);
        let (probe, probes) = watch::channel(Probe::default());
        let (structure, structures) = watch::channel(None);
        let (status_sender, status) = watch::channel(FarmStatus::default());
        let service = service::Service::new(key, wanted_receiver, status_sender, Arc::clone(&finished), Box::new(wake));
        let service = tokio::spawn(service.run(listener, probes, structures));
        Ok(Self { address, goal, probe, structure, status, finished, service })
    }

    /// The address that the farm listens on, with its real port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Changes what the wall wants to see.
    pub fn update_goal(&self, change: impl FnOnce(&mut RenderGoal)) {
        self.goal.send_modify(change);
    }

    /// What the wall wants to see now.
    pub fn goal(&self) -> RenderGoal {
        self.goal.borrow().clone()
    }

    /// Asks a render server what is seen at a point; the answer comes with the [`FarmStatus`], and to the last question
    /// only. There is none while nobody has the scene.
    pub fn probe(&self, probe: Probe) {
        self.probe.send_replace(probe);
    }

    /// Has every render server keep the scene in another structure, those that join later too; the last frame stays until
    /// the first is ready. `None`: as each was started.
    pub fn set_structure(&self, structure: Option<Structure>) {
        self.structure.send_replace(structure);
    }

    /// Takes the finished frame, if there is one; the farm finishes no other before.
    pub fn take_frame(&self) -> Option<Frame> {
        self.finished.take()
    }

    /// The farm as it is now.
    pub fn status(&self) -> FarmStatus {
        self.status.borrow().clone()
    }
}

impl Drop for Farm {
    fn drop(&mut self) {
        self.service.abort();
    }
}

/// Where a finished frame waits for the wall to take it. Holding one frame is what keeps the farm from outrunning the
/// wall, and every frame from being shown less or more than once.
#[derive(Debug, Default)]
struct FinishedFrame {
    frame: Mutex<Option<Frame>>,
    taken: Notify,
}

impl FinishedFrame {
    fn put(&self, frame: Frame) {
        *self.frame.lock().unwrap_or_else(PoisonError::into_inner) = Some(frame);
    }

    fn take(&self) -> Option<Frame> {
        let frame = self.frame.lock().unwrap_or_else(PoisonError::into_inner).take();
        if frame.is_some() {
            self.taken.notify_one();
        }
        frame
    }
}
