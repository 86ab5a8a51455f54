//! One whole frame, traced and shaded in parallel, with its CPU time.

use std::{
    io,
    ops::Range,
    time::{Duration, Instant},
};

use glam::Vec3;
use shared::{
    appearance::ClipPlane,
    camera::CameraRays,
    division::{Division, FrameSize, Share, TILE_SIZE},
    protocol::FrameSpec,
    srgb,
};

use crate::{
    intersect::{MOST_PACKETS, PacketScratch, ray::Hit},
    render::{
        blocks::{SampleBlock, for_each_group},
        parallel::work_off,
        scene::Scene,
    },
};

/// The hits and colours of one frame, row by row from the bottom.
#[derive(Default)]
pub struct Frame {
    /// With triangle indices: looking up file indices here would cost a cache miss for each hit.
    hits: Vec<Hit>,
    /// sRGB-encoded colours.
    pub rgb: Vec<u8>,
}

/// Inputs of a frame's primary rays.
pub struct Setup<'a> {
    /// The scene to trace.
    pub scene: &'a Scene,
    /// The rays' origin and directions, in world space.
    pub rays: CameraRays,
    /// The plane that cuts the scene open.
    pub clip: Option<ClipPlane>,
    /// All tiles of the frame.
    pub share: Share,
}

/// Time spent on tracing a frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cost {
    /// Wall time.
    pub wall: Duration,
    /// CPU time of all threads.
    pub cpu: Duration,
}

impl Frame {
    /// Traces one ray through the centre of each sample, on the current rayon pool.
    pub fn trace(&mut self, scene: &Scene, spec: &FrameSpec) -> Cost {
        let follow = |setup: &Setup<'_>, tiles: &Tiles, scratch: &mut PacketScratch, (): &mut (), write: Write<'_>| {
            let Setup { scene, rays, clip, share } = setup;
            let write = |blocks: &[SampleBlock<'_>], hits: &[[Hit; 64]], _: &mut PacketScratch| write(blocks, hits);
            scene.trace_groups(rays, clip.as_ref(), share, tiles.numbers(), scratch, write);
        };
        self.trace_with(scene, spec, follow).0
    }

    /// Like [`Frame::trace`], with hits found by `follow`: it receives the setup, some tiles, scratch memory, a value of
    /// its thread, and a function that it must call with all blocks of the tiles and their hits.
    ///
    /// Also returns the threads' values, which start as their defaults.
    pub fn trace_with<T: Default + Send>(
        &mut self,
        scene: &Scene,
        spec: &FrameSpec,
        follow: impl Fn(&Setup<'_>, &Tiles, &mut PacketScratch, &mut T, Write<'_>) + Sync,
    ) -> (Cost, Vec<T>) {
        let rays = spec.camera.rays(spec.size);
        let clip = scene.clip_plane(&spec.camera, spec.appearance.clip);
        let task = Division::Tiled.task(0, 1);
        let Ok(share) = task.share(spec.size) else { return (Cost::default(), Vec::new()) };
        let setup = Setup { scene, rays, clip, share };
        self.hits.resize(spec.size.n_samples() as usize, Hit::MISS);

        let start = Instant::now();
        let of_threads = work_off(parts(&mut self.hits, 1, spec.size), |next| {
            let mut value = T::default();
            let mut scratch = PacketScratch::default();
            while let Some(Part { tiles, mut samples }) = next() {
                follow(&setup, &tiles, &mut scratch, &mut value, &mut |blocks, hits| {
                    for (block, hits) in blocks.iter().zip(hits) {
                        if let Some((i, first_j)) = block.tile() {
                            // With a constant length, rows are copied without a call to memcpy.
                            for (j, hits) in (first_j..).zip(hits.as_chunks::<8>().0) {
                                samples.row_from((i, j))[..8].copy_from_slice(hits);
                            }
                        } else {
                            block.samples().zip(hits).for_each(|(sample, &hit)| samples.row_from(sample)[0] = hit);
                        }
                    }
                });
            }
            value
        });
        let cpu = of_threads.iter().map(|(_, cpu)| *cpu).sum();
        (Cost { wall: start.elapsed(), cpu }, of_threads.into_iter().map(|(value, _)| value).collect())
    }

    /// Shades all hits; returns the CPU time, summed over all threads.
    pub fn shade(&mut self, scene: &Scene, spec: &FrameSpec) -> Duration {
        let rays = spec.camera.rays(spec.size);
        let lighting = scene.lighting(spec);
        let task = Division::Tiled.task(0, 1);
        let Ok(share) = task.share(spec.size) else { return Duration::ZERO };
        self.rgb.resize(3 * self.hits.len(), 0);
        let all_hits = &self.hits;
        let of_threads = work_off(parts(&mut self.rgb, 3, spec.size), |next| {
            let mut scratch = PacketScratch::default();
            let mut directions = [[Vec3::ZERO; 64]; MOST_PACKETS];
            let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
            while let Some(Part { tiles, mut samples }) = next() {
                for_each_group(&share, tiles.numbers(), |blocks| {
                    for (index, block) in blocks.iter().enumerate() {
                        for (sample_idx, (i, j)) in block.samples().enumerate() {
                            directions[index][sample_idx] = rays.direction(i, j);
                            hits[index][sample_idx] = all_hits[(j * spec.size.xres() + i) as usize];
                        }
                    }
                    let lights = lighting.light_group(blocks, 0, &directions, &hits, &mut scratch);
                    for (block, lights) in blocks.iter().zip(lights) {
                        for (sample, light) in block.samples().zip(lights) {
                            samples.row_from(sample)[..3].copy_from_slice(&light.to_array().map(srgb::encode));
                        }
                    }
                });
            }
        });
        of_threads.into_iter().map(|((), cpu)| cpu).sum()
    }

    /// Writes the hits: for each sample, little endian, the triangle's file index as `u32` (0xffffffff for a miss) and t
    /// as `f32` in units of the ray's direction (infinite for a miss).
    pub fn write_hits(&self, scene: &Scene, out: &mut dyn io::Write) -> io::Result<()> {
        self.hits.iter().try_for_each(|&hit| {
            let hit = scene.with_file_index(hit);
            out.write_all(&hit.triangle.to_le_bytes())?;
            out.write_all(&hit.t.to_le_bytes())
        })
    }

    /// Number of samples that hit something.
    pub fn n_hits(&self) -> usize {
        self.hits.iter().filter(|hit| !hit.is_miss()).count()
    }
}

/// Writes the hits of blocks, each block's in the order of its samples.
pub type Write<'a> = &'a mut dyn FnMut(&[SampleBlock<'_>], &[[Hit; 64]]);

/// Guided self-scheduling (Polychronopoulos and Kuck, 1987): each part is the remaining frame / (8 × threads). Large parts
/// come first, to save overhead; small ones last, so that threads finish together.
const PARTS_PER_THREAD: u32 = 8;

/// Minimum columns of tiles in a part.
const LEAST_COLUMNS: u32 = 4;

/// A rectangle of tiles, up to two rows high.
pub struct Tiles {
    columns: Range<u32>,
    rows: Range<u32>,
    x_tiles: u32,
}

impl Tiles {
    /// The tiles' numbers in the frame, in squares of 2×2, whose packets are traced together.
    pub fn numbers(&self) -> impl Iterator<Item = u32> + Clone + use<> {
        let Self { columns, rows, x_tiles } = self;
        let (end, rows, x_tiles) = (columns.end, rows.clone(), *x_tiles);
        columns.clone().step_by(2).flat_map(move |column| {
            let columns = column..(column + 2).min(end);
            rows.clone().flat_map(move |row| columns.clone().map(move |column| row * x_tiles + column))
        })
    }
}

/// A part of a frame, processed by one thread.
struct Part<'a, T> {
    tiles: Tiles,
    samples: Samples<'a, T>,
}

/// Mutable access to the values of a part's samples.
struct Samples<'a, T> {
    /// The part's first sample (i, j).
    first: (u32, u32),
    /// Rows of samples, with `per_sample` values each.
    rows: Vec<&'a mut [T]>,
    per_sample: u32,
}

impl<T> Samples<'_, T> {
    /// The values of a sample and of those that follow it in its row.
    fn row_from(&mut self, (i, j): (u32, u32)) -> &mut [T] {
        let first = (i - self.first.0) * self.per_sample;
        &mut self.rows[(j - self.first.1) as usize][first as usize..]
    }
}

/// Divides a frame into parts for the current rayon pool. `all` holds `per_sample` values for each sample, row by row.
fn parts<T>(all: &mut [T], per_sample: u32, size: FrameSize) -> impl Iterator<Item = Part<'_, T>> {
    let row_length = (size.xres() * per_sample) as usize;
    let (x_tiles, y_tiles) = (size.x_tiles(), size.y_tiles());
    let n_threads = rayon::current_num_threads() as u32;
    let bands = (0..).step_by(2).zip(all.chunks_mut(row_length * 2 * TILE_SIZE as usize));
    bands.flat_map(move |(row, band)| {
        let n_tiles = (y_tiles - row) * x_tiles / (PARTS_PER_THREAD * n_threads);
        // Parts are two rows high and whole squares wide.
        let n_columns = (n_tiles / 2).max(LEAST_COLUMNS).min(x_tiles).next_multiple_of(2);
        let mut parts: Vec<_> = (0..x_tiles)
            .step_by(n_columns as usize)
            .map(|column| {
                let (columns, rows) = (column..(column + n_columns).min(x_tiles), row..(row + 2).min(y_tiles));
                let first = (column * TILE_SIZE, row * TILE_SIZE);
                Part {
                    tiles: Tiles { columns, rows, x_tiles },
                    samples: Samples { first, rows: Vec::new(), per_sample },
                }
            })
            .collect();
        for row in band.chunks_mut(row_length) {
            let of_parts = row.chunks_mut((n_columns * TILE_SIZE * per_sample) as usize);
            parts.iter_mut().zip(of_parts).for_each(|(part, of_part)| part.samples.rows.push(of_part));
        }
        parts
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::threads;

    #[test]
    fn parts_cover_frames_of_any_size() {
        for (xres, yres) in [(1, 1), (7, 301), (37, 21), (301, 7), (1024, 512)] {
            let size = FrameSize::new(xres, yres).unwrap();
            let task = Division::Tiled.task(0, 1);
            let share = task.share(size).unwrap();
            for n_threads in [1, 2, 16] {
                let pool = threads::pool(Some(n_threads)).unwrap();
                let mut all = vec![[0; 3]; size.n_samples() as usize];
                pool.install(|| {
                    for Part { tiles, mut samples } in parts(all.as_flattened_mut(), 3, size) {
                        for tile in tiles.numbers() {
                            for (i, j) in share.samples(tile).iter() {
                                samples.row_from((i, j))[..3].iter_mut().zip([i, j, 1]).for_each(|(to, n)| *to += n);
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
