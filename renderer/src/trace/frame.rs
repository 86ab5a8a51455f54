//! One whole frame, traced and shaded in parallel, with the CPU time that it took.

use std::{
    io,
    ops::Range,
    sync::Mutex,
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
        let xres = request.size.xres() as usize;
        let work = Division::Tiled.work(0, 1);
        let Ok(share) = work.share(request.size) else { return Cost::default() };
        self.hits.resize(request.size.n_samples() as usize, Hit::MISS);

        let start = Instant::now();
        let total = Mutex::new(Cost::default());
        // No run of tasks is given to one thread, which might be left with it when the others have ended.
        let samples_per_task = samples_per_task(request.size);
        self.hits.par_chunks_mut(samples_per_task).enumerate().with_max_len(1).for_each(|(task, all_hits)| {
            let start = ThreadTime::now();
            let mut cost = Cost::default();
            let first = task * samples_per_task;
            let tiles = tiles_of_task(request.size, task);
            let mut scratch = PacketScratch::default();
            // What a group's rays met is still in the cache for its shadow rays.
            let mut visit = |blocks: &[Block<'_>], hits: &[[Hit; 64]], scratch: &mut PacketScratch| {
                for (Block { samples, .. }, hits) in blocks.iter().zip(hits) {
                    let width = (samples[samples.len() - 1].0 - samples[0].0) as usize + 1;
                    for (row, hits) in samples.chunks(width).zip(hits.chunks(width)) {
                        let at = row[0].1 as usize * xres + row[0].0 as usize - first;
                        let to = &mut all_hits[at..at + width];
                        match (to.as_mut_array::<8>(), hits.as_array::<8>()) {
                            (Some(to), Some(hits)) => *to = *hits,
                            _ => to.copy_from_slice(&hits[..width]),
                        }
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
                    let samples: Vec<_> = share.samples(tile).iter().collect();
                    let mut hits = [Hit::MISS; 64];
                    for (hit, &(i, j)) in hits.iter_mut().zip(&samples) {
                        *hit = clip::intersect(scene.grid(), clip, Ray::new(rays.eye, rays.direction(i, j)));
                    }
                    visit(&[Block { samples: &samples, places: &[] }], &[hits], &mut scratch);
                }),
            }
            cost.cpu = start.elapsed();
            add(&total, cost);
        });
        Cost { wall: start.elapsed(), ..total.into_inner().unwrap_or_default() }
    }

    /// Shades all hits; returns the CPU time of all threads.
    pub fn shade(&mut self, scene: &Scene, request: &FrameRequest) -> Duration {
        let rays = request.camera.rays(request.size);
        let lighting = scene.lighting(request);
        let xres = request.size.xres();
        let work = Division::Tiled.work(0, 1);
        let Ok(share) = work.share(request.size) else { return Duration::ZERO };
        self.rgb.resize(3 * self.hits.len(), 0);
        let total = Mutex::new(Cost::default());
        let samples_per_task = samples_per_task(request.size);
        let tasks = self.rgb.par_chunks_mut(3 * samples_per_task).zip(self.hits.par_chunks(samples_per_task));
        tasks.enumerate().with_max_len(1).for_each(|(task, (rgb, hits))| {
            let start = ThreadTime::now();
            let mut scratch = PacketScratch::default();
            let mut directions = [[Vec3::ZERO; 64]; MOST_PACKETS];
            let mut hits_of_blocks = [[Hit::MISS; 64]; MOST_PACKETS];
            let first = task * samples_per_task;
            let at = |(i, j): (u32, u32)| (j * xres + i) as usize - first;
            for_each_group(&share, tiles_of_task(request.size, task), |blocks| {
                for (index, Block { samples, .. }) in blocks.iter().enumerate() {
                    for (place, &(i, j)) in samples.iter().enumerate() {
                        directions[index][place] = rays.direction(i, j);
                        hits_of_blocks[index][place] = hits[at((i, j))];
                    }
                }
                let lights = lighting.of_group(blocks, 0, &directions, &hits_of_blocks, &mut scratch);
                for (Block { samples, .. }, lights) in blocks.iter().zip(lights) {
                    for (&sample, light) in samples.iter().zip(lights) {
                        rgb[3 * at(sample)..][..3].copy_from_slice(&light.to_array().map(srgb::encode));
                    }
                }
            });
            add(&total, Cost { cpu: start.elapsed(), ..Cost::default() });
        });
        total.into_inner().unwrap_or_default().cpu
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

/// Samples of a task: of two rows of tiles, whose squares of 2×2 go together; they lie together in the frame.
fn samples_per_task(size: FrameSize) -> usize {
    size.xres() as usize * 2 * TILE_SIZE as usize
}

fn tiles_of_task(size: FrameSize, task: usize) -> Range<u32> {
    let first_row = 2 * task as u32;
    first_row * size.x_tiles()..(first_row + 2).min(size.y_tiles()) * size.x_tiles()
}

fn add(total: &Mutex<Cost>, cost: Cost) {
    if let Ok(mut total) = total.lock() {
        total.cpu += cost.cpu;
        total.n_shadow_rays += cost.n_shadow_rays;
        total.n_shadowed += cost.n_shadowed;
    }
}
