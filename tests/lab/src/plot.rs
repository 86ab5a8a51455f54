//! Draws charts: [`Figure`] as scatter plots in SVG and PNG, [`LineChart`] as lines over the number of nodes in SVG.

mod figure;
mod labels;
mod lines;

use std::sync::Once;

use plotters::{
    prelude::*,
    style::{FontStyle, register_font},
};

pub use self::{
    figure::{Axis, Figure, Plot, Point, Series, power, significant, whole_decades},
    lines::{Line, LineChart, write_line_charts},
};

const FONT: &str = "sans-serif";

/// Letters, axes and lines.
const INK: RGBColor = RGBColor(40, 44, 52);

/// Okabe and Ito's colours, which colour-blind people can tell apart.
pub const COLORS: [RGBColor; 7] = [
    RGBColor(213, 94, 0),
    RGBColor(204, 121, 167),
    RGBColor(0, 114, 178),
    RGBColor(0, 158, 115),
    RGBColor(86, 60, 20),
    RGBColor(178, 132, 0),
    RGBColor(70, 150, 200),
];

/// Bounds and notes.
pub const GREY: RGBColor = RGBColor(110, 110, 110);

/// The colour of other ray tracers.
pub const PEER_COLOR: RGBColor = RGBColor(90, 90, 90);

type DrawResult = Result<(), Box<dyn std::error::Error>>;

/// Registers the font; to be called before anything is drawn.
fn register_fonts() {
    static REGISTERED: Once = Once::new();
    REGISTERED.call_once(|| {
        // The built-in bytes are a valid font.
        let _ = register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT);
    });
}

/// Letters of `size` pixels.
fn style(size: i32) -> TextStyle<'static> {
    (FONT, size).into_font().color(&INK)
}
