//! How the picture looks: from where it is lit, and what is behind the model.

use egui::{Slider, Ui};
use shared::look::{Background, Light, Look};

use crate::input::Command;

pub(super) fn show(ui: &mut Ui, look: &Look, commands: &mut Vec<Command>) {
    let (mut azimuth, mut elevation) = (look.light.azimuth_deg(), look.light.elevation_deg());
    let name = Light::PRESETS.iter().find(|(_, light)| *light == look.light).map_or("set by hand", |(name, _)| name);
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
    ui.label("Background (B)");
    ui.horizontal(|ui| {
        for (name, background) in Background::PRESETS {
            if ui.selectable_label(background == look.background, name).clicked() {
                commands.push(Command::SetBackground(background));
            }
        }
    });
}
