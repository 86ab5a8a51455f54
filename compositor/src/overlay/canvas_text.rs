//! Text that lies on the canvas: every window shows its part of it, through projectors that may be turned and warped.

use std::sync::Arc;

use egui::{
    Align, Color32, FontId, Galley, LayerId, Mesh, Pos2, Rect, Shape, Ui, Vec2,
    epaint::{Vertex, WHITE_UV},
    pos2,
    text::{LayoutJob, TextFormat},
    vec2,
};

use super::region::ProjectorRegion;

/// A text with a box around it, laid out in the resolution of the first projector of a window.
///
/// Places are fractions of the canvas, whose upper-left corner is (0, 0) and whose lower-right corner is (1, 1).
pub(super) struct CanvasText {
    galley: Arc<Galley>,
    /// Points of the window for the canvas's width and height.
    points_per_canvas: Vec2,
    /// Around the text, in points.
    padding: Vec2,
}

/// How a text is laid out.
pub(super) struct TextStyle {
    /// The height of letters, as a fraction of the canvas's height.
    pub size: f32,
    /// The widest box, as a fraction of the canvas's width.
    pub most_width: f32,
    pub align: Align,
}

impl CanvasText {
    /// Smaller letters are hard to read; points.
    pub(super) const SMALLEST: f32 = 12.0;

    /// Lays out paragraphs, each with its colour; `None` if the window shows no part of the canvas.
    pub(super) fn new(
        ui: &Ui,
        regions: &[ProjectorRegion],
        paragraphs: &[(&str, Color32)],
        style: &TextStyle,
    ) -> Option<Self> {
        let points_per_canvas = regions.first()?.points_per_canvas()?;
        let font_size = (style.size * points_per_canvas.y).max(Self::SMALLEST);
        let padding = vec2(0.6, 0.3) * font_size;
        let mut job = LayoutJob { halign: style.align, ..LayoutJob::default() };
        job.wrap.max_width = (style.most_width * points_per_canvas.x - 2.0 * padding.x).max(font_size);
        for (index, &(text, color)) in paragraphs.iter().enumerate() {
            let format = TextFormat::simple(FontId::proportional(font_size), color);
            let line_end = if index > 0 { "\n" } else { "" };
            job.append(&format!("{line_end}{text}"), 0.0, format);
        }
        let galley = ui.fonts_mut(|fonts| fonts.layout_job(job));
        Some(Self { galley, points_per_canvas, padding })
    }

    /// The size of its box.
    pub(super) fn size(&self) -> Vec2 {
        (self.galley.rect.size() + 2.0 * self.padding) / self.points_per_canvas
    }

    /// Draws it below all panels, in a box of its size. Lay out all texts before: that may change the texture of letters.
    pub(super) fn draw(&self, ui: &Ui, regions: &[ProjectorRegion], area: Rect, opacity: f32) {
        #[expect(clippy::redundant_closure_for_method_calls, reason = "the method alone has one lifetime, not any")]
        let texels = ui.fonts(|fonts| fonts.font_image_size()).map(|side| side as f32);
        let mut mesh = Mesh::default();
        let color = Color32::from_black_alpha(170).gamma_multiply(opacity);
        for pos in [area.left_top(), area.right_top(), area.left_bottom(), area.right_bottom()] {
            mesh.vertices.push(Vertex { pos, uv: WHITE_UV, color });
        }
        mesh.add_triangle(0, 1, 2);
        mesh.add_triangle(1, 2, 3);
        let corner = area.min + self.padding / self.points_per_canvas;
        for row in &self.galley.rows {
            let first = mesh.vertices.len() as u32;
            let letters = &row.visuals.mesh;
            mesh.indices.extend(letters.indices.iter().map(|index| first + index));
            mesh.vertices.extend(letters.vertices.iter().map(|letter| {
                let in_galley = row.pos + letter.pos.to_vec2() - self.galley.rect.min;
                let uv = pos2(letter.uv.x / texels[0], letter.uv.y / texels[1]);
                Vertex {
                    pos: corner + in_galley / self.points_per_canvas,
                    uv,
                    color: letter.color.gamma_multiply(opacity),
                }
            }));
        }
        let painter = ui.ctx().layer_painter(LayerId::background());
        let pixels_per_point = ui.ctx().pixels_per_point();
        for region in regions.iter().filter(|region| region.canvas.intersects(area)) {
            // Whole pixels keep letters crisp.
            let Some(at) = region.place(corner) else { continue };
            let snapped = (at.to_vec2() * pixels_per_point).round() / pixels_per_point - at.to_vec2();
            let place = |pos: Pos2| region.place(pos).map(|pos| pos + snapped);
            let Some(vertices) = mesh.vertices.iter().map(|it| Some(Vertex { pos: place(it.pos)?, ..*it })).collect()
            else {
                continue;
            };
            let shown = Mesh { vertices, indices: mesh.indices.clone(), ..Mesh::default() };
            painter.with_clip_rect(region.window).add(Shape::Mesh(Arc::new(shown)));
        }
    }
}
