//! Reads results of other ray tracers, to add them to the charts.

use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::plot::{GREY, Mark, Point, Series};

/// One ray tracer. A plot shows it if both of its numbers are known.
#[derive(Clone, Debug, Default, Deserialize, Serialize, PartialEq)]
#[serde(default, deny_unknown_fields)]
pub(super) struct Peer {
    pub(super) name: String,
    pub(super) cpu_ns_per_ray: Option<f64>,
    pub(super) depth_error_p999: Option<f64>,
    pub(super) wrong_per_million: Option<f64>,
    pub(super) bytes_per_triangle: Option<f64>,
    pub(super) build_seconds: Option<f64>,
    pub(super) cpu_ms: Option<f64>,
    pub(super) flip: Option<f64>,
    pub(super) psnr: Option<f64>,
    pub(super) light_rmse: Option<f64>,
    /// Samples a pixel, with which `light_rmse` was measured; may be empty.
    pub(super) samples: Option<u32>,
}

/// The points of all ray tracers that have both numbers; `point` takes x and y from one of them, in decades.
pub(super) fn series(peers: &[Peer], point: impl Fn(&Peer) -> Option<(f64, f64)>) -> impl Iterator<Item = Series> {
    peers.iter().filter_map(move |peer| {
        let (x, y) = point(peer)?;
        Some(Series::single(&peer.name, GREY, Mark::Circle, Point::new(x, y)))
    })
}

/// Larger files are not points; bytes.
const LONGEST_FILE: u64 = 1 << 20;

/// Reads CSV whose first line names the columns; all but `name` may be missing or empty.
pub(super) fn read(path: &Path) -> Result<Vec<Peer>> {
    let file = path.display();
    let wrong_file =
        || format!("{file}: is not a CSV file of points with columns name, cpu_ns_per_ray, bytes_per_triangle, …");
    let text = channel::files::read_text(path, LONGEST_FILE).with_context(|| file.to_string())?;
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(text.as_bytes());
    let mut peers = Vec::new();
    for row in reader.deserialize() {
        let peer: Peer = row.with_context(wrong_file)?;
        // Axes are logarithmic.
        let positive =
            [peer.cpu_ns_per_ray, peer.bytes_per_triangle, peer.build_seconds, peer.cpu_ms, peer.flip, peer.light_rmse];
        let all_positive = positive.into_iter().flatten().all(|x| x.is_finite() && x > 0.0);
        let others = [peer.depth_error_p999, peer.wrong_per_million, peer.psnr];
        let all_usable = others.into_iter().flatten().all(|x| x.is_finite() && x >= 0.0);
        anyhow::ensure!(all_positive && all_usable, "{file}: {} has a number that cannot be drawn", peer.name);
        peers.push(peer);
    }
    Ok(peers)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read_text(text: &str) -> Result<Vec<Peer>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("points.csv");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn unknown_numbers_are_empty() {
        let peers = read_text("name, cpu_ns_per_ray, build_seconds\n\"Embree, robust\", 12.5,\nother,,3\n").unwrap();
        assert_eq!(peers[0], Peer { name: "Embree, robust".to_owned(), cpu_ns_per_ray: Some(12.5), ..Peer::default() });
        assert_eq!(peers[1].build_seconds, Some(3.0));
    }

    #[test]
    fn a_number_that_cannot_be_drawn_is_an_error() {
        for text in [
            "name,speed\na,1\n",
            "name,cpu_ns_per_ray\na,fast\n",
            "name,flip\na,0\n",
            "name,psnr\na,NaN\n",
            "\u{0}\n\n\"a",
        ] {
            let error = format!("{:#}", read_text(text).map(|peers| peers.len()).unwrap_err());
            assert!(error.contains("points.csv"), "{error}");
        }
    }
}
