//! What is measured about the farm and about each frame: for the overlay, and for `--stats`.

use std::{net::SocketAddr, sync::Arc};

use serde::Serialize;
use shared::{
    division::{Division, FrameSize, Task},
    protocol::{Encoding, ProbeHit, RunCosts, SceneState},
};

/// The number of a render server: counts up from 1 in the order of joining while a wall runs, never used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub struct NodeId(pub u32);

/// A render server as the overlay shows it.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeStatus {
    /// Its number.
    pub id: NodeId,
    /// Its name, as it gave it.
    pub name: String,
    /// Where it connected from.
    pub address: SocketAddr,
    /// Threads that it traces with.
    pub threads: u32,
    /// How far it is with the wall's scene; `None` until it has said anything about it.
    pub scene: Option<SceneState>,
    /// Whether nothing has come from it for a moment: others have its work until it is heard again.
    pub is_silent: bool,
    /// How often a render server of this name, on this machine, was lost since the wall started.
    pub n_failures: u32,
    /// The last round trip of a ping, in milliseconds.
    pub round_trip_ms: Option<f64>,
}

impl NodeStatus {
    /// Whether it is given frames of the wall's scene to render.
    pub fn is_ready(&self) -> bool {
        !self.is_silent && matches!(self.scene, Some(SceneState::Ready { .. }))
    }
}

/// The farm between frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FarmStatus {
    /// Every connected render server, in the order of joining.
    pub nodes: Vec<NodeStatus>,
    /// How many render servers were lost since the wall started.
    pub n_lost: u32,
    /// How many frames became whole although a render server was lost or late.
    pub n_healed: u32,
    /// What happened last that an operator should know, with its cure.
    pub message: Option<String>,
    /// The last answer to a question about the model.
    pub probed: Option<Probed>,
}

/// What a render server says is seen at a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Probed {
    /// The question's number.
    pub number: u32,
    /// The triangle, if there is any.
    pub hit: Option<ProbeHit>,
}

/// Where one render server's time in one frame went.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NodeFrameStats {
    /// Its number.
    pub id: NodeId,
    /// Its name.
    pub name: String,
    /// Where it connected from; `None` where nothing is connected, as in predictions.
    pub address: Option<SocketAddr>,
    /// How often a render server of this name, on its machine, had been lost until then.
    pub n_failures: u32,
    /// The last round trip of a ping until then, in milliseconds.
    pub round_trip_ms: Option<f64>,
    /// How much of the frame's units it was given, 0 to 1.
    pub share: f64,
    /// From its first ray to its last sample.
    pub trace_ms: f64,
    /// CPU time of all its tracing threads.
    pub trace_cpu_ms: f64,
    /// CPU time of each of its tracing threads on average: how busy it was, whatever else its machine had to do.
    pub busy_ms: f64,
    /// From sending its work to having its last sample, less tracing: both ways over the network and waiting in queues.
    pub network_ms: f64,
    /// From having its last sample to the end of the frame.
    pub idle_ms: f64,
    /// Works of others that it was given as well, because those were lost or late.
    pub taken_over: u32,
    /// How its samples travelled.
    pub encoding: Encoding,
    /// How fast they came while it had work, in megabits a second; 0 if others were faster.
    pub mbit_per_s: f64,
    /// Samples and their headers.
    pub bytes_in: u64,
    /// Requests.
    pub bytes_out: u64,
}

impl NodeFrameStats {
    /// Adds what the same render server did for another piece of work of the frame.
    pub(crate) fn add(&mut self, other: &Self) {
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

/// How a frame came about in the farm.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameStats {
    /// Its number.
    pub frame: u64,
    /// Its resolution.
    #[serde(serialize_with = "serialize_size")]
    pub size: FrameSize,
    /// How it was divided.
    pub division: Division,
    /// From the first request to the last sample in its place.
    pub render_ms: f64,
    /// The same from when the frame before it was whole, if it was begun earlier: what one takes of many that follow each
    /// other.
    pub interval_ms: f64,
    /// Time spent placing samples, summed over the receiving threads.
    pub place_ms: f64,
    /// The busy time of the busiest render server over the mean of all: 1 is a perfect division.
    pub imbalance: f64,
    /// 1, and one more each time work was given out again.
    pub attempts: u32,
    /// How many render servers had been lost until then.
    pub n_lost: u32,
    /// How many frames had become whole although a render server was lost or late, this one included.
    pub n_healed: u32,
    /// Bytes received.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// Each render server that took part.
    pub nodes: Vec<NodeFrameStats>,
    /// The works that were answered: together, who rendered what.
    #[serde(skip)]
    pub tasks: Arc<[FrameTask]>,
}

/// A work of a frame, who did it, and what it cost.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTask {
    /// Who.
    pub node: NodeId,
    /// Which units.
    pub task: Task,
    /// CPU time of all tracing threads, in nanoseconds.
    pub trace_cpu_ns: u64,
    /// Where in the work that went, if it was measured.
    pub costs: RunCosts,
}

/// The largest of some times over their mean: at least 1, and 1 when there are none.
pub(crate) fn max_over_mean(times: impl Iterator<Item = f64> + Clone) -> f64 {
    let (sum, count) = (times.clone().sum::<f64>(), times.clone().count());
    // The sum of equal times can be rounded up, so that their mean is above them all.
    if sum > 0.0 { (times.fold(0.0, f64::max) * count as f64 / sum).max(1.0) } else { 1.0 }
}

fn serialize_size<S: serde::Serializer>(size: &FrameSize, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(size)
}

/// Where the time of showing a frame went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DisplayStats {
    /// Handing the samples to the GPU.
    pub upload_ms: f64,
    /// Scaling them over the wall.
    pub draw_ms: f64,
    /// Handing the picture to the screen; 0 without one.
    pub present_ms: f64,
    /// From the camera's motion to its picture.
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
