//! From hits to linear light.
//!
//! Only + − × ÷ √ are used, in a fixed order, so that every machine computes the same bits.

use glam::Vec3;
use shared::{
    appearance::ClipPlane,
    protocol::{FrameSpec, LightingMode, ShadingMode},
    srgb,
};

use crate::{
    grid::traced::TracedMesh,
    intersect::{InstructionSet, RayCost, ray::Hit},
    render::{
        gloss::GlossySurface,
        secondary::LightVisibility,
        surface::{Surface, SurfaceBatch, Surfaces, normalize_or_zero},
    },
    texture::{
        footprint::WideRays,
        materials::{Finish, PointMaterial},
    },
};

/// Shades a mesh seen by one camera: a light at the eye shows form, a key light relief, and a sky which way is up.
pub struct Shader<'a> {
    mesh: &'a TracedMesh,
    shading: ShadingMode,
    /// The camera's up direction, unit length, world space.
    up: Vec3,
    n_rows: f32,
    /// Linear light of the background at the bottom and at the top.
    background: [Vec3; 2],
    /// Whether shadow rays are traced.
    has_shadows: bool,
    /// Points away from the kept half; unit length, world space.
    cap_normal: Vec3,
}

/// Albedo of meshes without colours: unglazed clay, linear.
pub const CLAY: Vec3 = Vec3::new(0.60, 0.55, 0.49);

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
        let up = normalize_or_zero(spec.camera.v());
        let background = [spec.appearance.background.bottom, spec.appearance.background.top].map(linear);
        let cap_normal = clip.map_or(Vec3::ZERO, |plane| plane.normal.as_vec3());
        let has_shadows = spec.rays != LightingMode::Primary;
        Self { mesh, shading: spec.view, up, n_rows: spec.size.yres() as f32, background, has_shadows, cap_normal }
    }

    /// The linear light from a surface, given its material, if it has one, and the lights that reach it.
    #[inline]
    pub fn light(&self, surface: &Surface, material: Option<&PointMaterial>, visibility: &LightVisibility) -> Vec3 {
        let &Surface { to_eye, geometric, shading: normal, color } = surface;
        match self.shading {
            // The cost of a ray does not depend on its hit: see [`cost_color`].
            ShadingMode::Normals | ShadingMode::Cost => (normal + 1.0) * 0.5,
            ShadingMode::Shaded => {
                let eye = normal.dot(to_eye).max(0.0);
                let mut key_visibility = visibility.key;
                if self.has_shadows {
                    key_visibility *= soft_terminator(geometric, normal, visibility.key_direction);
                }
                let key = normal.dot(visibility.key_direction).max(0.0) * key_visibility;
                let sky = 0.5 + 0.5 * normal.dot(self.up);
                let ambient = EYE_LIGHT * eye + SKY_LIGHT * sky + GROUND_LIGHT * (1.0 - sky);
                let light = KEY_LIGHT * key + ambient * visibility.ambient_visibility;
                let Some(&PointMaterial { finish, emissive }) = material else { return color * light };
                match finish {
                    Finish::Unlit => color,
                    Finish::Matte => color * light + emissive,
                    Finish::Glossy { roughness, metallic } => {
                        let surface = GlossySurface { color, roughness, metallic, normal, to_eye };
                        color * (1.0 - metallic) * light
                            + self.reflected(&surface, key_visibility, visibility)
                            + emissive
                    }
                }
            }
        }
    }

    /// The background's light; `row` counts samples from the bottom.
    #[inline]
    pub(super) fn backdrop(&self, row: f32) -> Vec3 {
        let height = row / self.n_rows;
        self.background[0] * (1.0 - height) + self.background[1] * height
    }

    /// The light that a glossy surface reflects rather than scatters.
    fn reflected(&self, surface: &GlossySurface, key_visibility: f32, visibility: &LightVisibility) -> Vec3 {
        let mirrored = surface.mirrored();
        let sky = 0.5 + 0.5 * mirrored.dot(self.up);
        let ambient = EYE_LIGHT * surface.highlight(surface.to_eye)
            + surface.sheen() * (SKY_LIGHT * sky + GROUND_LIGHT * (1.0 - sky));
        KEY_LIGHT * surface.highlight(visibility.key_direction) * key_visibility
            + ambient * visibility.ambient_visibility
    }

    /// Finds the surfaces of a mesh at up to 64 hits.
    pub(super) fn find_surfaces(
        &self,
        instructions: InstructionSet,
        rays: impl WideRays,
        hits: &[Hit],
        batch: &mut SurfaceBatch,
    ) {
        let mesh = self.mesh;
        let plain_color = if mesh.has_materials() { Vec3::ONE } else { CLAY };
        // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
        unsafe { instructions.call(Surfaces { mesh, rays, hits, plain_color, batch: &mut *batch }) }
        if mesh.has_materials() && self.shading == ShadingMode::Shaded {
            batch.find_materials(mesh, instructions);
        }
    }

    /// The surface of a cap, on the side of the eye.
    #[inline]
    pub(super) fn cap(&self, direction: Vec3) -> Surface {
        let to_eye = -normalize_or_zero(direction.as_dvec3());
        let normal = if self.cap_normal.dot(to_eye) < 0.0 { -self.cap_normal } else { self.cap_normal };
        Surface { to_eye, geometric: normal, shading: normal, color: CAP }
    }
}

/// The part of a light that a smooth surface keeps where its triangles turn away from the light, so that light ends
/// smoothly where their shadows begin: Chiang, Li and Burley, "Taming the Shadow Terminator" (2019).
#[inline(always)]
pub(super) fn soft_terminator(geometric: Vec3, shading: Vec3, to_light: Vec3) -> f32 {
    let product = shading.dot(to_light) * geometric.dot(shading);
    let cosine = geometric.dot(to_light).max(0.0);
    let part = cosine / product;
    if cosine >= product { 1.0 } else { part + part * part - part * part * part }
}

/// The colours of many cells and of many tests in the cost view, encoded: Okabe and Ito's sky blue and orange, which
/// colour-blind people can tell apart.
pub const CELLS_COLOR: [u8; 3] = [86, 180, 233];
/// See [`CELLS_COLOR`].
pub const TESTS_COLOR: [u8; 3] = [230, 159, 0];

/// The linear light of a ray's cost: cells in [`CELLS_COLOR`] plus tests in [`TESTS_COLOR`]; a higher cost is always
/// brighter, and much of both is nearly white.
pub fn cost_color(cost: RayCost) -> Vec3 {
    let brightness = |count: u32, half: f32| count as f32 / (count as f32 + half);
    linear(CELLS_COLOR) * brightness(cost.n_cells, HALF_CELLS)
        + linear(TESTS_COLOR) * brightness(cost.n_tests, HALF_TESTS)
}

/// Well above the cost of most rays, so that images of scans are dark with bright outlines.
const HALF_CELLS: f32 = 64.0;
const HALF_TESTS: f32 = 256.0;

/// Linear light of an encoded colour.
fn linear(color: [u8; 3]) -> Vec3 {
    Vec3::from_array(color.map(srgb::decode))
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{
        appearance::{Appearance, Background},
        camera::Camera,
        detail::Detail,
        division::FrameSize,
        protocol::SampleRange,
        scene::SceneId,
    };
    use strum::VariantArray;

    use super::*;
    use crate::{
        model::{mesh::Mesh, normal::Normal},
        render::surface::visible_normal,
        texture::footprint::SampleRays,
    };

    const EYE: Vec3 = Vec3::new(0.0, 0.0, 5.0);

    fn traced(mesh: Mesh) -> TracedMesh {
        let order = (0..mesh.triangles.len() as u32).collect();
        TracedMesh::new(mesh, order)
    }

    fn shader(mesh: &TracedMesh, shading: ShadingMode) -> Shader<'_> {
        Shader::new(mesh, &spec(shading, Appearance::default()), None)
    }

    fn spec(shading: ShadingMode, appearance: Appearance) -> FrameSpec {
        FrameSpec {
            scene: SceneId::Statue { triangles: 0, treatment: Default::default() },
            camera: Camera::look_at(EYE.as_dvec3(), DVec3::ZERO, DVec3::Y, 0.7, 16.0 / 9.0).unwrap(),
            size: FrameSize::PAPER,
            view: shading,
            rays: LightingMode::Primary,
            samples: SampleRange::CENTRE,
            detail: Detail::FULL,
            appearance,
        }
    }

    /// Nothing is in shadow; the key light is on the eye's side.
    const UNOCCLUDED: LightVisibility =
        LightVisibility { key_direction: Vec3::new(-0.48, 0.6, 0.64), key: 1.0, ambient_visibility: 1.0 };

    /// The interpolated surfaces at hits.
    fn surfaces(
        shader: &Shader<'_>,
        instructions: InstructionSet,
        directions: &[Vec3],
        hits: &[Hit],
    ) -> [Option<Surface>; 64] {
        let mut batch = SurfaceBatch::NONE;
        let rays = SampleRays { eye: EYE, directions, sides: [Vec3::ZERO; 2] };
        shader.find_surfaces(instructions, rays, hits, &mut batch);
        std::array::from_fn(|hit| batch.surface(hit))
    }

    /// The light at a hit, with all instructions.
    fn light(shader: &Shader<'_>, direction: Vec3, hit: Hit) -> Vec3 {
        let lights = InstructionSet::available().into_iter().map(|instructions| {
            let surface = surfaces(shader, instructions, &[direction], &[hit])[0];
            shader.light(&surface.expect("a hit on a triangle"), None, &UNOCCLUDED)
        });
        let lights: Vec<_> = lights.collect();
        assert!(lights.iter().all(|light| *light == lights[0]), "{lights:?}");
        lights[0]
    }

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
            let [front, back] = [0, 1].map(|triangle| light(&shader, -Vec3::Z, Hit { triangle, t: 5.0 }));
            assert_eq!(front, back);
        }
        let normals = light(&shader(&mesh, ShadingMode::Normals), -Vec3::Z, Hit { triangle: 0, t: 5.0 });
        assert_eq!(normals, Vec3::new(0.5, 0.5, 1.0));
    }

    #[test]
    fn misses_show_the_background_from_bottom_to_top() {
        let mesh = traced(facing_mesh());
        let background = Background { bottom: [255, 0, 10], top: [0, 255, 10] };
        let shader =
            Shader::new(&mesh, &spec(ShadingMode::Shaded, Appearance { background, ..Appearance::default() }), None);
        let encoded = |row: f32| shader.backdrop(row).to_array().map(srgb::encode);
        assert_eq!((encoded(0.0), encoded(512.0)), (background.bottom, background.top));
        // Half of the light is value 188.
        assert_eq!(encoded(256.0), [188, 188, 10]);
    }

    #[test]
    fn a_picture_of_the_background_alone_is_known() {
        let scene = crate::render::scene::Scene::build(facing_mesh(), &crate::grid::GridOptions::default(), &|_| ());
        let is_blank = |samples: u32, background: &str, towards: f64| {
            let background: Background = background.parse().unwrap();
            let eye = DVec3::new(0.0, 0.0, 5.0);
            let camera = Camera::look_at(eye, eye + DVec3::Z * towards, DVec3::Y, 0.7, 2.0).unwrap();
            let samples = SampleRange { count: samples, ..SampleRange::CENTRE };
            let size = FrameSize::new(64, 48).unwrap();
            let appearance = Appearance { background, ..Appearance::default() };
            let spec = FrameSpec { camera, size, samples, ..spec(ShadingMode::Shaded, appearance) };
            let rgb = scene.render_frame(&spec).0;
            background.fills(size, rgb.as_chunks().0.iter().copied())
        };
        for background in ["424449,1b1f28", "000000", "ffffff,000000"] {
            for samples in [1, 16] {
                assert!(is_blank(samples, background, 1.0), "{background}");
                assert!(!is_blank(samples, background, -1.0), "{background}");
            }
        }
    }

    #[test]
    fn higher_costs_are_brighter() {
        let light = |n_cells, n_tests| cost_color(RayCost { n_cells, n_tests });
        assert_eq!(light(0, 0), Vec3::ZERO);
        for (less, more) in [(0, 1), (10, 11), (1000, 1100), (100_000, u32::MAX)] {
            assert!(light(less, 7).z < light(more, 7).z && light(7, less).x < light(7, more).x);
        }
        assert!(light(u32::MAX, u32::MAX).max_element() <= 1.0);
    }

    #[test]
    fn cells_and_tests_have_colours_that_the_colour_blind_can_tell_apart() {
        let encoded = |n_cells, n_tests| cost_color(RayCost { n_cells, n_tests }).to_array().map(srgb::encode);
        assert_eq!([encoded(u32::MAX, 0), encoded(0, u32::MAX)], [CELLS_COLOR, TESTS_COLOR]);
        // Without red and green, blue is left: all of one colour and none of the other.
        assert!(CELLS_COLOR[2] > 200 && TESTS_COLOR[2] == 0);
    }

    #[test]
    fn vertex_colours_tint_the_light() {
        let red = traced(Mesh { colors: vec![[255, 0, 0]; 3], ..facing_mesh() });
        let light = light(&shader(&red, ShadingMode::Shaded), -Vec3::Z, Hit { triangle: 0, t: 5.0 });
        assert!(light.x > 0.5 && light.y == 0.0 && light.z == 0.0, "{light}");
    }

    #[test]
    fn normals_are_interpolated_on_the_side_of_the_eye() {
        let corners = [Vec3::new(-0.5, 0.0, 1.0), Vec3::new(0.5, 0.0, 1.0), Vec3::new(0.0, 0.4, 1.0)];
        for sign in [1.0, -1.0] {
            let normals = corners.map(|normal| Normal::new(normal * sign)).to_vec();
            let mesh = traced(Mesh { normals, ..facing_mesh() });
            let shader = shader(&mesh, ShadingMode::Normals);
            for triangle in [0, 1] {
                for (target, expected) in [
                    (Vec3::new(-1.0, -1.0, 0.0), corners[0]),
                    (Vec3::new(0.0, -1.0, 0.0), Vec3::Z),
                    (Vec3::new(0.0, 1.0, 0.0), corners[2]),
                ] {
                    let light = light(&shader, target - EYE, Hit { triangle, t: 1.0 });
                    assert!((light * 2.0 - 1.0).dot(expected.normalize()) > 0.9999, "{light} at {target}");
                }
            }
        }
    }

    #[test]
    fn hits_among_misses_and_caps_have_the_normals_and_colours_that_they_have_alone() {
        let normals = [Vec3::new(-0.5, 0.1, 1.0), Vec3::new(0.5, 0.0, 1.0), Vec3::NAN].map(Normal::new).to_vec();
        let colors = vec![[255, 0, 9], [0, 255, 90], [0, 0, 255]];
        let mesh = traced(Mesh { normals, colors, ..facing_mesh() });
        let shader = shader(&mesh, ShadingMode::Normals);
        let triangle = |sample: u32| [0, Hit::MISS.triangle, 1, 1, Hit::CAP][sample as usize % 5];
        let hits: [Hit; 64] = std::array::from_fn(|sample| Hit { triangle: triangle(sample as u32), t: 1.0 });
        let directions: [Vec3; 64] =
            std::array::from_fn(|sample| Vec3::new(sample as f32 * 0.01 - 0.3, -0.4, 0.0) - EYE);
        for n in [0, 1, 27, 64] {
            for instructions in InstructionSet::available() {
                let together = surfaces(&shader, instructions, &directions[..n], &hits[..n]);
                for (sample, surface) in together.iter().enumerate() {
                    let is_hit = sample < n && hits[sample].triangle < 2;
                    let alone = surfaces(&shader, instructions, &directions[sample..=sample], &hits[sample..=sample]);
                    assert_eq!(*surface, alone[0].filter(|_| is_hit), "{sample} of {n}, {instructions:?}");
                    assert_eq!(surface.is_some(), is_hit);
                }
            }
        }
    }

    #[test]
    fn a_corner_without_a_normal_has_the_triangle_s() {
        let normals = vec![Normal::new(Vec3::new(1.0, 0.0, 1.0)), Normal::OF_TRIANGLE, Normal::new(Vec3::NAN)];
        let mesh = traced(Mesh { normals, ..facing_mesh() });
        let shader = shader(&mesh, ShadingMode::Normals);
        for triangle in [0, 1] {
            let at = |target: Vec3| light(&shader, target - EYE, Hit { triangle, t: 1.0 });
            assert_eq!(at(Vec3::new(1.0, -1.0, 0.0)), Vec3::new(0.5, 0.5, 1.0));
            assert!(at(Vec3::new(-1.0, -1.0, 0.0)).x > 0.8);
        }
    }

    #[test]
    fn normals_of_any_direction_are_visible_unit_vectors() {
        let directions = || {
            let axis = |n: u32| [-1.0f32, 0.0, 1e-30, 1.0][n as usize % 4];
            (0..64).map(move |n| Vec3::new(axis(n), axis(n / 4), axis(n / 16)))
        };
        let unit = |direction: Vec3| normalize_or_zero(direction.as_dvec3());
        for to_eye in directions().map(unit).filter(|direction| *direction != Vec3::ZERO) {
            for geometric in directions().map(unit).filter(|geometric| geometric.dot(to_eye) >= 0.0) {
                for normal in directions() {
                    let visible = visible_normal(normal, geometric, to_eye);
                    let is_unit = (visible.length() - 1.0).abs() < 1e-6 || visible == geometric;
                    assert!(is_unit && visible.dot(to_eye) > -1e-6, "{normal} {geometric} {to_eye}: {visible}");
                    let part = soft_terminator(geometric, visible, to_eye);
                    assert!((0.0..=1.0).contains(&part), "{normal} {geometric} {to_eye}: {part}");
                }
            }
        }
    }

    #[test]
    fn light_ends_smoothly_where_triangles_turn_away_from_it() {
        let shading = Vec3::Y;
        let tilted = |degrees: f32| Vec3::new(degrees.to_radians().sin(), degrees.to_radians().cos(), 0.0);
        let parts = [0.0, 40.0, 60.0, 79.9, 80.1].map(|tilt| soft_terminator(tilted(tilt), shading, tilted(-10.0)));
        assert_eq!((parts[0], parts[4]), (1.0, 0.0));
        assert!(parts.is_sorted_by(|a, b| a > b) && parts[3] < 0.02, "{parts:?}");
    }

    #[test]
    fn colours_are_interpolated_in_linear_light() {
        let mesh = traced(Mesh { colors: vec![[255, 0, 0], [0, 255, 0], [0, 0, 255]], ..facing_mesh() });
        let shader = shader(&mesh, ShadingMode::Shaded);
        let albedo = |triangle, target: Vec3| {
            let (direction, hit) = (target - EYE, Hit { triangle, t: 1.0 });
            let surface = surfaces(&shader, InstructionSet::best(), &[direction], &[hit])[0];
            surface.expect("a hit on a triangle").color
        };
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
            let light = light(&shader(&traced(mesh), ShadingMode::Shaded), -Vec3::Z, Hit { triangle: 0, t: 5.0 });
            assert!(light.is_finite() && light.min_element() > 0.1, "{scale}: {light}");
        }
    }
}
