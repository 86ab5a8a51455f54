//! Points of other ray tracers, read from a file to be drawn among ours.

use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

/// One of them, with what is known of it; it is drawn wherever both of a plot's numbers are.
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
}

/// Reads CSV whose first line names the columns; all but `name` may be missing or empty.
pub(super) fn read(path: &Path) -> Result<Vec<Peer>> {
    let told = || {
        format!("{}: is no CSV of points, with columns name, cpu_ns_per_ray, bytes_per_triangle, ...", path.display())
    };
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).with_context(told)?;
    let mut peers = Vec::new();
    for row in reader.deserialize() {
        let peer: Peer = row.with_context(told)?;
        // Logarithms are drawn.
        let positive = [peer.cpu_ns_per_ray, peer.bytes_per_triangle, peer.build_seconds, peer.cpu_ms, peer.flip];
        let all_positive = positive.into_iter().flatten().all(|x| x.is_finite() && x > 0.0);
        let others = [peer.depth_error_p999, peer.wrong_per_million, peer.psnr];
        let all_usable = others.into_iter().flatten().all(|x| x.is_finite() && x >= 0.0);
        anyhow::ensure!(
            all_positive && all_usable,
            "{}: {} has a number that cannot be drawn",
            path.display(),
            peer.name
        );
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
    fn what_is_not_known_is_left_empty() {
        let peers = read_text("name, cpu_ns_per_ray, build_seconds\n\"Embree, robust\", 12.5,\nother,,3\n").unwrap();
        assert_eq!(peers[0], Peer { name: "Embree, robust".to_owned(), cpu_ns_per_ray: Some(12.5), ..Peer::default() });
        assert_eq!(peers[1].build_seconds, Some(3.0));
    }

    #[test]
    fn what_cannot_be_drawn_is_told() {
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
