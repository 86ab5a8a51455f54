//! The farm: render servers that connect over TCP, and the frames that they render together.
//!
//! [`Farm::start`] runs the farm on the caller's tokio runtime. The rest of the wall sets its goal with
//! [`Farm::update_goal`] and takes finished frames with [`Farm::take_frame`]; neither blocks.

mod connection;
mod frame_buffer;
mod local_news;
mod log_limit;
mod losses;
pub mod notices;
mod open_frame;
mod outbox;
mod questions;
mod rate_limit;
pub mod scheduler;
mod service;
mod silence;
pub mod stats;
mod supply;
mod tile_row;
mod transfer;

use std::{
    io,
    net::SocketAddr,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::Instant,
};

use channel::key::Key;
use glam::DVec3;
use renderer::{grid::GridOptions, scene_file::SceneStore};
use shared::{
    appearance::Clip,
    camera::Camera,
    division::Division,
    protocol::{Encoding, FrameSpec},
    scene::SceneId,
    structure::Structure,
};
use tokio::{
    net::TcpListener,
    sync::{Notify, mpsc, watch},
};

pub(crate) use self::{frame_buffer::MOST_FRAMES, log_limit::LogLimit, rate_limit::RateLimit};
pub use self::{
    frame_buffer::{BufferPool, FrameBuffer, FrameSamples, PlaceError},
    local_news::LocalReporter,
};
use self::{
    stats::{FarmStatus, FrameStats},
    supply::SceneSupply,
};

/// The frame that the wall wants rendered now, and how. The latest goal replaces all earlier ones.
#[derive(Clone, Debug)]
pub struct RenderGoal {
    /// The frame to render; `None` until there is a scene.
    pub spec: Option<FrameSpec>,
    /// Where render servers on this machine find the scene.
    pub scene_path: Option<PathBuf>,
    /// The scene that may come next, and where they find it: they load it beside the present one.
    pub next_scene: Option<(SceneId, Option<PathBuf>)>,
    /// The number of the change that the wall fades into: frames that were asked for since tell it.
    pub change: u32,
    /// Where they find the sky image that the spec names, if it does.
    pub sky_path: Option<PathBuf>,
    /// Whether the frame only refines one that was shown: it is cancelled as soon as another is wanted.
    pub is_refinement: bool,
    /// How frames are divided.
    pub division: Division,
    /// The first frame waits until so many render servers are ready, and the next one does if this number changes.
    pub min_renderers: u32,
    /// Render frame after frame, even if nothing changes.
    pub repeat: bool,
    /// Frames in flight: with several, render servers do not wait for the wall. At least 1.
    pub in_flight: u32,
    /// How samples travel; `None`: by measurement, the faster way for each link.
    pub encoding: Option<Encoding>,
    /// When the camera was set.
    pub moved_at: Instant,
}

/// A complete frame.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its contents.
    pub spec: FrameSpec,
    /// Its samples.
    pub rgba: FrameSamples,
    /// How it was rendered.
    pub stats: FrameStats,
    /// When its camera was set, or when it was started if an earlier frame shows that motion.
    pub moved_at: Instant,
    /// The change of its goal.
    pub change: u32,
}

impl Frame {
    /// Whether it shows the background alone.
    pub fn is_blank(&self) -> bool {
        let rgb = |&sample: &u32| {
            let [r, g, b, _] = sample.to_ne_bytes();
            [r, g, b]
        };
        self.spec.appearance.background.fills(self.spec.size, self.rgba.iter().map(rgb))
    }
}

/// A question about the model: which triangle is visible at one point of the canvas.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Probe {
    /// The question's number, from 1.
    pub number: u32,
    /// The scene and the camera; `None` asks nothing.
    pub view: Option<(SceneId, Camera)>,
    /// The point, as fractions of the view plane's edges u and v.
    pub at: [f32; 2],
    /// The clip plane, if there is one.
    pub clip: Option<Clip>,
}

/// A question about the model: which points of it a camera sees.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Look {
    /// The question's number, from 1.
    pub number: u32,
    /// The scene and the camera; `None` asks nothing.
    pub view: Option<(SceneId, Camera)>,
    /// The clip plane, if there is one.
    pub clip: Option<Clip>,
    /// The points, in world space.
    pub points: Arc<[DVec3]>,
}

/// A question about the model: how long the way along its surface is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Stretch {
    /// The question's number, from 1.
    pub number: u32,
    /// The scene; `None` asks nothing.
    pub scene: Option<SceneId>,
    /// On the surface, in world space.
    pub ends: [DVec3; 2],
    /// A direction across the surface: the way lies in the plane that it spans with the ends.
    pub across: DVec3,
}

/// A running farm. Dropping it closes every connection.
#[derive(Debug)]
pub struct Farm {
    address: SocketAddr,
    goal: watch::Sender<RenderGoal>,
    probe: watch::Sender<Probe>,
    look: watch::Sender<Look>,
    stretch: watch::Sender<Stretch>,
    structure: watch::Sender<Option<Structure>>,
    status: watch::Receiver<FarmStatus>,
    finished: Arc<FinishedFrame>,
    local: LocalReporter,
    supply: Arc<SceneSupply>,
    service: tokio::task::JoinHandle<()>,
}

impl Farm {
    /// Serves render servers that connect to `listener`: with a key, only those that have the same one. Must be called
    /// within a tokio runtime.
    ///
    /// The farm's threads call `wake` whenever there is a frame to take or the status has changed.
    pub fn start(
        listener: TcpListener,
        key: Option<Key>,
        goal: RenderGoal,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let finished = Arc::new(FinishedFrame::default());
        let (goal, goals) = watch::channel(goal);
        let (probe, probes) = watch::channel(Probe::default());
        let (look, looks) = watch::channel(Look::default());
        let (stretch, stretches) = watch::channel(Stretch::default());
        let (structure, structures) = watch::channel(None);
        let (status_sender, status) = watch::channel(FarmStatus::default());
        let (local, local_news) = mpsc::unbounded_channel();
        let supply = Arc::new(SceneSupply::default());
        let service = service::Service::new(
            key,
            goals,
            status_sender,
            Arc::clone(&finished),
            Arc::clone(&supply),
            Box::new(wake),
        );
        let service = tokio::spawn(service.run(listener, (probes, looks, stretches), structures, local_news));
        let local = LocalReporter(local);
        Ok(Self { address, goal, probe, look, stretch, structure, status, finished, local, supply, service })
    }

    /// The address that the farm listens on, with the actual port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// For who starts render servers of the wall's own: their names, and their ends.
    pub fn local_reporter(&self) -> LocalReporter {
        self.local.clone()
    }

    /// Lets render servers that lack the model fetch its scene file, which is made with these options when the first of them
    /// asks, and kept in the store's cache.
    pub fn give_scene_files(&self, store: SceneStore, options: GridOptions) {
        self.supply.make_with(store, options);
    }

    /// Changes the goal.
    pub fn update_goal(&self, change: impl FnOnce(&mut RenderGoal)) {
        self.goal.send_modify(change);
    }

    /// The current goal.
    pub fn goal(&self) -> RenderGoal {
        self.goal.borrow().clone()
    }

    /// Asks a render server which triangle is visible at a point. Only the last question is answered, in
    /// [`FarmStatus::probed`], and none while no render server has the scene.
    pub fn probe(&self, probe: Probe) {
        self.probe.send_replace(probe);
    }

    /// Asks a render server which points a camera sees. The last question is answered, in [`FarmStatus::seen`], as soon as a
    /// render server has the scene; those before it may be.
    pub fn look(&self, look: Look) {
        self.look.send_replace(look);
    }

    /// Asks a render server how long the way along the surface is. The last question is answered, in [`FarmStatus::way`], as
    /// soon as a render server has the scene.
    pub fn measure(&self, stretch: Stretch) {
        self.stretch.send_replace(stretch);
    }

    /// Has every render server keep the scene in another structure, those that join later too. The last frame stays
    /// visible until the first render server is ready. `None`: the structure that each was started with.
    pub fn set_structure(&self, structure: Option<Structure>) {
        self.structure.send_replace(structure);
    }

    /// Takes the finished frame, if there is one. The farm holds back the next until this one is taken.
    pub fn take_frame(&self) -> Option<Frame> {
        self.finished.take()
    }

    /// The farm's current status.
    pub fn status(&self) -> FarmStatus {
        self.status.borrow().clone()
    }
}

impl Drop for Farm {
    fn drop(&mut self) {
        self.service.abort();
    }
}

/// Holds a finished frame until the wall takes it. As it holds only one, the farm cannot outrun the wall, and each frame
/// is shown once.
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
