//! How a surface scatters light: Lambert's diffuse, and reflections of glTF's metallic-roughness model (glTF 2.0,
//! appendix B).
//!
//! Nothing that loops call has a branch, so that the compiler turns them into vector instructions.

use std::f32::consts::{FRAC_1_PI, PI};

use glam::Vec3;

use crate::render::{
    gloss,
    sampling::circle_point,
    secondary::tangent_basis,
    shade::soft_terminator,
    surface::{N, Surface, Vectors, get, set},
};

/// A surface at one point, seen from the origin of a ray.
#[derive(Clone, Copy)]
pub(super) struct Scattering {
    geometric: Vec3,
    normal: Vec3,
    to_eye: Vec3,
    /// Linear; each from 0 to 1.
    diffuse: Vec3,
    gloss: Option<Gloss>,
}

/// The reflecting part of a surface.
#[derive(Clone, Copy)]
struct Gloss {
    /// The part of light that is reflected when seen from the front.
    facing: Vec3,
    /// The same seen from the side.
    grazing: f32,
    /// The part that reaches the diffuse surface below when seen from the eye.
    passed: Vec3,
    /// The square of the roughness.
    alpha: f32,
    /// The part of the samples that follow the reflection rather than the diffuse part.
    part_of_samples: f32,
}

impl Gloss {
    /// That of a surface which reflects nothing.
    const NONE: Self = Self { facing: Vec3::ZERO, grazing: 0.0, passed: Vec3::ONE, alpha: 1.0, part_of_samples: 0.0 };
}

/// A direction in which light is followed.
#[derive(Clone, Copy)]
pub(super) struct ScatterSample {
    /// Unit length, world space.
    pub(super) direction: Vec3,
    /// The part of the light from there that goes to the eye, times the cosine, over the density.
    pub(super) weight: Vec3,
    /// For each steradian; 0 if no light comes from there.
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
        Self { geometric, normal, to_eye, diffuse, gloss: None }
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
        let gloss = Gloss { facing, grazing: 1.0, passed, alpha: roughness * roughness, part_of_samples: part };
        Self { gloss: Some(gloss), ..matte }
    }

    /// The part of the light from a direction (unit length) that goes to the eye, times the cosine; and the density of samples there.
    #[inline(always)]
    pub(super) fn toward(&self, direction: Vec3) -> (Vec3, f32) {
        let cosine = self.normal.dot(direction);
        let kept = soft_terminator(self.geometric, self.normal, direction);
        let (mut light, mut density) = (self.diffuse * (cosine * FRAC_1_PI), cosine * FRAC_1_PI);
        if let Some(gloss) = &self.gloss {
            // Light is lost on its way in and out: Ashikhmin and Shirley, "An Anisotropic Phong BRDF Model" (2000). With glTF's
            // own loss, by the halfway vector, smooth surfaces seen from the side would give off more light than falls on them.
            let diffuse = light * gloss.passed * (Vec3::ONE - gloss::fresnel(gloss.facing, gloss.grazing, cosine));
            let (reflected, of_reflection) = self.reflected(gloss, direction, cosine);
            (light, density) = (diffuse + reflected, density + (of_reflection - density) * gloss.part_of_samples);
        }
        let is_in_front = (cosine > 0.0) & (self.geometric.dot(direction) > 0.0);
        if is_in_front { (light * kept, density) } else { (Vec3::ZERO, 0.0) }
    }

    /// The reflected light times the cosine, and the density of its samples.
    #[inline(always)]
    fn reflected(&self, gloss: &Gloss, direction: Vec3, n_dot_l: f32) -> (Vec3, f32) {
        let halfway = direction + self.to_eye;
        let length = halfway.length();
        let n_dot_v = self.normal.dot(self.to_eye);
        let halfway = halfway * (1.0 / length);
        let square = gloss.alpha * gloss.alpha;
        // The distribution of Trowbridge and Reitz ("GGX"), with Smith's visibility of correlated heights.
        let n_dot_h = self.normal.dot(halfway).min(1.0);
        let spread = n_dot_h * n_dot_h * (square - 1.0) + 1.0;
        let distribution = square / (PI * spread * spread);
        let [reach_v, reach_l] = [n_dot_v, n_dot_l].map(|cosine| (square + (1.0 - square) * cosine * cosine).sqrt());
        let visibility = 0.5 / (n_dot_l * reach_v + n_dot_v * reach_l);
        let fresnel = gloss::fresnel(gloss.facing, gloss.grazing, self.to_eye.dot(halfway));
        let density = distribution / (2.0 * (n_dot_v + reach_v));
        let is_seen = (length > 0.0) & (n_dot_v > 0.0);
        if is_seen { (fresnel * (distribution * visibility * n_dot_l), density) } else { (Vec3::ZERO, 0.0) }
    }

    /// Chooses a direction, from a number of 0 to 1 and a point of the unit square.
    #[inline(always)]
    pub(super) fn sample(&self, choice: f32, at: [f32; 2]) -> ScatterSample {
        let is_diffuse = self.gloss.as_ref().is_none_or(|gloss| choice >= gloss.part_of_samples);
        let [x, y] = tangent_basis(self.normal);
        // In proportion to the cosine.
        let (radius, [cos, sin]) = (at[0].sqrt(), circle_point(at[1]));
        let mut local = Vec3::new(radius * cos, radius * sin, (1.0 - at[0]).sqrt());
        if let Some(gloss) = &self.gloss {
            let reflection = self.reflection(gloss, [x, y], at);
            local = if is_diffuse { local } else { reflection };
        }
        let direction = x * local.x + y * local.y + self.normal * local.z;
        let (light, density) = self.toward(direction);
        let weight = light * (1.0 / density);
        let brings_light = (density > 0.0) & weight.is_finite();
        ScatterSample { direction, weight, density: if brings_light { density } else { 0.0 }, is_diffuse }
    }

    /// The eye's reflection in one of the microfacets that it sees, in the frame of the normal: Dupuy and Benyoub, "Sampling
    /// Visible GGX Normals with Spherical Caps" (2023).
    #[inline(always)]
    fn reflection(&self, gloss: &Gloss, [x, y]: [Vec3; 2], [u, v]: [f32; 2]) -> Vec3 {
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

/// [`N`] surfaces, in a form for loops that the compiler turns into vector instructions.
pub(super) struct Scatterings {
    geometrics: Vectors,
    normals: Vectors,
    to_eyes: Vectors,
    diffuses: Vectors,
    /// Whether no surface reflects light; then directions to the eye and what follows are undefined.
    pub(super) are_matte: bool,
    facings: Vectors,
    grazings: [f32; N],
    passed: Vectors,
    alphas: [f32; N],
    parts_of_samples: [f32; N],
}

impl Scatterings {
    #[inline(always)]
    pub(super) fn of<'a>(scattering: impl Fn(usize) -> &'a Scattering) -> Self {
        let [geometrics, normals, to_eyes, diffuses, facings, passed] = [[[0.0; N]; 3]; 6];
        let [grazings, alphas, parts_of_samples] = [[0.0; N]; 3];
        let are_matte = (0..N).all(|lane| scattering(lane).gloss.is_none());
        let mut all = Self {
            geometrics,
            normals,
            to_eyes,
            diffuses,
            are_matte,
            facings,
            grazings,
            passed,
            alphas,
            parts_of_samples,
        };
        for lane in 0..N {
            let Scattering { geometric, normal, diffuse, .. } = scattering(lane);
            set(&mut all.geometrics, lane, *geometric);
            set(&mut all.normals, lane, *normal);
            set(&mut all.diffuses, lane, *diffuse);
        }
        if are_matte {
            return all;
        }
        for lane in 0..N {
            let Scattering { to_eye, gloss, .. } = scattering(lane);
            let gloss = gloss.unwrap_or(Gloss::NONE);
            set(&mut all.to_eyes, lane, *to_eye);
            set(&mut all.facings, lane, gloss.facing);
            set(&mut all.passed, lane, gloss.passed);
            all.grazings[lane] = gloss.grazing;
            all.alphas[lane] = gloss.alpha;
            all.parts_of_samples[lane] = gloss.part_of_samples;
        }
        all
    }

    /// One of the surfaces. `REFLECTS` unless all are matte, so that the loops over these have no reflections to compute.
    #[inline(always)]
    pub(super) fn get<const REFLECTS: bool>(&self, lane: usize) -> Scattering {
        let gloss = Gloss {
            facing: get(&self.facings, lane),
            grazing: self.grazings[lane],
            passed: get(&self.passed, lane),
            alpha: self.alphas[lane],
            part_of_samples: self.parts_of_samples[lane],
        };
        Scattering {
            geometric: get(&self.geometrics, lane),
            normal: get(&self.normals, lane),
            to_eye: get(&self.to_eyes, lane),
            diffuse: get(&self.diffuses, lane),
            gloss: REFLECTS.then_some(gloss),
        }
    }
}

/// A vector of unit length, or without a direction zero.
#[inline(always)]
fn normalized(vector: Vec3) -> Vec3 {
    let length = vector.length();
    if length > 0.0 { vector * (1.0 / length) } else { Vec3::ZERO }
}
