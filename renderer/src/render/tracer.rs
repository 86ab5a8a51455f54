//! Traces and shades a share of a frame.

use std::{ops::Range, time::Duration};

use glam::Vec3;
use shared::{
    appearance::ClipPlane,
    camera::CameraRays,
    division::{Division, Share},
    protocol::FrameSpec,
};

use crate::{
    intersect::{MOST_PACKETS, Packet, PacketScratch, clip, ray::Hit},
    render::{
        blocks::{SampleBlock, for_each_group, lanes_to_rows, sum_terms_by_lane},
        lighting::{LightSums, Lighting},
        parallel::work_off,
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
        let n_samples: u32 = units.clone().map(|unit| share.samples(unit).count()).sum();
        let first = rgb.len();
        rgb.resize(first + 3 * n_samples as usize, 0);
        let (pixels, _) = rgb[first..].as_chunks_mut::<3>();
        let n_samples = spec.samples.count;
        self.sum_lights(spec, share, units, |lighting, sums, at, index| {
            pixels[index] = lighting.encode(sums, at, n_samples);
        });
    }

    /// Sums the light of all samples of the pixels of `units` of a share, on the calling thread; calls `visit` with the sums,
    /// block and index of each pixel, and its index in the order of [`Share::samples`].
    pub fn sum_lights(
        &self,
        spec: &FrameSpec,
        share: &Share,
        units: Range<u32>,
        mut visit: impl FnMut(&Lighting<'_>, &LightSums, (usize, usize), usize),
    ) {
        let spec = &FrameSpec { camera: self.local(&spec.camera), ..*spec };
        let rays = spec.camera.rays(spec.size);
        let clip = self.clip_plane(&spec.camera, spec.appearance.clip);
        let lighting = Lighting::new(self, spec, clip);
        let mut scratch = PacketScratch::default();
        let mut packets = [Packet::NONE; MOST_PACKETS];
        let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
        let mut directions = [[Vec3::ZERO; 64]; MOST_PACKETS];
        for_each_group(share, units, |blocks| {
            let mut sums = lighting.no_light();
            // Sum the light of all samples of the blocks' pixels.
            for index in 0..spec.samples.count {
                let sample = spec.samples.first.wrapping_add(index);
                let packets = &mut packets[..blocks.len()];
                packets
                    .iter_mut()
                    .zip(blocks)
                    .for_each(|(packet, block)| set_camera_rays(packet, &rays, block, sample));
                self.trace_group(blocks, packets, clip.as_ref(), &mut scratch, &mut hits[..blocks.len()]);
                for (index, (block, packet)) in blocks.iter().zip(packets).enumerate() {
                    let [x, y, z] = &packet.directions;
                    for (lane, &sample_idx) in block.sample_of_lane().iter().enumerate() {
                        directions[index][sample_idx] = Vec3::new(x[lane], y[lane], z[lane]);
                    }
                }
                let lights = lighting.light_group(blocks, sample, &directions, &hits, &mut scratch);
                lighting.add(blocks.len(), &lights, &hits, &mut sums);
            }
            for (number, block) in blocks.iter().enumerate() {
                for index in 0..block.n_samples() {
                    visit(&lighting, &sums, (number, index), block.output_index(index));
                }
            }
        });
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
        clip: Option<&ClipPlane>,
        scratch: &mut PacketScratch,
        hits: &mut [[Hit; 64]],
    ) {
        clip::intersect_packets(&self.grid, clip, packets, scratch, hits);
        for (block, hits) in blocks.iter().zip(hits) {
            if block.tile().is_some() {
                lanes_to_rows(hits);
            }
        }
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
            let (i, j) = block.sample(index);
            let (x, y) = sample_point(i, j, sample);
            let direction = rays.direction_through(x, y);
            (0..3).for_each(|axis| packet.directions[axis][lane] = direction[axis]);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{
        appearance::{Appearance, Light},
        camera::Camera,
        division::{Division, FrameSize},
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
            scene: SceneId::Statue { triangles: 0, crease: Default::default() },
            camera: Camera::look_at(DVec3::new(1.0, 2.0, 5.0), DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap(),
            size: FrameSize::new(37, 21).unwrap(),
            view: ShadingMode::Shaded,
            rays: LightingMode::Primary,
            samples: SampleRange { first, count },
            appearance: Appearance::default(),
        }
    }

    #[test]
    fn the_samples_do_not_depend_on_the_division() {
        check_divisions(&tetrahedron(), &spec(0, 3));
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
        for (rays, appearance) in LightingMode::VARIANTS
            .iter()
            .copied()
            .flat_map(|rays| [Appearance::default(), cut].map(|appearance| (rays, appearance)))
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
