//! What a run of the experiment found, as files: JSON with all of it, and CSV for each kind of figure.

use std::{fs, path::Path};

use anyhow::Context;
use serde::Serialize;
use shared::division::Division;

/// All of it.
#[derive(Debug, Default, Serialize)]
pub(super) struct Results {
    /// What was shown.
    pub(super) model: String,
    /// From where; `None` for a camera that sees all.
    pub(super) camera: Option<String>,
    /// Cores of the machine that measured: more render servers than these share them.
    pub(super) n_cores: usize,
    /// Real programs and sockets on this machine.
    pub(super) measured: Vec<MeasuredRow>,
    /// What a cluster of one-core machines like this one would do: a prediction.
    pub(super) predicted: Vec<PredictedRow>,
    /// Predictions of what was also measured.
    pub(super) checks: Vec<Check>,
}

/// Frames of one division by one number of render servers. Times are in milliseconds.
#[derive(Clone, Debug, Serialize)]
pub(super) struct MeasuredRow {
    /// `None` for the display alone.
    pub(super) division: Option<Division>,
    pub(super) n_nodes: u32,
    pub(super) size: String,
    pub(super) n_frames: usize,
    /// From one shown frame to the next.
    pub(super) frame_ms_median: f64,
    pub(super) frame_ms_p95: f64,
    /// From the first request to the last sample.
    pub(super) render_ms_median: f64,
    /// Handing the samples to the GPU and scaling them over the wall.
    pub(super) display_ms_median: f64,
    /// CPU time of the busiest node.
    pub(super) busiest_ms_median: f64,
    pub(super) bytes_in: f64,
    pub(super) bytes_out: f64,
    /// CPU time of the busiest node over the mean.
    pub(super) imbalance_median: f64,
}

/// Frames that a cluster would render. Times are in milliseconds.
#[derive(Clone, Debug, Serialize)]
pub(super) struct PredictedRow {
    pub(super) division: Division,
    pub(super) n_nodes: u32,
    /// How many of them have a third of the others' speed.
    pub(super) n_slow: u32,
    pub(super) size: String,
    /// Whether the camera goes around the model.
    pub(super) is_moving: bool,
    /// Of the link into the wall.
    pub(super) mbit_per_s: f64,
    pub(super) n_frames: usize,
    /// From one whole frame to the next.
    pub(super) frame_ms: f64,
    /// CPU time of all shares over the speed of all nodes.
    pub(super) compute_ms: f64,
    /// How long the samples occupy the link.
    pub(super) link_ms: f64,
    /// The longer of the two: `compute` or `link`.
    pub(super) binds: &'static str,
    /// `frame_ms` over the longer of the two: 1 is the best that can be.
    pub(super) over_bound: f64,
    /// The speed-up over one node, behind the same link, by the number of nodes.
    pub(super) efficiency: f64,
    /// CPU time of the busiest node over the mean.
    pub(super) imbalance_median: f64,
    pub(super) imbalance_p95: f64,
    pub(super) bytes_in: f64,
}

/// A prediction of this machine, and what it did: without display, each node on one core of its own.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Check {
    pub(super) division: Division,
    pub(super) n_nodes: u32,
    pub(super) measured_ms: f64,
    /// CPU time of the busiest node, measured.
    pub(super) measured_busy_ms: f64,
    pub(super) predicted_ms: f64,
    pub(super) predicted_over_measured: f64,
}

impl Results {
    /// Writes all files of figures into a folder.
    pub(super) fn write(&self, folder: &Path) -> anyhow::Result<()> {
        let json = serde_json::to_string_pretty(self).context("figures are plain numbers")?;
        let files = [
            ("bench.json", json),
            ("measured.csv", csv(&self.measured)?),
            ("predicted.csv", csv(&self.predicted)?),
            ("checks.csv", csv(&self.checks)?),
        ];
        for (name, text) in files {
            let path = folder.join(name);
            fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }
}

/// One line for each row, after one with the names of its fields.
fn csv<T: Serialize>(rows: &[T]) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(String::from_utf8(writer.into_inner()?)?)
}

/// The value below which a part of the values lies, by the nearest rank; 0 of none.
pub(super) fn quantile(values: impl Iterator<Item = f64>, part: f64) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().saturating_sub(1);
    sorted.get((last as f64 * part).round() as usize).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_become_lines_under_their_names() {
        let check = Check {
            division: Division::Tiled,
            n_nodes: 2,
            measured_ms: 1.5,
            measured_busy_ms: 1.25,
            predicted_ms: 3.0,
            predicted_over_measured: 2.0,
        };
        let text = csv(&[check]).unwrap();
        let names = "division,n_nodes,measured_ms,measured_busy_ms,predicted_ms,predicted_over_measured";
        assert_eq!(text, format!("{names}\ntiled,2,1.5,1.25,3.0,2.0\n"));
        assert_eq!(csv::<Check>(&[]).unwrap(), "");
    }

    #[test]
    fn quantiles_are_values_of_the_nearest_rank() {
        let values = || [3.0, 1.0, 2.0].into_iter();
        assert_eq!([0.0, 0.5, 0.95].map(|part| quantile(values(), part)), [1.0, 2.0, 3.0]);
        assert_eq!(quantile(std::iter::empty(), 0.5), 0.0);
    }
}
