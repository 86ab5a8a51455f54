//! The panel of measurements: speed, its causes, and switches.

use egui::{Align, Layout, RichText, Ui};
use shared::{
    division::Division,
    protocol::{LightingMode, SceneState, ShadingMode},
    structure::Storage,
};
use strum::VariantArray;

use super::{
    OverlayModel, Tint, history, nodes,
    style::{self, callout, metrics, section},
};
use crate::{control::input::Command, farm::stats::NodeStatus};

/// Storages of the grid to compare, in the order of the key; `None` is the one with which render servers were started. The
/// compact one is for those that lack memory.
pub(crate) const STORAGES: [Option<Storage>; 4] =
    [None, Some(Storage::Tree), Some(Storage::RowDisplacement), Some(Storage::Plain)];
/// Rays that light the picture, in the order of the key; `None` leaves the choice to the wall.
pub(crate) const RAYS: [Option<LightingMode>; 5] = [
    None,
    Some(LightingMode::Primary),
    Some(LightingMode::Shadows),
    Some(LightingMode::AmbientOcclusion),
    Some(LightingMode::Path),
];
/// Densities of the grid in cells per triangle, in the order of the key.
pub(crate) const DENSITIES: [u32; 6] = [4, 8, 16, 32, 64, 128];

pub(super) fn show(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    headline(ui, model, commands);
    waiting(ui, model);
    timings(ui, model);
    history::show(ui, &model.history);
    switches(ui, model, commands);
    nodes::show(ui, model);
}

fn headline(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    let rate = match model.frames_per_second {
        Some(rate) => format!("{rate:.1} frames/s"),
        None if is_loading(model) => "loading".to_owned(),
        None if model.frame.is_none() => "waiting".to_owned(),
        None => at_rest(model),
    };
    style::heading(ui, &rate, "Keys (F1)", Command::ToggleHelp, commands);
    let latency = model.display.map(|display| display.latency_ms);
    let latency = latency.map_or_else(|| "no frame yet".to_owned(), |ms| format!("{ms:.0} ms from camera to picture"));
    ui.label(latency);
}

/// What a wall does whose camera rests.
fn at_rest(model: &OverlayModel) -> String {
    let [so_far, in_all] = model.n_samples;
    match model.status.percent {
        Some(percent) => format!("refining: {percent} %"),
        None if model.is_refining && so_far < in_all => "refining".to_owned(),
        None if model.is_refining => "finished".to_owned(),
        None => "at rest".to_owned(),
    }
}

/// Whether the wall, or the first of its render servers, is not ready yet.
fn is_loading(model: &OverlayModel) -> bool {
    let is_loading =
        |node: &NodeStatus| matches!(node.scene, Some(SceneState::Loading { .. } | SceneState::Fetching(_)));
    model.loading.is_some() || nodes::n_ready(&model.status) == 0 && model.status.nodes.iter().any(is_loading)
}

/// Why there is nothing to see, or nothing new, and the cure.
fn waiting(ui: &mut Ui, model: &OverlayModel) {
    if let Some((name, progress)) = &model.loading {
        callout(ui, style::ACCENT, |ui| {
            ui.label(format!("Reading {name}: {:.0} %", progress * 100.0));
            ui.add(egui::ProgressBar::new(*progress).desired_height(6.0));
        });
    }
    let n_ready = nodes::n_ready(&model.status);
    if model.status.nodes.is_empty() {
        callout(ui, style::BUSY, |ui| {
            ui.label(RichText::new("No render server is connected.").strong());
            ui.label("Start one with:");
            ui.label(RichText::new(&model.join.command).monospace().color(style::ACCENT));
            ui.label(RichText::new(&model.join.note).small());
        });
    } else if model.frame.is_none() && n_ready < model.min_renderers as usize {
        callout(ui, style::ACCENT, |ui| {
            ui.label(format!("Waiting for render servers: {n_ready} of {} are ready.", model.min_renderers));
        });
    }
}

fn timings(ui: &mut Ui, model: &OverlayModel) {
    section(ui, "Frame", "ms");
    let (frame, display) = (model.frame.as_ref(), model.display);
    let ms = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), style::ms);
    let text = |value: Option<String>| value.unwrap_or_else(|| "–".to_owned());
    metrics(
        ui,
        &[
            ("render", ms(frame.map(|frame| frame.render_ms))),
            ("place", ms(frame.map(|frame| frame.place_ms))),
            ("upload", ms(display.map(|display| display.upload_ms))),
            ("draw", ms(display.map(|display| display.draw_ms))),
            ("present", ms(display.map(|display| display.present_ms))),
            ("imbalance", text(frame.map(|frame| format!("×{:.2}", frame.imbalance)))),
        ],
    );
    metrics(
        ui,
        &[
            ("nodes", text(frame.map(|frame| frame.nodes.len().to_string()))),
            ("resolution", text(frame.map(|frame| frame.size.to_string()))),
            ("received", text(frame.map(|frame| style::bytes(frame.bytes_in)))),
            ("sent", text(frame.map(|frame| style::bytes(frame.bytes_out)))),
            ("attempts", text(frame.map(|frame| frame.attempts.to_string()))),
        ],
    );
}

/// Whether the resolution follows the motion, and the samples a pixel so far.
fn refinement(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    let [so_far, in_all] = model.n_samples;
    let so_far = match so_far < in_all {
        true => format!("{so_far} of {in_all}"),
        false if model.is_refining && model.has_noise_limit => format!("up to {so_far}, finished"),
        false if model.is_refining => format!("{so_far}, finished"),
        false => so_far.to_string(),
    };
    let samples = |ui: &mut Ui| {
        if model.frame.is_some() {
            ui.label(format!("samples: {so_far}"));
        }
    };
    style::line(ui, samples, |ui| {
        let mut is_refining = model.is_refining;
        let checkbox = ui.checkbox(&mut is_refining, "resolution follows the motion (M)");
        commands.extend(checkbox.changed().then_some(Command::ToggleRefinement));
    });
}

fn switches(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    ui.add_space(6.0);
    refinement(ui, model, commands);
    let mut row = |ui: &mut Ui, name: &str, add: &mut dyn FnMut(&mut Ui, &mut Vec<Command>)| {
        ui.horizontal_wrapped(|ui| {
            let layout = Layout::left_to_right(Align::Center);
            ui.allocate_ui_with_layout(egui::vec2(SWITCH_NAME_WIDTH, 24.0), layout, |ui| {
                ui.set_min_width(SWITCH_NAME_WIDTH);
                ui.label(name);
            });
            add(ui, commands);
        });
    };
    row(ui, "division (H)", &mut |ui, commands| {
        choices(ui, Division::VARIANTS, |it| it == model.division, |it| it, Command::SetDivision, commands);
    });
    row(ui, "view (V)", &mut |ui, commands| {
        choices(ui, ShadingMode::VARIANTS, |it| it == model.view, |it| it, Command::SetShading, commands);
    });
    row(ui, "grid (K)", &mut |ui, commands| {
        ui.spacing_mut().item_spacing.x = 0.0;
        let is_chosen = |storage| storage == model.structure.map(|structure| structure.storage);
        let name = |storage: Option<Storage>| storage.map_or("as started", Into::into);
        choices(ui, &STORAGES, is_chosen, name, Command::SetStorage, commands);
    });
    row(ui, "cells (J)", &mut |ui, commands| {
        let is_chosen = |it| model.structure.is_some_and(|structure| structure.density == f64::from(it));
        choices(ui, &DENSITIES, is_chosen, |it| it, Command::SetDensity, commands);
        ui.label(RichText::new("a triangle").small().weak());
    });
    row(ui, "tint (T)", &mut |ui, commands| {
        choices(ui, Tint::VARIANTS, |it| it == model.tint, <&str>::from, Command::SetTint, commands);
    });
    row(ui, "rays (R)", &mut |ui, commands| {
        let name = |rays: Option<LightingMode>| rays.map_or("auto".to_owned(), |rays| rays.to_string());
        choices(ui, &RAYS, |it| it == model.rays, name, Command::SetLighting, commands);
    });
}

/// Width of the switches' names in points.
const SWITCH_NAME_WIDTH: f32 = 66.0;

/// A selectable label for each of `all`; a click asks for it.
fn choices<T: Copy, S: ToString>(
    ui: &mut Ui,
    all: &[T],
    is_chosen: impl Fn(T) -> bool,
    name: impl Fn(T) -> S,
    command: impl Fn(T) -> Command,
    commands: &mut Vec<Command>,
) {
    for &choice in all {
        let label = ui.selectable_label(is_chosen(choice), name(choice).to_string());
        commands.extend(label.clicked().then_some(command(choice)));
    }
}
