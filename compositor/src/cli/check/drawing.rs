//! The wall as a drawing: what lies where on the canvas, and where its pixels come from.

use std::fmt::Write;

use glam::DVec2;

use crate::wall::{Projector, Wall, homography::UNIT_SQUARE};

/// Width of what is drawn, in the drawing's own units: pixels, unless it is scaled.
const WIDTH: f64 = 1400.0;
/// Space around it, and between its two parts.
const MARGIN: f64 = 70.0;
/// A wall that is higher than this is drawn narrower.
const HEIGHT: f64 = 900.0;
/// The part below, of the pixels, is smaller.
const PIXELS_WIDTH: f64 = 700.0;
const PIXELS_HEIGHT: f64 = 450.0;

const INK: &str = "#1b1b1f";
const FAINT: &str = "#6f7178";

/// The wall as an SVG file's text, under a title.
pub(super) fn draw(wall: &Wall, title: &str) -> String {
    let mut svg = String::new();
    // Writing to a string cannot fail.
    let _ = draw_to(&mut svg, wall, title);
    svg
}

fn draw_to(svg: &mut String, wall: &Wall, title: &str) -> std::fmt::Result {
    let [width_m, height_m] = wall.canvas_m();
    let px_per_m = (WIDTH / width_m).min(HEIGHT / height_m);
    let canvas_px = DVec2::new(width_m, height_m) * px_per_m;
    let [columns, rows] = wall.output_size().map(f64::from);
    let px_per_pixel = (PIXELS_WIDTH / columns).min(PIXELS_HEIGHT / rows);
    let pixels_top = 2.0 * MARGIN + canvas_px.y + MARGIN;
    let (full_width, full_height) = (WIDTH + 2.0 * MARGIN, pixels_top + rows * px_per_pixel + MARGIN);
    writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{full_width:.0}\" height=\"{full_height:.0}\" \
         viewBox=\"0 0 {full_width:.1} {full_height:.1}\" font-family=\"sans-serif\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>"
    )?;
    text(svg, DVec2::new(MARGIN, MARGIN * 0.7), 22.0, "start", INK, title)?;

    // The canvas, upper-left corner first.
    let origin = DVec2::new(MARGIN + (WIDTH - canvas_px.x) / 2.0, 1.6 * MARGIN);
    let on_wall = |point: DVec2| origin + DVec2::new(point.x, 1.0 - point.y) * canvas_px;
    let frame = format!("fill=\"#f2f2f0\" stroke=\"{FAINT}\" stroke-width=\"1\" stroke-dasharray=\"6 4\"");
    polygon(svg, &UNIT_SQUARE.map(on_wall), &frame)?;
    let below = on_wall(DVec2::new(0.5, 0.0)) + DVec2::new(0.0, 26.0);
    text(svg, below, 16.0, "middle", FAINT, &format!("the canvas: {width_m} m × {height_m} m"))?;
    for (index, projector) in wall.projectors().iter().enumerate() {
        let canvas = projector.canvas;
        let place = UNIT_SQUARE.map(|corner| on_wall(canvas.canvas_from_rect(corner)));
        // Where several lie over each other the colours add up, and overlaps are seen.
        let fill = format!("fill=\"{}\" fill-opacity=\"0.38\" stroke=\"{INK}\" stroke-width=\"1.2\"", colour(index));
        polygon(svg, &place, &fill)?;
    }
    for (index, projector) in wall.projectors().iter().enumerate() {
        let on_wall = |place: DVec2| on_wall(projector.canvas.canvas_from_rect(place));
        label(svg, wall, index, &on_wall)?;
    }

    let below = DVec2::new(MARGIN + WIDTH / 2.0, pixels_top - 18.0);
    text(svg, below, 16.0, "middle", FAINT, &format!("its pixels: {columns} × {rows} in the picture of all outputs"))?;
    let origin = DVec2::new(MARGIN + (WIDTH - columns * px_per_pixel) / 2.0, pixels_top);
    for (index, projector) in wall.projectors().iter().enumerate() {
        let output = projector.output;
        let at = origin + DVec2::new(f64::from(output.x), f64::from(output.y)) * px_per_pixel;
        let size = DVec2::new(f64::from(output.width), f64::from(output.height)) * px_per_pixel;
        let fill = format!("fill=\"{}\" fill-opacity=\"0.38\" stroke=\"{INK}\" stroke-width=\"0.8\"", colour(index));
        polygon(svg, &UNIT_SQUARE.map(|corner| at + corner * size), &fill)?;
        let monitor = projector.monitor.as_ref().map(|monitor| format!(" {monitor}")).unwrap_or_default();
        let number = format!("{}{monitor}", index + 1);
        text(svg, at + size / 2.0 + DVec2::new(0.0, 5.0), font_size(&number, size, 18.0), "middle", INK, &number)?;
    }
    writeln!(svg, "</svg>")
}

/// Name, number, pixels and peculiarities of a projector, a mark where its upper-left pixel is, and the outline of its
/// pixels where that is not the outline of its place.
fn label(svg: &mut String, wall: &Wall, index: usize, on_wall: &dyn Fn(DVec2) -> DVec2) -> std::fmt::Result {
    let projector = &wall.projectors()[index];
    let (upper_left, lower_right) = (on_wall(DVec2::ZERO), on_wall(DVec2::ONE));
    let size = lower_right - upper_left;
    if let Some(corners) = projector.raster_corners_in_rect() {
        let corners = corners.map(on_wall);
        if projector.warp_px != [[0.0; 2]; 4] {
            let dashes = "fill=\"none\" stroke=\"#c22f2f\" stroke-width=\"1\" stroke-dasharray=\"3 3\"";
            polygon(svg, &corners, dashes)?;
        }
        // A small triangle in the corner of the first pixel, its long leg along the first row.
        let [first, right, _, down] = corners;
        let leg = 0.07 * size.min_element();
        let mark = [
            first,
            first + (right - first).normalize_or_zero() * 2.0 * leg,
            first + (down - first).normalize_or_zero() * leg,
        ];
        polygon(svg, &mark, &format!("fill=\"{INK}\" fill-opacity=\"0.75\""))?;
    }
    let centre = (upper_left + lower_right) / 2.0;
    let name_size = font_size(&projector.name, size, 24.0);
    text(svg, centre - DVec2::new(0.0, 0.3 * name_size), name_size, "middle", INK, &projector.name)?;
    for (line, details) in details(index, projector).iter().enumerate() {
        let at = centre + DVec2::new(0.0, (0.75 + 0.8 * line as f64) * name_size);
        text(svg, at, font_size(details, size, 0.62 * name_size), "middle", FAINT, details)?;
    }
    Ok(())
}

fn details(index: usize, projector: &Projector) -> Vec<String> {
    let Projector { output, rotation, flip, warp_px, gamma, black_level, gain, monitor, .. } = projector;
    let mut lines = vec![format!("{}: {} × {} pixels", index + 1, output.width, output.height)];
    let mut special = Vec::new();
    special.extend(monitor.clone());
    if rotation.degrees() != 0 {
        special.push(format!("turned {}°", rotation.degrees()));
    }
    match flip {
        crate::wall::Flip::None => {}
        crate::wall::Flip::Horizontal => special.push("mirrored".to_owned()),
        crate::wall::Flip::Vertical => special.push("top down".to_owned()),
    }
    if *warp_px != [[0.0; 2]; 4] {
        special.push("warped".to_owned());
    }
    if let crate::wall::Gamma::Power(exponent) = gamma {
        special.push(format!("gamma {exponent}"));
    }
    if *black_level > 0.0 {
        special.push(format!("black {black_level}"));
    }
    if *gain != [1.0; 3] {
        special.push(format!("gain {} {} {}", gain[0], gain[1], gain[2]));
    }
    lines.extend(special.chunks(3).map(|some| some.join(", ")));
    lines
}

/// A size in which a text fits into a box, at most `largest`.
fn font_size(text: &str, box_size: DVec2, largest: f64) -> f64 {
    // Letters are a little more than half as wide as high.
    (0.9 * box_size.x / (0.58 * text.chars().count().max(1) as f64)).min(box_size.y / 4.5).min(largest)
}

/// Neighbours differ, and black text can be read on all.
fn colour(index: usize) -> &'static str {
    ["#7fb2e5", "#f2c14e", "#8fd19e", "#e59bb4", "#b8a1e0"][index % 5]
}

fn polygon(svg: &mut String, corners: &[DVec2], attributes: &str) -> std::fmt::Result {
    write!(svg, "<polygon points=\"")?;
    for corner in corners {
        write!(svg, "{:.2},{:.2} ", corner.x, corner.y)?;
    }
    writeln!(svg, "\" {attributes}/>")
}

fn text(svg: &mut String, at: DVec2, size: f64, anchor: &str, colour: &str, text: &str) -> std::fmt::Result {
    let escaped = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    // What XML does not know, control characters above all, no drawing can hold.
    let escaped: String = escaped.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    writeln!(
        svg,
        "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size:.1}\" text-anchor=\"{anchor}\" fill=\"{colour}\">{escaped}</text>",
        at.x, at.y
    )
}
