//! The caption of a show's scene, at the lower edge of the canvas.

use egui::{Align, Color32, Rect, Ui, Vec2, pos2};

use super::{
    OverlayModel,
    canvas_text::{CanvasText, TextStyle},
};

/// A text under the picture.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Caption {
    pub text: String,
    /// 0 to 1.
    pub opacity: f32,
    /// The part of the canvas that panels leave free, its upper-left corner (0, 0).
    pub free: Rect,
}

/// Letters, as a fraction of the canvas's height.
const SIZE: f32 = 0.032;
/// The widest box, as a fraction of the free part of the canvas.
const MOST_WIDTH: f32 = 0.8;
/// Between the box and the lower edge, as a fraction of the canvas's height.
const MARGIN: f32 = 0.035;

/// Lays the caption out; `None` if there is none.
pub(super) fn layout(ui: &Ui, model: &OverlayModel) -> Option<(CanvasText, Rect)> {
    let caption = model.caption.as_ref().filter(|_| !model.is_aligning)?;
    let style = TextStyle { size: SIZE, most_width: MOST_WIDTH * caption.free.width(), align: Align::Center };
    let text = CanvasText::new(ui, &model.regions, &[(&caption.text, Color32::WHITE)], &style)?;
    let area = place(text.size(), caption.free);
    Some((text, area))
}

pub(super) fn draw(ui: &Ui, model: &OverlayModel, laid_out: Option<&(CanvasText, Rect)>) {
    if let (Some(caption), Some((text, area))) = (&model.caption, laid_out) {
        text.draw(ui, &model.regions, *area, caption.opacity);
    }
}

/// The box of a caption in the middle of the lower edge of a free part of the canvas.
fn place(size: Vec2, free: Rect) -> Rect {
    let bottom = (free.max.y - MARGIN).max(size.y);
    Rect::from_min_size(pos2(free.center().x - size.x / 2.0, bottom - size.y), size)
}
