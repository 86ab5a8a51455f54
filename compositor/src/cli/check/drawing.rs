//! The wall as an SVG drawing: its projectors on the canvas, and their pixels in the spanning output.

use glam::DVec2;

use crate::wall::{Flip, Gamma, Projector, Wall, homography::UNIT_SQUARE, outline};

/// Width of the canvas in the drawing's units: pixels, unless the drawing is scaled.
const WIDTH: f64 = 1400.0;
/// Space around the canvas, and between the two parts of the drawing.
const MARGIN: f64 = 70.0;
/// A wall that is higher than this is drawn narrower.
const HEIGHT: f64 = 900.0;
/// The lower part, of the pixels, is smaller.
const PIXELS_WIDTH: f64 = 700.0;
const PIXELS_HEIGHT: f64 = 450.0;

const INK: &str = "#1b1b1f";
const FAINT: &str = "#6f7178";

/// The wall as an SVG file's text, under a title.
pub(super) fn draw(wall: &Wall, title: &str) -> String {
    let [width_m, height_m] = wall.canvas_m();
    let px_per_m = (WIDTH / width_m).min(HEIGHT / height_m);
    let canvas_px = DVec2::new(width_m, height_m) * px_per_m;
    let [columns, rows] = wall.output_size().map(f64::from);
    let px_per_pixel = (PIXELS_WIDTH / columns).min(PIXELS_HEIGHT / rows);
    let pixels_top = 2.0 * MARGIN + canvas_px.y + MARGIN;
    let (full_width, full_height) = (WIDTH + 2.0 * MARGIN, pixels_top + rows * px_per_pixel + MARGIN);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{full_width:.0}\" height=\"{full_height:.0}\" \
         viewBox=\"0 0 {full_width:.1} {full_height:.1}\" font-family=\"sans-serif\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
    );
    text(&mut svg, DVec2::new(MARGIN, MARGIN * 0.7), 22.0, "start", INK, title);

    // The canvas and its projectors, upper-left corner first.
    let origin = DVec2::new(MARGIN + (WIDTH - canvas_px.x) / 2.0, 1.6 * MARGIN);
    let on_canvas = |from_top: DVec2| origin + from_top * canvas_px;
    let frame = format!("fill=\"#f2f2f0\" stroke=\"{FAINT}\" stroke-width=\"1\" stroke-dasharray=\"6 4\"");
    polygon(&mut svg, &UNIT_SQUARE.map(|corner| on_canvas(DVec2::new(corner.x, 1.0 - corner.y))), &frame);
    let below = on_canvas(DVec2::new(0.5, 1.0)) + DVec2::new(0.0, 26.0);
    text(&mut svg, below, 16.0, "middle", FAINT, &format!("the canvas: {width_m} m × {height_m} m"));
    for (index, projector) in wall.projectors().iter().enumerate() {
        // Translucent, so that overlaps are darker.
        let fill = format!("fill=\"{}\" fill-opacity=\"0.38\" stroke=\"{INK}\" stroke-width=\"1.2\"", color(index));
        polygon(&mut svg, &UNIT_SQUARE.map(|corner| on_canvas(projector.canvas.drawing_from_rect(corner))), &fill);
    }
    for (index, projector) in wall.projectors().iter().enumerate() {
        label(&mut svg, index, projector, &|rect_point| on_canvas(projector.canvas.drawing_from_rect(rect_point)));
    }

    // The same projectors in the spanning output.
    let below = DVec2::new(MARGIN + WIDTH / 2.0, pixels_top - 18.0);
    text(
        &mut svg,
        below,
        16.0,
        "middle",
        FAINT,
        &format!("its pixels: {columns} × {rows} in the picture of all outputs"),
    );
    let origin = DVec2::new(MARGIN + (WIDTH - columns * px_per_pixel) / 2.0, pixels_top);
    for (index, projector) in wall.projectors().iter().enumerate() {
        let output = projector.output;
        let (at, size) = (origin + output.origin() * px_per_pixel, output.size() * px_per_pixel);
        let fill = format!("fill=\"{}\" fill-opacity=\"0.38\" stroke=\"{INK}\" stroke-width=\"0.8\"", color(index));
        polygon(&mut svg, &UNIT_SQUARE.map(|corner| at + corner * size), &fill);
        let monitor = projector.monitor.as_ref().map(|monitor| format!(" {monitor}")).unwrap_or_default();
        let number = format!("{}{monitor}", index + 1);
        text(&mut svg, at + size / 2.0 + DVec2::new(0.0, 5.0), font_size(&number, size, 18.0), "middle", INK, &number);
    }
    svg + "</svg>\n"
}

/// Name, number, pixels and special settings of a projector, a mark at its first pixel, and for a warped projector the
/// outline of its pixels.
fn label(svg: &mut String, index: usize, projector: &Projector, in_drawing: &dyn Fn(DVec2) -> DVec2) {
    let (upper_left, lower_right) = (in_drawing(DVec2::ZERO), in_drawing(DVec2::ONE));
    let size = lower_right - upper_left;
    if let Some(outline) = projector.outline_in_rect() {
        let outline: Vec<DVec2> = outline.into_iter().map(in_drawing).collect();
        if projector.is_warped() {
            let dashes = "fill=\"none\" stroke=\"#c22f2f\" stroke-width=\"1\" stroke-dasharray=\"3 3\"";
            polygon(svg, &outline, dashes);
        }
        // A small triangle in the corner of the first pixel, its long leg along the first row.
        let corner = |index: usize| outline[index * outline.len() / 4];
        let (first, right, down) = (corner(0), corner(1), corner(3));
        let leg = 0.07 * size.min_element();
        let mark = [
            first,
            first + (right - first).normalize_or_zero() * 2.0 * leg,
            first + (down - first).normalize_or_zero() * leg,
        ];
        polygon(svg, &mark, &format!("fill=\"{INK}\" fill-opacity=\"0.75\""));
    }
    let centre = (upper_left + lower_right) / 2.0;
    let name_size = font_size(&projector.name, size, 24.0);
    text(svg, centre - DVec2::new(0.0, 0.3 * name_size), name_size, "middle", INK, &projector.name);
    for (line, details) in details(index, projector).iter().enumerate() {
        let at = centre + DVec2::new(0.0, (0.75 + 0.8 * line as f64) * name_size);
        text(svg, at, font_size(details, size, 0.62 * name_size), "middle", FAINT, details);
    }
}

fn details(index: usize, projector: &Projector) -> Vec<String> {
    let Projector { output, rotation, flip, warp_px, mesh, gamma, black_level, gain, monitor, .. } = projector;
    let mut lines = vec![format!("{}: {} × {} pixels", index + 1, output.width, output.height)];
    let mut special = Vec::new(); // settings that are not the default
    special.extend(monitor.clone());
    if rotation.degrees() != 0 {
        special.push(format!("turned {}°", rotation.degrees()));
    }
    match flip {
        Flip::None => {}
        Flip::Horizontal => special.push("mirrored".to_owned()),
        Flip::Vertical => special.push("top down".to_owned()),
    }
    if *warp_px != [[0.0; 2]; 4] {
        special.push("warped".to_owned());
    }
    if let Some(mesh) = mesh {
        special.push(format!("mesh {}", mesh.file()));
    }
    if let Gamma::Power(exponent) = gamma {
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

/// A font size at which a text fits into a box with some space around it, at most `largest`.
fn font_size(text: &str, box_size: DVec2, largest: f64) -> f64 {
    outline::font_size(text, DVec2::new(0.9 * box_size.x, box_size.y / 4.5)).min(largest)
}

/// Neighbours differ, and black text is legible on all of them.
fn color(index: usize) -> &'static str {
    ["#7fb2e5", "#f2c14e", "#8fd19e", "#e59bb4", "#b8a1e0"][index % 5]
}

fn polygon(svg: &mut String, corners: &[DVec2], attributes: &str) {
    let points: String = corners.iter().map(|corner| format!("{:.2},{:.2} ", corner.x, corner.y)).collect();
    *svg += &format!("<polygon points=\"{points}\" {attributes}/>\n");
}

fn text(svg: &mut String, at: DVec2, size: f64, anchor: &str, color: &str, text: &str) {
    let escaped = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    // XML has no control characters.
    let escaped: String = escaped.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    *svg += &format!(
        "<text x=\"{:.1}\" y=\"{:.1}\" font-size=\"{size:.1}\" text-anchor=\"{anchor}\" fill=\"{color}\">{escaped}</text>\n",
        at.x, at.y
    );
}
