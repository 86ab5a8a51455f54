//! Where panels are in a window: the one place that decides it, so that no panel lies over another.

use egui::{Align2, Rect};

use super::style::PANEL_PADDING;

/// The contents of a panel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Figures,
    /// The model, and the wall.
    Model,
    Help,
    Files,
    /// An annotation that is being written.
    Draft,
}

/// A panel: as high as its parts, unless the window is lower and they scroll.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Panel {
    /// From top to bottom.
    pub parts: Vec<Part>,
    /// Where it is in the window's room.
    pub align: Align2,
    /// The width of its content in points.
    pub width: f32,
}

/// The panels in a window, in points.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Layout {
    /// The window without its margins, and without a legend that has no place beside panels.
    pub room: Rect,
    pub panels: Vec<Panel>,
    /// The room that panels leave, for messages; all of it if they leave too little.
    pub free: Rect,
}

/// Space around and between panels in points.
const MARGIN: f32 = 16.0;
/// Messages need this width in points.
const LEAST_FREE: f32 = 160.0;

impl Part {
    /// The width of its content in points, where there is room.
    fn width(self) -> f32 {
        match self {
            Self::Figures => 394.0,
            Self::Model => 310.0,
            Self::Help => 880.0,
            Self::Files | Self::Draft => 420.0,
        }
    }
}

impl Layout {
    /// Arranges parts in a window: a `dialog` stands alone in the middle; figures and model stand on both sides, or in a
    /// narrow window below each other. `legend`: the height in points of a legend, which has its place below panels where
    /// there is none beside them.
    pub(super) fn new(window: Rect, dialog: Option<Part>, sides: &[Part], legend: Option<f32>) -> Self {
        let mut room = window.shrink(MARGIN.min(window.width().min(window.height()) / 4.0));
        let outer = |part: &Part| (part.width() + 2.0 * PANEL_PADDING).min(room.width());
        let panel = |parts: &[Part], align| {
            let width = parts.iter().map(outer).fold(0.0, f32::max) - 2.0 * PANEL_PADDING;
            Panel { parts: parts.to_vec(), align, width: width.max(1.0) }
        };
        let is_wide = sides.iter().map(|part| outer(part) + MARGIN).sum::<f32>() + LEAST_FREE <= room.width();
        let panels = match (dialog, sides) {
            (Some(dialog), _) => vec![panel(&[dialog], Align2::CENTER_TOP)],
            (None, [left, right]) if is_wide => {
                vec![panel(&[*left], Align2::LEFT_TOP), panel(&[*right], Align2::RIGHT_TOP)]
            }
            (None, []) => Vec::new(),
            (None, parts) => vec![panel(parts, Align2::LEFT_TOP)],
        };
        let mut free = room;
        for Panel { align, width, .. } in &panels {
            let taken = width + 2.0 * PANEL_PADDING + MARGIN;
            match *align {
                Align2::LEFT_TOP => free.min.x += taken,
                Align2::RIGHT_TOP => free.max.x -= taken,
                _ => {}
            }
        }
        if free.width() < LEAST_FREE {
            free = room;
            if let Some(height) = legend {
                let edge = room.max.y - height.min(room.height() / 2.0);
                (free.min.y, room.max.y) = (edge, (edge - MARGIN).max(room.min.y));
            }
        }
        Self { room, panels, free }
    }
}

#[cfg(test)]
mod tests {
    use egui::{pos2, vec2};

    use super::*;

    const SIDES: [Part; 2] = [Part::Figures, Part::Model];

    fn layout(width: f32, dialog: Option<Part>) -> Layout {
        Layout::new(Rect::from_min_size(pos2(0.0, 0.0), vec2(width, 600.0)), dialog, &SIDES, None)
    }

    #[test]
    fn figures_and_model_share_a_panel_where_there_is_no_room_for_two() {
        let wide = layout(1100.0, None);
        assert_eq!(wide.panels.len(), 2);
        assert_eq!(wide.panels.iter().map(|panel| &*panel.parts).collect::<Vec<_>>(), [&SIDES[..1], &SIDES[1..]]);
        for width in [900.0, 700.0, 330.0, 60.0] {
            let narrow = layout(width, None);
            let [panel] = &*narrow.panels else { panic!("{narrow:?}") };
            assert_eq!(panel.parts, SIDES);
            assert!(
                panel.width + 2.0 * PANEL_PADDING <= narrow.room.width().max(2.0 * PANEL_PADDING + 1.0),
                "{narrow:?}"
            );
        }
    }

    #[test]
    fn a_dialog_stands_alone_in_the_middle() {
        let help = layout(1600.0, Some(Part::Help));
        let [panel] = &*help.panels else { panic!("{help:?}") };
        assert_eq!((&*panel.parts, panel.align), (&[Part::Help][..], Align2::CENTER_TOP));
    }

    #[test]
    fn messages_have_what_panels_leave_or_the_window() {
        assert_eq!(layout(1600.0, None).free.x_range(), egui::Rangef::new(454.0, 1230.0));
        assert_eq!(layout(500.0, None).free, layout(500.0, None).room);
        assert_eq!(layout(711.0, None).free.x_range(), egui::Rangef::new(454.0, 695.0), "beside one panel");
    }
}
