//! Predicts a cluster of one-core machines: this machine traces the tasks one by one, and a simulation replays them through
//! the wall's scheduler and a model of the link.

use std::time::Duration;

use compositor::farm::stats::NodeFrameStats;
use glam::DVec3;
use shared::{
    camera::UpAxis,
    division::{Division, FrameSize},
    protocol::FrameSpec,
};
use strum::VariantArray;

use super::{
    replay::{ReplayedFrame, SimulatedCluster, SimulatedLink, period, replay},
    results::{Check, MeasuredRow, PredictedRow},
    shares::ShareTracer,
};
use crate::statistics::{mean, milliseconds, quantiles};

/// Frames that do not count: the dynamic division balances.
const N_FIRST: usize = 4;

/// Radians that the camera orbits the model from frame to frame: one degree, at 60 frames a second one orbit in six
/// seconds.
const YAW_PER_FRAME: f64 = std::f64::consts::PI / 180.0;

/// One-way latency through a switch of an idle network.
const LATENCY: Duration = Duration::from_micros(100);

/// The paper's link, as its authors measured it, and a fast one; Mbit/s.
const LINKS_MBIT_PER_S: [f64; 2] = [680.0, 10_000.0];

const SLOW: f64 = 3.0;

/// One prediction: frames of one size, with one division among some nodes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scenario {
    pub(super) size: FrameSize,
    pub(super) is_moving: bool,
    pub(super) division: Division,
    pub(super) n_nodes: u32,
    pub(super) n_slow: u32,
}

/// All predictions for frames of one size. The cluster of one node comes before those that are compared with it.
pub(super) fn scenarios(size: FrameSize, node_counts: &[u32]) -> Vec<Scenario> {
    let mut scenarios = Vec::new();
    for is_moving in [false, true] {
        // The static divisions see neither costs nor motion: one camera tells all about them.
        let divisions = if is_moving { &[Division::Dynamic][..] } else { Division::VARIANTS };
        for &division in divisions {
            let counts = [1].iter().chain(node_counts.iter().filter(|&&n_nodes| n_nodes > 1));
            scenarios.extend(counts.map(|&n_nodes| Scenario { size, is_moving, division, n_nodes, n_slow: 0 }));
            if division == Division::Dynamic && node_counts.contains(&12) {
                scenarios.push(Scenario { size, is_moving, division, n_nodes: 12, n_slow: 1 });
            }
        }
    }
    scenarios
}

/// One node's times for a frame: from one to the next, and of CPU.
#[derive(Clone, Copy, Debug)]
pub(super) struct Alone {
    pub(super) frame_ms: f64,
    pub(super) compute_ms: f64,
}

/// The frames of a camera that orbits the model.
#[derive(Clone, Copy, Debug)]
pub(super) struct Path {
    pub(super) spec: FrameSpec,
    /// The centre of the orbit, in world space.
    pub(super) centre: DVec3,
    pub(super) in_flight: u32,
}

impl Path {
    fn spec(&self, scenario: &Scenario, n_shown: usize) -> FrameSpec {
        let yaw = if scenario.is_moving { n_shown as f64 * YAW_PER_FRAME } else { 0.0 };
        let camera = self.spec.camera.orbit(self.centre, UpAxis::Y, yaw, 0.0);
        FrameSpec { camera, size: scenario.size, ..self.spec }
    }
}

/// Predicts one scenario for each link; `None` when `is_stopped`. `alone` gives the times of one node for a frame of this
/// scenario behind a link, given in Mbit/s.
pub(super) fn predict(
    scenario: &Scenario,
    path: &Path,
    n_frames: usize,
    tracer: &mut ShareTracer<'_>,
    alone: impl Fn(f64) -> Option<Alone>,
    is_stopped: impl Fn() -> bool,
) -> Option<Vec<PredictedRow>> {
    let slowness: Vec<f64> =
        (0..scenario.n_nodes).map(|node| if node < scenario.n_slow { SLOW } else { 1.0 }).collect();
    let speed: f64 = slowness.iter().map(|slowness| 1.0 / slowness).sum();
    // One node repeats the same frame of a still camera.
    let n_frames = if scenario.n_nodes == 1 && !scenario.is_moving { 1 } else { n_frames };
    LINKS_MBIT_PER_S
        .into_iter()
        .map(|mbit_per_s| {
            let link = SimulatedLink { bits_per_second: mbit_per_s * 1e6, latency: LATENCY };
            let cluster = SimulatedCluster {
                slowness: slowness.clone(),
                link,
                division: scenario.division,
                in_flight: path.in_flight,
            };
            let trace = |tasks: &[_]| tracer.trace(tasks, &is_stopped);
            let frames = replay(&cluster, N_FIRST + n_frames, |n_shown| path.spec(scenario, n_shown), trace);
            let counted = frames.get(N_FIRST..N_FIRST + n_frames)?;
            let frame_ms = milliseconds(period(&frames, N_FIRST)?);
            let mean_of = |value: &dyn Fn(&ReplayedFrame) -> f64| mean(counted.iter().map(value));
            let compute_ms = mean_of(&|frame| {
                let cpu_ms = |node: &NodeFrameStats| node.trace_cpu_ms / slowness[node.id.0 as usize];
                frame.stats.nodes.iter().map(cpu_ms).sum::<f64>() / speed
            });
            let bytes_in = mean_of(&|frame| frame.stats.bytes_in as f64);
            let link_ms = milliseconds(link.time_for(bytes_in as u64));
            let imbalances = counted.iter().map(|frame| frame.stats.imbalance);
            let [imbalance_median, imbalance_p95] = quantiles(imbalances, [0.5, 0.95]);
            let alone = if scenario.n_nodes == 1 { Alone { frame_ms, compute_ms } } else { alone(mbit_per_s)? };
            Some(PredictedRow {
                division: scenario.division,
                n_nodes: scenario.n_nodes,
                n_slow: scenario.n_slow,
                size: scenario.size.to_string(),
                is_moving: scenario.is_moving,
                mbit_per_s,
                n_frames,
                frame_ms,
                compute_ms,
                link_ms,
                binds: if compute_ms >= link_ms { "compute" } else { "link" },
                over_bound: frame_ms / compute_ms.max(link_ms),
                efficiency: alone.frame_ms / (frame_ms * speed),
                cpu_over_alone: compute_ms * speed / alone.compute_ms,
                imbalance_median,
                imbalance_p95,
                bytes_in,
            })
        })
        .collect()
}

/// Predicts a measurement on this machine without display, where the link is the loopback.
pub(super) fn check(
    measured: &MeasuredRow,
    path: &Path,
    tracer: &mut ShareTracer<'_>,
    is_stopped: impl Fn() -> bool,
) -> Option<Check> {
    let division = measured.division?;
    let link = SimulatedLink { bits_per_second: f64::INFINITY, latency: Duration::from_micros(50) };
    let cluster =
        SimulatedCluster { slowness: vec![1.0; measured.n_nodes as usize], link, division, in_flight: path.in_flight };
    let trace = |tasks: &[_]| tracer.trace(tasks, &is_stopped);
    let frames = replay(&cluster, N_FIRST + 4, |_| path.spec, trace);
    let predicted_ms = milliseconds(period(&frames, N_FIRST)?);
    let measured_ms = measured.frame_ms_median;
    Some(Check {
        division,
        n_nodes: measured.n_nodes,
        measured_ms,
        measured_busy_ms: measured.busiest_ms_median,
        predicted_ms,
        predicted_over_measured: predicted_ms / measured_ms,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_node_comes_before_those_that_are_compared_with_it() {
        let scenarios = scenarios(FrameSize::PAPER, &[12, 64]);
        for (index, scenario) in scenarios.iter().enumerate() {
            let alone = |other: &Scenario| {
                (other.division, other.is_moving, other.n_nodes) == (scenario.division, scenario.is_moving, 1)
            };
            assert!(scenarios[..=index].iter().any(alone), "{scenario:?}");
        }
        assert_eq!(scenarios.iter().filter(|scenario| scenario.n_slow == 1).count(), 2);
    }
}
