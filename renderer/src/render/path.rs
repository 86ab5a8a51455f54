//! Path tracing: light from a sun and a sky that bounces between surfaces.
//!
//! Kajiya, "The Rendering Equation" (1986), as in Pharr, Jakob and Humphreys, *Physically Based Rendering* (4th edition, 2023,
//! chapter 13): each path goes on where its surface scatters most; at each surface a ray to the sun is weighed against the
//! path's own chance to hit it (Veach and Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering",
//! 1995). The sky changes so slowly that paths find it best by leaving the scene.
//!
//! The paths of neighbouring pixels, and several of each, go from bounce to bounce together, so that hundreds of rays are traced
//! in one call. Only + − × ÷ √ are used, in a fixed order for each path: every machine computes the same bits.
//!
//! `sobol` makes random numbers, `lights` are sun and sky, `lamp` lights rooms, `ground` catches shadows, `scattering` is what
//! surfaces do to light, and `tone` makes it fit a display. `onward` finds where paths go on, many at once; `rays` go there.
//! `splitting` and `sight` save rays, and `pixel` keeps what a pixel's paths bring and find.

mod ground;
mod lamp;
pub(super) mod lights;
mod onward;
pub(super) mod pixel;
mod rays;
mod scattering;
pub(super) mod sight;
#[cfg(test)]
mod sky_tests;
mod sobol;
pub(super) mod splitting;
#[cfg(test)]
mod tests;
pub(super) mod tone;

use std::ops::Range;

use glam::{DVec3, Vec3};
use shared::{appearance::ClipPlane, protocol::FrameSpec};

use self::{
    ground::Ground,
    lamp::Lamp,
    lights::{Lights, Sky, Sun},
    onward::{Onward, Outgoing, ToLight},
    pixel::{PixelPaths, PixelSums, Sharing},
    rays::{Contribution, NextRays},
    scattering::{ScatterSample, Scattering},
    sight::{SightOf, sky_part},
    sobol::PixelSample,
    splitting::camera_ray,
};
use crate::{
    grid::Grid,
    intersect::{
        clip,
        ray::{Hit, Ray},
    },
    render::{
        blocks::SampleBlock,
        lift::{Lift, LiftedPoint},
        scene::Scene,
        secondary::{back_and_light, tangent_basis},
        shade::Shader,
        sky::PlacedSky,
        surface::{Surface, SurfaceBatch, normalize_or_zero},
    },
    texture::{
        footprint::WideRays,
        materials::{Finish, PointMaterial},
    },
};

/// Light that a white surface scatters when the sun is in front of it.
pub const SUN_LIGHT: Vec3 = Vec3::new(0.82, 0.77, 0.69);

/// Linear light of the sky straight above; from there to straight below it changes evenly with height.
pub const ZENITH_LIGHT: Vec3 = Vec3::new(0.40, 0.46, 0.57);
/// Linear light of the sky straight below.
pub const GROUND_LIGHT: Vec3 = Vec3::new(0.13, 0.115, 0.105);

/// Reflections that diffusely scattered light sees have at least this roughness: smoother ones would be rare and bright, as
/// caustics.
const LEAST_SCATTERED_ROUGHNESS: f32 = 0.5;

/// Density, for each steradian, below which a path blurs as if it were scattered diffusely.
const SCATTERED_DENSITY: f32 = 4.0 * std::f32::consts::FRAC_1_PI;

/// Paths that bring less than this part of the light end by chance. Most paths leave the scene soon by themselves: to end brighter
/// ones saves few rays, and makes most of a picture's noise.
const ROULETTE_WEIGHT: f32 = 0.25;

/// Dimensions of the samples that each bounce takes.
const DIMENSIONS: u32 = 3;

/// Follows the paths of one frame's samples.
pub(super) struct PathTracer<'a> {
    grid: &'a Grid,
    clip: Option<ClipPlane>,
    lift: Lift<'a>,
    eye: DVec3,
    lights: Lights<'a>,
    /// Only where surfaces hide most of the sky from the eye.
    lamp: Option<Lamp>,
    /// Only where the background shows shadows.
    ground: Option<Ground>,
    bounces: u8,
    /// Number of the frame's first sample.
    first_sample: u32,
}

/// A path that has hit a surface, or the ground; paths that share a camera ray are one up to there.
pub(super) struct Path {
    sharing: Sharing,
    /// Its sample; of paths that share a camera ray, the ray's.
    sample: PixelSample,
    /// Number of its sample; of paths that share a camera ray, the first one's.
    sample_number: u32,
    origin: DVec3,
    direction: Vec3,
    /// Change of the direction across the width and the height of what the ray stands for.
    sides: [Vec3; 2],
    /// A miss on the ground.
    hit: Hit,
    /// The part of the light from the direction that reaches the eye.
    weight: Vec3,
    /// The least density with which a direction of the path was chosen, for each steradian.
    density: f32,
}

impl Path {
    fn is_on_ground(&self) -> bool {
        self.hit.is_miss()
    }

    /// The contribution of a ray from its surface that finds this much light.
    fn brings(&self, light: Vec3) -> Contribution {
        let light = self.weight * light;
        Contribution {
            sharing: self.sharing,
            light: if self.is_on_ground() { -light } else { light },
            comes_with_hit: self.is_on_ground(),
            sight: None,
        }
    }

    /// The path with this number among those that share a camera ray.
    fn alone(&self, number: u32) -> Self {
        let sample_number = self.sample_number.wrapping_add(number);
        Self { sharing: self.sharing.alone(number), sample: self.sample_alone(number), sample_number, ..*self }
    }

    /// The sample of that path.
    fn sample_alone(&self, number: u32) -> PixelSample {
        self.sample.with_number(self.sample_number.wrapping_add(number))
    }
}

/// The least roughness of reflections that a path sees whose directions were chosen with this density, for each steradian:
/// rare paths to narrow highlights would be fireflies. A lobe's solid angle is about the fourth power of its roughness, and
/// a path stands for that of one over its density. Kaplanyan and Dachsbacher, "Path Space Regularization for Holistic and
/// Robust Light Transport" (2013).
fn least_roughness(density: f32) -> f32 {
    LEAST_SCATTERED_ROUGHNESS * (SCATTERED_DENSITY / density).min(1.0).sqrt().sqrt()
}

/// Paths by number.
#[derive(Clone, Copy)]
struct PathRays<'a>(&'a [Path]);

impl WideRays for PathRays<'_> {
    #[inline(always)]
    fn origin(&self, index: usize) -> Vec3 {
        self.0[index].origin.as_vec3()
    }

    #[inline(always)]
    fn direction(&self, index: usize) -> Vec3 {
        self.0[index].direction
    }

    #[inline(always)]
    fn sides(&self, index: usize) -> [Vec3; 2] {
        self.0[index].sides
    }
}

/// A point on a surface that a path has hit.
#[derive(Clone, Copy)]
struct PathVertex<'a> {
    path: &'a Path,
    /// Lifted off the surface; model space.
    point: DVec3,
    scattering: Scattering,
}

impl<'a> PathTracer<'a> {
    /// Prepares for one frame of a scene that a plane may cut open.
    pub(super) fn new(scene: &'a Scene, spec: &FrameSpec, clip: Option<ClipPlane>) -> Self {
        let grid = &scene.grid;
        let [_, to_light] = back_and_light(spec);
        let light = spec.appearance.path;
        let up = spec.camera.v().normalize().as_vec3();
        let eye = spec.camera.eye().as_vec3().as_dvec3();
        let sky = Sky { up, zenith: ZENITH_LIGHT, ground: GROUND_LIGHT };
        let sky_map = scene.sky.as_deref().and_then(|map| map.placed(&spec.appearance));
        let ground = light.has_ground().then(|| {
            let up = spec.appearance.up.direction();
            let of_sun = SUN_LIGHT * up.dot(to_light).max(0.0) as f32;
            let open = sky_map.as_ref().map_or_else(|| of_sun + sky.scattered(up.as_vec3()), PlacedSky::scattered_up);
            Ground::below(grid.mesh(), spec.appearance.up, open)
        });
        Self {
            grid,
            clip,
            lift: Lift::new(grid.mesh(), clip, Vec3::ZERO),
            eye,
            lights: Lights { sun: Sun::new(to_light, light.sun_degrees(), SUN_LIGHT), sky, sky_map },
            lamp: Lamp::at(grid, clip.as_ref(), eye, SUN_LIGHT),
            ground: ground.flatten(),
            bounces: light.bounces(),
            first_sample: spec.samples.first,
        }
    }

    /// Begins the paths of the first of some of a frame's samples, and those of the others that share their camera rays, of
    /// neighbouring blocks' pixels; the rays follow `directions` from the eye to `hits`, and `sides` are the changes of direction
    /// across a sample. Misses begin none, unless they meet the ground before their `backdrops`. `first` is the index of the first
    /// pixel's sum of light.
    pub(super) fn begin(
        &self,
        blocks: &[SampleBlock<'_>],
        samples: Range<u32>,
        (directions, sides): (&[[Vec3; 64]], [Vec3; 2]),
        (hits, backdrops): (&[[Hit; 64]], &[[Vec3; 64]]),
        (first, pixels): (usize, &mut [PixelPaths]),
        paths: &mut Vec<Path>,
    ) {
        for (index, block) in blocks.iter().enumerate() {
            for (sample_idx, pixel) in block.samples().enumerate() {
                let place = 64 * index + sample_idx;
                let found = &mut pixels[place];
                let (ray_number, path_number) = camera_ray(samples.start, found.n_paths);
                if path_number > 0 {
                    continue;
                }
                found.n_camera_rays += 1;
                let (direction, hit) = (directions[index][sample_idx], hits[index][sample_idx]);
                let ground = self.ground.as_ref().filter(|_| hit.is_miss());
                let weight = match ground.filter(|ground| ground.point(self.eye, direction).is_some()) {
                    Some(ground) => ground.weight(backdrops[index][sample_idx]),
                    None if hit.is_miss() => continue,
                    None => Vec3::ONE,
                };
                let n_paths = found.n_paths.min(samples.len() as u32);
                paths.push(Path {
                    sharing: Sharing { first: first + place, n_paths, is_direct: true },
                    sample: PixelSample::new(pixel, self.first_sample.wrapping_add(ray_number)),
                    sample_number: self.first_sample.wrapping_add(samples.start),
                    origin: self.eye,
                    direction,
                    sides,
                    hit,
                    weight,
                    density: f32::INFINITY,
                });
            }
        }
    }

    /// Follows paths to their ends, and adds what they find to `sums`.
    pub(super) fn add_lights(&self, shader: &Shader<'_>, mut paths: Vec<Path>, mut sums: PixelSums<'_>) {
        for bounce in 0..=self.bounces {
            paths = self.bounce(shader, bounce, &paths, &mut sums);
            if paths.is_empty() {
                break;
            }
        }
    }

    /// Lights the surfaces that paths have hit, and follows the paths to their next surfaces; the last bounce only to the sky.
    fn bounce(&self, shader: &Shader<'_>, bounce: u8, paths: &[Path], sums: &mut PixelSums<'_>) -> Vec<Path> {
        let mut next = NextRays::of(paths.iter().map(|path| path.sharing.n_paths as usize).sum());
        let (mut batch, mut hits, mut points) = (SurfaceBatch::NONE, [Hit::MISS; 64], [None; 64]);
        let (mut vertices, mut outgoing) = (Vec::with_capacity(64), Outgoing::default());
        for paths in paths.chunks(64) {
            let rays = PathRays(paths);
            hits.iter_mut().zip(paths).for_each(|(hit, path)| *hit = path.hit);
            let hits = &hits[..paths.len()];
            shader.find_surfaces(self.grid.instructions, rays, hits, &mut batch);
            self.lift.points(self.grid.instructions, rays, hits, &mut points);
            vertices.clear();
            for (index, path) in paths.iter().enumerate() {
                let vertex = if path.is_on_ground() {
                    self.vertex_on_ground(path)
                } else {
                    let surface = batch.surface(index).unwrap_or_else(|| shader.cap(path.direction));
                    Self::vertex(path, points[index], &surface, batch.material(index), sums)
                };
                vertices.extend(vertex);
            }
            outgoing.find((self.grid.instructions, &self.lights), &vertices, bounce);
            let mut onwards = outgoing.onwards.iter();
            for (vertex, to_light) in vertices.iter().zip(&outgoing.to_lights) {
                self.send_to_lights(vertex, bounce, to_light, &mut next, sums);
                for (number, onward) in (0..vertex.path.sharing.n_paths).zip(&mut onwards) {
                    self.follow_on(&vertex.path.alone(number), vertex, bounce, onward, &mut next, sums);
                }
            }
        }
        let NextRays { shadow_rays, contributions_of_shadow_rays, paths, contributions_of_paths } = next;
        self.cast_shadows(shadow_rays, &contributions_of_shadow_rays, sums);
        self.follow(paths, &contributions_of_paths, sums)
    }

    /// Sends rays to the lights from a surface that a path has hit.
    #[inline(always)]
    fn send_to_lights(
        &self,
        vertex: &PathVertex<'_>,
        bounce: u8,
        to_light: &ToLight,
        rays: &mut NextRays,
        sums: &mut PixelSums<'_>,
    ) {
        let PathVertex { path, point, scattering } = vertex;
        let sunlight = Contribution { sight: (bounce == 0).then_some(SightOf::Sun), ..path.brings(to_light.light) };
        // No path ends at its first surface, so the number is free there.
        if let Some((sunlight, _)) = sunlight.beyond(|| to_light.random, sums) {
            rays.push_shadow_ray((*point, to_light.direction, f32::MAX), sunlight);
        }
        // The lamp shows the model alone.
        if let Some(lamp) = self.lamp.as_ref().filter(|_| !path.is_on_ground()) {
            let (to_lamp, light) = lamp.toward(*point);
            let (part, _) = scattering.toward(normalize_or_zero(to_lamp));
            let ray = (*point, normalize_or_zero(to_lamp), to_lamp.length() as f32);
            rays.push_shadow_ray(ray, path.brings(part * light));
        }
    }

    /// Sends a ray to a path's next surface; the less light it brings, the more often the path ends (Russian roulette).
    #[inline(always)]
    fn follow_on(
        &self,
        path: &Path,
        vertex: &PathVertex<'_>,
        bounce: u8,
        &Onward { sample, escaped, random }: &Onward,
        rays: &mut NextRays,
        sums: &mut PixelSums<'_>,
    ) {
        let (is_first, is_last) = (bounce == 0, bounce == self.bounces);
        let ScatterSample { direction, is_diffuse, density, .. } = sample;
        let weight = path.weight * sample.weight;
        let bright = weight.max_element() * (1.0 / ROULETTE_WEIGHT);
        let survival = if is_first || is_last { 1.0 } else { bright.min(1.0) };
        if density == 0.0 || random >= survival {
            return;
        }
        let mut path = Path { weight: weight * (1.0 / survival), ..*path };
        let sight = is_first.then(|| SightOf::Sky { part: sky_part(direction) });
        let escaped = Contribution { sight, ..path.brings(escaped) };
        let Some((escaped, traced_part)) = escaped.beyond(|| random, sums) else { return };
        path.weight *= 1.0 / traced_part;
        if is_last {
            rays.push_shadow_ray((vertex.point, direction, f32::MAX), escaped);
            return;
        }
        // Light that was scattered widely sees textures as they are: many paths blur them anyway.
        let width = if is_diffuse { 0.0 } else { path.sides[0].length() / path.direction.length() };
        rays.contributions_of_paths.push(escaped);
        rays.paths.push(Path {
            origin: vertex.point.as_vec3().as_dvec3(),
            direction,
            sides: tangent_basis(direction).map(|side| side * width),
            density: path.density.min(density),
            ..path
        });
    }

    /// The surface that a path has hit; adds the light that it gives off. `None` if it only gives off light, and for slivers too
    /// thin to have a point.
    #[inline(always)]
    fn vertex<'p>(
        path: &'p Path,
        lifted: Option<LiftedPoint>,
        surface: &Surface,
        material: Option<&PointMaterial>,
        sums: &mut PixelSums<'_>,
    ) -> Option<PathVertex<'p>> {
        let point = lifted?.point;
        let Some(&PointMaterial { finish, emissive }) = material else {
            return Some(PathVertex { path, point, scattering: Scattering::matte(surface) });
        };
        sums.add(path.sharing, path.weight * emissive);
        let scattering = match finish {
            Finish::Unlit => {
                sums.add(path.sharing, path.weight * surface.color);
                return None;
            }
            Finish::Matte => Scattering::matte(surface),
            Finish::Glossy { roughness, metallic } => {
                Scattering::glossy(surface, roughness, metallic, least_roughness(path.density))
            }
        };
        Some(PathVertex { path, point, scattering })
    }

    /// The point of the ground that a path has hit.
    fn vertex_on_ground<'p>(&self, path: &'p Path) -> Option<PathVertex<'p>> {
        let ground = self.ground.as_ref()?;
        let point = ground.point(path.origin, path.direction)?.point;
        Some(PathVertex { path, point, scattering: Scattering::matte(&ground.surface(path.direction)) })
    }

    /// Traces shadow rays, and adds what they find.
    fn cast_shadows(&self, mut rays: Vec<Ray>, contributions: &[Contribution], sums: &mut PixelSums<'_>) {
        let mut occluded = vec![false; rays.len()];
        clip::occluded_rays(self.grid, self.clip.as_ref(), &mut rays, &mut occluded);
        for (&contribution, is_occluded) in contributions.iter().zip(occluded) {
            sums.add_found(contribution, is_occluded);
        }
    }

    /// Traces paths to their next surfaces, and adds what their rays find.
    fn follow(&self, mut paths: Vec<Path>, contributions: &[Contribution], sums: &mut PixelSums<'_>) -> Vec<Path> {
        let rays: Vec<_> = paths.iter().map(|path| Ray::new(path.origin.as_vec3(), path.direction)).collect();
        let mut hits = vec![Hit::MISS; rays.len()];
        clip::intersect_rays(self.grid, self.clip.as_ref(), &rays, &mut hits);
        for ((path, &contribution), hit) in paths.iter_mut().zip(contributions).zip(hits) {
            sums.add_found(contribution, !hit.is_miss());
            path.hit = hit;
        }
        paths.retain(|path| !path.hit.is_miss());
        paths
    }
}
