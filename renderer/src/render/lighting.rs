//! From the hits of a block of samples to their light, in any shading and lighting mode.

use glam::Vec3;
use shared::{
    appearance::ClipPlane,
    protocol::{FrameSpec, LightingMode, ShadingMode},
    srgb,
};

use crate::{
    intersect::{
        MOST_PACKETS, PacketScratch, RayCost, clip,
        ray::{Hit, Ray},
    },
    render::{
        blocks::SampleBlock,
        path::{
            PathTracer,
            pixel::{PixelPaths, PixelSums},
            sight::Sights,
            splitting::{MOST_PATHS, camera_ray},
            tone::ToneMapping,
        },
        sampling::sample_point,
        scene::Scene,
        secondary::SecondaryRays,
        shade::{self, Shader},
        surface::SurfaceBatch,
    },
    texture::footprint::SampleRays,
};

/// A value for each sample of neighbouring blocks.
pub type GroupOf<T> = [[T; 64]; MOST_PACKETS];

/// Paths that are followed together, four samples of a full group: enough to trace many rays in a call, few enough for the
/// cache.
const PATHS_AT_ONCE: usize = 4 * 64 * MOST_PACKETS;

/// Lights the hits of one frame.
pub struct Lighting<'a> {
    shading: ShadingMode,
    shader: Shader<'a>,
    secondary: SecondaryRays<'a>,
    /// Only in path-traced frames.
    paths: Option<(PathTracer<'a>, ToneMapping)>,
    eye: Vec3,
    /// Number of the frame's first sample.
    first_sample: u32,
    /// Change of a ray's direction across the width and the height of its part of a pixel, in model space.
    sample_sides: [Vec3; 2],
}

impl<'a> Lighting<'a> {
    /// Prepares for one frame of a scene that a plane may cut open.
    pub fn new(scene: &'a Scene, spec: &FrameSpec, clip: Option<ClipPlane>) -> Self {
        let grid = &scene.grid;
        let secondary = SecondaryRays::new(grid, spec, clip);
        let rays = spec.camera.rays(spec.size);
        // All samples of a pixel share it.
        let side = 1.0 / (spec.samples.count as f32).sqrt();
        let sample_sides = [rays.du * side, rays.dv * side];
        let shader = Shader::new(grid.mesh(), spec, clip);
        let is_path_traced = spec.view == ShadingMode::Shaded && spec.rays == LightingMode::Path;
        let paths =
            is_path_traced.then(|| (PathTracer::new(scene, spec, clip), ToneMapping::new(spec.appearance.path)));
        let first_sample = spec.samples.first;
        Self { shading: spec.view, shader, secondary, paths, eye: rays.eye, first_sample, sample_sides }
    }

    /// Number of samples of each pixel of `n_blocks` blocks that are lit at once, at least 1; the fewer blocks, the more. Samples
    /// that share camera rays are lit together.
    pub(super) fn samples_at_once(&self, n_blocks: usize) -> u32 {
        if self.paths.is_none() {
            return 1;
        }
        let n_samples = (PATHS_AT_ONCE / (64 * n_blocks)) as u32;
        n_samples - n_samples % MOST_PATHS
    }

    /// Adds the linear light of several samples of neighbouring blocks to `sums`, after those that it has: of the blocks' pixels
    /// (i, j), whose rays follow `directions` to `hits`. What is in `lights` does not matter.
    pub fn light_group(
        &self,
        blocks: &[SampleBlock<'_>],
        (directions, hits): (&[GroupOf<Vec3>], &[GroupOf<Hit>]),
        scratch: &mut PacketScratch,
        lights: &mut Vec<GroupOf<Vec3>>,
        sums: &mut LightSums,
    ) {
        lights.clear();
        lights.resize(hits.len(), [[Vec3::ZERO; 64]; MOST_PACKETS]);
        let rays = directions.iter().zip(hits).zip(&mut *lights);
        let samples = sums.n_samples..sums.n_samples + hits.len() as u32;
        if let Some((tracer, _)) = &self.paths {
            let mut paths = Vec::with_capacity(64 * blocks.len() * hits.len());
            for (index, (sample, ((directions, hits), lights))) in samples.clone().zip(rays).enumerate() {
                let first = 64 * MOST_PACKETS * index;
                for (index, block) in blocks.iter().enumerate() {
                    let points = block.samples().enumerate();
                    for (sample_idx, (i, j)) in points.filter(|&(at, _)| hits[index][at].is_miss()) {
                        let pixel = &mut sums.pixels[64 * index + sample_idx];
                        let (ray_number, _) = camera_ray(sample, pixel.n_paths);
                        let (_, y) = sample_point(i, j, self.first_sample.wrapping_add(ray_number));
                        let light = self.shader.backdrop(y);
                        lights[index][sample_idx] = light;
                        pixel.shared_light += light;
                    }
                }
                let rays = (directions.as_slice(), self.sample_sides);
                let samples = sample..samples.end;
                tracer.begin(blocks, samples, rays, (hits, lights), (first, &mut sums.pixels), &mut paths);
            }
            let lights = lights.as_flattened_mut().as_flattened_mut();
            let LightSums { pixels, sights, .. } = sums;
            tracer.add_lights(&self.shader, paths, PixelSums { lights, pixels, sights });
        } else {
            for (sample, ((directions, hits), lights)) in samples.zip(rays) {
                let sample = self.first_sample.wrapping_add(sample);
                self.light_sample(blocks, sample, directions, hits, scratch, lights);
            }
        }
        lights.iter().zip(hits).for_each(|(lights, hits)| self.add(blocks.len(), lights, hits, sums));
    }

    /// The light of one sample of each pixel, without paths.
    fn light_sample(
        &self,
        blocks: &[SampleBlock<'_>],
        sample: u32,
        directions: &GroupOf<Vec3>,
        hits: &GroupOf<Hit>,
        scratch: &mut PacketScratch,
        lights: &mut GroupOf<Vec3>,
    ) {
        if self.shading == ShadingMode::Cost {
            let SecondaryRays { grid, clip, eye, .. } = &self.secondary;
            for (index, block) in blocks.iter().enumerate() {
                for (light, &direction) in lights[index].iter_mut().zip(&directions[index]).take(block.n_samples()) {
                    let ray = clip::clip_ray(clip.as_ref(), Ray::new(eye.as_vec3(), direction));
                    *light = shade::cost_color(ray.map_or(RayCost::default(), |ray| grid.cost(&ray)));
                }
            }
            return;
        }
        let visibility = self.secondary.visibility(blocks, sample, directions, hits, scratch);
        let mut batch = SurfaceBatch::NONE;
        for (index, block) in blocks.iter().enumerate() {
            let n_samples = block.n_samples();
            let (directions, hits) = (&directions[index][..n_samples], &hits[index][..n_samples]);
            if !hits.iter().all(|hit| hit.is_miss()) {
                let rays = SampleRays { eye: self.eye, directions, sides: self.sample_sides };
                self.shader.find_surfaces(self.secondary.grid.instructions, rays, hits, &mut batch);
            }
            for (sample_idx, (i, j)) in block.samples().enumerate() {
                let (_, y) = sample_point(i, j, sample);
                lights[index][sample_idx] = if hits[sample_idx].is_miss() {
                    self.shader.backdrop(y)
                } else {
                    let surface = batch.surface(sample_idx);
                    let surface = surface.unwrap_or_else(|| self.shader.cap(directions[sample_idx]));
                    self.shader.light(&surface, batch.material(sample_idx), &visibility[index][sample_idx])
                };
            }
        }
    }

    /// Sums of the light of no samples yet.
    pub fn no_light(&self) -> LightSums {
        let n_pixels = if self.paths.is_some() { 64 * MOST_PACKETS } else { 0 };
        LightSums {
            n_samples: 0,
            lights: [[Vec3::ZERO; 64]; MOST_PACKETS],
            as_it_is: vec![(Vec3::ZERO, 0); n_pixels],
            pixels: vec![PixelPaths::default(); n_pixels],
            sights: Vec::new(),
        }
    }

    /// Adds the light of a sample of each pixel of `n_blocks` blocks to their sums.
    fn add(&self, n_blocks: usize, lights: &[[Vec3; 64]], hits: &[[Hit; 64]], sums: &mut LightSums) {
        sums.n_samples += 1;
        let lights = lights.as_flattened().iter().take(64 * n_blocks);
        let lit = sums.lights.as_flattened_mut();
        if sums.as_it_is.is_empty() {
            lit.iter_mut().zip(lights).for_each(|(sum, light)| *sum += *light);
            return;
        }
        let mesh = self.secondary.grid.mesh();
        for (index, (light, hit)) in lights.zip(hits.as_flattened()).enumerate() {
            if hit.is_miss() || (!hit.is_cap() && mesh.is_unlit(hit.triangle)) {
                let (sum, n) = &mut sums.as_it_is[index];
                *sum += *light;
                *n += 1;
            } else {
                lit[index] += *light;
            }
        }
    }

    /// The mean light of the samples of pixel `index` of a block, linear, as a display shows it.
    ///
    /// Exposure and tone mapping change the light of lit surfaces alone: a background is shown as it was asked for, and unlit
    /// surfaces as their colours say.
    #[inline]
    pub(super) fn shown(&self, sums: &LightSums, (block, index): (usize, usize)) -> Vec3 {
        let n_samples = sums.n_samples;
        let light = sums.lights[block][index];
        match (&self.paths, sums.as_it_is.get(64 * block + index)) {
            (Some(_), Some(&(as_it_is, n))) if n == n_samples => as_it_is / n_samples as f32,
            (Some((_, tone)), Some(&(as_it_is, n))) => {
                let n_lit = (n_samples - n) as f32;
                (tone.shown(light / n_lit) * n_lit + as_it_is) / n_samples as f32
            }
            _ => light / n_samples as f32,
        }
    }

    /// The same, encoded.
    #[inline]
    pub fn encode(&self, sums: &LightSums, at: (usize, usize)) -> [u8; 3] {
        let light = self.shown(sums, at);
        // An array's `map` is a call for each pixel, and takes 3 to 5 % of a frame.
        [srgb::encode(light.x), srgb::encode(light.y), srgb::encode(light.z)]
    }
}

/// The light of the samples of neighbouring blocks' pixels, linear.
pub struct LightSums {
    /// Samples of each pixel.
    pub n_samples: u32,
    /// Of all samples; in path-traced frames of those that hit a lit surface.
    pub lights: [[Vec3; 64]; MOST_PACKETS],
    /// Of the others in path-traced frames, and their number; empty in other frames.
    as_it_is: Vec<(Vec3, u32)>,
    /// Findings of the pixels' paths; empty in frames without paths.
    pub(super) pixels: Vec<PixelPaths>,
    /// Only of pixels whose rays are left out where all find the same. They are larger than all else.
    pub(super) sights: Vec<Sights>,
}

impl LightSums {
    /// Number of rays that the samples of pixel `index` of a block took, in path-traced frames.
    pub fn n_rays(&self, (block, index): (usize, usize)) -> u32 {
        let paths = self.pixels.get(64 * block + index);
        paths.map_or(self.n_samples, |paths| paths.n_camera_rays + paths.n_other_rays)
    }

    /// The light of a pixel's samples; and that part of it which those with the same camera ray share.
    pub(super) fn light_of_parts(&self, place: usize) -> [Vec3; 2] {
        [self.lights.as_flattened()[place] + self.as_it_is[place].0, self.pixels[place].shared_light]
    }

    /// The same without sights.
    pub(super) fn light(&self) -> Self {
        let Self { n_samples, lights, as_it_is, pixels, .. } = self;
        let (as_it_is, pixels) = (as_it_is.clone(), pixels.clone());
        Self { n_samples: *n_samples, lights: *lights, as_it_is, pixels, sights: Vec::new() }
    }

    /// The light of the samples that are not in `others`, which are the first of them.
    pub(super) fn light_without(&self, others: &Self) -> Self {
        let mut rest = self.light();
        rest.n_samples -= others.n_samples;
        let lights = rest.lights.as_flattened_mut().iter_mut().zip(others.lights.as_flattened());
        lights.for_each(|(light, other)| *light -= *other);
        for ((light, n), (other, n_other)) in rest.as_it_is.iter_mut().zip(&others.as_it_is) {
            *light -= *other;
            *n -= n_other;
        }
        for (paths, other) in rest.pixels.iter_mut().zip(&others.pixels) {
            paths.shared_light -= other.shared_light;
        }
        rest
    }

    /// Keeps the light of the pixels at some places in all blocks, which are in rising order.
    pub(super) fn keep(&mut self, places: &[usize]) {
        keep(self.lights.as_flattened_mut(), places);
        keep(&mut self.as_it_is, places);
        keep(&mut self.pixels, places);
        keep(&mut self.sights, places);
    }
}

/// Moves the values at some places, in rising order, to the front.
fn keep<T>(values: &mut [T], places: &[usize]) {
    if !values.is_empty() {
        places.iter().enumerate().for_each(|(to, &from)| values.swap(to, from));
    }
}
