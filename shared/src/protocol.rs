//! The messages between the wall and its render servers.
//!
//! Both sides open with [`PREAMBLE`]. Then each message is a length, a kind and a body: control messages are bincode,
//! samples are a fixed header followed by raw RGB bytes, which no serializer touches; [`crate::codec`] does both.
//!
//! The order of a conversation: the server says [`ToWall::Hello`], the wall [`ToServer::Welcome`]; the wall names a
//! scene ([`ToServer::LoadScene`]) and hears how far it is ([`ToWall::SceneState`]); then it asks for shares of frames
//! ([`ToServer::RenderFrame`]) and gets [`Chunk`]s and a [`ToWall::TaskDone`] for each. Heartbeats flow all along, and now
//! and then a [`ToServer::Probe`] and its answer.

use std::{ops::Range, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{
    appearance::{Appearance, Clip},
    camera::Camera,
    curve::TILES_PER_SQUARE,
    division::{FrameSize, Share, Task},
    scene::SceneId,
    structure::Structure,
};

/// The version of everything below; a change to any message changes it.
pub const PROTOCOL_VERSION: u8 = 9;

/// The first bytes that either side sends: "RAYWALL" and the version.
pub const PREAMBLE: [u8; 8] = [b'R', b'A', b'Y', b'W', b'A', b'L', b'L', PROTOCOL_VERSION];

/// The first bytes of a side that has a key, before its Noise handshake: "RAYLOCK" and the version. What follows
/// encrypted is the same conversation, from its [`PREAMBLE`] on.
pub const SECURE_PREAMBLE: [u8; 8] = [b'R', b'A', b'Y', b'L', b'O', b'C', b'K', PROTOCOL_VERSION];

/// How often either side says that it lives.
pub const HEARTBEAT_INTERVAL: Duration = Duration::from_millis(50);

/// A render server that was silent for this long gets no more work, and others get what it has.
pub const HEARTBEAT_TIMEOUT: Duration = Duration::from_millis(250);

/// A peer that was silent for this long is lost: longer than a slow link takes to send lost packets again.
pub const SILENCE_LIMIT: Duration = Duration::from_secs(2);

/// How long a peer may take from connecting to a finished handshake.
pub const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(2);

/// The most RGB bytes in one chunk: small enough that heartbeats are never stuck behind one.
pub const CHUNK_BYTES: usize = 64 * 1024;

/// The longest name a render server can have, in bytes.
pub const LONGEST_NAME: usize = 64;

/// The port of the wall unless another is set.
pub const DEFAULT_PORT: u16 = 7117;

/// The number of a frame: counts up from 1 while a wall runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FrameId(pub u64);

/// The number of a piece of work: unique among all that a wall gives out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TaskId(pub u32);

/// What the samples of a frame show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadingMode {
    /// The model, lit.
    #[default]
    Shaded,
    /// The geometric normals, as colours.
    Normals,
    /// What each ray costs: cells passed in red, triangles tested in green.
    Cost,
}

impl ShadingMode {
    /// Every view, in the order in which a key steps through them.
    pub const ALL: [Self; 3] = [Self::Shaded, Self::Normals, Self::Cost];

    /// The name on command lines and on screen.
    pub fn name(self) -> &'static str {
        match self {
            Self::Shaded => "shaded",
            Self::Normals => "normals",
            Self::Cost => "cost",
        }
    }
}

impl std::str::FromStr for ShadingMode {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|view| view.name() == text)
            .ok_or_else(|| format!("\"{text}\" is no view: it is shaded, normals or cost"))
    }
}

/// The rays that a picture is made of: each kind includes those before it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LightingMode {
    /// Rays from the eye only.
    #[default]
    Primary,
    /// From each hit a ray to the key light.
    Shadows,
    /// From each hit short rays all around, which find what lies close by.
    AmbientOcclusion,
}

impl LightingMode {
    /// Every ray tree, in the order in which a key steps through them.
    pub const ALL: [Self; 3] = [Self::Primary, Self::Shadows, Self::AmbientOcclusion];

    /// The name on command lines and on screen.
    pub fn name(self) -> &'static str {
        match self {
            Self::Primary => "primary",
            Self::Shadows => "shadows",
            Self::AmbientOcclusion => "ambient",
        }
    }
}

impl std::str::FromStr for LightingMode {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|rays| rays.name() == text)
            .ok_or_else(|| format!("\"{text}\" is no kind of rays: it is primary, shadows or ambient"))
    }
}

/// Which samples of each pixel are averaged: numbers `first` to `first + count − 1`, in linear light.
///
/// Sample 0 goes through the pixel's centre; where the others go is a pure function of pixel and sample number.
///
/// Invariant on the wire: at least one and at most [`SampleRange::LARGEST_COUNT`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(u32, u32)", into = "(u32, u32)")]
pub struct SampleRange {
    /// The first sample's number.
    pub first: u32,
    /// How many; from 1 to [`SampleRange::LARGEST_COUNT`].
    pub count: u32,
}

impl SampleRange {
    /// One sample through the centre of each pixel.
    pub const CENTRE: Self = Self { first: 0, count: 1 };

    /// More samples than this are split over several frames.
    pub const LARGEST_COUNT: u32 = 256;
}

/// Why two numbers are no range of samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} samples a pixel: from 1 to {max} are possible", max = SampleRange::LARGEST_COUNT)]
pub struct SampleRangeError(u32);

impl TryFrom<(u32, u32)> for SampleRange {
    type Error = SampleRangeError;

    fn try_from((first, count): (u32, u32)) -> Result<Self, SampleRangeError> {
        let is_valid = (1..=Self::LARGEST_COUNT).contains(&count);
        if is_valid { Ok(Self { first, count }) } else { Err(SampleRangeError(count)) }
    }
}

impl From<SampleRange> for (u32, u32) {
    fn from(SampleRange { first, count }: SampleRange) -> Self {
        (first, count)
    }
}

/// How samples travel; what arrives is the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    /// As they are.
    #[default]
    Raw,
    /// As an LZ4 block, where that is shorter.
    Lz4,
}

impl Encoding {
    /// The name on screen.
    pub fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Lz4 => "LZ4",
        }
    }

    /// The one that this is not.
    pub fn other(self) -> Self {
        match self {
            Self::Raw => Self::Lz4,
            Self::Lz4 => Self::Raw,
        }
    }
}

impl std::str::FromStr for Encoding {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "raw" => Ok(Self::Raw),
            "lz4" => Ok(Self::Lz4),
            _ => Err(format!("\"{text}\" is no encoding: it is raw or lz4")),
        }
    }
}

/// Everything that decides the samples of a frame: two equal pictures are equal bits.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameSpec {
    /// What is rendered.
    pub scene: SceneId,
    /// From where.
    pub camera: Camera,
    /// At which resolution.
    pub size: FrameSize,
    /// What the samples show.
    pub view: ShadingMode,
    /// By which rays they are lit.
    pub rays: LightingMode,
    /// Which samples of each pixel.
    pub samples: SampleRange,
    /// From where it is lit, what is behind the model, and where it is cut open.
    pub appearance: Appearance,
}

/// What the wall says to a render server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ToServer {
    /// The answer to [`ToWall::Hello`].
    Welcome,
    /// The wall does not take this server, and closes the connection.
    Refused {
        /// Why, and what to do.
        reason: String,
    },
    /// Get this scene ready.
    LoadScene {
        /// Which scene.
        scene: SceneId,
        /// Where a server on the wall's own machine finds it, in the bytes of its system's paths; other servers use what
        /// they were started with.
        path: Option<Vec<u8>>,
        /// How its grid is to be kept, if somebody at the wall has said so; else as the server was started.
        structure: Option<Structure>,
    },
    /// Render a share of a frame.
    RenderFrame {
        /// Which frame.
        frame: FrameId,
        /// The number of this work, repeated in every answer.
        task_id: TaskId,
        /// The whole picture.
        spec: FrameSpec,
        /// The share of it.
        task: Task,
        /// How the samples are to travel.
        encoding: Encoding,
    },
    /// Answers to this frame are no longer wanted.
    Cancel {
        /// Which frame.
        frame: FrameId,
    },
    /// The wall lives; to be answered with the same number.
    Ping {
        /// Microseconds on the wall's clock.
        sent_us: u64,
    },
    /// Say what is seen at one point of the view plane; one ray, and not a part of any frame.
    Probe {
        /// The number of the question, repeated in the answer.
        number: u32,
        /// What is looked at.
        scene: SceneId,
        /// From where.
        camera: Camera,
        /// Which point of the view plane, as parts of its edges u and v.
        at: [f32; 2],
        /// Where it is cut open, if anywhere.
        clip: Option<Clip>,
    },
}

/// What a render server says to the wall.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ToWall {
    /// The first message.
    Hello {
        /// The server's name on screen, at most [`LONGEST_NAME`] bytes.
        name: String,
        /// Threads that it traces with.
        threads: u32,
    },
    /// How far the scene is; sent after every change, and a few times a second while loading.
    SceneState {
        /// Which scene.
        scene: SceneId,
        /// How far.
        state: SceneState,
    },
    /// All chunks of a work are sent.
    TaskDone {
        /// Which frame.
        frame: FrameId,
        /// Which work.
        task_id: TaskId,
        /// How long it took.
        timings: TaskTimings,
        /// Where in the work the time went.
        costs: RunCosts,
    },
    /// The server lives.
    Heartbeat,
    /// The answer to a ping.
    Pong {
        /// As in the ping.
        sent_us: u64,
    },
    /// The answer to a probe; none comes from a server that does not have the scene.
    Probed {
        /// As in the probe.
        number: u32,
        /// The nearest triangle there, if any.
        hit: Option<ProbeHit>,
    },
}

/// A triangle that is seen at a point of the view plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProbeHit {
    /// Its number in the file, from 0.
    pub triangle: u32,
    /// Where it is hit, in units of the way from the eye to the point of the view plane.
    pub t: f32,
}

/// How far a render server is with a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum SceneState {
    /// Loading or building.
    Loading {
        /// 0 to 1.
        progress: f32,
    },
    /// Frames of it can be asked for.
    Ready {
        /// Triangles that can be hit.
        triangles: u64,
        /// Bytes of mesh and structure in memory.
        bytes: u64,
        /// How the grid is kept, chosen or asked for; `None` if there is none.
        grid: Option<Structure>,
    },
    /// The server has no such scene.
    Missing {
        /// Why, and what to do.
        reason: String,
    },
}

/// Where the time of one work went on the server.
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

/// What the tiles of a work cost, in blocks of tiles that follow each other in the work.
///
/// Empty for a work whose units are not tiles along the curve: nobody would use it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunCosts {
    /// Tiles in each block but the last, which has what remains.
    pub run_units: u32,
    /// CPU time of each block's rays, in nanoseconds.
    pub cpu_ns: Vec<u32>,
}

impl RunCosts {
    /// The most blocks of one work: their costs fit a control message with room to spare.
    pub const MOST_RUNS: u32 = 32 * 1024;

    /// The most tiles in a block, if [`RunCosts::MOST_RUNS`] allows: some hundred microseconds of tracing, of which
    /// reading the clock is a small part.
    pub const LARGEST_RUN: u32 = 2 * TILES_PER_SQUARE;

    /// How many blocks a work should have, before they are made larger: cuts are placed to a part of one.
    const FEWEST_RUNS: u32 = 64;

    /// How many tiles make a block of a share; tiles that do not lie side by side have little in common, and are measured
    /// one by one.
    pub fn run_units(share: &Share<'_>) -> u32 {
        let n_units = share.count();
        let usual = match share.is_contiguous() {
            true if n_units >= Self::FEWEST_RUNS * Self::LARGEST_RUN => Self::LARGEST_RUN,
            true => TILES_PER_SQUARE,
            false => 1,
        };
        usual.max(n_units.div_ceil(Self::MOST_RUNS))
    }

    /// Whether these are the blocks of a work of `n_units` units, or none at all.
    pub fn fits(&self, n_units: u32) -> bool {
        let n_runs = n_units.checked_div(self.run_units).map(|_| n_units.div_ceil(self.run_units));
        self.cpu_ns.is_empty() || n_runs.is_some_and(|n_runs| n_runs as usize == self.cpu_ns.len())
    }

    /// The places in the work of each block's tiles, and what the block cost in nanoseconds.
    ///
    /// Invariant: the costs [fit](BlockCosts::fit) a work of `n_units` units.
    pub fn runs(&self, n_units: u32) -> impl Iterator<Item = (Range<u32>, u32)> {
        let starts = (0..n_units).step_by(self.run_units.max(1) as usize);
        starts.zip(&self.cpu_ns).map(move |(first, &cpu_ns)| {
            let end = first.saturating_add(self.run_units).min(n_units);
            (first..end, cpu_ns)
        })
    }
}

/// Samples of some units of a work. Idempotent: all answers to the same work are the same bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chunk<'a> {
    /// Which frame.
    pub frame: FrameId,
    /// Which work.
    pub task_id: TaskId,
    /// The place of the first unit in the work.
    pub first_unit: u32,
    /// How many units follow each other.
    pub n_units: u32,
    /// Their samples, RGB, sRGB-encoded, at most [`CHUNK_BYTES`].
    pub rgb: &'a [u8],
}
