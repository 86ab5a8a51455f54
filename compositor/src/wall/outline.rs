//! The layout that all drawings of a wall share: outlines of projectors, and the size of their labels.

use glam::DVec2;

use super::{CanvasRect, Wall};

/// A projector, or a screen, in a drawing of the wall.
#[derive(Clone, Debug, PartialEq)]
pub struct Outline {
    /// Its name.
    pub name: String,
    /// Its part of the canvas.
    pub canvas: CanvasRect,
    /// Its output's index in [`Wall::monitors`]; 0 if projectors name no monitors.
    pub output_idx: usize,
}

impl Outline {
    /// The outlines of all projectors, in the order of [`Wall::projectors`].
    pub fn all(wall: &Wall) -> impl Iterator<Item = Self> {
        let monitors = wall.monitors();
        wall.projectors().iter().map(move |projector| Self {
            name: projector.name.clone(),
            canvas: projector.canvas,
            output_idx: (monitors.iter().position(|(name, _)| Some(*name) == projector.monitor.as_deref()))
                .unwrap_or(0),
        })
    }
}

/// The largest font size at which a text fits into a box of this width and height.
pub fn font_size(text: &str, box_size: DVec2) -> f64 {
    // Letters are a little more than half as wide as high.
    (box_size.x / (0.58 * text.chars().count().max(1) as f64)).min(box_size.y)
}
