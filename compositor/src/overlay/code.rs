//! The code that opens the remote on a phone.

use egui::{Align2, Color32, Order, Pos2, Rect, RichText, Sense, Ui};
use qrcode::{Color, EcLevel, QrCode};

use super::style;

/// Width of the code in points, with its quiet zone.
const SIZE: f32 = 190.0;
/// Light modules around the code, which cameras need.
const QUIET: usize = 4;

/// Shows the code of a link in the lower right corner, and returns its area; `None` if the link is too long for one.
pub(super) fn show(ui: &Ui, link: &str) -> Option<Rect> {
    let code = QrCode::with_error_correction_level(link, EcLevel::M).ok()?;
    let area = egui::Area::new(egui::Id::unique("remote")).anchor(Align2::RIGHT_BOTTOM, [-16.0, -16.0]);
    let shown = area.order(Order::Foreground).interactable(false).show(ui.ctx(), |ui| {
        style::panel_frame().show(ui, |ui| {
            ui.set_width(SIZE);
            let (response, painter) = ui.allocate_painter(egui::vec2(SIZE, SIZE), Sense::hover());
            painter.rect_filled(response.rect, 6.0, Color32::WHITE);
            let module = SIZE / (code.width() + 2 * QUIET) as f32;
            let colors = code.to_colors();
            for index in (0..colors.len()).filter(|&index| colors[index] == Color::Dark) {
                let [x, y] = [index % code.width(), index / code.width()].map(|at| (at + QUIET) as f32 * module);
                // Edges on whole pixels leave no seams between modules.
                let corner = response.rect.min + egui::vec2(x, y);
                let square = Rect::from_min_max(corner, corner + egui::Vec2::splat(module));
                painter.rect_filled(snapped(square, ui.ctx().pixels_per_point()), 0.0, Color32::BLACK);
            }
            ui.label(RichText::new("Steer with your phone").strong());
            let place = link.split('#').next().unwrap_or_default();
            ui.label(RichText::new(place).small());
        });
    });
    Some(shown.response.rect)
}

/// The rectangle with its edges on whole pixels.
fn snapped(rect: Rect, pixels_per_point: f32) -> Rect {
    let snap = |at: f32| (at * pixels_per_point).round() / pixels_per_point;
    let corner = |point: Pos2| egui::pos2(snap(point.x), snap(point.y));
    Rect::from_min_max(corner(rect.min), corner(rect.max))
}
