//! The figures of wall and farm in Prometheus' text format, version 0.0.4.

use std::fmt::Write;

use super::state::WallState;

/// All figures; `n_remotes` are connected.
pub(super) fn text(WallState { farm, .. }: &WallState, n_remotes: usize, n_actions: u64) -> String {
    let mut text = String::new();
    let mut add = |name: &str, kind: &str, help: &str, values: &[(String, f64)]| {
        // Writing to a text cannot fail.
        let _ = writeln!(text, "# HELP raywall_{name} {help}\n# TYPE raywall_{name} {kind}");
        for (labels, value) in values {
            let _ = writeln!(text, "raywall_{name}{labels} {value}");
        }
    };
    let plain = |value: f64| vec![(String::new(), value)];
    add("frames_shown_total", "counter", "Frames shown.", &plain(farm.frames_shown as f64));
    add(
        "frames_per_second",
        "gauge",
        "Frames shown a second; 0 at rest.",
        &plain(farm.frames_per_second.unwrap_or(0.0)),
    );
    let stages = [
        ("render", farm.render_ms),
        ("place", farm.place_ms),
        ("upload", farm.upload_ms),
        ("draw", farm.draw_ms),
        ("latency", farm.latency_ms),
    ];
    let seconds = stages.map(|(stage, ms)| (format!("{{stage=\"{stage}\"}}"), ms / 1e3));
    add("frame_seconds", "gauge", "Times of the newest frame.", &seconds);
    add("imbalance_ratio", "gauge", "The busiest node's time over the mean.", &plain(farm.imbalance));
    let count = |state: &str| farm.nodes.iter().filter(|node| node.state == state).count() as f64;
    let states = ["ready", "loading", "missing", "silent", "joining"];
    let by_state = states.map(|state| (format!("{{state=\"{state}\"}}"), count(state)));
    add("nodes", "gauge", "Connected render servers by state.", &by_state);
    add("nodes_lost_total", "counter", "Render servers lost.", &plain(farm.nodes_lost.into()));
    add(
        "frames_healed_total",
        "counter",
        "Frames completed although a node was lost.",
        &plain(farm.frames_healed.into()),
    );
    let label = |node: &super::state::Node| {
        format!("{{name=\"{}\",address=\"{}\"}}", escaped(&node.name), escaped(&node.address))
    };
    let busy: Vec<_> = farm.nodes.iter().map(|node| (label(node), node.busy_ms / 1e3)).collect();
    add("node_busy_seconds", "gauge", "A node's busy time in the newest frame.", &busy);
    let threads: Vec<_> = farm.nodes.iter().map(|node| (label(node), node.threads.into())).collect();
    add("node_threads", "gauge", "A node's tracing threads.", &threads);
    add("remotes", "gauge", "Connected remotes.", &plain(n_remotes as f64));
    add("remote_actions_total", "counter", "Actions of remotes.", &plain(n_actions as f64));
    text
}

/// A label's value: names are chosen by peers.
fn escaped(value: &str) -> String {
    value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::remote::state::{FarmState, Node};

    #[test]
    fn every_line_is_a_comment_or_a_sample_whatever_nodes_are_called() {
        let names = ["left", "a\"b\\c\nraywall_nodes 7"];
        let node = |name: &str| Node { name: name.to_owned(), state: "ready", busy_ms: 2.0, ..Node::default() };
        let farm = FarmState { nodes: names.map(node).into(), frames_shown: 3, ..FarmState::default() };
        let text = text(&WallState { farm, ..WallState::default() }, 2, 9);
        for line in text.lines() {
            let is_sample = line.strip_prefix("raywall_").and_then(|line| line.rsplit_once(' '));
            assert!(
                line.starts_with("# ") || is_sample.is_some_and(|(_, value)| value.parse::<f64>().is_ok()),
                "{line}"
            );
        }
        assert!(text.contains("\nraywall_nodes{state=\"ready\"} 2\n") && text.contains("raywall_remotes 2\n"));
        assert!(!text.contains("\nraywall_nodes 7"), "a name forges a sample");
        assert!(text.contains("raywall_node_busy_seconds{name=\"left\",address=\"\"} 0.002\n"));
    }
}
