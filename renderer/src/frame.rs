//! One whole frame, traced and shaded in parallel, with the CPU time that it took.

use std::{
    io,
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use clap::ValueEnum;
use cpu_time::ThreadTime;
use glam::Vec3;
use rayon::prelude::*;
use shared::{
    division::{Division, FrameSize, TILE_SIZE},
    srgb,
};

use super::shadows::ShadowCaster;
use crate::{
    blocks::{Block, for_each_group},
    clip,
    grid::{MOST_PACKETS, PacketScratch, RayCost},
    ray::{Hit, Ray},
    tracer::{FrameRequest, Scene},
};

/// The hits and the colours of one frame, row by row from the bottom.
#[derive(Default)]
pub struct Frame {
    /// With the triangles' places in the mesh; their numbers in the file would have to be fetched from far away.
    hits: Vec<Hit>,
    /// Colours, sRGB-encoded.
    pub rgb: Vec<u8>,
}

/// How the primary rays of a measured frame are followed: to the same hits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Kernel {
    /// Those of a square of four tiles together
    #[default]
    Packet,
    /// One after the other, as if they had nothing in common
    Single,
}

/// What is traced for a measured frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct FrameOptions {
    /// How primary rays are followed.
    pub kernel: Kernel,
    /// Where the light of the shadow rays stands, in world space; without one there are no shadow rays.
    pub light: Option<Vec3>,
}

/// What tracing a frame took.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cost {
    /// Wall time.
    pub wall: Duration,
    /// CPU time of all threads.
    pub cpu: Duration,
    /// Shadow rays that were traced.
    pub n_shadow_rays: usize,
    /// Hits that the light does not reach, because they face away from it or something is in between.
    pub n_shadowed: usize,
}

impl Frame {
    /// Traces all samples through their centres, and from each hit a shadow ray to the light if there is one, on the
    /// threads of the rayon pool that this is called in.
    pub fn trace(&mut self, scene: &Scene, request: &FrameRequest, options: &FrameOptions) -> Cost {
        let rays = request.camera.rays(request.size);
        let clip = scene.clip_plane(&request.camera, request.look.clip);
        let clip = clip.as_ref();
        let work = Division::Tiled.work(0, 1);
        let Ok(share) = work.share(request.size) else { return Cost::default() };
        self.hits.resize(request.size.n_samples() as usize, Hit::MISS);

        let start = Instant::now();
        let sum = on_all_threads(parts(&mut self.hits, 1, request.size), |next| {
            let mut cost = Cost::default();
            let mut scratch = PacketScratch::default();
            while let Some(mut part) = next() {
                let tiles = part.tiles.clone();
                // What a group's rays met is still in the cache for its shadow rays.
                let mut visit = |blocks: &[Block<'_>], hits: &[[Hit; 64]], scratch: &mut PacketScratch| {
                    for (block, hits) in blocks.iter().zip(hits) {
                        if let Some((i, first_j)) = block.tile() {
                            // Of a known length, rows are copied without a call.
                            for (j, hits) in (first_j..).zip(hits.as_chunks::<8>().0) {
                                part.row_from((i, j))[..8].copy_from_slice(hits);
                            }
                        } else {
                            block.samples().zip(hits).for_each(|(sample, &hit)| part.row_from(sample)[0] = hit);
                        }
                    }
                    if let Some(light) = options.light {
                        let caster = ShadowCaster { scene, rays: &rays, light, kernel: options.kernel };
                        let (n_rays, n_hidden) = caster.cast(blocks, hits, scratch);
                        cost.n_shadow_rays += n_rays;
                        cost.n_shadowed += n_hidden;
                    }
                };
                match options.kernel {
                    Kernel::Packet => scene.trace_groups(&rays, clip, &share, tiles, &mut scratch, visit),
                    Kernel::Single => tiles.for_each(|tile| {
                        let samples = share.samples(tile);
                        let mut hits = [Hit::MISS; 64];
                        for (hit, (i, j)) in hits.iter_mut().zip(samples.iter()) {
                            *hit = clip::intersect(scene.grid(), clip, Ray::new(rays.eye, rays.direction(i, j)));
                        }
                        visit(&[Block::Unit { samples, first_place: 0 }], &[hits], &mut scratch);
                    }),
                }
            }
            cost
        });
        Cost { wall: start.elapsed(), ..sum }
    }

    /// Shades all hits; returns the CPU time of all threads.
    pub fn shade(&mut self, scene: &Scene, request: &FrameRequest) -> Duration {
        let rays = request.camera.rays(request.size);
        let lighting = scene.lighting(request);
        let work = Division::Tiled.work(0, 1);
        let Ok(share) = work.share(request.size) else { return Duration::ZERO };
        self.rgb.resize(3 * self.hits.len(), 0);
        let all_hits = &self.hits;
        let sum = on_all_threads(parts(&mut self.rgb, 3, request.size), |next| {
            let mut scratch = PacketScratch::default();
            let mut directions = [[Vec3::ZERO; 64]; MOST_PACKETS];
            let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
            while let Some(mut part) = next() {
                for_each_group(&share, part.tiles.clone(), |blocks| {
                    for (index, block) in blocks.iter().enumerate() {
                        for (place, (i, j)) in block.samples().enumerate() {
                            directions[index][place] = rays.direction(i, j);
                            hits[index][place] = all_hits[(j * request.size.xres() + i) as usize];
                        }
                    }
                    let lights = lighting.of_group(blocks, 0, &directions, &hits, &mut scratch);
                    for (block, lights) in blocks.iter().zip(lights) {
                        for (sample, light) in block.samples().zip(lights) {
                            part.row_from(sample)[..3].copy_from_slice(&light.to_array().map(srgb::encode));
                        }
                    }
                });
            }
            Cost::default()
        });
        sum.cpu
    }

    /// Writes the hits: per sample, little endian, the triangle in file order as `u32` (0xffffffff for none) and t as
    /// `f32` in units of the ray's direction (infinite for none).
    pub fn write_hits(&self, scene: &Scene, out: &mut dyn io::Write) -> io::Result<()> {
        self.hits.iter().try_for_each(|&hit| {
            let hit = scene.in_file_order(hit);
            out.write_all(&hit.triangle.to_le_bytes())?;
            out.write_all(&hit.t.to_le_bytes())
        })
    }

    /// How many samples hit something.
    pub fn n_hits(&self) -> usize {
        self.hits.iter().filter(|hit| !hit.is_miss()).count()
    }
}

/// What the primary rays of a frame cost when each is followed alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct CostSum {
    /// Cells that they pass.
    pub n_cells: u64,
    /// Triangles that they are tested against.
    pub n_tests: u64,
}

/// Counts what the primary rays of a frame cost, on the threads of the rayon pool that this is called in.
pub fn cost_sum(scene: &Scene, request: &FrameRequest) -> CostSum {
    let rays = request.camera.rays(request.size);
    let clip = scene.clip_plane(&request.camera, request.look.clip);
    let of_row = |j: u32| {
        (0..request.size.xres()).fold(CostSum::default(), |sum, i| {
            let ray = clip::kept(clip.as_ref(), Ray::new(rays.eye, rays.direction(i, j)));
            let cost = ray.map_or(RayCost::default(), |ray| scene.grid().cost(&ray));
            CostSum { n_cells: sum.n_cells + u64::from(cost.n_cells), n_tests: sum.n_tests + u64::from(cost.n_tests) }
        })
    };
    (0..request.size.yres())
        .into_par_iter()
        .map(of_row)
        .reduce(CostSum::default, |a, b| CostSum { n_cells: a.n_cells + b.n_cells, n_tests: a.n_tests + b.n_tests })
}

/// Into so many parts for each thread what is left of a frame is divided when one is taken: large ones first, for each costs
/// something, small ones last, so that threads end together (guided self-scheduling; Polychronopoulos and Kuck, 1987).
const PARTS_PER_THREAD: u32 = 8;

/// Columns of tiles in a part, at least.
const LEAST_COLUMNS: u32 = 4;

/// A part of a frame, for one thread at a time: some columns of two rows of tiles, whose squares of 2×2 go together.
struct Part<'a, T, I> {
    /// The tiles' numbers.
    tiles: I,
    /// The part's first sample.
    first: (u32, u32),
    /// What belongs to each row of samples, as many `T` for each sample as the frame has.
    rows: Vec<&'a mut [T]>,
    per_sample: u32,
}

impl<T, I> Part<'_, T, I> {
    /// What belongs to a sample, and to those that follow in its row.
    fn row_from(&mut self, (i, j): (u32, u32)) -> &mut [T] {
        let first = (i - self.first.0) * self.per_sample;
        &mut self.rows[(j - self.first.1) as usize][first as usize..]
    }
}

/// All parts of a frame that has `per_sample` of `all` for each sample, row by row, for the threads of the rayon pool that
/// this is called in.
fn parts<T>(
    all: &mut [T],
    per_sample: u32,
    size: FrameSize,
) -> impl Iterator<Item = Part<'_, T, impl Iterator<Item = u32> + Clone>> {
    let row_length = (size.xres() * per_sample) as usize;
    let (x_tiles, y_tiles) = (size.x_tiles(), size.y_tiles());
    let n_threads = rayon::current_num_threads() as u32;
    let bands = (0..).step_by(2).zip(all.chunks_mut(row_length * 2 * TILE_SIZE as usize));
    bands.flat_map(move |(row, band)| {
        let rows = row..(row + 2).min(y_tiles);
        let n_tiles = (y_tiles - row) * x_tiles / (PARTS_PER_THREAD * n_threads);
        // Two rows high, and as wide as whole squares.
        let n_columns = (n_tiles / 2).max(LEAST_COLUMNS).min(x_tiles).next_multiple_of(2);
        let mut parts: Vec<_> = (0..x_tiles)
            .step_by(n_columns as usize)
            .map(|column| {
                let end = (column + n_columns).min(x_tiles);
                let rows = rows.clone();
                // Square by square, so that nobody has to sort them.
                let tiles = (column..end).step_by(2).flat_map(move |column| {
                    let columns = column..(column + 2).min(end);
                    rows.clone().flat_map(move |row| columns.clone().map(move |column| row * x_tiles + column))
                });
                Part { tiles, first: (column * TILE_SIZE, row * TILE_SIZE), rows: Vec::new(), per_sample }
            })
            .collect();
        for row in band.chunks_mut(row_length) {
            let of_parts = row.chunks_mut((n_columns * TILE_SIZE * per_sample) as usize);
            parts.iter_mut().zip(of_parts).for_each(|(part, of_part)| part.rows.push(of_part));
        }
        parts
    })
}

/// How long a thread that has nothing left to do waits, awake, for the others.
///
/// Asleep, it would have to be woken: that took 0.2 to 0.4 % of a frame on two threads. The last parts of a frame, which are
/// small, take less than this.
const AWAKE: Duration = Duration::from_millis(1);

/// Has all threads of the rayon pool that this is called in take parts until none is left, and adds up what that cost.
///
/// All are woken at once, and none is given more than it works on: what others could not take would be waited for.
fn on_all_threads<P: Send>(
    parts: impl Iterator<Item = P> + Send,
    take: impl Fn(&mut dyn FnMut() -> Option<P>) -> Cost + Sync,
) -> Cost {
    let parts = Mutex::new(parts);
    let n_at_work = AtomicUsize::new(rayon::current_num_threads());
    let costs = rayon::broadcast(|_| {
        let start = ThreadTime::now();
        let cost = take(&mut || parts.lock().ok()?.next());
        let cost = Cost { cpu: start.elapsed(), ..cost };
        // Waiting is no work: its CPU time does not count.
        n_at_work.fetch_sub(1, Ordering::Relaxed);
        let done = Instant::now();
        while n_at_work.load(Ordering::Relaxed) > 0 && done.elapsed() < AWAKE {
            // With more threads than cores, another may need this one.
            thread::yield_now();
        }
        cost
    });
    costs.into_iter().fold(Cost::default(), |sum, cost| Cost {
        cpu: sum.cpu + cost.cpu,
        n_shadow_rays: sum.n_shadow_rays + cost.n_shadow_rays,
        n_shadowed: sum.n_shadowed + cost.n_shadowed,
        ..sum
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::threads;

    #[test]
    fn parts_are_the_whole_frame_whatever_its_size() {
        for (xres, yres) in [(1, 1), (7, 301), (37, 21), (301, 7), (1024, 512)] {
            let size = FrameSize::new(xres, yres).unwrap();
            let work = Division::Tiled.work(0, 1);
            let share = work.share(size).unwrap();
            for n_threads in [1, 2, 16] {
                let pool = threads::pool(Some(n_threads)).unwrap();
                let mut all = vec![[0; 3]; size.n_samples() as usize];
                pool.install(|| {
                    for mut part in parts(all.as_flattened_mut(), 3, size) {
                        for tile in part.tiles.clone() {
                            for (i, j) in share.samples(tile).iter() {
                                part.row_from((i, j))[..3].iter_mut().zip([i, j, 1]).for_each(|(to, n)| *to += n);
                            }
                        }
                    }
                });
                let expected = (0..yres).flat_map(|j| (0..xres).map(move |i| [i, j, 1]));
                assert!(all.into_iter().eq(expected), "{size}, {n_threads} threads");
            }
        }
    }
}
