//! The measurements of a run: the printed table, and the file of `--stats`.

use std::{collections::BTreeSet, path::Path};

use anyhow::Context;
use channel::files;
use serde::Serialize;
use shared::printable::counted;

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
    samples_blake3: String,
    /// Primary rays averaged for each sample.
    samples: u32,
    #[serde(flatten)]
    farm: FrameStats,
    display: DisplayStats,
    /// From the end of the frame before to the end of this one.
    frame_ms: f64,
}

impl Report {
    /// Adds a frame that was shown.
    pub fn add(&mut self, frame: &Frame, display: DisplayStats, frame_ms: f64) {
        let samples = bytemuck::cast_slice::<u32, [u8; 4]>(&frame.rgba);
        let rgb: Vec<u8> = samples.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect();
        self.frames.push(ShownFrame {
            samples_blake3: renderer::render::image::hash_samples(&rgb),
            samples: frame.spec.samples.count,
            farm: frame.stats.clone(),
            display,
            frame_ms,
        });
    }

    /// The number of frames shown.
    pub fn n_frames(&self) -> usize {
        self.frames.len()
    }

    /// Writes all of it as JSON.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let text = serde_json::to_string_pretty(self).context("the report is plain numbers")?;
        files::write(path, |out| out.write_all(text.as_bytes()))
            .with_context(|| format!("cannot write --stats {}", path.display()))
    }

    /// Medians and 95th percentiles as text.
    pub fn table(&self) -> String {
        let mut table = format!("{:<28}{:>10}{:>10}\n", counted(self.frames.len(), "frame"), "median ms", "p95 ms");
        let Some(last) = self.frames.last() else { return table };
        let mut row = |name: &str, values: Vec<f64>| {
            let (median, p95) = (quantile(&values, 0.5), quantile(&values, 0.95));
            table += &format!("{name:<28}{median:>10.2}{p95:>10.2}\n");
        };
        let of_frames = |value: fn(&ShownFrame) -> f64| self.frames.iter().map(value).collect::<Vec<_>>();
        row("render", of_frames(|frame| frame.farm.render_ms));
        row("busiest node over mean (no ms)", of_frames(|frame| frame.farm.imbalance));
        row("place (all threads)", of_frames(|frame| frame.farm.place_ms));
        row("upload", of_frames(|frame| frame.display.upload_ms));
        row("draw", of_frames(|frame| frame.display.draw_ms));
        if self.frames.iter().any(|frame| frame.display.present_ms > 0.0) {
            row("present", of_frames(|frame| frame.display.present_ms));
        }
        row("whole frame", of_frames(|frame| frame.frame_ms));
        let all_nodes = self.frames.iter().flat_map(|frame| &frame.farm.nodes);
        let nodes: BTreeSet<_> = all_nodes.map(|node| (node.id, node.name.as_str())).collect();
        for &(id, name) in &nodes {
            let of_node = |value: fn(&NodeFrameStats) -> f64| self.frames_of(id).map(value).collect();
            row(&format!("{name}: trace"), of_node(|node| node.trace_ms));
            row(&format!("{name}: network"), of_node(|node| node.network_ms));
            row(&format!("{name}: idle"), of_node(|node| node.idle_ms));
        }
        for (id, name) in nodes {
            table += &self.node_line(id, name);
        }
        let bytes_in = quantile(&of_frames(|frame| frame.farm.bytes_in as f64), 0.5);
        let bytes_out = quantile(&of_frames(|frame| frame.farm.bytes_out as f64), 0.5);
        table += &format!("render servers lost: {}, frames healed: {}\n", last.farm.n_lost, last.farm.n_healed);
        table + &format!("bytes a frame: {bytes_in:.0} in, {bytes_out:.0} out\n")
    }

    /// A render server's address and its totals.
    fn node_line(&self, id: NodeId, name: &str) -> String {
        let median = |value: fn(&NodeFrameStats) -> f64| {
            let values: Vec<_> = self.frames_of(id).map(value).collect();
            quantile(&values, 0.5)
        };
        let (share, mbit_per_s) = (100.0 * median(|node| node.share), median(|node| node.mbit_per_s));
        let n_taken_over: u32 = self.frames_of(id).map(|node| node.taken_over).sum();
        let last = self.frames_of(id).filter_map(|node| Some((node, node.address?))).last();
        let known = last.map_or_else(String::new, |(node, address)| {
            let ping = node.round_trip_ms.map(|ms| format!(", ping {ms:.2} ms")).unwrap_or_default();
            format!(" at {address}: {}{ping}, lost {} before", node.encoding, counted(node.n_failures, "time"))
        });
        format!(
            "{name}{known}; share {share:.0} %, {mbit_per_s:.0} Mbit/s, {} of others\n",
            counted(n_taken_over, "task")
        )
    }

    /// A render server's measurements in the frames that it took part in.
    fn frames_of(&self, id: NodeId) -> impl Iterator<Item = &NodeFrameStats> {
        self.frames.iter().flat_map(|frame| &frame.farm.nodes).filter(move |node| node.id == id)
    }
}

/// The quantile at `fraction`, by nearest rank.
fn quantile(values: &[f64], fraction: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * fraction).round() as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn new_measurements_replace_the_old_ones_only_when_they_are_complete() {
        let folder = std::env::temp_dir().join(format!("raywall-stats-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let [stats, kept] = ["stats.json", "kept.json"].map(|name| folder.join(name));
        std::fs::write(&stats, "old").unwrap();
        std::fs::hard_link(&stats, &kept).unwrap();
        Report::default().write(&stats).unwrap();
        assert_eq!(std::fs::read(&kept).unwrap(), b"old", "the old file itself was written");
        assert!(std::fs::read_to_string(&stats).unwrap().contains("frames"));
        std::fs::remove_dir_all(folder).unwrap();
    }
}
