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
    /// The part of the canvas where it may lie, its upper-left corner (0, 0).
    free: Rect,
}

impl Caption {
    /// A caption in a `free` part of the canvas, of which messages or a code have covered some parts: beside them, or above
    /// those that leave too little beside them.
    pub(crate) fn new(text: &str, opacity: f32, free: Rect, covered: &[Rect]) -> Self {
        let mut room = free;
        for part in covered {
            let band = Rect::from_min_max(pos2(room.min.x, room.max.y - BAND), room.max);
            if !part.intersects(band) {
                continue;
            }
            let (left, right) = (part.min.x - room.min.x, room.max.x - part.max.x);
            if left.max(right) < 0.5 * free.width() {
                room.max.y = part.min.y;
            } else if left > right {
                room.max.x = part.min.x;
            } else {
                room.min.x = part.max.x;
            }
        }
        // Above everything there may be nothing left.
        let free = if room.height() > BAND { room } else { free };
        Self { text: text.to_owned(), opacity, free }
    }
}

/// Letters, as a fraction of the canvas's height.
const SIZE: f32 = 0.032;
/// The widest box, as a fraction of the free part of the canvas.
const MOST_WIDTH: f32 = 0.8;
/// The height at the lower edge that captions usually take, as a fraction of the canvas's.
const BAND: f32 = 0.2;
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

#[cfg(test)]
mod tests {
    use super::*;

    fn room(covered: &[[f32; 4]]) -> [f32; 4] {
        let rect = |[left, top, right, bottom]: [f32; 4]| Rect::from_min_max(pos2(left, top), pos2(right, bottom));
        let covered: Vec<_> = covered.iter().copied().map(rect).collect();
        let Rect { min, max } = Caption::new("text", 1.0, rect([0.0, 0.0, 1.0, 1.0]), &covered).free;
        [min.x, min.y, max.x, max.y]
    }

    #[test]
    fn a_caption_lies_beside_a_code_and_above_messages() {
        assert_eq!(room(&[[0.0, 0.0, 1.0, 0.5]]), [0.0, 0.0, 1.0, 1.0], "far above it");
        assert_eq!(room(&[[0.75, 0.5, 1.0, 1.0]]), [0.0, 0.0, 0.75, 1.0]);
        assert_eq!(room(&[[0.0, 0.875, 0.25, 1.0]]), [0.25, 0.0, 1.0, 1.0]);
        assert_eq!(room(&[[0.25, 0.75, 0.75, 1.0]]), [0.0, 0.0, 1.0, 0.75]);
        assert_eq!(room(&[[0.0, 0.0, 1.0, 1.0]]), [0.0, 0.0, 1.0, 1.0], "nothing is free");
    }
}
