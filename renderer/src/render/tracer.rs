//! Traces and shades a share of a frame.

use std::{
    ops::Range,
    sync::atomic::{AtomicBool, Ordering::Relaxed},
    time::Duration,
};

use glam::Vec3;
use shared::{
    camera::CameraRays,
    division::{Division, Share},
    protocol::FrameSpec,
};

use crate::{
    intersect::{MOST_PACKETS, Packet, PacketScratch, clip, ray::Hit},
    render::{
        blocks::{SampleBlock, for_each_group, lanes_to_rows, sum_terms_by_lane},
        lighting::{GroupOf, LightSums, Lighting},
        noise,
        parallel::work_off,
        path::{pixel::PixelPaths, splitting::camera_ray},
        sampling::sample_point,
        scene::Scene,
    },
};

/// Tiles of a frame that a thread renders at once.
const TILES_PER_PART: u32 = 32;

impl Scene {
    /// Renders `units` of a share (indices in the share, not in the frame), on the calling thread.
    ///
    /// Appends their samples to `rgb`, sRGB-encoded, in the order of [`Share::samples`]. The bits depend only on scene,
    /// spec and sample, so several threads may render parts of one share.
    pub fn render(&self, spec: &FrameSpec, share: &Share, units: Range<u32>, rgb: &mut Vec<u8>) {
        self.render_unless(&AtomicBool::new(false), spec, share, units, rgb);
    }

    /// As [`Scene::render`]; once nobody wants the samples, it soon returns with others.
    pub(crate) fn render_unless(
        &self,
        unwanted: &AtomicBool,
        spec: &FrameSpec,
        share: &Share,
        units: Range<u32>,
        rgb: &mut Vec<u8>,
    ) {
        let n_samples: u32 = units.clone().map(|unit| share.samples(unit).count()).sum();
        let first = rgb.len();
        rgb.resize(first + 3 * n_samples as usize, 0);
        let (pixels, _) = rgb[first..].as_chunks_mut::<3>();
        self.sum_lights_unless(unwanted, spec, share, units, |lighting, sums, at, index| {
            pixels[index] = lighting.encode(sums, at);
        });
    }

    /// Sums the light of the samples of the pixels of `units` of a share, on the calling thread; calls `visit` with the sums,
    /// block and index of each pixel, and its index in the order of [`Share::samples`].
    pub fn sum_lights(
        &self,
        spec: &FrameSpec,
        share: &Share,
        units: Range<u32>,
        visit: impl FnMut(&Lighting<'_>, &LightSums, (usize, usize), usize),
    ) {
        self.sum_lights_unless(&AtomicBool::new(false), spec, share, units, visit);
    }

    fn sum_lights_unless(
        &self,
        unwanted: &AtomicBool,
        spec: &FrameSpec,
        share: &Share,
        units: Range<u32>,
        mut visit: impl FnMut(&Lighting<'_>, &LightSums, (usize, usize), usize),
    ) {
        let scene = self.at(spec.detail);
        let spec = &FrameSpec { camera: scene.local(&spec.camera), ..*spec };
        let mut sampler = Sampler::new(scene, spec, unwanted);
        match noise::of_frame(spec) {
            Some(limit) => noise::sum_lights(&mut sampler, (share, units), (spec.samples.count, limit), visit),
            None => for_each_group(share, units, |blocks| {
                let mut sums = sampler.lighting.no_light();
                sampler.add(blocks, 0..spec.samples.count, &mut sums);
                for (number, block) in blocks.iter().enumerate() {
                    for index in 0..block.n_samples() {
                        visit(&sampler.lighting, &sums, (number, index), block.output_index(index));
                    }
                }
            }),
        }
    }

    /// Renders a whole frame on the current rayon pool.
    ///
    /// Returns its samples, sRGB-encoded, row by row from the bottom, and the CPU time of all threads.
    pub fn render_frame(&self, spec: &FrameSpec) -> (Vec<u8>, Duration) {
        let share = Division::Tiled.task(0, 1).share(spec.size).expect("one machine renders any frame");
        let of_threads = work_off((0..share.count()).step_by(TILES_PER_PART as usize), |next| {
            let parts = std::iter::from_fn(next).map(|first| {
                let units = first..(first + TILES_PER_PART).min(share.count());
                let mut rgb = Vec::new();
                self.render(spec, &share, units.clone(), &mut rgb);
                (units, rgb)
            });
            parts.collect::<Vec<_>>()
        });
        let cpu = of_threads.iter().map(|(_, cpu)| *cpu).sum();
        let mut rows = vec![[0; 3]; spec.size.n_samples() as usize];
        for (units, rgb) in of_threads.iter().flat_map(|(parts, _)| parts) {
            let samples = units.clone().flat_map(|unit| share.samples(unit).iter());
            for ((i, j), &color) in samples.zip(rgb.as_chunks().0) {
                rows[(j * spec.size.xres() + i) as usize] = color;
            }
        }
        (rows.into_flattened(), cpu)
    }

    /// Intersects the packets of neighbouring blocks; hits are in the order of each block's samples.
    pub fn trace_group(
        &self,
        blocks: &[SampleBlock<'_>],
        packets: &[Packet],
        scratch: &mut PacketScratch,
        hits: &mut [[Hit; 64]],
    ) {
        clip::intersect_packets(&self.grid, packets, scratch, hits);
        for (block, hits) in blocks.iter().zip(hits) {
            if block.tile().is_some() {
                lanes_to_rows(hits);
            }
        }
    }
}

/// Traces and lights the samples of one frame's pixels.
pub(super) struct Sampler<'a> {
    scene: &'a Scene,
    /// Whether nobody wants the samples any more.
    unwanted: &'a AtomicBool,
    rays: CameraRays,
    first_sample: u32,
    pub(super) lighting: Lighting<'a>,
    scratch: PacketScratch,
    packets: [Packet; MOST_PACKETS],
    /// Of each of the samples that are lit at once.
    hits: Vec<GroupOf<Hit>>,
    directions: Vec<GroupOf<Vec3>>,
    lights: Vec<GroupOf<Vec3>>,
}

impl<'a> Sampler<'a> {
    /// Prepares for one frame; the camera is in model space.
    fn new(scene: &'a Scene, spec: &FrameSpec, unwanted: &'a AtomicBool) -> Self {
        let clip = scene.clip_plane(&spec.camera, spec.appearance.clip);
        Self {
            scene,
            unwanted,
            rays: spec.camera.rays(spec.size),
            first_sample: spec.samples.first,
            lighting: Lighting::new(scene, spec, clip),
            scratch: PacketScratch::default(),
            packets: std::array::from_fn(|_| Packet { clip, ..Packet::NONE }),
            hits: Vec::new(),
            directions: Vec::new(),
            lights: Vec::new(),
        }
    }

    /// Whether nobody wants the samples any more.
    pub(super) fn is_unwanted(&self) -> bool {
        self.unwanted.load(Relaxed)
    }

    /// Adds the light of samples of the pixels of neighbouring blocks, unless nobody wants it; the frame's first sample has
    /// index 0.
    pub(super) fn add(&mut self, blocks: &[SampleBlock<'_>], samples: Range<u32>, sums: &mut LightSums) {
        let mut samples = samples;
        while !samples.is_empty() && !self.is_unwanted() {
            let n = samples.len().min(self.lighting.samples_at_once(blocks.len()) as usize);
            self.trace(blocks, samples.start..samples.start + n as u32, &sums.pixels);
            let Self { lighting, scratch, hits, directions, lights, .. } = self;
            lighting.light_group(blocks, (&directions[..n], &hits[..n]), scratch, lights, sums);
            samples.start += n as u32;
        }
    }

    /// Traces the camera's rays of samples of the pixels of neighbouring blocks. Samples that share a ray have the hit of their
    /// first.
    fn trace(&mut self, blocks: &[SampleBlock<'_>], samples: Range<u32>, pixels: &[PixelPaths]) {
        let Self { scene, rays, first_sample, scratch, hits, directions, .. } = self;
        if hits.len() < samples.len() {
            hits.resize(samples.len(), [[Hit::MISS; 64]; MOST_PACKETS]);
            directions.resize(samples.len(), [[Vec3::ZERO; 64]; MOST_PACKETS]);
        }
        let packets = &mut self.packets[..blocks.len()];
        let is_shared = pixels.iter().any(|pixel| pixel.n_paths > 1);
        for (row, sample) in samples.enumerate() {
            for (index, (packet, block)) in packets.iter_mut().zip(blocks).enumerate() {
                if is_shared {
                    share_camera_rays(packet, rays, block, (sample, *first_sample), &pixels[64 * index..]);
                } else {
                    set_camera_rays(packet, rays, block, first_sample.wrapping_add(sample));
                }
            }
            let (before, hits) = hits.split_at_mut(row);
            scene.trace_group(blocks, packets, scratch, &mut hits[0][..blocks.len()]);
            for (index, (block, packet)) in blocks.iter().zip(&*packets).enumerate() {
                let [x, y, z] = &packet.directions;
                for (lane, &sample_idx) in block.sample_of_lane().iter().enumerate() {
                    directions[row][index][sample_idx] = Vec3::new(x[lane], y[lane], z[lane]);
                    if lane < block.n_samples() && packet.active >> lane & 1 == 0 {
                        hits[0][index][sample_idx] = before[row - 1][index][sample_idx];
                    }
                }
            }
        }
    }
}

/// Fills a packet with the rays that paths share at this sample, whose number counts from the frame's first; those are inactive
/// that an earlier sample has traced.
fn share_camera_rays(
    packet: &mut Packet,
    rays: &CameraRays,
    block: &SampleBlock<'_>,
    (sample, first_sample): (u32, u32),
    pixels: &[PixelPaths],
) {
    packet.origin = rays.eye;
    packet.active = u64::MAX >> (64 - block.n_samples());
    for (lane, index) in block.sample_of_lane().into_iter().enumerate() {
        let (ray_number, path_number) = camera_ray(sample, pixels[index].n_paths);
        if path_number > 0 {
            packet.active &= !(1 << lane);
        }
        set_camera_ray(packet, lane, rays, block.sample(index), first_sample.wrapping_add(ray_number));
    }
}

/// Fills a packet with the rays through sample number `sample` of a block's pixels, by [`SampleBlock::sample_of_lane`].
// The laboratory calls it from another crate: not inlined, it took twice as long.
#[inline]
pub fn set_camera_rays(packet: &mut Packet, rays: &CameraRays, block: &SampleBlock<'_>, sample: u32) {
    packet.origin = rays.eye;
    packet.active = u64::MAX >> (64 - block.n_samples());
    if let (Some((i, j)), 0) = (block.tile(), sample) {
        // The rays of a tile share their column's and row's terms: this saves up to 5 % of a frame's time.
        let x = std::array::from_fn(|column| (i + column as u32) as f32 + 0.5);
        let y = std::array::from_fn(|row| (j + row as u32) as f32 + 0.5);
        for (axis, along) in packet.directions.iter_mut().enumerate() {
            sum_terms_by_lane(&rays.direction_terms::<8>(axis, &x, &y), along);
        }
    } else {
        for (lane, index) in block.sample_of_lane().into_iter().enumerate() {
            set_camera_ray(packet, lane, rays, block.sample(index), sample);
        }
    }
}

/// Sets a lane of a packet to the ray through sample number `sample` of a pixel.
#[inline]
fn set_camera_ray(packet: &mut Packet, lane: usize, rays: &CameraRays, (i, j): (u32, u32), sample: u32) {
    let (x, y) = sample_point(i, j, sample);
    let direction = rays.direction_through(x, y);
    (0..3).for_each(|axis| packet.directions[axis][lane] = direction[axis]);
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{
        appearance::{Appearance, Light},
        camera::Camera,
        detail::Detail,
        division::{Division, FrameSize},
        path_light::PathLight,
        protocol::{LightingMode, SampleRange, ShadingMode},
        scene::{Crease, SceneId},
    };
    use strum::VariantArray;

    use super::*;
    use crate::{
        grid::{Grid, GridOptions},
        intersect::{InstructionSet, ray::Ray},
        model::{mesh::Mesh, statue},
    };

    fn tetrahedron() -> Scene {
        let mesh = Mesh {
            vertices: vec![[-1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]],
            triangles: vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
            ..Mesh::default()
        };
        Scene::build(mesh, &GridOptions::default(), &|_| ())
    }

    fn spec(first: u32, count: u32) -> FrameSpec {
        FrameSpec {
            scene: SceneId::Statue { triangles: 0, treatment: Default::default() },
            camera: Camera::look_at(DVec3::new(1.0, 2.0, 5.0), DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap(),
            size: FrameSize::new(37, 21).unwrap(),
            view: ShadingMode::Shaded,
            rays: LightingMode::Primary,
            samples: SampleRange::all(first, count),
            detail: Detail::FULL,
            appearance: Appearance::default(),
        }
    }

    #[test]
    fn the_samples_do_not_depend_on_the_division() {
        check_divisions(&tetrahedron(), &spec(0, 3));
    }

    #[test]
    fn pixels_stop_at_the_same_sample_in_every_division() {
        let scene = Scene::build(statue::generate(3000, &|_| ()), &GridOptions::default(), &|_| ());
        let camera = Camera::look_at(DVec3::new(0.6, 1.5, 2.5), DVec3::Y, DVec3::Y, 0.5, 2.0).unwrap();
        let with = |noise: &str| {
            let samples = SampleRange { noise: noise.parse().unwrap(), ..SampleRange::all(0, 100) };
            FrameSpec { camera, rays: LightingMode::Path, samples, ..spec(0, 1) }
        };
        let [all, some] = ["0", "4"].map(|noise| check_divisions(&scene, &with(noise)));
        assert_ne!(all, some, "no pixel stops early");
        let squared_error = |of: &[u8]| {
            let differences = of.iter().zip(&all).map(|(a, b)| i32::from(*a) - i32::from(*b));
            differences.map(|difference| difference * difference).sum::<i32>()
        };
        // Which rays are traced changes the noise alone.
        let of_more = squared_error(&check_divisions(&scene, &with("0.01")));
        assert!(4 * of_more < squared_error(&some), "pixels stop for no reason: {of_more} of {}", squared_error(&some));
    }

    #[test]
    fn rays_to_the_sun_are_left_out_where_all_find_the_same_and_the_light_stays() {
        let scene = Scene::build(statue::generate(3000, &|_| ()), &GridOptions::default(), &|_| ());
        let camera = Camera::look_at(DVec3::new(0.6, 1.5, 2.5), DVec3::Y, DVec3::Y, 0.5, 2.0).unwrap();
        let lights = |noise: &str| {
            let samples = SampleRange { noise: noise.parse().unwrap(), ..SampleRange::all(0, 256) };
            let spec = FrameSpec { camera, rays: LightingMode::Path, samples, ..spec(0, 1) };
            let share = Division::Tiled.task(0, 1).share(spec.size).unwrap();
            let (mut lights, mut n_rays, mut n_samples) = (vec![0.0; spec.size.n_samples() as usize], 0, 0);
            scene.sum_lights(&spec, &share, 0..share.count(), |_, sums, (block, index), output_index| {
                lights[output_index] = f64::from(sums.lights[block][index].y) / f64::from(sums.n_samples);
                n_rays += sums.n_rays((block, index));
                n_samples += sums.n_samples;
            });
            (lights, f64::from(n_rays) / f64::from(n_samples))
        };
        let ((all, rays_of_all), (some, rays_of_some)) = (lights("0"), lights("0.05"));
        assert!(rays_of_some < 0.95 * rays_of_all, "{rays_of_some} rays a sample, {rays_of_all} when none is left out");
        let differences = all.iter().zip(&some).map(|(all, some)| some - all);
        let (sum, squares) = differences.fold((0.0, 0.0), |(sum, squares), it| (sum + it, squares + it * it));
        assert!(squares > 0.0 && sum.abs() < 4.0 * f64::sqrt(squares), "{sum} of {}", f64::sqrt(squares));
    }

    #[test]
    fn samples_that_nobody_wants_end_soon() {
        let scene = tetrahedron();
        let samples = SampleRange { noise: "1".parse().unwrap(), ..SampleRange::all(0, 256) };
        let spec = FrameSpec { rays: LightingMode::Path, samples, ..spec(0, 1) };
        for division in [Division::Tiled, Division::Interleaved] {
            let share = division.task(0, 1).share(spec.size).unwrap();
            let mut rgb = Vec::new();
            scene.render_unless(&AtomicBool::new(true), &spec, &share, 0..share.count(), &mut rgb);
            assert_eq!(rgb.len(), 3 * 37 * 21);
        }
    }

    #[test]
    fn a_probe_finds_what_a_frame_shows() {
        let (scene, spec) = (tetrahedron(), spec(0, 1));
        let (rays, size) = (spec.camera.rays(spec.size), spec.size);
        let (mut n_hits, mut n_caps, mut n_other) = (0, 0, 0);
        let samples = || (0..size.yres()).flat_map(|j| (0..size.xres()).map(move |i| (i, j)));
        for (cut, (i, j)) in
            [None, "eye:40".parse().ok()].into_iter().flat_map(|cut| samples().map(move |at| (cut, at)))
        {
            let plane = scene.clip_plane(&spec.camera, cut);
            let ray = Ray::new(rays.eye, rays.direction(i, j));
            let seen = scene.with_file_index(clip::intersect(&scene.grid, plane.as_ref(), ray));
            let at = [(i as f32 + 0.5) / size.xres() as f32, (j as f32 + 0.5) / size.yres() as f32];
            let probed = scene.probe(&spec.camera, at, cut);
            n_hits += u32::from(probed.is_some());
            n_caps += u32::from(probed.is_some_and(|hit| hit.triangle.is_none()));
            // The rays differ in their last bits, which only on an edge is another triangle.
            let is_same = match probed {
                None => seen.is_miss(),
                Some(hit) => {
                    hit.triangle.unwrap_or(Hit::CAP) == seen.triangle && (hit.t - seen.t).abs() < 1e-5 * seen.t
                }
            };
            n_other += u32::from(!is_same);
        }
        assert!(n_hits > 160 && n_caps > 20 && n_other <= 4, "{n_hits} hits, {n_caps} caps, {n_other} others");
        for at in [[f32::NAN, 0.5], [f32::INFINITY, 0.0], [f32::MAX, f32::MAX], [-9.0, 0.5]] {
            assert_eq!(scene.probe(&spec.camera, at, None), None);
        }
    }

    #[test]
    fn neither_division_nor_instructions_change_a_frame() {
        let mut mesh = statue::generate(3000, &|_| ()).smooth(Crease::default());
        mesh.colors = mesh.vertices.iter().map(|vertex| vertex.map(|x| (x.abs() * 999.0) as u8 | 128)).collect();
        assert!(mesh.normals.iter().any(|normal| normal.vector().is_some()));
        let camera = Camera::look_at(DVec3::new(0.6, 1.5, 2.5), DVec3::Y, DVec3::Y, 0.5, 2.0).unwrap();
        let cut = Appearance { light: Light::PRESETS[5].1, clip: "eye:40".parse().ok(), ..Appearance::default() };
        let on_ground = Appearance { path: PathLight::default().with_ground(true), ..Appearance::default() };
        for (rays, appearance) in LightingMode::VARIANTS
            .iter()
            .copied()
            .flat_map(|rays| [Appearance::default(), cut, on_ground].map(|appearance| (rays, appearance)))
        {
            let spec = FrameSpec { camera, rays, appearance, ..spec(1, 2) };
            let frames = InstructionSet::available().into_iter().map(|instructions| {
                let grid = Grid::build(mesh.clone(), &GridOptions::default(), &|_| ()).with_instructions(instructions);
                check_divisions(&Scene::from(grid), &spec)
            });
            let frames: Vec<_> = frames.collect();
            assert!(frames.iter().all(|frame| frame == &frames[0]), "{rays:?} {appearance:?}");
        }
    }

    #[test]
    fn stand_ins_have_the_same_bits_whatever_the_structure_and_the_instructions() {
        let mesh = statue::generate(60_000, &|_| ()).smooth(Crease::default());
        let camera = Camera::look_at(DVec3::new(0.6, 1.5, 5.0), DVec3::Y * 1.6, DVec3::Y, 0.7, 2.0).unwrap();
        let of_instructions = InstructionSet::available().into_iter().map(|set| (GridOptions::default(), set));
        let little =
            GridOptions { memory_budget: "16M".parse().unwrap(), density: Some(0.5), ..GridOptions::default() };
        let scenes = of_instructions.chain([(little, InstructionSet::best())]).map(|(options, instructions)| {
            let mut scene = Scene::build_with_stand_ins(mesh.clone(), 1, &options, &|_| ());
            scene.grids_mut().for_each(|grid| grid.instructions = instructions);
            scene
        });
        let scenes: Vec<_> = scenes.collect();
        let sizes: Vec<_> = scenes[0].stand_in_sizes().collect();
        assert!(
            sizes.len() > 2 && scenes.iter().all(|scene| scene.stand_in_sizes().eq(sizes.iter().copied())),
            "{sizes:?}"
        );

        for rays in [LightingMode::Primary, LightingMode::AmbientOcclusion] {
            let full = FrameSpec { camera, rays, ..spec(0, 1) };
            let frame = |detail: Detail| {
                let spec = FrameSpec { detail, ..full };
                let frames: Vec<_> = scenes.iter().map(|scene| check_divisions(scene, &spec)).collect();
                assert!(frames.iter().all(|frame| frame == &frames[0]), "{rays}, {detail:?}");
                frames.into_iter().next()
            };
            let mut frames = vec![frame(Detail::FULL)];
            assert!(frames[0] == frame(Detail::try_from(sizes[0].0 * 0.999).unwrap()), "no cells are so small");
            for &(side, n_triangles) in &sizes {
                let detail = Detail::try_from(side).unwrap();
                assert_eq!(scenes[0].at(detail).n_triangles(), n_triangles);
                frames.push(frame(detail));
            }
            frames.dedup();
            assert_eq!(frames.len(), 1 + sizes.len(), "each stand-in is another");
        }
    }

    /// Renders a frame in several ways and gives it back.
    fn check_divisions(scene: &Scene, spec: &FrameSpec) -> Vec<u8> {
        let mut frames = Vec::new();
        for (division, machines) in [(Division::Tiled, 1), (Division::Tiled, 3), (Division::Interleaved, 5)] {
            let mut frame = vec![0; 37 * 21 * 3];
            for machine in 0..machines {
                let task = division.task(machine, machines);
                let share = task.share(spec.size).unwrap();
                let mut rgb = Vec::new();
                let middle = share.count() / 3;
                for units in [0..middle, middle..share.count()] {
                    scene.render(spec, &share, units, &mut rgb);
                }
                let samples = (0..share.count()).flat_map(|unit| share.samples(unit).iter());
                for ((i, j), color) in samples.zip(rgb.chunks_exact(3)) {
                    let at = (j * 37 + i) as usize * 3;
                    frame[at..at + 3].copy_from_slice(color);
                }
            }
            frames.push(frame);
        }
        assert!(frames.iter().all(|frame| frame == &frames[0]));
        assert!(frames[0].chunks_exact(3).any(|color| color[0] > 100), "the model is seen");
        frames.swap_remove(0)
    }
}
