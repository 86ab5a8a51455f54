//! The panel of figures: how fast, why not, and what can be switched.

use egui::{Align, Layout, RichText, Ui};
use shared::{
    division::Division,
    protocol::{LightingMode, ShadingMode},
    structure::Storage,
};

use super::{
    OverlayModel, Tint, history, nodes,
    style::{self, Tone, callout, metrics, section},
};
use crate::control::input::Command;

/// The storages of the grid, in the order in which a key steps through them; the first is as render servers were started.
pub const STORAGES: [Option<Storage>; 4] =
    [None, Some(Storage::Tree), Some(Storage::RowDisplacement), Some(Storage::Plain)];
/// The densities of the grid, in the order in which a key steps through them, in cells per triangle.
pub const DENSITIES: [u32; 6] = [4, 8, 16, 32, 64, 128];

pub(super) fn show(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    headline(ui, model, commands);
    for message in &model.messages {
        callout(ui, Tone::Warning, |ui| {
            ui.label(message);
            if ui.small_button("Dismiss").clicked() {
                commands.push(Command::DismissMessage);
            }
        });
    }
    waiting(ui, model);
    timings(ui, model);
    history::show(ui, &model.history);
    switches(ui, model, commands);
    nodes::show(ui, model);
}

fn headline(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    ui.horizontal(|ui| {
        let rate = match model.frames_per_second {
            Some(rate) => format!("{rate:.1} frames/s"),
            None => "at rest".to_owned(),
        };
        ui.label(RichText::new(rate).heading().strong());
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            if ui.button("Keys (F1)").clicked() {
                commands.push(Command::ToggleHelp);
            }
        });
    });
    let latency = model.display.map(|display| display.latency_ms);
    let latency = latency.map_or_else(|| "no frame yet".to_owned(), |ms| format!("{ms:.0} ms from camera to picture"));
    ui.label(latency);
}

/// Why there is nothing to see, or nothing new, and what to do.
fn waiting(ui: &mut Ui, model: &OverlayModel) {
    if let Some((name, progress)) = &model.loading {
        callout(ui, Tone::Note, |ui| {
            ui.label(format!("Reading {name}: {:.0} %", progress * 100.0));
            ui.add(egui::ProgressBar::new(*progress).desired_height(6.0));
        });
    }
    let n_ready = nodes::n_ready(&model.status);
    if model.status.nodes.is_empty() {
        callout(ui, Tone::Warning, |ui| {
            ui.label(RichText::new("No render server is connected.").strong());
            ui.label("Start one with:");
            ui.label(RichText::new(&model.join.command).monospace().color(style::ACCENT));
            ui.label(RichText::new(&model.join.note).small());
        });
    } else if n_ready < model.min_renderers as usize {
        callout(ui, Tone::Note, |ui| {
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

/// Whether the resolution follows the motion, and how many samples a pixel there are so far.
fn refinement(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    ui.horizontal(|ui| {
        let mut is_refining = model.is_refining;
        if ui.checkbox(&mut is_refining, "resolution follows the motion (M)").changed() {
            commands.push(Command::ToggleRefinement);
        }
        if model.frame.is_some() {
            let [so_far, in_all] = model.n_samples;
            let so_far = if so_far < in_all { format!("{so_far} of {in_all}") } else { so_far.to_string() };
            ui.with_layout(Layout::right_to_left(Align::Center), |ui| ui.label(format!("samples: {so_far}")));
        }
    });
}

fn switches(ui: &mut Ui, model: &OverlayModel, commands: &mut Vec<Command>) {
    ui.add_space(6.0);
    refinement(ui, model, commands);
    egui::Grid::new("switches").num_columns(2).show(ui, |ui| {
        ui.horizontal(|ui| ui.label("division (H)"));
        ui.horizontal(|ui| {
            for division in Division::ALL {
                if ui.selectable_label(division == model.division, division.name()).clicked() {
                    commands.push(Command::SetDivision(division));
                }
            }
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("view (V)"));
        ui.horizontal(|ui| {
            for view in ShadingMode::ALL {
                if ui.selectable_label(view == model.view, view.name()).clicked() {
                    commands.push(Command::SetView(view));
                }
            }
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("grid (K)"));
        ui.horizontal(|ui| {
            ui.spacing_mut().item_spacing.x = 0.0;
            for storage in STORAGES {
                let is_chosen = storage == model.structure.map(|structure| structure.storage);
                if ui.selectable_label(is_chosen, storage.map_or("as started", Storage::name)).clicked() {
                    commands.push(Command::SetStorage(storage));
                }
            }
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("cells (J)"));
        ui.horizontal(|ui| {
            for density in DENSITIES {
                let is_chosen = model.structure.is_some_and(|structure| structure.density == f64::from(density));
                if ui.selectable_label(is_chosen, density.to_string()).clicked() {
                    commands.push(Command::SetDensity(density));
                }
            }
            ui.label(RichText::new("a triangle").small().weak());
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("tint (T)"));
        ui.horizontal(|ui| {
            for tint in Tint::ALL {
                if ui.selectable_label(tint == model.tint, tint.name()).clicked() {
                    commands.push(Command::SetTint(tint));
                }
            }
        });
        ui.end_row();
        ui.horizontal(|ui| ui.label("rays (R)"));
        ui.horizontal(|ui| {
            for rays in LightingMode::ALL {
                if ui.selectable_label(rays == model.rays, rays.name()).clicked() {
                    commands.push(Command::SetRays(rays));
                }
            }
        });
        ui.end_row();
    });
}
