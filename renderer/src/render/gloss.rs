//! Reflections of glossy surfaces: glTF's metallic-roughness model (glTF 2.0, appendix B) under the wall's lights.
//!
//! Lights have the intensity that a white surface scatters, so π cancels.

use glam::Vec3;

/// A glossy surface at one point, seen from the eye.
pub(super) struct GlossySurface {
    /// Linear.
    pub(super) color: Vec3,
    pub(super) roughness: f32,
    pub(super) metallic: f32,
    /// Unit length.
    pub(super) normal: Vec3,
    /// Unit length.
    pub(super) to_eye: Vec3,
}

/// The part of light that dielectrics reflect when seen from the front.
const DIELECTRIC: f32 = 0.04;

/// Smoother surfaces have highlights so small and bright that single samples miss or overrate them.
const SMOOTHEST: f32 = 0.25;

impl GlossySurface {
    /// The part of a light from this direction (unit length) that reaches the eye.
    pub(super) fn highlight(&self, to_light: Vec3) -> Vec3 {
        let (n_dot_l, n_dot_v) = (self.normal.dot(to_light), self.normal.dot(self.to_eye));
        let halfway = to_light + self.to_eye;
        let length = halfway.length();
        if n_dot_l <= 0.0 || n_dot_v <= 0.0 || length == 0.0 {
            return Vec3::ZERO;
        }
        let halfway = halfway * (1.0 / length);
        let (n_dot_h, v_dot_h) = (self.normal.dot(halfway).min(1.0), self.to_eye.dot(halfway));
        let roughness = self.roughness.max(SMOOTHEST);
        let alpha = roughness * roughness;
        // The distribution of Trowbridge and Reitz ("GGX"), with Hammon's fit of Smith's visibility.
        let spread = n_dot_h * n_dot_h * (alpha * alpha - 1.0) + 1.0;
        let distribution = alpha * alpha / (spread * spread);
        let (product, sum) = (2.0 * n_dot_l * n_dot_v, n_dot_l + n_dot_v);
        let visibility = 0.5 / (product + (sum - product) * alpha);
        self.fresnel(v_dot_h, 1.0) * (distribution * visibility * n_dot_l)
    }

    /// The part of a surrounding light that reaches the eye.
    pub(super) fn sheen(&self) -> Vec3 {
        self.fresnel(self.normal.dot(self.to_eye), 1.0 - self.roughness)
    }

    /// The direction from which a surrounding light reaches the eye: the mirrored one if smooth, across the surface if rough.
    pub(super) fn mirrored(&self) -> Vec3 {
        let mirrored = self.normal * (2.0 * self.normal.dot(self.to_eye)) - self.to_eye;
        mirrored + (self.normal - mirrored) * (self.roughness * self.roughness)
    }

    /// The part of light that is reflected at an angle with this cosine; it rises to at least `grazing`.
    fn fresnel(&self, cosine: f32, grazing: f32) -> Vec3 {
        fresnel(facing(self.color, self.metallic), grazing, cosine)
    }
}

/// The part of light that a surface reflects when seen from the front.
pub(super) fn facing(color: Vec3, metallic: f32) -> Vec3 {
    Vec3::splat(DIELECTRIC) + (color - DIELECTRIC) * metallic
}

/// Schlick's approximation of the part of light that is reflected at an angle with this cosine; it rises from that of
/// `facing` to at least `grazing`.
#[inline(always)]
pub(super) fn fresnel(facing: Vec3, grazing: f32, cosine: f32) -> Vec3 {
    let x = (1.0 - cosine).clamp(0.0, 1.0);
    let x2 = x * x;
    facing + (facing.max(Vec3::splat(grazing)) - facing) * (x2 * x2 * x)
}
