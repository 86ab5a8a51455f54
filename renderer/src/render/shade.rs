//! From hits to linear light.
//!
//! Only + − × ÷ √ are used, in a fixed order, so that every machine computes the same bits.

use glam::Vec3;
use shared::{
    appearance::ClipPlane,
    protocol::{FrameSpec, ShadingMode},
    srgb,
};

use crate::{
    grid::traced::TracedMesh,
    intersect::{RayCost, ray::Hit, triangle},
    render::{gloss::GlossySurface, secondary::LightVisibility},
    texture::materials::PointMaterial,
};

/// Shades a mesh seen by one camera: a light at the eye shows form, a key light relief, and a sky which way is up.
pub struct Shader<'a> {
    mesh: &'a TracedMesh,
    shading: ShadingMode,
    /// The origin of all rays, model space.
    eye: Vec3,
    /// The camera's up direction, unit length, world space.
    up: Vec3,
    n_rows: f32,
    /// Linear light of the background at the bottom and at the top.
    background: [Vec3; 2],
    /// Points away from the kept half; unit length, world space.
    cap_normal: Vec3,
}

/// Albedo of meshes without colours: unglazed clay, linear.
const CLAY: Vec3 = Vec3::new(0.60, 0.55, 0.49);

/// Albedo of the cap of a cut: the red of sections in drawings, linear; few scans have it.
const CAP: Vec3 = Vec3::new(0.50, 0.12, 0.07);

/// Linear intensities of the light at the eye, the key light, the sky and the ground.
const EYE_LIGHT: Vec3 = Vec3::new(0.26, 0.26, 0.26);
const KEY_LIGHT: Vec3 = Vec3::new(0.62, 0.58, 0.52);
const SKY_LIGHT: Vec3 = Vec3::new(0.19, 0.22, 0.27);
const GROUND_LIGHT: Vec3 = Vec3::new(0.055, 0.045, 0.04);

impl<'a> Shader<'a> {
    /// Prepares for one frame of a scene that a plane may cut open.
    pub fn new(mesh: &'a TracedMesh, spec: &FrameSpec, clip: Option<ClipPlane>) -> Self {
        let up = normalize_or_zero(spec.camera.v().normalize().as_vec3());
        let background = [spec.appearance.background.bottom, spec.appearance.background.top].map(linear);
        let cap_normal = clip.map_or(Vec3::ZERO, |plane| plane.normal.as_vec3());
        let eye = spec.camera.eye().as_vec3();
        Self { mesh, shading: spec.view, eye, up, n_rows: spec.size.yres() as f32, background, cap_normal }
    }

    /// The linear light along one ray, given its hit's material and the lights that reach it. `row` counts samples from the bottom.
    #[inline]
    pub fn light(
        &self,
        direction: Vec3,
        hit: Hit,
        material: Option<&PointMaterial>,
        row: f32,
        visibility: &LightVisibility,
    ) -> Vec3 {
        if hit.is_miss() {
            let height = row / self.n_rows;
            return self.background[0] * (1.0 - height) + self.background[1] * height;
        }
        let normal = if hit.is_cap() {
            self.cap_normal
        } else {
            let [a, b, c] = self.mesh.corners(hit.triangle).map(Vec3::from_array);
            normalize_or_zero((b - a).cross(c - a))
        };
        // Scans are seen from both sides: turn the normal towards the ray's origin.
        let normal = if normal.dot(direction) > 0.0 { -normal } else { normal };
        match self.shading {
            // The cost of a ray does not depend on its hit: see [`cost_color`].
            ShadingMode::Normals | ShadingMode::Cost => (normal + 1.0) * 0.5,
            ShadingMode::Shaded => {
                let to_eye = -normalize_or_zero(direction);
                let eye = normal.dot(to_eye).max(0.0);
                let key = normal.dot(visibility.key_direction).max(0.0) * visibility.key;
                let sky = 0.5 + 0.5 * normal.dot(self.up);
                let ambient = EYE_LIGHT * eye + SKY_LIGHT * sky + GROUND_LIGHT * (1.0 - sky);
                let scattered = KEY_LIGHT * key + ambient * visibility.ambient_visibility;
                let Some(material) = material else { return self.albedo(direction, hit) * scattered };
                let color = self.vertex_color(direction, hit).unwrap_or(Vec3::ONE) * Vec3::from(material.base_color);
                let emissive = Vec3::from(material.emissive);
                match material.gloss {
                    None => color * scattered + emissive,
                    Some([roughness, metallic]) => {
                        let surface = GlossySurface { color, roughness, metallic, normal, to_eye };
                        color * (1.0 - metallic) * scattered + self.reflected(&surface, visibility) + emissive
                    }
                }
            }
        }
    }

    /// The light that a glossy surface reflects rather than scatters.
    fn reflected(&self, surface: &GlossySurface, visibility: &LightVisibility) -> Vec3 {
        let mirrored = surface.mirrored();
        let sky = 0.5 + 0.5 * mirrored.dot(self.up);
        let ambient = EYE_LIGHT * surface.highlight(surface.to_eye)
            + surface.sheen() * (SKY_LIGHT * sky + GROUND_LIGHT * (1.0 - sky));
        KEY_LIGHT * surface.highlight(visibility.key_direction) * visibility.key
            + ambient * visibility.ambient_visibility
    }

    fn albedo(&self, direction: Vec3, hit: Hit) -> Vec3 {
        if hit.is_cap() { CAP } else { self.vertex_color(direction, hit).unwrap_or(CLAY) }
    }

    /// The corners' colours, interpolated in linear light.
    fn vertex_color(&self, direction: Vec3, hit: Hit) -> Option<Vec3> {
        let colors = self.mesh.corner_colors(hit.triangle)?;
        Some(interpolate(colors.map(linear), self.corner_weights(direction, hit)))
    }

    /// The parts of the hit triangle's corners in the hit point; undefined for misses and caps.
    #[inline]
    fn corner_weights(&self, direction: Vec3, hit: Hit) -> [f32; 3] {
        triangle::corner_weights(self.eye, direction, &self.mesh.corners(hit.triangle)).map(|weight| weight as f32)
    }
}

/// The colour of a ray's cost: cells in red, tests in green; a higher cost is always brighter.
pub fn cost_color(cost: RayCost) -> Vec3 {
    let brightness = |count: u32, half: f32| count as f32 / (count as f32 + half);
    Vec3::new(brightness(cost.n_cells, HALF_CELLS), brightness(cost.n_tests, HALF_TESTS), 0.0)
}

/// Well above the cost of most rays, so that images of scans are dark with bright outlines.
const HALF_CELLS: f32 = 64.0;
const HALF_TESTS: f32 = 256.0;

fn interpolate([a, b, c]: [Vec3; 3], weights: [f32; 3]) -> Vec3 {
    a * weights[0] + b * weights[1] + c * weights[2]
}

/// Linear light of an encoded colour.
fn linear(color: [u8; 3]) -> Vec3 {
    Vec3::from_array(color.map(srgb::decode))
}

/// The normalized vector, or zero. Scales first, so that squares neither overflow nor underflow.
fn normalize_or_zero(v: Vec3) -> Vec3 {
    let largest = v.abs().max_element();
    if largest == 0.0 || !largest.is_finite() {
        return Vec3::ZERO;
    }
    let v = v / largest;
    v * (1.0 / v.length())
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{
        appearance::{Appearance, Background},
        camera::Camera,
        division::FrameSize,
        protocol::{LightingMode, SampleRange},
        scene::SceneId,
    };
    use strum::VariantArray;

    use super::*;
    use crate::model::mesh::Mesh;

    fn traced(mesh: Mesh) -> TracedMesh {
        let mut order: Vec<u32> = (0..mesh.triangles.len() as u32).collect();
        TracedMesh::new(mesh, &mut order)
    }

    fn shader(mesh: &TracedMesh, shading: ShadingMode) -> Shader<'_> {
        Shader::new(mesh, &spec(shading, Appearance::default()), None)
    }

    fn spec(shading: ShadingMode, appearance: Appearance) -> FrameSpec {
        FrameSpec {
            scene: SceneId::Statue { triangles: 0 },
            camera: Camera::look_at(DVec3::Z * 5.0, DVec3::ZERO, DVec3::Y, 0.7, 16.0 / 9.0).unwrap(),
            size: FrameSize::PAPER,
            view: shading,
            rays: LightingMode::Primary,
            samples: SampleRange::CENTRE,
            appearance,
        }
    }

    /// Nothing is in shadow; the key light is on the eye's side.
    const UNOCCLUDED: LightVisibility =
        LightVisibility { key_direction: Vec3::new(-0.48, 0.6, 0.64), key: 1.0, ambient_visibility: 1.0 };

    fn facing_mesh() -> Mesh {
        Mesh {
            vertices: vec![[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]],
            triangles: vec![[0, 1, 2], [2, 1, 0]],
            ..Mesh::default()
        }
    }

    #[test]
    fn both_sides_look_alike() {
        let mesh = traced(facing_mesh());
        for &shading in ShadingMode::VARIANTS {
            let shader = shader(&mesh, shading);
            let [front, back] =
                [0, 1].map(|triangle| shader.light(-Vec3::Z, Hit { triangle, t: 5.0 }, None, 0.0, &UNOCCLUDED));
            assert_eq!(front, back);
        }
        let normals =
            shader(&mesh, ShadingMode::Normals).light(-Vec3::Z, Hit { triangle: 0, t: 5.0 }, None, 0.0, &UNOCCLUDED);
        assert_eq!(normals, Vec3::new(0.5, 0.5, 1.0));
    }

    #[test]
    fn misses_show_the_background_from_bottom_to_top() {
        let mesh = traced(facing_mesh());
        let background = Background { bottom: [255, 0, 10], top: [0, 255, 10] };
        let shader =
            Shader::new(&mesh, &spec(ShadingMode::Shaded, Appearance { background, ..Appearance::default() }), None);
        let encoded = |row: f32| shader.light(-Vec3::Z, Hit::MISS, None, row, &UNOCCLUDED).to_array().map(srgb::encode);
        assert_eq!((encoded(0.0), encoded(512.0)), (background.bottom, background.top));
        // Half of the light is value 188.
        assert_eq!(encoded(256.0), [188, 188, 10]);
    }

    #[test]
    fn higher_costs_are_brighter() {
        let light = |n_cells, n_tests| cost_color(RayCost { n_cells, n_tests });
        assert_eq!(light(0, 0), Vec3::ZERO);
        for (less, more) in [(0, 1), (10, 11), (1000, 1100), (100_000, u32::MAX)] {
            assert!(light(less, 7).x < light(more, 7).x && light(7, less).y < light(7, more).y);
        }
        assert!(light(u32::MAX, u32::MAX).max_element() <= 1.0);
    }

    #[test]
    fn vertex_colours_tint_the_light() {
        let red = traced(Mesh { colors: vec![[255, 0, 0]; 3], ..facing_mesh() });
        let light =
            shader(&red, ShadingMode::Shaded).light(-Vec3::Z, Hit { triangle: 0, t: 5.0 }, None, 0.0, &UNOCCLUDED);
        assert!(light.x > 0.5 && light.y == 0.0 && light.z == 0.0, "{light}");
    }

    #[test]
    fn colours_are_interpolated_in_linear_light() {
        let mesh = traced(Mesh { colors: vec![[255, 0, 0], [0, 255, 0], [0, 0, 255]], ..facing_mesh() });
        let shader = shader(&mesh, ShadingMode::Shaded);
        let albedo = |triangle, target: Vec3| shader.albedo(target - shader.eye, Hit { triangle, t: 1.0 });
        for triangle in [0, 1] {
            for (weights, target) in [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.25, 0.25, 0.5], [0.1, 0.2, 0.7]]
                .map(|[a, b, c]: [f32; 3]| (Vec3::new(a, b, c), Vec3::new(-a + b, -a - b + c, 0.0)))
            {
                let albedo = albedo(triangle, target);
                assert!((albedo - weights).length() < 1e-6, "{albedo} at {target}");
            }
        }
    }

    #[test]
    fn triangles_of_any_size_have_light() {
        for scale in [1e-18f32, 1e-6, 1.0, 1e6, 1e18] {
            let mut mesh = facing_mesh();
            mesh.vertices.iter_mut().flatten().for_each(|x| *x *= scale);
            let light = shader(&traced(mesh), ShadingMode::Shaded).light(
                -Vec3::Z,
                Hit { triangle: 0, t: 5.0 },
                None,
                0.0,
                &UNOCCLUDED,
            );
            assert!(light.is_finite() && light.min_element() > 0.1, "{scale}: {light}");
        }
    }
}
