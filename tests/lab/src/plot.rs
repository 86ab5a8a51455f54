//! Draws plots, as SVG and PNG.

mod figure;
mod labels;

pub use self::figure::{
    Axis, COLORS, FONT, Figure, INK, PEER_COLOR, Plot, Point, Series, power, register_fonts, significant, style,
    whole_decades,
};
