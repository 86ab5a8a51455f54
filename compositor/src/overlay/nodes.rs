//! One row for each render server: who it is, how it is, and where its time in the newest frame went.

use egui::{Align, Color32, Layout, RichText, Ui};
use shared::protocol::SceneState;

use super::{OverlayModel, style};
use crate::stats::{FarmStatus, NodeFrameStats, NodeStatus};

/// How many render servers can be given work.
pub(super) fn n_ready(status: &FarmStatus) -> usize {
    status.nodes.iter().filter(|node| node.is_ready()).count()
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel) {
    let FarmStatus { nodes, n_lost, n_healed, .. } = &model.status;
    if nodes.is_empty() {
        return;
    }
    let lost = if *n_lost > 0 { format!(", {n_lost} lost, {n_healed} frames healed") } else { String::new() };
    style::section(ui, &format!("Render servers: {} of {} ready{lost}", n_ready(&model.status), nodes.len()), "ms");
    for node in nodes {
        let frame = model.frame.as_ref().and_then(|frame| frame.nodes.iter().find(|stats| stats.id == node.id));
        row(ui, node, frame);
    }
}

fn row(ui: &mut Ui, node: &NodeStatus, frame: Option<&NodeFrameStats>) {
    let (state, colour, reason) = state(node);
    ui.add_space(4.0);
    ui.horizontal(|ui| {
        ui.label(RichText::new(&node.name).strong());
        ui.label(RichText::new(where_and_how(node)).small().weak());
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| ui.label(RichText::new(state).color(colour)));
    });
    if let Some(reason) = reason {
        ui.label(RichText::new(reason).color(style::BUSY));
    }
    let of_frame = |figure: fn(&NodeFrameStats) -> String| frame.map_or_else(|| "–".to_owned(), figure);
    style::metrics(
        ui,
        &[
            ("share", of_frame(|frame| format!("{:.0} %", frame.share * 100.0))),
            ("trace", of_frame(|frame| style::ms(frame.trace_ms))),
            ("network", of_frame(|frame| style::ms(frame.network_ms))),
            ("idle", of_frame(|frame| style::ms(frame.idle_ms))),
            ("Mbit/s", of_frame(|frame| format!("{:.0} {}", frame.mbit_per_s, frame.encoding.name()))),
            ("bytes", of_frame(|frame| style::bytes(frame.bytes_in + frame.bytes_out))),
            ("ping", node.round_trip_ms.map_or_else(|| "–".to_owned(), style::ms)),
        ],
    );
}

fn where_and_how(node: &NodeStatus) -> String {
    let threads = if node.threads == 1 { "thread" } else { "threads" };
    let failures = match node.n_failures {
        0 => String::new(),
        n_failures => format!(", lost {n_failures} times"),
    };
    format!("{}, {} {threads}{failures}", node.address, node.threads)
}

/// The state in a word, its colour, and what to do about it.
fn state(node: &NodeStatus) -> (String, Color32, Option<&str>) {
    match &node.scene {
        _ if node.is_silent => ("silent".to_owned(), style::BUSY, None),
        None => ("connected".to_owned(), style::BUSY, None),
        Some(SceneState::Loading { progress }) => (format!("loading {:.0} %", progress * 100.0), style::BUSY, None),
        Some(SceneState::Ready { .. }) => ("ready".to_owned(), style::GOOD, None),
        Some(SceneState::Missing { reason }) => ("no model".to_owned(), style::BAD, Some(reason)),
    }
}
