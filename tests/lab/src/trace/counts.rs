//! Counts the cells and triangles that the rays of a frame meet.

use rayon::prelude::*;
use renderer::{
    intersect::{RayCost, clip, ray::Ray},
    render::scene::Scene,
};
use shared::protocol::FrameSpec;

/// Cost of a frame's primary rays, traced one by one.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CostSum {
    /// Cells passed.
    pub(super) n_cells: u64,
    /// Triangles tested.
    pub(super) n_tests: u64,
}

/// Counts what the primary rays of a frame cost, on the threads of the rayon pool that this is called in.
pub(super) fn cost_sum(scene: &Scene, request: &FrameSpec) -> CostSum {
    let rays = request.camera.rays(request.size);
    let clip = scene.clip_plane(&request.camera, request.appearance.clip);
    let of_row = |j: u32| {
        (0..request.size.xres()).fold(CostSum::default(), |sum, i| {
            let ray = clip::clip_ray(clip.as_ref(), Ray::new(rays.eye, rays.direction(i, j)));
            let cost = ray.map_or(RayCost::default(), |ray| scene.grid().cost(&ray));
            CostSum { n_cells: sum.n_cells + u64::from(cost.n_cells), n_tests: sum.n_tests + u64::from(cost.n_tests) }
        })
    };
    (0..request.size.yres())
        .into_par_iter()
        .map(of_row)
        .reduce(CostSum::default, |a, b| CostSum { n_cells: a.n_cells + b.n_cells, n_tests: a.n_tests + b.n_tests })
}
