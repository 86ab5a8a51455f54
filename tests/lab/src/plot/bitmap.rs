//! The PNG's backend, with letters at their places.

use ab_glyph::{Font, FontRef, ScaleFont, point};
use plotters::prelude::BitMapBackend;
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingBackend, DrawingErrorKind,
    text_anchor::{HPos, VPos},
};

/// Plotters' bitmap, whose own letters run together: it leaves out the room at a letter's left, and puts each on a whole
/// pixel.
pub(super) struct Bitmap<'a> {
    pixels: BitMapBackend<'a>,
    font: FontRef<'static>,
}

impl<'a> Bitmap<'a> {
    /// Three bytes a pixel, for `size` columns and rows.
    pub(super) fn new(rgb: &'a mut [u8], size: (u32, u32), font: FontRef<'static>) -> Self {
        Self { pixels: BitMapBackend::with_buffer(rgb, size), font }
    }
}

type Drawn<'a> = Result<(), DrawingErrorKind<<BitMapBackend<'a> as DrawingBackend>::ErrorType>>;

impl<'a> DrawingBackend for Bitmap<'a> {
    type ErrorType = <BitMapBackend<'a> as DrawingBackend>::ErrorType;

    fn get_size(&self) -> (u32, u32) {
        self.pixels.get_size()
    }

    fn ensure_prepared(&mut self) -> Drawn<'a> {
        self.pixels.ensure_prepared()
    }

    fn present(&mut self) -> Drawn<'a> {
        self.pixels.present()
    }

    fn draw_pixel(&mut self, at: BackendCoord, color: BackendColor) -> Drawn<'a> {
        self.pixels.draw_pixel(at, color)
    }

    fn draw_line<S: BackendStyle>(&mut self, from: BackendCoord, to: BackendCoord, style: &S) -> Drawn<'a> {
        self.pixels.draw_line(from, to, style)
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        upper_left: BackendCoord,
        lower_right: BackendCoord,
        style: &S,
        is_filled: bool,
    ) -> Drawn<'a> {
        self.pixels.draw_rect(upper_left, lower_right, style, is_filled)
    }

    fn draw_text<T: BackendTextStyle>(&mut self, text: &str, style: &T, at: BackendCoord) -> Drawn<'a> {
        let layout = style.layout_box(text).map_err(|error| DrawingErrorKind::FontError(Box::new(error)))?;
        let ((left, top), (right, bottom)) = layout;
        let (width, height) = (right - left, bottom - top);
        let anchor = style.anchor();
        let x = match anchor.h_pos {
            HPos::Left => 0,
            HPos::Center => -width / 2,
            HPos::Right => -width,
        };
        let y = match anchor.v_pos {
            VPos::Top => 0,
            VPos::Center => -height / 2,
            VPos::Bottom => -height,
        };
        // Where plotters has the baseline in charts of SVG, too.
        let baseline = y as f32 + style.size() as f32 / 2.0;
        for (letter_x, letter_y, coverage) in self.covered(text, style.size() as f32, [x as f32, baseline]) {
            let (turned_x, turned_y) = style.transform().transform(letter_x, letter_y);
            let color = style.color();
            let color = BackendColor { alpha: color.alpha * f64::from(coverage), ..color };
            self.draw_pixel((at.0 + turned_x, at.1 + turned_y), color)?;
        }
        Ok(())
    }
}

impl Bitmap<'_> {
    /// The pixels of a line of text, and how much of each its letters cover.
    fn covered(&self, text: &str, size: f32, [mut x, baseline]: [f32; 2]) -> Vec<(i32, i32, f32)> {
        let font = self.font.as_scaled(size);
        let mut covered = Vec::new();
        let mut previous = None;
        for letter in text.chars() {
            let id = font.glyph_id(letter);
            x += previous.replace(id).map_or(0.0, |previous| font.kern(previous, id));
            let glyph = id.with_scale_and_position(size, point(x, baseline));
            if let Some(outline) = font.outline_glyph(glyph) {
                let min = outline.px_bounds().min;
                outline.draw(|column, row, coverage| {
                    covered.push((min.x as i32 + column as i32, min.y as i32 + row as i32, coverage.min(1.0)));
                });
            }
            x += font.h_advance(id);
        }
        covered
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_stand_apart() {
        let mut rgb = vec![255; 3 * 200 * 40];
        let font = FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT).unwrap();
        let bitmap = Bitmap::new(&mut rgb, (200, 40), font);
        for text in ["10 Gbit", "Mill"] {
            let n_letters = text.chars().filter(|letter| *letter != ' ').count();
            let mut columns: Vec<i32> = bitmap
                .covered(text, 26.0, [0.0, 20.0])
                .into_iter()
                .filter_map(|(x, _, coverage)| (coverage > 0.5).then_some(x))
                .collect();
            columns.sort_unstable();
            columns.dedup();
            let n_runs = 1 + columns.windows(2).filter(|pair| pair[1] > pair[0] + 1).count();
            assert_eq!(n_runs, n_letters, "{text}: {columns:?}");
        }
    }
}
