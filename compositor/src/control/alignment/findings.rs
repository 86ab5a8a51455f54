//! A calibration's findings, drawn on the canvas: to be looked at on the wall, or in a file.

use glam::DVec2;
use shared::{division::FrameSize, printable::printable_line};

use super::sheet::Sheet;
use crate::{
    calibration::Finding,
    gpu::RgbImage,
    wall::{PixelRect, Projector, Wall, homography::apply},
};

/// A picture of all of the canvas.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CanvasPicture {
    pub size: FrameSize,
    /// RGBA, four bytes a sample, bottom row first, as in frames.
    pub rgba: Vec<u8>,
}

/// The drawing on one projector.
struct Field {
    color: [u8; 3],
    /// The first is large.
    lines: Vec<String>,
    /// From points of its pixels to others.
    arrows: Vec<[DVec2; 2]>,
}

/// The longer side of the picture.
const SIDE: f64 = 1920.0;
/// Fields are this dark, so that white letters are read on them.
const TINT: f64 = 0.45;
/// Misses of this many pixels of a projector, at the median, are as bad as allowed: the same as in a verdict.
const WORST_PX: f64 = 0.3;
/// The arrows of projectors that fit are this long at most, as a part of their picture's longer side.
const ARROW: f64 = 0.06;
const WHITE: [u8; 3] = [255; 3];
const LINES: [u8; 3] = [150; 3];
const GOOD: [f64; 3] = [30.0, 190.0, 80.0];
const FAIR: [f64; 3] = [235.0, 190.0, 40.0];
const BAD: [f64; 3] = [235.0, 50.0, 40.0];
const UNSEEN: [u8; 3] = [70, 70, 80];

impl CanvasPicture {
    /// Each projector with the distances of its points from their places, in its pixels, and arrows to where they are seen;
    /// `notes` go below. The canvas's lines show whether neighbours coincide.
    pub(crate) fn of_findings(wall: &Wall, findings: &[Finding], notes: &[String]) -> Self {
        let farthest = findings.iter().filter_map(|it| it.fit).map(|fit| fit.p95_px).fold(0.01, f64::max);
        let side = wall.projectors().iter().map(|it| it.output.size().max_element()).fold(f64::INFINITY, f64::min);
        // A round number: 1, 2 or 5 with zeros.
        let exact = ARROW * side / farthest;
        let decade = 10.0_f64.powf(exact.max(1.0).log10().floor());
        let factor = [5.0, 2.0, 1.0].into_iter().map(|it| it * decade).find(|it| *it <= exact).unwrap_or(1.0);
        let field = |(index, projector): (usize, &Projector)| {
            let finding = findings.get(index).cloned().unwrap_or_default();
            let name = printable_line(&projector.name);
            let Some(fit) = finding.fit else {
                return Field { color: UNSEEN, lines: vec!["not found".to_owned(), name], arrows: Vec::new() };
            };
            let badness = if finding.has_fault { 1.0 } else { (fit.median_px / WORST_PX).min(1.0) };
            let mut lines = vec![
                format!("{:.2} px", fit.median_px),
                name,
                format!("95 % within {:.2} px", fit.p95_px),
                format!("{:.0} % seen, {} photos", 100.0 * finding.covered, fit.n_shots),
            ];
            lines.extend(finding.moved_px.map(|moved| format!("corners move {moved:.1} px")));
            let arrows = finding.misses.iter().map(|[px, by]| [*px, *px + *by * factor]).collect();
            Field { color: graded(badness), lines, arrows }
        };
        let fields = wall.projectors().iter().enumerate().map(field).collect::<Vec<_>>();
        let has_arrows = fields.iter().any(|field| !field.arrows.is_empty());
        let mut notes = notes.to_vec();
        if has_arrows {
            notes.insert(0, format!("arrows show misses {factor:.0} times as long"));
        }
        Self::draw(wall, &fields, &notes)
    }

    /// Each projector with the number of photographs that show it; `notes` go below.
    pub(crate) fn of_progress(wall: &Wall, n_photos: &[usize], notes: &[String]) -> Self {
        let field = |(index, projector): (usize, &Projector)| {
            let n = n_photos.get(index).copied().unwrap_or(0);
            let lines = vec![n.to_string(), printable_line(&projector.name), "photographs show it".to_owned()];
            Field { color: if n == 0 { UNSEEN } else { graded(0.0) }, lines, arrows: Vec::new() }
        };
        Self::draw(wall, &wall.projectors().iter().enumerate().map(field).collect::<Vec<_>>(), notes)
    }

    fn draw(wall: &Wall, fields: &[Field], notes: &[String]) -> Self {
        let canvas_m = DVec2::from(wall.canvas_m());
        let size_px = (canvas_m * SIDE / canvas_m.max_element()).round().max(DVec2::splat(16.0));
        let (width, height) = (size_px.x as u32, size_px.y as u32);
        let mut sheet = Sheet::new(PixelRect { x: 0, y: 0, width, height });
        // Where rectangles overlap, colours are mixed.
        let mut sums = vec![([0_u32; 3], 0_u32); width as usize * height as usize];
        for (projector, field) in wall.projectors().iter().zip(fields) {
            let rect = rect_px(projector, size_px);
            for y in rect.y..(rect.y + rect.height).min(height) {
                for x in rect.x..(rect.x + rect.width).min(width) {
                    let (sum, n) = &mut sums[y as usize * width as usize + x as usize];
                    *sum = std::array::from_fn(|channel| sum[channel] + u32::from(field.color[channel]));
                    *n += 1;
                }
            }
        }
        sheet.each_pixel(sheet.clip, |x, y| {
            let (sum, n) = sums[y as usize * width as usize + x as usize];
            sum.map(|sum| (TINT * f64::from(sum) / f64::from(n.max(1))) as u8)
        });
        let step_px = size_px.min_element() / 8.0;
        for axis in [0, 1] {
            let n_lines = (size_px[axis] / 2.0 / step_px).floor() as i32;
            for n in -n_lines..=n_lines {
                let at = size_px[axis] / 2.0 + f64::from(n) * step_px;
                let end = |along: f64| if axis == 0 { DVec2::new(at, along) } else { DVec2::new(along, at) };
                sheet.line(end(0.0), end(size_px[1 - axis]), 1.5, LINES);
            }
        }
        for (projector, field) in wall.projectors().iter().zip(fields) {
            sheet.frame(rect_px(projector, size_px), 2, LINES);
            for arrow in &field.arrows {
                draw_arrow(&mut sheet, projector, *arrow, size_px);
            }
        }
        for (projector, field) in wall.projectors().iter().zip(fields) {
            draw_lines(&mut sheet, rect_px(projector, size_px), &field.lines);
        }
        draw_notes(&mut sheet, size_px, notes);
        let size = FrameSize::new(width, height).unwrap_or(FrameSize::ONE);
        Self { size, rgba: sheet.pixels.into_flattened() }
    }

    /// The picture as files have it.
    pub(crate) fn image(&self) -> RgbImage {
        let [width, height] = [self.size.xres(), self.size.yres()];
        let rows = self.rgba.chunks_exact(4 * width as usize).rev();
        RgbImage {
            size: [width, height],
            rgb: rows.flat_map(|row| row.chunks_exact(4).flat_map(|px| [px[0], px[1], px[2]])).collect(),
        }
    }
}

/// From good, 0, over fair to bad, 1.
fn graded(badness: f64) -> [u8; 3] {
    let (from, to, part) =
        if badness < 0.5 { (GOOD, FAIR, 2.0 * badness) } else { (FAIR, BAD, 2.0 * badness.min(1.0) - 1.0) };
    std::array::from_fn(|channel| (from[channel] + (to[channel] - from[channel]) * part) as u8)
}

/// A projector's rectangle of the canvas in pixels of the picture, from the top.
fn rect_px(projector: &Projector, size_px: DVec2) -> PixelRect {
    let rect = projector.canvas;
    let from = (DVec2::new(rect.left, 1.0 - rect.bottom - rect.height) * size_px).round().max(DVec2::ZERO);
    let to = (DVec2::new(rect.left + rect.width, 1.0 - rect.bottom) * size_px).round().min(size_px).max(from);
    let [x, y, width, height] = [from.x, from.y, to.x - from.x, to.y - from.y].map(|it| it as u32);
    PixelRect { x, y, width, height }
}

/// The place in the picture that a projector's pixel shows.
fn place(projector: &Projector, px: DVec2, size_px: DVec2) -> Option<DVec2> {
    let image = apply(projector.raster_from_image()?.inverse(), px / projector.output.size())?;
    let canvas = projector.canvas.canvas_from_rect(projector.rect_at(image));
    Some(DVec2::new(canvas.x, 1.0 - canvas.y) * size_px).filter(|at| at.is_finite())
}

fn draw_arrow(sheet: &mut Sheet, projector: &Projector, [from, to]: [DVec2; 2], size_px: DVec2) {
    let [Some(from), Some(to)] = [from, to].map(|px| place(projector, px, size_px)) else { return };
    sheet.line(from, to, 1.5, WHITE);
    sheet.square(from, 5.0, WHITE);
}

/// Lines in the middle of a projector's rectangle.
fn draw_lines(sheet: &mut Sheet, rect: PixelRect, lines: &[String]) {
    let n_letters = lines.iter().map(|line| line.chars().count()).max().unwrap_or(1).max(12) as f64;
    let size = (f64::from(rect.width) / (0.8 * n_letters)).min(f64::from(rect.height) / 12.0).max(8.0);
    // Above the middle, where notes hide nothing.
    let mut at = rect.origin() + rect.size() * DVec2::new(0.5, 0.35) - DVec2::new(0.0, 0.5 * size * lines.len() as f64);
    for (index, line) in lines.iter().enumerate() {
        let size = if index == 0 { 1.8 * size } else { size };
        sheet.text(at, size, WHITE, line);
        at.y += 1.15 * size;
    }
}

/// Lines on black at the bottom; long ones are set smaller.
fn draw_notes(sheet: &mut Sheet, size_px: DVec2, notes: &[String]) {
    let height = (size_px.y / 28.0).clamp(10.0, 32.0);
    let top = size_px.y - 1.2 * height * notes.len() as f64;
    let [y, width] = [top.max(0.0) as u32, size_px.x as u32];
    sheet.fill(PixelRect { x: 0, y, width, height: size_px.y as u32 - y }, [0; 3]);
    for (index, note) in notes.iter().enumerate() {
        let note = printable_line(note);
        let fitting = size_px.x / (0.48 * note.chars().count().max(1) as f64);
        let at = DVec2::new(size_px.x / 2.0, top + 1.2 * height * (index as f64 + 0.5));
        sheet.text(at, height.min(fitting).max(6.0), WHITE, &note);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::solve::Fit;

    fn wall() -> Wall {
        let text = "canvas_m = [2.0, 1.0]\n[grid]\ncolumns = 2\nrows = 1\npixels = [400, 400]\noverlap = [0.1, 0.0]\n";
        Wall::from_toml("ours", text).expect("a wall")
    }

    /// The colour most frequent near a place of the picture, from the upper left, between lines and letters.
    fn color_at(picture: &CanvasPicture, part: DVec2) -> [u8; 3] {
        let image = picture.image();
        let at = part * DVec2::new(f64::from(image.size[0]), f64::from(image.size[1]));
        image.pixel(at.x as u32, at.y as u32)
    }

    #[test]
    fn projectors_are_tinted_by_how_well_they_fit() {
        let fit = Fit { n_points: 100, n_shots: 2, n_crossings: 90, median_px: 0.02, p95_px: 0.05 };
        let good = Finding { fit: Some(fit), covered: 0.9, ..Finding::default() };
        let bad = Finding { has_fault: true, ..good.clone() };
        let picture = CanvasPicture::of_findings(&wall(), &[good.clone(), bad], &["a note".to_owned()]);
        let ([left, right], middle) = ([0.04, 0.96].map(|x| color_at(&picture, DVec2::new(x, 0.05))), 0.5);
        assert!(left[1] > 2 * left[0] && right[0] > 2 * right[1], "{left:?} {right:?}");
        // The overlap has both colours.
        let both = color_at(&picture, DVec2::new(middle + 0.02, 0.05));
        assert!(both[0] > left[0] && both[1] > right[1], "{both:?}");
        let unfound = CanvasPicture::of_findings(&wall(), &[good, Finding::default()], &[]);
        assert_eq!(color_at(&unfound, DVec2::new(0.96, 0.05)), UNSEEN.map(|it| (TINT * f64::from(it)) as u8));
    }

    #[test]
    fn misses_are_arrows_and_progress_counts_photographs() {
        let fit = Fit { n_points: 100, n_shots: 2, n_crossings: 90, median_px: 0.02, p95_px: 0.05 };
        let with = |by: DVec2| {
            let misses = vec![[DVec2::new(60.0, 330.0), by]];
            let finding = Finding { fit: Some(fit), covered: 0.9, misses, ..Finding::default() };
            CanvasPicture::of_findings(&wall(), &[finding.clone(), Finding { misses: Vec::new(), ..finding }], &[])
        };
        assert_ne!(with(DVec2::new(0.05, 0.0)), with(DVec2::new(0.0, 0.05)));
        let progress = CanvasPicture::of_progress(&wall(), &[3, 0], &[]);
        assert_ne!(color_at(&progress, DVec2::new(0.04, 0.05)), color_at(&progress, DVec2::new(0.96, 0.05)));
    }
}
