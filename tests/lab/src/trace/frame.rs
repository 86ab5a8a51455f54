//! One whole frame on all threads, with its CPU time: by packets or by single rays, with or without shadow rays.

use std::{
    io,
    time::{Duration, Instant},
};

use clap::ValueEnum;
use glam::{DVec3, Vec3};
use renderer::{
    intersect::{
        MOST_PACKETS, Packet, PacketScratch, clip,
        ray::{Hit, Ray},
    },
    render::{
        blocks::{SampleBlock, for_each_group},
        lighting::Lighting,
        parallel::work_off,
        scene::Scene,
        tracer::set_camera_rays,
    },
};
use shared::{
    appearance::ClipPlane,
    camera::CameraRays,
    division::{Division, FrameSize, Share, TILE_SIZE},
    protocol::FrameSpec,
};

use super::shadows::ShadowCaster;

/// How rays are traced; the hits are the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Kernel {
    /// Those of four tiles of a square together
    #[default]
    Packet,
    /// One by one
    Single,
}

/// Options of a measured frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameOptions {
    /// How rays are traced.
    pub kernel: Kernel,
    /// Position of the light in world space; `None` traces no shadow rays.
    pub light: Option<DVec3>,
}

/// Time spent on tracing a frame, and the rays beside the primary ones.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cost {
    /// Wall time.
    pub wall: Duration,
    /// CPU time of all threads.
    pub cpu: Duration,
    /// Shadow rays traced.
    pub n_shadow_rays: usize,
    /// Hits that face away from the light or are occluded from it.
    pub n_shadowed: usize,
}

/// The hits and colours of one frame, tile by tile.
pub struct Frame {
    size: FrameSize,
    /// All tiles of the frame.
    share: Share,
    /// With triangle indices: looking up file indices while tracing would cost a cache miss for each hit.
    hits: Vec<[Hit; 64]>,
    colors: Vec<[[u8; 3]; 64]>,
}

impl Frame {
    /// A frame without hits.
    pub fn new(size: FrameSize) -> Self {
        let share = Division::Tiled.task(0, 1).share(size).expect("one machine renders any frame");
        let n_tiles = share.count() as usize;
        Self { size, share, hits: vec![[Hit::MISS; 64]; n_tiles], colors: vec![[[0; 3]; 64]; n_tiles] }
    }

    /// Traces all samples through their centres, and from each hit a shadow ray to the light if there is one, on the
    /// current rayon pool. `spec` has the frame's size.
    pub fn trace(&mut self, scene: &Scene, spec: &FrameSpec, options: &FrameOptions) -> Cost {
        let camera = scene.local(&spec.camera);
        let rays = camera.rays(self.size);
        let clip = scene.clip_plane(&camera, spec.appearance.clip);
        let share = &self.share;

        let start = Instant::now();
        let of_threads = work_off(parts(&mut self.hits, self.size), |next| {
            let (mut n_shadow_rays, mut n_shadowed) = (0, 0);
            let mut scratch = PacketScratch::default();
            while let Some(mut part) = next() {
                let tiles = part.tiles();
                // Shadow rays follow at once, while their triangles are in the cache.
                let mut visit = |blocks: &[SampleBlock<'_>], hits: &[[Hit; 64]], scratch: &mut PacketScratch| {
                    blocks.iter().zip(hits).for_each(|(block, hits)| *part.values_of(block) = *hits);
                    if let Some(light) = options.light {
                        let light = (light - scene.mesh().origin()).as_vec3();
                        let caster = ShadowCaster { scene, rays: &rays, light, kernel: options.kernel };
                        let (n_rays, n_hidden) = caster.cast(blocks, hits, scratch);
                        n_shadow_rays += n_rays;
                        n_shadowed += n_hidden;
                    }
                };
                match options.kernel {
                    Kernel::Packet => trace_groups(scene, &rays, clip.as_ref(), share, tiles, &mut scratch, visit),
                    Kernel::Single => tiles.for_each(|tile| {
                        let samples = share.samples(tile);
                        let mut hits = [Hit::MISS; 64];
                        for (hit, (i, j)) in hits.iter_mut().zip(samples.iter()) {
                            let ray = Ray::new(rays.eye, rays.direction(i, j));
                            *hit = clip::intersect(&scene.grid, clip.as_ref(), ray);
                        }
                        visit(&[SampleBlock::Unit { samples, first_index: 0 }], &[hits], &mut scratch);
                    }),
                }
            }
            (n_shadow_rays, n_shadowed)
        });
        let cost = Cost { wall: start.elapsed(), ..Cost::default() };
        of_threads.into_iter().fold(cost, |sum, ((n_shadow_rays, n_shadowed), cpu)| Cost {
            cpu: sum.cpu + cpu,
            n_shadow_rays: sum.n_shadow_rays + n_shadow_rays,
            n_shadowed: sum.n_shadowed + n_shadowed,
            ..sum
        })
    }

    /// Shades all hits; returns the CPU time, summed over all threads.
    pub fn shade(&mut self, scene: &Scene, spec: &FrameSpec) -> Duration {
        let spec = &FrameSpec { camera: scene.local(&spec.camera), ..*spec };
        let rays = spec.camera.rays(self.size);
        let lighting = Lighting::new(scene, spec, scene.clip_plane(&spec.camera, spec.appearance.clip));
        let (share, all_hits, x_tiles) = (&self.share, &self.hits, self.size.x_tiles());
        let of_threads = work_off(parts(&mut self.colors, self.size), |next| {
            let mut scratch = PacketScratch::default();
            let mut directions = [[[Vec3::ZERO; 64]; MOST_PACKETS]];
            let mut hits = [[[Hit::MISS; 64]; MOST_PACKETS]];
            let mut lights = Vec::new();
            while let Some(mut part) = next() {
                for_each_group(share, part.tiles(), |blocks| {
                    for (index, block) in blocks.iter().enumerate() {
                        let (column, row) = tile_of(block);
                        hits[0][index] = all_hits[(row * x_tiles + column) as usize];
                        for (direction, (i, j)) in directions[0][index].iter_mut().zip(block.samples()) {
                            *direction = rays.direction(i, j);
                        }
                    }
                    let mut sums = lighting.no_light();
                    lighting.light_group(blocks, (&directions, &hits), &mut scratch, &mut lights, &mut sums);
                    for (number, block) in blocks.iter().enumerate() {
                        let colors = part.values_of(block).iter_mut().take(block.n_samples());
                        colors.enumerate().for_each(|(index, color)| *color = lighting.encode(&sums, (number, index)));
                    }
                });
            }
        });
        of_threads.into_iter().map(|((), cpu)| cpu).sum()
    }

    /// Writes the hits: for each sample, little endian, the triangle's file index as `u32` (0xffffffff for a miss,
    /// 0xfffffffe for a cap) and t as `f32` in units of the ray's direction (infinite for a miss).
    pub fn write_hits(&self, scene: &Scene, out: &mut dyn io::Write) -> io::Result<()> {
        self.row_by_row(&self.hits).try_for_each(|hit| {
            let hit = scene.with_file_index(hit);
            out.write_all(&hit.triangle.to_le_bytes())?;
            out.write_all(&hit.t.to_le_bytes())
        })
    }

    /// Number of samples that hit something.
    pub fn n_hits(&self) -> usize {
        self.row_by_row(&self.hits).filter(|hit| !hit.is_miss()).count()
    }

    /// The shaded frame, sRGB-encoded, row by row from the bottom.
    pub fn rgb(&self) -> Vec<u8> {
        self.row_by_row(&self.colors).flatten().collect()
    }

    /// The samples' values, row by row from the bottom.
    fn row_by_row<T: Copy>(&self, tiles: &[[T; 64]]) -> impl Iterator<Item = T> {
        let ((xres, yres), x_tiles) = (self.size.into(), self.size.x_tiles());
        (0..yres).flat_map(move |j| {
            (0..xres).map(move |i| {
                let (column, row) = (i / TILE_SIZE, j / TILE_SIZE);
                let width = TILE_SIZE.min(xres - column * TILE_SIZE);
                tiles[(row * x_tiles + column) as usize][(j % TILE_SIZE * width + i % TILE_SIZE) as usize]
            })
        })
    }
}

/// Traces all samples of a share through their centres, on the calling thread; calls `visit` with each block and its
/// hits.
pub(crate) fn trace_share(
    scene: &Scene,
    rays: &CameraRays,
    share: &Share,
    mut visit: impl FnMut(&SampleBlock<'_>, &[Hit]),
) {
    trace_groups(scene, rays, None, share, 0..share.count(), &mut PacketScratch::default(), |blocks, hits, _| {
        blocks.iter().zip(hits).for_each(|(block, hits)| visit(block, &hits[..block.n_samples()]));
    });
}

/// Traces `units` of a share, in a scene that a plane may cut open; calls `visit` with groups of neighbouring blocks and
/// their hits. It may use `scratch` too.
fn trace_groups(
    scene: &Scene,
    rays: &CameraRays,
    clip: Option<&ClipPlane>,
    share: &Share,
    units: impl Iterator<Item = u32> + Clone,
    scratch: &mut PacketScratch,
    mut visit: impl FnMut(&[SampleBlock<'_>], &[[Hit; 64]], &mut PacketScratch),
) {
    let mut packets: [_; MOST_PACKETS] = std::array::from_fn(|_| Packet { clip: clip.copied(), ..Packet::NONE });
    let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
    for_each_group(share, units, |blocks| {
        let (packets, hits) = (&mut packets[..blocks.len()], &mut hits[..blocks.len()]);
        packets.iter_mut().zip(blocks).for_each(|(packet, block)| set_camera_rays(packet, rays, block, 0));
        scene.trace_group(blocks, packets, scratch, hits);
        visit(blocks, hits, scratch);
    });
}

/// Guided self-scheduling (Polychronopoulos and Kuck, 1987): each part is the remaining frame / (8 × threads). Large parts
/// come first, to save overhead; small ones last, so that threads finish together.
const PARTS_PER_THREAD: usize = 8;

/// Minimum columns of tiles in a part.
const LEAST_COLUMNS: usize = 4;

/// A rectangle of tiles, one or two rows high, with the values of each tile's samples; processed by one thread.
struct Part<'a, T> {
    /// Column and row of the first tile.
    first: (u32, u32),
    x_tiles: u32,
    /// The second row may be empty.
    rows: [&'a mut [[T; 64]]; 2],
}

impl<T> Part<'_, T> {
    /// The tiles' numbers in the frame, in squares of 2×2, whose packets are traced together.
    fn tiles(&self) -> impl Iterator<Item = u32> + Clone + use<T> {
        let ((first, row), x_tiles) = (self.first, self.x_tiles);
        let end = first + self.rows[0].len() as u32;
        let rows = row..row + 1 + u32::from(!self.rows[1].is_empty());
        (first..end).step_by(2).flat_map(move |column| {
            let columns = column..(column + 2).min(end);
            rows.clone().flat_map(move |row| columns.clone().map(move |column| row * x_tiles + column))
        })
    }

    /// The values of a block that is one of the tiles.
    fn values_of(&mut self, block: &SampleBlock<'_>) -> &mut [T; 64] {
        let ((column, row), (first_column, first_row)) = (tile_of(block), self.first);
        &mut self.rows[(row - first_row) as usize][(column - first_column) as usize]
    }
}

/// Column and row of a block that is a tile.
fn tile_of(block: &SampleBlock<'_>) -> (u32, u32) {
    let (i, j) = block.sample(0);
    (i / TILE_SIZE, j / TILE_SIZE)
}

/// Divides a frame into parts for the current rayon pool.
fn parts<T>(tiles: &mut [[T; 64]], size: FrameSize) -> impl Iterator<Item = Part<'_, T>> {
    let x_tiles = size.x_tiles() as usize;
    let (n_tiles, n_parts) = (tiles.len(), PARTS_PER_THREAD * rayon::current_num_threads());
    tiles.chunks_mut(2 * x_tiles).enumerate().flat_map(move |(band_idx, band)| {
        let n_left = n_tiles - 2 * band_idx * x_tiles;
        // Parts are two rows high and whole squares wide.
        let n_columns = (n_left / n_parts / 2).max(LEAST_COLUMNS).min(x_tiles).next_multiple_of(2);
        let (lower, upper) = band.split_at_mut(x_tiles);
        let mut upper = upper.chunks_mut(n_columns);
        lower.chunks_mut(n_columns).enumerate().map(move |(part_idx, lower)| Part {
            first: ((part_idx * n_columns) as u32, 2 * band_idx as u32),
            x_tiles: x_tiles as u32,
            rows: [lower, upper.next().unwrap_or_default()],
        })
    })
}

#[cfg(test)]
mod tests {
    use renderer::render::threads;

    use super::*;

    #[test]
    fn parts_cover_frames_of_any_size() {
        for (xres, yres) in [(1, 1), (7, 301), (37, 21), (301, 7), (1024, 512)] {
            let size = FrameSize::new(xres, yres).unwrap();
            let frame = Frame::new(size);
            for n_threads in [1, 2, 16] {
                let pool = threads::pool(Some(n_threads)).unwrap();
                let mut all = vec![[[0; 3]; 64]; frame.hits.len()];
                pool.install(|| {
                    for mut part in parts(&mut all, size) {
                        for_each_group(&frame.share, part.tiles(), |blocks| {
                            for block in blocks {
                                for ([x, y, n], (i, j)) in part.values_of(block).iter_mut().zip(block.samples()) {
                                    (*x, *y, *n) = (i, j, *n + 1);
                                }
                            }
                        });
                    }
                });
                let expected = (0..yres).flat_map(|j| (0..xres).map(move |i| [i, j, 1]));
                assert!(frame.row_by_row(&all).eq(expected), "{size}, {n_threads} threads");
            }
        }
    }
}
