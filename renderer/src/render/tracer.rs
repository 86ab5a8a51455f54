//! Traces and shades a share of a frame.

use std::ops::Range;

use glam::Vec3;
use rayon::prelude::*;
use shared::{
    appearance::{Appearance, Clip, ClipPlane},
    camera::{Camera, CameraRays},
    division::{FrameSize, Share},
    protocol::{LightingMode, ProbeHit, SampleRange, ShadingMode},
    srgb,
};

use crate::{
    grid::{Grid, GridOptions, traced::TracedMesh},
    intersect::{
        MOST_PACKETS, Packet, PacketScratch, clip,
        ray::{Hit, Ray},
    },
    model::mesh::Mesh,
    render::{
        blocks::{SampleBlock, for_each_group, lanes_to_rows, sum_terms_by_lane},
        lighting::Lighting,
    },
};

/// A mesh with its grid: all that rays need.
pub struct Scene {
    grid: Grid,
}

/// How a scene is made ready.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SceneOptions {
    /// The grid's.
    pub grid: GridOptions,
}

/// A picture of a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameRequest {
    /// From where.
    pub camera: Camera,
    /// At which resolution.
    pub size: FrameSize,
    /// What the samples show.
    pub view: ShadingMode,
    /// By which rays they are lit.
    pub rays: LightingMode,
    /// Which samples of each pixel.
    pub samples: SampleRange,
    /// From where it is lit, what is behind the model, and where it is cut open.
    pub appearance: Appearance,
}

impl Scene {
    /// Builds the grid, on the threads of the rayon pool that this is called in.
    /// `progress` is told now and then what part is done, from 0 to 1, from any thread.
    pub fn build(mesh: Mesh, options: &SceneOptions, progress: &(dyn Fn(f32) + Sync)) -> Self {
        let grid = Grid::build(mesh, &options.grid, progress);
        Self { grid }
    }

    /// A scene of a grid that is already there.
    pub fn from_grid(grid: Grid) -> Self {
        Self { grid }
    }

    /// The grid alone.
    pub fn into_grid(self) -> Grid {
        self.grid
    }

    /// The mesh, in the grid's order.
    pub fn mesh(&self) -> &TracedMesh {
        self.grid.mesh()
    }

    /// The grid.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Triangles that can be hit.
    pub fn n_triangles(&self) -> usize {
        self.mesh().n_triangles()
    }

    /// Bytes of mesh and grid in memory.
    pub fn n_bytes(&self) -> usize {
        self.mesh().n_bytes() + self.grid.n_bytes()
    }

    /// The same hit, with the triangle's number in the file instead of its place in the mesh.
    #[inline]
    pub fn with_file_index(&self, hit: Hit) -> Hit {
        if hit.is_miss() { hit } else { Hit { triangle: self.mesh().file_index(hit.triangle), ..hit } }
    }

    /// The nearest triangle at a point of the view plane, given as parts of its edges u and v: by the same arithmetic as
    /// in frames, so that it is the triangle that is seen.
    pub fn probe(&self, camera: &Camera, at: [f32; 2], clip: Option<Clip>) -> Option<ProbeHit> {
        let direction = camera.rays(FrameSize::ONE).direction_through(at[0], at[1]);
        if !direction.is_finite() {
            return None;
        }
        let plane = self.clip_plane(camera, clip);
        let ray = Ray::new(camera.eye().as_vec3(), direction);
        let hit = self.with_file_index(clip::intersect(&self.grid, plane.as_ref(), ray));
        (!hit.is_miss()).then_some(ProbeHit { triangle: hit.triangle, t: hit.t })
    }

    /// The plane that cuts this scene open in a picture by this camera.
    pub fn clip_plane(&self, camera: &Camera, clip: Option<Clip>) -> Option<ClipPlane> {
        let bounds = self.mesh().bounds();
        let [min, max] = [bounds.min, bounds.max].map(|corner| Vec3::from_array(corner).as_dvec3());
        clip?.plane((min, max), camera)
    }

    /// What turns the hits of a frame into light.
    pub fn lighting(&self, spec: &FrameRequest) -> Lighting<'_> {
        Lighting::new(&self.grid, spec, self.clip_plane(&spec.camera, spec.appearance.clip))
    }

    /// Renders the share's units `units` (places in the share, not numbers in the frame), on the calling thread.
    ///
    /// Appends their samples to `rgb`, sRGB-encoded, in the order of [`Share::samples`]. The bits depend on nothing but
    /// scene, request and sample, so several threads may render parts of one share.
    pub fn render(&self, spec: &FrameRequest, share: &Share<'_>, units: Range<u32>, rgb: &mut Vec<u8>) {
        let rays = spec.camera.rays(spec.size);
        let clip = self.clip_plane(&spec.camera, spec.appearance.clip);
        let lighting = self.lighting(spec);
        let mut scratch = PacketScratch::default();
        let n_samples: u32 = units.clone().map(|unit| share.samples(unit).count()).sum();
        let first = rgb.len();
        rgb.resize(first + 3 * n_samples as usize, 0);
        let (pixels, _) = rgb[first..].as_chunks_mut::<3>();
        let mut packets = [Packet::NONE; MOST_PACKETS];
        let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
        let mut directions = [[Vec3::ZERO; 64]; MOST_PACKETS];
        for_each_group(share, units, |blocks| {
            let mut sums = [[Vec3::ZERO; 64]; MOST_PACKETS];
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
                let all = sums.as_flattened_mut().iter_mut().zip(lights.as_flattened());
                all.take(64 * blocks.len()).for_each(|(sum, light)| *sum += light);
            }
            for (block, sums) in blocks.iter().zip(&sums) {
                for (index, sum) in sums.iter().take(block.n_samples()).enumerate() {
                    pixels[block.output_index(index)] = (*sum / spec.samples.count as f32).to_array().map(srgb::encode);
                }
            }
        });
    }

    /// [`Scene::render`] on all threads of the rayon pool that this is called in.
    pub fn render_parallel(&self, spec: &FrameRequest, share: &Share<'_>) -> Vec<u8> {
        let direction_terms: Vec<_> = unit_ranges(share, SAMPLES_PER_JOB)
            .into_par_iter()
            .map(|units| {
                let mut rgb = Vec::new();
                self.render(spec, share, units, &mut rgb);
                rgb
            })
            .collect();
        direction_terms.concat()
    }

    /// Traces the share's units `units` through the centres of their samples, in a scene that a plane may cut open, on the
    /// calling thread; calls `visit` with each block and what each of its samples hits.
    pub fn trace(
        &self,
        rays: &CameraRays,
        clip: Option<&ClipPlane>,
        share: &Share<'_>,
        units: Range<u32>,
        mut visit: impl FnMut(&SampleBlock<'_>, &[Hit]),
    ) {
        let mut scratch = PacketScratch::default();
        self.trace_groups(rays, clip, share, units, &mut scratch, |blocks, hits, _| {
            blocks.iter().zip(hits).for_each(|(block, hits)| visit(block, &hits[..block.n_samples()]));
        });
    }

    /// The same for blocks that are neighbours at once; `visit` may use `scratch` too.
    pub fn trace_groups(
        &self,
        rays: &CameraRays,
        clip: Option<&ClipPlane>,
        share: &Share<'_>,
        units: impl Iterator<Item = u32> + Clone,
        scratch: &mut PacketScratch,
        mut visit: impl FnMut(&[SampleBlock<'_>], &[[Hit; 64]], &mut PacketScratch),
    ) {
        let mut packets = [Packet::NONE; MOST_PACKETS];
        let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
        for_each_group(share, units, |blocks| {
            let (packets, hits) = (&mut packets[..blocks.len()], &mut hits[..blocks.len()]);
            packets.iter_mut().zip(blocks).for_each(|(packet, block)| set_camera_rays(packet, rays, block, 0));
            self.trace_group(blocks, packets, clip, scratch, hits);
            visit(blocks, hits, scratch);
        });
    }

    /// Finds what the rays of neighbouring blocks' packets hit, in the order of each block's samples.
    fn trace_group(
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

/// Makes a packet the rays through sample number `sample` of a block's pixels, in the lanes that [`SampleBlock::in_lanes`] tells.
fn set_camera_rays(packet: &mut Packet, rays: &CameraRays, block: &SampleBlock<'_>, sample: u32) {
    packet.origin = rays.eye;
    packet.active = u64::MAX >> (64 - block.n_samples());
    if let (Some((i, j)), 0) = (block.tile(), sample) {
        // A tile's rays share what they have of their column and of their row: up to 5 % of a frame's time.
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

/// Samples of one task: enough that starting it costs nothing, few enough that threads end together.
const SAMPLES_PER_JOB: u32 = 2048;

/// Cuts a share into runs of units with about `n_samples` each.
pub fn unit_ranges(share: &Share<'_>, n_samples: u32) -> Vec<Range<u32>> {
    if share.count() == 0 {
        return Vec::new();
    }
    let step = (n_samples / share.samples(0).count()).max(1);
    (0..share.count()).step_by(step as usize).map(|first| first..(first + step).min(share.count())).collect()
}

/// Where sample number `sample` of pixel (i, j) pierces the view plane, in samples from its lower-left corner.
///
/// Sample 0 is the pixel's centre; the others follow the R₂ sequence (Roberts, "The Unreasonable Effectiveness of
/// Quasirandom Sequences", 2018), shifted differently in each pixel, so that neighbours do not share a pattern.
pub fn sample_point(i: u32, j: u32, sample: u32) -> (f32, f32) {
    if sample == 0 {
        return (i as f32 + 0.5, j as f32 + 0.5);
    }
    // 2³² over the plastic number and over its square.
    let along = |step: u32, seed: u32| {
        let sample_idx = hash_u32(i ^ hash_u32(j ^ seed)).wrapping_add(step.wrapping_mul(sample));
        // 23 bits, so that neither the half step nor the product is rounded.
        ((sample_idx >> 9) as f32 + 0.5) * (1.0 / 8_388_608.0)
    };
    (i as f32 + along(3_242_174_889, 1), j as f32 + along(2_447_445_414, 2))
}

/// A mixing of bits: "lowbias32" of Wellons, "Prospecting for Hash Functions" (2018).
pub(crate) fn hash_u32(mut x: u32) -> u32 {
    x = (x ^ x >> 16).wrapping_mul(0x7feb_352d);
    x = (x ^ x >> 15).wrapping_mul(0x846c_a68b);
    x ^ x >> 16
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intersect::InstructionSet;
    use glam::DVec3;
    use shared::{appearance::Light, division::Division};

    fn tetrahedron() -> Scene {
        let mesh = Mesh {
            vertices: vec![[-1.0, -1.0, -1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 1.0]],
            triangles: vec![[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]],
            ..Mesh::default()
        };
        Scene::build(mesh, &SceneOptions::default(), &|_| ())
    }

    fn spec(first: u32, count: u32) -> FrameRequest {
        FrameRequest {
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
        let (mut n_hits, mut n_other) = (0, 0);
        for (i, j) in (0..size.yres()).flat_map(|j| (0..size.xres()).map(move |i| (i, j))) {
            let seen = scene.with_file_index(scene.grid.intersect(&Ray::new(rays.eye, rays.direction(i, j))));
            let at = [(i as f32 + 0.5) / size.xres() as f32, (j as f32 + 0.5) / size.yres() as f32];
            let probed = scene.probe(&spec.camera, at, None);
            n_hits += u32::from(probed.is_some());
            // The rays differ in their last bits, which only on an edge is another triangle.
            let is_same = match probed {
                None => seen.is_miss(),
                Some(hit) => hit.triangle == seen.triangle && (hit.t - seen.t).abs() < 1e-5 * seen.t,
            };
            n_other += u32::from(!is_same);
        }
        assert!(n_hits > 80 && n_other <= 2, "{n_hits} hits, {n_other} of them others");
        for at in [[f32::NAN, 0.5], [f32::INFINITY, 0.0], [f32::MAX, f32::MAX], [-9.0, 0.5]] {
            assert_eq!(scene.probe(&spec.camera, at, None), None);
        }
    }

    #[test]
    fn neither_division_nor_instructions_change_a_ray_tree() {
        let mesh = crate::model::statue::generate(3000, &|_| ());
        let camera = Camera::look_at(DVec3::new(0.6, 1.5, 2.5), DVec3::Y, DVec3::Y, 0.5, 2.0).unwrap();
        let cut = Appearance { light: Light::PRESETS[5].1, clip: "eye:40".parse().ok(), ..Appearance::default() };
        for (rays, appearance) in LightingMode::ALL
            .into_iter()
            .flat_map(|rays| [Appearance::default(), cut].map(|appearance| (rays, appearance)))
        {
            let spec = FrameRequest { camera, rays, appearance, ..spec(1, 2) };
            let frames = InstructionSet::available().into_iter().map(|instructions| {
                let grid = Grid::build(mesh.clone(), &GridOptions::default(), &|_| ()).with_instructions(instructions);
                check_divisions(&Scene { grid }, &spec)
            });
            let frames: Vec<_> = frames.collect();
            assert!(frames.iter().all(|frame| frame == &frames[0]), "{rays:?} {appearance:?}");
        }
    }

    /// Renders a frame in several ways and gives it back.
    fn check_divisions(scene: &Scene, spec: &FrameRequest) -> Vec<u8> {
        let mut frames = Vec::new();
        for (division, machines) in [(Division::Tiled, 1), (Division::Tiled, 3), (Division::Interleaved, 5)] {
            let mut frame = vec![0; 37 * 21 * 3];
            for machine in 0..machines {
                let task = division.task(machine, machines);
                let share = task.share(spec.size).unwrap();
                let rgb = scene.render_parallel(spec, &share);
                let places = (0..share.count()).flat_map(|unit| share.samples(unit).iter());
                for ((i, j), color) in places.zip(rgb.chunks_exact(3)) {
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

    #[test]
    fn sample_points_fill_their_pixel() {
        assert_eq!(sample_point(3, 4, 0), (3.5, 4.5));
        let mut seen = [false; 16];
        for sample in 1..=64 {
            let (x, y) = sample_point(7, 1000, sample);
            assert!((7.0..=8.0).contains(&x) && (1000.0..=1001.0).contains(&y), "{x} {y}");
            seen[((x - 7.0) * 4.0) as usize % 4 * 4 + ((y - 1000.0) * 4.0) as usize % 4] = true;
        }
        assert_eq!(seen, [true; 16], "64 samples leave no sixteenth of a pixel empty");
        assert_ne!(sample_point(7, 1, 1).0.fract(), sample_point(8, 1, 1).0.fract());
    }
}
