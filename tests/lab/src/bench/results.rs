//! Results of the experiment, as JSON with all of them and as a CSV file of each kind.

use std::path::Path;

use anyhow::Context;
use serde::Serialize;
use shared::division::Division;

use crate::files;

#[derive(Debug, Default, Serialize)]
pub(super) struct Results {
    pub(super) model: String,
    /// The camera's file; `None` for a camera that sees the whole model.
    pub(super) camera: Option<String>,
    /// Cores of this machine; more render servers than these share them.
    pub(super) n_cores: usize,
    /// Measured on this machine, with real programs and sockets.
    pub(super) measured: Vec<MeasuredRow>,
    /// Predicted for clusters of one-core machines like this one.
    pub(super) predicted: Vec<PredictedRow>,
    /// Predictions beside measurements of the same.
    pub(super) checks: Vec<Check>,
}

/// Frames of one division by one number of render servers. Times are in milliseconds.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct MeasuredRow {
    /// `None` for the display alone.
    pub(super) division: Option<Division>,
    pub(super) n_nodes: u32,
    pub(super) size: String,
    pub(super) n_frames: usize,
    /// From one shown frame to the next.
    pub(super) frame_ms_median: f64,
    pub(super) frame_ms_p95: f64,
    /// From the first task to the last sample.
    pub(super) render_ms_median: f64,
    /// Uploading the samples and drawing the wall.
    pub(super) display_ms_median: f64,
    /// CPU time of the busiest node.
    pub(super) busiest_ms_median: f64,
    pub(super) bytes_in: f64,
    pub(super) bytes_out: f64,
    /// CPU time of the busiest node over the mean.
    pub(super) imbalance_median: f64,
}

/// Predicted frames of a cluster. Times are in milliseconds.
#[derive(Clone, Debug, Serialize)]
pub(super) struct PredictedRow {
    pub(super) division: Division,
    pub(super) n_nodes: u32,
    /// How many nodes have a third of the others' speed.
    pub(super) n_slow: u32,
    pub(super) size: String,
    /// Whether the camera goes around the model.
    pub(super) is_moving: bool,
    /// Rate of the link into the wall.
    pub(super) mbit_per_s: f64,
    pub(super) n_frames: usize,
    /// From one complete frame to the next.
    pub(super) frame_ms: f64,
    /// CPU time of all tasks over the speed of all nodes.
    pub(super) compute_ms: f64,
    /// Time that the samples occupy the link.
    pub(super) link_ms: f64,
    /// The larger of the two: `compute` or `link`.
    pub(super) binds: &'static str,
    /// `frame_ms` over the larger of the two; at best 1.
    pub(super) over_bound: f64,
    /// Speed-up over one node behind the same link, divided by the speed of all nodes; above 1 only if all tasks together
    /// take less CPU time than one node's.
    pub(super) efficiency: f64,
    /// CPU time of all tasks over that of the whole frame on one node: a share has packets of other rays than the frame.
    pub(super) cpu_over_alone: f64,
    /// CPU time of the busiest node over the mean.
    pub(super) imbalance_median: f64,
    pub(super) imbalance_p95: f64,
    pub(super) bytes_in: f64,
}

/// A prediction for this machine beside its measurement, without display and with a core for each node.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Check {
    pub(super) division: Division,
    pub(super) n_nodes: u32,
    pub(super) measured_ms: f64,
    pub(super) measured_busy_ms: f64,
    pub(super) predicted_ms: f64,
    pub(super) predicted_over_measured: f64,
}

impl Results {
    pub(super) fn write(&self, folder: &Path) -> anyhow::Result<()> {
        let json = serde_json::to_string_pretty(self).context("results are plain numbers")?;
        let files = [
            ("bench.json", json),
            ("measured.csv", files::csv(&self.measured)?),
            ("predicted.csv", files::csv(&self.predicted)?),
            ("checks.csv", files::csv(&self.checks)?),
        ];
        files.into_iter().try_for_each(|(name, text)| files::write(folder, name, text.as_bytes()))
    }
}
