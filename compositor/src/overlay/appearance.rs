//! Controls of the [`Appearance`]: key light, background and clip plane.

use egui::{Role, Slider, Ui, WidgetInfo};
use shared::{
    appearance::{Appearance, Background, Clip, ClipSide, Light},
    protocol::LightingMode,
};
use strum::VariantArray;

use crate::control::input::Command;

/// `rays`: those that were chosen, if any were.
pub(super) fn show(ui: &mut Ui, appearance: &Appearance, rays: Option<LightingMode>, commands: &mut Vec<Command>) {
    let (mut azimuth, mut elevation) = (appearance.light.azimuth_deg(), appearance.light.elevation_deg());
    let name =
        Light::PRESETS.iter().find(|(_, light)| *light == appearance.light).map_or("set by hand", |(name, _)| name);
    ui.label(format!("Light (L): {name}"));
    let mut angle = |degrees: &mut i16, limit: i16, name: &str| {
        ui.add(Slider::new(degrees, -limit..=limit).text(name).suffix("°")).changed()
    };
    let is_turned = angle(&mut azimuth, 180, "light to the right");
    let is_raised = angle(&mut elevation, 90, "light up");
    if (is_turned || is_raised)
        && let Ok(light) = Light::new(azimuth, elevation)
    {
        commands.push(Command::SetLight(light));
    }
    // Without a choice, paths light pictures at rest.
    if rays.is_none_or(|rays| rays == LightingMode::Path) {
        light_of_paths(ui, appearance, commands);
    }
    ui.label("Background (B)");
    ui.horizontal_wrapped(|ui| {
        for (name, background) in Background::PRESETS {
            let label = ui.selectable_label(background == appearance.background, name);
            commands.extend(label.clicked().then_some(Command::SetBackground(background)));
        }
    });
    cut(ui, appearance.clip, commands);
}

fn light_of_paths(ui: &mut Ui, appearance: &Appearance, commands: &mut Vec<Command>) {
    let (mut degrees, mut stops) = (appearance.path.sun_degrees(), appearance.path.exposure_ev());
    // A sky image has a sun of its own.
    let sun = Slider::new(&mut degrees, 0.0..=90.0).text("sun").suffix("°").fixed_decimals(1);
    if appearance.sky.is_none() && ui.add(sun).changed() {
        commands.push(Command::SetSun((degrees * 10.0).round() as u16));
    }
    let exposure = Slider::new(&mut stops, -10.0..=10.0).text("exposure ([ and ])").suffix(" stops").fixed_decimals(1);
    if ui.add(exposure).changed() {
        commands.push(Command::SetExposure((stops * 10.0).round() as i16));
    }
    let mut has_ground = appearance.path.has_ground();
    if ui.checkbox(&mut has_ground, "shadow on a ground (Z)").changed() {
        commands.push(Command::SetGround(has_ground));
    }
}

fn cut(ui: &mut Ui, clip: Option<Clip>, commands: &mut Vec<Command>) {
    ui.horizontal_wrapped(|ui| {
        ui.label("Cut (X)");
        ui.spacing_mut().item_spacing.x = 0.0;
        let sides = std::iter::once(None).chain(ClipSide::VARIANTS.iter().copied().map(Some));
        for side in sides {
            let is_chosen = side == clip.map(Clip::side);
            let name = side.map_or("none", Into::into);
            let button = ui.selectable_label(is_chosen, name);
            let accessible_label = format!("cut from {name}");
            button.widget_info(|| WidgetInfo::selected(Role::Button, true, is_chosen, &accessible_label));
            commands.extend(button.clicked().then_some(Command::SetClip(side.map(|from| Clip::with_side(from, clip)))));
        }
    });
    if let Some(clip) = clip {
        let mut percent = f64::from(clip.cut_permille()) / 10.0;
        let slider = Slider::new(&mut percent, 0.0..=100.0).text("cut away").suffix(" %").max_decimals(1);
        if ui.add(slider).changed()
            && let Ok(clip) = Clip::new(clip.side(), (percent * 10.0).round() as u16)
        {
            commands.push(Command::SetClip(Some(clip)));
        }
    }
}
