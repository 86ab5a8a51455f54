//! The messages between the wall and its render servers.
//!
//! Both sides open with [`PREAMBLE`]. Then each message is a length, a kind and a body. Control messages are bincode;
//! samples are a fixed header followed by RGB bytes, which no serializer touches. [`crate::codec`] encodes both.
//!
//! A conversation: the server sends [`ToWall::Hello`], the wall answers [`ToServer::Welcome`]. The wall names a scene
//! ([`ToServer::LoadScene`]), and the server reports its progress ([`ToWall::SceneState`]); it may name the next one ahead
//! ([`ToServer::PrepareScene`]). The wall then gives out tasks
//! ([`ToServer::RenderFrame`]), and the server answers each with [`Chunk`]s and a [`ToWall::TaskDone`]. Heartbeats flow all
//! the time; a [`ToServer::Probe`], a [`ToServer::Look`] or a [`ToServer::Measure`] may come at any time.
//!
//! A server that lacks the scene may fetch its scene file, on a connection of its own that opens with
//! [`ToWall::FetchScene`] in place of a hello. The wall answers with [`ToServer::SceneFileAwaited`] while it makes the file,
//! then with [`ToServer::SceneFile`]. The server asks for the file's bytes with [`ToWall::FetchPart`]; they come in order, as
//! bare bytes of at most [`CHUNK_BYTES`] a message.

use std::{fmt, ops::Range, time::Duration};

use glam::DVec3;
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantArray};

use crate::{
    appearance::{Appearance, Clip},
    camera::Camera,
    curve::TILES_PER_SQUARE,
    detail::Detail,
    division::{FrameSize, Share, Task},
    marks::SurfaceWay,
    names::unknown_name,
    noise::NoiseLimit,
    printable::bytes,
    scene::SceneId,
    sky::SkyId,
    structure::Structure,
};

/// The version of all messages, and of the bits of a frame: a change to either changes it.
pub const PROTOCOL_VERSION: u8 = 23;

/// The first bytes that either side sends: "RAYWALL" and the version.
pub const PREAMBLE: [u8; 8] = [b'R', b'A', b'Y', b'W', b'A', b'L', b'L', PROTOCOL_VERSION];

/// The first bytes of a side that has a key: "RAYLOCK" and the version. A Noise handshake follows, and then the same
/// conversation encrypted, from its [`PREAMBLE`] on.
pub const SECURE_PREAMBLE: [u8; 8] = [b'R', b'A', b'Y', b'L', b'O', b'C', b'K', PROTOCOL_VERSION];

/// Interval of each side's heartbeats.
pub const HEARTBEAT_INTERVAL: Duration = Duration::from_millis(50);

/// A render server that was silent for this long gets no more tasks, and its tasks go to others.
pub const HEARTBEAT_TIMEOUT: Duration = Duration::from_millis(250);

/// A peer that was silent for this long is lost. A slow link resends lost packets in less time.
pub const SILENCE_LIMIT: Duration = Duration::from_secs(2);

/// The longest time from connecting to a finished handshake.
pub const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(2);

/// The most RGB bytes in one chunk: a larger one would delay heartbeats.
pub const CHUNK_BYTES: usize = 64 * 1024;

/// The most bytes of a scene file that one [`ToWall::FetchPart`] asks for: those of a chunk that has a hash of its own.
pub const FETCH_BYTES: usize = 1 << 20;

/// A peer that was silent for this long while a scene file travels is lost: frames go first, and disks are slow.
pub const FETCH_SILENCE_LIMIT: Duration = Duration::from_secs(30);

/// The longest name a render server can have, in bytes.
pub const LONGEST_NAME: usize = 64;

/// The port of the wall unless another is set.
pub const DEFAULT_PORT: u16 = 7117;

/// The number of a frame, from 1 on since the wall started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FrameId(pub u64);

/// The number of a task, unique among all tasks of a wall.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TaskId(pub u32);

/// The subject of a frame's samples; a key steps through the variants in this order.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, Display, EnumString, VariantArray,
)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum ShadingMode {
    /// The model, lit.
    #[default]
    Shaded,
    /// The normals that light falls on, as colours.
    Normals,
    /// The cost of each ray: cells passed in blue, triangles tested in orange.
    Cost,
}

/// The rays that light a sample: each of the first three modes includes those before it; a key steps through them in this
/// order.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, Display, EnumString, VariantArray,
)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum LightingMode {
    /// Rays from the eye only.
    #[default]
    Primary,
    /// From each hit a ray to the key light.
    Shadows,
    /// From each hit short hemisphere rays, which find close surfaces.
    #[serde(rename = "ambient")]
    #[strum(serialize = "ambient")]
    AmbientOcclusion,
    /// Paths of light from a sun and a sky, which bounces between surfaces.
    Path,
}

/// The samples of each pixel that are averaged in linear light: numbers `first` to `first + count − 1`.
///
/// Sample 0 goes through the pixel's centre; the position of others is a pure function of pixel and sample number.
///
/// Invariant on the wire: at least one and at most [`SampleRange::LARGEST_COUNT`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(u32, u32, NoiseLimit)")]
pub struct SampleRange {
    /// The first sample's number.
    pub first: u32,
    /// Number of samples, from 1 to [`SampleRange::LARGEST_COUNT`].
    pub count: u32,
    /// Path-traced pixels with no more noise than this get fewer samples.
    pub noise: NoiseLimit,
}

impl SampleRange {
    /// One sample through the centre of each pixel.
    pub const CENTRE: Self = Self::all(0, 1);

    /// All of these samples, whatever the noise.
    pub const fn all(first: u32, count: u32) -> Self {
        Self { first, count, noise: NoiseLimit::NONE }
    }

    /// The samples that options ask for, or the default of these rays: one, or as many paths as their noise needs. Whoever
    /// asks for a number of samples, and not for a noise, gets all of them.
    pub fn asked(rays: LightingMode, count: Option<u32>, noise: Option<NoiseLimit>) -> Self {
        let default = if rays == LightingMode::Path { Self::LARGEST_COUNT } else { 1 };
        let of_count = if count.is_some() { NoiseLimit::NONE } else { NoiseLimit::default() };
        Self { first: 0, count: count.unwrap_or(default), noise: noise.unwrap_or(of_count) }
    }

    /// The most samples of one frame; more are split over several frames.
    pub const LARGEST_COUNT: u32 = 256;
}

/// The count is out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} samples a pixel: from 1 to {max} are possible", max = SampleRange::LARGEST_COUNT)]
pub struct SampleRangeError(u32);

impl TryFrom<(u32, u32, NoiseLimit)> for SampleRange {
    type Error = SampleRangeError;

    fn try_from((first, count, noise): (u32, u32, NoiseLimit)) -> Result<Self, SampleRangeError> {
        let is_valid = (1..=Self::LARGEST_COUNT).contains(&count);
        if is_valid { Ok(Self { first, count, noise }) } else { Err(SampleRangeError(count)) }
    }
}

/// How samples travel; they arrive unchanged.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, Display, EnumString, VariantArray,
)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum Encoding {
    /// Unpacked.
    #[default]
    Raw,
    /// As an LZ4 block if that is shorter.
    #[strum(serialize = "lz4", to_string = "LZ4")]
    Lz4,
}

impl Encoding {
    /// The other of the two.
    pub fn other(self) -> Self {
        match self {
            Self::Raw => Self::Lz4,
            Self::Lz4 => Self::Raw,
        }
    }
}

/// The frame that is asked for. It decides all samples: equal specs give equal bits.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the fields' types say it")]
pub struct FrameSpec {
    pub scene: SceneId,
    pub camera: Camera,
    pub size: FrameSize,
    pub view: ShadingMode,
    pub rays: LightingMode,
    pub samples: SampleRange,
    pub detail: Detail,
    pub appearance: Appearance,
}

/// A sky image to load.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkyFile {
    /// The image.
    pub id: SkyId,
    /// Its path, as that of the model.
    pub path: Option<Vec<u8>>,
}

/// A message from the wall to a render server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the types of most fields say it")]
pub enum ToServer {
    /// The answer to [`ToWall::Hello`].
    Welcome,
    /// The wall refuses this server and closes the connection.
    Refused {
        /// The reason and the cure.
        reason: String,
    },
    /// Load this scene.
    LoadScene {
        scene: SceneId,
        /// The model's path, in the bytes of the system's paths, for a server on the wall's own machine. Other servers use
        /// the models that they were started with.
        path: Option<Vec<u8>>,
        /// The grid that was chosen at the wall, if any; else the server uses its own options.
        structure: Option<Structure>,
        /// The sky image that lights the scene, if there is one.
        sky: Option<SkyFile>,
    },
    /// Load this scene beside the present one, if there is memory for both: [`ToServer::LoadScene`] may follow. The server
    /// answers nothing.
    PrepareScene {
        scene: SceneId,
        /// As in [`ToServer::LoadScene`], as are the other fields.
        path: Option<Vec<u8>>,
        structure: Option<Structure>,
        sky: Option<SkyFile>,
    },
    /// Render a share of a frame.
    RenderFrame {
        frame: FrameId,
        /// The task's number, repeated in every answer.
        task_id: TaskId,
        spec: FrameSpec,
        /// The units to render.
        task: Task,
        /// How the samples must travel.
        encoding: Encoding,
    },
    /// The wall wants no more answers to this frame.
    Cancel { frame: FrameId },
    /// The wall's heartbeat; the server answers with the same number.
    Ping {
        /// Microseconds on the wall's clock.
        sent_us: u64,
    },
    /// Find the triangle at a point of the view plane: one ray, outside of any frame.
    Probe {
        /// The probe's number, repeated in the answer.
        number: u32,
        scene: SceneId,
        camera: Camera,
        /// The point of the view plane, as parts of its edges u and v.
        at: [f32; 2],
        clip: Option<Clip>,
    },
    /// Find out which points the eye sees: one ray to each, outside of any frame.
    Look {
        /// The question's number, repeated in the answer.
        number: u32,
        scene: SceneId,
        camera: Camera,
        clip: Option<Clip>,
        /// In world space.
        points: Vec<DVec3>,
    },
    /// Find the way from one point to another along the surface, in the plane of both points and a direction.
    Measure {
        /// The question's number, repeated in the answer.
        number: u32,
        scene: SceneId,
        /// On the surface, in world space.
        ends: [DVec3; 2],
        /// Of any length, across the surface.
        across: DVec3,
    },
    /// The scene file that [`ToWall::FetchScene`] asks for is being made.
    SceneFileAwaited {
        /// 0 to 1.
        progress: f32,
    },
    /// The scene file that [`ToWall::FetchScene`] asks for.
    SceneFile {
        /// Its length.
        n_bytes: u64,
        /// The hash in its head, which stands for all of it.
        hash: [u8; 32],
    },
}

/// A message from a render server to the wall.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "the types of most fields say it")]
pub enum ToWall {
    /// The first message.
    Hello {
        /// The server's name on screen, at most [`LONGEST_NAME`] bytes.
        name: String,
        /// Number of tracing threads.
        threads: u32,
    },
    /// The scene's state; sent after every change, and a few times a second while loading.
    SceneState { scene: SceneId, state: SceneState },
    /// All chunks of a task are sent.
    TaskDone { frame: FrameId, task_id: TaskId, timings: TaskTimings, costs: RunCosts },
    /// The server's heartbeat.
    Heartbeat,
    /// The answer to a ping.
    Pong {
        /// As in the ping.
        sent_us: u64,
    },
    /// The answer to a probe; a server without the scene sends none.
    Probed {
        /// As in the probe.
        number: u32,
        /// The nearest triangle or cap, if any.
        hit: Option<ProbeHit>,
    },
    /// The answer to a look; a server without the scene sends none.
    Seen {
        /// As in the look.
        number: u32,
        /// Whether the eye sees each of the points.
        seen: Vec<bool>,
    },
    /// The answer to a [`ToServer::Measure`]; a server without the scene sends none.
    Measured {
        /// As in the question.
        number: u32,
        /// The shortest, if any leads along the surface.
        way: Option<SurfaceWay>,
    },
    /// The first message of a connection that fetches the wall's scene, and no other.
    FetchScene { scene: SceneId },
    /// Send bytes of the scene file.
    FetchPart {
        /// The first byte.
        first: u64,
        /// Number of bytes, from 1 to [`FETCH_BYTES`].
        n_bytes: u32,
    },
}

/// The triangle, or the cap of a cut, at a point of the view plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProbeHit {
    /// Its file index, from 0; `None` on the cap of a cut.
    pub triangle: Option<u32>,
    /// Distance of the hit, in units of the vector from the eye to the point of the view plane.
    pub t: f32,
    /// The hit in world space, in `f64` on the plane of its triangle.
    pub point: DVec3,
    /// The unit normal of that plane, on the side of the eye.
    pub normal: DVec3,
}

/// State of a scene on a render server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum SceneState {
    /// Loading or building.
    Loading {
        /// 0 to 1.
        progress: f32,
    },
    /// The server can render it.
    Ready {
        /// Triangles that can be hit.
        triangles: u64,
        /// Bytes of mesh and structure in memory.
        bytes: u64,
        /// The grid's storage and density; `None` if there is no grid.
        grid: Option<Structure>,
    },
    /// The server does not have the scene.
    Missing {
        /// The reason and the cure.
        reason: String,
    },
    /// The scene's file is on its way from the wall.
    Fetching(Transfer),
}

/// The progress of a scene file's transfer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Transfer {
    /// Bytes that have arrived and are right.
    pub n_done: u64,
    /// Bytes of the file.
    pub n_bytes: u64,
    /// The rate of the last seconds; 0 at first.
    pub bytes_per_second: u64,
}

impl Transfer {
    /// The fraction that has arrived, 0 to 1.
    pub fn fraction(&self) -> f32 {
        if self.n_bytes == 0 { 0.0 } else { (self.n_done as f64 / self.n_bytes as f64).min(1.0) as f32 }
    }

    /// Seconds until the file is there, if its rate lasts; `None` without a rate.
    pub fn seconds_left(&self) -> Option<u64> {
        let n_left = self.n_bytes.saturating_sub(self.n_done);
        (self.bytes_per_second > 0).then(|| n_left.div_ceil(self.bytes_per_second))
    }
}

impl fmt::Display for Transfer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.0} % of {}", self.fraction() * 100.0, bytes(self.n_bytes))?;
        match self.seconds_left() {
            Some(seconds) => write!(f, ", {}/s, {seconds} s left", bytes(self.bytes_per_second)),
            None => Ok(()),
        }
    }
}

/// The time that one task took on the server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TaskTimings {
    /// From reading the request to the first ray, in microseconds.
    pub queued_us: u32,
    /// From the first ray to the last sample, in microseconds.
    pub trace_us: u32,
    /// CPU time of all tracing threads, in microseconds.
    pub trace_cpu_us: u32,
    /// Waiting for the network to take the chunks, in microseconds.
    pub send_us: u32,
}

/// Costs of a task's units, measured in runs of units.
///
/// The dynamic division uses those of tiles along the curve; where units are others, a run is a chunk, and its cost is only
/// shown. Empty if there would be more than [`RunCosts::MOST_RUNS`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunCosts {
    /// Units in each run but the last, which has the rest.
    pub run_units: u32,
    /// CPU time of each run's rays, in nanoseconds.
    pub cpu_ns: Vec<u32>,
}

impl RunCosts {
    /// The most runs of one task: their costs fit a control message with room to spare.
    pub const MOST_RUNS: u32 = 32 * 1024;

    /// The most tiles in a run, if [`RunCosts::MOST_RUNS`] allows: they take some hundred microseconds, of which reading
    /// the clock is a small part.
    pub const LARGEST_RUN: u32 = 2 * TILES_PER_SQUARE;

    /// A task that would have fewer of the largest runs than this is measured in smaller ones.
    const FEWEST_RUNS: u32 = 64;

    /// Number of tiles in a run of this share; tiles that are not contiguous have unrelated costs, so each is measured
    /// alone.
    pub fn run_units(share: &Share) -> u32 {
        let n_units = share.count();
        let usual = match share.is_contiguous() {
            true if n_units >= Self::FEWEST_RUNS * Self::LARGEST_RUN => Self::LARGEST_RUN,
            true => TILES_PER_SQUARE,
            false => 1,
        };
        usual.max(n_units.div_ceil(Self::MOST_RUNS))
    }

    /// Whether these are the runs of a task of `n_units` units, or none at all.
    pub fn fits(&self, n_units: u32) -> bool {
        let n_runs = n_units.checked_div(self.run_units).map(|_| n_units.div_ceil(self.run_units));
        self.cpu_ns.is_empty() || n_runs.is_some_and(|n_runs| n_runs as usize == self.cpu_ns.len())
    }

    /// Each run's tiles, by index in the task, and the run's cost in nanoseconds.
    ///
    /// The costs must [fit](RunCosts::fits) a task of `n_units` units.
    pub fn runs(&self, n_units: u32) -> impl Iterator<Item = (Range<u32>, u32)> {
        let starts = (0..n_units).step_by(self.run_units.max(1) as usize);
        starts.zip(&self.cpu_ns).map(move |(first, &cpu_ns)| {
            let end = first.saturating_add(self.run_units).min(n_units);
            (first..end, cpu_ns)
        })
    }
}

/// Samples of consecutive units of a task. Idempotent: all answers to one task are the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chunk<'a> {
    /// The task's frame.
    pub frame: FrameId,
    /// The task.
    pub task_id: TaskId,
    /// Index of the first unit in the task.
    pub first_unit: u32,
    /// Number of units.
    pub n_units: u32,
    /// Samples of these units, sRGB-encoded RGB, at most [`CHUNK_BYTES`].
    pub rgb: &'a [u8],
}
