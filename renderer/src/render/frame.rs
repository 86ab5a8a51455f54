//! One whole frame, traced and shaded in parallel, with the CPU time that it took.

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
    srgb,
};

use crate::{
    intersect::{MOST_PACKETS, PacketScratch, ray::Hit},
    render::{
        blocks::{SampleBlock, for_each_group},
        parallel::work_off,
        tracer::{FrameRequest, Scene},
    },
};

/// The hits and the colours of one frame, row by row from the bottom.
#[derive(Default)]
pub struct Frame {
    /// With the triangles' places in the mesh; their numbers in the file would have to be fetched from far away.
    hits: Vec<Hit>,
    /// Colours, sRGB-encoded.
    pub rgb: Vec<u8>,
}

/// Everything that the primary rays of a frame need.
pub struct Setup<'a> {
    /// Where they are followed.
    pub scene: &'a Scene,
    /// Their directions, in world space.
    pub rays: CameraRays,
    /// The plane that cuts the scene open.
    pub clip: Option<ClipPlane>,
    /// The tiles of the frame.
    pub share: Share<'a>,
}

/// What tracing a frame took.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cost {
    /// Wall time.
    pub wall: Duration,
    /// CPU time of all threads.
    pub cpu: Duration,
}

impl Frame {
    /// Traces all samples through their centres, on the threads of the current rayon pool.
    pub fn trace(&mut self, scene: &Scene, request: &FrameRequest) -> Cost {
        let follow = |setup: &Setup<'_>, tiles: &Tiles, scratch: &mut PacketScratch, (): &mut (), write: Write<'_>| {
            let Setup { scene, rays, clip, share } = setup;
            let write = |blocks: &[SampleBlock<'_>], hits: &[[Hit; 64]], _: &mut PacketScratch| write(blocks, hits);
            scene.trace_groups(rays, clip.as_ref(), share, tiles.numbers(), scratch, write);
        };
        self.trace_with(scene, request, follow).0
    }

    /// The same, but `follow` finds the hits of some tiles: it is given the frame's setup, the tiles, memory to work in, a
    /// value of its thread, and a function to be called with all blocks of the tiles and their hits.
    ///
    /// Also returns the threads' values, which begin as their defaults.
    pub fn trace_with<T: Default + Send>(
        &mut self,
        scene: &Scene,
        request: &FrameRequest,
        follow: impl Fn(&Setup<'_>, &Tiles, &mut PacketScratch, &mut T, Write<'_>) + Sync,
    ) -> (Cost, Vec<T>) {
        let rays = request.camera.rays(request.size);
        let clip = scene.clip_plane(&request.camera, request.appearance.clip);
        let task = Division::Tiled.task(0, 1);
        let Ok(share) = task.share(request.size) else { return (Cost::default(), Vec::new()) };
        let setup = Setup { scene, rays, clip, share };
        self.hits.resize(request.size.n_samples() as usize, Hit::MISS);

        let start = Instant::now();
        let of_threads = work_off(parts(&mut self.hits, 1, request.size), |next| {
            let mut value = T::default();
            let mut scratch = PacketScratch::default();
            while let Some(Part { tiles, mut samples }) = next() {
                follow(&setup, &tiles, &mut scratch, &mut value, &mut |blocks, hits| {
                    for (block, hits) in blocks.iter().zip(hits) {
                        if let Some((i, first_j)) = block.tile() {
                            // Of a known length, rows are copied without a call.
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

    /// Shades all hits; returns the CPU time of all threads.
    pub fn shade(&mut self, scene: &Scene, request: &FrameRequest) -> Duration {
        let rays = request.camera.rays(request.size);
        let lighting = scene.lighting(request);
        let task = Division::Tiled.task(0, 1);
        let Ok(share) = task.share(request.size) else { return Duration::ZERO };
        self.rgb.resize(3 * self.hits.len(), 0);
        let all_hits = &self.hits;
        let of_threads = work_off(parts(&mut self.rgb, 3, request.size), |next| {
            let mut scratch = PacketScratch::default();
            let mut directions = [[Vec3::ZERO; 64]; MOST_PACKETS];
            let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
            while let Some(Part { tiles, mut samples }) = next() {
                for_each_group(&share, tiles.numbers(), |blocks| {
                    for (index, block) in blocks.iter().enumerate() {
                        for (sample_idx, (i, j)) in block.samples().enumerate() {
                            directions[index][sample_idx] = rays.direction(i, j);
                            hits[index][sample_idx] = all_hits[(j * request.size.xres() + i) as usize];
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

    /// Writes the hits: per sample, little endian, the triangle in file order as `u32` (0xffffffff for none) and t as
    /// `f32` in units of the ray's direction (infinite for none).
    pub fn write_hits(&self, scene: &Scene, out: &mut dyn io::Write) -> io::Result<()> {
        self.hits.iter().try_for_each(|&hit| {
            let hit = scene.with_file_index(hit);
            out.write_all(&hit.triangle.to_le_bytes())?;
            out.write_all(&hit.t.to_le_bytes())
        })
    }

    /// How many samples hit something.
    pub fn n_hits(&self) -> usize {
        self.hits.iter().filter(|hit| !hit.is_miss()).count()
    }
}

/// Writes the hits of blocks, each block's in the order of its samples.
pub type Write<'a> = &'a mut dyn FnMut(&[SampleBlock<'_>], &[[Hit; 64]]);

/// Guided self-scheduling (Polychronopoulos and Kuck, 1987): each part is the rest of the frame / (8 × threads). Large parts
/// come first, because each has a cost of its own; small ones last, so that threads end together.
const PARTS_PER_THREAD: u32 = 8;

/// Columns of tiles in a part, at least.
const LEAST_COLUMNS: u32 = 4;

/// Some columns of up to two rows of tiles.
pub struct Tiles {
    columns: Range<u32>,
    rows: Range<u32>,
    x_tiles: u32,
}

impl Tiles {
    /// The tiles' numbers in the frame, one square of 2×2 after the other, as packets go together.
    pub fn numbers(&self) -> impl Iterator<Item = u32> + Clone + use<> {
        let Self { columns, rows, x_tiles } = self;
        let (end, rows, x_tiles) = (columns.end, rows.clone(), *x_tiles);
        columns.clone().step_by(2).flat_map(move |column| {
            let columns = column..(column + 2).min(end);
            rows.clone().flat_map(move |row| columns.clone().map(move |column| row * x_tiles + column))
        })
    }
}

/// A part of a frame, for one thread at a time.
struct Part<'a, T> {
    tiles: Tiles,
    samples: Samples<'a, T>,
}

/// What belongs to the samples of a part.
struct Samples<'a, T> {
    /// The part's first sample.
    first: (u32, u32),
    /// Rows of samples, with as many `T` for each sample as the frame has.
    rows: Vec<&'a mut [T]>,
    per_sample: u32,
}

impl<T> Samples<'_, T> {
    /// What belongs to a sample, and to those that follow in its row.
    fn row_from(&mut self, (i, j): (u32, u32)) -> &mut [T] {
        let first = (i - self.first.0) * self.per_sample;
        &mut self.rows[(j - self.first.1) as usize][first as usize..]
    }
}

/// All parts of a frame for the threads of the current rayon pool. `all` has `per_sample` values for each sample, row by row.
fn parts<T>(all: &mut [T], per_sample: u32, size: FrameSize) -> impl Iterator<Item = Part<'_, T>> {
    let row_length = (size.xres() * per_sample) as usize;
    let (x_tiles, y_tiles) = (size.x_tiles(), size.y_tiles());
    let n_threads = rayon::current_num_threads() as u32;
    let bands = (0..).step_by(2).zip(all.chunks_mut(row_length * 2 * TILE_SIZE as usize));
    bands.flat_map(move |(row, band)| {
        let n_tiles = (y_tiles - row) * x_tiles / (PARTS_PER_THREAD * n_threads);
        // Two rows high, and as wide as whole squares.
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
    fn parts_are_the_whole_frame_whatever_its_size() {
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
