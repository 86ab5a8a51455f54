//! Test patterns: their images, and their uses.

use glam::DVec2;
use shared::{division::FrameSize, srgb};
use strum::VariantArray;

use super::sheet::Sheet;
use crate::wall::{
    PixelRect, Projector, Wall,
    homography::{UNIT_SQUARE, apply},
};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Corner {
    pub projector_idx: usize,
    /// 0 to 3: upper left, upper right, lower right, lower left, as seen on the wall.
    pub corner_idx: usize,
}

/// A test pattern, shown in place of frames; in the order in which a key steps through them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, strum::Display, strum::VariantArray)]
#[strum(serialize_all = "lowercase")]
pub(crate) enum Pattern {
    /// A grid of the canvas through each projector's warp, and the corners to drag. Projectors are not blended: in an
    /// overlap, the lines of both are visible, and coincide once the wall is aligned.
    Align,
    /// Each projector's name, number and pixels.
    Names,
    /// Checkerboards of single pixels at the corners, and a grid of every 32nd pixel, which reveal any scaling.
    Pixels,
    /// White through the blend weights, which ramp down in overlaps.
    Overlap,
    /// Black and white lines beside greys: they look alike at the number of the projector's gamma.
    Gamma,
    /// Fine lines and small text, for focusing.
    Focus,
}

/// The image of a test pattern on one output, for the present stage.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PatternImage {
    /// The output's part of the spanning output.
    pub output: PixelRect,
    /// Its samples.
    pub size: FrameSize,
    /// RGBA, four bytes a sample, bottom row first, as in frames.
    pub rgba: Vec<u8>,
    /// The wall to draw it with, and the part of that wall.
    pub wall: (Wall, PixelRect),
}

const WHITE: [u8; 3] = [255; 3];
const GREY: [u8; 3] = [120; 3];
const DIM: [u8; 3] = [45; 3];
const ORANGE: [u8; 3] = [255, 150, 30];

impl Pattern {
    /// Its use, in one line.
    pub(crate) fn help(self) -> &'static str {
        match self {
            Self::Align => {
                "drag a corner, or Tab and arrows (Shift: finer), until lines of neighbours meet; Backspace resets a \
                 corner (Shift: all), Ctrl+Z undoes, Ctrl+S saves"
            }
            Self::Names => "which projector is which; the triangle is at its first pixel",
            Self::Pixels => "the checkerboards must be even: if not, something scales the picture",
            Self::Overlap => "white must look even all over the wall: if not, look at gamma, then at gain",
            Self::Gamma => "from afar, the stripes look like the grey under the right gamma",
            Self::Focus => "lines and letters must be sharp in the middle and in the corners",
        }
    }

    /// The pattern after `current`; none after the last.
    pub(crate) fn next(current: Option<Self>) -> Option<Self> {
        Self::VARIANTS.get(current.map_or(0, |current| 1 + current as usize)).copied()
    }

    /// The images of the pattern, one for each output, unless one has more pixels than a frame may have samples.
    pub(crate) fn shown(self, wall: &Wall, selected: Option<Corner>) -> anyhow::Result<Vec<PatternImage>> {
        wall.output_parts().into_iter().map(|output| self.shown_on(output, wall, selected)).collect()
    }

    fn shown_on(self, output: PixelRect, wall: &Wall, selected: Option<Corner>) -> anyhow::Result<PatternImage> {
        if self == Self::Overlap {
            let rgba = vec![255; 4];
            return Ok(PatternImage { output, size: FrameSize::ONE, rgba, wall: (wall.clone(), output) });
        }
        let PixelRect { width, height, .. } = output;
        let too_large = |error| {
            anyhow::anyhow!(
                "no test pattern {self}: one output would have {width}×{height} pixels, {error}: name the output of each \
                 projector"
            )
        };
        let size = FrameSize::new(width, height).map_err(too_large)?;
        let mut sheet = Sheet::new(output);
        let on_output = |(_, projector): &(usize, &Projector)| output.contains_rect(&projector.output);
        for (index, projector) in wall.projectors().iter().enumerate().filter(on_output) {
            sheet.clip = projector.output;
            match self {
                Self::Align => align(&mut sheet, wall, index, selected.filter(|corner| corner.projector_idx == index)),
                Self::Names => names(&mut sheet, index, projector),
                Self::Pixels => pixels(&mut sheet, projector.output),
                Self::Gamma => gamma(&mut sheet, projector),
                Self::Focus => focus(&mut sheet, projector.output),
                Self::Overlap => {}
            }
        }
        Ok(PatternImage::of_output(output, size, sheet.pixels.into_flattened()))
    }
}

impl PatternImage {
    /// An image of `output`'s pixels, bottom row first.
    pub(crate) fn of_output(output: PixelRect, size: FrameSize, rgba: Vec<u8>) -> Self {
        let wall = Wall::of_one_output([output.width, output.height]);
        let part = wall.whole_output();
        Self { output, size, rgba, wall: (wall, part) }
    }
}

/// A point of a projector's rectangle (0 to 1) in pixels of the spanning output.
pub(super) fn to_output(projector: &Projector, rect_point: DVec2) -> Option<DVec2> {
    let image = projector.image_at(rect_point);
    // Far beyond a mesh there is no way back.
    let is_near = (image - 0.5).abs().max_element() < 1.0;
    on_output(projector, image).filter(|_| projector.mesh.is_none() || is_near)
}

/// A point of a projector's image (0 to 1) in pixels of the spanning output.
pub(super) fn on_output(projector: &Projector, image: DVec2) -> Option<DVec2> {
    let raster = apply(projector.raster_from_image()?, image)?;
    Some(projector.output.origin() + raster * projector.output.size())
}

fn align(sheet: &mut Sheet, wall: &Wall, index: usize, selected: Option<Corner>) {
    let projector = &wall.projectors()[index];
    let at = |rect_point: DVec2| to_output(projector, rect_point);
    // Lines bend with a mesh.
    let n_pieces = if projector.mesh.is_some() { 48 } else { 1 };
    let mut line = |from: DVec2, to: DVec2, thickness: f64, color: [u8; 3]| {
        let piece = |n: u32| from.lerp(to, f64::from(n) / f64::from(n_pieces));
        for n in 0..n_pieces {
            if let (Some(from), Some(to)) = (at(piece(n)), at(piece(n + 1))) {
                sheet.line(from, to, thickness, color);
            }
        }
    };
    // Lines of the canvas, the same for all projectors: spaced by an eighth of its shorter side, from the middle.
    let [width_m, height_m] = wall.canvas_m();
    let step_m = width_m.min(height_m) / 8.0;
    for (axis, side_m) in [width_m, height_m].into_iter().enumerate() {
        let n_lines = (side_m / 2.0 / step_m).floor() as i32;
        for n in -n_lines..=n_lines {
            let part = 0.5 + f64::from(n) * step_m / side_m;
            let [from, to] = if axis == 0 {
                [DVec2::new(part, 0.0), DVec2::new(part, 1.0)]
            } else {
                [DVec2::new(0.0, part), DVec2::new(1.0, part)]
            };
            if let Some((from, to)) =
                within_rect(projector.canvas.rect_from_canvas(from), projector.canvas.rect_from_canvas(to))
            {
                line(from, to, 2.0, if n == 0 { WHITE } else { GREY });
            }
        }
    }
    for corner in 0..4 {
        let ends = [corner, (corner + 1) % 4].map(|corner| on_output(projector, UNIT_SQUARE[corner]));
        if let [Some(from), Some(to)] = ends {
            sheet.line(from, to, 3.0, WHITE);
        }
    }
    for (corner_idx, corner) in UNIT_SQUARE.into_iter().enumerate() {
        let Some(position_px) = on_output(projector, corner) else { continue };
        let is_selected = selected.is_some_and(|selected| selected.corner_idx == corner_idx);
        let color = if is_selected { ORANGE } else { WHITE };
        sheet.square(position_px, if is_selected { 34.0 } else { 22.0 }, color);
    }
    let Some(centre) = on_output(projector, DVec2::splat(0.5)) else { return };
    let size = text_size(projector);
    sheet.text(centre, size, WHITE, &format!("{} {}", index + 1, projector.name));
    if let Some(Corner { corner_idx, .. }) = selected {
        let [x, y] = projector.warp_px[corner_idx];
        let corner = ["upper left", "upper right", "lower right", "lower left"][corner_idx];
        let below = centre + DVec2::new(0.0, 1.2 * size);
        sheet.text(below, 0.6 * size, ORANGE, &format!("{corner}: {x:+.2} right, {y:+.2} down"));
    }
}

/// The part of an axis-parallel line that lies within a projector's rectangle, in coordinates of the rectangle.
fn within_rect(from: DVec2, to: DVec2) -> Option<(DVec2, DVec2)> {
    let is_within = |a: f64, b: f64| a != b || (0.0..=1.0).contains(&a);
    let clamped = (from.clamp(DVec2::ZERO, DVec2::ONE), to.clamp(DVec2::ZERO, DVec2::ONE));
    (is_within(from.x, to.x) && is_within(from.y, to.y)).then_some(clamped)
}

fn names(sheet: &mut Sheet, index: usize, projector: &Projector) {
    let PixelRect { x, y, width, height } = projector.output;
    let (origin, size) = (projector.output.origin(), projector.output.size());
    sheet.frame(projector.output, 3, WHITE);
    // A triangle at the first pixel, with its longer leg along the first row.
    let leg = 0.12 * size.min_element();
    for n in 0..leg as u32 {
        let across = f64::from(n) + 0.5;
        sheet.line(origin + DVec2::new(0.0, across), origin + DVec2::new(2.0 * (leg - across), across), 1.0, ORANGE);
    }
    let centre = origin + size / 2.0;
    let text = text_size(projector);
    sheet.text(centre - DVec2::new(0.0, 1.5 * text), 2.2 * text, WHITE, &(index + 1).to_string());
    sheet.text(centre + DVec2::new(0.0, 0.4 * text), text, WHITE, &projector.name);
    let output = projector.monitor.as_ref().map(|monitor| format!("{monitor}, ")).unwrap_or_default();
    let pixels = format!("{output}{width} × {height} pixels at {x}, {y}");
    sheet.text(centre + DVec2::new(0.0, 1.5 * text), 0.6 * text, GREY, &pixels);
}

fn pixels(sheet: &mut Sheet, output: PixelRect) {
    let PixelRect { x, y, width, height } = output;
    for column in (0..width).step_by(32) {
        sheet.fill(PixelRect { x: x + column, width: 1, ..output }, DIM);
    }
    for row in (0..height).step_by(32) {
        sheet.fill(PixelRect { y: y + row, height: 1, ..output }, DIM);
    }
    for field in fields(output, 4) {
        sheet.each_pixel(field, |x, y| if (x + y) % 2 == 0 { WHITE } else { [0; 3] });
    }
    sheet.frame(output, 1, ORANGE);
}

/// Squares at the corners and in the middle of an output, with a side of 1 / `part` of its shorter side.
fn fields(output: PixelRect, part: u32) -> [PixelRect; 5] {
    let PixelRect { x, y, width, height } = output;
    let side = (width.min(height) / part).max(1);
    let [right, bottom] = [x + width - side.min(width), y + height - side.min(height)];
    let middle = [x + (width - side.min(width)) / 2, y + (height - side.min(height)) / 2];
    [[x, y], [right, y], [right, bottom], [x, bottom], middle].map(|[x, y]| PixelRect {
        x,
        y,
        width: side,
        height: side,
    })
}

fn gamma(sheet: &mut Sheet, projector: &Projector) {
    let output = projector.output;
    // From afar black and white lines give half of white's light, as does a grey that is encoded with the right gamma.
    sheet.each_pixel(output, |_, y| if y % 2 == 0 { WHITE } else { [0; 3] });
    let half_srgb = (f64::from(srgb::encode(0.5)), "srgb".to_owned());
    let half_of = |gamma: f64| (255.0 * 0.5_f64.powf(1.0 / gamma), format!("{gamma}"));
    let greys = [half_of(1.6), half_of(1.8), half_of(2.0), half_srgb, half_of(2.2), half_of(2.4), half_of(2.6)];
    let n_fields = greys.len() as u32;
    let [width, height] = [output.width / (2 * n_fields + 1), output.height / 3];
    for (n, (value, name)) in (0..).zip(greys) {
        let field = PixelRect { x: output.x + (2 * n + 1) * width, y: output.y + height, width, height };
        sheet.fill(field, [value.round() as u8; 3]);
        let size = field.size();
        let below = field.origin() + size * DVec2::new(0.5, 0.9);
        sheet.text(below, (0.45 * size.x).min(0.12 * size.y), [0; 3], &name);
    }
}

fn focus(sheet: &mut Sheet, output: PixelRect) {
    for field in fields(output, 5) {
        // Vertical lines left, horizontal lines right; one pixel wide above, two below.
        sheet.each_pixel(field, |column, row| {
            let along = if column - field.x < field.width / 2 { column } else { row };
            let thickness = if row - field.y < field.height / 2 { 1 } else { 2 };
            if along / thickness % 2 == 0 { WHITE } else { [0; 3] }
        });
    }
    for (n, size) in (0..).zip([8.0, 10.0, 13.0, 18.0]) {
        let at = output.origin() + output.size() * DVec2::new(0.5, 0.18 + 0.05 * f64::from(n));
        sheet.text(at, size, WHITE, "sphinx of black quartz, judge my vow 0123456789");
    }
    sheet.frame(output, 1, GREY);
}

/// The size of letters in pixels: readable from a distance, and narrow enough for the projector's name.
fn text_size(projector: &Projector) -> f64 {
    let PixelRect { width, height, .. } = projector.output;
    let n_letters = projector.name.chars().count().max(8) as f64 + 3.0;
    (f64::from(width) / (0.62 * n_letters)).min(f64::from(height) / 8.0).max(6.0)
}
