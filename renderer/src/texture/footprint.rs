//! The part of a texture that one sample of the picture shows, and the lookups that cover it.
//!
//! Ray differentials after Igehy, "Tracing Ray Differentials" (1999), for rays of a camera, where they are exact; several
//! lookups along the longer axis after McCormack et al., "Feline: Fast Elliptical Lines for Anisotropic Texture Mapping"
//! (1999).

use glam::{DVec3, Vec2, Vec3};

use crate::intersect::{ray::Ray, triangle};

/// A parallelogram on a texture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint {
    /// Its centre, in texture coordinates.
    pub(crate) centre: Vec2,
    /// Its sides.
    pub(crate) sides: [Vec2; 2],
}

/// Squares along a footprint's longer axis that cover it.
#[derive(Clone, Copy)]
pub(super) struct Squares {
    pub(super) first: Vec2,
    pub(super) step: Vec2,
    /// At least 1.
    pub(super) n: u32,
    /// In texels of the image.
    pub(super) width: f32,
}

/// Limit of [`Squares::n`]: longer footprints are blurred across.
const MOST_SQUARES: f32 = 8.0;

/// A ray of a camera, and the change of its direction across the width and the height of its sample.
pub(crate) struct SampleRay {
    pub(crate) eye: Vec3,
    pub(crate) direction: Vec3,
    pub(crate) sides: [Vec3; 2],
}

/// The point `a + β(b − a) + γ(c − a)` where rays from one origin meet the plane of a triangle.
///
/// By Cramer's rule β and γ are linear functions of the direction over another. In `f64`, products of coordinates of any size
/// are finite.
struct PlanePoint {
    of_beta: DVec3,
    of_gamma: DVec3,
    of_both: DVec3,
}

impl PlanePoint {
    #[inline(always)]
    fn new(origin: Vec3, [a, b, c]: [[f32; 3]; 3]) -> Self {
        let (a, b, c) = (Vec3::from(a).as_dvec3(), Vec3::from(b).as_dvec3(), Vec3::from(c).as_dvec3());
        let (ab, ac, from_a) = (b - a, c - a, origin.as_dvec3() - a);
        Self { of_beta: from_a.cross(ac), of_gamma: ab.cross(from_a), of_both: ab.cross(ac) }
    }
}

/// Where a ray hits a triangle, in texture coordinates; `coordinates` are those of its corners.
#[inline]
pub(crate) fn texture_point(ray: &Ray, corners: &[[f32; 3]; 3], [a, b, c]: [Vec2; 3]) -> Vec2 {
    let weights = triangle::corner_weights(ray.origin, ray.direction, corners);
    a * weights[0] as f32 + b * weights[1] as f32 + c * weights[2] as f32
}

impl SampleRay {
    /// The footprint on a triangle; `coordinates` are those of its corners.
    #[inline]
    pub(crate) fn footprint(&self, corners: [[f32; 3]; 3], [a, b, c]: [Vec2; 3]) -> Footprint {
        let PlanePoint { of_beta, of_gamma, of_both } = PlanePoint::new(self.eye, corners);
        let direction = self.direction.as_dvec3();
        let scale = 1.0 / of_both.dot(direction);
        let (beta, gamma) = (of_beta.dot(direction) * scale, of_gamma.dot(direction) * scale);
        let on_texture = |beta: f64, gamma: f64| (b - a) * beta as f32 + (c - a) * gamma as f32;
        // The quotient rule.
        let change = |side: Vec3| {
            let side = side.as_dvec3();
            let change = of_both.dot(side);
            on_texture((of_beta.dot(side) - beta * change) * scale, (of_gamma.dot(side) - gamma * change) * scale)
        };
        Footprint { centre: a + on_texture(beta, gamma), sides: [change(self.sides[0]), change(self.sides[1])] }
    }
}

impl Footprint {
    pub(super) const NONE: Self = Self { centre: Vec2::ZERO, sides: [Vec2::ZERO; 2] };

    /// The footprint on a texture whose coordinates are this matrix times (u, v, 1).
    #[inline(always)]
    pub(crate) fn transformed(&self, rows: &[[f32; 3]; 2]) -> Self {
        let [[a, b, _], [c, d, _]] = *rows;
        let [right, up] = self.sides;
        let [right, up] = [
            Vec2::new(a * right.x + b * right.y, c * right.x + d * right.y),
            Vec2::new(a * up.x + b * up.y, c * up.x + d * up.y),
        ];
        Self { centre: transformed(self.centre, rows), sides: [right, up] }
    }

    /// The squares for an image of `size` texels. Nothing branches, so that a loop becomes vector instructions.
    #[inline(always)]
    pub(super) fn squares(&self, size: Vec2) -> Squares {
        // The axes are those of the ellipse that the sides span: the singular values and vectors of a matrix.
        let (a, b) = (self.sides[0] * size, self.sides[1] * size);
        let (sum, area) = (a.length_squared() + b.length_squared(), a.perp_dot(b).abs());
        let difference = ((sum - 2.0 * area).max(0.0) * (sum + 2.0 * area)).sqrt();
        let major_squared = (sum + difference) * 0.5;
        let major = major_squared.sqrt();
        // Texels are never narrower than one.
        let minor = (area / major).max(1.0);
        let n = ((major / minor).min(MOST_SQUARES) + 0.5) as i32;
        let (n, is_one) = (n.max(1), n <= 1);
        let part = 1.0 / n as f32;

        // A single square needs no axis, and a circle has none.
        let (xx, yy, xy) = (a.x * a.x + b.x * b.x, a.y * a.y + b.y * b.y, a.x * a.y + b.x * b.y);
        let along = if xx > yy { Vec2::new(major_squared - yy, xy) } else { Vec2::new(xy, major_squared - xx) };
        let scale = if is_one { 0.0 } else { major / along.length() };
        let axis = along * scale / size;
        let step = axis * part;
        Squares { first: self.centre - (axis - step) * 0.5, step, n: n as u32, width: major * part }
    }
}

/// The matrix of these rows times (u, v, 1).
#[inline]
pub(crate) fn transformed(at: Vec2, [u, v]: &[[f32; 3]; 2]) -> Vec2 {
    Vec2::new(u[0] * at.x + u[1] * at.y + u[2], v[0] * at.x + v[1] * at.y + v[2])
}
