//! The overlay's style: calm, dark, legible from across a room.

use egui::{Align, Color32, FontFamily, FontId, Frame, Layout, RichText, TextStyle, Ui};

use crate::control::input::Command;
pub(super) use shared::printable::bytes;

/// Emphasis without alarm.
pub(super) const ACCENT: Color32 = Color32::from_rgb(122, 200, 255);
pub(super) const GOOD: Color32 = Color32::from_rgb(126, 211, 136);
/// Not ready yet.
pub(super) const BUSY: Color32 = Color32::from_rgb(240, 196, 92);
/// Needs an operator.
pub(super) const BAD: Color32 = Color32::from_rgb(255, 128, 112);
/// Around marks on the picture.
pub(super) const MARK_EDGE: Color32 = Color32::from_rgb(14, 17, 22);
const TEXT: Color32 = Color32::from_gray(225);
const WEAK: Color32 = Color32::from_gray(160);

/// Space inside the panels in points.
pub(super) const PANEL_PADDING: f32 = 14.0;
/// The part of it in which a scroll bar is, in points.
pub(super) const SCROLL_BAR: f32 = 10.0;

/// Sets colours and sizes, once for each context.
pub(crate) fn apply_style(context: &egui::Context) {
    context.set_theme(egui::Theme::Dark);
    context.all_styles_mut(|style| {
        let sizes = [
            (TextStyle::Heading, 24.0, FontFamily::Proportional),
            (TextStyle::Body, 14.5, FontFamily::Proportional),
            (TextStyle::Button, 14.5, FontFamily::Proportional),
            (TextStyle::Monospace, 14.0, FontFamily::Monospace),
            (TextStyle::Small, 12.0, FontFamily::Proportional),
        ];
        style.text_styles = sizes.map(|(name, size, family)| (name, FontId::new(size, family))).into();
        style.interaction.selectable_labels = false;
        style.spacing.button_padding = egui::vec2(8.0, 3.0);
        style.spacing.item_spacing = egui::vec2(8.0, 4.0);
        // The scroll bars of panels that are longer than the window are seen before the mouse is there.
        style.spacing.scroll.dormant_handle_opacity = 0.6;
        style.spacing.scroll.floating_width = 5.0;
        let visuals = &mut style.visuals;
        // A resting wall is not drawn.
        visuals.text_cursor.blink = false;
        visuals.override_text_color = None;
        visuals.widgets.noninteractive.fg_stroke.color = TEXT;
        visuals.widgets.inactive.fg_stroke.color = TEXT;
        visuals.weak_text_color = Some(WEAK);
        visuals.selection.bg_fill = Color32::from_rgb(38, 96, 140);
    });
}

/// The zoom for a window of `size` in physical pixels.
///
/// People see a wall from farther away than a screen of its resolution, so text keeps its part of the height; in a small
/// window it stays legible instead.
pub(crate) fn zoom(size: [u32; 2], scale_factor: f64) -> f32 {
    let height_in_points = f64::from(size[1]) / scale_factor;
    (height_in_points / 800.0).clamp(0.9, 6.0) as f32
}

pub(super) fn panel_frame() -> Frame {
    Frame::new().fill(Color32::from_rgba_unmultiplied(14, 17, 22, 232)).corner_radius(10.0).inner_margin(PANEL_PADDING)
}

/// A box that stands out from the panel: in [`ACCENT`] to note something, in [`BUSY`] if an operator has to act.
pub(super) fn callout<R>(ui: &mut Ui, color: Color32, add: impl FnOnce(&mut Ui) -> R) {
    ui.add_space(4.0);
    Frame::new()
        .fill(color.gamma_multiply(0.12))
        .stroke(egui::Stroke::new(1.0, color.gamma_multiply(0.6)))
        .corner_radius(6.0)
        .inner_margin(10.0)
        .show(ui, |ui| {
            ui.set_width(ui.available_width());
            add(ui)
        });
}

/// A line with something at its right end; what is left of it has the rest, and long texts in it are cut.
pub(super) fn line(ui: &mut Ui, right: impl FnOnce(&mut Ui), left: impl FnOnce(&mut Ui)) -> egui::Response {
    let both = ui.horizontal(|ui| {
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            right(ui);
            ui.with_layout(Layout::left_to_right(Align::Center), |ui| {
                ui.style_mut().wrap_mode = Some(egui::TextWrapMode::Truncate);
                left(ui);
            });
        });
    });
    both.response
}

/// A panel's heading, with a button that gives a command.
pub(super) fn heading(ui: &mut Ui, text: &str, button: &str, command: Command, commands: &mut Vec<Command>) {
    let button = |ui: &mut Ui| commands.extend(ui.button(button).clicked().then_some(command));
    line(ui, button, |ui| {
        ui.label(RichText::new(text).heading().strong());
    });
}

/// The heading of a section, and the unit of its values.
pub(super) fn section(ui: &mut Ui, name: &str, unit: &str) {
    ui.add_space(6.0);
    ui.separator();
    let unit = |ui: &mut Ui| {
        ui.label(RichText::new(unit).small().weak());
    };
    line(ui, unit, |ui| {
        ui.label(RichText::new(name).strong().color(ACCENT));
    });
}

/// The side of a swatch in points.
pub(super) const SWATCH: f32 = 10.0;

/// A small square in a colour that a legend explains.
pub(super) fn swatch(ui: &mut Ui, color: Color32) {
    let (rect, _) = ui.allocate_exact_size(egui::Vec2::splat(SWATCH), egui::Sense::hover());
    ui.painter().rect_filled(rect, 2.0, color);
}

/// A line of small text with the meaning of colours.
pub(super) fn legend(ui: &mut Ui, text: &str, colors: &[(&str, Color32)]) {
    let names = |ui: &mut Ui| {
        for (name, color) in colors.iter().rev() {
            ui.label(RichText::new(*name).small().color(*color));
        }
    };
    line(ui, names, |ui| {
        ui.label(RichText::new(text).small().weak());
    });
}

/// Parts of a whole side by side, each in its colour.
pub(super) fn stacked_bar(ui: &mut Ui, parts: &[(f64, Color32)], whole: f64, accessible_label: &str) {
    let size = egui::vec2(ui.available_width(), 9.0);
    let (rect, response) = ui.allocate_exact_size(size, egui::Sense::hover());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Meter, true, accessible_label));
    ui.painter().rect_filled(rect, 2.0, Color32::from_white_alpha(14));
    let mut left = rect.min.x;
    for &(part, color) in parts {
        let width = if whole > 0.0 { (part / whole).clamp(0.0, 1.0) as f32 * rect.width() } else { 0.0 };
        let right = (left + width).min(rect.max.x);
        let bar = egui::Rect::from_min_max(egui::pos2(left, rect.min.y), egui::pos2(right, rect.max.y));
        ui.painter().rect_filled(bar, 2.0, color);
        left = right;
    }
}

/// Values side by side, each under its name; on several lines where they are too long for one.
pub(super) fn metrics(ui: &mut Ui, figures: &[(&str, String)]) {
    let spacing = ui.spacing().item_spacing.x;
    // A value may reach into half of the space after it.
    let column_width = (ui.available_width() + spacing) / figures.len().max(1) as f32 - 0.5 * spacing;
    if figures.len() > 1 && figures.iter().any(|(_, value)| body_width(ui, value) > column_width) {
        let (first, rest) = figures.split_at(figures.len() / 2);
        metrics(ui, first);
        return metrics(ui, rest);
    }
    ui.columns(figures.len(), |columns| {
        for (column, (name, value)) in columns.iter_mut().zip(figures) {
            column.spacing_mut().item_spacing.y = 0.0;
            column.style_mut().wrap_mode = Some(egui::TextWrapMode::Extend);
            column.label(RichText::new(*name).small().weak());
            let accessible_label = format!("{name} {value}");
            column
                .label(RichText::new(value).strong())
                .widget_info(|| egui::WidgetInfo::labeled(egui::Role::Label, true, &accessible_label));
        }
    });
}

/// The width of a text in points.
pub(super) fn body_width(ui: &Ui, text: &str) -> f32 {
    let font = TextStyle::Body.resolve(ui.style());
    ui.fonts_mut(|fonts| fonts.layout_no_wrap(text.to_owned(), font, TEXT)).size().x
}

pub(super) fn ms(ms: f64) -> String {
    if ms < 99.95 { format!("{ms:.1}") } else { format!("{ms:.0}") }
}

/// A number with spaces between thousands.
pub(super) fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut grouped = String::new();
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            grouped.push(' ');
        }
        grouped.push(digit);
    }
    grouped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_keep_about_three_digits() {
        assert_eq!([ms(0.04), ms(9.96), ms(99.96)], ["0.0", "10.0", "100"]);
        assert_eq!([0, 999, 1000, 10_000_000].map(grouped), ["0", "999", "1 000", "10 000 000"]);
    }

    #[test]
    fn text_grows_with_the_wall_and_stays_legible_in_a_small_window() {
        assert_eq!(zoom([4096, 2304], 1.0), 2.88);
        assert_eq!(zoom([1422, 800], 1.0), 1.0);
        assert_eq!(zoom([2844, 1600], 2.0), 1.0);
        assert_eq!(zoom([640, 360], 1.0), 0.9);
    }
}
