//! The view of a whole model, wherever nobody chose another: one function for the wall, its render servers and the
//! laboratory.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::{Camera, UpAxis};

/// All that a view of a whole model depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// The bounding box (min, max) in world space; `min > max` if the model is empty.
    pub bounds: (DVec3, DVec3),
    /// The model's points that stand out farthest in many directions, in world space.
    pub outline: Vec<DVec3>,
    /// The axis that seems to point up.
    pub up: UpAxis,
}

/// A rectangle of the canvas, in fractions of its width and height; (0, 0) is lower left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CanvasPart {
    /// The lower-left corner.
    pub min: DVec2,
    /// The upper-right corner.
    pub max: DVec2,
}

impl CanvasPart {
    /// All of the canvas.
    pub const WHOLE: Self = Self { min: DVec2::ZERO, max: DVec2::ONE };
}

/// Vertical field of view of [`Camera::view_all`], in radians: 40°, the angle of a wall at a comfortable distance.
const FOV_Y: f64 = 0.7;

/// The part of the free width or height that the model fills; the rest is a margin, wider than an outline is inexact.
const FILLED: f64 = 0.94;

impl Shape {
    /// A box with y up.
    pub fn of_box(min: DVec3, max: DVec3) -> Self {
        let corner =
            |index: u32| DVec3::select(glam::BVec3::new(index & 1 != 0, index & 2 != 0, index & 4 != 0), max, min);
        Self { bounds: (min, max), outline: (0..8).map(corner).collect(), up: UpAxis::Y }
    }

    /// The directions to the right, up and towards the eye of a view of the whole: from the front, a little from the right,
    /// and the flatter the model lies, the more from above.
    fn axes(&self, up: UpAxis) -> [DVec3; 3] {
        let up_direction = up.direction();
        let front = up.front();
        let side = up_direction.cross(front);
        let extent = self.bounds.1 - self.bounds.0;
        let axis = up_direction.abs();
        let width = (extent * (DVec3::ONE - axis)).max_element();
        let flatness = 1.0 - extent.dot(axis) / width;
        let above = if flatness.is_finite() { flatness.clamp(0.25, 0.8) } else { 0.25 };
        let towards_eye = (front + side * 0.35 + up_direction * above).normalize();
        let right = up_direction.cross(towards_eye).normalize();
        [right, towards_eye.cross(right), towards_eye]
    }
}

impl Camera {
    /// A camera that sees a whole model and fills a part of the canvas with it.
    ///
    /// `aspect` is the canvas's width over its height. A model that is empty or has no extent is viewed as a small cube.
    pub fn view_all(shape: &Shape, up: UpAxis, aspect: f64, part: CanvasPart) -> Self {
        let (min, max) = shape.bounds;
        let is_usable = min.cmple(max).all() && min.is_finite() && max.is_finite() && !shape.outline.is_empty();
        let (centre, half) = if is_usable { ((min + max) * 0.5, (max - min) * 0.5) } else { (DVec3::ZERO, DVec3::ONE) };
        // From nearer, rounding would move the eye by much of its distance.
        let least = (centre.abs().max_element() * f64::EPSILON * 4096.0).max(half.max_element() * 1e-3).max(1e-36);
        let [right, top, towards_eye] = shape.axes(up);
        let outline = if is_usable { &*shape.outline } else { &[DVec3::ONE, DVec3::NEG_ONE] };
        // Along one axis of the canvas: slopes of the rays at the part's edges, and how far the outline reaches across them.
        let tan_y = (FOV_Y * 0.5).tan();
        let fit = |tan: f64, across: DVec3, low: f64, high: f64| {
            let (middle, reach) = (low + high - 1.0, (high - low).max(0.05) * FILLED);
            let slopes = [middle - reach, middle + reach].map(|slope| slope * tan);
            let reaches = outline.iter().map(|&point| {
                let offset = point - centre;
                slopes.map(|slope| offset.dot(across) + slope * offset.dot(towards_eye))
            });
            let start = [f64::INFINITY, f64::NEG_INFINITY];
            let [lowest, highest] = reaches.fold(start, |[low, high], [a, b]| [low.min(a), high.max(b)]);
            Fit { slopes, reaches: [lowest - least, highest + least] }
        };
        let across = fit(tan_y * aspect, right, part.min.x, part.max.x);
        let upwards = fit(tan_y, top, part.min.y, part.max.y);
        let distance = across.distance().max(upwards.distance());
        let aside = right * across.aside(distance) + top * upwards.aside(distance);
        let target = centre + aside;
        Self::look_at(target + towards_eye * distance, target, up.direction(), FOV_Y, aspect)
            .unwrap_or_else(|_| Self::fallback_camera(aspect))
    }

    /// A camera at the origin, for boxes so far away that no `f32` ray reaches them.
    fn fallback_camera(aspect: f64) -> Self {
        let half_height = (FOV_Y * 0.5).tan();
        let u = DVec3::X * (2.0 * half_height * aspect);
        let v = DVec3::Y * (2.0 * half_height);
        Self { eye: DVec3::Z, ll: (u + v) * -0.5, u, v }
    }
}

/// How a model fits between two planes through the eye, one at each edge of its part of the canvas.
struct Fit {
    slopes: [f64; 2],
    /// The extreme of the model's points, across plus slope times towards the eye, for each slope.
    reaches: [f64; 2],
}

impl Fit {
    /// The least distance of the eye at which the model lies between the planes.
    fn distance(&self) -> f64 {
        (self.reaches[1] - self.reaches[0]) / (self.slopes[1] - self.slopes[0])
    }

    /// How far aside the eye must be, at that distance or a longer one, for equal margins.
    fn aside(&self, distance: f64) -> f64 {
        (self.reaches[0] + self.reaches[1] - distance * (self.slopes[0] + self.slopes[1])) * 0.5
    }
}

#[cfg(test)]
mod tests {
    use strum::VariantArray;

    use super::*;

    /// The rectangle that a model covers on the canvas.
    fn covered(camera: &Camera, shape: &Shape) -> CanvasPart {
        let points = shape.outline.iter().map(|&point| DVec2::from(camera.project(point).unwrap()));
        let empty = CanvasPart { min: DVec2::INFINITY, max: DVec2::NEG_INFINITY };
        points.fold(empty, |part, point| CanvasPart { min: part.min.min(point), max: part.max.max(point) })
    }

    #[test]
    fn a_model_fills_its_part_of_the_canvas_and_stays_within() {
        let boxes = [
            (DVec3::ZERO, DVec3::ONE),
            (DVec3::ZERO, DVec3::splat(1e-30)),
            (DVec3::splat(1e6), DVec3::splat(1e6 + 1.0)),
            (DVec3::new(5e5, 0.0, -3.0), DVec3::new(5e5 + 1.0, 20.0, 1.0)),
            (DVec3::ZERO, DVec3::new(1.0, 0.01, 30.0)),
        ];
        let right = CanvasPart { min: DVec2::new(0.55, 0.1), max: DVec2::new(0.9, 1.0) };
        for ((min, max), &up) in boxes.iter().flat_map(|b| UpAxis::VARIANTS.iter().map(move |up| (b, up))) {
            for part in [CanvasPart::WHOLE, right] {
                let shape = Shape::of_box(*min, *max);
                let CanvasPart { min, max } = covered(&Camera::view_all(&shape, up, 16.0 / 9.0, part), &shape);
                assert!(min.cmpge(part.min).all() && max.cmple(part.max).all(), "{min} {max} is not in {part:?}");
                let filled = (max - min) / (part.max - part.min);
                if shape.bounds.0.x >= 5e5 {
                    // So far from the origin that rounding keeps the eye away.
                    continue;
                }
                assert!((filled.max_element() - FILLED).abs() < 0.03, "{filled} of {part:?}, {up} up");
                let axis = usize::from(filled.y > filled.x);
                let margins = [(min - part.min)[axis], (part.max - max)[axis]];
                assert!((margins[0] - margins[1]).abs() < 0.02, "{margins:?}");
            }
        }
    }

    #[test]
    fn a_model_that_lies_flat_is_seen_from_above() {
        let elevation = |max: DVec3, up: UpAxis| {
            let camera = Camera::view_all(&Shape::of_box(DVec3::ZERO, max), up, 2.0, CanvasPart::WHOLE);
            camera.backward().dot(up.direction()).asin().to_degrees()
        };
        assert!((13.0..14.0).contains(&elevation(DVec3::ONE, UpAxis::Y)));
        for up in [UpAxis::Z, UpAxis::MinusZ] {
            assert!((36.0..38.0).contains(&elevation(DVec3::new(2.0, 1.0, 0.1), up)), "{up}");
        }
    }

    #[test]
    fn shapes_without_extent_are_survived() {
        for (min, max) in [
            (DVec3::INFINITY, DVec3::NEG_INFINITY),
            (DVec3::ONE, DVec3::ONE),
            (DVec3::splat(1e17), DVec3::splat(1e17)),
            (DVec3::splat(-1e18), DVec3::splat(1e18)),
            (DVec3::ZERO, DVec3::X),
        ] {
            let camera = Camera::view_all(&Shape::of_box(min, max), UpAxis::Z, 1.0, CanvasPart::WHOLE);
            assert!(camera.u().length() > 0.0);
        }
    }
}
