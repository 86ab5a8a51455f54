//! Where a window shows the canvas, through projectors that may be rotated, flipped and warped.

use std::sync::Arc;

use egui::{Color32, Mesh, Pos2, Rect, Shape, Vec2, epaint::Vertex, pos2, vec2};
use glam::{DMat3, DVec2};

use crate::wall::{CanvasRect, Projector, homography::apply, mesh};

/// A projector's part of the canvas, and where the window shows it.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ProjectorRegion {
    /// The part of the canvas, whose upper-left corner is (0, 0) and whose lower-right corner is (1, 1).
    pub canvas: Rect,
    /// Where the projector's pixels are in the window, in points.
    pub window: Rect,
    /// The mesh by which its image bends, if it has one.
    mesh: Option<Arc<mesh::Mesh>>,
    /// From its image to those pixels, both from (0, 0) upper left to (1, 1): [`Projector::raster_from_image`].
    raster_from_image: DMat3,
}

/// Cells a side of the mesh that bends with a warped projector.
const N_CELLS: u16 = 12;

impl ProjectorRegion {
    /// A projector's region; `window` is where its pixels are.
    pub(crate) fn new(projector: &Projector, window: Rect) -> Option<Self> {
        let (mesh, raster_from_image) = (projector.mesh.clone(), projector.raster_from_image()?);
        Some(Self { canvas: to_rect(&projector.canvas), window, mesh, raster_from_image })
    }

    /// The window position of a point of the canvas, (0, 0) upper left; `None` if the projector does not show it.
    pub(super) fn window_position(&self, point: Pos2) -> Option<Pos2> {
        let at = self.in_window((point - self.canvas.min) / self.canvas.size())?;
        (self.canvas.contains(point) && self.window.contains(at)).then_some(at)
    }

    /// The window position, perhaps beyond the projector's pixels, of a point of the canvas.
    pub(super) fn place(&self, point: Pos2) -> Option<Pos2> {
        self.in_window((point - self.canvas.min) / self.canvas.size())
    }

    /// The width and height of the whole canvas in the window's resolution, in points.
    pub(super) fn points_per_canvas(&self) -> Option<Vec2> {
        let [corner, right, below] = [vec2(0.0, 0.0), vec2(1.0, 0.0), vec2(0.0, 1.0)].map(|part| self.in_window(part));
        let corner = corner?;
        Some(vec2((right? - corner).length(), (below? - corner).length()) / self.canvas.size())
    }

    /// A texture that lies on the canvas, as the window shows it; `uv` maps a point of the canvas to the texture.
    pub(super) fn textured(&self, texture: egui::TextureId, color: Color32, uv: impl Fn(Pos2) -> Pos2) -> Shape {
        let mut mesh = Mesh::with_texture(texture);
        let steps = || (0..=N_CELLS).map(|step| f32::from(step) / f32::from(N_CELLS));
        for part in steps().flat_map(|y| steps().map(move |x| vec2(x, y))) {
            let Some(pos) = self.in_window(part) else { return Shape::Noop };
            mesh.vertices.push(Vertex { pos, uv: uv(self.canvas.lerp_inside(part)), color });
        }
        let row = u32::from(N_CELLS) + 1;
        for corner in (0..u32::from(N_CELLS)).flat_map(|y| (0..u32::from(N_CELLS)).map(move |x| y * row + x)) {
            mesh.add_triangle(corner, corner + 1, corner + row);
            mesh.add_triangle(corner + 1, corner + row, corner + row + 1);
        }
        Shape::Mesh(Arc::new(mesh))
    }

    /// The window position, or one beyond its edges, of a point of the part, from (0, 0) to (1, 1).
    fn in_window(&self, part: Vec2) -> Option<Pos2> {
        let part = DVec2::new(part.x.into(), part.y.into());
        let image = self.mesh.as_ref().map_or(part, |mesh| mesh.image_near(mesh.bounds().canvas_from_rect(part)));
        let raster = apply(self.raster_from_image, image)?;
        Some(self.window.min + vec2(raster.x as f32, raster.y as f32) * self.window.size())
    }
}

/// A part of the canvas, whose upper-left corner is (0, 0) and whose lower-right corner is (1, 1).
pub(crate) fn to_rect(canvas: &CanvasRect) -> Rect {
    let min = canvas.drawing_from_rect(DVec2::ZERO).as_vec2();
    Rect::from_min_size(pos2(min.x, min.y), vec2(canvas.width as f32, canvas.height as f32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wall::{PixelRect, Rotation};

    fn right_half() -> Projector {
        let canvas = CanvasRect { left: 0.5, bottom: 0.0, width: 0.5, height: 1.0 };
        Projector::plain("right".to_owned(), canvas, PixelRect { x: 0, y: 0, width: 40, height: 20 })
    }

    #[test]
    fn a_point_of_the_canvas_is_found_on_its_projector() {
        let window = Rect::from_min_size(pos2(100.0, 0.0), vec2(20.0, 1.0));
        let region = ProjectorRegion::new(&right_half(), window).expect("upright");
        assert_eq!(region.window_position(pos2(0.75, 0.5)), Some(pos2(110.0, 0.5)));
        assert_eq!(region.window_position(pos2(0.25, 0.5)), None);
    }

    #[test]
    fn a_turned_projector_shows_it_turned_and_a_warped_one_cuts_it() {
        let window = Rect::from_min_size(pos2(0.0, 0.0), vec2(40.0, 20.0));
        let turned = Projector { rotation: Rotation::Right, ..right_half() };
        let region = ProjectorRegion::new(&turned, window).expect("turned");
        // Its upper edge is on the right: the canvas's top is on the left of its image, the canvas's right on top.
        let at = region.window_position(pos2(0.975, 0.05)).expect("on the canvas");
        assert!((at - pos2(2.0, 1.0)).length() < 1e-4, "{at}");
        let Shape::Mesh(mesh) = region.textured(egui::TextureId::default(), Color32::WHITE, |point| point) else {
            panic!("a mesh")
        };
        let upper_right = mesh.vertices.iter().find(|vertex| vertex.uv == pos2(1.0, 0.0)).expect("a corner");
        assert_eq!(upper_right.pos, pos2(0.0, 0.0));

        let outwards = Projector { warp_px: [[-4.0, 0.0], [0.0; 2], [0.0; 2], [-4.0, 0.0]], ..right_half() };
        let region = ProjectorRegion::new(&outwards, window).expect("warped");
        assert_eq!(region.window_position(pos2(0.51, 0.5)), None, "left of its first pixel");
        assert!(region.window_position(pos2(0.6, 0.5)).is_some());
    }
}
