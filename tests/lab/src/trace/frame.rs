//! Frames by the renderer's own driver, with shadow rays and with single rays.

use clap::ValueEnum;
use glam::Vec3;
use renderer::{
    intersect::{
        PacketScratch, clip,
        ray::{Hit, Ray},
    },
    render::{
        blocks::SampleBlock,
        frame::{Cost, Frame, Setup, Tiles, Write},
        scene::Scene,
    },
};
use shared::protocol::FrameSpec;

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
    pub light: Option<Vec3>,
}

/// Rays beside the primary ones.
#[derive(Clone, Copy, Debug, Default)]
pub struct RayCounts {
    /// Shadow rays traced.
    pub n_shadow_rays: usize,
    /// Hits that face away from the light or are occluded from it.
    pub n_shadowed: usize,
}

/// Traces all samples through their centres, and from each hit a shadow ray to the light if there is one, on the threads
/// of the current rayon pool.
pub fn trace(frame: &mut Frame, scene: &Scene, request: &FrameSpec, options: &FrameOptions) -> (Cost, RayCounts) {
    let follow =
        |setup: &Setup<'_>, tiles: &Tiles, scratch: &mut PacketScratch, counts: &mut RayCounts, write: Write<'_>| {
            let Setup { scene, rays, clip, share } = setup;
            // Shadow rays follow at once, while their triangles are in the cache.
            let mut visit = |blocks: &[SampleBlock<'_>], hits: &[[Hit; 64]], scratch: &mut PacketScratch| {
                write(blocks, hits);
                if let Some(light) = options.light {
                    let caster = ShadowCaster { scene, rays, light, kernel: options.kernel };
                    let (n_rays, n_hidden) = caster.cast(blocks, hits, scratch);
                    counts.n_shadow_rays += n_rays;
                    counts.n_shadowed += n_hidden;
                }
            };
            match options.kernel {
                Kernel::Packet => scene.trace_groups(rays, clip.as_ref(), share, tiles.numbers(), scratch, visit),
                Kernel::Single => tiles.numbers().for_each(|tile| {
                    let samples = share.samples(tile);
                    let mut hits = [Hit::MISS; 64];
                    for (hit, (i, j)) in hits.iter_mut().zip(samples.iter()) {
                        *hit = clip::intersect(scene.grid(), clip.as_ref(), Ray::new(rays.eye, rays.direction(i, j)));
                    }
                    visit(&[SampleBlock::Unit { samples, first_index: 0 }], &[hits], scratch);
                }),
            }
        };
    let (cost, counts) = frame.trace_with(scene, request, follow);
    let sum = counts.into_iter().fold(RayCounts::default(), |sum, counts| RayCounts {
        n_shadow_rays: sum.n_shadow_rays + counts.n_shadow_rays,
        n_shadowed: sum.n_shadowed + counts.n_shadowed,
    });
    (cost, sum)
}
