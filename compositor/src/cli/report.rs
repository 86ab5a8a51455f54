//! The measurements of a run: the printed table, and the file of `--stats`.

use std::{fmt::Write, path::Path};

use anyhow::Context;
use serde::Serialize;

use crate::farm::{
    Frame,
    stats::{DisplayStats, FrameStats, NodeFrameStats, NodeId},
};

/// Every shown frame of a run.
#[derive(Debug, Default, Serialize)]
pub struct Report {
    frames: Vec<ShownFrame>,
}

/// A frame that was shown, with all measurements of the overlay.
#[derive(Debug, Serialize)]
struct ShownFrame {
    /// BLAKE3 of the samples, RGB, row by row from the bottom: equal hashes mean equal frames.
    samples_blake3: Option<String>,
    /// Primary rays averaged for each sample.
    samples: Option<u32>,
    /// `None` for a frame without samples.
    #[serde(flatten)]
    farm: Option<FrameStats>,
    display: DisplayStats,
    /// From the end of the frame before to the end of this one.
    frame_ms: f64,
}

impl Report {
    /// Adds a frame that was shown.
    pub fn add(&mut self, frame: Option<&Frame>, display: DisplayStats, frame_ms: f64) {
        let samples_blake3 = frame.map(|frame| hash_samples(&frame.rgba));
        let farm = frame.map(|frame| frame.stats.clone());
        let samples = frame.map(|frame| frame.spec.samples.count);
        self.frames.push(ShownFrame { samples_blake3, samples, farm, display, frame_ms });
    }

    /// The number of frames shown.
    pub fn n_frames(&self) -> usize {
        self.frames.len()
    }

    /// Writes all of it as JSON.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let text = serde_json::to_string_pretty(self).context("the report is plain numbers")?;
        std::fs::write(path, text).with_context(|| format!("cannot write --stats {}", path.display()))
    }

    /// Medians and 95th percentiles as text.
    pub fn table(&self) -> String {
        let mut table = format!("{} frames{:>30}{:>10}\n", self.frames.len(), "median ms", "p95 ms");
        let mut row = |name: &str, values: Vec<f64>| {
            if !values.is_empty() {
                let (median, p95) = (quantile(&values, 0.5), quantile(&values, 0.95));
                // Writing to a string cannot fail.
                let _ = writeln!(table, "{name:<28}{median:>10.2}{p95:>10.2}");
            }
        };
        let farm = |value: fn(&FrameStats) -> f64| {
            self.frames.iter().filter_map(|frame| frame.farm.as_ref()).map(value).collect::<Vec<_>>()
        };
        let display = |value: fn(&DisplayStats) -> f64| self.frames.iter().map(|frame| value(&frame.display)).collect();
        row("render", farm(|stats| stats.render_ms));
        row("busiest node over mean (no ms)", farm(|stats| stats.imbalance));
        row("place (all threads)", farm(|stats| stats.place_ms));
        row("upload", display(|stats| stats.upload_ms));
        row("draw", display(|stats| stats.draw_ms));
        if self.frames.iter().any(|frame| frame.display.present_ms > 0.0) {
            row("present", display(|stats| stats.present_ms));
        }
        row("whole frame", self.frames.iter().map(|frame| frame.frame_ms).collect());
        let nodes = self.nodes();
        for (id, name) in &nodes {
            let of_node = |value: fn(&NodeFrameStats) -> f64| self.frames_of(*id).map(value).collect::<Vec<_>>();
            row(&format!("{name}: trace"), of_node(|node| node.trace_ms));
            row(&format!("{name}: network"), of_node(|node| node.network_ms));
            row(&format!("{name}: idle"), of_node(|node| node.idle_ms));
        }
        for (id, name) in &nodes {
            let _ = writeln!(table, "{}", self.node_line(*id, name));
        }
        if let Some(last) = self.frames.iter().filter_map(|frame| frame.farm.as_ref()).next_back() {
            let _ = writeln!(table, "render servers lost: {}, frames healed: {}", last.n_lost, last.n_healed);
        }
        let bytes_in = farm(|stats| stats.bytes_in as f64);
        let bytes_out = farm(|stats| stats.bytes_out as f64);
        if !bytes_in.is_empty() {
            let _ = writeln!(
                table,
                "bytes a frame: {:.0} in, {:.0} out",
                quantile(&bytes_in, 0.5),
                quantile(&bytes_out, 0.5)
            );
        }
        table
    }

    /// A render server's address and its totals.
    fn node_line(&self, id: NodeId, name: &str) -> String {
        let of_node = |value: fn(&NodeFrameStats) -> f64| {
            let values: Vec<_> = self.frames_of(id).map(value).collect();
            quantile(&values, 0.5)
        };
        let n_taken_over: u32 = self.frames_of(id).map(|node| node.taken_over).sum();
        let last = self.frames_of(id).filter(|node| node.address.is_some()).last();
        let known = last.map_or_else(String::new, |node| {
            let address = node.address.map(|address| format!(" at {address}")).unwrap_or_default();
            let ping = node.round_trip_ms.map(|ms| format!(", ping {ms:.2} ms")).unwrap_or_default();
            format!("{address}: {}{ping}, lost {} times before", node.encoding, node.n_failures)
        });
        format!(
            "{name}{known}; share {:.0} %, {:.0} Mbit/s, {n_taken_over} tasks of others",
            100.0 * of_node(|node| node.share),
            of_node(|node| node.mbit_per_s)
        )
    }

    /// A render server's measurements in the frames that it took part in.
    fn frames_of(&self, id: NodeId) -> impl Iterator<Item = &NodeFrameStats> {
        let frames = self.frames.iter().filter_map(|frame| frame.farm.as_ref());
        frames.flat_map(|stats| &stats.nodes).filter(move |node| node.id == id)
    }

    fn nodes(&self) -> Vec<(NodeId, String)> {
        let mut nodes: Vec<_> = self
            .frames
            .iter()
            .filter_map(|frame| frame.farm.as_ref())
            .flat_map(|stats| &stats.nodes)
            .map(|node| (node.id, node.name.clone()))
            .collect();
        nodes.sort();
        nodes.dedup();
        nodes
    }
}

/// BLAKE3 of the samples: RGB, row by row from the bottom.
fn hash_samples(rgba: &[u32]) -> String {
    let rgb: Vec<u8> = rgba
        .iter()
        .flat_map(|sample| {
            let [r, g, b, _] = sample.to_ne_bytes();
            [r, g, b]
        })
        .collect();
    renderer::render::image::hash_samples(&rgb)
}

/// The quantile at `fraction`, by nearest rank.
fn quantile(values: &[f64], fraction: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * fraction).round() as usize]
}
