//! How a surface scatters light: Lambert's diffuse, and reflections of glTF's metallic-roughness model (glTF 2.0,
//! appendix B).

use std::f32::consts::{FRAC_1_PI, PI};

use glam::Vec3;

use crate::render::{
    gloss, sampling::circle_point, secondary::tangent_basis, shade::soft_terminator, surface::Surface,
};

/// A surface at one point, seen from the origin of a ray.
pub(super) struct Scattering {
    geometric: Vec3,
    normal: Vec3,
    to_eye: Vec3,
    tangents: [Vec3; 2],
    /// Linear; each from 0 to 1.
    diffuse: Vec3,
    gloss: Option<Gloss>,
}

/// The reflecting part of a surface.
struct Gloss {
    /// The part of light that is reflected when seen from the front.
    facing: Vec3,
    /// The part that reaches the diffuse surface below when seen from the eye.
    passed: Vec3,
    /// The square of the roughness.
    alpha: f32,
    /// The part of the samples that follow the reflection rather than the diffuse part.
    part_of_samples: f32,
}

/// A direction in which light is followed.
pub(super) struct ScatterSample {
    /// Unit length, world space.
    pub(super) direction: Vec3,
    /// The part of the light from there that goes to the eye, times the cosine, over the density.
    pub(super) weight: Vec3,
    /// For each steradian.
    pub(super) density: f32,
    /// Whether it follows the diffuse part.
    pub(super) is_diffuse: bool,
}

/// Smoother surfaces are treated as if they had this roughness, so that highlights have a size.
const SMOOTHEST: f32 = 0.1;

impl Scattering {
    /// A surface that only scatters light.
    pub(super) fn matte(surface: &Surface) -> Self {
        let Surface { to_eye, geometric, shading: normal, color } = *surface;
        let diffuse = color.clamp(Vec3::ZERO, Vec3::ONE);
        Self { geometric, normal, to_eye, tangents: tangent_basis(normal), diffuse, gloss: None }
    }

    /// A surface that also reflects light. `least_roughness` blurs reflections that are seen by scattered light: Kaplanyan and
    /// Dachsbacher, "Path Space Regularization for Holistic and Robust Light Transport" (2013).
    pub(super) fn glossy(surface: &Surface, roughness: f32, metallic: f32, least_roughness: f32) -> Self {
        let color = surface.color;
        let matte = Self::matte(&Surface { color: color * (1.0 - metallic), ..*surface });
        let roughness = roughness.max(least_roughness.max(SMOOTHEST)).min(1.0);
        let facing = gloss::facing(color.clamp(Vec3::ZERO, Vec3::ONE), metallic);
        let fresnel = gloss::fresnel(facing, 1.0, matte.normal.dot(matte.to_eye));
        let (reflected, passed) = (fresnel.max_element(), Vec3::ONE - fresnel);
        let scattered = matte.diffuse.max_element() * (1.0 - reflected);
        let part = if scattered > 0.0 { (reflected / (reflected + scattered)).clamp(0.1, 0.9) } else { 1.0 };
        Self { gloss: Some(Gloss { facing, passed, alpha: roughness * roughness, part_of_samples: part }), ..matte }
    }

    /// The part of the light from a direction (unit length) that goes to the eye, times the cosine; and the density of samples there.
    pub(super) fn toward(&self, direction: Vec3) -> (Vec3, f32) {
        let cosine = self.normal.dot(direction);
        if cosine <= 0.0 || self.geometric.dot(direction) <= 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        let kept = soft_terminator(self.geometric, self.normal, direction);
        let (diffuse, density) = (self.diffuse * (cosine * FRAC_1_PI), cosine * FRAC_1_PI);
        let Some(gloss) = &self.gloss else { return (diffuse * kept, density) };
        // Light is lost on its way in and out: Ashikhmin and Shirley, "An Anisotropic Phong BRDF Model" (2000). With glTF's
        // own loss, by the halfway vector, smooth surfaces seen from the side would give off more light than falls on them.
        let diffuse = diffuse * gloss.passed * (Vec3::ONE - gloss::fresnel(gloss.facing, 1.0, cosine));
        let (reflected, of_reflection) = self.reflected(gloss, direction, cosine);
        ((diffuse + reflected) * kept, density + (of_reflection - density) * gloss.part_of_samples)
    }

    /// The reflected light times the cosine, and the density of its samples.
    fn reflected(&self, gloss: &Gloss, direction: Vec3, n_dot_l: f32) -> (Vec3, f32) {
        let halfway = direction + self.to_eye;
        let length = halfway.length();
        let n_dot_v = self.normal.dot(self.to_eye);
        if length == 0.0 || n_dot_v <= 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        let halfway = halfway * (1.0 / length);
        let square = gloss.alpha * gloss.alpha;
        // The distribution of Trowbridge and Reitz ("GGX"), with Smith's visibility of correlated heights.
        let n_dot_h = self.normal.dot(halfway).min(1.0);
        let spread = n_dot_h * n_dot_h * (square - 1.0) + 1.0;
        let distribution = square / (PI * spread * spread);
        let reach = |cosine: f32| (square + (1.0 - square) * cosine * cosine).sqrt();
        let visibility = 0.5 / (n_dot_l * reach(n_dot_v) + n_dot_v * reach(n_dot_l));
        let fresnel = gloss::fresnel(gloss.facing, 1.0, self.to_eye.dot(halfway));
        let density = distribution / (2.0 * (n_dot_v + reach(n_dot_v)));
        (fresnel * (distribution * visibility * n_dot_l), density)
    }

    /// Chooses a direction, from a number of 0 to 1 and a point of the unit square; `None` if no light comes from there.
    pub(super) fn sample(&self, choice: f32, at: [f32; 2]) -> Option<ScatterSample> {
        let is_diffuse = self.gloss.as_ref().is_none_or(|gloss| choice >= gloss.part_of_samples);
        let [x, y] = self.tangents;
        let local = match &self.gloss {
            Some(gloss) if !is_diffuse => self.reflection(gloss, at),
            _ => {
                // In proportion to the cosine.
                let (radius, [cos, sin]) = (at[0].sqrt(), circle_point(at[1]));
                Vec3::new(radius * cos, radius * sin, (1.0 - at[0]).sqrt())
            }
        };
        let direction = x * local.x + y * local.y + self.normal * local.z;
        let (light, density) = self.toward(direction);
        let weight = light * (1.0 / density);
        (density > 0.0 && weight.is_finite()).then_some(ScatterSample { direction, weight, density, is_diffuse })
    }

    /// The eye's reflection in one of the microfacets that it sees, in the frame of the normal: Dupuy and Benyoub, "Sampling
    /// Visible GGX Normals with Spherical Caps" (2023).
    fn reflection(&self, gloss: &Gloss, [u, v]: [f32; 2]) -> Vec3 {
        let [x, y] = self.tangents;
        let to_eye = Vec3::new(x.dot(self.to_eye), y.dot(self.to_eye), self.normal.dot(self.to_eye));
        let stretched = normalized(Vec3::new(to_eye.x * gloss.alpha, to_eye.y * gloss.alpha, to_eye.z));
        let [cos, sin] = circle_point(u);
        let z = (1.0 - v) * (1.0 + stretched.z) - stretched.z;
        let radius = (1.0 - z * z).max(0.0).sqrt();
        let halfway = Vec3::new(radius * cos, radius * sin, z) + stretched;
        let halfway = normalized(Vec3::new(halfway.x * gloss.alpha, halfway.y * gloss.alpha, halfway.z));
        halfway * (2.0 * to_eye.dot(halfway)) - to_eye
    }
}

/// A vector of unit length, or without a direction zero.
fn normalized(vector: Vec3) -> Vec3 {
    let length = vector.length();
    if length > 0.0 { vector * (1.0 / length) } else { Vec3::ZERO }
}
