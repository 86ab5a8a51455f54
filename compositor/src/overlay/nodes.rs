//! One row for each render server: its name, its state, and its times in the newest frame.

use std::borrow::Cow;

use egui::{Color32, RichText, Ui};
use shared::{printable::counted, protocol::SceneState};

use super::{OverlayModel, Tint, style, tint::node_color};
use crate::farm::stats::{FarmStatus, NodeFrameStats, NodeStatus};

pub(super) fn n_ready(status: &FarmStatus) -> usize {
    status.nodes.iter().filter(|node| node.is_ready()).count()
}

pub(super) fn show(ui: &mut Ui, model: &OverlayModel) {
    let FarmStatus { nodes, n_lost, n_healed, .. } = &model.status;
    if nodes.is_empty() {
        return;
    }
    let lost =
        if *n_lost > 0 { format!(", {n_lost} lost, {} healed", counted(n_healed, "frame")) } else { String::new() };
    style::section(ui, &format!("Render servers: {} of {} ready{lost}", n_ready(&model.status), nodes.len()), "");
    let frame_of =
        |node: &NodeStatus| model.frame.as_ref().and_then(|frame| frame.nodes.iter().find(|stats| stats.id == node.id));
    let longest_ms = nodes.iter().filter_map(frame_of).map(|frame| times(frame).iter().sum()).fold(0.0, f64::max);
    style::legend(ui, "ms in the newest frame", &[("tracing", TRACE), ("network", NETWORK), ("idle", IDLE)]);
    for node in nodes {
        let swatch = (model.tint == Tint::Nodes).then(|| node_color(node.id));
        let is_compact = nodes.len() > MOST_WITH_FIGURES;
        let head = row(ui, is_compact, node, swatch, frame_of(node), longest_ms);
        if is_compact {
            head.on_hover_ui(|ui| {
                ui.label(address_and_threads(node, frame_of(node)));
                details(ui, node, frame_of(node));
            });
        } else {
            details(ui, node, frame_of(node));
        }
    }
}

/// With more render servers than this, each has one line, and details are a tooltip.
const MOST_WITH_FIGURES: usize = 4;
/// Width of names in these lines, in points.
const COMPACT_NAME_WIDTH: f32 = 84.0;
const TRACE: Color32 = style::ACCENT;
const NETWORK: Color32 = style::BUSY;
const IDLE: Color32 = Color32::from_gray(95);

fn times(frame: &NodeFrameStats) -> [f64; 3] {
    [frame.trace_ms, frame.network_ms, frame.idle_ms]
}

fn row(
    ui: &mut Ui,
    is_compact: bool,
    node: &NodeStatus,
    swatch: Option<Color32>,
    frame: Option<&NodeFrameStats>,
    longest_ms: f64,
) -> egui::Response {
    let (state, color, reason) = state(node);
    let [trace, network, idle] = frame.map_or([0.0; 3], times);
    let bar = |ui: &mut Ui| {
        let accessible_label =
            format!("{}: tracing {trace:.1} ms, network {network:.1} ms, idle {idle:.1} ms", node.name);
        style::stacked_bar(ui, &[(trace, TRACE), (network, NETWORK), (idle, IDLE)], longest_ms, &accessible_label);
    };
    let state = |ui: &mut Ui| {
        ui.label(RichText::new(state).color(color));
        if is_compact {
            ui.allocate_ui(egui::vec2((ui.available_width() - COMPACT_NAME_WIDTH).max(1.0), 16.0), bar);
        }
    };
    let head = style::line(ui, state, |ui| {
        if let Some(swatch) = swatch {
            style::swatch(ui, swatch);
        }
        ui.label(RichText::new(&node.name).strong());
    });
    if !is_compact {
        ui.label(RichText::new(address_and_threads(node, frame)).small().weak());
    }
    if let Some(reason) = reason {
        ui.label(RichText::new(reason).color(style::BUSY));
    }
    if !is_compact {
        bar(ui);
    }
    head
}

fn details(ui: &mut Ui, node: &NodeStatus, frame: Option<&NodeFrameStats>) {
    let of_frame = |figure: fn(&NodeFrameStats) -> String| frame.map_or_else(|| "–".to_owned(), figure);
    style::metrics(
        ui,
        &[
            ("share", of_frame(|frame| format!("{:.0} %", frame.share * 100.0))),
            ("trace", of_frame(|frame| style::ms(frame.trace_ms))),
            ("network", of_frame(|frame| style::ms(frame.network_ms))),
            ("idle", of_frame(|frame| style::ms(frame.idle_ms))),
            ("Mbit/s", of_frame(|frame| format!("{:.0}", frame.mbit_per_s))),
            ("bytes", of_frame(|frame| style::bytes(frame.bytes_in + frame.bytes_out))),
            ("ping", node.round_trip_ms.map_or_else(|| "–".to_owned(), style::ms)),
        ],
    );
}

fn address_and_threads(node: &NodeStatus, frame: Option<&NodeFrameStats>) -> String {
    let threads = counted(node.threads, "thread");
    let failures = match node.n_failures {
        0 => String::new(),
        n_failures => format!(", lost {}", counted(n_failures, "time")),
    };
    let encoding = frame.map(|frame| format!(", {}", frame.encoding)).unwrap_or_default();
    format!("{}, {threads}{encoding}{failures}", node.address)
}

/// The state in a word, its colour, and the cure, or how long it lasts.
fn state(node: &NodeStatus) -> (String, Color32, Option<Cow<'_, str>>) {
    match &node.scene {
        _ if node.is_silent => ("silent".to_owned(), style::BUSY, None),
        None => ("connected".to_owned(), style::BUSY, None),
        Some(SceneState::Loading { progress }) => (format!("loading {:.0} %", progress * 100.0), style::BUSY, None),
        Some(SceneState::Fetching(transfer)) => {
            ("fetching the model".to_owned(), style::BUSY, Some(transfer.to_string().into()))
        }
        Some(SceneState::Ready { .. }) => ("ready".to_owned(), style::GOOD, None),
        Some(SceneState::Missing { reason }) => ("no model".to_owned(), style::BAD, Some(reason.into())),
    }
}
