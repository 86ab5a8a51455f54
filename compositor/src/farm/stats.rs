//! Measurements of the farm and of each frame, for the overlay and for `--stats`.

use std::{net::SocketAddr, sync::Arc};

use serde::Serialize;
use shared::{
    division::{Division, FrameSize, Task},
    marks::SurfaceWay,
    protocol::{Encoding, ProbeHit, RunCosts, SceneState, Transfer},
};

use super::notices::Notices;

/// The number of a render server: from 1, in the order of connecting; a wall uses none twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub struct NodeId(pub u32);

/// A render server as the overlay shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeStatus {
    /// Its number.
    pub id: NodeId,
    /// The name that it gave.
    pub name: String,
    /// Where it connected from.
    pub address: SocketAddr,
    /// Its tracing threads.
    pub threads: u32,
    /// Its progress with the wall's scene; `None` until it reports any.
    pub scene: Option<SceneState>,
    /// Whether nothing has arrived from it for a moment: others have its tasks until it is heard again.
    pub is_silent: bool,
    /// How often a render server of this name on this machine was lost since the wall started.
    pub n_failures: u32,
    /// The last round trip of a ping, in milliseconds.
    pub round_trip_ms: Option<f64>,
}

impl NodeStatus {
    /// The progress of its transfer, if it fetches the scene file.
    pub fn transfer(&self) -> Option<NodeTransfer> {
        let Some(SceneState::Fetching(transfer)) = self.scene else { return None };
        Some(NodeTransfer { name: self.name.clone(), transfer, seconds_left: transfer.seconds_left() })
    }

    /// Whether it is given tasks.
    pub fn is_ready(&self) -> bool {
        !self.is_silent && matches!(self.scene, Some(SceneState::Ready { .. }))
    }
}

/// The farm between frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FarmStatus {
    /// Every connected render server, in the order of joining.
    pub nodes: Vec<NodeStatus>,
    /// Render servers lost since the wall started.
    pub n_lost: u32,
    /// Frames completed although a render server was lost, or has not answered: others did its work.
    pub n_healed: u32,
    /// Render servers that do not render, each with the cure.
    pub notices: Notices,
    /// The last answer to a probe.
    pub probed: Option<Probed>,
    /// The last answer to a look.
    pub seen: Option<Seen>,
    /// The last answer about a way along the surface.
    pub way: Option<FoundWay>,
    /// How much of the frame in flight has arrived, in percent, if it takes long.
    pub percent: Option<u8>,
}

/// A render server's answer to a probe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probed {
    /// The probe's number.
    pub number: u32,
    /// The visible triangle, if there is one.
    pub hit: Option<ProbeHit>,
}

/// A render server's answer to a look.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// The look's number.
    pub number: u32,
    /// Whether each point is seen; a render server that lies may say it of fewer or more points.
    pub seen: Arc<[bool]>,
}

/// A render server's answer about a way along the surface.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundWay {
    /// The question's number.
    pub number: u32,
    /// The way, if one leads there; a render server that lies may say any.
    pub way: Option<SurfaceWay>,
}

/// How one render server spent its time in one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NodeFrameStats {
    /// Its number.
    pub id: NodeId,
    /// Its name.
    pub name: String,
    /// Where it connected from; `None` in simulations.
    pub address: Option<SocketAddr>,
    /// How often a render server of this name on this machine had been lost until then.
    pub n_failures: u32,
    /// The last round trip of a ping until then, in milliseconds.
    pub round_trip_ms: Option<f64>,
    /// The fraction of the frame's units that it was given, 0 to 1.
    pub share: f64,
    /// From its first ray to its last sample.
    pub trace_ms: f64,
    /// CPU time of all its tracing threads.
    pub trace_cpu_ms: f64,
    /// CPU time of its tracing threads, averaged: its load, unaffected by other programs on its machine.
    pub busy_ms: f64,
    /// From sending its task to receiving its last sample, less tracing: the network both ways, and waiting in queues.
    pub network_ms: f64,
    /// From receiving its last sample to the end of the frame.
    pub idle_ms: f64,
    /// Tasks of lost or late render servers that it was given in addition.
    pub taken_over: u32,
    /// How its samples travelled.
    pub encoding: Encoding,
    /// Rate of its samples while it had a task, in megabits a second; 0 if others were faster.
    pub mbit_per_s: f64,
    /// Bytes of samples and their headers.
    pub bytes_in: u64,
    /// Bytes of requests.
    pub bytes_out: u64,
}

impl NodeFrameStats {
    /// Adds the same render server's measurements for another task of the frame.
    pub(super) fn add(&mut self, other: &Self) {
        self.share += other.share;
        self.trace_ms += other.trace_ms;
        self.trace_cpu_ms += other.trace_cpu_ms;
        self.busy_ms += other.busy_ms;
        self.network_ms += other.network_ms;
        self.idle_ms = self.idle_ms.min(other.idle_ms);
        self.taken_over += other.taken_over;
        self.mbit_per_s = self.mbit_per_s.max(other.mbit_per_s);
        self.bytes_in += other.bytes_in;
        self.bytes_out += other.bytes_out;
    }
}

/// A render server that fetches the scene file.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NodeTransfer {
    /// Its name.
    pub name: String,
    /// How much it has, at which rate.
    #[serde(flatten)]
    pub transfer: Transfer,
    /// Until it has all; `None` if the rate is not known yet.
    pub seconds_left: Option<u64>,
}

/// How a frame was rendered.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameStats {
    /// Its number.
    pub frame: u64,
    /// Its resolution.
    #[serde(serialize_with = "serialize_size")]
    pub size: FrameSize,
    /// How it was divided.
    pub division: Division,
    /// From the first request to the last placed sample.
    pub render_ms: f64,
    /// The same, but counted from the completion of the previous frame if that was later than the first request: the time
    /// a frame takes of a sequence.
    pub interval_ms: f64,
    /// Time spent placing samples, summed over the receiving threads.
    pub place_ms: f64,
    /// The busiest render server's busy time over the mean: 1 is a perfect division.
    pub imbalance: f64,
    /// 1, and one more each time a task was given out again.
    pub attempts: u32,
    /// Whether render servers did the work of one that was lost, or that has not answered until then.
    pub is_healed: bool,
    /// Render servers lost until then.
    pub n_lost: u32,
    /// Frames completed until then for which others did the work of a render server, this one included.
    pub n_healed: u32,
    /// Bytes received.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// Each render server that took part.
    pub nodes: Vec<NodeFrameStats>,
    /// Render servers that were fetching the scene file then.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub fetching: Vec<NodeTransfer>,
    /// The finished tasks.
    #[serde(skip)]
    pub tasks: Arc<[FrameTask]>,
}

/// A finished task of a frame, and its cost.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTask {
    /// The render server.
    pub node: NodeId,
    /// Its units.
    pub task: Task,
    /// CPU time of all tracing threads, in nanoseconds.
    pub trace_cpu_ns: u64,
    /// CPU time by runs of tiles, if measured.
    pub costs: RunCosts,
}

/// The largest of some times over their mean: at least 1, and 1 if there are none.
pub(super) fn max_over_mean(times: impl Iterator<Item = f64> + Clone) -> f64 {
    let (sum, count) = (times.clone().sum::<f64>(), times.clone().count());
    // Rounding can lift the mean of equal times above all of them.
    if sum > 0.0 { (times.fold(0.0, f64::max) * count as f64 / sum).max(1.0) } else { 1.0 }
}

fn serialize_size<S: serde::Serializer>(size: &FrameSize, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(size)
}

/// How long it took to show a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DisplayStats {
    /// Uploading the samples to the GPU.
    pub upload_ms: f64,
    /// Drawing them over the wall.
    pub draw_ms: f64,
    /// Presenting to the screen; 0 without one.
    pub present_ms: f64,
    /// From the camera's motion to the picture that shows it.
    pub latency_ms: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_times_are_in_balance_however_their_sum_is_rounded() {
        for n in 0..300 {
            let imbalance = max_over_mean(std::iter::repeat_n(0.017, n));
            assert!((1.0..1.0 + 1e-12).contains(&imbalance), "{n} times: {imbalance}");
        }
        assert_eq!(max_over_mean([1.0, 2.0, 3.0].into_iter()), 1.5);
        assert_eq!(max_over_mean([0.0, 0.0].into_iter()), 1.0);
    }
}
