//! One projector: its part of the canvas, its pixels, and its light.

use std::sync::Arc;

use glam::{DMat3, DVec2};
use serde::{Deserialize, Serialize};

use super::{
    fall_off::FallOff,
    homography::{UNIT_SQUARE, apply, square_to_quad},
    mesh::Mesh,
};

/// One projector of the wall, or one screen.
#[derive(Clone, Debug, PartialEq)]
pub struct Projector {
    /// Its name, on the wall, in messages, and in the wall file.
    pub name: String,
    /// The window system's name of its monitor; all projectors have one, or none has.
    pub monitor: Option<String>,
    /// The part of the canvas that it lights.
    pub canvas: CanvasRect,
    /// Its pixels in the spanning output.
    pub output: PixelRect,
    /// Its clockwise rotation, seen from the audience.
    pub rotation: Rotation,
    /// Its mirroring, which comes before the rotation.
    pub flip: Flip,
    /// The offset of its image's corners from those of its pixels: upper left, upper right, lower right, lower left, each to
    /// the right and down in pixels, as seen on the wall.
    pub warp_px: [[f64; 2]; 4],
    /// Where its image lies on a canvas that is not flat; `None` if it fills the part of the canvas evenly. `warp_px` then
    /// moves the image's corners on top.
    pub mesh: Option<Arc<Mesh>>,
    /// Its light curve.
    pub gamma: Gamma,
    /// The light that it gives for black, as a part of white.
    pub black_level: f64,
    /// Factors that dim its red, green and blue to match the dimmest projector.
    pub gain: [f64; 3],
    /// The fall-off of its light; `None` if it is even. Black level and gain are those at its darkest point.
    pub fall_off: Option<FallOff>,
}

/// Quarter turns clockwise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rotation {
    /// Upright.
    #[default]
    None,
    /// Its upper edge is on the right.
    Right,
    /// Upside down, as a projector that hangs from the ceiling.
    Half,
    /// Its upper edge is on the left.
    Left,
}

/// Mirroring.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Flip {
    /// None.
    #[default]
    None,
    /// Left and right are exchanged, as in projection from behind.
    Horizontal,
    /// Top and bottom are exchanged.
    Vertical,
}

/// The light for a value v from 0 to 1, without the black level.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(try_from = "toml::Value", into = "toml::Value")]
pub enum Gamma {
    /// The curve of sRGB.
    #[default]
    Srgb,
    /// v to this power.
    Power(f64),
}

/// A rectangle of the canvas, whose lower-left corner is (0, 0) and whose upper-right corner is (1, 1).
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(missing_docs, reason = "the fields' names say it")]
pub struct CanvasRect {
    pub left: f64,
    pub bottom: f64,
    pub width: f64,
    pub height: f64,
}

/// A rectangle of pixels, from the upper-left corner of an image or a window: left and upper edge, columns and rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "said above")]
pub struct PixelRect {
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

impl Projector {
    /// An upright projector without corrections.
    pub fn plain(name: String, canvas: CanvasRect, output: PixelRect) -> Self {
        Self {
            name,
            monitor: None,
            canvas,
            output,
            rotation: Rotation::None,
            flip: Flip::None,
            warp_px: [[0.0; 2]; 4],
            mesh: None,
            gamma: Gamma::Srgb,
            black_level: 0.0,
            gain: [1.0; 3],
            fall_off: None,
        }
    }

    /// The same projector with a mesh; its part of the canvas is then the mesh's.
    pub fn with_mesh(self, mesh: Arc<Mesh>) -> Self {
        Self { canvas: mesh.bounds(), mesh: Some(mesh), ..self }
    }

    /// Whether its pixels are the canvas's rows and columns.
    pub fn is_upright(&self) -> bool {
        self.rotation == Rotation::None && self.flip == Flip::None && !self.is_warped()
    }

    /// Whether corners or a mesh move its image.
    pub fn is_warped(&self) -> bool {
        self.warp_px != [[0.0; 2]; 4] || self.mesh.is_some()
    }

    /// Columns and rows as seen on the wall.
    pub fn upright_size(&self) -> [u32; 2] {
        let PixelRect { width, height, .. } = self.output;
        if matches!(self.rotation, Rotation::Right | Rotation::Left) { [height, width] } else { [width, height] }
    }

    /// From its image to its pixels. The image runs from (0, 0) upper left to (1, 1) lower right as seen on the wall, the
    /// pixels from (0, 0) upper left to (1, 1) lower right as stored. Without a mesh, the image is its rectangle of the
    /// canvas.
    ///
    /// `None` if the warped corners are crossed, folded, or mirrored.
    pub fn raster_from_image(&self) -> Option<DMat3> {
        Some(self.raster_from_upright() * self.upright_from_image()?)
    }

    /// The same to its pixels as seen on the wall.
    pub fn upright_from_image(&self) -> Option<DMat3> {
        let upright_px = DVec2::from(self.upright_size().map(f64::from));
        let corner = |index: usize| UNIT_SQUARE[index] + DVec2::from(self.warp_px[index]) / upright_px;
        square_to_quad([corner(0), corner(1), corner(2), corner(3)])
    }

    /// The point of its image at a point of its rectangle.
    pub fn image_at(&self, rect_point: DVec2) -> DVec2 {
        self.mesh.as_ref().map_or(rect_point, |mesh| mesh.image_at(self.canvas.canvas_from_rect(rect_point)))
    }

    /// The point of its rectangle at a point of its image.
    pub fn rect_at(&self, image: DVec2) -> DVec2 {
        self.mesh.as_ref().map_or(image, |mesh| self.canvas.rect_from_canvas(mesh.canvas_at(image)))
    }

    /// From pixels as seen on the wall to pixels as stored, both from (0, 0) to (1, 1).
    pub(crate) fn raster_from_upright(&self) -> DMat3 {
        let affine = |x: [f64; 2], y: [f64; 2], origin: [f64; 2]| {
            DMat3::from_cols(DVec2::from(x).extend(0.0), DVec2::from(y).extend(0.0), DVec2::from(origin).extend(1.0))
        };
        let unturned = match self.rotation {
            Rotation::None => DMat3::IDENTITY,
            Rotation::Right => affine([0.0, -1.0], [1.0, 0.0], [0.0, 1.0]),
            Rotation::Half => affine([-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]),
            Rotation::Left => affine([0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]),
        };
        let unflipped = match self.flip {
            Flip::None => DMat3::IDENTITY,
            Flip::Horizontal => affine([-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]),
            Flip::Vertical => affine([1.0, 0.0], [0.0, -1.0], [0.0, 1.0]),
        };
        unflipped * unturned
    }

    /// The corners of its pixels, in units of its image; `None` if one is at or behind the horizon.
    pub fn raster_corners_in_image(&self) -> Option<[DVec2; 4]> {
        let image_from_raster = self.raster_from_image()?.inverse();
        let corners = UNIT_SQUARE.map(|corner| apply(image_from_raster, corner));
        let [Some(a), Some(b), Some(c), Some(d)] = corners else { return None };
        Some([a, b, c, d])
    }

    /// The outline of its pixels, from the first one's corner, in units of its rectangle; four corners, or more if a mesh
    /// bends the edges. `None` as for [`Projector::raster_corners_in_image`].
    pub fn outline_in_rect(&self) -> Option<Vec<DVec2>> {
        let corners = self.raster_corners_in_image()?;
        let n_steps = if self.mesh.is_some() { 16 } else { 1 };
        let on_edge = |n: usize| {
            let (from, to) = (corners[n / n_steps], corners[(n / n_steps + 1) % 4]);
            self.rect_at(from.lerp(to, (n % n_steps) as f64 / n_steps as f64))
        };
        Some((0..4 * n_steps).map(on_edge).collect())
    }

    /// Columns and rows of its pixels to a width and a height of the canvas, where they are densest.
    pub(super) fn density(&self) -> [f64; 2] {
        let [columns, rows] = self.upright_size();
        match &self.mesh {
            Some(mesh) => mesh.density([columns, rows]),
            None => [f64::from(columns) / self.canvas.width, f64::from(rows) / self.canvas.height],
        }
    }
}

impl Rotation {
    /// From clockwise degrees; `None` unless they are quarter turns.
    pub fn from_degrees(degrees: u32) -> Option<Self> {
        [Self::None, Self::Right, Self::Half, Self::Left].into_iter().find(|rotation| rotation.degrees() == degrees)
    }

    /// Clockwise degrees.
    pub fn degrees(self) -> u32 {
        90 * self as u32
    }
}

impl CanvasRect {
    /// A point of the canvas in units of this rectangle, whose upper-left corner is (0, 0), lower-right corner (1, 1).
    pub fn rect_from_canvas(&self, point: DVec2) -> DVec2 {
        DVec2::new((point.x - self.left) / self.width, 1.0 - (point.y - self.bottom) / self.height)
    }

    /// The point of the canvas at a point in units of this rectangle.
    pub fn canvas_from_rect(&self, rect_point: DVec2) -> DVec2 {
        DVec2::new(self.left + rect_point.x * self.width, self.bottom + (1.0 - rect_point.y) * self.height)
    }

    /// The same point in drawings: (0, 0) is the canvas's upper-left corner, (1, 1) its lower-right corner.
    pub fn drawing_from_rect(&self, rect_point: DVec2) -> DVec2 {
        let point = self.canvas_from_rect(rect_point);
        DVec2::new(point.x, 1.0 - point.y)
    }
}

impl PixelRect {
    /// The largest rectangle with the aspect ratio of `content` in an image of size `target`, centred.
    ///
    /// Sides and margins are whole pixels; a side is at least one pixel unless the target has none.
    pub fn fitted(content: [u32; 2], target: [u32; 2]) -> Self {
        let [content_width, content_height] = content.map(|side| u64::from(side.max(1)));
        let [target_width, target_height] = target.map(u64::from);
        let rounded = |numerator: u64, denominator: u64| (numerator + denominator / 2) / denominator;
        let (width, height) = if target_width * content_height <= target_height * content_width {
            let height = rounded(target_width * content_height, content_width);
            (target_width, height.clamp(1, target_height.max(1)).min(target_height))
        } else {
            let width = rounded(target_height * content_width, content_height);
            (width.clamp(1, target_width.max(1)).min(target_width), target_height)
        };
        let [x, y] = [(target_width - width) / 2, (target_height - height) / 2];
        // All fit into u32, as the target's sides do.
        let [x, y, width, height] = [x, y, width, height].map(|side| side as u32);
        Self { x, y, width, height }
    }

    /// The upper-left corner in pixels.
    pub fn origin(&self) -> DVec2 {
        DVec2::new(f64::from(self.x), f64::from(self.y))
    }

    /// Columns and rows.
    pub fn size(&self) -> DVec2 {
        DVec2::new(f64::from(self.width), f64::from(self.height))
    }

    /// Whether the two share a pixel.
    pub fn overlaps(&self, other: &Self) -> bool {
        let meet = |a: u32, a_extent: u32, b: u32, b_extent: u32| a.max(b) < (a + a_extent).min(b + b_extent);
        meet(self.x, self.width, other.x, other.width) && meet(self.y, self.height, other.y, other.height)
    }

    /// The smallest rectangle that contains both.
    pub fn union(&self, other: &Self) -> Self {
        let [x, y] = [self.x.min(other.x), self.y.min(other.y)];
        let right = (self.x + self.width).max(other.x + other.width);
        let bottom = (self.y + self.height).max(other.y + other.height);
        Self { x, y, width: right - x, height: bottom - y }
    }

    /// Whether a point, in pixels, lies in it.
    pub fn contains(&self, point: DVec2) -> bool {
        (0.0..f64::from(self.width)).contains(&(point.x - f64::from(self.x)))
            && (0.0..f64::from(self.height)).contains(&(point.y - f64::from(self.y)))
    }

    /// Its point, edges included, that is nearest to another point.
    pub fn nearest(&self, point: DVec2) -> DVec2 {
        point.clamp(self.origin(), self.origin() + self.size())
    }

    /// Whether all of `other` lies in it.
    pub fn contains_rect(&self, other: &Self) -> bool {
        let within = |a: u32, a_extent: u32, b: u32, b_extent: u32| a <= b && b + b_extent <= a + a_extent;
        within(self.x, self.width, other.x, other.width) && within(self.y, self.height, other.y, other.height)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn turned_and_flipped_projectors_have_their_corners_where_people_see_them() {
        let check = |degrees: u32, flip: Flip, expected: [[f64; 2]; 4]| {
            let rect = CanvasRect { left: 0.0, bottom: 0.0, width: 1.0, height: 1.0 };
            let output = PixelRect { x: 0, y: 0, width: 40, height: 30 };
            let rotation = Rotation::from_degrees(degrees).expect("a quarter turn");
            assert_eq!(rotation.degrees(), degrees);
            let projector = Projector { rotation, flip, ..Projector::plain("a".into(), rect, output) };
            // The pixels' upper-left, upper-right, lower-right and lower-left corners as seen on the wall.
            let seen = projector.raster_corners_in_image().expect("no warp");
            assert_eq!(seen.map(|corner| corner.to_array()), expected, "{degrees} {flip:?}");
        };
        check(0, Flip::None, [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]);
        check(90, Flip::None, [[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]);
        check(180, Flip::None, [[1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [1.0, 0.0]]);
        check(270, Flip::None, [[0.0, 1.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]);
        check(0, Flip::Horizontal, [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0], [1.0, 1.0]]);
        check(0, Flip::Vertical, [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]);
        // Mirrored first: its upper-left pixel goes to the upper right, and the rotation takes it to the lower right.
        check(90, Flip::Horizontal, [[1.0, 1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]);
    }

    #[test]
    fn a_wall_is_fitted_whole_centred_and_never_empty() {
        let fitted = |content, target| {
            let PixelRect { x, y, width, height } = PixelRect::fitted(content, target);
            (x, y, width, height)
        };
        assert_eq!(fitted([4096, 2304], [4096, 2304]), (0, 0, 4096, 2304));
        assert_eq!(fitted([4096, 2304], [1024, 768]), (0, 96, 1024, 576));
        assert_eq!(fitted([4096, 2304], [2000, 720]), (360, 0, 1280, 720));
        assert_eq!(fitted([4096, 2304], [1, 1]), (0, 0, 1, 1));
        assert_eq!(fitted([4096, 2304], [1, 700]), (0, 349, 1, 1));
        assert_eq!(fitted([16384, 1], [100, 100]), (0, 49, 100, 1));
        assert_eq!(fitted([4096, 2304], [0, 0]), (0, 0, 0, 0));
        assert_eq!(fitted([1, 1], [u32::MAX, 7]), (2_147_483_644, 0, 7, 7));
    }

    proptest! {
        #[test]
        fn a_fitted_wall_lies_in_its_target_and_touches_two_edges(
            content in any::<[u32; 2]>(), target in prop::array::uniform2(1_u32..100_000),
        ) {
            let PixelRect { x, y, width, height } = PixelRect::fitted(content, target);
            prop_assert!(width >= 1 && height >= 1);
            prop_assert!(x + width <= target[0] && y + height <= target[1]);
            prop_assert!(width == target[0] || height == target[1]);
        }
    }
}
